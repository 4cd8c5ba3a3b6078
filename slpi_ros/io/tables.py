"""Import of measured data from tables; reading and writing of the tables of the command line."""

import csv
import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from io import StringIO
from pathlib import Path

import numpy as np

from slpi_ros.arrays import FloatArray, IntArray
from slpi_ros.errors import RecordError
from slpi_ros.io.atomic_file import all_or_nothing
from slpi_ros.io.columns import Column, ColumnChoice, ColumnOptions, choose_columns, match_column
from slpi_ros.io.input_limits import MOST_AXES
from slpi_ros.io.record import Course, Record
from slpi_ros.io.table_files import CsvTable, MatTable, load_csv, load_mat

# message stamps count seconds in int32
_TIME_END = 2.0**31


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
    # The table is a text file with a line of column names above the numbers, separated by comma, semicolon or tab; with
    # semicolon or tab, decimal commas are allowed. Or it is a MATLAB file (``.mat``, up to version 7), whose numeric
    # vectors are the columns. A column name may contain a unit; without, units are seconds, volts and
    # `displacement_unit`, by default micrometres. Columns named by a topic, such as ``/room/temperature``, are recorded
    # quantities; other ones are left out. Empty cells and ``nan`` become NaN. If the first time is negative,
    # all times are shifted such that the record begins at 0.
    options = ColumnOptions(time, tuple(voltage), tuple(displacement), displacement_unit, tuple(axes))
    return import_with_summary(path, options).record


@dataclass(frozen=True)
class Imported:
    """Record of a table, the desired displacements (m), (N,), of axes that have some, and what was taken for what."""

    record: Record
    desired: Mapping[str, FloatArray]
    summary: tuple[str, ...]


def import_with_summary(path: str | os.PathLike[str], options: ColumnOptions) -> Imported:
    """Import a table as `import_table` does, with desired displacements and a summary by axis."""
    path = Path(path)
    table = load_mat(path) if path.suffix.lower() == ".mat" else load_csv(path)
    choice = choose_columns(table.columns, options, str(path))
    values = table.read([*(column.name for column in choice.columns()), *choice.quantities])
    time_ns = _nanoseconds(_si(values, choice.time), choice.time.name, table)
    t = (time_ns - time_ns[0]) * 1e-9
    record = Record(
        time_ns=time_ns,
        voltage={axis: _si(values, column) for axis, column in choice.voltage.items()},
        displacement={axis: _si(values, column) for axis, column in choice.displacement.items()},
        source=str(path),
        surroundings={name: _readings(t, values[name]) for name in choice.quantities},
    )
    desired = {axis: _si(values, column) for axis, column in choice.desired.items()}
    return Imported(record, desired, tuple(_summary(record, desired, choice)))


def _readings(t: FloatArray, values: FloatArray) -> Course:
    """Return times (s) and values of a quantity where it has some: it may be read less often than the stage."""
    known = np.isfinite(values)
    return t[known], values[known]


def _si(values: Mapping[str, FloatArray], column: Column) -> FloatArray:
    return values[column.name] * column.scale


def _summary(record: Record, desired: Mapping[str, FloatArray], choice: ColumnChoice) -> Iterable[str]:
    """Yield a line for each axis, one for time if its unit was assumed, and one for each desired column left out."""
    if choice.time.assumed:
        yield f"time: column '{choice.time.name}' taken as {choice.time.unit}"
    for axis in record.axes:
        voltage = _column_summary(choice.voltage[axis], record.voltage[axis], "V")
        displacement = _column_summary(choice.displacement[axis], record.displacement[axis] * 1e6, "µm")
        wanted = _column_summary(choice.desired[axis], desired[axis] * 1e6, "µm") if axis in desired else ""
        yield f"axis {axis}: {voltage}, {displacement}{', desired ' + wanted if wanted else ''}"
    for name, (_, readings) in record.surroundings.items():
        yield f"quantity {name}: {readings.size} readings"
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


def read_table(path: str | os.PathLike[str], suffix: str) -> tuple[FloatArray, dict[str, FloatArray]]:
    """Read times (s) and finite values (V or m) by axis, shape (N,) each, from a table of the command line."""
    t, by_axis, _ = read_table_with(path, suffix, ())
    return t, by_axis


def read_table_with(
    path: str | os.PathLike[str], suffix: str, beside: Sequence[str]
) -> tuple[FloatArray, dict[str, FloatArray], dict[str, FloatArray]]:
    """Read times (s), finite values (V or m) by axis, and quantities by name, (N,) each, from a table of a command."""
    # The columns are ``time_s``, ``<axis>_<suffix>``, "V" or "m", and of `beside` those that are there, in any order;
    # others are ignored. A quantity is held where its cells are empty.
    table = load_csv(Path(path))
    ending = _ending(suffix)
    own = [name for name in table.columns if name not in beside]
    columns = {n.removesuffix(ending): n for n in own if n.endswith(ending) and n != ending}
    if not columns:
        raise RecordError(f"{path}: no column <axis>{ending}; there is {table.listing()}")
    if len(columns) > MOST_AXES:
        raise RecordError(f"{path}: {len(columns)} columns <axis>{ending}, more than {MOST_AXES} axes; leave some out")
    time = match_column("time_s", table.columns)
    also = [name for name in beside if name in table.columns]
    values = table.read((time, *columns.values(), *also))
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
    by_axis = {axis: values[column] for axis, column in columns.items()}
    return values[time], by_axis, {name: values[name] for name in also}


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


def _nanoseconds(seconds: FloatArray, column: str, table: CsvTable | MatTable) -> IntArray:
    """Return time stamps (ns); if the first time is negative, all are shifted to start at 0, as messages require."""
    table.require(np.isfinite(seconds), column, seconds, "every row needs a time")
    table.require(np.abs(seconds) < _TIME_END, column, seconds, "more than 2^31 s; is the unit right?")
    _require_order(seconds, column, table)
    stamps: IntArray = np.rint((seconds - min(seconds[0], 0.0)) * 1e9).astype(np.int64)
    return stamps


def _require_order(seconds: FloatArray, column: str, table: CsvTable | MatTable) -> None:
    forward = np.concatenate([[True], np.diff(seconds) >= 0])
    table.require(forward, column, seconds, "time runs backwards here; sort or cut the table")
