"""Commands that stop, or never come: the compensator does what /diagnostics says, and says what it does."""

from pathlib import Path

import numpy as np
import pytest

rclpy = pytest.importorskip("rclpy")

from nodes.compensator_client import SECOND_NS, Client, compensator  # noqa: E402
from nodes.ros_helpers import RELIABLE, stage_model  # noqa: E402
from nodes.test_compensator_trajectory import trajectory  # noqa: E402
from std_msgs.msg import Float64MultiArray  # noqa: E402
from std_srvs.srv import Trigger  # noqa: E402
from trajectory_msgs.msg import JointTrajectory  # noqa: E402

from slpi_ros.model.document import save_model  # noqa: E402

MS = 1_000_000
TIMEOUT = {"command_timeout": 0.2, "safe_voltage": 10.0, "ramp_rate": 400.0}


@pytest.fixture
def x_file(tmp_path: Path) -> str:
    path = tmp_path / "x.json"
    save_model(stage_model(), path)
    return str(path)


def sender(client: Client):
    return client.graph.publisher(JointTrajectory, "/desired_trajectory", RELIABLE)


def wait_for_message(client: Client, part: str) -> str:
    status = client.graph.wait_for_status(f"{client.name}: compensator", lambda s: part in s.message, part)
    return status.message


def messages(client: Client) -> list[str]:
    return [status.message for status in client.graph.statuses(f"{client.name}: compensator")]


def test_after_a_trajectory_silence_leads_to_the_safe_voltage(x_file):
    with compensator(model_file=x_file, on_timeout="safe", **TIMEOUT) as client:
        client.connect()
        sender(client).publish(trajectory(["x"], [0, 20 * MS], [[3e-6], [6e-6]]))
        client.graph.spin_until(lambda: client.answers and client.answers[-1][0] > 50.0, "the trajectory")
        client.wait_for_rest(10.0)
        wait_for_message(client, "voltages are the safe ones")


def test_nothing_moves_before_it_has_been_told_to_and_that_is_said(x_file):
    with compensator(model_file=x_file, on_timeout="safe", **TIMEOUT) as client:
        client.connect()
        wait_for_message(client, "no command yet for")
        # What cancels nothing moves nothing.
        sender(client).publish(JointTrajectory())
        client.report(trajectories=1)
        said = wait_for_message(client, "no command yet for")
        assert said.endswith("voltages are held") and client.answers == []


def test_a_trajectory_that_waits_is_no_silence_and_says_when_it_begins(x_file):
    with compensator(model_file=x_file, on_timeout="safe", **TIMEOUT) as client:
        client.connect()
        client.ask(["x"], [5e-6])
        publisher = sender(client)
        in_an_hour = client.graph.node.get_clock().now().nanoseconds + 3600 * SECOND_NS
        publisher.publish(trajectory(["x"], [0], [[3e-6]], in_an_hour))
        client.report(trajectories=1)
        given, reported = client.answered, len(client.reports)
        client.graph.spin_until(lambda: len(client.reports) > reported + 4, "a while longer than the timeout")
        assert not any("no command" in said for said in messages(client)[reported:])
        assert "waiting for a trajectory that begins in 3" in messages(client)[-1]
        client.wish(["x"], [5e-6])
        _, values = client.report("the rejection", **{"rejected.following": 1})
        assert "begins in 3" in values["last_rejection"] and "cancel it with an empty one" in values["last_rejection"]
        assert client.answered == given
        # Cancelled, silence counts anew.
        publisher.publish(JointTrajectory())
        wait_for_message(client, "voltages go to the safe ones")
        client.wait_for_rest(10.0)


def test_a_gap_in_a_trajectory_is_no_silence(x_file):
    with compensator(model_file=x_file, on_timeout="safe", **TIMEOUT) as client:
        client.connect()
        sender(client).publish(trajectory(["x"], [0, 3600 * SECOND_NS], [[3e-6], [6e-6]]))
        client.graph.spin_until(lambda: client.answered >= 1, "the first point")
        reported = len(client.reports)
        client.graph.spin_until(lambda: len(client.reports) > reported + 4, "a while longer than the timeout")
        assert not any("no command" in said for said in messages(client)[reported:])
        # On its way to the second point, which is an hour away; on a busy computer it tells how late it was.
        assert "trajectory" in messages(client)[-1]


def test_a_reset_is_no_silence(x_file):
    with compensator(model_file=x_file, on_timeout="safe", reset_rate=150.0, reset_cycles=1, **TIMEOUT) as client:
        client.connect()
        client.ask(["x"], [5e-6])
        reported = len(client.reports)
        answer = client.graph.call(Trigger, f"{client.name}/reset_memory", Trigger.Request())
        assert answer.success
        said = messages(client)[reported:]
        while_resetting = [
            text
            for text, report in zip(said, client.reports[reported:], strict=True)
            if report["memory"] == "resetting"
        ]
        assert len(while_resetting) > 3 and set(while_resetting) == {"resetting the memory"}
        # Afterwards the silence goes on: what was commanded before counts.
        client.wait_for_rest(10.0)


def test_on_timeout_changed_in_the_silence_counts_at_once(x_file):
    with compensator(model_file=x_file, **{**TIMEOUT, "ramp_rate": 20.0}) as client:
        client.connect()
        before = client.ask(["x"], [5e-6])
        wait_for_message(client, "voltages are held")
        assert client.answers == [before]
        assert client.graph.set_parameters(client.name, on_timeout="safe") == ""
        wait_for_message(client, "voltages go to the safe ones")
        client.graph.spin_until(lambda: client.answers[-1][0] < before[0] - 1.0, "the ramp")
        # And back: what has been given so far is held.
        assert client.graph.set_parameters(client.name, on_timeout="hold") == ""
        wait_for_message(client, "voltages are held")
        held = client.answers[-1]
        assert held[0] > 10.0
        assert client.graph.set_parameters(client.name, on_timeout="safe", ramp_rate=2000.0) == ""
        client.wait_for_rest(10.0)
        wait_for_message(client, "voltages are the safe ones")
        assert (np.diff(np.array(client.answers)[:, 0]) <= 0.0).all()
        # The next silence is not to come before the report.
        assert client.graph.set_parameters(client.name, command_timeout=60.0) == ""
        client.ask(["x"], [5e-6])
        wait_for_message(client, "compensating")


@pytest.mark.slow
def test_another_publisher_of_the_voltages_is_named(x_file):
    with compensator(model_file=x_file) as client:
        client.connect()
        other = client.graph.publisher(Float64MultiArray, "/voltage_command", RELIABLE)
        said = wait_for_message(client, "also publishes voltage_command")
        assert client.graph.node.get_name() in said
        client.graph.node.destroy_publisher(other)
