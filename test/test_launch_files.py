"""The launch files, with stand-ins for launch, which has no wheels: what they start and which arguments they use."""

import importlib.util
import json
import re
import sys
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import MagicMock

import pytest

ROOT = Path(__file__).resolve().parents[1]
FILES = sorted((ROOT / "launch").glob("*.launch.py"))
TOPICS = json.loads((ROOT / "msg_schemas" / "topics.json").read_text())["topics"]
MODULES = (
    "launch", "launch.actions", "launch.conditions", "launch.event_handlers", "launch.events", "launch.substitutions",
    "launch_ros", "launch_ros.actions", "launch_ros.parameter_descriptions", "launch_ros.substitutions",
)  # fmt: skip


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.name.split(".")[0])
def test_executables_exist_and_arguments_are_declared(path, monkeypatch):
    stand_ins = {name: MagicMock() for name in MODULES}
    for name, module in stand_ins.items():
        monkeypatch.setitem(sys.modules, name, module)
    stand_ins["launch.substitutions"].LaunchConfiguration.side_effect = lambda name: SimpleNamespace(name=name)
    spec = importlib.util.spec_from_file_location("launch_file", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    module.generate_launch_description()
    actions, substitutions = stand_ins["launch.actions"], stand_ins["launch.substitutions"]
    nodes = stand_ins["launch_ros.actions"].Node, stand_ins["launch_ros.actions"].LifecycleNode
    started = {call.kwargs["executable"] for node in nodes for call in node.call_args_list}
    known = set(re.findall(r'"(\w+) = slpi_ros', (ROOT / "setup.py").read_text()))
    assert started and started <= known
    declared = {call.args[0] for call in actions.DeclareLaunchArgument.call_args_list}
    used = {call.args[0] for call in substitutions.LaunchConfiguration.call_args_list}
    assert used == declared
    defaults = {call.args[0]: call.kwargs.get("default_value") for call in actions.DeclareLaunchArgument.call_args_list}
    for call in (call for node in nodes for call in node.call_args_list):
        name, given = call.kwargs["executable"], dict(call.kwargs["remappings"])
        assert given.keys() >= {topic["name"] for topic in TOPICS if name in topic["publishers"] + topic["subscribers"]}
        # Nothing is remapped unless an argument says so.
        assert all(defaults[argument.name] == topic for topic, argument in given.items())
