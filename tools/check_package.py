"""Build the source distribution and the wheel, compare their contents, and try the wheel in a fresh environment."""

import argparse
import os
import re
import shutil
import subprocess
import sys
import tarfile
import tempfile
import venv
import zipfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
BUILD = "import sys; from setuptools import build_meta as b; print(getattr(b, 'build_' + sys.argv[1])(sys.argv[2]))"
# What somebody without ROS does first.
TRIAL = """
slpi excite -o drive.csv --voltage-min 0 --voltage-max 100
python -c 'import numpy as np
from slpi_ros.simulation.stage import Stage
t, v = np.loadtxt("drive.csv", delimiter=",", skiprows=1).T
stage = Stage.random(["x"], 1, 8e-9)
y = [stage.measure(stage.step(when, [volts]))[0] for when, volts in zip(t, v)]
np.savetxt("record.csv", np.c_[t, v, y], delimiter=",", header="time_s,x_V,x_m", comments="")'
slpi import record.csv -o record
slpi identify record -o stage.json --report report
slpi show stage.json
python -c 'import slpi_ros; print(slpi_ros.__file__, slpi_ros.load_model("stage.json").axes["x"].quality.held_out_rms)'
"""


def build(folder: Path) -> tuple[Path, Path]:
    """Return source distribution and wheel; the wheel is built from the source distribution, as an index would."""
    source = run_build(copy_of_checkout(folder / "checkout"), "sdist", folder)
    with tarfile.open(source) as archive:
        archive.extractall(folder / "unpacked", filter="data")
    (unpacked,) = (folder / "unpacked").iterdir()
    return source, run_build(unpacked, "wheel", folder)


def run_build(tree: Path, what: str, target: Path) -> Path:
    """Build in a process of its own; return the file."""
    command = [sys.executable, "-W", "error::UserWarning", "-c", BUILD, what, str(target)]
    done = subprocess.run(command, cwd=tree, capture_output=True, text=True)
    if done.returncode:
        sys.exit(f"the {what} cannot be built: {done.stderr}")
    return target / done.stdout.splitlines()[-1]


def copy_of_checkout(target: Path) -> Path:
    """Copy the checkout without what builds have left behind; return the copy."""
    made = ("build", "build-*", "install", "install-*", "log", "log-*", "dist", "_build", "*.egg-info", "__pycache__")
    left_behind = shutil.ignore_patterns(".*", *made)
    return Path(shutil.copytree(ROOT, target, symlinks=True, ignore=left_behind))


def missing(wheel: Path) -> set[str]:
    """Return the files of the package, its schemas and its shared files that the wheel does not contain."""
    with zipfile.ZipFile(wheel) as archive:
        names = set(archive.namelist())
    share = f"{wheel.stem.split('-')[0]}-{wheel.stem.split('-')[1]}.data/data/share/slpi_ros"
    package = [path for path in (ROOT / "slpi_ros").rglob("*") if path.suffix == ".py" or path.name == "py.typed"]
    wanted = {str(path.relative_to(ROOT)) for path in package}
    wanted |= {f"slpi_ros/reports/assets/{path.name}" for path in (ROOT / "slpi_ros/reports/assets").iterdir()}
    wanted |= {f"slpi_ros/export/templates/{path.name}" for path in (ROOT / "slpi_ros/export/templates").iterdir()}
    wanted |= {f"slpi_ros/msg_schemas/{path.name}" for path in (ROOT / "msg_schemas").glob("*.json")}
    for folder, pattern in (("launch", "*.py"), ("config", "*"), ("msg_schemas", "*.json")):
        wanted |= {f"{share}/{folder}/{path.name}" for path in (ROOT / folder).glob(pattern)}
    return wanted - names


def try_wheel(wheel: Path, folder: Path, *options: str, dependencies: Path | None = None) -> str:
    """Install the wheel into a new environment and run the trial there; return what it printed.

    `dependencies` is a folder of installed packages that the environment sees behind its own.
    """
    home = folder / "environment"
    venv.create(home, with_pip=False)
    if dependencies:
        (site,) = home.glob("lib/python*/site-packages")
        (site / "dependencies.pth").write_text(f"{dependencies}\n")
    pip = [sys.executable, "-m", "pip", "--python", str(home), "--disable-pip-version-check", "install", "-q"]
    subprocess.run([*pip, *options, str(wheel)], check=True)
    environment = {name: value for name, value in os.environ.items() if name not in ("PYTHONPATH", "VIRTUAL_ENV")}
    environment["PATH"] = f"{home / 'bin'}:{environment['PATH']}"
    trial = folder / "trial"
    trial.mkdir()
    done = subprocess.run(["sh", "-euc", TRIAL], cwd=trial, env=environment, stdout=subprocess.PIPE, text=True)
    if done.returncode:
        sys.exit(f"the trial failed: {done.stdout}")
    return done.stdout


def main() -> None:
    """Build, check and, with ``--install``, try the wheel with the pinned dependencies from the package index."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--install", action="store_true", help="install the wheel with its dependencies and try it")
    options = parser.parse_args()
    target = ROOT / "dist"
    target.mkdir(exist_ok=True)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        made = build(folder)
        if lost := missing(made[1]):
            sys.exit(f"the wheel lacks {', '.join(sorted(lost))}")
        if options.install:
            # The new wheel has no hash, and pip does not take some packages with hashes and some without.
            pins = re.findall(r"^[\w.-]+==[^\s\\]+", (ROOT / "requirements" / "lock.txt").read_text(), re.MULTILINE)
            (folder / "pins.txt").write_text("\n".join(pins))
            print(try_wheel(made[1], folder, "-c", str(folder / "pins.txt")))
        for path in made:
            print(path.replace(target / path.name).relative_to(ROOT))


if __name__ == "__main__":
    main()
