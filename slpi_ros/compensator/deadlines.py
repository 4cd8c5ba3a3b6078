"""What time allows: which points are due, and how far a voltage may go from one point to the next."""

from dataclasses import dataclass
from math import inf
from typing import Any, Generic, NamedTuple, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from slpi_ros.compensator.rejection import NOT_FINITE, TIME_BACKWARDS, RejectedError
from slpi_ros.io.joint_state import SECOND_NS
from slpi_ros.model.stream import LONGEST_STEP, AxisStream, Pace

FloatArray = NDArray[np.float64]
TimeArray = NDArray[np.int64]
Mask = NDArray[np.bool_]

# No clock shows a later time, and two of them can be added.
LATEST_NS = 2**62
# Blocks grow while the path is slow enough for the limits. Where it is not, samples go one by one, at first this many,
# and the more the sooner it happens again: a path that is too fast everywhere costs no more than it does one by one.
BLOCK, PATIENCE, MOST_PATIENCE = 1024, 256, 16384


class Timed(Protocol):
    """Points that are due one after the other."""

    @property
    def at_once(self) -> bool:
        """Whether the first point's time counts from the start, which is now."""

    def deadlines_ns(self, now_ns: int) -> TimeArray:
        """Return when the points are due if started now, shape (N,), nanoseconds, strictly increasing, N >= 1."""


Points = TypeVar("Points", bound=Timed)


class Due(NamedTuple, Generic[Points]):
    """The one point that is to be applied now.

    Parameters
    ----------
    points : Timed
        What it is one of.
    point : int
        Its number among them.
    deadline_ns : int, nanoseconds
        When it was due.
    skipped : int
        Points before it that are too late now.
    """

    points: Points
    point: int
    deadline_ns: int
    skipped: int


@dataclass
class Stretch(Generic[Points]):
    """The points ``next:stop`` are still to be applied, at `deadlines_ns`, shape (N,), nanoseconds."""

    points: Points
    deadlines_ns: TimeArray
    next: int
    stop: int

    def until(self, time_ns: int) -> int:
        """Return the first point from `next` on that is due at `time_ns` or later."""
        return self.next + int(np.searchsorted(self.deadlines_ns[self.next : self.stop], time_ns))


class Streamer(Generic[Points]):
    """Tells which points are due, by absolute deadlines: a late call does not delay the points after it.

    New points replace those before them as in joint_trajectory_controller: at once, or, stamped with a time to come,
    from their first deadline on. Any number of them may wait for their time.

    All times are nanoseconds on one clock, the caller's. One that never jumps is best: it is not looked at here.

    Attributes
    ----------
    skipped : int
        Points that were due together with a later one, so far.
    """

    def __init__(self) -> None:
        self.skipped = 0
        self._stretches: list[Stretch[Points]] = []

    @property
    def remaining(self) -> int:
        """Number of points still to be applied."""
        return sum(stretch.stop - stretch.next for stretch in self._stretches)

    @property
    def coming(self) -> list[Points]:
        """Those of which points are still to be applied, in order."""
        return [stretch.points for stretch in self._stretches]

    @property
    def next_deadline_ns(self) -> int | None:
        """When the next point is due, nanoseconds; None: there is none, the voltages stay."""
        return int(self._stretches[0].deadlines_ns[self._stretches[0].next]) if self._stretches else None

    def before(self, time_ns: int) -> list[Stretch[Points]]:
        """Return what is still to be applied before `time_ns`, in order."""
        return [
            Stretch(each.points, each.deadlines_ns, each.next, stop)
            for each in self._stretches
            if (stop := each.until(time_ns)) > each.next
        ]

    def start(self, points: Points, now_ns: int) -> int:
        """Let new points take over; return how many of those before are never applied."""
        deadlines = points.deadlines_ns(now_ns)
        kept = [] if points.at_once else self.before(int(deadlines[0]))
        dropped = self.remaining - sum(stretch.stop - stretch.next for stretch in kept)
        self._stretches = [*kept, Stretch(points, deadlines, 0, deadlines.size)]
        return dropped

    def cancel(self) -> int:
        """Forget all points, the voltages stay; return how many are never applied."""
        dropped = self.remaining
        self._stretches = []
        return dropped

    def due(self, now_ns: int) -> Due[Points] | None:
        """Return the latest point that is due and has not been returned, or None; call it until it returns None.

        Points due before it are never applied; they are counted in `Due.skipped` and in `skipped`. The last point
        before a handover is never skipped: others may name other axes.
        """
        stretch = self._stretches[0] if self._stretches else None
        if not stretch or now_ns < stretch.deadlines_ns[stretch.next]:
            return None
        first, stretch.next = stretch.next, stretch.until(now_ns + 1)
        if stretch.next == stretch.stop:
            del self._stretches[0]
        point = stretch.next - 1
        self.skipped += point - first
        return Due(stretch.points, point, int(stretch.deadlines_ns[point]), point - first)


def check_times(times: NDArray[Any], start_ns: int) -> None:
    """Reject times from a start (ns), shape (N,), N >= 1, that are no nanoseconds, or not in strict order.

    Raises
    ------
    RejectedError
        It names the first bad one.
    """
    if times.dtype.kind not in "iu":
        raise RejectedError(NOT_FINITE, f"times are of type {times.dtype}; give whole nanoseconds")
    if abs(start_ns) >= LATEST_NS or times.max() >= LATEST_NS:
        what = f"start {start_ns} ns, last point after {times.max()} ns"
        raise RejectedError(TIME_BACKWARDS, f"{what}: these are no times of a clock; correct the stamp and the times")
    back = np.concatenate([[times[0] < 0], times[1:] <= times[:-1]])
    if back.any():
        at = int(np.argmax(back))
        before = f"point {at - 1} at {times[at - 1] / SECOND_NS:.9g} s" if at else "the start"
        what = f"point {at} at {times[at] / SECOND_NS:.9g} s does not come after {before}"
        raise RejectedError(TIME_BACKWARDS, f"{what}; sort the points, and give each its own time")


def seconds_between(times_ns: TimeArray, since_ns: int) -> FloatArray:
    """Return the time from each point to the next, shape (N,), seconds; the first counts from `since_ns` (ns)."""
    elapsed = np.empty(times_ns.size)
    elapsed[0] = max(int(times_ns[0]) - since_ns, 0)
    elapsed[1:] = np.diff(times_ns)
    elapsed *= 1e-9
    return elapsed


def follow(stream: AxisStream, y: FloatArray, elapsed: FloatArray) -> tuple[FloatArray, Mask, FloatArray]:
    """Move an axis through displacements, as `AxisStream.move` does one by one.

    In blocks where the path is slow enough, sample by sample where it is not.

    Parameters
    ----------
    stream : AxisStream
    y : ndarray, shape (N,), metres
    elapsed : ndarray, shape (N,), seconds
        Since the sample before. A pause longer than `LONGEST_STEP` counts as that, and the axis starts from rest.

    Returns
    -------
    voltages : ndarray, shape (N,), volts
    late : ndarray of bool, shape (N,)
        Where the limits kept the voltage from its goal.
    reached : ndarray, shape (N,), metres
    """
    v, late, reached = np.empty_like(y), np.zeros(y.size, bool), np.empty_like(y)
    start, block, patience = 0, BLOCK, PATIENCE
    while start < y.size:
        stop = min(start + block, y.size)
        free = _until_too_fast(stream, y[start:stop], elapsed[start:stop], reached[start:stop])
        v[start : start + free.size] = free
        start += free.size
        if start == stop:
            block, patience = 4 * block, PATIENCE
            continue
        while start < y.size:
            stop = min(start + patience, y.size)
            v[start:stop], late[start:stop], reached[start:stop] = _one_by_one(
                stream, y[start:stop], elapsed[start:stop]
            )
            start = stop
            if not stream.missed or stream.held:
                break
        block, patience = BLOCK, min(2 * patience, MOST_PATIENCE)
    return v, late, reached


def _until_too_fast(stream: AxisStream, y: FloatArray, elapsed: FloatArray, reached: FloatArray) -> FloatArray:
    """Move through `y` up to the first step that is too fast; return the voltages, and note what they reach."""
    memory, limits = stream.memory, stream.limits
    if stream.missed and limits.acceleration < inf:
        # It may have to brake first.
        return np.empty(0)
    start = memory.snapshot()
    v = memory.inverse_array(y, limits.lower, limits.upper, reached)
    if limits.slew == limits.acceleration == inf:
        return v
    before = np.concatenate([[start.voltage], v[:-1]])
    too_fast = _too_fast(stream.pace, v, before, elapsed)
    free = int(np.argmax(too_fast)) if too_fast.any() else v.size
    if free < v.size:
        memory.restore(start)
        memory.forward_array(v[:free])
    if free:
        last = float(v[free - 1])
        stream.drive(last)
        stream.pace.moved(last - float(before[free - 1]), min(float(elapsed[free - 1]), LONGEST_STEP))
    return v[:free]


def _too_fast(pace: Pace, v: FloatArray, before: FloatArray, elapsed: FloatArray) -> Mask:
    """Tell where a step is longer than what `Pace.reach` allows, all before it being taken."""
    limits, dt = pace.limits, np.minimum(elapsed, LONGEST_STEP)
    if limits.acceleration == inf:
        way = limits.slew * dt
        return np.asarray((v < before - way) | (v > before + way))
    rate, change = _rates_before(pace, v - before, elapsed), limits.acceleration * dt
    up = np.minimum(np.minimum(rate + change, limits.slew) * dt, _braking_way(pace, limits.upper - before, dt))
    down = np.maximum(np.maximum(rate - change, -limits.slew) * dt, -_braking_way(pace, before - limits.lower, dt))
    return np.asarray((v < before + down) | (v > before + up))


def _rates_before(pace: Pace, steps: FloatArray, elapsed: FloatArray) -> FloatArray:
    """Return the rate (V/s) before each step (V), as `Pace` remembers it."""
    rates, dt = np.full(steps.size, pace.rate), np.minimum(elapsed[:-1], LONGEST_STEP)
    # Only the first step may take no time.
    np.divide(steps[:-1], dt, out=rates[1:], where=dt > 0.0)
    rates[elapsed > LONGEST_STEP] = 0.0
    return rates


def _braking_way(pace: Pace, distance: FloatArray, dt: FloatArray) -> FloatArray:
    """Return what `Pace` does: the longest steps (V) after which the voltage can still stop within a distance (V)."""
    acceleration, distance = pace.limits.acceleration, np.maximum(distance, 0.0)
    return np.minimum(acceleration * dt * (np.sqrt(dt * dt + 2.0 * distance / acceleration) - dt), distance)


def _one_by_one(stream: AxisStream, y: FloatArray, elapsed: FloatArray) -> tuple[list[float], list[bool], list[float]]:
    """Move through `y`; return the voltages, where a displacement was missed, and those reached."""
    v, late, reached = [], [], []
    for wish, dt in zip(y.tolist(), elapsed.tolist(), strict=True):
        v.append(stream.move(stream.pace.counted(dt), wish))
        late.append(stream.missed)
        reached.append(stream.memory.displacement)
    return v, late, reached
