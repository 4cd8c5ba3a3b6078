"""Alignment of voltage and displacement from separate topics to one clock."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from slpi_ros.arrays import FloatArray, IntArray
from slpi_ros.errors import RecordError
from slpi_ros.io.messages import SECOND_NS
from slpi_ros.io.record import Record
from slpi_ros.io.stage_name import same_stage, stage_name

# Longest gap, in median periods, across which values are interpolated.
_GAP = 10.0
# Blocks of messages by which a drift of two clocks is found, and messages in each; its standard errors, and the share
# of a sampling period that they are apart in the end, from which it is corrected.
_BLOCKS, _FEWEST_IN_BLOCKS, _SURE, _APART = 20, 10, 6.0, 0.1
# Axis names for columns without names.
_AXES = ("x", "y", "z")


@dataclass(frozen=True)
class Signals:
    """Decoded messages of one topic; (N,) each."""

    logged: IntArray  # ns, ascending: recording times
    stamp: IntArray | None  # ns, of the headers; None if no message is stamped
    frames: Mapping[str, frozenset[str]]  # names of the columns in the messages of each frame id, in their order
    fields: Mapping[str, Mapping[str, FloatArray]]  # ``position``, ``effort``, ``data`` or ``vector``; NaN: not given
    named: bool  # the message type names the columns, otherwise they are ``0``, ``1``, ...
    notes: tuple[str, ...] = ()  # on messages that were left out, or sorted
    received: int = 0  # messages, with those that were left out

    @property
    def names(self) -> tuple[str, ...]:
        """Joint names as in the messages; "0", "1", ... if the message type has none."""
        return tuple(next(iter(self.fields.values())))

    def stage(self, axes: Sequence[str], where: str, accept_stage: str = "") -> str:
        """Return what the messages of `axes` name their stage, "" if nothing; RecordError if they name several.

        What is named `accept_stage` is of the same stage as the others.
        """
        # Columns without names may be any axes.
        chosen = set(axes) if self.named and set(axes) <= set(self.names) else set(self.names)
        frames = [frame for frame, names in self.frames.items() if names & chosen]
        # An accepted name is the other name of the same stage.
        named = sorted(filter(stage_name, frames), key=lambda frame: stage_name(frame) == stage_name(accept_stage))
        for other in named[1:]:
            if not same_stage(named[0], other, accept_stage):
                raise RecordError(
                    f"{where}: messages of two stages, '{named[0]}' and '{other}'; record one stage alone, read the "
                    "axes of one (--axis), or, if both names are of the same stage, accept one for the other "
                    f"(--accept-stage '{other}')"
                )
        return next(iter(named or filter(None, frames)), "")


@dataclass(frozen=True)
class SeparateTopics:
    """Names and interpretation of separate topics for voltage and displacement, instead of ``stage_state``."""

    # Each topic may be of type ``sensor_msgs/JointState``, ``std_msgs/Float64``, ``std_msgs/Float64MultiArray`` or
    # ``geometry_msgs/Vector3Stamped``, in volts and metres. In a JointState, the displacement is ``position``; the
    # voltage is ``effort``, or ``position`` if ``effort`` is empty or zero. Axes match by name if both topics name
    # them; columns without names are assigned in the order of the axes, and a single voltage drives all axes.
    # Times are the header stamps if both topics have them and they overlap, otherwise the recording times of both
    # topics. There are samples only in the time that both cover, and no interpolation across gaps of ten periods.
    voltage: str  # name; slash and namespace may be omitted if the name is unambiguous
    displacement: str
    # The signal whose messages become samples. At the times of the displacement, a voltage reversal between two of them
    # becomes an additional sample with displacement NaN; at those of the voltage, the displacement is interpolated.
    clock: Literal["displacement", "voltage"] = "displacement"
    # A commanded voltage is held until the next message; with the clock "voltage", each sample then lies midway between
    # its message and the next one. A measured one is interpolated.
    held: bool = True


@dataclass(frozen=True)
class _Series:
    """The columns of one signal, each of shape (n,), and their times."""

    time: IntArray
    columns: Mapping[str, FloatArray]


def combine(
    voltage: Signals,
    displacement: Signals,
    topics: SeparateTopics,
    axes: Sequence[str],
    path: Path,
    accept_stage: str = "",
) -> Record:
    """Combine the signals of two topics into a record of `axes`, by name, or in the order of columns; empty for all.

    What is named `accept_stage` is of the same stage as the other messages of its topic.
    """
    where = f"{path}: voltage on '{topics.voltage}', displacement on '{topics.displacement}'"
    v_columns = _filled(voltage, ("effort", "position", "data", "vector"), where)
    d_columns = _filled(displacement, ("position", "data", "vector"), where)
    wanted = tuple(axes) or _common_axes(voltage, displacement)
    moves, drives = (
        signals.stage(wanted, f"{path}, topic '{topic}'", accept_stage)
        for signals, topic in ((displacement, topics.displacement), (voltage, topics.voltage))
    )
    moved = assigned(d_columns, displacement.named, wanted, f"{where}: displacement", alone=False)
    driven = assigned(v_columns, voltage.named, wanted, f"{where}: voltage", alone=True)
    v_time, d_time, notes = _times(voltage, displacement, topics, where)
    resample = _on_displacement if topics.clock == "displacement" else _on_voltage
    time, v, y = resample(_Series(v_time, driven), _Series(d_time, moved), topics.held)
    if not time.size:
        raise RecordError(f"{where}: no message of one lies within the time of the other; record them together")
    return Record(
        time_ns=time,
        voltage=v,
        displacement=y,
        source=str(path),
        hardware_id=moves or drives,
        notes=(
            *dict.fromkeys((*voltage.notes, *displacement.notes)),
            *notes,
            *_naming(voltage, topics.voltage, wanted),
            *_naming(displacement, topics.displacement, wanted),
        ),
    )


def _filled(signals: Signals, fields: Sequence[str], where: str) -> Mapping[str, FloatArray]:
    """Return the columns of the first field that is not empty or zero."""
    for field in fields:
        columns = signals.fields.get(field, {})
        if any(np.nan_to_num(column).any() for column in columns.values()):
            return columns
    raise RecordError(f"{where}: one of them has no value other than zero; choose other topics")


def _common_axes(voltage: Signals, displacement: Signals) -> tuple[str, ...]:
    """Return the axes that the messages name, in the order of the displacement."""
    if displacement.named:
        common = tuple(name for name in displacement.names if name in voltage.names)
        return common if voltage.named and common else displacement.names
    return voltage.names if voltage.named else _AXES[: len(displacement.names)]


def assigned(
    columns: Mapping[str, FloatArray], named: bool, axes: Sequence[str], what: str, *, alone: bool
) -> dict[str, FloatArray]:
    """Return one column for each axis; if `alone`, a single column may be used for all axes."""
    if named and all(axis in columns for axis in axes):
        return {axis: columns[axis] for axis in axes}
    if len(columns) == 1 and (alone or (len(axes) == 1 and not named)):
        return dict.fromkeys(axes, next(iter(columns.values())))
    if not named and len(columns) == len(axes):
        return dict(zip(axes, columns.values(), strict=True))
    held = f"axes {', '.join(columns)}" if named else f"{len(columns)} columns without names"
    raise RecordError(f"{what} has {held} for the axes {', '.join(axes)}; name those to read, in order (axes)")


def _naming(signals: Signals, topic: str, axes: Sequence[str]) -> list[str]:
    if signals.named or len(signals.names) == 1:
        return []
    return [f"'{topic}' names no axes: its columns were taken for {', '.join(axes)}, in this order"]


def _times(
    voltage: Signals, displacement: Signals, topics: SeparateTopics, where: str
) -> tuple[IntArray, IntArray, list[str]]:
    """Return the times of both topics on the same clock, and notes for the record."""
    if voltage.stamp is not None and displacement.stamp is not None:
        if _overlap(voltage.stamp, displacement.stamp):
            for topic, stamp in ((topics.voltage, voltage.stamp), (topics.displacement, displacement.stamp)):
                _require_order(stamp, f"{where}: stamps of '{topic}'")
            return voltage.stamp, *_in_one_clock(voltage, displacement, topics)
        reason = "their header stamps are of different clocks"
    else:
        unstamped = [
            f"'{topic}'"
            for topic, signals in ((topics.voltage, voltage), (topics.displacement, displacement))
            if signals.stamp is None
        ]
        reason = f"{' and '.join(unstamped)} without header stamps"
    if not _overlap(voltage.logged, displacement.logged):
        raise RecordError(f"{where}: at no time were both recorded; record them together")
    note = f"aligned by the time of recording ({reason}): late messages are paired with the wrong voltage"
    return voltage.logged, displacement.logged, [note]


def _in_one_clock(voltage: Signals, displacement: Signals, topics: SeparateTopics) -> tuple[IntArray, list[str]]:
    """Return the stamps of the displacement by the clock of those of the voltage, and a note if they drift apart."""
    # Both were recorded by one clock: each stamp's drift is that against the times of recording.
    assert voltage.stamp is not None and displacement.stamp is not None
    driven, uncertain = _rate(voltage.stamp, voltage.logged)
    moved, also = _rate(displacement.stamp, displacement.logged)
    rate, error = moved - driven, math.hypot(uncertain, also)
    time = displacement.stamp - displacement.stamp[0]
    apart = abs(rate) * float(time[-1])
    if not (abs(rate) > _SURE * error and apart > _APART * float(np.median(np.diff(displacement.stamp)))):
        return displacement.stamp, []
    # The rate of the recorder's clock against that of the voltage is not known better than to itself: it cancels.
    stamps: IntArray = displacement.stamp - np.rint(time * (rate / (1.0 + rate))).astype(np.int64)
    how = f"{1e6 * abs(rate):.3g} ppm {'faster' if rate > 0.0 else 'slower'} than that of '{topics.voltage}'"
    told = f"the clock of '{topics.displacement}' goes {how}, {apart * 1e-9:.3g} s in all: its stamps were corrected"
    return stamps, [told]


def _rate(stamp: IntArray, logged: IntArray) -> tuple[float, float]:
    """Return the relative rate of the clock of stamps (ns, (N,)) against that of recording, less 1, and its error."""
    blocks = np.array_split(np.arange(stamp.size), _BLOCKS)
    if stamp.size < _FEWEST_IN_BLOCKS * _BLOCKS:
        return 0.0, math.inf
    since = (logged - logged[0]).astype(np.float64)
    # Messages come late now and then: medians.
    at, late = (np.array([np.median(x[block]) for block in blocks]) for x in (since, stamp - stamp[0] - since))
    (rate, _), covariance = np.polyfit(at / at[-1], late, 1, cov=True)
    return float(rate / at[-1]), float(np.sqrt(covariance[0, 0]) / at[-1])


def _overlap(one: IntArray, other: IntArray) -> bool:
    return bool(max(one.min(), other.min()) < min(one.max(), other.max()))


def _require_order(time: IntArray, what: str) -> None:
    back = np.flatnonzero(np.diff(time) < 0)
    if back.size:
        seconds = (time[back[0]] - time[back[0] + 1]) / SECOND_NS
        raise RecordError(f"{what} run backwards by {seconds:.6g} s at message {back[0] + 1}; record anew")


_Aligned = tuple[IntArray, dict[str, FloatArray], dict[str, FloatArray]]


def _on_displacement(voltage: _Series, displacement: _Series, held: bool) -> _Aligned:
    """Resample the voltage at the times of the displacement."""
    known = (displacement.time >= voltage.time[0]) & (displacement.time <= voltage.time[-1])
    time = displacement.time[known]
    y = {axis: column[known] for axis, column in displacement.columns.items()}
    if not held:
        return time, {axis: between(time, voltage.time, column) for axis, column in voltage.columns.items()}, y
    current = np.searchsorted(voltage.time, time, side="right") - 1
    unseen = _unseen_turns(voltage, current)
    # Each missing reversal is inserted before the first displacement that is not earlier.
    places = np.searchsorted(time, voltage.time[unseen], side="left")
    current = np.insert(current, places, unseen)
    return (
        np.insert(time, places, voltage.time[unseen]),
        {axis: column[current] for axis, column in voltage.columns.items()},
        {axis: np.insert(column, places, np.nan) for axis, column in y.items()},
    )


def _unseen_turns(voltage: _Series, current: NDArray[np.intp]) -> NDArray[np.intp]:
    """Return the indices of voltage reversals that are not in `current`, the last message at each displacement."""
    unseen = np.zeros(voltage.time.size, dtype=bool)
    unseen[current.min(initial=voltage.time.size) : current.max(initial=0)] = True
    unseen[current] = False
    turn = np.zeros(voltage.time.size, dtype=bool)
    for column in voltage.columns.values():
        step = np.sign(np.diff(column))
        # While the voltage is constant, the direction of its last change is kept.
        step = step[np.maximum.accumulate(np.where(step != 0.0, np.arange(step.size), 0))]
        turn[1:-1] |= step[:-1] * step[1:] < 0
    return np.flatnonzero(unseen & turn)


def _on_voltage(voltage: _Series, displacement: _Series, held: bool) -> _Aligned:
    """Interpolate the displacement at the times of the voltage."""
    time, v = voltage.time, dict(voltage.columns)
    if held:
        time = time[:-1] + np.diff(time) // 2
        v = {axis: column[:-1] for axis, column in v.items()}
    known = (time >= displacement.time[0]) & (time <= displacement.time[-1])
    time = time[known]
    return (
        time,
        {axis: column[known] for axis, column in v.items()},
        {axis: between(time, displacement.time, column) for axis, column in displacement.columns.items()},
    )


def between(time: NDArray[Any], known_at: NDArray[Any], values: FloatArray) -> FloatArray:
    """Return values (N,), known at ascending times (N,), at other times (M,): linear between them, NaN in long gaps."""
    start = known_at[0]
    result = np.interp((time - start).astype(np.float64), (known_at - start).astype(np.float64), values)
    steps = np.diff(known_at)
    before = np.clip(np.searchsorted(known_at, time, side="left") - 1, 0, max(steps.size - 1, 0))
    within = (time > known_at[before]) & (time < known_at[before + 1])
    result[within & (steps[before] > _GAP * np.median(steps))] = np.nan
    return np.asarray(result)
