"""Trajectories: validated as a whole on arrival, then executed point by point at their deadlines.

Every point is one sample of desired displacements, compensated at its deadline in the same way as a command. There is
no interpolation, neither between points nor from the present displacement to the first one (in
joint_trajectory_controller: interpolation method ``none``): if a point is farther away than the slew limit allows, the
voltage approaches it at the slew limit.

A `delay` in the model of an axis advances the deadlines of its points by that time.
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

# Upper limit of valid times; the sum of two times does not overflow int64.
LATEST_NS = 2**62
# Number of points converted to lists at once.
BLOCK = 256


@dataclass(frozen=True)
class Trajectory:
    """Desired displacements of some axes at given times, validated by `Trajectory.of`.

    Parameters
    ----------
    names : tuple of str, length K
    time_from_start_ns : ndarray of int64, shape (N,), nanoseconds
        Strictly increasing, N >= 1.
    positions : ndarray, shape (N, K), metres
    start_ns : int, nanoseconds
        Start time; 0 starts at once. May be negative on a clock that counts from the start of the machine.
    cut : int
        Number of earlier points discarded because their time had passed; default 0.
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
        """Return a validated trajectory; arrays are not copied.

        Parameters
        ----------
        names : sequence of str, length K
            A subset of `axes`, in any order.
        time_from_start_ns : array_like of int, shape (N,), nanoseconds
        positions : array_like, shape (N, K), metres
        start_ns : int, nanoseconds
        axes : sequence of str
            Names of all axes.

        Raises
        ------
        RejectedError
            If names, shapes, times or positions are not valid; the message names the first invalid point.
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
            raise RejectedError(rejection.NOT_FINITE, f"{what}; send finite values only")
        return cls(tuple(names), times.astype(np.int64, copy=False), places, start_ns)

    def __len__(self) -> int:
        """Return the number of points."""
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
        """Return the trajectory without the points before `now_ns` (ns), or with all points if `start_ns` is 0.

        Raises
        ------
        RejectedError
            If all points are in the past.
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
    """The trajectory point to execute now.

    Parameters
    ----------
    names : tuple of str, length K
    displacements : list of float, length K, metres
    deadline_ns : int, nanoseconds
        Time at which the point was due.
    """

    names: tuple[str, ...]
    displacements: list[float]
    deadline_ns: int


class _Track:
    """Points of one trajectory for all axes with the same delay, executed in order.

    Parameters
    ----------
    names : tuple of str, length K
    positions : ndarray, shape (N, K), metres
    deadlines_ns : ndarray of int64, shape (N,), nanoseconds
    first : int
        Index of the first point to execute.
    counted : bool
        Whether `TrajectoryExecutor.remaining` counts the points: only one track of each trajectory is counted.
    """

    def __init__(
        self, names: tuple[str, ...], positions: FloatArray, deadlines_ns: TimeArray, first: int, counted: bool
    ) -> None:
        self.names, self.counted, self.begun = names, counted, False
        # The points ``next:stop`` are pending.
        self.next, self.stop = first, deadlines_ns.size
        self._positions, self._deadlines_ns = positions, deadlines_ns
        self._load()

    def _load(self) -> None:
        """Convert the next block of points to lists: access to single array elements is several times slower."""
        self._from, block = self.next, slice(self.next, self.next + BLOCK)
        self._times, self._rows = self._deadlines_ns[block].tolist(), self._positions[block].tolist()

    @property
    def next_ns(self) -> int:
        """Deadline of the next point, nanoseconds."""
        return int(self._times[self.next - self._from])

    def until(self, time_ns: int) -> int:
        """Return the index of the first pending point that is due at `time_ns` or later."""
        at = bisect_left(self._times, time_ns, self.next - self._from)
        if at < len(self._times):
            return min(self._from + at, self.stop)
        return self.next + int(np.searchsorted(self._deadlines_ns[self.next : self.stop], time_ns))

    def take(self, now_ns: int) -> tuple[Point, int]:
        """Return the latest point that is due, and the number of earlier pending points, which are skipped."""
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
    """Return trajectory points at absolute deadlines: a late call does not delay the following points.

    A new trajectory replaces the current points as in joint_trajectory_controller: at once, or, if it starts in the
    future, from its first deadline on. Any number of trajectories may be pending.

    All times are nanoseconds on the same clock, which the caller chooses.

    Attributes
    ----------
    skipped : int
        Number of points skipped so far because a later point was already due.
    """

    def __init__(self) -> None:
        self.skipped = 0
        self._tracks: list[_Track] = []

    @property
    def on(self) -> bool:
        """Whether points are pending."""
        return bool(self._tracks)

    @property
    def remaining(self) -> int:
        """Number of trajectory points that are not due yet."""
        return sum(track.stop - track.next for track in self._tracks if track.counted)

    @property
    def names(self) -> set[str]:
        """Names of the axes with pending points."""
        return {name for track in self._tracks for name in track.names}

    @property
    def next_deadline_ns(self) -> int | None:
        """Deadline of the next point, nanoseconds; None if no point is pending."""
        tracks = self._tracks
        return tracks[0].next_ns if len(tracks) == 1 else min((track.next_ns for track in tracks), default=None)

    @property
    def tracks(self) -> int:
        """Number of tracks: each pending trajectory has one for every different delay of its axes."""
        return len(self._tracks)

    @property
    def begun(self) -> bool:
        """Whether a pending trajectory has already executed a point."""
        return any(track.begun for track in self._tracks)

    def start(self, trajectory: Trajectory, now_ns: int, delays: Mapping[str, float] | None = None) -> None:
        """Start a trajectory at once, or when its first point is due.

        Parameters
        ----------
        trajectory : Trajectory
        now_ns : int, nanoseconds
        delays : mapping of axis name to float, seconds, optional
            Delay of each axis, by which its deadlines are advanced; default 0. Of the points with deadlines in the past
            only the last one is executed.

        Raises
        ------
        RejectedError
            If all points are in the past; the current trajectory continues.
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
        """Discard all pending points."""
        self._tracks = []

    def due(self, now_ns: int) -> Point | None:
        """Return the latest point that is due and not yet returned, or None; to be called until it returns None.

        Earlier points of the same track are skipped. Every track is returned separately, as it may move other axes.
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
