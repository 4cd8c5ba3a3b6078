"""Record of a stage: voltage and displacement of each axis with common time stamps."""

import mmap
import os
import tempfile
from collections.abc import Hashable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any
from weakref import WeakSet

import numpy as np
from numpy.typing import NDArray

from slpi_ros.arrays import FloatArray, IntArray
from slpi_ros.errors import RecordError, UsageError
from slpi_ros.io.input_limits import LONGEST_NAME, MOST_AXES
from slpi_ros.io.stage_name import stage_name

# Times (s) from the first stamp of a record, ascending, and values of a quantity, NaN: no reading, shape (n,) each.
Course = tuple[FloatArray, FloatArray]
# Columns of this size and above, in bytes, are kept in a temporary file.
MAPPED_FROM = 32 * 2**20
# How the note on a record begins whose messages were sorted; steps back (ns) from which a clock may have been set back.
OUT_OF_ORDER, SET_BACK_NS = "messages are not in the order of their stamps", 10**9
# Number of samples of a block, where a long record is worked on in blocks.
BLOCK = 1_000_000
# Mappings made here. Another one may be private: its changes would be lost with its memory.
_OWN: WeakSet[mmap.mmap] = WeakSet()


def new_column(size: int, dtype: np.dtype[Any]) -> NDArray[Any]:
    """Return an uninitialised column of a record; a long one is mapped from a temporary file if there is room."""
    if size * dtype.itemsize >= MAPPED_FROM:
        with suppress(OSError), tempfile.TemporaryFile() as file:
            # Reserved at once: a full disk must not be noticed later, at a write into the mapping.
            os.posix_fallocate(file.fileno(), 0, size * dtype.itemsize)
            pages = mmap.mmap(file.fileno(), size * dtype.itemsize)
            _OWN.add(pages)
            return np.ndarray(size, dtype, pages)
    return np.empty(size, dtype)


def release(*columns: NDArray[Any]) -> None:
    """Give back the memory that mapped columns occupy; their values stay in the file and are read again when used."""
    for column in columns:
        owner: Any = column
        while isinstance(owner, np.ndarray):
            owner = owner.base
        if isinstance(owner, mmap.mmap) and owner in _OWN:
            owner.madvise(mmap.MADV_DONTNEED)


def each_block(*columns: NDArray[Any]) -> Iterator[tuple[NDArray[Any], ...]]:
    """Yield equal parts of columns of one length, overlapping by one sample, and release each part afterwards."""
    for start in range(0, columns[0].size, BLOCK):
        yield tuple(column[start : start + BLOCK + 1] for column in columns)
        release(*columns)


def first_step_back(times: IntArray) -> int | None:
    """Return the first sample whose time is before that of the preceding one, or None."""
    for number, (part,) in enumerate(each_block(times)):
        back = part[1:] < part[:-1]
        if back.any():
            return number * BLOCK + int(np.argmax(back)) + 1
    return None


def order_note(times: IntArray) -> str:
    """Return how many messages have an earlier time (ns) than the one before them, and the largest step; else ""."""
    count, largest, at = 0, 0, 0
    for number, (part,) in enumerate(each_block(times)):
        steps = part[:-1] - part[1:]
        count += int(np.count_nonzero(steps > 0))
        if steps.size and steps.max() > largest:
            largest, at = int(steps.max()), number * BLOCK + int(np.argmax(steps)) + 1
    if not count:
        return ""
    told = (
        f"{OUT_OF_ORDER}: {count} of {times.size} come after a later one, message {at + 1} by {largest * 1e-9:.4g} s; "
        "they are sorted"
    )
    if largest < SET_BACK_NS:
        return told
    return f"{told}; if a clock was set back, leave that part out with --start or --stop, or record again"


def is_axis_name(axis: str) -> bool:
    """Return whether an axis can have this name."""
    return 0 < len(axis) <= LONGEST_NAME and axis.isprintable()


@dataclass(frozen=True)
class Record:
    """Voltage and displacement of the axes of one stage, with common time stamps.

    Parameters
    ----------
    time_ns : ndarray of int64, shape (N,), nanoseconds
        Stamps as recorded; not yet checked for order.
    voltage : mapping of axis name to ndarray, shape (N,), volts
        Applied voltage.
    displacement : mapping of axis name to ndarray, shape (N,), metres
        Measured displacement; NaN where the sensor gave no reading.
    source : str
        Origin of the record, for messages and for the model document.
    hardware_id : str
        Identifier of the stage, as given by its driver; "" if unknown.
    notes : tuple of str
        Remarks on how the record was made. Default none.
    surroundings : mapping of str to (ndarray, ndarray), shape (n,) each
        Quantities that were recorded beside it, by topic, or ``topic:field`` where a message has several: times (s)
        from the first stamp, ascending, and values, NaN where there is none. Default none.
    before : tuple of Record
        Records of the same session before it, in time order: between and after them nothing else has moved the stage,
        which rested at their last voltages. A diagnosis knows from them what the stage still remembers. Default none.

    Raises
    ------
    RecordError
        If the arrays do not have the same length or the axes differ.
    """

    time_ns: IntArray
    voltage: Mapping[str, FloatArray]
    displacement: Mapping[str, FloatArray]
    source: str = "record"
    hardware_id: str = ""
    notes: tuple[str, ...] = ()
    surroundings: Mapping[str, Course] = field(default_factory=dict)
    before: "tuple[Record, ...]" = ()
    axes: tuple[str, ...] = field(init=False)

    def __post_init__(self) -> None:
        if len(self.voltage) > MOST_AXES:
            raise RecordError(f"{self.source}: {len(self.voltage)} axes, more than {MOST_AXES}; choose some of them")
        if set(self.voltage) != set(self.displacement) or not self.voltage:
            raise RecordError(
                f"{self.source}: voltage of axes {sorted(self.voltage)} but displacement of "
                f"{sorted(self.displacement)}; each axis needs both"
            )
        for axis in self.voltage:
            if not is_axis_name(axis):
                raise RecordError(
                    f"{self.source}: {axis[:LONGEST_NAME]!r} is no name of an axis: give it one of 1 to "
                    f"{LONGEST_NAME} printable characters"
                )
            for name, signal in (("voltage", self.voltage[axis]), ("displacement", self.displacement[axis])):
                if signal.shape != self.time_ns.shape:
                    raise RecordError(
                        f"{self.source}: {name} of axis '{axis}' has {signal.shape} values "
                        f"for {self.time_ns.shape} stamps"
                    )
        for name, (t, value) in self.surroundings.items():
            if t.ndim != 1 or t.shape != value.shape:
                raise RecordError(
                    f"{self.source}: quantity '{name}' has {value.shape} values for {t.shape} times; give one for each"
                )
        object.__setattr__(self, "axes", tuple(self.voltage))

    @property
    def t(self) -> FloatArray:
        """Time since the first stamp, shape (N,), seconds."""
        return (self.time_ns - self.time_ns[0]) * 1e-9 if self.time_ns.size else np.empty(0)

    @cached_property
    def derived(self) -> dict[Hashable, Any]:
        """Results that are needed again, kept with the record by those who compute them."""
        return {}

    def part(self, rows: slice) -> "Record":
        """Return the record of some samples; in a session those before them go into what was `before`."""
        voltage, displacement = (
            {axis: signal[rows] for axis, signal in signals.items()} for signals in (self.voltage, self.displacement)
        )
        time_ns = self.time_ns[rows]
        later = (time_ns[0] - self.time_ns[0]) * 1e-9 if time_ns.size else 0.0
        beside = {name: (t - later, value) for name, (t, value) in self.surroundings.items()}
        before = self.before
        if before and later:
            before = (*before, replace(self, before=()).part(slice(0, rows.start)))
        return replace(
            self, time_ns=time_ns, voltage=voltage, displacement=displacement, surroundings=beside, before=before
        )

    def __len__(self) -> int:
        return int(self.time_ns.size)

    def require_axis(self, axis: str) -> None:
        """Raise UsageError if the record has no such axis."""
        if axis not in self.axes:
            raise UsageError(f"{self.source}: no axis '{axis}'; it holds {', '.join(self.axes)}")


def common_stage(records: Sequence[Record], hardware_id: str = "") -> str:
    """Return the hardware id of the stage of all records and a model, "" if unknown; UsageError if several."""
    if not records:
        raise UsageError("no record given; give at least one")
    stages: dict[str, tuple[str, str]] = {}
    for given, source in [(hardware_id, "the model"), *((each.hardware_id, each.source) for each in records)]:
        if name := stage_name(given):
            stages.setdefault(name, (given, source))
    if len(stages) > 1:
        listed = ", ".join(f"'{stage}' ({source})" for stage, source in stages.values())
        what = "records and a model" if stage_name(hardware_id) else "records"
        raise UsageError(f"several stages: {listed}; use {what} of one stage")
    return next((given for given, _ in stages.values()), "")
