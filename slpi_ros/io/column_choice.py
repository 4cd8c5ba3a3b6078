"""Which column of a table is time, voltage and displacement: by option, else by name."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import NoReturn

from slpi_ros.errors import RecordError, UsageError
from slpi_ros.io.columns import DISPLACEMENT, TIME, VOLTAGE, Column, Quantity, axis_of, begins, named, unit_in
from slpi_ros.io.table_files import CsvTable, MatTable, called


@dataclass(frozen=True)
class Wishes:
    """What the caller says of the columns; all of it may be left out. See `slpi_ros.io.tables.import_table`."""

    time: str | None = None
    voltage: tuple[str, ...] = ()
    displacement: tuple[str, ...] = ()
    displacement_unit: str | None = None
    axes: tuple[str, ...] = ()


@dataclass(frozen=True)
class Choice:
    """The columns of a record.

    Parameters
    ----------
    time : Column
        Time.
    voltage, displacement : mapping of axis name to Column
        Of the same axes.
    """

    time: Column
    voltage: Mapping[str, Column]
    displacement: Mapping[str, Column]

    def columns(self) -> tuple[Column, ...]:
        """Return all columns."""
        return (self.time, *self.displacement.values(), *self.voltage.values())


def choose(table: CsvTable | MatTable, wishes: Wishes) -> Choice:
    """Choose the columns.

    Raises
    ------
    RecordError
        If there is none, their number does not match, or a name says a unit that is not known.
    UsageError
        If an option is wrong, contradicts a name, or gives one column two roles.
    """
    told = wishes.displacement_unit
    if told is not None and not DISPLACEMENT.unit(told):
        raise UsageError(f"no displacement unit '{told}'; choose {', '.join(DISPLACEMENT.units)}")
    source = str(table.path)
    time = named(called(wishes.time, table.columns) if wishes.time else _time_column(table), TIME, source=source)
    moved_names = [called(name, table.columns) for name in wishes.displacement] or _displacement_columns(table)
    moved = [named(name, DISPLACEMENT, told=told, source=source) for name in moved_names]
    driven_names = [called(name, table.columns) for name in wishes.voltage] or _voltage_columns(table, time, moved)
    driven = _one_for_each(moved, [named(name, VOLTAGE, source=source) for name in driven_names], source)
    axes = _axis_names(moved, wishes.axes, source)
    _require_one_role(time, moved, driven, source)
    return Choice(time, dict(zip(axes, driven, strict=True)), dict(zip(axes, moved, strict=True)))


def _time_column(table: CsvTable | MatTable) -> str:
    found = [n for n in table.columns if begins(n, TIME) or (unit_in(n, TIME) and axis_of(n, TIME).casefold() == "t")]
    with_unit = [name for name in found if unit_in(name, TIME)]
    if not found:
        _missing(table, TIME)
    return "time_s" if "time_s" in found else (with_unit or found)[0]


def _displacement_columns(table: CsvTable | MatTable) -> list[str]:
    for word in DISPLACEMENT.words:
        if found := [name for name in table.columns if name.lower().startswith(word)]:
            return found
    lengths = [name for name in table.columns if unit_in(name, DISPLACEMENT)]
    driven = {axis_of(name, VOLTAGE).casefold() for name in table.columns if unit_in(name, VOLTAGE)}
    for axes in (driven, {"x", "y", "z"}):
        if found := [name for name in lengths if axis_of(name, DISPLACEMENT).casefold() in axes]:
            return found
    _missing(table, DISPLACEMENT)


def _voltage_columns(table: CsvTable | MatTable, time: Column, moved: Sequence[Column]) -> list[str]:
    """Return the columns of voltage: where names tell one for each axis, these; else all."""
    taken = {time.name, *(column.name for column in moved)}
    found = [n for n in table.columns if n not in taken and (begins(n, VOLTAGE) or unit_in(n, VOLTAGE))]
    if not found:
        _missing(table, VOLTAGE)
    of_axes = [[n for n in found if axis_of(n, VOLTAGE).casefold() == m.axis.casefold()] for m in moved]
    return [names[0] for names in of_axes] if all(len(names) == 1 for names in of_axes) else found


def _missing(table: CsvTable | MatTable, quantity: Quantity) -> NoReturn:
    option = quantity.name
    raise RecordError(
        f"{table.path}: no {option} column; there is {table.listing()}; name one of them (--{option} or {option}=)"
    )


def _one_for_each(moved: Sequence[Column], driven: Sequence[Column], source: str) -> list[Column]:
    """Return one voltage column for each displacement column."""
    if len(driven) == 1:
        return [*driven] * len(moved)
    if len(driven) != len(moved):
        raise RecordError(
            f"{source}: {len(driven)} voltage columns ({_names(driven)}) for {len(moved)} of displacement "
            f"({_names(moved)}); name one voltage for all or one for each (--voltage or voltage=)"
        )
    return [*driven]


def _axis_names(moved: Sequence[Column], axes: Sequence[str], source: str) -> tuple[str, ...]:
    """Return one name for each displacement column, no two alike."""
    names = tuple(axes) or tuple(column.axis for column in moved)
    if len(names) != len(moved):
        raise UsageError(f"{source}: {len(names)} axes for the displacement columns {_names(moved)}")
    if len(set(names)) < len(names):
        raise RecordError(
            f"{source}: displacement columns {_names(moved)} are axes {', '.join(names)}, two of them the "
            "same; choose the columns (--displacement or displacement=)"
        )
    return names


def _require_one_role(time: Column, moved: Sequence[Column], driven: Iterable[Column], source: str) -> None:
    """Refuse a column that is more than one thing; only a voltage may be that of several axes."""
    names = [time.name, *(column.name for column in moved), *{column.name for column in driven}]
    for name in names:
        if names.count(name) > 1:
            raise UsageError(
                f"{source}: column '{name}' twice; time, each displacement and voltage need columns of their own "
                "(--time, --displacement, --voltage)"
            )


def _names(columns: Sequence[Column]) -> str:
    return ", ".join(column.name for column in columns)
