"""The package's architecture: what may import what, and what no module may do."""

import ast
import re
import subprocess
import sys
from collections.abc import Iterable, Iterator, Mapping
from functools import cache
from pathlib import Path

from slpi_ros.effects.registry import EFFECTS

PACKAGE = "slpi_ros"
ROOT = Path(__file__).resolve().parents[1] / PACKAGE

# From top to bottom. A module may import its own layer and those below it, of its own layer only its own folder.
LAYERS = (
    {"cli"},
    {"papers", "nodes", "fleet"},
    {"reports"},
    {"calibration"},
    {"workflows", "export", "devices"},
    {"verification"},
    {"diagnosis"},
    {"identification", "compensator"},
    {"learning"},
    {"model", "excitation"},
    {"effects"},
    {"hysteresis", "io", "drivers", "simulation"},
    {"errors", "arrays"},
)
# Modules beside the folders.
BESIDE_FOLDERS = {"__init__.py", "errors.py"}
# Modules that import each other, wherever in the file. None is to come in, and each is to go.
KNOWN_CIRCLES: tuple[set[str], ...] = ()

# Modules outside the package that only one part of it may import.
ONLY_NODES = {"ament_index_python", "launch", "launch_ros", "rclpy", "rosidl_runtime_py"}
ONLY_NODES_ENDINGS = ("_msgs", "_srvs", "_interfaces")
ONLY_IO = {"rosbags"}

UNSAFE_MODULES = {"cloudpickle", "dill", "joblib", "marshal", "pickle", "shelve"}
UNSAFE_CALLS = {"compile", "eval", "exec"}

FILES = sorted(ROOT.rglob("*.py"))
LEVEL = {part: level for level, parts in enumerate(LAYERS) for part in parts}


def name_of(path: Path) -> str:
    return str(path.relative_to(ROOT))


def part_of(path: Path) -> str:
    """Return the part a file belongs to; "" is the public API, ``slpi_ros/__init__.py``."""
    first = path.relative_to(ROOT).parts[0].removesuffix(".py")
    return "" if first == "__init__" else first


@cache
def nodes_of(path: Path) -> tuple[ast.AST, ...]:
    """Return every node of a file's syntax tree."""
    return tuple(ast.walk(ast.parse(path.read_text(encoding="utf-8"))))


@cache
def imports_of(path: Path) -> frozenset[str]:
    """Return the full dotted name of every module or name that a file imports, wherever in the file."""

    def names() -> Iterator[str]:
        package = [PACKAGE, *path.relative_to(ROOT).parent.parts]
        for node in nodes_of(path):
            if isinstance(node, ast.Import):
                yield from (alias.name for alias in node.names)
            elif isinstance(node, ast.ImportFrom):
                base = package[: len(package) - node.level + 1] if node.level else []
                module = ".".join([*base, *([node.module] if node.module else [])])
                yield from (f"{module}.{alias.name}" for alias in node.names)

    return frozenset(names())


def parts_imported_by(path: Path) -> set[str]:
    """Return the parts of the package that a file imports; "" where it imports the public API itself."""
    names = [name.split(".") for name in imports_of(path)]
    within = [name[1] if len(name) > 1 else "" for name in names if name[0] == PACKAGE]
    return {part if part in LEVEL else "" for part in within}


def modules_imported_by(path: Path) -> set[Path]:
    """Return the files of the package that a file imports: modules, or the packages of other names."""
    found = set()
    for name in imports_of(path):
        module = ROOT.parent / name.replace(".", "/")
        places = (module.with_suffix(".py"), module / "__init__.py", module.parent.with_suffix(".py"))
        found |= {next((place for place in (*places, module.parent / "__init__.py") if place in FILES), path)}
    return found - {path}


def outside_imported_by(path: Path) -> set[str]:
    """Return the top-level modules outside the package that a file imports."""
    return {name.split(".")[0] for name in imports_of(path)} - {PACKAGE}


def needs_ros(module: str) -> bool:
    return module in ONLY_NODES or module.endswith(ONLY_NODES_ENDINGS)


def circles(imported: Mapping[Path, Iterable[Path]]) -> list[set[Path]]:
    """Return each largest set of files that import each other, directly or through others (Tarjan, 1972)."""
    order: dict[Path, int] = {}
    lowest: dict[Path, int] = {}
    stack: list[Path] = []
    found: list[set[Path]] = []

    def visit(path: Path) -> None:
        order[path] = lowest[path] = len(order)
        stack.append(path)
        for other in imported[path]:
            if other not in order:
                visit(other)
            if other in stack:
                lowest[path] = min(lowest[path], lowest[other])
        if lowest[path] == order[path]:
            first = stack.index(path)
            found.append(set(stack[first:]))
            del stack[first:]

    for path in imported:
        if path not in order:
            visit(path)
    return [circle for circle in found if len(circle) > 1]


def allowed_for(part: str) -> set[str]:
    """Return the parts that a part may import: those below, and itself."""
    if part == "":
        return LEVEL.keys() - {"cli", "fleet", "nodes", "papers"}
    allowed = {below for below in LEVEL if LEVEL[below] > LEVEL[part]} | {part}
    return allowed | {""} if LEVEL[part] <= 1 else allowed


def test_every_part_has_a_layer() -> None:
    assert not {part_of(path) for path in FILES} - LEVEL.keys() - {""}, "add them to LAYERS"


def test_modules_stand_in_folders() -> None:
    assert {path.name for path in FILES if path.parent == ROOT} == BESIDE_FOLDERS


def test_folders_are_packages() -> None:
    lacking = {name_of(path) for path in FILES if not (path.parent / "__init__.py").exists()}
    assert not lacking, "setup.py does not install a folder without __init__.py"


def test_imports_point_down() -> None:
    upward = {name_of(path): parts_imported_by(path) - allowed_for(part_of(path)) for path in FILES}
    assert not {name: parts for name, parts in upward.items() if parts}


def test_no_modules_import_each_other() -> None:
    found = [
        {name_of(path) for path in circle} for circle in circles({path: modules_imported_by(path) for path in FILES})
    ]
    assert not [circle for circle in found if circle not in KNOWN_CIRCLES]
    assert not [circle for circle in KNOWN_CIRCLES if circle not in found], "take it out of KNOWN_CIRCLES"


def test_circles_are_found() -> None:
    a, b, c, d = (Path(name) for name in "abcd")
    assert circles({a: [b], b: [c], c: [a, d], d: []}) == [{a, b, c}]
    assert circles({a: [b, c], b: [d], c: [d], d: []}) == []
    assert circles({a: [b], b: [a], c: [b, d], d: [c]}) == [{a, b}, {c, d}]


def test_ros_stays_in_nodes() -> None:
    using = {name_of(path) for path in FILES if any(map(needs_ros, outside_imported_by(path)))}
    assert not {name for name in using if not name.startswith("nodes/")}


def test_rosbags_stays_in_io() -> None:
    using = {name_of(path) for path in FILES if outside_imported_by(path) & ONLY_IO}
    assert not {name for name in using if not name.startswith("io/")}


def test_nothing_runs_what_it_reads() -> None:
    offenders = set()
    for path in FILES:
        calls = [node for node in nodes_of(path) if isinstance(node, ast.Call)]
        called = {call.func.id for call in calls if isinstance(call.func, ast.Name)}
        arguments = {keyword.arg for call in calls for keyword in call.keywords}
        if outside_imported_by(path) & UNSAFE_MODULES or called & UNSAFE_CALLS or "allow_pickle" in arguments:
            offenders.add(name_of(path))
    assert not offenders


# Parts that may name single effects: the effects themselves and the physics of simulations, which are none of theirs.
NAMING_EFFECTS = {"effects", "simulation"}
# Other names of effects, with the reason.
NAMED_ELSEWHERE = {
    "model/sensor.py": ({"delay", "lag"}, "the known timing of a sensor is the physics of these two"),
    "identification/record_quality.py": ({"creep", "delay", "lag"}, "what a drive lacks, in words"),
    "verification/tracking.py": ({"delay"}, "a part of a tracking error"),
    "reports/verification.py": ({"delay"}, "the same, in words"),
    "compensator/loop_design.py": ({"delay"}, "what limits the bandwidth of a loop, in words"),
    "reports/tuning.py": ({"delay"}, "the same"),
    "model/uncertainty.py": ({"surroundings"}, "a component of the budget"),
    "reports/certificate.py": ({"surroundings"}, "the quantities of a record, in the document"),
    "nodes/compensator.py": ({"surroundings"}, "the same"),
    "nodes/compensator_parameters.py": ({"surroundings"}, "the same"),
    "export/stage.py": ({"surroundings"}, "its quantities come into the exported source by a call of their own"),
    "nodes/identify.py": ({"surroundings"}, "the parameter, which names topics"),
    "cli/options.py": ({"clock"}, "an option of that name: which of two topics has the times of the samples"),
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
    using = {path.name for path in FILES if outside_imported_by(path) & {"dask", "distributed", "pyarrow"}}
    assert {path.name for path in FILES if part_of(path) == "fleet"} >= using


def test_only_a_table_loads_pandas() -> None:
    """It takes longer to import than all else of a command."""
    code = f"import sys, {PACKAGE}.cli, {PACKAGE}.io.tables, {PACKAGE}.nodes.identify; print(*sys.modules)"
    loaded = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT.parent, stdout=subprocess.PIPE, text=True, check=True
    )
    assert not {"pandas", "h5py", "openpyxl", "nptdms"} & set(loaded.stdout.split())


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


def test_what_the_architecture_page_names_is_there():
    text = (ROOT.parent / "docs" / "architecture.md").read_text()
    table = text[text.index("## Where to look") : text.index("## Decisions")]
    places = re.findall(r"`([\w/]+\.py)`(?: \(([^)]*)\))?", table)
    assert len(places) >= 15
    for path, names in places:
        there = (ROOT / path).read_text()
        for name in re.findall(r"`(\w+)`", names):
            assert re.search(rf"(def|class) {name}\b|^{name} = ", there, re.MULTILINE), (path, name)


# What one can hold in the head, for the code that moves a stage.
MOST_METHODS, MOST_ATTRIBUTES = 35, 20


def test_classes_that_move_a_stage_are_small_enough_to_be_read():
    found = {}
    for path in FILES:
        if part_of(path) not in ("compensator", "devices", "nodes"):
            continue
        for node in nodes_of(path):
            if isinstance(node, ast.ClassDef):
                methods = [each for each in node.body if isinstance(each, ast.FunctionDef | ast.AsyncFunctionDef)]
                attributes = {each.target.id for each in node.body if isinstance(each, ast.AnnAssign)}
                attributes |= {
                    each.attr
                    for each in ast.walk(node)
                    if isinstance(each, ast.Attribute)
                    and isinstance(each.ctx, ast.Store)
                    and isinstance(each.value, ast.Name)
                    and each.value.id == "self"
                }
                found[name_of(path), node.name] = len(methods), len(attributes)
    assert ("compensator/axis.py", "Axis") in found
    large = {name: size for name, size in found.items() if size[0] > MOST_METHODS or size[1] > MOST_ATTRIBUTES}
    assert not large
