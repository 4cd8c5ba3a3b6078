"""A path from the compensator to the wave generator of a simulated controller, as one block, over DDS."""

import socket
import time
from contextlib import contextmanager

import numpy as np
import pytest

pytest.importorskip("rclpy")

from diagnostic_msgs.msg import DiagnosticStatus  # noqa: E402
from nodes.ros_helpers import LATCHED, RELIABLE, on_graph, stage_model, started, values_of  # noqa: E402
from sensor_msgs.msg import JointState  # noqa: E402
from std_srvs.srv import Trigger  # noqa: E402
from trajectory_msgs.msg import JointTrajectory  # noqa: E402

from slpi_ros.io.messages import encode_trajectory  # noqa: E402
from slpi_ros.model.document import save_model  # noqa: E402

SLEW, PERIOD = 2000.0, 5e-5


class Bench:
    def __init__(self, graph):
        self.graph = graph
        graph.watch_diagnostics()
        self.blocks = graph.record(JointTrajectory, "voltage_trajectory", RELIABLE)
        self.recordings = graph.record(JointTrajectory, "recorded_trajectory", RELIABLE)
        self.told = graph.record(DiagnosticStatus, "voltage_trajectory_state", LATCHED)
        self.states = graph.record(JointState, "stage_state", RELIABLE)
        self.paths = graph.node.create_publisher(JointTrajectory, "desired_trajectory", RELIABLE)

    def connect(self):
        self.graph.wait_for_status(
            "/compensator: compensator", lambda status: values_of(status)["state"] == "active", "the compensator"
        )
        self.graph.spin_until(lambda: self.states, "a state")
        self.graph.spin_until(self.paths.get_subscription_count, "the ears of the compensator")
        return self

    def send(self, y, period=PERIOD):
        times = np.round(np.arange(len(y)) * period * 1e9).astype(np.int64)
        data = encode_trajectory(0, ["x"], times, y[:, None], np.zeros((len(y), 0)))
        # Until the voltage of the amplifier is known, it is rejected.
        for _ in range(60):
            self.paths.publish(data)
            self.graph.spin_for(0.5)
            if self.blocks:
                return
        raise AssertionError(f"no block came: {self.compensator.stderr}")

    def until(self, message):
        self.graph.spin_until(lambda: message in [each.message for each in self.told], message)
        return next(values_of(each) for each in reversed(self.told) if each.message == message)


@contextmanager
def benched(tmp_path, **options):
    """Start compensator, driver and simulated controller, with options of the compensator."""
    model = stage_model(("x",))
    save_model(model, tmp_path / "model.json")
    limits = {"voltage_min": 0.0, "voltage_max": 100.0}
    # Not in this process, which is busy with the messages of many points.
    with socket.create_server(("127.0.0.1", 0)) as server:
        address = "{}:{}".format(*server.getsockname())
    device = {"address": address, "voltage": 20.0, "noise_rms": 0.0}
    driver = {"device": "gcs", "address": address, "rate": 50.0, "slew_limit": 1.1 * SLEW, **limits}
    driver["hardware_id"] = model.hardware_id
    compensator = {
        "model_file": str(tmp_path / "model.json"),
        "slew_limit": SLEW,
        "trajectory_output": "block",
        **limits,
        **options,
    }
    with (
        started("device_simulator", device) as simulator,
        on_graph() as graph,
    ):
        while "own range" not in simulator.stderr:
            assert simulator.process.poll() is None
        with started("driver", driver) as node, started("compensator", compensator) as other:
            graph.tested = node
            made = Bench(graph)
            made.compensator = other
            made.model = model
            yield made.connect()


@pytest.fixture
def bench(tmp_path):
    with benched(tmp_path) as made:
        yield made


def path(model, seconds, period=PERIOD):
    low, high = model.axis("x").displacement_range
    t = np.arange(round(seconds / period)) * period
    return 0.5 * (low + high) + 0.2 * (high - low) * np.sin(2 * np.pi * 5.0 * t)


def test_a_path_is_played_by_the_clock_of_the_device_and_what_was_recorded_comes_back(bench):
    y = path(bench.model, 0.2)
    before = time.time()
    bench.send(y)
    end = bench.until("ended")
    (block,) = bench.blocks
    sent = np.array([point.effort[0] for point in block.points])
    assert int(end["sample"]) == len(sent) > len(y) and not block.points[0].positions
    stamp = f"{block.header.stamp.sec}.{block.header.stamp.nanosec:09d}"
    assert {values_of(each)["stamp"] for each in bench.told} == {stamp}
    assert np.abs(np.diff(sent)).max() <= SLEW * PERIOD * (1 + 1e-9) and sent[0] == 20.0
    bench.graph.spin_until(lambda: bench.recordings, "what was recorded")
    recording = bench.recordings[0]
    np.testing.assert_allclose([point.effort[0] for point in recording.points], sent, atol=1e-8)
    begun = recording.header.stamp.sec + recording.header.stamp.nanosec * 1e-9
    assert before < begun < time.time() - 0.2
    last = recording.points[-1].time_from_start
    assert last.sec + last.nanosec * 1e-9 == pytest.approx((len(sent) - 1) * PERIOD)
    assert np.ptp([point.positions[0] for point in recording.points]) > 1e-6
    # Afterwards the compensator goes on from there.
    status = bench.graph.wait_for_status(
        "/compensator: compensator", lambda status: values_of(status)["state"] == "active", "the compensator"
    )
    assert status.level < DiagnosticStatus.ERROR


def test_a_limit_that_is_lowered_meanwhile_stops_it_and_the_voltage_goes_inside(bench):
    bench.send(path(bench.model, 3.0, 1e-3), 1e-3)
    bench.until("playing")
    lowest = min(point.effort[0] for point in bench.blocks[0].points[500:])
    assert bench.graph.set_parameters("/compensator", voltage_max=lowest - 1.0) == ""
    assert int(bench.until("stopped")["sample"]) < len(bench.blocks[0].points)
    bench.graph.spin_until(lambda: bench.states[-1].effort[0] <= lowest - 1.0 + 1e-5, "the voltage inside the limits")


@pytest.mark.long
@pytest.mark.parametrize("how", ["empty", "stop"])
def test_it_is_stopped_where_it_is(bench, how):
    bench.send(path(bench.model, 3.0, 1e-3), 1e-3)
    bench.until("playing")
    if how == "empty":
        bench.paths.publish(JointTrajectory())
    else:
        answer = bench.graph.call(Trigger, "/driver/stop", Trigger.Request())
        assert answer.success and "sample" in answer.message
    sample = int(bench.until("stopped")["sample"])
    there = bench.blocks[0].points[sample - 1].effort[0]
    bench.graph.spin_for(0.3)
    assert bench.states[-1].effort[0] == pytest.approx(there, abs=1e-5)


@pytest.mark.long
def test_what_the_device_has_recorded_of_a_path_that_comes_again_is_learned(tmp_path):
    # Slowly, and armed again: a busy machine hears late of where the block is.
    with benched(tmp_path, learn="on", rearm=True) as bench:
        low, high = bench.model.axis("x").displacement_range
        y = 0.5 * (low + high) + 0.06 * (high - low) * np.sin(np.linspace(0.0, 2 * np.pi, 201))
        errors, told = [], {}
        for number in range(12):
            bench.blocks.clear()
            bench.told.clear()
            bench.send(y, 5e-3)
            bench.until("ended")
            bench.graph.spin_until(lambda number=number: len(bench.recordings) > number, "what was recorded")
            points = bench.recordings[-1].points
            at = np.array([each.time_from_start.sec + 1e-9 * each.time_from_start.nanosec for each in points])
            read = np.interp(at[-1] - 1.0 + np.arange(y.size) * 5e-3, at, [each.positions[0] for each in points])
            errors.append(float(np.std(read - y)))
            wanted = {"x.learn_pass": str(number + 1)} if number else {}
            status = bench.graph.wait_for_status(
                "/compensator: compensator",
                lambda status, wanted=wanted: wanted.items() <= values_of(status).items(),
                f"pass {number + 1}",
            )
            told = values_of(status)
        assert told["x.learn_reason"] == "" and told["learn_dropped"] == ""
        # The model is not that of the simulated stage.
        assert errors[1] > 50e-9
        assert errors[-1] < 0.2 * errors[1]
