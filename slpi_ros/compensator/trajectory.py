"""A trajectory: a path known in advance.

Every point is one command sample, given at its own time. There is no interpolation, neither between points nor from
the present displacement to the first one (in joint_trajectory_controller: interpolation method ``none``): where the
path is farther away than the slew limit allows, the voltage goes there at the slew limit.
"""

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from math import inf
from typing import Any, Generic, NamedTuple, Protocol, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from slpi_ros.compensator import validation as rejection
from slpi_ros.compensator.axis import Axis
from slpi_ros.compensator.model_swap import whole_way
from slpi_ros.compensator.validation import NOT_FINITE, TIME_BACKWARDS, RejectedError, require_names
from slpi_ros.effects.cross_coupling import Coupling
from slpi_ros.errors import SlpiError
from slpi_ros.io.messages import SECOND_NS
from slpi_ros.model.axis_model import AxisModel
from slpi_ros.model.limits import MAX_DT, Limits, RateLimiter
from slpi_ros.model.streaming import ROUNDING, StageStream, StreamingInverse, accepted_range, refusal

FloatArray = NDArray[np.float64]
TimeArray = NDArray[np.int64]


@dataclass(frozen=True)
class Trajectory:
    """Desired displacements of some axes at given times, as `Trajectory.of` checked them.

    Parameters
    ----------
    names : tuple of str, length K
    time_from_start_ns : ndarray of int64, shape (N,), nanoseconds
        Strictly increasing, N >= 1.
    positions : ndarray, shape (N, K), metres
    start_ns : int, nanoseconds
        0: at once. A clock that counts from the machine's start may have been negative then.
    cut : int
        Number of earlier points left out: their time had passed.
    """

    names: tuple[str, ...]
    time_from_start_ns: TimeArray
    positions: FloatArray
    start_ns: int
    cut: int = 0

    @classmethod
    def of(
        cls,
        names: Sequence[str],
        time_from_start_ns: ArrayLike,
        positions: ArrayLike,
        start_ns: int = 0,
        *,
        axes: Sequence[str],
    ) -> "Trajectory":
        """Return a checked trajectory; arrays are not copied.

        Parameters
        ----------
        names : sequence of str, length K
            Some of `axes`, in any order.
        time_from_start_ns : array_like of int, shape (N,), nanoseconds
        positions : array_like, shape (N, K), metres
        start_ns : int, nanoseconds
        axes : sequence of str
            All there are.

        Raises
        ------
        RejectedError
            If names, shapes, times or positions make no sense; the first bad point is named.
        """
        require_names(names, axes)
        times, places = _as_array(time_from_start_ns), _as_array(positions, np.float64)
        if not times.size:
            raise RejectedError(rejection.EMPTY, "the trajectory has no points; give at least one")
        if times.ndim != 1 or places.shape != (times.size, len(names)):
            what = f"{len(names)} axes, times of shape {times.shape}, positions of shape {places.shape}"
            raise RejectedError(rejection.LENGTH, f"{what}; give each point a time and a number for each axis")
        check_times(times, start_ns)
        finite = np.isfinite(places)
        if not finite.all():
            point, column = (int(i) for i in np.unravel_index(np.argmin(finite), finite.shape))
            what = f"axis '{names[column]}', point {point}: displacement is {places[point, column]} m"
            raise RejectedError(rejection.NOT_FINITE, f"{what}; send finite ones only")
        return cls(tuple(names), times.astype(np.int64, copy=False), places, start_ns)

    def __len__(self) -> int:
        """Return the number of points."""
        return self.time_from_start_ns.size

    def useful_at(self, now_ns: int) -> "Trajectory":
        """Return the part whose time has not passed; all of it if it starts at once.

        Raises
        ------
        RejectedError
            If nothing is left.
        """
        first = int(np.searchsorted(self.time_from_start_ns, now_ns - self.start_ns)) if self.start_ns else 0
        if first == len(self):
            ago = (now_ns - self.start_ns - int(self.time_from_start_ns[-1])) / SECOND_NS
            raise RejectedError(
                rejection.STALE, f"the trajectory ended {ago:.9g} s ago; send it earlier, or stamp it 0"
            )
        times, places = self.time_from_start_ns[first:], self.positions[first:]
        return replace(self, time_from_start_ns=times, positions=places, cut=self.cut + first)

    def deadlines_ns(self, now_ns: int) -> TimeArray:
        """Return when its points are due, shape (N,), nanoseconds, if it is accepted now."""
        return self.time_from_start_ns + (self.start_ns or now_ns)


def _as_array(values: ArrayLike, dtype: type | None = None) -> NDArray[Any]:
    try:
        return np.asarray(values, dtype)
    except (TypeError, ValueError, OverflowError) as error:
        raise RejectedError(rejection.LENGTH, f"the points are no array of numbers: {error}") from None


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


def follow(stream: StreamingInverse, y: FloatArray, elapsed: FloatArray) -> tuple[FloatArray, Mask, FloatArray]:
    """Move an axis through displacements, as `AxisStream.move` does one by one.

    In blocks where the path is slow enough, sample by sample where it is not.

    Parameters
    ----------
    stream : AxisStream
    y : ndarray, shape (N,), metres
    elapsed : ndarray, shape (N,), seconds
        Since the sample before. A pause longer than `MAX_DT` counts as that, and the axis starts from rest.

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


def _until_too_fast(stream: StreamingInverse, y: FloatArray, elapsed: FloatArray, reached: FloatArray) -> FloatArray:
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
        stream.pace.moved(last - float(before[free - 1]), min(float(elapsed[free - 1]), MAX_DT))
    return v[:free]


def _too_fast(pace: RateLimiter, v: FloatArray, before: FloatArray, elapsed: FloatArray) -> Mask:
    """Tell where a step is longer than what `Pace.reach` allows, all before it being taken."""
    limits, dt = pace.limits, np.minimum(elapsed, MAX_DT)
    if limits.acceleration == inf:
        way = limits.slew * dt
        return np.asarray((v < before - way) | (v > before + way))
    rate, change = _rates_before(pace, v - before, elapsed), limits.acceleration * dt
    up = np.minimum(np.minimum(rate + change, limits.slew) * dt, _braking_way(pace, limits.upper - before, dt))
    down = np.maximum(np.maximum(rate - change, -limits.slew) * dt, -_braking_way(pace, before - limits.lower, dt))
    return np.asarray((v < before + down) | (v > before + up))


def _rates_before(pace: RateLimiter, steps: FloatArray, elapsed: FloatArray) -> FloatArray:
    """Return the rate (V/s) before each step (V), as `RateLimiter` remembers it."""
    rates, dt = np.full(steps.size, pace.rate), np.minimum(elapsed[:-1], MAX_DT)
    # Only the first step may take no time.
    np.divide(steps[:-1], dt, out=rates[1:], where=dt > 0.0)
    rates[elapsed > MAX_DT] = 0.0
    return rates


def _braking_way(pace: RateLimiter, distance: FloatArray, dt: FloatArray) -> FloatArray:
    """Return what `RateLimiter` does: the longest steps (V) that can still stop within a distance (V)."""
    acceleration, distance = pace.limits.acceleration, np.maximum(distance, 0.0)
    return np.minimum(acceleration * dt * (np.sqrt(dt * dt + 2.0 * distance / acceleration) - dt), distance)


def _one_by_one(
    stream: StreamingInverse, y: FloatArray, elapsed: FloatArray
) -> tuple[list[float], list[bool], list[float]]:
    """Move through `y`; return the voltages, where a displacement was missed, and those reached."""
    v, late, reached = [], [], []
    for wish, dt in zip(y.tolist(), elapsed.tolist(), strict=True):
        v.append(stream.move(stream.pace.clamp_dt(dt), wish))
        late.append(stream.missed)
        reached.append(stream.memory.displacement)
    return v, late, reached


def follow_together(
    streams: Mapping[str, StreamingInverse],
    models: Mapping[str, AxisModel],
    paths: Mapping[str, FloatArray],
    elapsed: Mapping[str, FloatArray],
) -> dict[str, tuple[FloatArray, Mask, Mask]]:
    """Move axes through displacements, each as `AxisStream.move` does; a delay is undone by preview.

    Parameters
    ----------
    streams : mapping of axis name to AxisStream
        All axes of the stage; those that have no path stay.
    models : mapping of axis name to AxisModel
        Of all axes.
    paths : mapping of axis name to ndarray, shape (N,), metres
    elapsed : mapping of axis name to ndarray, shape (N,), seconds
        Since the point before.

    Returns
    -------
    dict of axis name to (ndarray, ndarray of bool, ndarray of bool), shape (N,) each
        Voltages (V), where the axis waits at a voltage limit, and where it is still on its way.

    Raises
    ------
    SlpiError
        It names the axis.
    """
    coupling = Coupling({name: models[name].chain.gains for name in streams})
    stage = StageStream(streams, coupling, {name: models[name].start.displacement for name in streams})
    ahead = {name: _previewed(models[name].chain.delay, path, elapsed[name]).tolist() for name, path in paths.items()}
    steps = {name: each.tolist() for name, each in elapsed.items()}
    answers = {
        name: (np.empty(path.size), np.zeros(path.size, bool), np.zeros(path.size, bool))
        for name, path in paths.items()
    }
    for k in range(len(next(iter(ahead.values())))):
        stage.decouple({name: path[k] for name, path in ahead.items()})
        for name, (v, held, slewed) in answers.items():
            stream = streams[name]
            try:
                v[k] = _move(stream, steps[name][k], ahead[name][k])
            except SlpiError as error:
                raise type(error)(f"axis '{name}': {error}") from None
            held[k] = stream.held
            slewed[k] = stream.missed and not held[k]
    return answers


def drive_through(stream: StreamingInverse, voltages: FloatArray, elapsed: FloatArray) -> None:
    """Move an axis through voltages, shape (N,), volts, each `elapsed` (s) after the one before."""
    for voltage, seconds in zip(voltages.tolist(), elapsed.tolist(), strict=True):
        dt = min(seconds, MAX_DT)
        stream.wait(seconds - dt)
        stream.drive(voltage, dt)


def _move(stream: StreamingInverse, elapsed: float, wish: float) -> float:
    dt = stream.pace.clamp_dt(elapsed)
    if elapsed > dt:
        stream.wait(elapsed - dt)
    return stream.move(dt, wish)


def _previewed(delay: float, path: FloatArray, elapsed: FloatArray) -> FloatArray:
    """Return the path, shape (N,), metres, as it is a delay (s) later."""
    t = np.cumsum(elapsed)
    return np.interp(t + delay, t, path) if delay else path


AxisPlan = tuple[FloatArray, Mask, Mask]


@dataclass(frozen=True)
class Standing:
    """Where an axis stands when a trajectory takes over.

    Parameters
    ----------
    model : AxisModel
    axis : AxisStream
        The live axis, which is only read.
    since_ns : int, nanoseconds
        When it was given its present voltage.
    """

    model: AxisModel
    axis: StreamingInverse
    since_ns: int

    def after(self, voltages: FloatArray, times_ns: TimeArray) -> "Standing":
        """Return where the axis stands once given voltages, shape (M,), volts, at times, shape (M,), M >= 1."""
        last, at_ns = float(voltages[-1]), int(times_ns[-1])
        before = float(voltages[-2]) if voltages.size > 1 else self.axis.voltage
        axis, elapsed = self.axis.copy(), seconds_between(times_ns, self.since_ns)
        if axis.timeless:
            axis.memory.forward_array(voltages)
            axis.drive(last)
        else:
            drive_through(axis, voltages, elapsed)
        axis.pace.moved(last - before, min(float(elapsed[-1]), MAX_DT))
        return replace(self, axis=axis, since_ns=at_ns)


@dataclass(frozen=True)
class Origin:
    """Where a plan expects an axis when it takes over.

    Parameters
    ----------
    axis : AxisStream
        The live axis of the time when the plan was made.
    limits : Limits
        At that time.
    went_through : tuple of float, volts
        What its memory will know by then, and last its voltage.
    """

    axis: StreamingInverse
    limits: Limits
    reversal_voltages: tuple[float, ...]

    def is_of(self, axis: StreamingInverse) -> bool:
        """Whether neither model nor limits have changed since."""
        return axis is self.axis and axis.limits == self.limits

    def is_here(self, axis: StreamingInverse) -> bool:
        """Whether the axis stands as expected, but for rounding."""
        here, there = whole_way(axis), self.reversal_voltages
        scale = ROUNDING * (1.0 + max(map(abs, there)))
        return len(here) == len(there) and all(abs(a - b) <= scale for a, b in zip(here, there, strict=True))


@dataclass(frozen=True)
class Plan:
    """A trajectory in volts.

    Parameters
    ----------
    trajectory : Trajectory
    voltages : ndarray, shape (N, K), volts
    held : ndarray of bool, shape (N, K)
        Where a displacement is out of reach: the axis waits at a voltage limit.
    slewed : ndarray of bool, shape (N, K)
        Where the axis is still on its way, at the slew limit.
    origins : mapping of axis name to Origin
        Of the axes that it reckons with.
    """

    trajectory: Trajectory
    voltages: FloatArray
    held: Mask
    slewed: Mask
    origins: Mapping[str, Origin]

    @property
    def at_once(self) -> bool:
        """Whether it takes over when it is accepted, not at the time of its first point."""
        return not self.trajectory.start_ns

    def deadlines_ns(self, now_ns: int) -> TimeArray:
        """Return when its points are due, shape (N,), nanoseconds, if it is accepted now."""
        return self.trajectory.deadlines_ns(now_ns)


def prepare(
    trajectory: Trajectory, standing: Mapping[str, Standing], now_ns: int, running: Streamer[Plan] | None = None
) -> Plan:
    """Return the plan of a trajectory that arrives now; nothing moves, whatever becomes of it.

    Parameters
    ----------
    trajectory : Trajectory
        Points whose time has passed are left out.
    standing : mapping of axis name to Standing
        The axes as they are now.
    now_ns : int, nanoseconds
        A trajectory without start may be started later; that does no harm.
    running : Streamer of Plan
        Its points go on until the first one of the new trajectory is due, unless that starts at once.

    Raises
    ------
    SlpiError
        If all of it is in the past, a displacement is far out of reach, or a model cannot follow from where it stands.
    """
    trajectory = trajectory.useful_at(now_ns)
    deadlines = trajectory.deadlines_ns(now_ns)
    expected = {name: standing[name] for name in _reckoned_with(trajectory.names, standing)}
    for stretch in running.before(int(deadlines[0])) if running and trajectory.start_ns else []:
        still = slice(stretch.next, stretch.stop)
        for column, name in enumerate(stretch.points.trajectory.names):
            if name in expected:
                voltages = stretch.points.voltages[still, column]
                expected[name] = expected[name].after(voltages, stretch.deadlines_ns[still])
    origins = {
        name: Origin(standing[name].axis, standing[name].axis.limits, whole_way(there.axis))
        for name, there in expected.items()
    }
    return Plan(trajectory, *_compensate(trajectory, deadlines, {**standing, **expected}), origins)


def _compensate(trajectory: Trajectory, deadlines: TimeArray, standing: Mapping[str, Standing]) -> AxisPlan:
    shape = trajectory.positions.shape
    v, held, slewed = np.empty(shape, order="F"), np.empty(shape, np.bool_, "F"), np.empty(shape, np.bool_, "F")
    paths = {name: np.ascontiguousarray(trajectory.positions[:, i]) for i, name in enumerate(trajectory.names)}
    for name, y in paths.items():
        _check_reachable(name, standing[name].model, y, trajectory.cut)
    together = _with_effects(paths, deadlines, standing)
    for column, (name, y) in enumerate(paths.items()):
        if name in together:
            v[:, column], held[:, column], slewed[:, column] = together[name]
            continue
        here = standing[name]
        elapsed = seconds_between(deadlines, here.since_ns)
        try:
            answer = _from_memory(here.model, here.axis, y, elapsed)
        except SlpiError as error:
            raise type(error)(f"axis '{name}': {error}") from None
        v[:, column], held[:, column], slewed[:, column] = answer
    return v, held, slewed


def _move_along(names: Iterable[str], standing: Mapping[str, Standing]) -> bool:
    """Whether axes may move along with each other."""
    return any(not standing[name].axis.timeless for name in names)


def _reckoned_with(names: Sequence[str], standing: Mapping[str, Standing]) -> Iterable[str]:
    """Return the names of the axes on which a path of the named ones depends."""
    return standing if _move_along(names, standing) else names


def _with_effects(
    paths: Mapping[str, FloatArray], deadlines: TimeArray, standing: Mapping[str, Standing]
) -> dict[str, AxisPlan]:
    """Return the plans of the axes if time matters to any of them; they may move along with each other."""
    if not _move_along(paths, standing):
        return {}
    return follow_together(
        {name: here.axis.copy() for name, here in standing.items()},
        {name: here.model for name, here in standing.items()},
        paths,
        {name: seconds_between(deadlines, standing[name].since_ns) for name in paths},
    )


def _from_memory(model: AxisModel, axis: StreamingInverse, y: FloatArray, elapsed: FloatArray) -> AxisPlan:
    v, late, reached = follow(axis.copy(), y, elapsed)
    missing, (low, high) = y - reached, model.displacement_range
    # At a limit a wish may just be met, or lie on this side of it.
    rounding = ROUNDING * (high - low)
    held = (v <= axis.limits.lower) & (missing < -rounding) | (v >= axis.limits.upper) & (missing > rounding)
    return v, held, late & ~held


def _check_reachable(name: str, model: AxisModel, y: FloatArray, cut: int) -> None:
    accepted = accepted_range(model.displacement_range)
    if (far := (y < accepted[0]) | (y > accepted[1])).any():
        at = int(np.argmax(far))
        what = f"axis '{name}', point {cut + at}: {refusal(float(y[at]), accepted)}"
        raise RejectedError(rejection.OUT_OF_RANGE, what)


class Following:
    """Moves axes along trajectories. All times are nanoseconds on one clock.

    While nothing comes in between, the voltages are those that were planned. Once something has - another model, new
    limits, points that were too late, a path before it that became another - the rest of the path is compensated sample
    by sample, from where the axes really are.

    Parameters
    ----------
    axes : mapping of name to Axis
    decouple : callable, optional
        Told the desired displacements (m) by axis name before the axes move there.

    Attributes
    ----------
    points_held, points_slewing : int
        Of the last plan: at a voltage limit, or still on their way.
    """

    def __init__(self, axes: Mapping[str, Axis], decouple: Callable[[Mapping[str, float]], None] | None = None) -> None:
        self._axes, self._decouple = axes, decouple
        self._streamer: Streamer[Plan] = Streamer()
        self._plan: Plan | None = None
        self._as_planned = False
        self._now: Callable[[], int] = int
        self._last_ns = dict.fromkeys(axes, 0)
        self.points_held = self.points_slewing = 0

    @property
    def on(self) -> bool:
        """Whether points are still to come."""
        return self._streamer.next_deadline_ns is not None

    @property
    def remaining(self) -> int:
        """Points still to come."""
        return self._streamer.remaining

    @property
    def skipped(self) -> int:
        """Points that came too late so far."""
        return self._streamer.skipped

    @property
    def next_deadline_ns(self) -> int | None:
        """When the next point is due, nanoseconds; None: there is none."""
        return self._streamer.next_deadline_ns

    @property
    def names(self) -> set[str]:
        """Axes that have points to come."""
        return {name for plan in self._streamer.coming for name in plan.trajectory.names}

    @property
    def under_way(self) -> bool:
        """Whether the next point is not the first of its trajectory."""
        return self.on and self._streamer.coming[0] is self._plan

    @property
    def doing(self) -> str:
        """What is being done with a trajectory; "" without one."""
        if not self.on:
            return ""
        wait = ((self.next_deadline_ns or 0) - self._now()) * 1e-9
        if wait < 1.0:
            return "following a trajectory"
        return f"waiting for a trajectory that {'goes on' if self._plan else 'begins'} in {wait:.0f} s"

    @property
    def busy(self) -> str:
        """Why desired displacements have to wait, and what to do."""
        return f"{self.doing}; wait, or cancel it with an empty one"

    def start(
        self, trajectory: Trajectory, now: Callable[[], int], given_ns: int, driven: Collection[str] = ()
    ) -> None:
        """Let a trajectory take over from what is being followed: at once, or when its first point is due.

        Parameters
        ----------
        trajectory : Trajectory
        now : callable
            Returns the time, nanoseconds. A long trajectory takes a while to compensate; one that starts at once starts
            after that.
        given_ns : int, nanoseconds
            When axes that no trajectory moves were given their voltage.
        driven : collection of str
            Axes that something else moves meanwhile.

        Raises
        ------
        SlpiError
            If it cannot be followed; what was being followed goes on.
        """
        self._last_ns.update(dict.fromkeys(driven if self.on else self._axes, given_ns))
        standing = {
            name: Standing(axis.model, axis.stream, self._last_ns[name])
            for name, axis in self._axes.items()
            if axis.model
        }
        plan = prepare(trajectory, standing, now(), self._streamer)
        self._now = now
        self.points_held, self.points_slewing = (int(mask.any(axis=1).sum()) for mask in (plan.held, plan.slewed))
        self._streamer.start(plan, now())

    def stop(self) -> None:
        """Leave the axes where they are, and take up desired displacements from there."""
        if not self.on and self._plan is None:
            return
        self._streamer.cancel()
        self._plan = None
        for axis in self._axes.values():
            axis.stamps.restart()

    def step(self, now_ns: int) -> int | None:
        """Move on to the latest point that is due; return its deadline (ns), None when none is due."""
        due = self._streamer.due(now_ns)
        if due is None:
            return None
        self._enter(due)
        plan, point = due.points, due.point
        if self._decouple:
            self._decouple(dict(zip(plan.trajectory.names, plan.trajectory.positions[point].tolist(), strict=True)))
        for column, name in enumerate(plan.trajectory.names):
            ahead = (due.deadline_ns - self._last_ns[name]) * 1e-9
            self._last_ns[name] = due.deadline_ns
            self._move(self._axes[name], plan, point, column, ahead)
        if not self.on:
            self.stop()
        return due.deadline_ns

    def _enter(self, due: Due[Plan]) -> None:
        """Notice what makes the plan no longer hold."""
        here = [(origin, self._axes[name].stream) for name, origin in due.points.origins.items()]
        if due.points is not self._plan:
            self._plan = due.points
            self._as_planned = all(origin.is_here(stream) for origin, stream in here)
        if due.skipped or not all(origin.is_of(stream) for origin, stream in here):
            self._as_planned = False

    def _move(self, axis: Axis, plan: Plan, point: int, column: int, ahead: float) -> None:
        wish = float(plan.trajectory.positions[point, column])
        if not self._as_planned:
            axis.move(ahead, wish)
            return
        planned = float(plan.voltages[point, column])
        before = float(plan.voltages[point - 1, column]) if point else axis.stream.voltage
        axis.follow(ahead, wish, planned, before)
        limits = axis.stream.limits
        width = limits.upper - limits.lower if limits.upper - limits.lower < inf else 1.0
        if abs(axis.stream.voltage - planned) > ROUNDING * width:
            self._as_planned = False
