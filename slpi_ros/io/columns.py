"""Interpretation of column names (quantity, unit, axis) and choice of the columns of a record."""

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import NoReturn

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

# Word by which the name of a column says that its displacement is a desired one.
_DESIRED = re.compile(r"(?<![^\W\d_])(?:desired|set[ _-]?point)(?![^\W\d_])", re.IGNORECASE)
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
    """Return `name` if it is a column, else the only column that equals it except for case; `name` if there is none."""
    alike = [column for column in columns if column.casefold() == name.casefold()]
    return alike[0] if len(alike) == 1 and name not in columns else name


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
    voltage: tuple[str, ...] = ()
    displacement: tuple[str, ...] = ()
    displacement_unit: str | None = None
    axes: tuple[str, ...] = ()
    desired: tuple[str, ...] = ()


@dataclass(frozen=True)
class ColumnChoice:
    """The columns of a record; `voltage` and `displacement` have the same axes, `desired` some of them or none."""

    time: Column
    voltage: Mapping[str, Column]
    displacement: Mapping[str, Column]
    desired: Mapping[str, Column] = field(default_factory=dict)
    left_out: tuple[str, ...] = ()  # names of desired columns, each with the reason
    quantities: tuple[str, ...] = ()  # columns of recorded quantities, named by their topics
    others: tuple[str, ...] = ()  # columns that are nothing of this

    def columns(self) -> tuple[Column, ...]:
        """Return all columns."""
        return (self.time, *self.displacement.values(), *self.voltage.values(), *self.desired.values())


def choose_columns(names: Sequence[str], options: ColumnOptions, source: str) -> ColumnChoice:
    """Choose the columns of a record among the `names` of all columns of the table, by option, else by name."""
    given_unit = options.displacement_unit
    if given_unit is not None and not DISPLACEMENT.unit(given_unit):
        raise UsageError(f"no displacement unit '{given_unit}'; choose {', '.join(DISPLACEMENT.units)}")
    time = parse_column(
        match_column(options.time, names) if options.time else _time_column(names, source), TIME, source=source
    )
    moved_names = [match_column(name, names) for name in options.displacement] or _displacement_columns(names, source)
    if len(moved_names) > MOST_AXES:
        raise RecordError(
            f"{source}: {len(moved_names)} displacement columns, more than the {MOST_AXES} axes that a stage may have; "
            "choose some (--displacement or displacement=)"
        )
    moved = [parse_column(name, DISPLACEMENT, given_unit=given_unit, source=source) for name in moved_names]
    driven_names = [match_column(name, names) for name in options.voltage] or _voltage_columns(
        names, time, moved, source
    )
    driven = _one_for_each(moved, [parse_column(name, VOLTAGE, source=source) for name in driven_names], source)
    axes = _axis_names(moved, options.axes, source)
    taken = {time.name, *(column.name for column in (*moved, *driven))}
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
    _require_one_role(time, (*moved, *desired.values()), driven, source)
    used = {*taken, *(column.name for column in wanted)}
    rest = [name for name in names if name and name not in used]
    return ColumnChoice(
        time=time,
        voltage=dict(zip(axes, driven, strict=True)),
        displacement=dict(zip(axes, moved, strict=True)),
        desired=desired,
        left_out=tuple(f"'{name}': {reason}" for name, reason in left_out.items()),
        quantities=tuple(name for name in rest if name.startswith("/")),
        others=tuple(name for name in rest if not name.startswith("/") and name not in left_out),
    )


def _time_column(names: Sequence[str], source: str) -> str:
    found = [n for n in names if begins(n, TIME) or (unit_in(n, TIME) and axis_of(n, TIME).casefold() == "t")]
    with_unit = [name for name in found if unit_in(name, TIME)]
    if not found:
        _missing(names, source, TIME)
    return "time_s" if "time_s" in found else (with_unit or found)[0]


def _displacement_columns(every: Sequence[str], source: str) -> list[str]:
    names = [name for name in every if not is_desired(name)]
    for word in DISPLACEMENT.prefixes:
        if found := [name for name in names if name.lower().startswith(word)]:
            return found
    lengths = [name for name in names if unit_in(name, DISPLACEMENT)]
    driven = {axis_of(name, VOLTAGE).casefold() for name in names if unit_in(name, VOLTAGE)}
    for axes in (driven, {"x", "y", "z"}):
        if found := [name for name in lengths if axis_of(name, DISPLACEMENT).casefold() in axes]:
            return found
    _missing(every, source, DISPLACEMENT)


def _voltage_columns(names: Sequence[str], time: Column, moved: Sequence[Column], source: str) -> list[str]:
    """Return the voltage columns: one for each axis if the names match the axes one to one, else all."""
    taken = {time.name, *(column.name for column in moved)}
    found = [n for n in names if n not in taken and (begins(n, VOLTAGE) or unit_in(n, VOLTAGE))]
    if not found:
        _missing(names, source, VOLTAGE)
    axes = [axis_of(n, VOLTAGE).casefold() for n in found]
    of_axes = [[n for n, axis in zip(found, axes, strict=True) if axis == m.axis.casefold()] for m in moved]
    return [names[0] for names in of_axes] if all(len(names) == 1 for names in of_axes) else found


def _missing(names: Sequence[str], source: str, quantity: ColumnQuantity) -> NoReturn:
    option = quantity.name
    raise RecordError(
        f"{source}: no {option} column; there is {joined(names)}; name one of them (--{option} or {option}=)"
    )


def _one_for_each(moved: Sequence[Column], driven: Sequence[Column], source: str) -> list[Column]:
    """Return one voltage column for each displacement column."""
    if len(driven) == 1:
        return [*driven] * len(moved)
    if len(driven) != len(moved):
        raise RecordError(
            f"{source}: {len(driven)} voltage columns ({_column_names(driven)}) for {len(moved)} of displacement "
            f"({_column_names(moved)}); name one voltage for all or one for each (--voltage or voltage=)"
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
            "same; choose the columns (--displacement or displacement=)"
        )
    return names


def _require_one_role(time: Column, moved: Sequence[Column], driven: Iterable[Column], source: str) -> None:
    """Raise UsageError if a column has more than one role; one voltage column may serve several axes."""
    names = [time.name, *(column.name for column in moved), *{column.name for column in driven}]
    for name in names:
        if names.count(name) > 1:
            raise UsageError(
                f"{source}: column '{name}' twice; time, each displacement and voltage need columns of their own "
                "(--time, --displacement, --voltage, --desired)"
            )


def _column_names(columns: Sequence[Column]) -> str:
    return ", ".join(column.name for column in columns)
