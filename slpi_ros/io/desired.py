"""Desired displacements that a bag or a table holds: of single messages, of trajectories."""

import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from slpi_ros.arrays import FloatArray, IntArray
from slpi_ros.errors import RecordError
from slpi_ros.io.alignment import Signals, assigned
from slpi_ros.io.bag_files import SUFFIXES, locate
from slpi_ros.io.bag_reader import Bag
from slpi_ros.io.messages import JOINT_TRAJECTORY, MESSAGE_TYPES, SECOND_NS, TrajectoryArrays, decode_trajectory
from slpi_ros.io.record import Record
from slpi_ros.io.tables import read_table

# Topics of desired displacements; while a trajectory is followed, or waits, single messages are rejected.
DESIRED, TRAJECTORY = "desired_displacement", "desired_trajectory"
# Later than any time of a recording (ns).
NEVER = int(np.iinfo(np.int64).max)
# A trajectory that is replaced so long (ns) before its end was followed to its end, as in the compensator.
EARLY_NS = SECOND_NS // 1000


@dataclass(frozen=True)
class DesiredPath:
    """What is asked of one axis from `since_ns` on, until another path of the axis begins; its last value is held."""

    axis: str
    time_ns: IntArray  # (N,), ascending
    y: FloatArray  # m, (N,)
    linear: bool  # between the points of a trajectory; else each is held until the next one
    since_ns: int
    halted_ns: int = NEVER  # from when it goes no further: another trajectory has replaced it
    ended_ns: int = NEVER  # from when nothing is asked for: all was cancelled

    @property
    def complete(self) -> bool:
        """Whether it is followed to its end."""
        return min(self.halted_ns, self.ended_ns) >= int(self.time_ns[-1]) - EARLY_NS

    @property
    def followed(self) -> "DesiredPath":
        """The path without what is held after the end of a trajectory."""
        if not self.linear:
            return self
        return replace(self, ended_ns=min(self.ended_ns, self.halted_ns, int(self.time_ns[-1]) + 1))

    @property
    def whole(self) -> "DesiredPath":
        """The path from its first to its last point, whatever was before and after that."""
        first_ns, last_ns = int(self.time_ns[0]), int(self.time_ns[-1])
        return replace(self, since_ns=first_ns, halted_ns=NEVER, ended_ns=last_ns + 1)

    @property
    def corners_ns(self) -> IntArray:
        """Times (ns), ascending, between which it is a straight line, or steps."""
        ends = min(self.halted_ns, self.ended_ns - 1)
        return np.unique(np.clip(np.append(self.time_ns, self.since_ns), self.since_ns, ends))

    def at(self, time_ns: IntArray, before: float = np.nan) -> FloatArray:
        """Return the displacements (m) at some times (ns), both (M,), from `since_ns` on; NaN where it asks for none.

        `before` (m): where the axis is when it begins, from where the first point is approached; NaN: not known.
        """
        at, asked = np.minimum(time_ns, self.halted_ns), (time_ns >= self.since_ns) & (time_ns < self.ended_ns)
        if self.linear:
            t, y = self.time_ns, self.y
            if self.since_ns < t[0]:
                t, y = np.append(self.since_ns, t), np.append(before, y)
            y = np.interp((at - t[0]) * 1e-9, (t - t[0]) * 1e-9, y)
        else:
            y = self.y[np.searchsorted(self.time_ns, at, side="right") - 1]
        return np.where(asked, y, np.nan)


@dataclass(frozen=True)
class _Given:
    """A trajectory of a bag, when it came (ns) and from when it is followed; without paths it cancels at once."""

    logged_ns: int  # by the clock of the recorder, which may be another one
    came_ns: int
    since_ns: int
    paths: Sequence[DesiredPath]

    @property
    def last_ns(self) -> int:
        """Time (ns) of its end."""
        return int(self.paths[0].time_ns[-1]) if self.paths else self.came_ns

    def halted_by(self, other: "_Given") -> int:
        """Return from when (ns) it goes no further, as another one has come, or a cancellation."""
        if not other.paths:
            return other.came_ns
        # Until the first sample of one that is stamped later, it goes on to its last point before that.
        points, first_ns = self.paths[0].time_ns, other.paths[0].time_ns[0]
        before = int(np.searchsorted(points, other.since_ns, side="left" if first_ns == other.since_ns else "right"))
        return max(other.came_ns, int(points[before - 1]) if before else 0)


def read_desired(path: str | os.PathLike[str], axes: Sequence[str], topic: str | None = None) -> list[DesiredPath]:
    """Read the desired displacements of a bag, in the order in which they are followed; [] if it has none.

    They are those of ``desired_displacement`` and ``desired_trajectory``, or of a given topic, as the compensator
    follows them: what it rejects for its model or its state is not known here. `axes` name columns without names.
    RecordError if the bag or a message cannot be read, or the axes do not match.
    """
    path = Path(path)
    columns: list[tuple[DesiredPath, IntArray]] = []
    given: list[_Given] = []
    with Bag(locate(path), path) as bag:
        for name in (DESIRED, TRAJECTORY) if topic is None else (topic,):
            if topic is None and not bag.holds(name):
                continue
            where = f"{path}, topic '{name}'"
            if bag.type_of(name, (*MESSAGE_TYPES, JOINT_TRAJECTORY)) == JOINT_TRAJECTORY:
                given = _trajectories(bag.messages(name), where)
            else:
                columns = _of_messages(bag.read(name, MESSAGE_TYPES), axes, where)
    return _followed(columns, given)


def desired_of(path: str | os.PathLike[str], record: Record, topic: str | None = None) -> dict[str, FloatArray] | None:
    """Return the desired displacement (m) of each axis, (N,), NaN: none, at the samples of a record of the same bag.

    None if the bag has none; else as `read_desired`, and RecordError if record and topic do not overlap in time.
    """
    found = read_desired(path, record.axes, topic)
    sampled = at_times(found, record.time_ns)
    # The last point of a trajectory is held, but not into a time of another clock.
    begins = int(record.time_ns.min(initial=NEVER))
    together = any(not each.linear or int(each.corners_ns[-1]) >= begins for each in found)
    if found and not (together and any(np.isfinite(y).any() for y in sampled.values())):
        what = f"topic '{topic}'" if topic else "desired displacements"
        raise RecordError(f"{path}: at no time were {what} and the record both recorded; record them with one clock")
    return sampled or None


def read_path(path: str | os.PathLike[str], axes: Sequence[str] = ()) -> tuple[FloatArray, dict[str, FloatArray]]:
    """Return times from 0 (s) and desired displacements (m), (N,), of a table ``time_s,<axis>_m`` or of a bag.

    `axes`: names of columns without names, default ``x``, and known ones. RecordError if there is no path, or it cannot
    be read.
    """
    if not (Path(path).is_dir() or Path(path).name.endswith(SUFFIXES)):
        t, columns = read_table(path, "m", axes)
        return t - t[:1], columns
    found = read_desired(path, axes or ("x",))
    if not found:
        raise RecordError(f"{path}: no message on {DESIRED} or {TRAJECTORY}; give the bag of a path, or a table")
    time_ns = np.unique(np.concatenate([each.corners_ns for each in found]))
    columns = at_times(found, time_ns)
    known = np.logical_and.reduce([np.isfinite(y) for y in columns.values()])
    if np.count_nonzero(known) < 2:
        raise RecordError(f"{path}: at no time are {', '.join(columns)} desired together; give a path of all axes")
    time_ns = time_ns[known]
    return (time_ns - time_ns[0]) * 1e-9, {axis: y[known] for axis, y in columns.items()}


def at_times(paths: Sequence[DesiredPath], time_ns: IntArray) -> dict[str, FloatArray]:
    """Return the desired displacements (m) by axis, (N,), at some times (ns), NaN where there are none.

    The paths are in the order of `read_desired`.
    """
    sampled: dict[str, FloatArray] = {}
    times = np.append(time_ns, np.array([each.since_ns for each in paths], np.int64))
    for place, each in enumerate(paths, time_ns.size):
        before = sampled.get(each.axis, np.full(times.size, np.nan))
        sampled[each.axis] = np.where(times >= each.since_ns, each.at(times, float(before[place])), before)
    return {axis: y[: time_ns.size] for axis, y in sampled.items()}


def _followed(columns: Sequence[tuple[DesiredPath, IntArray]], given: Sequence[_Given]) -> list[DesiredPath]:
    """Return what is followed of single messages, with the times (ns) of their recording, and of trajectories."""
    halted, pending = [one.last_ns for one in given], list[int]()
    cancelled: list[tuple[int, int]] = []  # number and time (ns)
    for number, one in enumerate(given):
        pending = [each for each in pending if halted[each] > one.came_ns]
        for each in pending:
            halted[each] = min(halted[each], given[each].halted_by(one))
        if one.paths:
            pending.append(number)
        elif pending:
            # It also ends what is held.
            cancelled.append((number, one.came_ns))
            pending = []
    found: list[DesiredPath] = []
    for number, one in enumerate(given):
        ended = next((at_ns for other, at_ns in cancelled if other > number), NEVER)
        until = halted[number] if halted[number] < one.last_ns else NEVER
        if one.since_ns <= until:
            found += [replace(each, halted_ns=until, ended_ns=ended) for each in one.paths]
    came, busy = np.array([one.logged_ns for one in given], np.int64), np.maximum.accumulate([0, *halted])
    for column, logged in columns:
        # From when a trajectory came until its end they are rejected.
        taken = column.time_ns >= busy[np.searchsorted(came, logged, side="right")]
        time_ns, y = column.time_ns[taken], column.y[taken]
        # What comes after a trajectory of the axis, or after all was cancelled, is a path of its own.
        others = [each.since_ns for each in found if each.linear and each.axis == column.axis]
        cuts = np.searchsorted(time_ns, np.sort(np.array([*others, *(at_ns for _, at_ns in cancelled)], np.int64)))
        for at, values in zip(np.split(time_ns, cuts), np.split(y, cuts), strict=True):
            if at.size:
                ended = next((at_ns for _, at_ns in cancelled if at_ns > at[0]), NEVER)
                found.append(replace(column, time_ns=at, y=values, since_ns=int(at[0]), ended_ns=ended))
    return sorted(found, key=lambda each: each.since_ns)


def _of_messages(found: Signals, axes: Sequence[str], where: str) -> list[tuple[DesiredPath, IntArray]]:
    """Return the single messages by axis, with the times (ns) of their recording."""
    time = found.logged if found.stamp is None else found.stamp
    columns: Mapping[str, FloatArray] = next(
        filter(None, (found.fields.get(field, {}) for field in ("position", "data", "vector"))), {}
    )
    wanted = list(columns) if found.named else list(axes)
    order = np.argsort(time, kind="stable")
    paths = []
    for axis, column in assigned(columns, found.named, wanted, where, alone=False).items():
        # A message that does not name the axis leaves it as it is.
        known = order[np.isfinite(column[order])]
        if known.size:
            one = DesiredPath(axis, time[known], column[known], linear=False, since_ns=int(time[known[0]]))
            paths.append((one, found.logged[known]))
    return paths


def _trajectories(messages: Iterable[tuple[int, bytes]], where: str) -> list[_Given]:
    """Return the trajectories of a topic, in the order in which they came."""
    read: list[tuple[int, TrajectoryArrays]] = []
    for logged_ns, message in messages:
        arrays = decode_trajectory(message)
        if arrays is None:
            raise RecordError(f"{where}: a trajectory cannot be read; give each point one position for each joint")
        if _is_sound(arrays):
            read.append((logged_ns, arrays))
    given: list[_Given] = []
    for logged_ns, arrays in sorted(read, key=lambda each: each[0]):
        # Without a stamp it begins when it comes.
        start_ns = arrays.start_ns or logged_ns
        time_ns = start_ns + arrays.time_from_start_ns
        if time_ns.size:
            came_ns = min(logged_ns, start_ns)
            paths = [
                DesiredPath(axis, time_ns, np.ascontiguousarray(arrays.values[:, place]), True, start_ns)
                for place, axis in enumerate(arrays.names)
            ]
        else:
            # Whatever its stamp is, it cancels when it comes, unless that is told by another clock than the stamps are.
            came_ns = logged_ns if logged_ns <= max((one.last_ns for one in given), default=0) else start_ns
            paths = []
        given.append(_Given(logged_ns, came_ns, start_ns, paths))
    return given


def _is_sound(arrays: TrajectoryArrays) -> bool:
    """Return whether a trajectory cancels, or is none that every compensator rejects as a whole."""
    times, names = arrays.time_from_start_ns, arrays.names
    if not times.size:
        return True
    ordered = bool(times[0] >= 0 and (np.diff(times) > 0).all())
    return ordered and 0 < len(set(names)) == len(names) and bool(np.isfinite(arrays.values).all())
