"""The package's architecture: what may import what, and what no module may do."""

import ast
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from slpi_ros.effects.registry import EFFECTS

PACKAGE = "slpi_ros"
ROOT = Path(__file__).resolve().parents[1] / PACKAGE

# From top to bottom. A module may import its own layer and those below it, of its own layer only its own folder.
LAYERS = (
    {"cli"},
    {"papers", "nodes", "fleet"},
    {"reports"},
    {"calibration"},
    {"diagnosis"},
    {"identification", "compensator"},
    {"model", "excitation"},
    {"effects"},
    {"hysteresis", "io", "simulation"},
    {"dependencies"},
    {"errors"},
)

# Modules outside the package that only one part of it may import.
ONLY_NODES = {"ament_index_python", "launch", "launch_ros", "rclpy", "rosidl_runtime_py"}
ONLY_NODES_ENDINGS = ("_msgs", "_srvs", "_interfaces")
ONLY_IO = {"rosbags"}

UNSAFE_MODULES = {"cloudpickle", "dill", "joblib", "marshal", "pickle", "shelve"}
UNSAFE_CALLS = {"compile", "eval", "exec"}

FILES = sorted(ROOT.rglob("*.py"))
LEVEL = {part: level for level, parts in enumerate(LAYERS) for part in parts}

every_file = pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(ROOT)))


def part_of(path: Path) -> str:
    """Return the part a file belongs to; "" is the public API, ``slpi_ros/__init__.py``."""
    first = path.relative_to(ROOT).parts[0].removesuffix(".py")
    return "" if first == "__init__" else first


def nodes_of(path: Path) -> Iterator[ast.AST]:
    """Yield every node of a file's syntax tree."""
    return ast.walk(ast.parse(path.read_text(encoding="utf-8")))


def imports_of(path: Path) -> Iterator[str]:
    """Yield the full dotted name of every module or name that a file imports, wherever in the file."""
    package = [PACKAGE, *path.relative_to(ROOT).parent.parts]
    for node in nodes_of(path):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else []
            module = ".".join([*base, *([node.module] if node.module else [])])
            yield from (f"{module}.{alias.name}" for alias in node.names)


def parts_imported_by(path: Path) -> set[str]:
    """Return the parts of the package that a file imports; "" where it imports the public API itself."""
    names = [name.split(".") for name in imports_of(path)]
    within = [name[1] if len(name) > 1 else "" for name in names if name[0] == PACKAGE]
    return {part if part in LEVEL else "" for part in within}


def outside_imported_by(path: Path) -> set[str]:
    """Return the top-level modules outside the package that a file imports."""
    return {name.split(".")[0] for name in imports_of(path)} - {PACKAGE}


def needs_ros(module: str) -> bool:
    return module in ONLY_NODES or module.endswith(ONLY_NODES_ENDINGS)


@every_file
def test_every_part_has_a_layer(path: Path) -> None:
    assert part_of(path) in LEVEL.keys() | {""}, f"add {part_of(path)!r} to LAYERS"


@every_file
def test_folder_is_a_package(path: Path) -> None:
    assert (path.parent / "__init__.py").exists(), "setup.py does not install a folder without __init__.py"


@every_file
def test_imports_point_down(path: Path) -> None:
    part, imported = part_of(path), parts_imported_by(path)
    if part == "":
        allowed = LEVEL.keys() - {"cli", "fleet", "nodes", "papers"}
    else:
        allowed = {below for below in LEVEL if LEVEL[below] > LEVEL[part]} | {part}
        allowed |= {"", *LAYERS[0]} if part == "cli" else {""} if part in LAYERS[1] else set()
    assert imported <= allowed, f"{part or PACKAGE} may not import {sorted(imported - allowed)}"


@every_file
def test_ros_stays_in_nodes(path: Path) -> None:
    ros = {module for module in outside_imported_by(path) if needs_ros(module)}
    assert part_of(path) == "nodes" or not ros


@every_file
def test_rosbags_stays_in_io(path: Path) -> None:
    assert part_of(path) == "io" or not outside_imported_by(path) & ONLY_IO


@every_file
def test_nothing_runs_what_it_reads(path: Path) -> None:
    assert not outside_imported_by(path) & UNSAFE_MODULES
    calls = [node for node in nodes_of(path) if isinstance(node, ast.Call)]
    called = {call.func.id for call in calls if isinstance(call.func, ast.Name)}
    assert not called & UNSAFE_CALLS
    assert not any(keyword.arg == "allow_pickle" for call in calls for keyword in call.keywords)


# Parts that may name single effects: the effects themselves and the physics of simulations, which are none of theirs.
NAMING_EFFECTS = {"effects", "simulation"}
# Other names of effects, with the reason.
NAMED_ELSEWHERE = {
    "model/sensor.py": ({"delay", "lag"}, "the known timing of a sensor is the physics of these two"),
    "nodes/stage_simulator.py": (set(EFFECTS), "parameters of the simulated stage"),
    "identification/record_quality.py": ({"creep", "delay", "lag"}, "what a drive lacks, in words"),
    "diagnosis/verify.py": ({"delay"}, "a cause of a tracking error"),
}


def effects_named_by(path: Path) -> set[str]:
    """Return the effects that a file imports or names in a text of its own."""
    texts = {node.value for node in nodes_of(path) if isinstance(node, ast.Constant) and isinstance(node.value, str)}
    start = f"{PACKAGE}.effects."
    imported = {name.removeprefix(start).split(".")[0] for name in imports_of(path) if name.startswith(start)}
    return (texts | imported) & EFFECTS.keys()


def test_effects_own_their_facts() -> None:
    """A new effect is its own file and an entry in the registry: nothing else names an effect."""
    others = [path for path in FILES if part_of(path) not in NAMING_EFFECTS]
    named = {str(path.relative_to(ROOT)): found for path in others if (found := effects_named_by(path))}
    assert named.keys() == NAMED_ELSEWHERE.keys()
    assert all(named[path] <= effects for path, (effects, _) in NAMED_ELSEWHERE.items())


def test_public_api_loads_neither_ros_nor_rosbags() -> None:
    code = f"import sys, {PACKAGE}; print(*sorted({{name.split('.')[0] for name in sys.modules}}))"
    command = [sys.executable, "-c", code]
    loaded = set(subprocess.run(command, cwd=ROOT.parent, stdout=subprocess.PIPE, text=True, check=True).stdout.split())
    assert PACKAGE in loaded
    assert not {module for module in loaded if needs_ros(module)} | loaded & ONLY_IO


def test_only_a_fleet_loads_dask() -> None:
    code = f"import sys, {PACKAGE}.cli, {PACKAGE}.fleet; {PACKAGE}.cli.parser('fleet'); print(*sys.modules)"
    loaded = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT.parent, stdout=subprocess.PIPE, text=True, check=True
    )
    assert not {"dask", "distributed", "pandas", "pyarrow"} & set(loaded.stdout.split())
    using = {path.name for path in FILES if outside_imported_by(path) & {"dask", "distributed", "pandas", "pyarrow"}}
    assert {path.name for path in FILES if part_of(path) == "fleet"} >= using


def test_only_whole_paths_load_the_compiler() -> None:
    """Neither the command line nor a node pays for it at its start."""
    code = f"import sys, {PACKAGE}.cli, {PACKAGE}.nodes.compensator; print('numba' in sys.modules)"
    command = [sys.executable, "-c", code]
    said = subprocess.run(command, cwd=ROOT.parent, stdout=subprocess.PIPE, text=True, check=True).stdout
    assert said.strip() == "False"


def test_the_objects_of_the_architecture_page_stand_where_it_says():
    text = (ROOT.parent / "docs" / "architecture.md").read_text()
    places = re.findall(r"`\w+\.([\w, ]+)` \|.*?\(\.\./(slpi_ros/[\w/]+\.py)#L(\d+)\)", text)
    assert len(places) >= 6
    for names, path, line in places:
        there = (ROOT.parent / path).read_text().splitlines()[int(line) - 1]
        assert any(f"def {name.strip()}(" in there for name in names.split(",")), (path, line, there)
