"""Trajectories: validated as a whole on arrival, then output at the output rate, linear between points."""

from bisect import bisect_left
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from slpi_ros.arrays import FloatArray, IntArray
from slpi_ros.compensator import validation as rejection
from slpi_ros.compensator.validation import RejectedError, require_names
from slpi_ros.io.messages import SECOND_NS
from slpi_ros.model.limits import PERIOD, Limits, RateLimiter
from slpi_ros.model.streaming import StreamingInverse, refusal

# Upper limit of valid times; the sum of two times does not overflow int64.
LATEST_NS = 2**62
# Points of a trajectory that are looked at before it begins, and with each sample of it: some microseconds each.
CHECKED_FIRST, CHECKED_LATER = 500, 50


@dataclass(frozen=True)
class Trajectory:
    """Desired displacements of some axes at given times, validated by `Trajectory.of`."""

    names: tuple[str, ...]
    time_from_start_ns: IntArray  # (N,), strictly increasing
    positions: FloatArray  # m, (N, names)
    start_ns: int  # 0: at once; may be negative if the clock counts from the start of the machine
    cut: int = 0  # earlier points discarded because their time had passed

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
        """Return a validated trajectory of some of the `axes`, in any order; arrays are not copied."""
        require_names(names, axes)
        times, places = _as_array(time_from_start_ns), _as_array(positions, np.float64)
        if not times.size:
            raise RejectedError(rejection.EMPTY, "the trajectory has no points; give at least one")
        if times.ndim != 1 or places.shape != (times.size, len(names)):
            what = f"{len(names)} axes, times of shape {times.shape}, positions of shape {places.shape}"
            raise RejectedError(rejection.LENGTH, f"{what}; give each point a time and a number for each axis")
        _check_times(times, start_ns)
        finite = np.isfinite(places)
        if not finite.all():
            point, column = (int(i) for i in np.unravel_index(np.argmin(finite), finite.shape))
            what = f"axis '{names[column]}', point {point}: displacement is {places[point, column]} m"
            raise RejectedError(rejection.NOT_FINITE, f"{what}; send finite values only")
        return cls(tuple(names), times.astype(np.int64, copy=False), places, start_ns)

    def __len__(self) -> int:
        return self.time_from_start_ns.size

    def check_reach(self, accepted: Mapping[str, tuple[float, float]]) -> None:
        """Reject displacements outside the accepted range (m) of each axis; the message names the first one."""
        for column, name in enumerate(self.names):
            y, (low, high) = self.positions[:, column], accepted[name]
            if y.min() < low or y.max() > high:
                at = int(np.argmax((y < low) | (y > high)))
                what = f"axis '{name}', point {self.cut + at}: {refusal(float(y[at]), accepted[name])}"
                raise RejectedError(rejection.OUT_OF_RANGE, what)

    def useful_at(self, now_ns: int) -> "Trajectory":
        """Return the trajectory without the points before `now_ns` (ns), or with all points if `start_ns` is 0."""
        first = int(np.searchsorted(self.time_from_start_ns, now_ns - self.start_ns)) if self.start_ns else 0
        if first == len(self):
            ago = (now_ns - self.start_ns - int(self.time_from_start_ns[-1])) / SECOND_NS
            raise RejectedError(
                rejection.STALE, f"the trajectory ended {ago:.9g} s ago; send it earlier, or stamp it 0"
            )
        times, places = self.time_from_start_ns[first:], self.positions[first:]
        return replace(self, time_from_start_ns=times, positions=places, cut=self.cut + first)


def _as_array(values: ArrayLike, dtype: type | None = None) -> NDArray[Any]:
    try:
        return np.asarray(values, dtype)
    except (TypeError, ValueError, OverflowError) as error:
        raise RejectedError(rejection.LENGTH, f"the points are not an array of numbers: {error}") from None


def _check_times(times: NDArray[Any], start_ns: int) -> None:
    """Reject times since the start (ns), shape (N,), N >= 1, that are not integers, too large or not increasing."""
    if times.dtype.kind not in "iu":
        raise RejectedError(rejection.NOT_FINITE, f"times are of type {times.dtype}; give whole nanoseconds")
    if abs(start_ns) >= LATEST_NS or times.max() >= LATEST_NS:
        what = f"start {start_ns} ns, last point after {times.max()} ns"
        raise RejectedError(
            rejection.TIME_BACKWARDS, f"{what}: these are not valid times; correct the stamp and the times"
        )
    back = np.concatenate([[times[0] < 0], times[1:] <= times[:-1]])
    if back.any():
        at = int(np.argmax(back))
        before = f"point {at - 1} at {times[at - 1] / SECOND_NS:.9g} s" if at else "the start"
        what = f"point {at} at {times[at] / SECOND_NS:.9g} s does not come after {before}"
        raise RejectedError(rejection.TIME_BACKWARDS, f"{what}; sort the points, and give each its own time")


class Point(NamedTuple):
    """The sample of a trajectory to output now."""

    names: tuple[str, ...]
    displacements: list[float]  # m, of the axes `names`
    deadline_ns: int
    between: bool = False  # interpolated, not a point of the trajectory


@dataclass(eq=False)
class _Track:
    """Points of one trajectory for all axes with the same delay, executed in order."""

    names: tuple[str, ...]
    positions: FloatArray  # m, (N, names)
    deadlines_ns: memoryview  # access to single elements of an array is several times slower
    next: int  # the points ``next:stop`` are pending
    since_ns: int  # the last sample, from which the next point is approached; at first the begin
    period_ns: int
    place: Callable[[str], float] | None  # see `TrajectoryExecutor`
    counted: bool  # by `TrajectoryExecutor.remaining`: only one track of each trajectory is
    since: list[float] | None = None  # m, the last sample; None: none has been output yet

    def __post_init__(self) -> None:
        self.stop = len(self.deadlines_ns)
        self._aim()

    def _aim(self) -> None:
        """Set the deadlines (ns) of the next point and of the next sample, which is on the way to it."""
        self.deadline_ns = self.deadlines_ns[self.next]
        self._way_ns = self.deadline_ns - self.since_ns
        stays = self.since is None and self.place is None
        self._pieces = 1 if stays else max(round(self._way_ns / self.period_ns), 1)
        self.next_ns = self.since_ns + self._way_ns // self._pieces

    def until(self, time_ns: int) -> int:
        """Return the index of the first pending point that is due at `time_ns` or later."""
        return bisect_left(self.deadlines_ns, time_ns, self.next, self.stop)

    def take(self, now_ns: int) -> tuple[Point, int]:
        """Return the latest sample that is due, and the number of earlier pending points, which are skipped."""
        skipped = 0
        if now_ns < self.deadline_ns:
            point = self._between(now_ns)
        else:
            last = self.next
            self.next += 1
            if self.next < self.stop and self.deadlines_ns[self.next] <= now_ns:
                self.next = self.until(now_ns + 1)
                skipped, last = self.next - 1 - last, self.next - 1
            point = Point(self.names, self.positions[last].tolist(), self.deadlines_ns[last])
        self.since_ns, self.since = point.deadline_ns, point.displacements
        if self.next < self.stop:
            self._aim()
        return point, skipped

    def _between(self, now_ns: int) -> Point:
        """Return the latest interpolated sample that is due before the next point."""
        since = self.since
        if since is None:
            assert self.place
            since = [self.place(name) for name in self.names]
        piece = max((now_ns - self.since_ns) * self._pieces // self._way_ns, 1)
        ahead_ns = self._way_ns * piece // self._pieces
        share, goal = ahead_ns / self._way_ns, self.positions[self.next].tolist()
        places = [y + share * (end - y) for y, end in zip(since, goal, strict=True)]
        return Point(self.names, places, self.since_ns + ahead_ns, between=True)


class TrajectoryExecutor:
    """Return the samples of trajectories at absolute deadlines: a late call does not delay the following ones."""

    # Points that are further apart than the output period are interpolated. A new trajectory replaces the current
    # points as in joint_trajectory_controller: at once, or, if it starts in the future, from its start on. Any number
    # of trajectories may be pending. All times are nanoseconds on the same clock, which the caller chooses. `place`
    # returns the displacement (m) of an axis, from which the first point is approached; else an axis stays until then.
    def __init__(self, period: float = PERIOD, place: Callable[[str], float] | None = None) -> None:
        self.period, self._place = period, place
        self.skipped = 0  # points, because a later one was already due
        self.crowded = 0  # of these, closer together than the output period
        self.too_fast = ""  # the first point that the slew limit will make late; "" if none is known
        self.refused = ""  # why another model canceled the last one; "" if none did
        self._tracks: list[_Track] = []
        self._ahead: Iterator[str] = iter(())  # see `_look_ahead`

    @property
    def on(self) -> bool:
        """Whether points are pending."""
        return bool(self._tracks)

    @property
    def remaining(self) -> int:
        """Number of trajectory points that are not due yet."""
        return sum(track.stop - track.next for track in self._tracks if track.counted)

    @property
    def next_deadline_ns(self) -> int | None:
        """Deadline of the next sample, nanoseconds; None if no point is pending."""
        # Asked for several times a message, mostly without a trajectory.
        return min([track.next_ns for track in self._tracks]) if self._tracks else None

    @property
    def moving(self) -> set[str]:
        """Names of the axes that are on their way along a trajectory."""
        return {name for track in self._tracks if track.since for name in track.names}

    def start(
        self,
        trajectory: Trajectory,
        now_ns: int,
        delays: Mapping[str, float] | None = None,
        streams: Mapping[str, StreamingInverse] | None = None,
    ) -> None:
        """Start a trajectory at once, or when its first point is due; RejectedError if all points are in the past.

        `delays` (s) advance the deadlines of an axis; of the points in the past the last one is executed. With the
        inverses `streams` of its axes, the points that their slew limits will make late are looked for.
        """
        useful = trajectory.useful_at(now_ns)
        due = useful.time_from_start_ns + (trajectory.start_ns or now_ns)
        shifts = {name: round((delays or {}).get(name, 0.0) * SECOND_NS) for name in useful.names}
        tracks: list[_Track] = []
        for shift in sorted(set(shifts.values())):
            columns = [i for i, name in enumerate(useful.names) if shifts[name] == shift]
            deadlines = due - shift if shift else due
            first = min(int(np.searchsorted(deadlines, now_ns)), due.size - 1)
            positions = useful.positions if len(columns) == len(useful.names) else useful.positions[:, columns]
            names = tuple(useful.names[i] for i in columns)
            begin_ns = max(trajectory.start_ns - shift, now_ns) if trajectory.start_ns else now_ns
            period_ns, counted = round(self.period * SECOND_NS), not tracks
            tracks.append(_Track(names, positions, deadlines.data, first, begin_ns, period_ns, self._place, counted))
        begin_ns = min(track.next_ns for track in tracks)
        kept = self._tracks if trajectory.start_ns else []
        for track in kept:
            track.stop = track.until(begin_ns) if track.next_ns < begin_ns else track.next
        self._tracks = [*(track for track in kept if track.next < track.stop), *tracks]
        wait = (trajectory.start_ns - now_ns) * 1e-9 if trajectory.start_ns else 0.0
        self.too_fast = self.refused = ""
        self._ahead = _look_ahead(trajectory, streams, wait, self.period) if streams else iter(())
        self.look_ahead()

    def look_ahead(self) -> None:
        """Look at the next points: whether the slew limit will make one late (`too_fast`)."""
        self.too_fast = self.too_fast or next(self._ahead, "")

    def recheck(self, accepted: Mapping[str, tuple[float, float]]) -> bool:
        """Cancel all if what is pending leaves the range (m) that another model accepts of an axis; return whether."""
        for track in self._tracks:
            # The way to the next point begins at the last sample.
            rows = track.positions[track.next : track.stop]
            rows = rows if track.since is None else np.vstack((track.since, rows))
            for name, y in zip(track.names, rows.T, strict=True):
                low, high = accepted[name]
                beyond = y[(y < low) | (y > high)]
                if beyond.size:
                    self.cancel()
                    why = refusal(float(beyond[0]), accepted[name])
                    self.refused = f"trajectory canceled by another model: axis '{name}': {why}"
                    return True
        return False

    def cancel(self) -> None:
        """Discard all pending points."""
        self._tracks, self._ahead = [], iter(())

    def due(self, now_ns: int) -> Point | None:
        """Return the latest point that is due and not yet returned, or None; to be called until it returns None."""
        # Earlier points of the same track are skipped. Every track is returned separately, as it may move other axes.
        if not self._tracks:
            return None
        track = self._tracks[0] if len(self._tracks) == 1 else min(self._tracks, key=lambda each: each.next_ns)
        if now_ns < track.next_ns:
            return None
        first_ns = track.deadline_ns
        point, skipped = track.take(now_ns)
        if skipped and track.counted:
            self.skipped += skipped
            if point.deadline_ns - first_ns < skipped * round(self.period * SECOND_NS):
                self.crowded += skipped
        if track.next == track.stop:
            self._tracks.remove(track)
        return point


def _look_ahead(
    trajectory: Trajectory, streams: Mapping[str, StreamingInverse], wait: float, period: float
) -> Iterator[str]:
    """Look at the next points of each axis with every step, and yield "" until one is late, which is told at last.

    Late is what the slew limit makes late by more than two periods (s); the trajectory begins after `wait` (s).
    """
    limits = {name: streams[name].limits for name in trajectory.names if np.isfinite(streams[name].limits.slew)}
    copies = {name: streams[name].copy() for name in limits}
    for name, stream in copies.items():
        stream.pace = RateLimiter(Limits(limits[name].lower, limits[name].upper), period, stream.voltage)
    voltages = {name: stream.voltage for name, stream in copies.items()}
    begin_ns, first, points = -round(max(wait, 0.0) * SECOND_NS), 0, CHECKED_FIRST
    while copies and first < len(trajectory):
        part = slice(first, first + points)
        times = trajectory.time_from_start_ns[part].tolist()
        for name, stream in copies.items():
            last_ns, slew, voltage = begin_ns, limits[name].slew, voltages[name]
            places = trajectory.positions[part, trajectory.names.index(name)].tolist()
            for number, (time_ns, y) in enumerate(zip(times, places, strict=True), first):
                dt = (time_ns - last_ns) * 1e-9
                last_ns = time_ns
                goal = stream.move(dt, y, time_ns)
                voltage += min(max(goal - voltage, -slew * dt), slew * dt)
                late = abs(goal - voltage) / slew
                if late > 2.0 * period:
                    yield (
                        f"too fast for slew_limit {slew:g} V/s: axis '{name}', point {trajectory.cut + number} at "
                        f"{time_ns / SECOND_NS:.6g} s will be late by {late:.3g} s"
                    )
                    return
            voltages[name] = voltage
        yield ""
        begin_ns, first, points = times[-1], part.stop, CHECKED_LATER
