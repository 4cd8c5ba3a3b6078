"""The launch files, read as launch does: what they start, their arguments, parameters and remappings."""

import json
import re
from importlib import import_module
from pathlib import Path

import pytest
import yaml
from launch_reader import DeclareLaunchArgument, LaunchConfiguration, actions_of, nodes_of

ROOT = Path(__file__).resolve().parents[1]
FILES = sorted((ROOT / "launch").glob("*.launch.py"))
TOPICS = json.loads((ROOT / "msg_schemas" / "topics.json").read_text())["topics"]
SIMULATED = str(ROOT / "config" / "simulated_device.yaml")
CALIBRATOR = str(ROOT / "config" / "calibrator.yaml")
WITH_DEVICE = {"driver_file": SIMULATED, "device_file": SIMULATED}
# Arguments of each file, and what it then starts, each after what.
STARTED = (
    ("device", {"driver_file": "d.yaml"}, {"driver": ""}),
    ("device", WITH_DEVICE, {"device_simulator": "", "driver": "device_simulator"}),
    ("compensator", {}, {"compensator": ""}),
    ("compensator", {"model_file": "m.json", "driver_file": "d.yaml"}, {"compensator": "", "driver": ""}),
    ("compensator", WITH_DEVICE, {"compensator": "", "device_simulator": "", "driver": "device_simulator"}),
    ("calibrate", {"params_file": CALIBRATOR, "output": "o"}, {"calibrator": ""}),
    (
        "calibrate", {"params_file": CALIBRATOR, "output": "o", "simulate": "true"},
        {"calibrator": "", "stage_simulator": ""},
    ),
    (
        "calibrate", {"params_file": CALIBRATOR, "output": "o", **WITH_DEVICE},
        {"calibrator": "", "device_simulator": "", "driver": "device_simulator"},
    ),
    ("record", {"params_file": "p.yaml", "bag": "b"}, {"exciter": "", "recorder": ""}),
    ("demo", {}, {"stage_simulator": "", "compensator": "", "identify": ""}),
)  # fmt: skip


def launch_file(name):
    return ROOT / "launch" / f"{name}.launch.py"


def declarations_of(executable):
    pytest.importorskip("rclpy")
    module = {"compensator": "compensator_parameters"}.get(executable, executable)
    return {each.name for each in import_module(f"slpi_ros.nodes.{module}").DECLARATIONS} | {"use_sim_time"}


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.name.split(".")[0])
def test_arguments_that_are_declared_are_used_and_no_others(path):
    LaunchConfiguration.used.clear()
    declared = {each.given[0] for each in actions_of(path) if isinstance(each, DeclareLaunchArgument)}
    assert LaunchConfiguration.used == declared


@pytest.mark.parametrize(("name", "arguments", "expected"), STARTED)
def test_what_is_started_and_with_which_topics_and_parameters(name, arguments, expected):
    nodes = nodes_of(launch_file(name), arguments)
    assert {node.executable: node.after for node in nodes} == expected and len(nodes) == len(expected)
    known = set(re.findall(r'"(\w+) = slpi_ros', (ROOT / "setup.py").read_text()))
    for node in nodes:
        assert node.executable in known
        own = {t["name"] for t in TOPICS if node.executable in t["publishers"] + t["subscribers"]}
        assert node.remappings.keys() >= own
        # Nothing is remapped unless an argument says so.
        assert all(topic == to for topic, to in node.remappings.items())
        assert node.parameters.keys() <= declarations_of(node.executable)


@pytest.mark.parametrize(
    ("name", "arguments"), [("compensator", WITH_DEVICE), ("calibrate", {"params_file": CALIBRATOR, "output": "o"})]
)
def test_a_topic_and_a_namespace_hold_for_all_nodes(name, arguments):
    given = {**WITH_DEVICE, **arguments, "namespace": "left", "voltage_topic": "/v/commands"}
    nodes = nodes_of(launch_file(name), given)
    assert len(nodes) == 3
    assert {node.namespace for node in nodes if node.executable != "device_simulator"} == {"left"}
    assert {node.remappings["voltage_command"] for node in nodes if node.remappings} == {"/v/commands"}


@pytest.mark.parametrize("path", sorted((ROOT / "config").glob("*.yaml")), ids=lambda path: path.stem)
def test_parameters_of_the_shipped_files_are_those_of_a_node(path):
    own = {"one_axis": "compensator", "xy": "compensator"}
    for name, given in yaml.safe_load(path.read_text()).items():
        if not isinstance(given, dict) or "ros__parameters" not in given or path.stem == "ros2_control":
            continue
        executable = name.removeprefix("/**").removeprefix("/") or own.get(path.stem, path.stem)
        assert given["ros__parameters"].keys() <= declarations_of(executable)


def test_the_simulated_device_is_where_its_driver_looks():
    given = yaml.safe_load(Path(SIMULATED).read_text())
    device, driver = (given[f"/**/{name}"]["ros__parameters"] for name in ("device_simulator", "driver"))
    assert (device["device"], device["address"]) == (driver["device"], driver["address"])
