"""``slpi doctor`` on a running graph."""

import json

import pytest

pytest.importorskip("rclpy")

from nodes.ros_helpers import on_graph, started  # noqa: E402
from std_msgs.msg import Float64MultiArray  # noqa: E402

from slpi_ros.cli import main  # noqa: E402
from slpi_ros.nodes.common import UNNAMED, full_name  # noqa: E402
from slpi_ros.nodes.graph_probe import probe  # noqa: E402
from slpi_ros.reports.doctor import FAILED, check_graph  # noqa: E402


def faults(topic, found):
    return [check.text for check in check_graph(found) if check.level == FAILED and check.text.startswith(topic)]


def complete(found):
    there = found.state_publishers and found.command_publishers and found.command_subscribers and len(found.nodes) > 1
    return found if there and found.limits and found.stamps.size > 10 else None


def test_a_stage_with_one_and_with_two_who_command():
    with on_graph() as graph, started("stage_simulator", {"hardware_id": "s1"}):
        graph.spin_until(lambda: graph.node.count_publishers("stage_state"), "the simulator")
        with started("compensator", {"voltage_max": 90.0}):
            graph.spin_until(lambda: graph.node.count_publishers("voltage_command"), "the compensator")
            # A busy machine may need longer to discover everything.
            found = graph.spin_until(lambda: complete(probe("stage_state", "voltage_command", "", 1.0)), "both nodes")
            assert list(found.state_publishers) == ["/stage_simulator"] and found.hardware_id == "s1"
            assert found.command_publishers == ["/compensator"] and found.command_subscribers == ["/stage_simulator"]
            assert found.limits == {"x": (0.0, 90.0)} and {"/stage_simulator", "/compensator"} <= set(found.nodes)
            assert found.axes == ["x"] and found.voltage == {"x": 0.0} and found.stamps.size > 10
            assert found.stamps.shape == found.arrivals.shape and found.model is None
            assert not faults("/voltage_command", found)
            graph.node.create_publisher(Float64MultiArray, "voltage_command", 1)
            graph.spin_until(lambda: faults("/voltage_command", probe("stage_state", "voltage_command", "", 0.5)), "it")


def test_without_a_driver_the_command_fails(capsys):
    with on_graph():
        code = main(["doctor", "--seconds", "0.1", "--namespace", "nowhere", "--json"])
    said = capsys.readouterr()
    document = json.loads(said.out)
    assert code == 1 and not document["well"] and not said.err
    assert any(check["level"] == "failed" and "/nowhere/stage_state" in check["text"] for check in document["checks"])


def test_a_name_that_ros_refuses_is_wrong_usage(capsys):
    assert main(["doctor", "--seconds", "0.1", "--namespace", "1 2"]) == 2
    said = capsys.readouterr()
    assert not said.out and said.err.count("\n") == 1


def test_a_node_whose_name_the_middleware_does_not_know_yet_is_told_in_words():
    assert full_name("/lab", "driver") == "/lab/driver"
    assert full_name("_NODE_NAMESPACE_UNKNOWN_", "_NODE_NAME_UNKNOWN_") == UNNAMED
