"""From one way of moving to another: whoever gives the next voltage, slew and acceleration hold for the real time.

The clock is a made one: what is given when is exact.
"""

from math import inf

import numpy as np
import pytest

rclpy = pytest.importorskip("rclpy")

from nodes.ros_helpers import stage_model  # noqa: E402

from slpi_ros.compensator.controller import Controller  # noqa: E402
from slpi_ros.compensator.feedback import LoopSettings, PidGains  # noqa: E402
from slpi_ros.compensator.validation import RejectedError  # noqa: E402
from slpi_ros.model.limits import Limits  # noqa: E402

MS, START_NS = 1_000_000, 5_000_000_000
SLEW, ACCELERATION = 500.0, 2000.0
GENTLE = Limits(0.0, 100.0, SLEW, ACCELERATION)
TOP = 9e-6
# What a timer that is a microsecond late does to the shortest steps.
TIMER = 0.05


class Bench:
    """All axes, on a clock that goes as it is told, moved on when the controller says that it is due."""

    def __init__(self, limits=GENTLE, axes=("x",), feedback=False):
        self.now_ns, self.given, self.meant = START_NS, [], []
        settings = LoopSettings(feedback, PidGains(1e5, 1e7), 0.1)
        self.controller = Controller(axes, [limits] * len(axes), loops=[settings] * len(axes))
        self.controller.use_model(stage_model(axes))
        self.controller.activate(self.now_ns)

    def publish(self, axes):
        self.given.append((self.now_ns, *self.controller.voltages))
        self.meant.append(list(axes))

    def advance(self):
        """Do what is due, and note which axes that has moved."""
        before = [(axis.given_ns, axis.point_ns) for axis in self.controller.axes]
        if self.controller.advance(self.now_ns, self.now_ns):
            axes = self.controller.axes
            pairs = zip(axes, before, strict=True)
            moved = {axis.place for axis, last in pairs if (axis.given_ns, axis.point_ns) != last}
            self.publish(moved)

    def run(self, seconds):
        end_ns = self.now_ns + int(seconds * 1e9)
        while (due_ns := self.controller.next_due_ns(self.now_ns, self.now_ns)) is not None and due_ns <= end_ns:
            self.now_ns = max(self.now_ns, due_ns)
            self.advance()
        self.now_ns = end_ns

    def wish(self, *displacements):
        names = self.controller.names[: len(displacements)]
        self.controller.update(self.now_ns, names, displacements, self.now_ns)
        self.publish(range(len(names)))

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
            self.controller.hold(self.now_ns)
        else:
            self.controller.ramp([ramp_to] * len(self.controller.axes), 50.0, self.now_ns)
        while self.controller.ramping:
            self.now_ns += 4 * MS
            self.advance()

    def ramp(self, rate=400.0, voltage=0.0):
        if self.now_ns - self.given[-1][0] > 100 * MS:
            # The axes have been at rest, and their time begins now.
            self.publish(range(len(self.controller.axes)))
        self.controller.ramp([voltage] * len(self.controller.axes), rate, self.now_ns)

    def rates(self, axis=0):
        """Return duration (s) and rate (V/s) of all steps so far; after a pause of 0.1 s an axis is at rest."""
        # What is given for another axis is no step of this one.
        own = [(t, each[axis]) for (t, *each), meant in zip(self.given, self.meant, strict=True) if axis in meant]
        t, v = np.array(own).T
        t, v = t[np.diff(t, append=inf) > 0] * 1e-9, v[np.diff(t, append=inf) > 0]
        dt = np.diff(t)
        return dt, np.diff(v) / np.minimum(dt, 0.1)

    def check(self, limits=GENTLE):
        for axis in range(len(self.controller.axes)):
            dt, rate = self.rates(axis)
            assert np.abs(rate).max() <= limits.slew * (1 + TIMER)
            before = np.where(dt > 0.1, 0.0, np.append(0.0, rate[:-1]))
            if limits.acceleration < inf:
                change = np.abs(rate - before) / np.minimum(dt, 0.1)
                at = int(np.argmax(change))
                assert change[at] <= limits.acceleration * (1 + TIMER), (axis, at, dt[: at + 2], rate[: at + 2])

    def check_stands(self):
        """All axes came to rest, and nothing more is sent."""
        last = self.given[-1]
        for axis in range(len(self.controller.axes)):
            dt, rate = self.rates(axis)
            assert abs(rate[-1]) <= ACCELERATION * dt[-1] * (1 + TIMER)
        self.run(1.0)
        assert self.given[-1] == last and not self.controller.ramping


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
    made.check(limits)
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
    assert made.controller.axes[0].in_motion(made.now_ns)
    made.wish(wish)
    made.send(1.5, wish)
    made.check()
    assert len(made.given) == 300 + 1 + 30 + 1 + 300


def test_without_acceleration_limit_no_time_has_passed_at_the_first_command_after_a_ramp(bench):
    made = bench(Limits(0.0, 100.0, SLEW))
    made.send(1.5, TOP)
    made.ramp()
    made.run(0.0503)
    before = made.given[-1][1]
    made.wish(TOP)
    assert made.given[-1][1] == before
    made.run(1.0)
    assert made.given[-1][1] == before


def test_axes_that_a_command_does_not_name_come_to_rest(bench):
    made = bench(axes=("x", "y"))
    made.send(1.5, TOP, TOP)
    made.run(1.0)
    made.ramp(400.0)
    made.run(0.1507)
    made.wish(5e-6)
    for _ in range(60):
        made.run(0.0047)
        made.wish(5e-6)
    made.check()
    made.check_stands()
    assert made.given[-1][2] > 1.0


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
    assert made.controller.axes[0].in_motion(made.now_ns)
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


def test_commands_that_cease_leave_the_axis_at_rest_and_what_comes_then_knows(bench):
    """Nothing is sent unasked, so nothing brakes; but a ramp that begins later does not go on as fast."""
    made = bench()
    made.send(0.1, TOP)
    assert made.controller.axes[0].in_motion(made.now_ns)
    sent = len(made.given)
    made.run(0.5)
    assert len(made.given) == sent
    made.ramp(300.0)
    made.run(1.0)
    made.check()
    made.check_stands()
    assert (
        made.given[-1][1] == pytest.approx(0.0, abs=1e-8) and max(v for _, v in made.given) == made.given[sent - 1][1]
    )


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
    assert len(made.given) == sent + 100


@FEEDBACK
def test_a_measurement_that_starts_the_loop_in_motion_changes_no_rate(bench, feedback):
    made = bench(feedback=feedback)
    made.send(0.1, TOP)
    made.controller.measure(["x"], [made.controller.axes[0].stream.memory.displacement], made.now_ns)
    made.send(0.5, TOP)
    made.check()
