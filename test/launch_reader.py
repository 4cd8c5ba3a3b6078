"""What a launch file starts, read without launch, which has no wheels: the nodes, their parameters and remappings.

Stand-ins for the few classes of launch that the launch files use; `nodes_of` evaluates a file with arguments as launch
does. Nothing of rclpy is replaced: the nodes can then be started as processes.
"""

import importlib.util
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType
from typing import Any, ClassVar

import yaml

ROOT = Path(__file__).resolve().parents[1]
SHARE = {"slpi_ros": ROOT}
Arguments = dict[str, str]
# What an executable says when it is ready.
READY = {"device_simulator": "own range"}


class Stand:
    """Keeps what it was made with."""

    def __init__(self, *given: Any, **named: Any) -> None:
        self.given, self.named = given, named


class Substitution(Stand):
    """Becomes a text once the arguments are known."""

    def text(self, _: Arguments) -> str:
        raise NotImplementedError


class LaunchConfiguration(Substitution):
    used: ClassVar[set[str]] = set()

    def __init__(self, *given: Any, **named: Any) -> None:
        super().__init__(*given, **named)
        self.used.add(given[0])

    def text(self, arguments: Arguments) -> str:
        return arguments[self.given[0]]


class EqualsSubstitution(Substitution):
    def text(self, arguments: Arguments) -> str:
        return str(text_of(self.given[0], arguments) == text_of(self.given[1], arguments)).lower()


class PathJoinSubstitution(Substitution):
    def text(self, arguments: Arguments) -> str:
        return str(Path(*(text_of(part, arguments) for part in self.given[0])))


class FindPackageShare(Substitution):
    def text(self, _: Arguments) -> str:
        return str(SHARE[self.given[0]])


class ParameterValue(Substitution):
    def text(self, arguments: Arguments) -> str:
        return text_of(self.given[0], arguments)


class IfCondition(Stand):
    def holds(self, arguments: Arguments) -> bool:
        return text_of(self.given[0], arguments).lower() in ("true", "1")


class UnlessCondition(IfCondition):
    def holds(self, arguments: Arguments) -> bool:
        return not super().holds(arguments)


class Node(Stand): ...


class LifecycleNode(Node): ...


class DeclareLaunchArgument(Stand): ...


class IncludeLaunchDescription(Stand): ...


class RegisterEventHandler(Stand): ...


class OnProcessExit(Stand): ...


class OnProcessIO(Stand): ...


class EmitEvent(Stand): ...


class Shutdown(Stand): ...


class LaunchDescription(Stand): ...


MODULES = {
    "launch": (LaunchDescription,),
    "launch.actions": (DeclareLaunchArgument, EmitEvent, IncludeLaunchDescription, RegisterEventHandler),
    "launch.conditions": (IfCondition, UnlessCondition),
    "launch.event_handlers": (OnProcessExit, OnProcessIO),
    "launch.events": (Shutdown,),
    "launch.substitutions": (EqualsSubstitution, LaunchConfiguration, PathJoinSubstitution),
    "launch_ros": (),
    "launch_ros.actions": (LifecycleNode, Node),
    "launch_ros.parameter_descriptions": (ParameterValue,),
    "launch_ros.substitutions": (FindPackageShare,),
}


@dataclass
class Started:
    """One node that a launch file starts."""

    executable: str
    name: str
    namespace: str
    files: list[str] = field(default_factory=list)  # of parameters, in order
    parameters: dict[str, Any] = field(default_factory=dict)
    remappings: dict[str, str] = field(default_factory=dict)
    after: str = ""  # executable on whose output it is started; "": at once

    def words(self) -> list[str]:
        """Return its arguments, as launch_ros gives them."""
        words = ["-r", f"__node:={self.name}"] if self.name else []
        words += ["-r", f"__ns:=/{self.namespace.strip('/')}"] if self.namespace else []
        words += [word for file in self.files for word in ("--params-file", file)]
        words += [word for pair in self.remappings.items() for word in ("-r", "{}:={}".format(*pair))]
        return words


def text_of(given: Any, arguments: Arguments) -> str:
    """Return a text or what a substitution becomes; parts of a list are joined."""
    if isinstance(given, (list, tuple)):
        return "".join(text_of(part, arguments) for part in given)
    return given.text(arguments) if isinstance(given, Substitution) else str(given)


@contextmanager
def stand_ins() -> Iterator[None]:
    """Let the launch files import the stand-ins, whatever is installed."""
    before = {name: sys.modules.get(name) for name in MODULES}
    for name, classes in MODULES.items():
        module = ModuleType(name)
        module.__dict__.update({each.__name__: each for each in classes})
        sys.modules[name] = module
    try:
        yield
    finally:
        for name, module in before.items():
            sys.modules.pop(name)
            if module is not None:
                sys.modules[name] = module


def actions_of(path: Path) -> list[Stand]:
    """Return the actions of a launch file."""
    with stand_ins():
        spec = importlib.util.spec_from_file_location("launch_file", path)
        assert spec is not None and spec.loader is not None
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
        return list(module.generate_launch_description().given[0])


def nodes_of(path: Path, given: Mapping[str, str]) -> list[Started]:
    """Return what a launch file starts with these arguments; AssertionError for one that it has not or that lacks."""
    actions = actions_of(path)
    declared = {each.given[0]: each.named for each in actions if isinstance(each, DeclareLaunchArgument)}
    assert given.keys() <= declared.keys(), f"{path.name} has no argument {sorted(given.keys() - declared.keys())}"
    arguments = dict(given)
    for name, named in declared.items():
        assert name in given or "default_value" in named, f"{path.name} needs {name}"
        if name not in given:
            arguments[name] = text_of(named["default_value"], arguments)
    found: list[Started] = []
    for action in actions:
        found += _started(action, arguments)
    return found


def _started(action: Stand, arguments: Arguments, after: str = "") -> list[Started]:
    condition = action.named.get("condition")
    if condition is not None and not condition.holds(arguments):
        return []
    if isinstance(action, IncludeLaunchDescription):
        handed = {name: text_of(value, arguments) for name, value in action.named["launch_arguments"]}
        return nodes_of(Path(text_of(action.given[0], arguments)), handed)
    if isinstance(action, RegisterEventHandler) and isinstance(action.given[0], OnProcessIO):
        return _on_output(action.given[0], arguments)
    if not isinstance(action, Node):
        return []
    named = action.named
    assert named["package"] == "slpi_ros"
    node = Started(
        named["executable"],
        named.get("name", ""),
        text_of(named.get("namespace", ""), arguments),
        remappings={topic: text_of(to, arguments) for topic, to in named.get("remappings", ())},
        after=after,
    )
    for each in named["parameters"]:
        if isinstance(each, dict):
            node.parameters |= {key: _value(value, arguments) for key, value in each.items()}
        else:
            node.files.append(text_of(each, arguments))
    return [node]


def _on_output(handler: OnProcessIO, arguments: Arguments) -> list[Started]:
    """Return what is started by the line with which the process is ready; by another line nothing is."""
    source = _started(handler.named["target_action"], arguments)
    if not source:
        return []
    for text, expected in ((b"anything else\n", 0), (f"it says: {READY[source[0].executable]}\n".encode(), 1)):
        event = Stand()
        event.text = text  # type: ignore[attr-defined]
        answers = [each for each in (handler.named[key](event) for key in ("on_stdout", "on_stderr")) if each]
        # Launch starts one action once.
        assert len(set(map(id, answers))) == expected
    return _started(answers[0], arguments, source[0].executable)


def _value(given: Any, arguments: Arguments) -> Any:
    if not isinstance(given, Substitution):
        return given
    text = text_of(given, arguments)
    return text if given.named.get("value_type") is str else yaml.safe_load(text)
