"""What the name of a column says: its unit, however it is written, and its axis."""

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

from slpi_ros.errors import RecordError, UsageError


@dataclass(frozen=True, eq=False)
class Quantity:
    """What a column can hold.

    Parameters
    ----------
    name : str
        For messages; the name of its option.
    default : str
        Unit where nothing says it.
    units : mapping of str to float
        Known units and their size in SI.
    words : tuple of str
        How names of its columns begin, in lower case.
    others : frozenset of str
        Endings of names that are units too, but none of this quantity, in lower case.
    """

    name: str
    default: str
    units: Mapping[str, float]
    words: tuple[str, ...]
    others: frozenset[str]

    def unit(self, text: str) -> str:
        """Return the known unit that a text means; "" if none. Case counts only where it decides."""
        plain = text.strip().replace("µ", "u").replace("μ", "u")
        if plain in self.units:
            return plain
        if plain.casefold() in _SPELT:
            spelt = _SPELT[plain.casefold()]
            return spelt if spelt in self.units else ""
        # Nm is no length; and MV may be meant as either
        one_case = plain in (plain.lower(), plain.upper()) and plain != "MV"
        return next((unit for unit in self.units if one_case and unit.casefold() == plain.casefold()), "")

    def is_other_unit(self, text: str) -> bool:
        """Return whether a text that is no unit of this quantity must be one of another."""
        if self.unit(text):
            return False
        folded = text.strip().casefold()
        almost = any(unit.casefold() == folded for unit in self.units)
        # names such as voltage_s and displacement_h rather end in the name of an axis
        foreign = any(q.unit(text) == text and (len(text) > 1 or text == "V") for q in QUANTITIES)
        return almost or foreign or folded in self.others


_COMMON = frozenset({"%", "percent", "pct", "count", "counts", "lsb", "bit", "bits", "deg", "ma", "hz", "khz", "a.u."})
_LENGTHS = {
    "in",
    "inch",
    "inches",
    "mil",
    "mils",
    "ft",
    "cm",
    "dm",
    "km",
    "å",
    "angstrom",
    "rad",
    "mrad",
    "urad",
    "µrad",
}

TIME = Quantity(
    "time",
    "s",
    {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "min": 60.0, "h": 3600.0},
    ("time",),
    _COMMON | {"m", "d", "day", "days", "ps"},
)
VOLTAGE = Quantity("voltage", "V", {"V": 1.0, "mV": 1e-3, "kV": 1e3}, ("voltage",), _COMMON | {"uv", "µv", "nv"})
DISPLACEMENT = Quantity(
    "displacement",
    "um",
    {"m": 1.0, "mm": 1e-3, "um": 1e-6, "nm": 1e-9, "pm": 1e-12},
    ("displacement", "position"),
    _COMMON | _LENGTHS,
)
QUANTITIES = (TIME, VOLTAGE, DISPLACEMENT)

_SPELT = {
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

_INDEX_OF_A_MATRIX = re.compile(r"\((?:\d+,:|:,\d+)\)$")
_BRACKETS = re.compile(r"[(\[]([^()\[\]]*)[)\]]")
_SPOKEN = re.compile(r"(?:\s+in\s+|\s*/\s+|\s+/\s*)(\S+)\s*$")
_PARTS = re.compile(r"[^\s_.,-]+")


@dataclass(frozen=True)
class Column:
    """A column of a table, and what its name says.

    Parameters
    ----------
    name : str
        As in the table.
    axis : str
        What its name holds beside the quantity and the unit; ``x`` if nothing.
    unit : str
        Unit of its values.
    scale : float
        Size of the unit in SI.
    assumed : bool
        Whether neither the name nor an option says the unit.
    """

    name: str
    axis: str
    unit: str
    scale: float
    assumed: bool


def named(name: str, quantity: Quantity, *, told: str | None = None, source: str = "table") -> Column:
    """Return what the name of a column says; units as in ``x_nm``, ``x (nm)``, ``x [nm]``, ``x in nm``, ``x / nm``.

    Parameters
    ----------
    name : str
        Name of the column.
    quantity : Quantity
        What it holds.
    told : str, optional
        Unit by option, for a name without one.
    source : str
        The table, for messages.

    Raises
    ------
    RecordError
        If the name says a unit that is not known.
    UsageError
        If it says another unit than the option.
    """
    stem, written = _split(name, quantity)
    unit = quantity.unit(written)
    if written and not unit:
        raise RecordError(
            f"{source}: column '{name}': '{written}' is no unit of {quantity.name} known here; choose another column, "
            f"or convert the values and rename it (units: {', '.join(quantity.units)})"
        )
    if told and unit and quantity.unit(told) != unit:
        raise UsageError(
            f"{source}: column '{name}' is in {unit} by its name, but --{quantity.name}-unit says {told}; "
            "leave the option out or rename the column"
        )
    known = unit or quantity.unit(told or "")
    size = known or quantity.default
    return Column(name, _axis(stem), size, quantity.units[size], assumed=not known)


def is_unit(text: str) -> bool:
    """Return whether a text is a unit of anything, also of what is not known here."""
    return any(quantity.unit(text) or quantity.is_other_unit(text) for quantity in QUANTITIES)


def unit_in(name: str, quantity: Quantity) -> str:
    """Return the known unit that a name says; "" if none."""
    return quantity.unit(_split(name, quantity)[1])


def axis_of(name: str, quantity: Quantity) -> str:
    """Return what a name holds beside quantity and unit."""
    return _axis(_split(name, quantity)[0])


def begins(name: str, quantity: Quantity) -> bool:
    """Return whether a name begins with a word for the quantity."""
    return name.lower().startswith(quantity.words)


def _split(name: str, quantity: Quantity) -> tuple[str, str]:
    """Return the rest of a name and the unit it says, as written; "" if it says none."""
    index = _INDEX_OF_A_MATRIX.search(name)
    body, index_text = (name[: index.start()], index.group()) if index else (name, "")
    for start, end, written in _written_units(body, quantity):
        stem = re.sub(r"[\s_]+in[\s_]*$", "", body[:start]) + body[end:]
        return stem + index_text, written
    return body + index_text, ""


def _written_units(name: str, quantity: Quantity) -> Iterator[tuple[int, int, str]]:
    """Yield begin, end and text of what may be the unit in a name, the surest first."""

    def is_any(text: str) -> bool:
        return bool(quantity.unit(text)) or quantity.is_other_unit(text)

    brackets = [(*found.span(), found.group(1).strip()) for found in _BRACKETS.finditer(name)]
    yield from (found for found in reversed(brackets) if is_any(found[2]))
    if (spoken := _SPOKEN.search(name)) and not brackets:
        yield (*spoken.span(), spoken.group(1))
    yield from (found for found in brackets if found[2] and found[1] == len(name.rstrip()))
    parts = [(*found.span(), found.group()) for found in _PARTS.finditer(name)]
    for number in range(len(parts) - 1, 0, -1):
        begin, end, text = parts[number]
        # inside a name, as in displacement_nm_x, a single letter is no unit
        if is_any(text) and (number == len(parts) - 1 or len(text) > 1):
            yield begin, end, text


def _axis(stem: str) -> str:
    for word in (word for quantity in QUANTITIES for word in quantity.words):
        if stem.lstrip().lower().startswith(word):
            stem = stem.lstrip()[len(word) :]
            break
    axis = stem.strip(" \t_.-,/")
    # what is left may stand in brackets
    if re.fullmatch(r"[(\[][^()\[\]]*[)\]]", axis) and not _INDEX_OF_A_MATRIX.search(axis):
        axis = axis[1:-1]
    return " ".join(axis.split()) or "x"
