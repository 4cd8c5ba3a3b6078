"""Import of measured data from tables; reading and writing of the tables of the command line."""

import csv
import os
from collections.abc import Collection, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from io import StringIO
from pathlib import Path

import numpy as np

from slpi_ros.arrays import FloatArray, IntArray
from slpi_ros.errors import DependencyError, RecordError, dependencies_needed
from slpi_ros.io.alignment import between
from slpi_ros.io.array_files import HDF5, TDMS, ZIP, load_arrays
from slpi_ros.io.atomic_file import all_or_nothing
from slpi_ros.io.columns import (
    DISPLACEMENT,
    TIME,
    VOLTAGE,
    Column,
    ColumnChoice,
    ColumnOptions,
    ColumnQuantity,
    choose_columns,
    is_line,
    joined,
    match_column,
    parse_column,
    times_in,
    two_clocks,
)
from slpi_ros.io.input_limits import MOST_AXES, TABLE_BYTES, open_input
from slpi_ros.io.record import Course, Record
from slpi_ros.io.table_files import Table, load_spreadsheet, load_text

# message stamps count seconds in int32
_TIME_END = 2.0**31
# Of a time without a unit, the seconds of one unit by the size of the first value: ms, us or ns since 1970.
_SINCE_1970 = ((1e17, "ns"), (1e14, "us"), (1e11, "ms"))
_OLD_WORKBOOK = b"\xd0\xcf\x11\xe0"


def import_table(
    path: str | os.PathLike[str],
    *,
    time: str | None = None,
    voltage: Sequence[str] = (),
    displacement: Sequence[str] = (),
    displacement_unit: str | None = None,
    axes: Sequence[str] = (),
) -> Record:
    """Import measured data (V, m) from a table, identifying columns and units by name or option."""
    # The table is a text, a spreadsheet, or a file of arrays, see `load_table`. A column name may contain a unit;
    # without, units are seconds, volts and `displacement_unit`, by default micrometres. Columns named by a topic, such
    # as ``/room/temperature``, are recorded quantities; other ones are left out. Empty cells and ``nan`` become NaN. If
    # the first time is negative or no stamp of a message, all times are shifted such that the record begins at 0.
    options = ColumnOptions(time, voltage, displacement, displacement_unit, axes)
    return import_with_summary(path, options).record


def load_table(path: Path, options: ColumnOptions | None = None) -> Table:
    """Find the columns of a table by the content of its file; DependencyError if its library is missing."""
    given = options or ColumnOptions()
    begin = b""
    with suppress(OSError), open_input(path, TABLE_BYTES) as file:
        begin = file.read(8)
    suffix = path.suffix.lower()
    if begin.startswith(_OLD_WORKBOOK):
        raise RecordError(f"{path}: a workbook of an old Excel; save it as .xlsx or CSV")
    try:
        with dependencies_needed():
            if suffix in (".mat", ".npz") or begin.startswith((HDF5, TDMS)):
                return load_arrays(path, begin, given.group)
            if begin.startswith(ZIP):
                return load_spreadsheet(path, given.names, given.sheet)
    except DependencyError as error:
        kind = "a file of HDF5, as of MATLAB 7.3: " if "h5py" in str(error) else ""
        raise DependencyError(f"{path}: {kind}{error}; or save it as text, or from MATLAB by -v7") from error
    return load_text(path, given.names)


@dataclass(frozen=True)
class Imported:
    """Record of a table, the desired displacements (m), (N,), of axes that have some, and what was taken for what."""

    record: Record
    desired: Mapping[str, FloatArray]
    summary: tuple[str, ...]


def import_with_summary(path: str | os.PathLike[str], options: ColumnOptions) -> Imported:
    """Import a table as `import_table` does, with desired displacements and a summary by axis."""
    path = Path(path)
    table = load_table(path, options)
    period = options.sample_period or table.period
    # Of a sampling period in the place of times there is one value.
    choice = choose_columns(table.columns, options, str(path), table.read, period=bool(period))
    wanted = [*(column.name for column in choice.columns()), *choice.quantities]
    first, said = list[str](), list[str]()
    if choice.time and options.sample_period is None and (single := table.single(choice.time.name)) is not None:
        period, choice = single * choice.time.scale, replace(choice, time=None)
        wanted.pop(0)
    values = table.read(wanted)
    if choice.time and table.period and np.isnan(values[choice.time.name]).all():
        choice = replace(choice, time=None)
    if choice.time is None or options.sample_period:
        assert period is not None
        time_ns = np.rint(np.arange(values[wanted[-1]].size) * (period * 1e9)).astype(np.int64)
        said.append(f"time: a row every {period:g} s")
    else:
        _require_one_clock(table, choice, choice.time, values[choice.time.name])
        time, seconds = _in_seconds(choice.time, values[choice.time.name])
        if table.holds_dates(time.name):
            time, seconds = replace(time, assumed=False), values[time.name]
            said.append(f"time: '{time.name}' in seconds from its first row on")
        else:
            first.append(f"time: column '{time.name}' {'taken as' if time.assumed else 'in'} {time.unit}")
        choice = replace(choice, time=time)
        time_ns = _nanoseconds(seconds, time.name, table)
        if time_ns[0] == 0 and seconds[0] > 0.0:
            said.append(f"time: counts from {seconds[0]:.12g} s on; the record begins at 0")
    t = (time_ns - time_ns[0]) * 1e-9
    voltage = {axis: _si(values, column) for axis, column in choice.voltage.items()}
    displacement = {axis: _si(values, column) for axis, column in choice.displacement.items()}
    for axis, y in displacement.items():
        voltage[axis], aligned = _on_rows_of(y, voltage[axis], t)
        if aligned:
            said.append(f"axis {axis}: rows of two clocks; the voltage was interpolated to those of the displacement")
    record = Record(
        time_ns=time_ns,
        voltage=voltage,
        displacement=displacement,
        source=str(path),
        surroundings={name: _readings(t, values[name]) for name in choice.quantities},
    )
    if table.left_out:
        said.append(f"left out, no columns of numbers: {joined(table.left_out)}")
    desired = {axis: _si(values, column) for axis, column in choice.desired.items()}
    return Imported(record, desired, (*first, *_summary(record, desired, choice), *said))


def _in_seconds(column: Column, values: FloatArray) -> tuple[Column, FloatArray]:
    """Return a column of time and its values in seconds; a unit that its name does not tell is that of a date."""
    if column.assumed and (unit := next((unit for least, unit in _SINCE_1970 if values[0] >= least), "")):
        column = replace(column, unit=unit, scale=TIME.units[unit])
    return column, values * column.scale


def _require_one_clock(table: Table, choice: ColumnChoice, time: Column, own: FloatArray) -> None:
    """Raise RecordError if the table has another column of times that are not those of the first one."""
    for name in times_in(choice.others):
        try:
            column, values = parse_column(name, TIME), table.read([name])[name]
        except RecordError:
            continue
        known = np.isfinite(own) & np.isfinite(values)
        first, other = own[known] * time.scale, values[known] * column.scale
        if not (np.diff(other) > 0.0).all():
            # What does not run forward is no time.
            continue
        # Another clock of the same rows shows other times by a constant; of an unknown unit it shows a straight line.
        apart = np.ptp(other - first) > 0.5 * np.median(np.diff(first))
        if apart and not (column.assumed and is_line(first, other, fewest=2)):
            raise RecordError(two_clocks(str(table.path), time.name, name, table.columns))


def _on_rows_of(y: FloatArray, v: FloatArray, t: FloatArray) -> tuple[FloatArray, bool]:
    """Return voltages (V) that are known where the displacements `y` are, if they stand in rows of their own."""
    moved, driven = np.isfinite(y), np.isfinite(v)
    if np.count_nonzero(moved & driven) >= np.count_nonzero(moved) // 2 or np.count_nonzero(driven) < 2:
        return v, False
    filled, known = v.copy(), t[driven]
    at = moved & ~driven & (t >= known[0]) & (t <= known[-1])
    filled[at] = between(t[at], known, v[driven])
    return filled, True


def _readings(t: FloatArray, values: FloatArray) -> Course:
    """Return times (s) and values of a quantity where it has some: it may be read less often than the stage."""
    known = np.isfinite(values)
    return t[known], values[known]


def _si(values: Mapping[str, FloatArray], column: Column) -> FloatArray:
    return values[column.name] * column.scale


def _goes_back(v: FloatArray) -> bool:
    """Return whether a voltage goes up and down again, by half of its range at least: else no hysteresis shows."""
    v = v[np.isfinite(v)]
    fall, rise = np.max(np.maximum.accumulate(v) - v), np.max(v - np.minimum.accumulate(v))
    return bool(min(fall, rise) >= 0.5 * np.ptp(v))


def _summary(record: Record, desired: Mapping[str, FloatArray], choice: ColumnChoice) -> Iterable[str]:
    """Yield a line for each axis and quantity, and one for what is left out."""
    for axis in record.axes:
        voltage = _column_summary(choice.voltage[axis], record.voltage[axis], "V")
        displacement = _column_summary(choice.displacement[axis], record.displacement[axis] * 1e6, "µm")
        wanted = _column_summary(choice.desired[axis], desired[axis] * 1e6, "µm") if axis in desired else ""
        yield f"axis {axis}: {voltage}, {displacement}{', desired ' + wanted if wanted else ''}"
        if is_line(record.voltage[axis], record.displacement[axis]) and _goes_back(record.voltage[axis]):
            yield (
                f"axis {axis}: the displacement is a straight line of '{choice.voltage[axis].name}', without "
                "hysteresis: is this a monitor of the sensor? The voltage must be that of the drive (--voltage)"
            )
    for name, (_, readings) in record.surroundings.items():
        yield f"quantity {name}: {readings.size} readings"
    for name in choice.monitors:
        yield f"left out, '{name}': a straight line of the displacement, so a monitor of the sensor"
    for reason in choice.left_out:
        yield f"left out, column {reason}; name the columns of desired displacements in units of length (--desired)"
    if choice.others:
        yield (
            f"left out, columns {', '.join(choice.others)}; one that is named by a topic, such as /room/temperature, "
            "is read as a recorded quantity"
        )


def _column_summary(column: Column, values: FloatArray, unit: str) -> str:
    """Return name and range of a column, and whether its unit was assumed."""
    known = values[np.isfinite(values)]
    assumed = " (unit assumed)" if column.assumed else ""
    if not known.size:
        return f"{column.name} without a value"
    return f"{column.name} {known.min():.5g} to {known.max():.5g} {unit}{assumed}"


def read_table(
    path: str | os.PathLike[str], suffix: str, axes: Collection[str] = ()
) -> tuple[FloatArray, dict[str, FloatArray]]:
    """Read times (s) and finite values (V or m) by axis, shape (N,) each, from a table of the command line."""
    t, by_axis, _ = read_table_with(path, suffix, (), axes)
    return t, by_axis


def read_table_with(
    path: str | os.PathLike[str], suffix: str, beside: Sequence[str], axes: Collection[str] = ()
) -> tuple[FloatArray, dict[str, FloatArray], dict[str, FloatArray]]:
    """Read times (s), finite values (V or m) by axis, and quantities by name, (N,) each, from a table of a command."""
    # The columns are ``time_s``, ``<axis>_<suffix>``, "V" or "m", of an axis without one that in another unit of the
    # same quantity, as in x_um, and of `beside` those that are there, in any order; others are ignored, also those in
    # another unit beside one in "V" or "m" if they are not of the known `axes`. A quantity is held where its cells are
    # empty.
    table = load_table(Path(path))
    ending = _ending(suffix)
    own = [name for name in table.columns if name not in beside]
    columns = _of_each_axis(own, VOLTAGE if suffix == VOLTAGE.default else DISPLACEMENT)
    if given := {axis: column for axis, column in columns.items() if column[0].endswith(ending)}:
        columns = {axis: column for axis, column in columns.items() if axis in given or axis in axes}
    if not columns:
        raise RecordError(
            f"{path}: no column <axis>{ending}; there is {table.listing()}; write such names above the columns, or "
            f"make a bag of a measured record: slpi import {path} -o BAG"
        )
    if len(columns) > MOST_AXES:
        raise RecordError(f"{path}: {len(columns)} columns <axis>{ending}, more than {MOST_AXES} axes; leave some out")
    time = match_column("time_s", table.columns)
    also = [name for name in beside if name in table.columns]
    values = table.read((time, *(name for name, _ in columns.values()), *also))
    for name in also:
        values[name] = _held(values[name])
    for column, samples in values.items():
        table.require(
            np.isfinite(samples),
            column,
            samples,
            "no finite number (an empty cell counts as nan); write one into every cell",
        )
    _require_order(values[time], time, table)
    by_axis = {axis: scale * values[column] for axis, (column, scale) in columns.items()}
    return values[time], by_axis, {name: values[name] for name in also}


def _of_each_axis(names: Sequence[str], quantity: ColumnQuantity) -> dict[str, tuple[str, float]]:
    """Return the column ``<axis>_<unit>`` of each axis, that in SI before others, and the SI value of its unit."""
    units, found = list(quantity.units), dict[str, tuple[tuple[int, bool], str]]()
    for name in names:
        axis, _, end = name.rpartition("_")
        if axis and (unit := quantity.unit(end)):
            rank = units.index(unit), end != unit
            if axis not in found or rank < found[axis][0]:
                found[axis] = rank, name
    return {axis: (name, quantity.units[units[rank[0]]]) for axis, (rank, name) in found.items()}


def _held(values: FloatArray) -> FloatArray:
    """Return values, shape (N,), with the last known one, at the beginning the first, where they are not known."""
    known = np.flatnonzero(np.isfinite(values))
    if not known.size:
        return values
    return values[known[np.maximum(np.searchsorted(known, np.arange(values.size), side="right") - 1, 0)]]


def write_table(path: str | os.PathLike[str], t: FloatArray, columns: Mapping[str, FloatArray], suffix: str) -> None:
    """Write a table that ``read_table`` reads back: time to the nanosecond, values to the last bit; atomically."""
    path = Path(path)
    for axis, values in columns.items():
        if len(values) != len(t):
            raise RecordError(f"{path}: {len(values)} values of axis '{axis}' but {len(t)} times")
    texts: list[Iterable[str]] = [(f"{second:.9f}" for second in np.asarray(t, float).tolist())]
    texts += [map(repr, np.asarray(values, float).tolist()) for values in columns.values()]
    with all_or_nothing(path, RecordError) as file:
        file.write(f"{table_header(columns, suffix)}\n")
        file.writelines(f"{','.join(row)}\n" for row in zip(*texts, strict=True))


def table_header(axes: Iterable[str], suffix: str) -> str:
    """Return the line of column names that `write_table` writes for these axes and this unit."""
    line = StringIO()
    csv.writer(line, lineterminator="").writerow(["time_s", *(f"{axis}{_ending(suffix)}" for axis in axes)])
    return line.getvalue()


def _ending(suffix: str) -> str:
    return f"_{suffix.strip('_')}"


def _nanoseconds(seconds: FloatArray, column: str, table: Table) -> IntArray:
    """Return time stamps (ns); if the first time is no stamp of a message, all are shifted to start at 0."""
    table.require(np.isfinite(seconds), column, seconds, "every row needs a time")
    table.require(np.abs(seconds - seconds[0]) < _TIME_END, column, seconds, "more than 2^31 s; is the unit right?")
    _require_order(seconds, column, table)
    begins = seconds[0] if not 0.0 <= seconds[0] < _TIME_END else 0.0
    stamps: IntArray = np.rint((seconds - begins) * 1e9).astype(np.int64)
    return stamps


def _require_order(seconds: FloatArray, column: str, table: Table) -> None:
    forward = np.concatenate([[True], np.diff(seconds) >= 0])
    table.require(forward, column, seconds, "time runs backwards here; sort or cut the table")
