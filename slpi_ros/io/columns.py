"""Interpretation of column names (quantity, unit, axis) and choice of the columns of a record."""

import math
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import NoReturn

import numpy as np

from slpi_ros.arrays import FloatArray
from slpi_ros.errors import RecordError, UsageError
from slpi_ros.io.input_limits import MOST_AXES


@dataclass(frozen=True, eq=False)
class ColumnQuantity:
    """A physical quantity that a column can hold."""

    name: str  # in messages, and of the option that selects its columns
    default: str  # unit if neither the column name nor an option gives one
    units: Mapping[str, float]  # SI values
    prefixes: tuple[str, ...]  # beginnings of the names of its columns, lower case
    others: frozenset[str]  # units that are recognized in a column name but not valid, lower case

    def unit(self, text: str) -> str:
        """Return the known unit that a text denotes, or ""; case matters only where it changes the meaning."""
        plain = text.strip().replace("µ", "u").replace("μ", "u")
        if plain in self.units:
            return plain
        if plain.casefold() in _SPELLED:
            spelled = _SPELLED[plain.casefold()]
            return spelled if spelled in self.units else ""
        # Nm (newton metre) is not a length, and MV may mean megavolt or millivolt.
        one_case = plain in (plain.lower(), plain.upper()) and plain != "MV"
        return next((unit for unit in self.units if one_case and unit.casefold() == plain.casefold()), "")

    def is_other_unit(self, text: str) -> bool:
        """Return whether a text is a unit, but not one of this quantity."""
        if self.unit(text):
            return False
        folded = text.strip().casefold()
        almost = any(unit.casefold() == folded for unit in self.units)
        # In names such as voltage_s and displacement_h, the last letter is more likely the name of an axis.
        foreign = any(q.unit(text) == text and (len(text) > 1 or text == "V") for q in QUANTITIES)
        return almost or foreign or folded in self.others


_COMMON = frozenset({"%", "percent", "pct", "count", "counts", "lsb", "bit", "bits", "deg", "ma", "hz", "khz", "a.u."})
_LENGTHS = {"in", "inch", "inches", "mil", "mils", "ft", "cm", "dm", "km", "å", "angstrom"}
_ANGLES = {"rad", "mrad", "urad", "µrad"}

TIME = ColumnQuantity(
    "time",
    "s",
    {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "min": 60.0, "h": 3600.0},
    ("time",),
    _COMMON | {"m", "d", "day", "days", "ps"},
)
VOLTAGE = ColumnQuantity("voltage", "V", {"V": 1.0, "mV": 1e-3, "kV": 1e3}, ("voltage",), _COMMON | {"uv", "µv", "nv"})
DISPLACEMENT = ColumnQuantity(
    "displacement",
    "um",
    {"m": 1.0, "mm": 1e-3, "um": 1e-6, "nm": 1e-9, "pm": 1e-12},
    ("displacement", "position"),
    _COMMON | _LENGTHS | _ANGLES,
)
QUANTITIES = (TIME, VOLTAGE, DISPLACEMENT)

_SPELLED = {
    **dict.fromkeys(("sec", "secs", "second", "seconds"), "s"),
    **dict.fromkeys(("msec", "millisecond", "milliseconds"), "ms"),
    **dict.fromkeys(("usec", "microsecond", "microseconds"), "us"),
    **dict.fromkeys(("mins", "minute", "minutes"), "min"),
    **dict.fromkeys(("hr", "hrs", "hour", "hours"), "h"),
    **dict.fromkeys(("volt", "volts"), "V"),
    **dict.fromkeys(("millivolt", "millivolts"), "mV"),
    **dict.fromkeys(("meter", "meters", "metre", "metres"), "m"),
    **dict.fromkeys(("millimeter", "millimeters", "millimetre", "millimetres"), "mm"),
    **dict.fromkeys(("micron", "microns", "micrometer", "micrometers", "micrometre", "micrometres"), "um"),
    **dict.fromkeys(("nanometer", "nanometers", "nanometre", "nanometres"), "nm"),
}

# Values of columns by name.
Reader = Callable[[Sequence[str]], Mapping[str, FloatArray]]
# Rows from which a line can be told from a loop; what is left beside a line is noise up to this multiple of its own.
FEWEST_FOR_A_LINE, AS_NOISE = 20, 1.5
# Median of the absolute value of a standard normal value.
NORMAL_MEDIAN = 0.6745
# Word by which the name of a column says that its displacement is a desired one.
_DESIRED = re.compile(r"(?<![^\W\d_])(?:desired|set[ _-]?point)(?![^\W\d_])", re.IGNORECASE)
# Names of columns of time: of LabVIEW, of MATLAB, and of a sampling period.
_TIMES = ("X_Value", "x_value", "t", "ts", "Ts")
_INDEX_OF_A_MATRIX = re.compile(r"\((?:\d+,:|:,\d+)\)$")
_BRACKETS = re.compile(r"[(\[]([^()\[\]]*)[)\]]")
_SEPARATED = re.compile(r"(?:\s+in\s+|\s*/\s+|\s+/\s*)(\S+)\s*$")
_PARTS = re.compile(r"[^\s_.,-]+")


@dataclass(frozen=True)
class Column:
    """Column of a table, with the axis and unit from its name."""

    name: str
    axis: str  # the part of the name that is neither quantity nor unit; x if there is none
    unit: str
    scale: float  # SI value of the unit
    assumed: bool  # neither the name nor an option gives the unit


def parse_column(
    name: str, quantity: ColumnQuantity, *, given_unit: str | None = None, source: str = "table"
) -> Column:
    """Parse the name of a column; unit as in ``x_nm``, ``x (nm)``, ``x [nm]``, ``x in nm``, ``x / nm``, or given."""
    stem, written = _split(name, quantity)
    unit = quantity.unit(written)
    if written and not unit:
        raise RecordError(
            f"{source}: column '{name}': '{written}' is no unit of {quantity.name} known here; choose another column, "
            f"or convert the values and rename it (units: {', '.join(quantity.units)})"
        )
    if given_unit and unit and quantity.unit(given_unit) != unit:
        raise UsageError(
            f"{source}: column '{name}' is in {unit} by its name, but --{quantity.name}-unit says {given_unit}; "
            "leave the option out or rename the column"
        )
    known = unit or quantity.unit(given_unit or "")
    size = known or quantity.default
    return Column(name, _axis(stem), size, quantity.units[size], assumed=not known)


def is_unit(text: str) -> bool:
    """Return whether a text is a unit of any quantity, including units that are recognized but not supported."""
    return any(quantity.unit(text) or quantity.is_other_unit(text) for quantity in QUANTITIES)


def unit_in(name: str, quantity: ColumnQuantity) -> str:
    """Return the known unit in the name of a column; "" if there is none."""
    return quantity.unit(_split(name, quantity)[1])


def axis_of(name: str, quantity: ColumnQuantity) -> str:
    """Return the part of a column name that is neither quantity nor unit; ``x`` if there is none."""
    return _axis(_split(name, quantity)[0])


def begins(name: str, quantity: ColumnQuantity) -> bool:
    """Return whether a name begins with a word for the quantity."""
    return name.lower().startswith(quantity.prefixes)


def is_desired(name: str) -> bool:
    """Return whether the name of a column says that it holds desired displacements."""
    return bool(_DESIRED.search(name)) and not any(begins(name, quantity) for quantity in (TIME, VOLTAGE))


def _parse_desired(name: str, given_unit: str | None, source: str) -> Column:
    """Parse the name of a column of desired displacements, whose word for them belongs to no axis."""
    column = parse_column(name, DISPLACEMENT, given_unit=given_unit, source=source)
    stem = _DESIRED.sub(" ", _split(name, DISPLACEMENT)[0])
    return replace(column, axis=_axis(stem.strip(" \t_.-,/")))


def _split(name: str, quantity: ColumnQuantity) -> tuple[str, str]:
    """Return a column name without its unit, and the unit as written, or "" if there is none."""
    index = _INDEX_OF_A_MATRIX.search(name)
    body, index_text = (name[: index.start()], index.group()) if index else (name, "")
    for start, end, written in _written_units(body, quantity):
        stem = re.sub(r"[\s_]+in[\s_]*$", "", body[:start]) + body[end:]
        return stem + index_text, written
    return body + index_text, ""


def _written_units(name: str, quantity: ColumnQuantity) -> Iterator[tuple[int, int, str]]:
    """Yield begin, end and text of each possible unit in a name, the most likely one first."""

    def is_any(text: str) -> bool:
        return bool(quantity.unit(text)) or quantity.is_other_unit(text)

    brackets = [(*found.span(), found.group(1).strip()) for found in _BRACKETS.finditer(name)]
    yield from (found for found in reversed(brackets) if is_any(found[2]))
    if (separated := _SEPARATED.search(name)) and not brackets:
        yield (*separated.span(), separated.group(1))
    yield from (found for found in brackets if found[2] and found[1] == len(name.rstrip()))
    parts = [(*found.span(), found.group()) for found in _PARTS.finditer(name)]
    for number in range(len(parts) - 1, 0, -1):
        begin, end, text = parts[number]
        # Inside a name, a unit has at least two letters, as in displacement_nm_x.
        if is_any(text) and (number == len(parts) - 1 or len(text) > 1):
            yield begin, end, text


def _axis(stem: str) -> str:
    for word in (word for quantity in QUANTITIES for word in quantity.prefixes):
        if stem.lstrip().lower().startswith(word):
            stem = stem.lstrip()[len(word) :]
            break
    axis = stem.strip(" \t_.-,/")
    # The rest may be enclosed in brackets.
    if re.fullmatch(r"[(\[][^()\[\]]*[)\]]", axis) and not _INDEX_OF_A_MATRIX.search(axis):
        axis = axis[1:-1]
    return " ".join(axis.split()) or "x"


def match_column(name: str, columns: Sequence[str]) -> str:
    """Return the column of this name, but for case and unit; `name` if there is none, or several."""
    if name in columns:
        return name
    # A unit in a line of its own is no part of the name that people see.
    for plain in (str.casefold, lambda column: column.casefold().rpartition(" [")[0]):
        alike = [column for column in columns if plain(column) == name.casefold()]
        if len(alike) == 1:
            return alike[0]
    return name


def joined(names: Sequence[str]) -> str:
    """Return the names joined for a message, limited to 200 printable characters."""
    text = ", ".join(names)
    return printable(text[:200]) + ("..." if len(text) > 200 else "")


def printable(text: str) -> str:
    """Replace control characters, which could disturb a terminal, by question marks."""
    return "".join(c if c.isprintable() or c == "\N{NO-BREAK SPACE}" else "?" for c in text)


@dataclass(frozen=True)
class ColumnOptions:
    """The options of `slpi_ros.io.tables.import_table`, all with default values."""

    time: str | None = None
    voltage: Sequence[str] = ()
    displacement: Sequence[str] = ()
    displacement_unit: str | None = None
    axes: Sequence[str] = ()
    desired: Sequence[str] = ()
    sample_period: float | None = None  # s, instead of a column of time
    sensor_scale: float | None = None  # m for one unit of a column of displacement
    amplifier_gain: float | None = None  # V at the stage for one unit of a column of voltage
    names: Sequence[str] = ()  # of the columns of a text without a header
    sheet: str | None = None  # of a workbook
    group: str | None = None  # of a TDMS file

    def __post_init__(self) -> None:
        for name in ("sample_period", "sensor_scale", "amplifier_gain"):
            value = getattr(self, name)
            least = 1e-9 if name == "sample_period" else -math.inf
            if value is not None and not (math.isfinite(value) and value != 0.0 and value >= least):
                raise UsageError(f"--{name.replace('_', '-')} {value:g}: give a number that can be one")
        if self.time and self.sample_period:
            raise UsageError("--time and --sample-period: give one of them")


@dataclass(frozen=True)
class ColumnChoice:
    """The columns of a record; `voltage` and `displacement` have the same axes, `desired` some of them or none."""

    time: Column | None  # None: the rows have a period
    voltage: Mapping[str, Column]
    displacement: Mapping[str, Column]
    desired: Mapping[str, Column] = field(default_factory=dict)
    left_out: tuple[str, ...] = ()  # names of desired columns, each with the reason
    monitors: tuple[str, ...] = ()  # columns in volts that are straight lines of the displacement
    quantities: tuple[str, ...] = ()  # columns of recorded quantities, named by their topics
    others: tuple[str, ...] = ()  # columns that are nothing of this

    def columns(self) -> tuple[Column, ...]:
        """Return all columns."""
        time = () if self.time is None else (self.time,)
        return (*time, *self.displacement.values(), *self.voltage.values(), *self.desired.values())


def choose_columns(
    names: Sequence[str], options: ColumnOptions, source: str, read: Reader, *, period: bool = False
) -> ColumnChoice:
    """Choose the columns of a record among the `names` of all columns of the table, by option, else by name.

    `read` returns the values of columns: of several in volts those that follow the displacement are told from the drive
    by them. With a `period` of the rows there need be no column of time.
    """
    given_unit = options.displacement_unit
    if given_unit is not None and not DISPLACEMENT.unit(given_unit):
        raise UsageError(f"no displacement unit '{given_unit}'; choose {', '.join(DISPLACEMENT.units)}")
    time_name = match_column(options.time, names) if options.time else _time_column(names, source, period)
    time = parse_column(time_name, TIME, source=source) if time_name else None
    moved_names = [match_column(name, names) for name in options.displacement]
    moved_names = moved_names or _displacement_columns(names, options.voltage, source)
    if len(moved_names) > MOST_AXES:
        raise RecordError(
            f"{source}: {len(moved_names)} displacement columns, more than the {MOST_AXES} axes that a stage may have; "
            "choose some (--displacement)"
        )
    if options.sensor_scale is None:
        moved = [parse_column(name, DISPLACEMENT, given_unit=given_unit, source=source) for name in moved_names]
    else:
        moved = [_scaled(name, options.sensor_scale, "m") for name in moved_names]
    driven_names = [match_column(name, names) for name in options.voltage]
    monitors: tuple[str, ...] = ()
    if not driven_names:
        driven_names, monitors = _voltage_columns(names, time_name, moved, source, read)
    if options.amplifier_gain is None:
        driven = [parse_column(name, VOLTAGE, source=source) for name in driven_names]
    else:
        driven = [_scaled(name, options.amplifier_gain, "V") for name in driven_names]
    driven = _one_for_each(moved, driven, source)
    axes = _axis_names(moved, options.axes, source)
    taken = {time_name, *(column.name for column in (*moved, *driven))}
    wanted_names, left_out = [match_column(name, names) for name in options.desired], dict[str, str]()
    for name in () if wanted_names else names:
        if name not in taken and is_desired(name):
            unit = _split(name, DISPLACEMENT)[1]
            if unit and not DISPLACEMENT.unit(unit):
                left_out[name] = f"{unit} is no unit of displacement"
            else:
                wanted_names.append(name)
    wanted = [_parse_desired(name, given_unit, source) for name in wanted_names]
    desired, of_none = _of_axes(wanted, moved, axes, source, named=bool(options.desired))
    left_out |= {column.name: f"no axis '{column.axis}'" for column in of_none}
    _require_one_role(time_name, (*moved, *desired.values()), driven, source)
    used = {*taken, *monitors, *(column.name for column in wanted)}
    rest = [name for name in names if name and name not in used]
    return ColumnChoice(
        time=time,
        voltage=dict(zip(axes, driven, strict=True)),
        displacement=dict(zip(axes, moved, strict=True)),
        desired=desired,
        left_out=tuple(f"'{name}': {reason}" for name, reason in left_out.items()),
        monitors=monitors,
        quantities=tuple(name for name in rest if name.startswith("/")),
        others=tuple(name for name in rest if not name.startswith("/") and name not in left_out),
    )


def _scaled(name: str, scale: float, unit: str) -> Column:
    """Return a column whose scale (SI value of one unit) is given."""
    named = next((quantity for quantity in QUANTITIES if unit_in(name, quantity)), DISPLACEMENT)
    return Column(name, axis_of(name, named), unit, scale, assumed=False)


def times_in(names: Sequence[str]) -> list[str]:
    """Return the columns that hold times by their names."""
    found = [n for n in names if begins(n, TIME) or (unit_in(n, TIME) and axis_of(n, TIME).casefold() == "t")]
    with_unit = [n for n in names if unit_in(n, TIME) and not (begins(n, VOLTAGE) or begins(n, DISPLACEMENT))]
    return found or (with_unit if len(with_unit) == 1 else [n for n in names if n in _TIMES])


def two_clocks(source: str, one: str, other: str, names: Sequence[str]) -> str:
    """Return what is wrong with a table of two columns of time, and what to do."""
    return (
        f"{source}: two columns of time, '{one}' and '{other}', of two clocks; there is {joined(names)}; write the "
        "rows of both one below the other, with one column of time and empty cells: the import aligns them"
    )


def _time_column(names: Sequence[str], source: str, period: bool) -> str:
    """Return the column of time; "" if there is none and none is needed."""
    found = times_in(names)
    with_unit = [name for name in found if unit_in(name, TIME)]
    if not found and not period:
        _missing(names, source, TIME, "or give the sampling period (--sample-period)")
    time = "time_s" if "time_s" in found else (with_unit or found or [""])[0]
    if found.count(time) > 1:
        raise RecordError(two_clocks(source, time, time, names))
    return time


def _displacement_columns(every: Sequence[str], driven: Sequence[str], source: str) -> list[str]:
    names = [name for name in every if not is_desired(name) and name not in driven]
    for word in DISPLACEMENT.prefixes:
        found = [name for name in names if name.lower().startswith(word)]
        # A sensor may be recorded in volts, too.
        if found := [name for name in found if not unit_in(name, VOLTAGE)] or found:
            return found
    lengths = [name for name in names if unit_in(name, DISPLACEMENT)]
    axes_driven = {axis_of(name, VOLTAGE).casefold() for name in names if unit_in(name, VOLTAGE)}
    for axes in (axes_driven, {"x", "y", "z"}):
        if found := [name for name in lengths if axis_of(name, DISPLACEMENT).casefold() in axes]:
            return found
    if len(lengths) == 1:
        return lengths
    _missing(every, source, DISPLACEMENT, "of a sensor's monitor in volts its scale, too (--sensor-scale)")


def _voltage_columns(
    names: Sequence[str], time: str, moved: Sequence[Column], source: str, read: Reader
) -> tuple[list[str], tuple[str, ...]]:
    """Return the voltage columns, one for each axis or one for all, and those that are monitors of the sensor."""
    taken = {time, *(column.name for column in moved)}
    found = [n for n in names if n not in taken and (begins(n, VOLTAGE) or unit_in(n, VOLTAGE))]
    found = found or [n for n in names if n not in taken and VOLTAGE.name in n.casefold()]
    if not found:
        _missing(names, source, VOLTAGE)
    monitors: tuple[str, ...] = ()
    if len(found) > 1:
        values: Mapping[str, FloatArray] = {}
        with suppress(RecordError):
            values = read([*found, *(column.name for column in moved)])
        monitors = tuple(n for n in values if n in found and any(is_line(values[n], values[m.name]) for m in moved))
        if len(monitors) < len(found):
            found = [n for n in found if n not in monitors]
        else:
            monitors = ()
    # A name that is of another quantity names no axis.
    own = {n: _split(n, VOLTAGE)[0].strip(" \t_.-,/").casefold() for n in found if not begins(n, DISPLACEMENT)}
    of_axes = [[n for n, stem in own.items() if _axis(stem) == m.axis.casefold() and stem] for m in moved]
    if len(found) > 1 and len(moved) > 1 and all(len(matching) == 1 for matching in of_axes):
        return [matching[0] for matching in of_axes], monitors
    if len(found) > 1 and (len(moved) == 1 or len(found) == len(moved)):
        raise RecordError(
            f"{source}: {len(found)} columns in volts ({joined(found)}), of which one may be a monitor of the sensor; "
            f"name the drive{' of each axis' if len(moved) > 1 else ''} (--voltage)"
        )
    return found, monitors


def is_line(x: FloatArray, y: FloatArray, fewest: int = FEWEST_FOR_A_LINE) -> bool:
    """Return whether one signal is a straight line of the other, both (N,): what is left is noise, or digits."""
    both = np.isfinite(x) & np.isfinite(y)
    x, y = x[both], y[both]
    if x.size < fewest or not (np.ptp(x) and np.ptp(y)):
        return False
    with np.errstate(over="ignore", invalid="ignore"):
        x, y = (x - x.mean()) / np.std(x), (y - y.mean()) / np.std(y)
    # Damaged values may be too far apart to be compared.
    if not (np.isfinite(x).all() and np.isfinite(y).all() and np.ptp(x) and np.ptp(y)):
        return False
    rest = y - np.mean(x * y) * x
    steps = [np.diff(np.unique(signal)) for signal in (x, y)]
    digits = max(float(step.min()) for step in steps)
    # A loop of hysteresis changes little from row to row; noise does, and digits are as large as they are. What is
    # hardly smaller than the signal is not beside a line.
    left = float(np.std(rest))
    return left <= max(AS_NOISE * _noise(rest), digits) and AS_NOISE * left < 1.0


def _noise(x: FloatArray) -> float:
    """Return the standard deviation of white noise with steps from row to row as large as the median of these."""
    return float(np.median(np.abs(np.diff(x)))) / (NORMAL_MEDIAN * 2**0.5)


def _missing(names: Sequence[str], source: str, quantity: ColumnQuantity, also: str = "") -> NoReturn:
    raise RecordError(
        f"{source}: no {quantity.name} column; there is {joined([name for name in names if name])}; name one of them "
        f"(--{quantity.name}){', ' if also else ''}{also}"
    )


def _one_for_each(moved: Sequence[Column], driven: Sequence[Column], source: str) -> list[Column]:
    """Return one voltage column for each displacement column."""
    if len(driven) == 1:
        return [*driven] * len(moved)
    if len(driven) != len(moved):
        raise RecordError(
            f"{source}: {len(driven)} voltage columns ({_column_names(driven)}) for {len(moved)} of displacement "
            f"({_column_names(moved)}); name one voltage for all or one for each (--voltage)"
        )
    return [*driven]


def _of_axes(
    wanted: Sequence[Column], moved: Sequence[Column], axes: Sequence[str], source: str, *, named: bool
) -> tuple[dict[str, Column], tuple[Column, ...]]:
    """Return the columns of desired displacements by axis, and those of no axis; `named`: by an option."""
    own = {column.axis.casefold(): axis for column, axis in zip(moved, axes, strict=True)}
    found: dict[str, Column] = {}
    left_out = []
    for column in wanted:
        axis = own.get(column.axis.casefold())
        if axis is None and len(moved) == len(wanted) == 1 and (named or column.axis == "x"):
            axis = axes[0]
        if axis is None or axis in found:
            left_out.append(column)
        else:
            found[axis] = column
    if named and left_out and len(wanted) == len(moved):
        # Names that tell no axis are in the order of the displacements.
        return dict(zip(axes, wanted, strict=True)), ()
    if any(own.get(column.axis.casefold()) in found for column in left_out) or (named and left_out):
        raise RecordError(
            f"{source}: desired displacements {_column_names(wanted)} for axes {', '.join(axes)}; name one column for "
            "each axis (--desired)"
        )
    return found, tuple(left_out)


def _axis_names(moved: Sequence[Column], axes: Sequence[str], source: str) -> tuple[str, ...]:
    """Return one axis name for each displacement column; all must be different."""
    names = tuple(axes) or tuple(column.axis for column in moved)
    if len(names) != len(moved):
        raise UsageError(f"{source}: {len(names)} axes for the displacement columns {_column_names(moved)}")
    if len(set(names)) < len(names):
        raise RecordError(
            f"{source}: displacement columns {_column_names(moved)} are axes {', '.join(names)}, two of them the "
            "same; choose the columns (--displacement)"
        )
    return names


def _require_one_role(time: str, moved: Sequence[Column], driven: Iterable[Column], source: str) -> None:
    """Raise UsageError if a column has more than one role; one voltage column may serve several axes."""
    names = [time, *(column.name for column in moved), *{column.name for column in driven}]
    for name in names:
        if names.count(name) > 1:
            raise UsageError(
                f"{source}: column '{name}' twice; time, each displacement and voltage need columns of their own "
                "(--time, --displacement, --voltage, --desired)"
            )


def _column_names(columns: Sequence[Column]) -> str:
    return ", ".join(column.name for column in columns)
