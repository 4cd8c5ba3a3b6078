"""What is installed elsewhere: source distribution, wheel, container, and what package.xml names."""

import os
import re
import subprocess
import sys
import sysconfig
import tarfile
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
sys.path.append(str(ROOT / "tools"))

import check_package  # noqa: E402

# Names that differ between PyPI and rosdep, and what rosdep has no key for.
ROSDEP = {"rosbags": "python3-rosbags-pip", "ruamel": "python3-ruamel.yaml"}
NO_KEY = {"osqp", "threadpoolctl", "setuptools"}


@pytest.mark.slow
def test_the_wheel_is_complete_and_works_in_an_environment_of_its_own(tmp_path):
    source, wheel = check_package.build(tmp_path)
    assert not check_package.missing(wheel)
    with tarfile.open(source) as archive:
        names = archive.getnames()
    assert not [name for name in names if "__pycache__" in name or "/." in name]
    dependencies = Path(sysconfig.get_paths()["purelib"])
    said = check_package.try_wheel(wheel, tmp_path, "--no-deps", "--no-index", dependencies=dependencies)
    where, held_out = said.splitlines()[-1].split()
    assert Path(where).is_relative_to(tmp_path)
    assert 6e-9 < float(held_out) < 10e-9


def required():
    text = (ROOT / "setup.py").read_text()
    (found,) = re.findall(r"install_requires=\[(.*?)\]", text, re.DOTALL)
    return set(re.findall(r'"([\w-]+)', found))


def test_package_xml_names_every_dependency_that_rosdep_knows():
    root = ElementTree.parse(ROOT / "package.xml").getroot()
    keys = {each.text for each in root.iter("exec_depend")}
    for name in required() - NO_KEY:
        assert ROSDEP.get(name, f"python3-{name}") in keys
    page = (ROOT / "docs" / "how-to" / "install.md").read_text()
    for name in required() - {"setuptools"}:
        assert name in page


def test_the_dockerfile_passes_its_linter_and_installs_what_the_package_needs():
    linter = Path(sys.executable).with_name("hadolint")
    if not linter.exists():
        pytest.skip("hadolint is not installed")
    done = subprocess.run([linter, ROOT / "Dockerfile"], stdout=subprocess.PIPE, text=True)
    assert done.returncode == 0, done.stdout
    text = (ROOT / "Dockerfile").read_text()
    for name in required() - {"setuptools"}:
        assert re.search(rf"\b(python3-)?{name}\b", text), name
    pinned = re.findall(r"^\S+==\S+", (ROOT / "requirements" / "lock.txt").read_text(), re.MULTILINE)
    assert set(re.findall(r"[\w-]+==[\w.]+", text)) <= set(pinned)


def test_versions_agree():
    version = ElementTree.parse(ROOT / "package.xml").getroot().find("version").text
    assert f'version="{version}"' in (ROOT / "setup.py").read_text()
    assert f"\n{version} (" in (ROOT / "CHANGELOG.rst").read_text()


def test_the_changelog_is_short_and_names_no_other_version():
    version = ElementTree.parse(ROOT / "package.xml").getroot().find("version").text
    sections = re.split(r"^(.+)\n-+$", (ROOT / "CHANGELOG.rst").read_text(), flags=re.MULTILINE)[1:]
    for name, text in zip(sections[::2], sections[1::2], strict=True):
        assert name == "Forthcoming" or name.split()[0] == version
        assert 1 <= len(re.findall(r"^\* ", text, re.MULTILINE)) <= 30, name


def minima():
    """Return the lower bound of each package that setup.py names one for."""
    found = re.findall(r'"([\w-]+)(?:\[\w+\])?>=([\w.]+)', (ROOT / "setup.py").read_text())
    assert len(found) >= 20
    return dict(found)


def pins(name):
    """Return the versions in one of the files of requirements/."""
    return dict(re.findall(r"^([\w-]+)==([\w.]+)", (ROOT / "requirements" / f"{name}.txt").read_text(), re.MULTILINE))


def test_the_tests_run_with_every_lower_bound_and_with_nothing_older():
    run = [pins(name) for name in ("lock", "jazzy", "minimum")]
    for name, least in minima().items():
        versions = {each[name] for each in run if name in each}
        assert least == min(versions, key=lambda version: tuple(map(int, re.findall(r"\d+", version)))), name


def test_every_pin_that_replaces_one_has_something_to_replace_or_is_needed():
    known = pins("lock").keys() | {"pyrsistent", "pytz", "six", "wheel"}
    assert pins("jazzy").keys() <= known
    assert pins("minimum").keys() <= pins("jazzy").keys() | pins("lock").keys()


def run_script(*command, **environment):
    environment = {**{name: value for name, value in os.environ.items() if name != "PYTHON"}, **environment}
    return subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True)


def python_in(folder, version, name="python3"):
    """Make a program that answers as a Python of another version does; return its path."""
    folder.mkdir(parents=True, exist_ok=True)
    program = folder / name
    program.write_text(
        f'#!/bin/sh\ncase "$2" in *realpath*) echo {program} ;; *version_info*) echo {version} ;; esac\n'
    )
    program.chmod(0o755)
    return program


def test_a_python_is_found_where_it_is_not_the_one_in_use(tmp_path):
    of_pyenv = tmp_path / "pyenv" / "versions" / "3.12.9" / "bin"
    wanted, other = python_in(of_pyenv, "3.12", "python3.12"), python_in(tmp_path / "bin", "3.10")
    # What pyenv puts into PATH for a version that is not active.
    (tmp_path / "bin" / "python3.12").write_text(
        "#!/bin/sh\necho 'pyenv: python3.12: command not found' >&2\nexit 127\n"
    )
    (tmp_path / "bin" / "python3.12").chmod(0o755)
    environment = {
        "PATH": f"{tmp_path / 'bin'}:/usr/bin:/bin",
        "PYENV_ROOT": str(tmp_path / "pyenv"),
        "UV_PYTHON_INSTALL_DIR": str(tmp_path / "uv"),
        "HOME": str(tmp_path),
    }
    found = run_script("tools/find_python.sh", "3.12", "venv", **environment)
    assert (found.returncode, found.stdout) == (0, f"{wanted}\n")
    found = run_script("tools/find_python.sh", "3.10 3.12", "venv", **environment)
    assert found.stdout == f"{other}\n"
    named = python_in(tmp_path / "named", "3.12")
    assert run_script("tools/find_python.sh", "3.12", "venv", **environment, PYTHON=str(named)).stdout == f"{named}\n"
    found = run_script("tools/find_python.sh", "3.9", "venv", **environment)
    assert (found.returncode, found.stdout) == (1, "")


@pytest.mark.parametrize("ci", ["", "true"])
def test_ci_says_loudly_that_there_is_no_python_of_ubuntu(tmp_path, ci):
    python_in(tmp_path, "3.11")
    for name in ("chromium", "clang", "cppcheck", "g++", "make", "python3.12"):
        (tmp_path / name).write_text(f'#!/bin/sh\n[ {name} != python3.12 ] || exit 127\necho {name} "$@"\n')
        (tmp_path / name).chmod(0o755)
    environment = {"PATH": f"{tmp_path}:/usr/bin:/bin", "PYENV_ROOT": str(tmp_path), "HOME": str(tmp_path), "CI": ci}
    done = run_script(".ci/run", **environment, UV_PYTHON_INSTALL_DIR=str(tmp_path))
    assert done.returncode == (1 if ci else 0)
    assert done.stdout == "make test\n" and "NOT TESTED" in done.stderr
