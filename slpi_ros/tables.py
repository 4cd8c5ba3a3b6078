"""Tables in and out: measured data to import, and the command tables of the command line."""

import os
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import NoReturn

import numpy as np
from numpy.typing import NDArray

from slpi_ros.csv_table import CsvTable, load_csv
from slpi_ros.errors import RecordError, UsageError
from slpi_ros.files import all_or_nothing
from slpi_ros.identification.record import FloatArray, Record
from slpi_ros.mat_table import MatTable, load_mat

_METRES = {"m": 1.0, "mm": 1e-3, "um": 1e-6, "µm": 1e-6, "nm": 1e-9}
_VOLTS = {"kV": 1e3, "V": 1.0, "mV": 1e-3}
_SECONDS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}

# message stamps count seconds in int32
_TIME_END = 2.0**31


def import_table(
    path: str | os.PathLike[str],
    *,
    time: str | None = None,
    voltage: Sequence[str] = (),
    displacement: Sequence[str] = (),
    displacement_unit: str = "um",
    axes: Sequence[str] = (),
) -> Record:
    """Read measured data from any source; the names of the columns say what they are.

    A unit at the end of a name (``_s``, ``_ms``, ``_V``, ``_mV``, ``_um``, ...) is honoured.

    Parameters
    ----------
    path : path
        Comma-separated, with the names of the columns in the first line; or a MATLAB file of numeric arrays, up to
        version 7, whose name ends in ``.mat``: its vectors are the columns.
    time : str, optional
        Column of time; by default ``time_s``, else the first that begins with "time".
    voltage : sequence of str
        Columns of voltage, one for all axes or one for each displacement; by default those that begin with
        "voltage" or end in ``_V``.
    displacement : sequence of str
        Columns of displacement, one for each axis; by default those that begin with "displacement", else
        ``<axis>_m`` (or another unit) where there is ``<axis>_V``.
    displacement_unit : {"um", "m", "mm", "nm"}
        Unit of displacement columns whose names do not end in one.
    axes : sequence of str
        Names of the axes; by default those in the displacement columns' names, and ``x`` where there is none.

    Returns
    -------
    Record
        In volts and metres. Empty cells and ``nan`` become NaN. A time axis that begins before zero is
        shifted to begin there.

    Raises
    ------
    RecordError
        If the file, a column or a value is not what it should be.
    UsageError
        If an option is wrong.
    """
    if displacement_unit not in _METRES:
        raise UsageError(f"no displacement unit '{displacement_unit}'; choose {', '.join(_METRES)}")
    table = _load(Path(path))
    clock = time or _time_column(table)
    moved = tuple(displacement) or _displacement_columns(table)
    driven = _one_for_each(moved, tuple(voltage) or _voltage_columns(table, moved), table.path)
    names = _axis_names(moved, tuple(axes), table.path)
    values = table.read((clock, *moved, *driven))
    return Record(
        time_ns=_nanoseconds(values[clock] * _scale(clock, _SECONDS, "s"), clock, table),
        voltage={n: values[c] * _scale(c, _VOLTS, "V") for n, c in zip(names, driven, strict=True)},
        displacement={n: values[c] * _scale(c, _METRES, displacement_unit) for n, c in zip(names, moved, strict=True)},
        source=str(path),
    )


def read_table(path: str | os.PathLike[str], suffix: str) -> tuple[FloatArray, dict[str, FloatArray]]:
    """Read a command table, in which every value counts.

    Parameters
    ----------
    path : path
        Columns ``time_s`` and ``<axis>_<suffix>`` in any order; others are ignored.
    suffix : {"V", "m"}
        Unit of the wanted columns.

    Returns
    -------
    t : ndarray, shape (N,), seconds
        Never decreasing.
    values : dict of axis name to ndarray, shape (N,), volts or metres
        In the order of the columns.

    Raises
    ------
    RecordError
        If a value is missing or not finite, or time runs backwards; with line, column and value.
    """
    table = load_csv(Path(path))
    ending = _ending(suffix)
    columns = {n.removesuffix(ending): n for n in table.columns if n.endswith(ending) and n != ending}
    if not columns:
        raise RecordError(f"{path}: no column <axis>{ending}; there is {table.listing()}")
    values = table.read(("time_s", *columns.values()))
    for column, samples in values.items():
        table.require(np.isfinite(samples), column, samples, "every cell needs a finite number")
    _require_order(values["time_s"], "time_s", table)
    return values["time_s"], {axis: values[column] for axis, column in columns.items()}


def write_table(path: str | os.PathLike[str], t: FloatArray, columns: Mapping[str, FloatArray], suffix: str) -> None:
    """Write a table that ``read_table`` reads back: time to the nanosecond, values to the last bit.

    The file appears complete or not at all; one of the same name is replaced.

    Parameters
    ----------
    path : path
        Where to write.
    t : ndarray, shape (N,), seconds
        Time.
    columns : mapping of axis name to ndarray, shape (N,), volts or metres
        One column for each axis.
    suffix : {"V", "m"}
        Unit of the columns.

    Raises
    ------
    RecordError
        If the lengths differ or the file cannot be written.
    """
    path = Path(path)
    for axis, values in columns.items():
        if len(values) != len(t):
            raise RecordError(f"{path}: {len(values)} values of axis '{axis}' but {len(t)} times")
    header = ",".join(["time_s", *(f"{axis}{_ending(suffix)}" for axis in columns)])
    texts: list[Iterable[str]] = [(f"{second:.9f}" for second in np.asarray(t, float).tolist())]
    texts += [map(repr, np.asarray(values, float).tolist()) for values in columns.values()]
    with all_or_nothing(path, RecordError) as file:
        file.write(f"{header}\n")
        file.writelines(f"{','.join(row)}\n" for row in zip(*texts, strict=True))


def _load(path: Path) -> CsvTable | MatTable:
    return load_mat(path) if path.suffix.lower() == ".mat" else load_csv(path)


def _displacement_columns(table: CsvTable | MatTable) -> tuple[str, ...]:
    """Return the columns that hold displacement, by their names."""
    if found := tuple(n for n in table.columns if n.startswith("displacement")):
        return found
    driven = {axis for axis, unit in (_split(n, _VOLTS) for n in table.columns) if unit}
    split = {n: _split(n, _METRES) for n in table.columns}
    found = tuple(n for n, (axis, unit) in split.items() if unit and axis in driven)
    return found or _missing(table, "displacement column", "displacement")


def _voltage_columns(table: CsvTable | MatTable, moved: Sequence[str]) -> tuple[str, ...]:
    """Return the columns that hold voltage, sorted as the displacements where they name the same axes."""
    found = tuple(n for n in table.columns if n.startswith("voltage") or n.endswith("_V"))
    by_axis = {_split(n, _VOLTS)[0]: n for n in found}
    axes = [_split(n, _METRES)[0] for n in moved]
    if len(found) == len(by_axis) and sorted(axes) == sorted(by_axis):
        return tuple(by_axis[axis] for axis in axes)
    return found or _missing(table, "voltage column", "voltage")


def _time_column(table: CsvTable | MatTable) -> str:
    """Return the column that holds time."""
    found = [n for n in table.columns if n.startswith("time")] or _missing(table, "time column", "time")
    return "time_s" if "time_s" in found else found[0]


def _missing(table: CsvTable | MatTable, what: str, option: str) -> NoReturn:
    raise RecordError(
        f"{table.path}: no {what}; there is {table.listing()}; name one of them (--{option} or {option}=)"
    )


def _split(column: str, units: Mapping[str, float]) -> tuple[str, str]:
    """Return axis and unit of a name such as ``displacement_x_um`` or ``x_V``; the unit is "" if none."""
    stem, _, unit = column.rpartition("_")
    if unit not in units:
        stem, unit = column, ""
    for word in ("displacement", "voltage"):
        stem = stem.removeprefix(word)
    return stem.strip("_") or "x", unit


def _scale(column: str, units: Mapping[str, float], default: str) -> float:
    return units[_split(column, units)[1] or default]


def _ending(suffix: str) -> str:
    return f"_{suffix.strip('_')}"


def _one_for_each(moved: Sequence[str], driven: Sequence[str], path: Path) -> tuple[str, ...]:
    """Return one voltage column for each displacement column."""
    if len(driven) == 1:
        return tuple(driven) * len(moved)
    if len(driven) != len(moved):
        raise RecordError(
            f"{path}: {len(driven)} voltage columns ({', '.join(driven)}) for {len(moved)} of displacement "
            f"({', '.join(moved)}); name one voltage for all or one for each (--voltage or voltage=)"
        )
    return tuple(driven)


def _axis_names(moved: Sequence[str], axes: Sequence[str], path: Path) -> tuple[str, ...]:
    """Return one name for each displacement column, no two alike."""
    names = tuple(axes) or tuple(_split(column, _METRES)[0] for column in moved)
    if len(names) != len(moved):
        raise UsageError(f"{path}: {len(names)} axes for the displacement columns {', '.join(moved)}")
    if len(set(names)) < len(names):
        raise RecordError(
            f"{path}: displacement columns {', '.join(moved)} are axes {', '.join(names)}, two of them the "
            "same; choose the columns (--displacement or displacement=)"
        )
    return names


def _nanoseconds(seconds: FloatArray, column: str, table: CsvTable | MatTable) -> NDArray[np.int64]:
    """Return stamps; times before zero move all stamps up, as messages cannot hold them."""
    table.require(np.isfinite(seconds), column, seconds, "every row needs a time")
    table.require(np.abs(seconds) < _TIME_END, column, seconds, "more than 2^31 s; is the unit right?")
    _require_order(seconds, column, table)
    stamps: NDArray[np.int64] = np.rint((seconds - min(seconds[0], 0.0)) * 1e9).astype(np.int64)
    return stamps


def _require_order(seconds: FloatArray, column: str, table: CsvTable | MatTable) -> None:
    forward = np.concatenate([[True], np.diff(seconds) >= 0])
    table.require(forward, column, seconds, "time runs backwards here; sort or cut the table")
