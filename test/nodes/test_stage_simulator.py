"""The simulated stage as a process of its own, over DDS."""

import math
import signal
import time
from collections.abc import Callable
from contextlib import contextmanager

import numpy as np
import pytest

rclpy = pytest.importorskip("rclpy")

from nodes.ros_helpers import PATIENCE_S, NodeProcess  # noqa: E402
from rclpy.context import Context  # noqa: E402
from rclpy.executors import SingleThreadedExecutor  # noqa: E402
from rclpy.qos import QoSProfile, ReliabilityPolicy  # noqa: E402
from rosgraph_msgs.msg import Clock  # noqa: E402
from sensor_msgs.msg import JointState  # noqa: E402
from std_msgs.msg import Float64MultiArray  # noqa: E402

from slpi_ros.simulation.stage import Stage  # noqa: E402

QOS = QoSProfile(depth=100, reliability=ReliabilityPolicy.RELIABLE)


def start(**parameters) -> NodeProcess:
    given = [part for name, value in parameters.items() for part in ("-p", f"{name}:={value}")]
    return NodeProcess("stage_simulator", {}, given)


class Bench:
    """What stands at the other end of the topics."""

    def __init__(self, context: Context) -> None:
        self.node = rclpy.create_node("bench", context=context)
        self.states: list[JointState] = []
        self._executor = SingleThreadedExecutor(context=context)
        self._executor.add_node(self.node)
        self._commands = self.node.create_publisher(Float64MultiArray, "voltage_command", QOS)
        self.node.create_subscription(JointState, "stage_state", self.states.append, QOS)

    def send(self, *voltages: float) -> None:
        self._commands.publish(Float64MultiArray(data=list(voltages)))

    def spin_until(self, done: Callable[[], bool], process: NodeProcess) -> None:
        deadline = time.monotonic() + PATIENCE_S
        while not done():
            assert process.process.poll() is None, f"the simulator has ended: {process.stderr}"
            assert time.monotonic() < deadline, f"nothing happened; {len(self.states)} states so far"
            self._executor.spin_once(timeout_sec=0.05)

    def connect(self, process: NodeProcess, axes: int) -> None:
        """Command rest until an answer comes: neither direction loses anything from then on."""

        self.spin_until(self._commands.get_subscription_count, process)
        # Before the first command the stage reports 0 V, so the answer is told by its voltage.
        self.spin_until(lambda: bool(self.states), process)
        before = len(self.states)

        def answered() -> bool:
            self.send(*[0.0] * axes)
            return len(self.states) > before

        self.spin_until(answered, process)

    def spin_once(self) -> None:
        self._executor.spin_once(timeout_sec=0.02)

    def moved(self) -> list[JointState]:
        """Return the states after those that answered `connect`."""
        return [state for state in self.states if any(state.effort)]

    def close(self) -> None:
        self._executor.shutdown()
        self.node.destroy_node()


@contextmanager
def simulator(**parameters):
    process = start(**parameters)
    context = Context()
    rclpy.init(context=context)
    bench = Bench(context)
    try:
        yield bench, process
    finally:
        bench.close()
        rclpy.shutdown(context=context)
        process.kill()


def expected(seed, axes, commands):
    stage = Stage.random(axes, seed, noise_rms=0.0)
    return [stage.measure(stage.step(0.0, command)) for command in commands]


def test_every_command_is_answered_in_order_with_what_the_stage_does():
    commands = [(10.0, 90.0), (60.5, 20.0), (30.25, 45.0), (80.0, 0.0), (1.0, 100.0)]
    # unquoted, YAML takes y for a boolean
    with simulator(axes="['x', 'y']", seed=4, noise_rms=0.0, hardware_id="bench_7") as (bench, process):
        bench.connect(process, axes=2)
        for command in commands:
            bench.send(*command)
        bench.spin_until(lambda: len(bench.moved()) >= len(commands), process)
        states = bench.moved()
    assert [tuple(state.effort) for state in states] == commands
    assert [list(state.position) for state in states] == expected(4, ["x", "y"], commands)
    assert all(list(state.name) == ["x", "y"] for state in states)
    assert all(state.header.frame_id == "bench_7" for state in states)
    stamps = [(state.header.stamp.sec, state.header.stamp.nanosec) for state in states]
    assert stamps == sorted(stamps) and stamps[0][0] > 0


def test_a_restart_finds_the_stage_as_it_was_left():
    history, commands = [60.0, 20.0, 80.0], [[30.0], [50.0], [10.0]]
    with simulator(noise_rms=0.0, seed=3, initial_state=history) as (bench, process):
        bench.connect(process, axes=1)
        for command in commands:
            bench.send(*command)
        bench.spin_until(lambda: len(bench.moved()) >= len(commands), process)
        states = bench.moved()
    left, fresh = (expected(3, ["x"], [*before, *commands])[-3:] for before in ([[v] for v in [*history, 0.0]], []))
    assert [list(state.position) for state in states] == left != fresh
    assert all(state.header.frame_id == "simulated-3" for state in states)


def test_the_amplifier_saturates():
    with simulator(noise_rms=0, voltage_min=0, voltage_max=80) as (bench, process):
        bench.connect(process, axes=1)
        for command in (1e6, 40.0, -50.0, 10.0):
            bench.send(command)
        bench.spin_until(lambda: bool(bench.states) and list(bench.states[-1].effort) == [10.0], process)
        states = bench.states[-4:]
    assert [state.effort[0] for state in states] == [80.0, 40.0, 0.0, 10.0]
    positions = [state.position[0] for state in states]
    assert positions == [y for (y,) in expected(0, ["x"], [[80.0], [40.0], [0.0], [10.0]])]


def test_commands_that_are_none_are_ignored_and_counted():
    with simulator(noise_rms=0.0) as (bench, process):
        bench.connect(process, axes=1)
        for command in ((), (10.0, 20.0), (math.nan,), (math.inf,), (-math.inf,), (25.0,)):
            bench.send(*command)
        bench.spin_until(lambda: bool(bench.moved()), process)
        states = bench.moved()
        assert process.stop(signal.SIGINT) == 0
        said = process.stderr
    assert [list(state.effort) for state in states] == [[25.0]]
    assert [list(state.position) for state in states] == expected(0, ["x"], [[25.0]])
    assert "[]" in said and "Traceback" not in said


def test_a_stage_that_does_not_answer_publishes_on_its_own():
    with simulator(answer_commands=False, rate=100, noise_rms=5e-9, seed=2) as (bench, process):
        bench.spin_until(lambda: len(bench.states) >= 5, process)
        assert all(list(state.effort) == [0.0] for state in bench.states)

        def moved() -> bool:
            bench.send(50.0)
            return len(bench.moved()) >= 20

        bench.spin_until(moved, process)
        readings = [state.position[0] for state in bench.moved()]
    ((true,),) = expected(2, ["x"], [[50.0]])
    assert len(set(readings)) > 5
    assert max(abs(y - true) for y in readings) < 8 * 5e-9


def test_the_stage_of_the_mpi_paper_creeps_as_time_goes_by():
    with simulator(preset="p11", axes="['x', 'y']", voltage_min=-20, voltage_max=150) as (bench, process):
        bench.connect(process, axes=2)
        for _ in range(2):
            bench.send(120.0, 60.0)
            time.sleep(0.5)
        bench.spin_until(lambda: len(bench.moved()) >= 2, process)
        first, later = (list(state.position) for state in bench.moved())
    assert all(late - early > 1e-7 for early, late in zip(first, later, strict=True))


def test_it_publishes_from_its_start_on_and_answers_once_commanded():
    with simulator(noise_rms=0.0, rate=200) as (bench, process):
        bench.spin_until(lambda: len(bench.states) >= 20, process)
        assert all(list(state.effort) == [0.0] for state in bench.states)
        bench.connect(process, axes=1)
        bench.send(30.0)
        bench.spin_until(lambda: bool(bench.moved()), process)
        for _ in range(5):
            bench.spin_once()
        assert len(bench.moved()) == 1
        # Somebody who commands may wait for a state before the next command.
        bench.spin_until(lambda: len(bench.moved()) > 20, process)


def test_stage_time_runs_faster_on_request():
    with simulator(noise_rms=0.0, rate=100, speed=20.0, creep=0.03) as (bench, process):
        clocks = []
        bench.node.create_subscription(Clock, "/clock", clocks.append, QOS)
        bench.spin_until(lambda: len(clocks) >= 2, process)
        begun, first = time.monotonic(), clocks[-1].clock
        bench.spin_until(lambda: clocks[-1].clock.sec - first.sec >= 40, process)
        assert time.monotonic() - begun < 39
        # However late its messages are, no sample is lost.
        times = [each.clock.sec * 10**9 + each.clock.nanosec for each in clocks]
        assert {int(step) for step in np.diff(times) if step <= 10**7} == {10**7}
        stamps = [state.header.stamp.sec for state in bench.states]
        assert stamps[-1] - stamps[0] >= 4


def test_a_character_is_drawn_from_the_seed_and_told_only_if_not_hidden():
    told, readings = {}, {}
    for character in ("drawn", "hidden"):
        with simulator(noise_rms=0.0, seed=5, character=character, answer_commands=False) as (bench, process):
            bench.spin_until(lambda bench=bench: len(bench.states) >= 3, process)
            readings[character] = bench.states[0].header.frame_id
            process.stop(signal.SIGINT)
            told[character] = process.stderr
    assert readings == {"drawn": "simulated-5-drawn", "hidden": "simulated-5-hidden"}
    assert "Character(" in told["drawn"] and "Character(" not in told["hidden"]


def test_effects_are_given_by_parameters_and_change_the_hardware_id():
    ids = set()
    for creep in (0.01, 0.02):
        with simulator(creep=creep) as (bench, process):
            bench.spin_until(lambda bench=bench: bool(bench.states), process)
            ids.add(bench.states[0].header.frame_id)
    assert len(ids) == 2 and all(name.startswith("simulated-0-") for name in ids)


@pytest.mark.parametrize(
    ("parameters", "complaint"),
    [
        ({"voltage_min": 50.0, "voltage_max": 20.0}, "50.0"),
        ({"voltage_max": 500.0}, "500.0"),
        ({"axes": "[x, x]"}, "axes"),
        ({"noise_rms": ".nan"}, "noise_rms"),
        ({"rate": 0.0, "answer_commands": False}, "rate"),
        ({"rate": "fast"}, "'fast'"),
        ({"seed": -1}, "seed"),
        ({"preset": "p11"}, "x, y"),
        ({"preset": "best"}, "'best'"),
        ({"answer_commands": "7"}, "answer_commands"),
        ({"creep": -0.1}, "creep"),
        ({"character": "shy"}, "'shy'"),
        ({"speed": 0.0}, "speed"),
        ({"preset": "p11", "axes": "['x', 'y']", "lag": 0.01}, "p11"),
    ],
)
def test_parameters_of_which_no_stage_can_be_made(parameters, complaint):
    process = start(**parameters)
    try:
        assert process.wait() == 2
        said = process.stderr
    finally:
        process.kill()
    assert complaint in said and "Traceback" not in said and len(said.splitlines()) == 1
