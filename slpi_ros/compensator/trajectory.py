"""Trajectories: checked as a whole when they arrive, then given point by point, each when it is due.

Every point is one sample of desired displacements, compensated when its time has come, as a command is. There is no
interpolation, neither between points nor from the present displacement to the first one (in
joint_trajectory_controller: interpolation method ``none``): where the path is farther away than the slew limit allows,
the voltage goes there at the slew limit.

A `delay` in the model of an axis shifts when: its points are given so much earlier.
"""

from bisect import bisect_left
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from slpi_ros.compensator import validation as rejection
from slpi_ros.compensator.validation import RejectedError, require_names
from slpi_ros.io.messages import SECOND_NS
from slpi_ros.model.streaming import refusal

FloatArray = NDArray[np.float64]
TimeArray = NDArray[np.int64]

# No clock shows a later time, and two of them can be added.
LATEST_NS = 2**62
# Points made lists of at once.
BLOCK = 256


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
        _check_times(times, start_ns)
        finite = np.isfinite(places)
        if not finite.all():
            point, column = (int(i) for i in np.unravel_index(np.argmin(finite), finite.shape))
            what = f"axis '{names[column]}', point {point}: displacement is {places[point, column]} m"
            raise RejectedError(rejection.NOT_FINITE, f"{what}; send finite ones only")
        return cls(tuple(names), times.astype(np.int64, copy=False), places, start_ns)

    def __len__(self) -> int:
        """Return the number of points."""
        return self.time_from_start_ns.size

    def check_reach(self, accepted: Mapping[str, tuple[float, float]]) -> None:
        """Reject displacements outside of those accepted (m), by axis name; the first one is named."""
        for column, name in enumerate(self.names):
            y, (low, high) = self.positions[:, column], accepted[name]
            if y.min() < low or y.max() > high:
                at = int(np.argmax((y < low) | (y > high)))
                what = f"axis '{name}', point {self.cut + at}: {refusal(float(y[at]), accepted[name])}"
                raise RejectedError(rejection.OUT_OF_RANGE, what)

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


def _as_array(values: ArrayLike, dtype: type | None = None) -> NDArray[Any]:
    try:
        return np.asarray(values, dtype)
    except (TypeError, ValueError, OverflowError) as error:
        raise RejectedError(rejection.LENGTH, f"the points are no array of numbers: {error}") from None


def _check_times(times: NDArray[Any], start_ns: int) -> None:
    """Reject times from a start (ns), shape (N,), N >= 1, that are no nanoseconds, or not in strict order."""
    if times.dtype.kind not in "iu":
        raise RejectedError(rejection.NOT_FINITE, f"times are of type {times.dtype}; give whole nanoseconds")
    if abs(start_ns) >= LATEST_NS or times.max() >= LATEST_NS:
        what = f"start {start_ns} ns, last point after {times.max()} ns"
        raise RejectedError(
            rejection.TIME_BACKWARDS, f"{what}: these are no times of a clock; correct the stamp and the times"
        )
    back = np.concatenate([[times[0] < 0], times[1:] <= times[:-1]])
    if back.any():
        at = int(np.argmax(back))
        before = f"point {at - 1} at {times[at - 1] / SECOND_NS:.9g} s" if at else "the start"
        what = f"point {at} at {times[at] / SECOND_NS:.9g} s does not come after {before}"
        raise RejectedError(rejection.TIME_BACKWARDS, f"{what}; sort the points, and give each its own time")


class Point(NamedTuple):
    """The one point that is to be given now.

    Parameters
    ----------
    names : tuple of str, length K
    displacements : list of float, length K, metres
    deadline_ns : int, nanoseconds
        When it was due.
    """

    names: tuple[str, ...]
    displacements: list[float]
    deadline_ns: int


class _Track:
    """Points of axes with the same delay, given one after the other.

    Parameters
    ----------
    names : tuple of str, length K
    positions : ndarray, shape (N, K), metres
    deadlines_ns : ndarray of int64, shape (N,), nanoseconds
    first : int
        The first point that is to be given.
    counted : bool
        Whether its points count: where the axes of a trajectory have several delays, they do once.
    """

    def __init__(
        self, names: tuple[str, ...], positions: FloatArray, deadlines_ns: TimeArray, first: int, counted: bool
    ) -> None:
        self.names, self.counted, self.begun = names, counted, False
        # The points ``next:stop`` are still to be given.
        self.next, self.stop = first, deadlines_ns.size
        self._positions, self._deadlines_ns = positions, deadlines_ns
        self._load()

    def _load(self) -> None:
        """Make lists of the next points: to take numbers from arrays one by one is several times slower."""
        self._from, block = self.next, slice(self.next, self.next + BLOCK)
        self._times, self._rows = self._deadlines_ns[block].tolist(), self._positions[block].tolist()

    @property
    def next_ns(self) -> int:
        """When the next point is due, nanoseconds."""
        return int(self._times[self.next - self._from])

    def until(self, time_ns: int) -> int:
        """Return the first point from `next` on that is due at `time_ns` or later."""
        at = bisect_left(self._times, time_ns, self.next - self._from)
        if at < len(self._times):
            return min(self._from + at, self.stop)
        return self.next + int(np.searchsorted(self._deadlines_ns[self.next : self.stop], time_ns))

    def take(self, now_ns: int) -> tuple[Point, int]:
        """Return the latest point that is due, and how many due before it are skipped."""
        first, self.next = self.next, self.until(now_ns + 1)
        at, self.begun = self.next - 1 - self._from, True
        if at < len(self._rows):
            point = Point(self.names, self._rows[at], self._times[at])
        else:
            last = self.next - 1
            point = Point(self.names, self._positions[last].tolist(), int(self._deadlines_ns[last]))
        if self.next < self.stop and self.next - self._from >= len(self._times):
            self._load()
        return point, self.next - 1 - first


class TrajectoryExecutor:
    """Tells which point is due, by absolute deadlines: a late call does not delay the points after it.

    New points replace those before them as in joint_trajectory_controller: at once, or, stamped with a time to come,
    from their first deadline on. Any number of trajectories may wait for their time.

    All times are nanoseconds on one clock, the caller's.

    Attributes
    ----------
    skipped : int
        Points that were due together with a later one, so far.
    """

    def __init__(self) -> None:
        self.skipped = 0
        self._tracks: list[_Track] = []

    @property
    def on(self) -> bool:
        """Whether points are still to come."""
        return bool(self._tracks)

    @property
    def remaining(self) -> int:
        """Number of points still to be given."""
        return sum(track.stop - track.next for track in self._tracks if track.counted)

    @property
    def names(self) -> set[str]:
        """Axes that have points to come."""
        return {name for track in self._tracks for name in track.names}

    @property
    def next_deadline_ns(self) -> int | None:
        """When the next point is due, nanoseconds; None: there is none."""
        tracks = self._tracks
        return tracks[0].next_ns if len(tracks) == 1 else min((track.next_ns for track in tracks), default=None)

    @property
    def tracks(self) -> int:
        """Number of trajectories that have points to come, counted again for each delay among their axes."""
        return len(self._tracks)

    @property
    def begun(self) -> bool:
        """Whether a trajectory is under way, not only waiting for its time."""
        return any(track.begun for track in self._tracks)

    def start(self, trajectory: Trajectory, now_ns: int, delays: Mapping[str, float] | None = None) -> None:
        """Let a trajectory take over: at once, or when its first point is due.

        Parameters
        ----------
        trajectory : Trajectory
        now_ns : int, nanoseconds
        delays : mapping of axis name to float, seconds, optional
            Of the axes: so much before their time points are given. Those that would have had to be given before now
            are left out, but for the last one.

        Raises
        ------
        RejectedError
            If all of it is in the past; what was being followed goes on.
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
            tracks.append(_Track(names, positions, deadlines, first, counted=not tracks))
        begin_ns = min(track.next_ns for track in tracks)
        kept = self._tracks if trajectory.start_ns else []
        for track in kept:
            track.stop = track.until(begin_ns) if track.next_ns < begin_ns else track.next
        self._tracks = [*(track for track in kept if track.next < track.stop), *tracks]

    def cancel(self) -> None:
        """Forget all points."""
        self._tracks = []

    def due(self, now_ns: int) -> Point | None:
        """Return the latest point that is due and has not been returned, or None; call it until it returns None.

        Points due before it are never given. The last point before a handover is: others may name other axes.
        """
        if not self._tracks:
            return None
        track = self._tracks[0] if len(self._tracks) == 1 else min(self._tracks, key=lambda each: each.next_ns)
        if now_ns < track.next_ns:
            return None
        point, skipped = track.take(now_ns)
        self.skipped += skipped if track.counted else 0
        if track.next == track.stop:
            self._tracks.remove(track)
        return point
