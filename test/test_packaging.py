"""What is installed elsewhere: source distribution, wheel, container, and what package.xml names."""

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
ROSDEP = {"rosbags": "python3-rosbags-pip"}
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
