"""The life of a compensator: how it starts, is told what to do, and ends."""

import json
import os
import signal
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

rclpy = pytest.importorskip("rclpy")

from lifecycle_msgs.msg import State, Transition  # noqa: E402
from lifecycle_msgs.srv import GetState  # noqa: E402
from nodes.compensator_client import Client, compensator  # noqa: E402
from nodes.ros_helpers import LATCHED, NodeProcess, on_graph, stage_model, started  # noqa: E402
from rcl_interfaces.srv import DescribeParameters, GetParameters  # noqa: E402
from std_msgs.msg import String  # noqa: E402

from slpi_ros.hysteresis.multi_slope import (  # noqa: E402
    AmplitudeScaled,  # noqa: E402
    MultiSlope,
    thresholds_for,
)
from slpi_ros.model.axis_model import AxisModel, FitQuality, Start  # noqa: E402
from slpi_ros.model.document import format_model, save_model  # noqa: E402
from slpi_ros.model.stage_model import StageModel  # noqa: E402

CHECKOUT = Path(__file__).resolve().parents[2]
CONFIGURE, CLEANUP = Transition.TRANSITION_CONFIGURE, Transition.TRANSITION_CLEANUP
ACTIVATE, DEACTIVATE = Transition.TRANSITION_ACTIVATE, Transition.TRANSITION_DEACTIVATE


@pytest.fixture
def x_file(tmp_path: Path) -> str:
    path = tmp_path / "x.json"
    save_model(stage_model(), path)
    return str(path)


def state(client: Client) -> int:
    return client.graph.call(GetState, f"{client.name}/get_state", GetState.Request()).current_state.id


def test_lifecycle_by_services(x_file):
    with compensator(autostart=False, model_file=x_file) as client:
        client.connect("unconfigured")
        assert not client.graph.node.get_publishers_info_by_topic("/voltage_command")
        assert client.change_state(CONFIGURE)
        client.connect("inactive")
        client.wish(["x"], [1e-6])
        client.report("the rejection", **{"rejected.inactive": 1})
        assert client.change_state(ACTIVATE)
        status, _ = client.report(state="active")
        before = client.ask(["x"], [5e-6])
        assert client.change_state(DEACTIVATE) and client.change_state(ACTIVATE)
        # Memory and voltage are still there: the same wish again moves nothing.
        assert client.ask(["x"], [5e-6]) == before
        assert client.change_state(DEACTIVATE) and client.change_state(CLEANUP)
        client.report(state="unconfigured", **{"model.kind": ""})
        assert state(client) == State.PRIMARY_STATE_UNCONFIGURED
        assert client.change_state(CONFIGURE) and client.change_state(ACTIVATE)
        client.connect()
        assert client.ask(["x"], [3e-6]) != before
        assert client.change_state(Transition.TRANSITION_ACTIVE_SHUTDOWN)
        client.report(state="finalized")
        assert client.node.stop() == 0


def test_impossible_transitions_are_refused_and_survived():
    with compensator() as client:
        client.connect()
        for transition in (CONFIGURE, ACTIVATE, CLEANUP, 0, 97, 255):
            assert not client.change_state(transition)
        assert state(client) == State.PRIMARY_STATE_ACTIVE
        assert "Traceback" not in client.node.stderr


def test_a_wrong_model_file_keeps_it_unconfigured_until_it_is_right(x_file, tmp_path):
    with compensator(autostart=False, model_file=str(tmp_path / "none.json")) as client:
        client.connect("unconfigured")
        assert not client.change_state(CONFIGURE)
        status, values = client.report(models_refused=1)
        assert status.level == b"\2" and "none.json: cannot read a model" in status.message
        assert state(client) == State.PRIMARY_STATE_UNCONFIGURED
        missing = str(tmp_path / "missing.json")
        assert "cannot read a model" in client.graph.set_parameters(client.name, model_file=missing)
        assert client.graph.set_parameters(client.name, model_file=x_file) == ""
        assert client.change_state(CONFIGURE) and client.change_state(ACTIVATE)
        client.connect()
        assert client.ask(["x"], [0.0]) == [0.0]


@pytest.mark.parametrize(("executor", "number"), [("events", signal.SIGTERM), ("default", signal.SIGINT)])
def test_a_signal_ends_it_in_order(number, executor):
    with compensator(executor=executor) as client:
        client.connect()
        assert state(client) == State.PRIMARY_STATE_ACTIVE, "who answers is spinning"
        assert client.node.stop(number) == 0
        assert client.node.stderr == ""


WRONG = [
    ({"axes": ["x", "x"]}, "axes"),
    ({"axes": [""]}, "axes"),
    ({"axes": []}, "axes"),
    ({"axes": "x"}, "axes"),
    ({"voltage_min": 100}, "voltage_max"),
    ({"axes": ["x", "y"], "voltage_min": [0.0, 90.0], "voltage_max": [100, 80]}, "axis 'y'"),
    ({"voltage_max": [1.0, 2.0]}, "voltage_max"),
    ({"voltage_max": float("nan")}, "voltage_max"),
    ({"voltage_max": "high"}, "voltage_max"),
    ({"voltage_min": False}, "voltage_min"),
    ({"slew_limit": -1}, "slew_limit"),
    ({"slew_limit": -1.0}, "slew_limit"),
    ({"command_timeout": -0.5}, "command_timeout"),
    ({"desired_type": "Pose"}, "desired_type"),
    ({"desired_type": "Float64", "axes": ["x", "y"]}, "Float64"),
    ({"executor": "fast"}, "executor"),
    ({"diagnostic_period": 0}, "diagnostic_period"),
]


def test_wrong_parameters_are_refused_in_one_line(tmp_path):
    nodes = []
    try:
        for parameters, _ in WRONG:
            nodes.append(NodeProcess("compensator", parameters, ()))
        for node, (parameters, named) in zip(nodes, WRONG, strict=True):
            assert node.wait() == 2, (parameters, node.stderr)
            assert node.stderr.count("\n") == 1 and named in node.stderr, (parameters, node.stderr)
    finally:
        for node in nodes:
            node.kill()


@pytest.mark.parametrize("text", [None, "garbage", format_model(stage_model(("y",)))])
def test_a_wrong_model_file_ends_it_in_one_line(tmp_path, text):
    path = tmp_path / "model.json"
    if text is not None:
        path.write_text(text)
    with started("compensator", {"model_file": str(path)}) as node:
        assert node.wait() == 1
        assert node.stderr.count("\n") == 1 and str(path) in node.stderr


WEIGHTS = 1e-7 * np.array([5, 0, 1, 2, 0, 0, 1, 0.5, 0, 0, 0, 0.2, 0])
SMPI = AmplitudeScaled(
    MultiSlope(-10.0, 120.0, thresholds_for(120.0), WEIGHTS), np.array([60.0, 120.0]), np.array([40e-6, 90e-6])
)
# It needs whole paths.
PATH_MODEL = AxisModel(
    "smpi", SMPI, Start(-10.0, 1e-6), (-10.0, 110.0), (1e-6, 91e-6), FitQuality(0, 0, 0, 0, 1, 1, "")
)


def test_a_model_that_needs_whole_paths_is_refused_either_way(tmp_path):
    path, text = tmp_path / "smpi.json", format_model(StageModel({"x": PATH_MODEL}, "", ""))
    path.write_text(text)
    said = "axis 'x': kind 'smpi'"
    with started("compensator", {"model_file": str(path)}) as node:
        # Both nodes have one name: the report of the other is looked at once this one has ended.
        assert node.wait() == 1 and node.stderr.startswith(f"{path}: {said}") and node.stderr.count("\n") == 1
    with compensator() as client:
        client.connect()
        client.graph.publisher(String, "/stage_model", LATCHED).publish(String(data=text))
        _, values = client.report(models_refused=1)
        assert values["last_model_error"].startswith(f"/stage_model: {said}")


def test_parameters_change_together_or_not_at_all(x_file):
    with compensator(model_file=x_file) as client:
        client.connect()
        assert 40.0 < client.ask(["x"], [5e-6])[0] < 60.0
        assert client.graph.set_parameters(client.name, voltage_min=10, voltage_max=[70], slew_limit=0) == ""
        assert client.ask(["x"], [10e-6]) == [70.0]
        for refused, why in (
            ({"voltage_min": 20.0, "voltage_max": 15.0}, "not below"),
            ({"voltage_max": float("inf")}, "voltage_max"),
            ({"voltage_max": None}, "voltage_max"),
            ({"voltage_min": 0.0, "axes": ["z"]}, "read-only"),
            ({"executor": "default"}, "read-only"),
            ({"nonsense": 1.0}, "undeclared"),
        ):
            assert why in client.graph.set_parameters(client.name, **refused)
        assert client.ask(["x"], [10.2e-6]) == [70.0]
        # A limit below the present voltage: it goes there, at the slew limit.
        assert client.graph.set_parameters(client.name, voltage_max=60.0, slew_limit=500.0) == ""
        client.wait_for_rest(60.0)
        assert np.abs(np.diff(np.array(client.answers[-10:])[:, 0])).max() <= 2.0 * 500.0 / 1000 + 1e-9
        request = DescribeParameters.Request(names=["voltage_max", "axes"])
        described = client.graph.call(DescribeParameters, f"{client.name}/describe_parameters", request).descriptors
        assert all(descriptor.description for descriptor in described) and described[1].read_only


def test_silence_is_reported_and_the_voltage_held(x_file):
    with compensator(model_file=x_file, command_timeout=0.3) as client:
        client.connect()
        client.ask(["x"], [5e-6])
        status = client.graph.wait_for_status(
            f"{client.name}: compensator", lambda status: "no command for" in status.message, "the silence"
        )
        assert status.level == b"\1" and len(client.answers) == 1
        client.ask(["x"], [5e-6])
        client.graph.wait_for_status(f"{client.name}: compensator", lambda s: s.level == b"\0", "health again")


def test_real_time_where_the_system_allows_it(x_file):
    with compensator(model_file=x_file, realtime_priority=1) as client:
        client.connect()
        assert client.ask(["x"], [0.0]) == [0.0]
        in_real_time = os.sched_getscheduler(client.node.process.pid) == os.SCHED_FIFO
        assert in_real_time != ("no realtime_priority 1" in client.node.stderr)


CONFIGS = {"one_axis": ["x"], "xy": ["x", "y"], "ros2_control": ["x", "y"]}


@pytest.mark.parametrize(("config", "namespace"), list(zip(CONFIGS, ("", "/left", ""), strict=True)))
def test_config_files_start_a_compensator(config, namespace):
    axes = CONFIGS[config]
    arguments = ["--params-file", str(CHECKOUT / "config" / f"{config}.yaml"), "-r", f"__ns:={namespace or '/'}"]
    with compensator(*arguments, namespace=namespace) as client:
        client.connect()
        models = client.graph.publisher(String, f"{namespace}/stage_model", LATCHED)
        # The stage that xy.yaml names is another one than stage_model's.
        models.publish(String(data=format_model(replace(stage_model(axes), hardware_id=""))))
        client.report("the model", **{"model.kind": ", ".join(["slpi"] * len(axes))})
        assert client.ask(axes, [0.0] * len(axes)) == [0.0] * len(axes)


@pytest.mark.parametrize("namespace", ["", "/left"])
@pytest.mark.parametrize("config", [*CONFIGS, "exciter"])
def test_a_parameter_given_behind_a_config_file_has_the_last_word(config, namespace):
    name = "exciter" if config == "exciter" else "compensator"
    file = ["--params-file", str(CHECKOUT / "config" / f"{config}.yaml")]
    arguments = [*file, "-p", "voltage_max:=60.0", "-p", "slew_limit:=700.0", "-r", f"__ns:={namespace or '/'}"]
    with on_graph() as graph, started(name, {"slew_limit": 1.0}, *arguments) as node:
        graph.tested = node
        request = GetParameters.Request(names=["voltage_max", "slew_limit"])
        values = graph.call(GetParameters, f"{namespace}/{name}/get_parameters", request).values
        assert [value.double_value for value in values] == [60.0, 700.0]


def test_topics_are_as_documented(x_file):
    table = json.loads((CHECKOUT / "msg_schemas" / "topics.json").read_text())
    with on_graph() as graph, started("compensator", {"model_file": x_file}):
        for topic in table["topics"]:
            for role, look in (
                ("publishers", graph.node.get_publishers_info_by_topic),
                ("subscribers", graph.node.get_subscriptions_info_by_topic),
            ):
                if "compensator" not in topic[role]:
                    continue
                name = topic["name"] if topic["name"].startswith("/") else f"/{topic['name']}"
                # A second subscriber of the states tells their publishers apart.
                for found in graph.spin_until(lambda look=look, name=name: look(name), name):
                    assert found.topic_type in topic["types"]
                    # A subscriber that takes readings as they come is content with less.
                    taken = {topic["qos"]["reliability"], *(["best_effort"] if role == "subscribers" else [])}
                    assert found.qos_profile.reliability.name.lower() in taken
                    assert found.qos_profile.durability.name.lower() == topic["qos"]["durability"]
