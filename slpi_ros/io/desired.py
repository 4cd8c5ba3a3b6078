"""Desired displacements that a bag or a table holds: of single messages, of trajectories."""

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from slpi_ros.arrays import FloatArray, IntArray
from slpi_ros.errors import RecordError
from slpi_ros.io.alignment import Signals, assigned
from slpi_ros.io.bag_files import SUFFIXES, locate
from slpi_ros.io.bag_reader import Bag
from slpi_ros.io.messages import JOINT_TRAJECTORY, MESSAGE_TYPES, TrajectoryArrays, decode_trajectory
from slpi_ros.io.record import Record
from slpi_ros.io.tables import read_table

# Topics of desired displacements; a trajectory is followed before single messages.
DESIRED, TRAJECTORY = "desired_displacement", "desired_trajectory"


@dataclass(frozen=True)
class DesiredPath:
    """Desired displacements of one axis; a later path replaces an earlier one."""

    axis: str
    time_ns: IntArray  # (N,), ascending
    y: FloatArray  # m, (N,); NaN: as before
    linear: bool  # between the points of a trajectory; else each is held until the next one

    def at(self, time_ns: IntArray) -> FloatArray:
        """Return the displacements (m) at some times (ns), both (M,); NaN where this path gives none."""
        if self.linear:
            origin = self.time_ns[0]
            y = np.interp((time_ns - origin) * 1e-9, (self.time_ns - origin) * 1e-9, self.y)
            return np.where((time_ns >= origin) & (time_ns <= self.time_ns[-1]), y, np.nan)
        known = np.isfinite(self.y)
        last = np.searchsorted(self.time_ns[known], time_ns, side="right")
        return np.asarray(np.append(np.nan, self.y[known])[last])


def read_desired(path: str | os.PathLike[str], axes: Sequence[str], topic: str | None = None) -> list[DesiredPath]:
    """Read the desired displacements of a bag; [] if it has none.

    They are those of ``desired_displacement`` and ``desired_trajectory``, or of a given topic; `axes` name columns
    without names. RecordError if the bag or a message cannot be read, or the axes do not match.
    """
    path = Path(path)
    found: list[DesiredPath] = []
    with Bag(locate(path), path) as bag:
        for name in (DESIRED, TRAJECTORY) if topic is None else (topic,):
            if topic is None and not bag.holds(name):
                continue
            where = f"{path}, topic '{name}'"
            if bag.type_of(name, (*MESSAGE_TYPES, JOINT_TRAJECTORY)) == JOINT_TRAJECTORY:
                for logged_ns, message in bag.messages(name):
                    found += _of_trajectory(decode_trajectory(message), logged_ns, where)
            else:
                found += _of_messages(bag.read(name, MESSAGE_TYPES), axes, where)
    return found


def desired_of(path: str | os.PathLike[str], record: Record, topic: str | None = None) -> dict[str, FloatArray] | None:
    """Return the desired displacement (m) of each axis, (N,), NaN: none, at the samples of a record of the same bag.

    None if the bag has none; else as `read_desired`, and RecordError if record and topic do not overlap in time.
    """
    found = read_desired(path, record.axes, topic)
    sampled = at_times(found, record.time_ns)
    if found and not any(np.isfinite(y).any() for y in sampled.values()):
        what = f"topic '{topic}'" if topic else "desired displacements"
        raise RecordError(f"{path}: at no time were {what} and the record both recorded; record them with one clock")
    return sampled or None


def read_path(path: str | os.PathLike[str], axes: Sequence[str] = ()) -> tuple[FloatArray, dict[str, FloatArray]]:
    """Return times from 0 (s) and desired displacements (m), (N,), of a table ``time_s,<axis>_m`` or of a bag.

    `axes`: names of columns without names; default ``x``. RecordError if there is no path, or it cannot be read.
    """
    if not (Path(path).is_dir() or Path(path).name.endswith(SUFFIXES)):
        t, columns = read_table(path, "m")
        return t - t[:1], columns
    found = read_desired(path, axes or ("x",))
    if not found:
        raise RecordError(f"{path}: no message on {DESIRED} or {TRAJECTORY}; give the bag of a path, or a table")
    time_ns = np.unique(np.concatenate([each.time_ns for each in found]))
    columns = at_times(found, time_ns)
    known = np.logical_and.reduce([np.isfinite(y) for y in columns.values()])
    if np.count_nonzero(known) < 2:
        raise RecordError(f"{path}: at no time are {', '.join(columns)} desired together; give a path of all axes")
    time_ns = time_ns[known]
    return (time_ns - time_ns[0]) * 1e-9, {axis: y[known] for axis, y in columns.items()}


def at_times(paths: Sequence[DesiredPath], time_ns: IntArray) -> dict[str, FloatArray]:
    """Return the desired displacements (m) by axis, (N,), at some times (ns), NaN where there are none."""
    sampled: dict[str, FloatArray] = {}
    for each in paths:
        y, before = each.at(time_ns), sampled.get(each.axis)
        sampled[each.axis] = y if before is None else np.where(np.isfinite(y), y, before)
    return sampled


def _of_messages(found: Signals, axes: Sequence[str], where: str) -> list[DesiredPath]:
    time = found.logged if found.stamp is None else found.stamp
    columns: Mapping[str, FloatArray] = next(
        filter(None, (found.fields.get(field, {}) for field in ("position", "data", "vector"))), {}
    )
    wanted = list(columns) if found.named else list(axes)
    order = np.argsort(time, kind="stable")
    return [
        DesiredPath(axis, time[order], column[order], linear=False)
        for axis, column in assigned(columns, found.named, wanted, where, alone=False).items()
    ]


def _of_trajectory(arrays: TrajectoryArrays | None, logged_ns: int, where: str) -> list[DesiredPath]:
    if arrays is None:
        raise RecordError(f"{where}: a trajectory cannot be read; give each point one position for each joint")
    if not arrays.time_from_start_ns.size:
        return []
    # Without a stamp it begins when it arrives.
    time_ns = (arrays.start_ns or logged_ns) + arrays.time_from_start_ns
    return [
        DesiredPath(axis, time_ns, np.ascontiguousarray(arrays.values[:, place]), linear=True)
        for place, axis in enumerate(arrays.names)
    ]
