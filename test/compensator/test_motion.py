"""From one way of moving to another: whoever gives the next voltage, slew and acceleration hold for the real time.

The clock is a made one: what is given when is exact.
"""

from dataclasses import replace

import numpy as np
import pytest

rclpy = pytest.importorskip("rclpy")

from nodes.ros_helpers import stage_model  # noqa: E402

from benchmarks.episodes import Ratios, Wire  # noqa: E402
from slpi_ros.compensator.controller import Controller, StopReason  # noqa: E402
from slpi_ros.compensator.feedback import LoopSettings, PidGains  # noqa: E402
from slpi_ros.compensator.validation import RejectedError  # noqa: E402
from slpi_ros.effects.creep import Creep  # noqa: E402
from slpi_ros.model.limits import Limits  # noqa: E402

MS, START_NS = 1_000_000, 5_000_000_000
SLEW, ACCELERATION = 500.0, 2000.0
GENTLE = Limits(0.0, 100.0, SLEW, ACCELERATION)
TOP = 9e-6


class Bench:
    """All axes, on a clock that goes as it is told, moved on when the controller says that it is due."""

    def __init__(self, limits=GENTLE, axes=("x",), feedback=False):
        self.now_ns, self.given = START_NS, []
        settings = LoopSettings(feedback, PidGains(1e5, 1e7), 0.1)
        self.controller = Controller(axes, [limits] * len(axes), loops=[settings] * len(axes))
        self.controller.use_model(stage_model(axes))
        self.controller.activate(self.now_ns)
        self.ratios = Ratios()
        self.wires = [Wire(v, limits, self.controller.trajectory.period) for v in self.controller.voltages]

    def publish(self):
        self.given.append((self.now_ns, *self.controller.voltages))
        for wire, voltage, axis in zip(self.wires, self.controller.voltages, self.controller.axes, strict=True):
            meant = self.now_ns in (axis.samples.given_ns, axis.loop.driven_ns)
            wire.output(voltage, self.now_ns, self.ratios, f"output {len(self.given)}", meant)

    def advance(self):
        """Do what is due."""
        if self.controller.advance(self.now_ns, self.now_ns):
            self.publish()

    def run(self, seconds):
        end_ns = self.now_ns + int(seconds * 1e9)
        while (due_ns := self.controller.next_due_ns(self.now_ns, self.now_ns)) is not None and due_ns <= end_ns:
            self.now_ns = max(self.now_ns, due_ns)
            self.advance()
        self.now_ns = end_ns

    def wish(self, *displacements):
        names = self.controller.names[: len(displacements)]
        self.controller.update(self.now_ns, names, displacements, self.now_ns)
        self.publish()

    def send(self, seconds, *displacements, period=0.005):
        for _ in range(round(seconds / period)):
            self.run(period)
            self.wish(*displacements)

    def follow(self, path, period_ns=5 * MS, names=("x",), first_ns=0, start_ns=0):
        times = first_ns + np.arange(len(path)) * period_ns
        rows = np.column_stack([path] * len(names))
        self.controller.follow(list(names), times, rows, start_ns, self.now_ns, self.now_ns)

    def cancel(self):
        self.controller.follow([], [], [], 0, self.now_ns, self.now_ns)

    def end(self, ramp_to=None):
        """Hold, or go to a voltage, as an end of activity does."""
        if ramp_to is None:
            self.controller.stop(StopReason.DEACTIVATED, self.now_ns)
        else:
            self.controller.ramp([ramp_to] * len(self.controller.axes), 50.0, self.now_ns)
        while self.controller.ramping:
            self.now_ns += 4 * MS
            self.advance()

    def ramp(self, rate=400.0, voltage=0.0):
        self.controller.ramp([voltage] * len(self.controller.axes), rate, self.now_ns)

    def check(self):
        """Slew and acceleration as they reached the amplifiers, by the definitions."""
        ratios = self.ratios
        assert max(ratios.step, ratios.slew, ratios.acceleration) <= 1.0 + 1e-9, ratios
        assert ratios.outside <= 0.0 and ratios.outputs > 0

    def check_stands(self):
        """All axes came to rest, and nothing more is sent."""
        last = len(self.given)
        assert all(abs(axis.output.rate) <= ACCELERATION * 1e-3 for axis in self.controller.axes)
        self.run(1.0)
        assert len(self.given) == last and not self.controller.ramping


@pytest.fixture
def bench():
    """Return a maker of benches."""
    return Bench


LIMITS = [Limits(0.0, 100.0, SLEW), GENTLE]
FEEDBACK = pytest.mark.parametrize("feedback", [False, True])


@FEEDBACK
@pytest.mark.parametrize("limits", LIMITS)
@pytest.mark.parametrize("first_ns", [0, MS, 30 * MS, 500 * MS])
def test_a_trajectory_that_takes_over_from_a_ramp(bench, limits, first_ns, feedback):
    made = bench(limits, feedback=feedback)
    made.send(1.5, TOP)
    made.run(1.0)
    made.ramp(50.0)
    made.run(0.2013)
    made.follow(np.full(200, TOP), first_ns=first_ns)
    made.run(3.0)
    made.check()
    assert made.controller.axes[0].stream.memory.displacement == pytest.approx(TOP, abs=1e-12)


@FEEDBACK
@pytest.mark.parametrize("wish", [2e-6, TOP])
@pytest.mark.parametrize("late", [0.0, 0.0013, 0.0039])
def test_a_command_that_interrupts_a_ramp(bench, wish, late, feedback):
    made = bench(feedback=feedback)
    made.send(1.5, TOP)
    made.run(1.0)
    made.ramp()
    made.run(0.12 + late)
    assert made.controller.axes[0].output.in_motion
    made.wish(wish)
    made.send(1.5, wish)
    made.check()
    made.run(0.5)
    assert made.controller.axes[0].stream.memory.displacement == pytest.approx(wish, abs=1e-12)


def test_a_command_right_after_a_step_of_a_ramp_moves_by_the_time_since_that_step(bench):
    made = bench(Limits(0.0, 100.0, SLEW))
    made.send(1.5, TOP)
    made.ramp()
    made.run(0.0503)
    before_ns, before = made.given[-1]
    made.wish(TOP)
    assert made.given[-1][1] - before == pytest.approx(SLEW * (made.now_ns - before_ns) * 1e-9)
    # What is held back follows by itself, at the output rate.
    made.run(1.0)
    made.check()
    assert made.controller.axes[0].stream.memory.displacement == pytest.approx(TOP, abs=1e-12)
    steps = np.diff([t for t, _ in made.given[-10:]])
    assert (steps == MS).all()


def test_axes_that_a_command_does_not_name_keep_their_own_goal(bench):
    made = bench(axes=("x", "y"))
    made.send(1.5, TOP, TOP)
    made.run(1.0)
    made.ramp(400.0)
    made.run(0.1507)
    made.wish(5e-6)
    for _ in range(60):
        made.run(0.0047)
        made.wish(5e-6)
    made.run(1.0)
    made.check()
    made.check_stands()
    assert made.given[-1][2] == pytest.approx(0.0, abs=1e-8), "the end of its ramp"
    assert made.controller.axes[0].stream.memory.displacement == pytest.approx(5e-6, abs=1e-12)


@FEEDBACK
@pytest.mark.parametrize("how", ["cancel", "end", "replace", "deactivate", "ramp", "silence"])
def test_a_trajectory_that_leaves_an_axis_in_motion(bench, how, feedback):
    made = bench(axes=("x", "y"), feedback=feedback)
    made.follow(np.full(400, TOP), names=("x", "y"))
    made.run(0.1512)
    if how == "end":
        made.cancel()
        made.run(1.0)
        made.follow(np.linspace(0.0, TOP, 41)[1:], names=("x", "y"))
        made.run(0.25)
    assert made.controller.axes[0].output.in_motion
    if how == "cancel":
        made.cancel()
    elif how == "replace":
        made.follow(np.full(100, 5e-6), names=("y",))
    elif how == "deactivate":
        made.end()
        made.controller.deactivate(made.now_ns)
    elif how == "ramp":
        made.end(20.0)
    elif how == "silence":
        made.cancel()
        made.run(0.003)
        made.ramp(50.0, 20.0)
    made.run(3.0)
    made.check()
    made.check_stands()
    if how in ("ramp", "silence"):
        assert made.given[-1][1:] == pytest.approx((20.0, 20.0))


def test_a_single_command_is_followed_to_its_goal(bench):
    """At the output rate, although nothing more is sent."""
    made = bench()
    made.wish(TOP)
    assert len(made.given) == 1 and made.controller.axes[0].slewing
    made.run(1.0)
    made.check()
    made.check_stands()
    assert made.controller.axes[0].stream.memory.displacement == pytest.approx(TOP, abs=1e-12)
    assert (np.diff([t for t, _ in made.given]) == MS).all()


def test_a_command_replaces_the_goal_of_one_that_is_under_way(bench):
    made = bench()
    made.wish(TOP)
    made.run(0.1)
    assert made.controller.axes[0].output.in_motion
    made.wish(2e-6)
    made.run(1.0)
    made.check()
    made.check_stands()
    assert made.controller.axes[0].stream.memory.displacement == pytest.approx(2e-6, abs=1e-12)


def test_a_refused_trajectory_stops_no_ramp(bench):
    made = bench()
    made.send(1.0, TOP)
    made.run(1.0)
    made.ramp()
    made.run(0.1)
    with pytest.raises(RejectedError) as caught:
        made.follow([1.0])
    assert caught.value.cause == "out_of_range"
    made.run(2.0)
    made.check()
    assert made.given[-1][1] == pytest.approx(0.0, abs=1e-8)


def test_a_path_that_ends_gently_ends_with_its_last_point(bench):
    made = bench()
    made.send(2.0, 5e-6)
    made.run(1.0)
    sent = len(made.given)
    made.follow(5e-6 + 2e-6 * (0.5 - 0.5 * np.cos(np.linspace(0.0, np.pi, 100))))
    made.run(2.0)
    made.check()
    # One sample each millisecond, interpolated between points 5 ms apart, and at most a step to come to rest.
    assert sent + 496 <= len(made.given) <= sent + 497
    assert made.given[-1][0] <= made.given[sent][0] + 496 * MS
    made.check_stands()


@FEEDBACK
def test_a_measurement_that_starts_the_loop_in_motion_changes_no_rate(bench, feedback):
    made = bench(feedback=feedback)
    made.send(0.1, TOP)
    made.controller.measure(["x"], [made.controller.axes[0].stream.memory.displacement], made.now_ns)
    made.send(0.5, TOP)
    made.check()


def test_a_step_with_creep_arrives_at_the_slew_limit_and_not_when_the_hold_begins():
    """What the limit held back was taken for reached, up to three intervals between the messages."""
    made = Bench(Limits(0.0, 100.0, 1000.0))
    model = stage_model()
    creep = Creep((0.3,), (0.05,))
    made.controller.use_model(replace(model, axes={"x": replace(model.axes["x"], effects=(creep,))}))
    for y in (3e-6, 6e-6, 2e-6, 6e-6):
        made.wish(y)
        made.run(0.2)
        axis = made.controller.axes[0]
        assert axis.stream.uncoupled_displacement == pytest.approx(y, rel=0.02)
        assert not axis.slewing
        made.run(0.4)
    made.check()


def test_wider_limits_are_used_by_a_hold_at_once_and_not_by_its_feedback():
    made = Bench(Limits(0.0, 50.0), feedback=True)
    for _ in range(40):
        made.run(0.005)
        made.controller.measure(["x"], [made.controller.axes[0].expected], made.now_ns)
        made.wish(8e-6)
    made.run(3.0)
    made.controller.use_limits([Limits(0.0, 100.0)], made.now_ns)
    made.run(0.01)
    axis = made.controller.axes[0]
    assert axis.stream.uncoupled_displacement == pytest.approx(8e-6, abs=1e-9)


def test_a_zero_that_is_set_in_motion_brakes():
    made = Bench(GENTLE)
    made.send(0.3, TOP)
    made.controller.measure(["x"], [made.controller.axes[0].expected + 1e-8], made.now_ns)
    assert made.controller.axes[0].output.in_motion
    made.controller.set_zero(made.now_ns)
    assert made.controller.ramping
    made.run(1.0)
    made.check()
    made.check_stands()


def test_a_step_that_ends_at_rest_is_output_though_the_limits_that_waited_for_it_have_no_acceleration():
    made = Bench(replace(GENTLE, acceleration=1e6))
    made.send(0.1, TOP)
    assert made.controller.axes[0].output.in_motion
    made.controller.use_limits([replace(GENTLE, acceleration=np.inf)], made.now_ns)
    given = len(made.given)
    made.run(0.001)
    assert len(made.given) == given + 1 and made.controller.axes[0].output.rate == 0.0
    assert made.given[-1][1] == made.given[given - 1][1]
