"""The exciter as a process of its own, over DDS."""

import math
import signal
import time
from collections import deque
from contextlib import contextmanager
from types import SimpleNamespace

import numpy as np
import pytest

rclpy = pytest.importorskip("rclpy")

from nodes.ros_helpers import RELIABLE, on_graph, started  # noqa: E402
from rclpy.event_handler import SubscriptionEventCallbacks  # noqa: E402
from refusals import holds, refusal  # noqa: E402
from sensor_msgs.msg import JointState  # noqa: E402
from std_msgs.msg import Float64MultiArray  # noqa: E402
from std_srvs.srv import Trigger  # noqa: E402
from trajectory_msgs.msg import JointTrajectory  # noqa: E402

from slpi_ros.compensator.listening import LOOK_WITHOUT_NS  # noqa: E402
from slpi_ros.errors import UsageError  # noqa: E402
from slpi_ros.excitation.drives import excite  # noqa: E402
from slpi_ros.nodes.exciter import DECLARATIONS, Exciter, ExciterSettings  # noqa: E402

RATE = 100.0
LIMITS = {"voltage_min": 0.0, "voltage_max": 100.0, "rate": RATE}
# As soon as somebody listens; without a publisher of stage_state.
AT_ONCE = LIMITS | {"settle": 0.0, "rest_voltage": 0.0}


class Listener:
    """Keeps the voltages that come, and knows whether it would miss any."""

    def __init__(self, graph):
        self._graph, self.commands, self.publishers = graph, [], 0
        callbacks = SubscriptionEventCallbacks(matched=self._on_matched)
        graph.node.create_subscription(
            Float64MultiArray, "voltage_command", self.commands.append, RELIABLE, event_callbacks=callbacks
        )

    def _on_matched(self, status):
        self.publishers = status.current_count

    @property
    def v(self):
        """Voltages so far, shape (N, axes)."""
        return np.array([list(command.data) for command in self.commands])

    def wait_for_publisher(self):
        self._graph.spin_until(lambda: self.publishers, "the exciter to be connected")

    def wait_for_motion(self):
        self._graph.spin_until(lambda: self.commands and self.commands[-1].data[0] > 60.0, "the drive")

    def wait_for(self, count):
        self._graph.spin_until(lambda: len(self.commands) >= count, f"{count} voltages")


@contextmanager
def exciter(graph, **given):
    with started("exciter", given) as node:
        graph.tested = node
        yield node
        graph.tested = None


def call(graph, name):
    return graph.call(Trigger, f"exciter/{name}", Trigger.Request())


def wait_for_end(graph, node):
    """Return the exit code once the node has ended and all that it sent has come."""
    graph.tested = None
    graph.spin_until(lambda: node.process.poll() is not None, "the end of the exciter")
    end = time.monotonic() + 0.3
    graph.spin_until(lambda: time.monotonic() > end, "the last message")
    return node.wait()


def drawn(**given):
    """Return the voltages of a drive, shape (N, axes), planned at 80 % of the slew limit."""
    given["slew_limit"] = 0.8 * given.get("slew_limit", 1000.0)
    return np.column_stack(
        list(excite(**({"voltage_min": 0.0, "voltage_max": 100.0, "rate": RATE} | given)).voltage.values())
    )


def fastest(v):
    return float(np.max(np.abs(np.diff(v, axis=0)))) * RATE


def stall(node, seconds):
    node.process.send_signal(signal.SIGSTOP)
    time.sleep(seconds)
    node.process.send_signal(signal.SIGCONT)


def publish_state(graph, **effort):
    """Say again and again where the axes are, and follow the commands; return once somebody listens.

    An axis "x" follows the first voltage of each command, others stay.
    """
    publisher = graph.node.create_publisher(JointState, "stage_state", RELIABLE)

    def follow(command):
        effort["x"] = command.data[0]

    def report():
        position = [1e-7 * v for v in effort.values()]
        publisher.publish(JointState(name=list(effort), position=position, effort=list(effort.values())))

    graph.node.create_subscription(Float64MultiArray, "voltage_command", follow, RELIABLE)
    graph.node.create_timer(0.02, report)
    graph.spin_until(publisher.get_subscription_count, "the exciter to listen")
    end = time.monotonic() + 0.2
    graph.spin_until(lambda: time.monotonic() > end or graph.tested.process.poll() is not None, "some states")


@pytest.fixture(scope="class")
def waiting():
    """Return a graph, an exciter that waits for the service, and what it publishes."""
    # On a busy machine the states of this process come late, too.
    given = AT_ONCE | {"autostart": False, "slew_limit": 500.0, "state_timeout": 10.0}
    with on_graph() as graph, exciter(graph, **given) as node:
        listener = Listener(graph)
        listener.wait_for_publisher()
        yield graph, node, listener


def moving(v):
    """Return voltages, shape (N,), from the first to the last one that is not 0."""
    at = np.flatnonzero(v)
    return np.asarray(v)[at[0] : at[-1] + 1] if at.size else np.empty(0)


class TestAnExciterThatWaits:
    def test_services_start_and_stop(self, waiting):
        graph, node, listener = waiting
        assert call(graph, "stop").message == "at rest" and not listener.commands
        assert "voltage_max" in graph.set_parameters("exciter", voltage_max=1e9)
        assert "0.8 V/s" in graph.set_parameters("exciter", slew_limit=1.0)
        assert graph.set_parameters("exciter", drive="creep", duration=10.0) == ""
        wanted = drawn(slew_limit=500.0, drive="creep", duration=10.0)
        for _ in range(2):
            listener.commands.clear()
            answer = call(graph, "start")
            assert answer.success and answer.message == "drive 'creep' of 10 s"
            assert not call(graph, "start").success
            listener.wait_for_motion()
            seen = len(listener.commands)
            answer = call(graph, "stop")
            assert answer.success and answer.message.startswith("back in ")
            graph.spin_until(lambda: listener.commands[-1].data[0] == 0.0, "the way back")
            # A late sample is followed by an early one, which the slew limit may hold back.
            np.testing.assert_allclose(listener.v[:seen], wanted[:seen], atol=500.0 / RATE)
            assert fastest(listener.v) <= 2 * 500.0 * (1 + 1e-9)
        assert node.process.poll() is None

    def test_a_drive_keeps_the_limits_that_it_began_with(self, waiting):
        graph, node, listener = waiting
        listener.commands.clear()
        assert graph.set_parameters("exciter", repeat=True) == ""
        assert call(graph, "start").success
        listener.wait_for_motion()
        assert holds(graph.set_parameters("exciter", voltage_max=60.0), "voltage_max", "~/stop")
        # What the next drive begins with may be set meanwhile.
        assert graph.set_parameters("exciter", repeat=False) == ""
        call(graph, "stop")
        graph.spin_until(lambda: "stopped after" in node.stderr.split("exciting")[-1], "the end of the drive")
        for top in (60.0, 100.0):
            assert graph.set_parameters("exciter", voltage_max=top) == ""

    def test_a_drive_reaches_the_stage_sample_by_sample(self, waiting):
        graph, node, listener = waiting
        listener.commands.clear()
        assert (
            graph.set_parameters("exciter", drive="calibration", duration=3.0, slew_limit=0.0, seed=3, settle=1.0) == ""
        )
        states = graph.record(JointState, "stage_state")
        with started("stage_simulator"):
            graph.spin_until(lambda: graph.node.count_subscribers("voltage_command") == 2, "the simulator")
            began = time.time()
            assert call(graph, "start").success
            wanted = drawn(duration=3.0, seed=3, slew_limit=0.0)
            listener.wait_for(len(wanted))

            def answered():
                # The simulator may have been the last to connect, and reports its rest before and after the drive.
                told, all_wanted = (moving(v) for v in ([state.effort[0] for state in states], wanted[:, 0]))
                return told.size and np.array_equal(told, all_wanted[-told.size :])

            graph.spin_until(answered, "the stage to do what it is told")
            graph.spin_until(lambda: "done after" in node.stderr, "the exciter to say that it is done")
        np.testing.assert_array_equal(listener.v, wanted)
        last = states[-1].header.stamp
        # On a busy machine it takes longer, but never less.
        assert last.sec + last.nanosec * 1e-9 - began > 0.95 * (len(wanted) - 1) / RATE
        assert "Traceback" not in node.stderr

    def test_the_drive_begins_and_ends_where_the_stage_is(self, waiting):
        graph, _, listener = waiting
        listener.commands.clear()
        publish_state(graph, other=5.0, x=40.0)
        given = {"duration": 2.0, "slew_limit": 0.0, "seed": 0, "settle": 0.0, "rest_voltage": math.nan}
        assert graph.set_parameters("exciter", **given) == ""
        call(graph, "start")
        wanted = drawn(duration=2.0, start=40.0, slew_limit=0.0)
        listener.wait_for(len(wanted))
        np.testing.assert_array_equal(listener.v, wanted)


def test_a_stall_delays_the_drive_and_never_makes_it_leap():
    with on_graph() as graph, exciter(graph, **AT_ONCE, duration=2.0, slew_limit=0.0) as node:
        listener = Listener(graph)
        listener.wait_for_motion()
        stall(node, 0.5)
        assert wait_for_end(graph, node) == 0
        assert "instead of 2.0 s" in node.stderr
        v = listener.v
    np.testing.assert_array_equal(v, drawn(duration=2.0, slew_limit=0.0)[-len(v) :])


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_brings_the_stage_back(number):
    with (
        on_graph() as graph,
        exciter(graph, **AT_ONCE | {"rest_voltage": 10.0}, duration=20.0, slew_limit=400.0) as node,
    ):
        listener = Listener(graph)
        listener.wait_for_motion()
        if number == signal.SIGTERM:
            stall(node, 0.3)
        node.process.send_signal(number)
        assert wait_for_end(graph, node) == 0
        assert "Traceback" not in node.stderr
        v = listener.v
    assert v[-1, 0] == pytest.approx(10.0) and v.max() > 60.0
    assert v.min() >= 0.0 and v.max() <= 100.0
    # A late step is made up.
    assert fastest(v) <= 2 * 400.0 * (1 + 1e-9)
    assert len(v) < 20.0 * RATE


@pytest.mark.slow
def test_it_ends_after_a_slow_stage_has_reported_the_last_voltage():
    """Who stops the recorder when the exciter has ended has the memory at the end on record."""
    behind, reported = 1.5, []
    with on_graph() as graph, exciter(graph, **AT_ONCE, duration=3.0, state_timeout=3.0) as node:
        due: deque[tuple[float, float]] = deque([(0.0, 0.0)])
        publisher = graph.node.create_publisher(JointState, "stage_state", RELIABLE)
        graph.node.create_subscription(
            Float64MultiArray, "voltage_command",
            lambda command: due.append((time.monotonic() + behind, command.data[0])), RELIABLE,
        )  # fmt: skip

        def report():
            while len(due) > 1 and due[1][0] <= time.monotonic():
                due.popleft()
            publisher.publish(JointState(name=["x"], position=[1e-7 * due[0][1]], effort=[due[0][1]]))
            if node.process.poll() is None:
                reported.append(due[0][1])

        graph.node.create_timer(0.01, report)
        assert wait_for_end(graph, node) == 0, node.stderr
        assert "does not hold the end" not in node.stderr
    assert max(reported) > 90.0 and reported[-1] == 0.0


def test_a_stage_that_does_not_follow_ends_the_drive():
    with on_graph() as graph, exciter(graph, **AT_ONCE, duration=10.0) as node:
        publisher = graph.node.create_publisher(JointState, "stage_state", RELIABLE)
        state = JointState(name=["x"], position=[0.0], effort=[0.0])
        graph.node.create_timer(0.02, lambda: publisher.publish(state))
        listener = Listener(graph)
        assert wait_for_end(graph, node) == 1
        assert holds(node.stderr.splitlines()[-1], "axis 'x'", "stage_state")
        assert listener.v[-1, 0] == 0.0 and len(listener.v) < 5.0 * RATE


def test_a_sensor_that_dies_ends_the_drive():
    with on_graph() as graph, exciter(graph, **LIMITS, settle=0.0, duration=30.0) as node:
        publisher = graph.node.create_publisher(JointState, "stage_state", RELIABLE)
        v = [20.0]

        def follow(command):
            v[0] = command.data[0]

        graph.node.create_subscription(Float64MultiArray, "voltage_command", follow, RELIABLE)
        timer = graph.node.create_timer(
            0.01, lambda: publisher.publish(JointState(name=["x"], position=[1e-7 * v[0]], effort=v))
        )
        listener = Listener(graph)
        graph.spin_until(lambda: v[0] > 50.0, "50 V")
        timer.cancel()
        died = len(listener.commands)
        assert wait_for_end(graph, node) == 1
        assert holds(node.stderr.splitlines()[-1], "no valid stage_state")
    after = listener.v[died:, 0]
    assert after[-1] == pytest.approx(20.0) and len(after) < 1.5 * RATE


def test_without_a_report_or_a_number_it_waits_and_says_so():
    with on_graph() as graph, exciter(graph, **LIMITS, settle=0.0) as node:
        listener = Listener(graph)
        graph.spin_until(lambda: "rest_voltage" in node.stderr, "the exciter to say what it lacks")
        assert holds(node.stderr.splitlines()[-1], "stage_state", "rest_voltage")
        assert not listener.commands


def test_micrometres_are_named():
    with on_graph() as graph, exciter(graph, **LIMITS, settle=0.0) as node:
        Listener(graph)
        publisher = graph.node.create_publisher(JointState, "stage_state", RELIABLE)
        graph.node.create_timer(0.02, lambda: publisher.publish(JointState(name=["x"], position=[12.3], effort=[0.0])))
        graph.spin_until(lambda: "micrometres" in node.stderr, "the rule")
        assert holds(node.stderr, "position 12.3", "'x'", "0.1 m")


def test_a_stage_outside_the_limits_is_left_alone():
    with on_graph() as graph, exciter(graph, **AT_ONCE) as node:
        publish_state(graph, x=120.0)
        listener = Listener(graph)
        assert wait_for_end(graph, node) == 1
        said = node.stderr.splitlines()[-1]
    assert said == "exciter: axis 'x' is at 120 V, outside 0 to 100 V; move it inside first"
    assert not listener.commands


def test_it_drives_nothing_before_the_middleware_has_had_the_time_to_find_everybody():
    with on_graph() as graph:
        listener, begun = Listener(graph), time.monotonic_ns()
        publish = graph.node.create_publisher(JointState, "stage_state", RELIABLE).publish
        graph.node.create_timer(0.01, lambda: publish(JointState(name=["x"], position=[0.0], effort=[0.0])))
        with exciter(graph, **LIMITS, settle=0.0):
            listener.wait_for(1)
            assert time.monotonic_ns() - begun >= LOOK_WITHOUT_NS


@pytest.mark.slow
def test_it_drives_nothing_beside_another_publisher():
    with on_graph() as graph:
        graph.node.create_publisher(Float64MultiArray, "voltage_command", RELIABLE)
        listener = Listener(graph)
        with exciter(graph, **LIMITS, settle=0.5, rest_voltage=0.0) as node:
            assert wait_for_end(graph, node) == 1
            assert holds(node.stderr.splitlines()[-1], "1 other publisher", "voltage_command", graph.node.get_name())
            assert "exciting" not in node.stderr
    assert not listener.commands


@pytest.mark.slow
def test_it_drives_nothing_beside_two_reporters_of_an_axis():
    with on_graph() as graph:
        for _ in range(2):
            publish = graph.node.create_publisher(JointState, "stage_state", RELIABLE).publish
            graph.node.create_timer(
                0.01, lambda publish=publish: publish(JointState(name=["x"], position=[0.0], effort=[0.0]))
            )
        listener = Listener(graph)
        with exciter(graph, **LIMITS, settle=0.0) as node:
            assert wait_for_end(graph, node) == 1
            assert holds(node.stderr.splitlines()[-1], "two publishers of stage_state")
    assert not listener.commands


def test_it_returns_when_another_publisher_appears():
    with on_graph() as graph, exciter(graph, **AT_ONCE, duration=30.0, slew_limit=400.0) as node:
        listener = Listener(graph)
        listener.wait_for_motion()
        graph.node.create_publisher(Float64MultiArray, "voltage_command", RELIABLE)
        assert wait_for_end(graph, node) == 1
        # On a busy machine its name is heard of later than the publisher.
        told = node.stderr.splitlines()[-1]
        assert holds(told, "1 other publisher", "voltage_command")
        assert graph.node.get_name() in told or "unknown name" in told
        v = listener.v
    assert v[-1, 0] == pytest.approx(0.0, abs=1e-9) and v.max() > 60.0
    assert fastest(v) <= 2 * 400.0 * (1 + 1e-9) and len(v) < 20.0 * RATE


def test_it_waits_until_another_publisher_has_left():
    with on_graph() as graph, exciter(graph, **AT_ONCE, autostart=False) as node:
        other = graph.node.create_publisher(Float64MultiArray, "voltage_command", RELIABLE)
        listener = Listener(graph)
        graph.spin_until(lambda: listener.publishers == 2, "both publishers")
        call(graph, "start")
        graph.spin_until(lambda: "other publisher" in node.stderr, "that it waits")
        assert not listener.commands
        graph.node.destroy_publisher(other)
        listener.wait_for_motion()


def seconds_of(time):
    return time.sec + time.nanosec * 1e-9


def test_a_drive_as_one_trajectory_that_nobody_tells_of():
    """Where it has stopped is not known without a driver or a stage that says so: nothing is sent after that."""
    drive = {"duration": 60.0, "axes": ["x", "y"], "drive": "cross_coupling"}
    with on_graph() as graph, exciter(graph, **AT_ONCE, **drive, output="trajectory") as node:
        listener, trajectories = Listener(graph), graph.record(JointTrajectory, "voltage_trajectory")
        graph.spin_until(lambda: trajectories, "the trajectory")
        node.process.send_signal(signal.SIGINT)
        assert wait_for_end(graph, node) == 1
        assert "not confirmed" in node.stderr
        assert holds(node.stderr.splitlines()[-1], "stop is not confirmed", "nobody reports")
    whole, stop = trajectories
    assert list(whole.joint_names) == ["x", "y"] and not stop.points
    assert not any(len(point.positions) or len(point.velocities) for point in whole.points)
    times = [seconds_of(point.time_from_start) for point in whole.points]
    np.testing.assert_allclose(np.diff([0.0, *times]), 1.0 / RATE, atol=1e-9)
    np.testing.assert_array_equal([list(point.effort) for point in whole.points], drawn(**drive))
    # They say when they were made.
    assert 0.0 < time.time() - seconds_of(whole.header.stamp) < 60.0
    assert seconds_of(whole.header.stamp) < seconds_of(stop.header.stamp)
    assert not listener.commands


def test_a_stage_that_says_where_it_is_is_brought_back_without_a_driver_that_tells():
    with on_graph() as graph, exciter(graph, **LIMITS, settle=0.0, duration=30.0, output="trajectory") as node:
        playing, v = [], [20.0]

        def take(trajectory):
            playing[:] = [(time.monotonic(), np.array([point.effort[0] for point in trajectory.points]))]
            trajectories.append(trajectory)

        def report():
            if playing and len(playing[0][1]):
                begun, samples = playing[0]
                v[0] = float(samples[min(int((time.monotonic() - begun) * RATE), len(samples) - 1)])
            publisher.publish(JointState(name=["x"], position=[1e-7 * v[0]], effort=v))

        trajectories = []
        publisher = graph.node.create_publisher(JointState, "stage_state", RELIABLE)
        graph.node.create_subscription(JointTrajectory, "voltage_trajectory", take, RELIABLE)
        graph.node.create_timer(0.02, report)
        graph.spin_until(lambda: v[0] > 60.0, "60 V")
        node.process.send_signal(signal.SIGTERM)
        assert wait_for_end(graph, node) == 0, node.stderr
        assert holds(node.stderr.splitlines()[-1], "stopped after", "no driver has confirmed", "x at 20 V")
    _, stop, back = trajectories
    assert not stop.points and v[0] == pytest.approx(20.0, abs=1e-9)
    samples = np.array([point.effort[0] for point in back.points])
    assert samples[0] > 50.0 and np.abs(np.diff(samples)).max() <= 0.8 * 1000.0 / RATE


def test_limits_must_be_given():
    with started("exciter") as node:
        assert node.wait() == 2
        assert holds(node.stderr, "voltage_min", "nan", -10000, 10000) and node.stderr.count("\n") == 1


@pytest.mark.parametrize(
    ("given", "says"),
    [
        ({"voltage_max": math.nan}, ("voltage_max", "nan")),
        ({"voltage_max": -5.0}, ("-5 V",)),
        ({"slew_limit": 5.0}, ("4 V/s",)),
        ({"drive": "friction"}, ("drive", "'friction'", "calibration", "delay")),
        ({"voltage_max": [100.0, 50.0]}, ("voltage_max", "[100.0, 50.0]")),
        ({"rest_voltage": 120.0}, ("120 V",)),
        ({"output": "trajectory", "repeat": True}, ("repeat", "'trajectory'")),
        ({"axes": ["x", "x"]}, ("axes", "['x', 'x']")),
        ({"axes": []}, ("axes", "[]")),
    ],
)
def test_parameters_of_which_no_drive_can_be_made(given, says):
    values = {entry.name: entry.default for entry in DECLARATIONS} | LIMITS
    ExciterSettings.of(values)
    assert holds(refusal(UsageError, ExciterSettings.of, values | given), *says)


@pytest.mark.parametrize(("found", "start"), [([50.0], 50.0), ([-0.5], 0.0), ([100.9], 100.0)])
def test_a_voltage_read_back_is_taken_to_be_within_limits(found, start):
    values = {entry.name: entry.default for entry in DECLARATIONS} | LIMITS
    assert ExciterSettings.of(values).drawn(found).voltage["x"][0] == start
    given = ExciterSettings.of(values | {"rest_voltage": 25.0})
    assert given.drawn(found).voltage["x"][0] == 25.0


def test_the_slew_limit_is_the_range_in_a_tenth_of_a_second_unless_it_is_said():
    values = {entry.name: entry.default for entry in DECLARATIONS} | LIMITS
    assert ExciterSettings.of(values).limits[0].slew == 1000.0
    assert ExciterSettings.of(values | {"slew_limit": 0.0}).limits[0].slew == math.inf


def test_it_drives_nothing_that_two_report():
    with on_graph() as graph, exciter(graph, **AT_ONCE, autostart=False) as node:
        listener = Listener(graph)
        graph.tested = node
        publish_state(graph, x=0.0)
        publish_state(graph, x=0.0)
        call(graph, "start")
        graph.spin_until(lambda: "two publishers" in node.stderr, "that both are named")
        assert not listener.commands


@pytest.mark.parametrize("busy", [{"_waiting": True}, {"_playback": object()}])
def test_neither_a_drive_nor_one_that_waits_takes_other_limits(busy):
    def of(**given):
        return ExciterSettings.of({one.name: one.default for one in DECLARATIONS} | LIMITS | given)

    def required(settings, **state):
        begun = SimpleNamespace(settings=of())
        node = SimpleNamespace(**{"_waiting": False, "_playback": None, "_parameter_set": begun} | state)
        Exciter._require_as_begun(node, settings)

    for name, value in {"voltage_min": 5.0, "voltage_max": 60.0, "slew_limit": 500.0, "rate": 50.0}.items():
        assert holds(refusal(UsageError, required, of(**{name: value}), **busy), name, "~/stop")
        required(of(**{name: value}))
    required(of(duration=20.0, repeat=True, voltage_max=[100]), **busy)
