"""A drive as one block, over DDS: exciter, driver and a simulated controller, judged by the log of the controller."""

import signal
import time
from contextlib import contextmanager

import numpy as np
import pytest

pytest.importorskip("rclpy")

from nodes.ros_helpers import RELIABLE, on_graph, started  # noqa: E402
from refusals import holds  # noqa: E402
from sensor_msgs.msg import JointState  # noqa: E402
from std_srvs.srv import Trigger  # noqa: E402
from trajectory_msgs.msg import JointTrajectory  # noqa: E402

from slpi_ros.simulation.devices.gcs import GcsSimulator  # noqa: E402

REST, SLEW, CYCLES = 20.0, 400.0, 100.0
LIMITS = {"voltage_min": 0.0, "voltage_max": 100.0}
DRIVE = LIMITS | {"slew_limit": SLEW, "output": "trajectory", "settle": 0.0, "duration": 20.0, "rate": 100.0}


class Bench:
    """A driver with a simulated controller."""

    def __init__(self, graph, simulator, driver):
        self.graph, self.simulator, self.driver = graph, simulator, driver
        self.begun = 0  # changes of the output before the drive

    def call(self, service):
        return self.graph.call(Trigger, service, Trigger.Request())

    @property
    def path(self):
        """Voltages of the output since the drive began."""
        before = self.simulator.log[self.begun - 1].voltage if self.begun else REST
        return np.array([before, *(each.voltage for each in self.simulator.log[self.begun :])])

    @contextmanager
    def exciting(self, **given):
        """Start an exciter, and wait until it drives."""
        self.begun = len(self.simulator.log)
        with started("exciter", DRIVE | given) as node:
            self.graph.tested = node
            if not given.get("autostart", True):
                assert self.call("exciter/start").success
            yield node
            self.graph.tested = None

    def wait_for_motion(self):
        self.graph.spin_until(lambda: self.simulator.voltage("1") > 60.0, "the drive")

    def end_of(self, node):
        """Return the exit code."""
        self.graph.tested = None
        self.graph.spin_until(lambda: node.process.poll() is not None, "the end of the exciter")
        return node.wait()

    def require_still(self):
        """Require that the device moves no more, and never moved faster than its limits."""
        there, count = self.simulator.voltage("1"), len(self.simulator.log)
        self.graph.spin_for(0.5)
        assert self.simulator.voltage("1") == there and len(self.simulator.log) == count
        times = np.array([each.time_ns for each in self.simulator.log[self.begun :]]) * 1e-9
        # A step may make up for a late one, and waits in the driver for up to a cycle.
        most = 1.1 * SLEW * (np.diff(times) + 2.0 / CYCLES)
        assert (np.abs(np.diff(self.path[1:])) <= most).all()
        return there


@contextmanager
def driven(**options):
    given = LIMITS | {"device": "gcs", "slew_limit": 1.1 * SLEW, "rate": CYCLES}
    with (
        GcsSimulator(voltages=[REST], **options) as simulator,
        on_graph() as graph,
        started("driver", given | {"address": simulator.address}) as driver,
    ):
        states = graph.record(JointState, "stage_state")
        graph.tested = driver
        graph.spin_until(lambda: states, "a state")
        yield Bench(graph, simulator, driver)


def require_return_after_ctrl_c(bench):
    begun = time.monotonic()
    with bench.exciting() as node:
        bench.wait_for_motion()
        node.process.send_signal(signal.SIGINT)
        assert bench.end_of(node) == 0, node.stderr
        assert time.monotonic() - begun < 0.8 * DRIVE["duration"]
        assert holds(node.stderr.splitlines()[-1], "stopped after", "x at 20 V") and "Traceback" not in node.stderr
    assert bench.require_still() == pytest.approx(REST, abs=1e-3)
    assert bench.path.max() > 60.0


@pytest.fixture(scope="class")
def bench():
    with driven() as made:
        yield made


class TestADeviceThatPlaysBlocks:
    def test_ctrl_c_in_the_middle_of_a_block_brings_it_to_rest(self, bench):
        require_return_after_ctrl_c(bench)

    @pytest.mark.slow
    def test_so_does_stop(self, bench):
        with bench.exciting(autostart=False) as node:
            bench.wait_for_motion()
            assert bench.call("exciter/stop").success
            bench.graph.spin_until(lambda: "stopped after" in node.stderr, "the way back")
            assert bench.require_still() == pytest.approx(REST, abs=1e-3)
            assert node.process.poll() is None

    @pytest.mark.slow
    def test_so_does_a_fault_which_is_named(self, bench):
        with bench.exciting() as node:
            bench.wait_for_motion()
            other = bench.graph.node.create_publisher(JointTrajectory, "voltage_trajectory", RELIABLE)
            assert bench.end_of(node) == 1
            bench.graph.node.destroy_publisher(other)
            assert holds(node.stderr.splitlines()[-1], "1 other publisher", "voltage_trajectory")
        assert bench.require_still() == pytest.approx(REST, abs=1e-3)

    def test_a_whole_drive_ends_as_the_driver_says(self, bench):
        blocks = bench.graph.record(JointTrajectory, "voltage_trajectory")
        with bench.exciting(drive="sweep", duration=3.0) as node:
            assert bench.end_of(node) == 0, node.stderr
            assert "done after" in node.stderr and "confirmed" not in node.stderr
        (block,) = blocks
        age = time.time() - block.header.stamp.sec - block.header.stamp.nanosec * 1e-9
        assert 0.0 < age < 60.0
        assert bench.require_still() == pytest.approx(REST, abs=1e-3) and bench.path.max() > 99.0

    def test_a_block_that_is_refused_moves_nothing_and_the_reason_is_that_of_the_driver(self, bench):
        assert bench.call("driver/stop").success
        with bench.exciting() as node:
            assert bench.end_of(node) == 1
            assert holds(node.stderr.splitlines()[-1], "refuses", "~/arm")
            assert "done after" not in node.stderr
        assert len(bench.path) == 1
        assert bench.call("driver/arm").success

    @pytest.mark.slow
    def test_what_the_driver_stops_stays_there(self, bench):
        with bench.exciting() as node:
            bench.wait_for_motion()
            answer = bench.call("driver/stop")
            assert answer.success and "sample" in answer.message
            assert bench.end_of(node) == 1
            assert holds(node.stderr.splitlines()[-1], "stopped the drive at sample", "~/stop")
        assert bench.require_still() > 50.0


@pytest.mark.slow
def test_one_that_streams_them_comes_back_as_well():
    with driven(without=("WAV",)) as bench:
        require_return_after_ctrl_c(bench)


@pytest.mark.slow
def test_the_end_of_the_driver_is_told():
    with driven() as bench, bench.exciting() as node:
        bench.wait_for_motion()
        bench.driver.process.send_signal(signal.SIGINT)
        assert bench.end_of(node) == 1
        assert holds(node.stderr.splitlines()[-1], "stopped the drive at sample", "the driver has ended")
        bench.require_still()
