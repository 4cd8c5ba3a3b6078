"""A package that is missing or broken is one line that names it and says how to get it, or a slower way."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from slpi_ros.errors import HOW_TO_GET

ROOT = Path(__file__).resolve().parents[1]
# What a module in the place of another one does when it is imported.
MISSING = "raise ModuleNotFoundError(f'No module named {__name__!r}', name=__name__)"
BROKEN = "raise ImportError('built for another Python')"
NO_LIBRARY = "raise OSError('libLLVM.so: cannot open shared object file')"
# Packages that are imported by another name.
IMPORTED = {"pyserial": "serial", "pyyaml": "yaml"}
FLEET = {"bokeh", "dask", "distributed", "pyarrow"}


def run(folder, name, contents, *command):
    """Run Python with a module of this name and contents in the place of the installed one."""
    (folder / f"{name}.py").write_text(contents)
    # A namespace package may be loaded already when Python starts (ruamel.yaml 0.17 by its .pth file).
    (folder / "sitecustomize.py").write_text(f"import sys\nsys.modules.pop({name!r}, None)\n")
    environment = {**os.environ, "PYTHONPATH": f"{folder}{os.pathsep}{ROOT}"}
    return subprocess.run([sys.executable, *command], env=environment, cwd=folder, capture_output=True, text=True)


@pytest.fixture(scope="module")
def record(tmp_path_factory):
    """Return a bag of 2 s and its model."""
    folder = tmp_path_factory.mktemp("record")
    t = np.arange(2000) * 1e-3
    v = 50.0 * (1.0 - np.cos(2 * np.pi * 2 * t) * np.linspace(1.0, 0.3, t.size))
    y = 1e-7 * v + 2e-7 * np.sin(2 * np.pi * 2 * t) + np.random.default_rng(0).normal(0.0, 8e-9, t.size)
    np.savetxt(folder / "table.csv", np.c_[t, v, y], delimiter=",", header="time_s,x_V,x_m", comments="")
    for line in ("import table.csv -o bag", "identify bag -o model.json --kind pi"):
        subprocess.run(
            [sys.executable, "-m", "slpi_ros.cli", *line.split()], cwd=folder, check=True, capture_output=True
        )
    return folder


def test_setup_py_and_the_ways_to_get_packages_name_the_same_ones():
    text = (ROOT / "setup.py").read_text()
    (needed,) = re.findall(r"install_requires=\[(.*?)\]", text, re.DOTALL)
    (fleet,) = re.findall(r"^FLEET = \[(.*?)\]\n", text, re.DOTALL | re.MULTILINE)
    (tables,) = re.findall(r"^TABLES = \[(.*?)\]\n", text, re.DOTALL | re.MULTILINE)
    (drivers,) = re.findall(r"^DRIVERS = \{(.*?)\}\n", text, re.DOTALL | re.MULTILINE)
    of_drivers = {IMPORTED.get(name, name) for name in re.findall(r'"([\w-]+)(?:\[\w+\])?>=', drivers)}
    named = set(re.findall(r'"([\w-]+)', needed + fleet + tables)) | {"distributed"} | of_drivers
    assert named - {"setuptools"} == HOW_TO_GET.keys()


@pytest.mark.parametrize("contents", [MISSING, BROKEN])
@pytest.mark.parametrize(
    ("name", "arguments"),
    [
        ("numpy", "show model.json"),
        ("scipy", "identify bag -o other.json"),
        ("osqp", "identify bag -o other.json"),
        ("osqp", "diagnose bag --model model.json -o diagnosis"),
        ("rosbags", "import table.csv -o other"),
        ("ruamel", "identify bag -o other.json"),
        ("pandas", "import table.csv -o other"),
        ("threadpoolctl", "refit model.json bag -o other.json"),
        ("jsonschema", "show wrong.json"),
        ("matplotlib", "experiments -o papers"),
        ("pyarrow", "fleet . -o fleet"),
    ],
)
def test_the_command_line_names_it_in_one_line(record, tmp_path, name, arguments, contents):
    (record / "wrong.json").write_text('{"schema": "slpi_ros/model/2"}')
    words = [str(record / word) if (record / word).exists() and word != "." else word for word in arguments.split()]
    done = run(tmp_path, name, contents, "-m", "slpi_ros.cli", *words)
    assert done.returncode == 1
    (line,) = done.stderr.splitlines()
    assert line.startswith(f"slpi {words[0]}: {name} ") and HOW_TO_GET[name] in line
    assert ("built for another Python" in line) == (contents == BROKEN)
    assert not [path for path in tmp_path.iterdir() if path.suffix in (".json", "") and path.name != "__pycache__"]


@pytest.mark.ros
@pytest.mark.parametrize(
    "node", ["calibrator", "compensator", "driver", "exciter", "identify", "recorder", "stage_simulator"]
)
@pytest.mark.parametrize(("name", "contents"), [("rclpy", MISSING), ("numpy", MISSING), ("numpy", BROKEN)])
def test_a_node_names_it_in_one_line(tmp_path, node, name, contents):
    done = run(tmp_path, name, contents, "-m", "slpi_ros.nodes.start", node)
    assert done.returncode == 1 and done.stdout == ""
    (line,) = done.stderr.splitlines()
    assert name in line and (HOW_TO_GET.get(name) or "setup.bash") in line


@pytest.mark.parametrize("contents", [MISSING, BROKEN])
def test_python_raises_an_error_that_names_it(tmp_path, contents):
    code = (
        "import slpi_ros\ntry:\n    slpi_ros.identify\nexcept slpi_ros.SlpiError as error:\n"
        "    assert isinstance(error, ImportError)\n    print(error)"
    )
    done = run(tmp_path, "osqp", contents, "-c", code)
    assert done.stderr == "" and done.stdout.startswith("osqp ") and HOW_TO_GET["osqp"] in done.stdout


def test_an_error_of_the_package_itself_is_not_blamed_on_another_one(tmp_path):
    code = (
        "from slpi_ros.errors import dependencies_needed\n"
        "try:\n    with dependencies_needed():\n        from slpi_ros.errors import nothing\n"
        "except ImportError as error:\n    print(type(error).__name__)"
    )
    assert run(tmp_path, "unused", "", "-c", code).stdout == "ImportError\n"


@pytest.mark.parametrize("contents", [MISSING, BROKEN, NO_LIBRARY, "njit = None", "import numpy.nothing"])
def test_without_numba_the_results_are_the_same_and_it_is_told_once(tmp_path, contents):
    code = (
        "import json, sys, numpy as np\n"
        "from slpi_ros.effects.base import EffectContext\n"
        "from slpi_ros.effects.creep import Creep\n"
        "from slpi_ros.effects.rate_dependence import RateDependence\n"
        "from slpi_ros.hysteresis.prandtl_ishlinskii import PrandtlIshlinskii\n"
        "from slpi_ros.hysteresis.turning_points import Memory\n"
        "v = 50.0 + 40.0 * np.sin(np.arange(30_000) ** 1.3 * 1e-3)\n"
        "memory = Memory(PrandtlIshlinskii(np.array([0.0, 5.0, 20.0]), np.array([1e-7, 2e-8, 3e-8])), 0.0)\n"
        "y = memory.forward_array(v)\n"
        "around = EffectContext(1e-3 * np.arange(v.size))\n"
        "felt, crept = RateDependence(1.0, 0.5).apply(v, around), Creep((1.0,), (0.02,)).apply(y, around)\n"
        "print(json.dumps([each[::100].tolist() for each in (y, felt, crept)]))"
    )
    with_numba = run(tmp_path, "unused", "", "-c", code)
    without = run(tmp_path, "numba", contents, "-c", code)
    assert with_numba.stderr == "" and without.returncode == 0
    assert without.stderr.count("NotCompiledWarning") == 1 and HOW_TO_GET["numba"] in without.stderr
    for one, other in zip(json.loads(with_numba.stdout), json.loads(without.stdout), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-12, atol=0.0)
