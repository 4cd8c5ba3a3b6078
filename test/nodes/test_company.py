"""Who else is there: another stage, another publisher of its state, another commander of its voltages."""

import signal
import time
from dataclasses import replace

import pytest
from nodes.compensator_client import compensator
from nodes.ros_helpers import RELIABLE, NodeProcess, stage_model
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray
from std_srvs.srv import Trigger

from slpi_ros.model.document import save_model

pytestmark = pytest.mark.ros


@pytest.fixture
def model_file(tmp_path):
    path = tmp_path / "model.json"
    save_model(replace(stage_model(("x",)), hardware_id="mine"), path)
    return str(path)


def reporting(client, frame="mine", axis="x", rate=100.0):
    """Publish the states of a stage that is where it was commanded to be; return the timer."""
    states = client.graph.node.create_publisher(JointState, "/stage_state", RELIABLE)

    def publish():
        at = client.answers[-1][0] if client.answers else 0.0
        message = JointState(name=[axis], position=[0.0], effort=[at])
        message.header.frame_id = frame
        states.publish(message)

    return client.graph.node.create_timer(1.0 / rate, publish)


def wait_for_obstacle(client, *words):
    """Wait until the compensator says that it does not move, with these words."""
    return client.graph.wait_for_status(
        "/compensator: compensator", lambda status: all(word in status.message for word in words), f"{words}"
    )


def insist(client, seconds=0.6):
    """Send desired displacements for some time; return how many voltages have come."""
    before = client.answered
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        client.wish(["x"], [2e-6])
        client.graph.spin_for(0.02)
    return client.answered - before


def test_a_model_of_another_stage_moves_nothing(model_file):
    with compensator(model_file=model_file, start_voltage="auto") as client:
        reporting(client, frame="theirs")
        wait_for_obstacle(client, "'mine'", "'theirs'")
        client.graph.spin_until(lambda: "'theirs'" in client.node.stderr, "that it is told without a command")
        assert insist(client, 2.0) == 0


def test_what_is_accepted_is_taken_for_this_stage(model_file):
    with compensator(model_file=model_file, start_voltage="auto", accept_stage="theirs") as client:
        reporting(client, frame="theirs")
        client.graph.spin_until(lambda: insist(client, 0.1), "a voltage")
        client.graph.spin_until(lambda: "'theirs'" in client.node.stderr, "that it is told")


def test_a_stage_that_is_exchanged_is_driven_no_more(model_file):
    with compensator(model_file=model_file, start_voltage="auto") as client:
        timer = reporting(client)
        client.graph.spin_until(lambda: insist(client, 0.1), "a voltage")
        client.graph.node.destroy_timer(timer)
        reporting(client, frame="theirs")
        wait_for_obstacle(client, "'mine'", "'theirs'")
        assert insist(client) == 0


def test_two_publishers_of_one_axis_are_both_named(model_file):
    with compensator(model_file=model_file, start_voltage="auto") as client:
        reporting(client)
        reporting(client)
        wait_for_obstacle(client, "two publishers")
        assert insist(client, 1.0) == 0


def test_two_publishers_of_different_axes_are_two_drivers(model_file):
    with compensator(model_file=model_file, start_voltage="auto") as client:
        reporting(client)
        reporting(client, axis="y")
        client.graph.spin_until(lambda: insist(client, 0.1), "a voltage")


def test_who_moves_the_axis_of_a_driver_that_reports_right_after_another_one_is_noticed(tmp_path):
    path = tmp_path / "model.json"
    save_model(stage_model(("x", "y")), path)
    with compensator(model_file=str(path), start_voltage="auto", axes=["x", "y"], voltage_max=[100.0] * 2,
                     voltage_min=[0.0] * 2, slew_limit=[0.0] * 2) as client:  # fmt: skip
        node, moved = client.graph.node, [0.0]
        drivers = [node.create_publisher(JointState, "/stage_state", RELIABLE) for _ in range(2)]

        def publish():
            # One right after the other, always in this order.
            at = client.answers[-1] if client.answers else [0.0, 0.0]
            by = moved.pop() if len(moved) > 1 else moved[0]
            for driver, axis, v in zip(drivers, ("x", "y"), (at[0], at[1] + by), strict=True):
                driver.publish(JointState(name=[axis], position=[0.0], effort=[v]))

        node.create_timer(0.01, publish)
        client.graph.spin_until(lambda: insist(client, 0.1), "a voltage")
        client.graph.spin_for(1.5)
        # In 200 reports only: they may not be missed for long.
        moved.extend([20.0] * 200)
        wait_for_obstacle(client, "axis 'y'", "~/arm")


def test_a_voltage_that_somebody_repeats_holds_the_first_one_back(model_file):
    with compensator(model_file=model_file, start_voltage="auto") as client:
        reporting(client, rate=50.0)
        commands = client.graph.node.create_publisher(Float64MultiArray, "/voltage_command", RELIABLE)
        timer = client.graph.node.create_timer(0.8, lambda: commands.publish(Float64MultiArray(data=[77.0])))
        wait_for_obstacle(client, client.graph.node.get_name())
        insist(client, 3.0)
        assert [77.0] in client.answers and all(answer == [77.0] for answer in client.answers)
        client.graph.node.destroy_timer(timer)
        client.graph.spin_until(
            lambda: insist(client, 0.05) and any(answer != [77.0] for answer in client.answers), "its own voltage"
        )


def test_a_second_compensator_does_not_move_beside_a_running_one(model_file):
    with compensator(model_file=model_file, start_voltage="auto") as client:
        reporting(client)
        client.graph.spin_until(lambda: insist(client, 0.1), "a voltage")
        given = {"model_file": model_file, "start_voltage": "auto", "reset_on_start": True, "diagnostic_period": 0.2}
        second = NodeProcess("compensator", given, ("-r", "__node:=second"))
        try:
            client.graph.wait_for_status(
                "/second: compensator", lambda status: "/compensator" in status.message, "the running one named"
            )
            client.graph.spin_until(lambda: "/compensator" in second.stderr, "that it is told without a command")
            client.graph.spin_for(3.0)
            # The running one repeats its voltage; nothing else has moved.
            assert {answer[0] for answer in client.answers[-3:]} == {client.answers[-1][0]}
            count = client.answered
            client.graph.spin_until(lambda: client.answered > count, "the voltage repeated")
            client.node.process.send_signal(signal.SIGKILL)
            client.node.process.wait()
            client.graph.tested = second
            last = client.answered
            # What was killed is silent: the reset that the second one was started for begins.
            client.graph.spin_until(lambda: client.answered > last + 3, "its reset")
        finally:
            second.stop(signal.SIGKILL)


def reset(client):
    return client.graph.call(Trigger, f"{client.name}/reset_memory", Trigger.Request())


def test_a_reset_that_is_asked_for_at_once_waits_until_it_is_known_who_is_there(model_file):
    with compensator(model_file=model_file, start_voltage="auto", reset_rate=500.0) as client:
        reporting(client)
        assert reset(client).success and client.answered > 3


def test_a_reset_of_another_stage_is_refused(model_file):
    with compensator(model_file=model_file, start_voltage="auto") as client:
        reporting(client, frame="theirs")
        answer = reset(client)
        assert not answer.success and "'theirs'" in answer.message and client.answered == 0
