"""Tables in files: text of any layout, spreadsheets; the names of their columns, and their values as numbers."""

import codecs
import csv
import io
import re
import warnings
from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from slpi_ros.arrays import FloatArray, Mask
from slpi_ros.errors import RecordError
from slpi_ros.io.columns import QUANTITIES, begins, is_unit, joined, printable, unit_in
from slpi_ros.io.input_limits import (
    LONGEST_HEADER,
    MOST_COLUMNS,
    TABLE_BYTES,
    LimitError,
    open_input,
    read_input,
    require_count,
    require_unpacked,
)

# White space is last: names may hold spaces. Of two separators with as many columns the first one is taken.
_SEPARATORS = (";", "\t", ",", "|", " ")
_DECIMAL_MARKS = (".", ",")
_LINES_TO_SEARCH, _HEAD = 500, 16 * 2**20
# Lines above the data that may hold names, units and comments.
_HEADER_LINES = 4
_MARKS = {codecs.BOM_UTF8: "utf-8", codecs.BOM_UTF16_LE: "utf-16-le", codecs.BOM_UTF16_BE: "utf-16-be"}
_NO_TEXT = re.compile(r"[\0-\x08\x0e-\x19\x7f]")
_ENOUGH = 10_000
_BLOCK = 2**20
# Up to 15 digits and powers of ten up to 22 are exact, and so is their quotient; with a decimal mark, one digit less.
_LONG_NUMBER = b"0" * 16
# Rows that pandas reads at once.
_ROWS = 500_000
_COMMENT = re.compile(r"^\s*(?:[#%!]|//)+\s*")
# A date, a date with a time of day, or a time of day.
_WHEN = re.compile(r"\d{1,4}([-/.])\d{1,2}\1\d{1,4}(?:[T ]+\d.*)?|\d+:\d\d:\d\d(?:[.,]\d+)?(?: ?[AP]M)?", re.IGNORECASE)
# How programs write that there is no number, beside an empty cell.
_MISSING: tuple[str, ...] = ("nan", "NaN", "NAN", "-nan", "-NaN", "-nan(ind)", "1.#QNAN")
_MISSING += ("NA", "N/A", "n/a", "#N/A", "null", "NULL", "None")
_DAY, _HALF_A_DAY = 86_400.0, 43_200.0
# Of a file of LabVIEW (.lvm), the sampling period where it has no column of time.
_LABVIEW, _DELTA_X = "LabVIEW Measurement", re.compile(r"^Delta_X[\t,;]+([^\t,;\s]+)", re.MULTILINE)


@dataclass(frozen=True)
class Table(ABC):
    """Table in a file, whose columns are read by name."""

    path: Path
    columns: tuple[str, ...]
    period: float | None = field(default=None, kw_only=True)  # s, of the rows where the file tells it
    left_out: tuple[str, ...] = field(default=(), kw_only=True)  # what the file holds beside columns of numbers

    @abstractmethod
    def _values(self, wanted: Sequence[str]) -> dict[str, FloatArray]:
        """Return columns that are there once."""

    @abstractmethod
    def _place(self, row: int, column: str) -> str:
        """Return where a value is in the file."""

    def holds_dates(self, column: str) -> bool:
        """Return whether a column holds dates or times of day."""
        return False

    def single(self, column: str) -> float | None:
        """Return the value of a column that holds a single one, where the file allows that; else None."""
        return None

    def listing(self) -> str:
        """Return the names of the columns for a message."""
        return joined([column for column in self.columns if column])

    def read(self, wanted: Sequence[str]) -> dict[str, FloatArray]:
        """Return the wanted columns as numbers, each of shape (N,), N >= 2; an empty cell is NaN."""
        # Dates and times of day become seconds from the first one.
        for column in wanted:
            if self.columns.count(column) != 1:
                problem = "two columns" if column in self.columns else "no column"
                raise RecordError(f"{self.path}: {problem} '{column}'; there is {self.listing()}")
        values = self._values(list(dict.fromkeys(wanted)))
        rows = min((column.size for column in values.values()), default=0)
        if rows < 2:
            raise RecordError(f"{self.path}: {rows} rows of data; at least two are needed")
        return values

    def require(self, good: Mask, column: str, values: FloatArray, rule: str) -> None:
        """Raise RecordError, with the `rule`, for the first of the values (N,) that is not `good`."""
        if not good.all():
            row = int(np.argmin(good))
            raise RecordError(f"{self.path}: {self._place(row, column)}: {values[row]:.12g}; {rule}")


@dataclass(frozen=True)
class TextTable(Table):
    """Table in a text: lines of as many cells."""

    separator: str  # " ": any white space; if not a comma, numbers may have a decimal comma
    encoding: str
    start: int  # byte at which the rows begin
    first_line: int  # lines above them
    content: bytes | None = None  # of a spreadsheet, as text; None: in the file

    def _values(self, wanted: Sequence[str]) -> dict[str, FloatArray]:
        places = [self.columns.index(column) for column in wanted]
        rows = self._fast(places) or self._careful(places)
        return dict(zip(wanted, rows, strict=True))

    def holds_dates(self, column: str) -> bool:
        """Return whether a column holds dates or times of day."""
        place = self.columns.index(column)
        _, first = next(self._lines(), (0, []))
        return place < len(first) and bool(_WHEN.fullmatch(first[place].strip()))

    def _open(self) -> BinaryIO:
        file = open_input(self.path, TABLE_BYTES) if self.content is None else io.BytesIO(self.content)
        file.seek(self.start)
        return file

    def _fast(self, places: Sequence[int]) -> list[FloatArray] | None:
        """Read a table whose wanted cells are all numbers, or dates; None if it contains anything else."""
        import pandas as pd

        _, first = next(self._lines(), (0, []))
        if not first:
            return None
        dated = [place for place in places if self.holds_dates(self.columns[place])]
        # Cells beyond the header must be empty; rows that are longer than the first one are an error.
        beyond = range(len(self.columns), len(first))
        kinds: dict[int, Any] = dict.fromkeys(range(len(first)), object)
        kinds |= {place: str if place in dated else np.float64 for place in (*places, *beyond)}
        if max(places) >= len(first):
            return None
        marks = _DECIMAL_MARKS if self.separator != "," else _DECIMAL_MARKS[:1]
        comma = any("," in first[place] for place in places if place < len(first))
        # With pandas 2 long numbers are read to the last digit only on request; later it deprecates the request.
        old = int(pd.__version__.split(".")[0]) < 3
        exact: dict[str, Any] = {"float_precision": "round_trip"} if old and self._holds_long_numbers() else {}
        for mark in reversed(marks) if comma else marks:
            try:
                with self._open() as file, warnings.catch_warnings(action="error", category=pd.errors.ParserWarning):
                    parts = [
                        [part[place].to_numpy() for place in (*places, *beyond)]
                        for part in pd.read_csv(
                            file,
                            sep=self.separator if self.separator != " " else r"\s+",
                            header=None,
                            names=range(len(first)),
                            index_col=False,
                            dtype=kinds,
                            decimal=mark,
                            encoding=self.encoding,
                            na_values=_MISSING,
                            keep_default_na=False,
                            skipinitialspace=True,
                            chunksize=_ROWS,
                            **exact,
                        )
                    ]
            except (ValueError, OverflowError, pd.errors.ParserWarning):
                continue
            columns = [np.concatenate(column) for column in zip(*parts, strict=True)]
            # Cells that are missing are looked at line by line.
            if any(pd.isna(column).any() for column in columns[: len(places)]):
                return None
            if not all(np.isnan(column).all() for column in columns[len(places) :]):
                return None
            for place in dated:
                seconds = _seconds(columns[places.index(place)])
                if seconds is None:
                    return None
                columns[places.index(place)] = seconds
            return columns[: len(places)]
        return None

    def _holds_long_numbers(self) -> bool:
        """Return whether a number may have more digits than a quotient of two exact ones, or an exponent."""
        if self.encoding.startswith("utf-16"):
            return True
        marks = b"123456789." + (b"" if self.separator == "," else b",")
        alike = bytes.maketrans(marks, b"0" * len(marks))
        with self._open() as file:
            end = b""
            while block := file.read(_BLOCK):
                if b"e" in block or b"E" in block or _LONG_NUMBER in (plain := end + block.translate(alike)):
                    return True
                end = plain[-len(_LONG_NUMBER) :]
        return False

    def _careful(self, places: Sequence[int]) -> list[FloatArray]:
        """Read the table line by line; slower, but allows empty cells and names the line of an error."""
        cells: list[list[str]] = [[] for _ in places]
        lines = []
        marks, mixed = set[str](), 0
        for line, row in self._lines():
            while len(row) > len(self.columns) and not row[-1].strip():
                row.pop()
            if not max(places) < len(row) <= len(self.columns):
                raise RecordError(
                    f"{self.path}: line {line} has {len(row)} cells, the header {len(self.columns)}; write one cell "
                    "for each column, and numbers with a decimal point unless the separator is a semicolon or tab"
                )
            lines.append(line)
            for column, place in zip(cells, places, strict=True):
                column.append(row[place])
            if self.separator != ",":
                marks |= {",", "."} & set("".join(row[place] for place in places if not _WHEN.fullmatch(row[place])))
            mixed = mixed or (line if len(marks) > 1 else 0)
        columns = [self._numbers(one, lines, self.columns[place]) for one, place in zip(cells, places, strict=True)]
        if mixed:
            raise RecordError(
                f"{self.path}: line {mixed}: decimal commas and points in one table; write all numbers alike"
            )
        return columns

    def _numbers(self, cells: Sequence[str], lines: Sequence[int], column: str) -> FloatArray:
        if next((bool(_WHEN.fullmatch(cell.strip())) for cell in cells if cell.strip()), False):
            seconds = _seconds(np.array(cells, object))
            if seconds is not None:
                return seconds
        values = np.full(len(cells), np.nan)
        for row, cell in enumerate(cells):
            try:
                if cell.strip() and cell.strip() not in _MISSING:
                    values[row] = _to_float(cell if self.separator == "," else cell.replace(",", "."))
            except ValueError:
                raise RecordError(
                    f"{self.path}: line {lines[row]}, column '{column}': {cell[:40]!r} is not a number; "
                    "correct it or leave the cell empty"
                ) from None
        return values

    def _lines(self) -> Iterator[tuple[int, list[str]]]:
        """Yield the line number and the cells of every line that is neither blank nor a comment."""
        with io.TextIOWrapper(self._open(), self.encoding) as text:
            reader = csv.reader(map(_plain, text) if self.separator == " " else text, delimiter=self.separator)
            try:
                for cells in reader:
                    if any(map(str.strip, cells)) and not _COMMENT.match(cells[0]):
                        yield reader.line_num + self.first_line, cells
            except csv.Error as error:
                raise RecordError(
                    f"{self.path}: line {reader.line_num + self.first_line}: not a table ({error})"
                ) from error

    def _place(self, row: int, column: str) -> str:
        line, _ = next(islice(self._lines(), row, None))
        return f"line {line}, column '{column}'"


def _seconds(cells: Any) -> FloatArray | None:
    """Return dates or times of day, text of shape (N,), as seconds from the first one; None if one is neither."""
    import pandas as pd

    text = pd.Series(cells).str.strip().str.replace(",", ".").replace("", None)
    with suppress(ValueError, OverflowError):
        seconds = pd.to_timedelta(text).dt.total_seconds().to_numpy(np.float64)
        # After midnight they begin anew.
        return np.asarray(seconds + _DAY * np.cumsum(np.diff(seconds, prepend=seconds[0]) < -_HALF_A_DAY))
    found = []
    for way in ({"format": "ISO8601"}, {"format": "mixed"}, {"format": "mixed", "dayfirst": True}):
        with suppress(ValueError, OverflowError):
            when = pd.to_datetime(text, utc=True, **way)
            found.append((when - when.iloc[0]).dt.total_seconds().to_numpy(np.float64))
    # Whether day or month is first shows where a day ends: the record is the shorter one.
    return min(found, key=lambda seconds: float(np.nanmax(seconds) - np.nanmin(seconds)), default=None)


def load_text(path: Path, names: Sequence[str] = ()) -> TextTable:
    """Find the columns of a text: encoding, separator, decimal mark and header are detected, or its `names` given."""
    try:
        with open_input(path, TABLE_BYTES) as file:
            encoding, mark = _encoding(file, path)
            file.seek(mark)
            head = file.read(_HEAD)
    except FileNotFoundError:
        raise RecordError(f"{path}: no such file; give a table with comma-separated values") from None
    except OSError as error:
        raise RecordError(f"{path}: cannot be read ({error.strerror}); give a CSV file") from error
    return _of_text(path, head.decode(encoding, "ignore"), names, encoding, mark)


def load_spreadsheet(path: Path, names: Sequence[str] = (), sheet: str | None = None) -> TextTable:
    """Read a sheet of an Excel workbook; default: the only one that is not empty."""
    from openpyxl import load_workbook

    content = read_input(path, TABLE_BYTES)
    try:
        require_unpacked(content)
        with warnings.catch_warnings(action="ignore"):
            book = load_workbook(io.BytesIO(content), read_only=True, data_only=True)
            texts = {one.title: _as_text(one) for one in book.worksheets if sheet in (None, one.title)}
    except Exception as error:
        # Parsers of XML raise errors of many types.
        raise unreadable(path, error, "a spreadsheet", "save the sheet as CSV") from error
    filled = {title: text for title, text in texts.items() if text.strip()}
    if len(filled) != 1:
        listed = joined(list(filled) if sheet is None else book.sheetnames)
        raise RecordError(f"{path}: {len(filled)} sheets to choose from; name one of {listed or 'those'} (--sheet)")
    (text,) = filled.values()
    content = text.encode()
    return _of_text(path, text, names, "utf-8", 0, content)


def _as_text(sheet: Any) -> str:
    """Return the cells of a sheet as lines, separated by tabs."""
    rows = ([_cell_text(cell) for cell in row] for row in sheet.iter_rows(values_only=True))
    return "".join("\t".join(row) + "\n" for row in rows)


def _cell_text(cell: Any) -> str:
    if cell is None:
        return ""
    return " ".join((cell.isoformat(" ") if hasattr(cell, "hour") and hasattr(cell, "day") else str(cell)).split())


def unreadable(path: Path, error: Exception, kind: str, remedy: str) -> RecordError:
    """Return the error of a file that its library cannot read; `kind` says what it should be."""
    if isinstance(error, RecordError):
        return error
    reason = getattr(error, "strerror", None) or " ".join(str(error).split())[:200] or type(error).__name__
    return RecordError(f"{path}: cannot be read as {kind} ({reason}); {remedy}")


def _encoding(file: BinaryIO, path: Path) -> tuple[str, int]:
    """Return the encoding of a text and the size of its byte order mark."""
    first = file.read(4)
    mark = next((mark for mark in _MARKS if first.startswith(mark)), b"")
    for encoding in (_MARKS[mark],) if mark else ("utf-8", "latin-1"):
        file.seek(len(mark))
        decoder = codecs.getincrementaldecoder(encoding)()
        try:
            begin = decoder.decode(file.read(_BLOCK))
            good = not _NO_TEXT.search(begin, 0, _ENOUGH) and "\0" not in begin
            while good and (block := file.read(_BLOCK)):
                good = "\0" not in decoder.decode(block)
            decoder.decode(b"", final=True)
        except UnicodeError:
            continue
        if good:
            return encoding, len(mark)
    raise RecordError(f"{path}: not a text file; give a table with comma-separated values in UTF-8")


def _of_text(
    path: Path, head: str, names: Sequence[str], encoding: str, mark: int, content: bytes | None = None
) -> TextTable:
    """Return the table whose text begins with `head`."""
    try:
        lines = _first_lines(head)
        found = max(
            (at for separator in _SEPARATORS for at in _layouts(lines, separator, names)),
            key=lambda one: (one.clean, one.width, -_SEPARATORS.index(one.separator), -one.line),
            default=None,
        )
        found = found or _first_line(lines, path)
        require_count(len(found.columns), MOST_COLUMNS, "columns")
    except LimitError as error:
        raise RecordError(f"{path}: {error.strerror}; give a table with the columns of the stage only") from None
    if len(found.columns) < 2:
        raise RecordError(
            f"{path}: no line with the names of columns above lines of as many numbers, separated by comma, semicolon, "
            "tab or spaces; begin with a line such as time_s,x_V, or name them (--names)"
        )
    if all(_is_number(name) for name in found.columns):
        raise RecordError(
            f"{path}: numbers in the first line; put the names of the columns above them, or name them (--names)"
        )
    period = _DELTA_X.search(head) if head.startswith(_LABVIEW) else None
    return TextTable(
        path,
        tuple(printable(name) for name in found.columns),
        found.separator,
        encoding,
        mark + len(head[: found.end].encode(encoding)),
        found.line,
        content,
        period=_to_float(period[1].replace(",", ".")) if period and _is_number(period[1]) else None,
    )


@dataclass(frozen=True)
class _Line:
    """A line that is not blank: its number, its text, and the offset of its end in the whole text."""

    number: int
    text: str
    end: int


@dataclass(frozen=True)
class _Layout:
    """Names of columns, the separator, and the last line above the rows: its number, and the offset of its end."""

    columns: Sequence[str]
    separator: str
    line: int
    end: int
    width: int = 0  # cells of the first row
    clean: bool = False  # it holds numbers only


def _first_lines(text: str) -> list[_Line]:
    """Return the first lines that are not blank, to be searched for the column names."""
    lines: list[_Line] = []
    end = 0
    for number, line in enumerate(islice(io.StringIO(text, newline=""), _LINES_TO_SEARCH), 1):
        require_count(len(line), LONGEST_HEADER, f"characters in line {number}")
        end += len(line)
        if line.strip():
            lines.append(_Line(number, line, end))
        if end > 4 * LONGEST_HEADER and len(lines) > 2 * _HEADER_LINES:
            break
    return lines


def _layouts(lines: Sequence[_Line], separator: str, names: Sequence[str]) -> Iterator[_Layout]:
    """Yield the layouts that the first lines may have: rows of numbers, below a header or with the given names."""
    rows = [_cells(line.text, separator) for line in lines]
    for at, row in enumerate(rows):
        if not _is_data(row) or (at and _meets(rows[at - 1], row)):
            continue
        above = lines[at - 1] if at else _Line(0, "", 0)
        columns = _named(rows[at:], names) if names else _header(lines[:at], rows[:at], separator, row)
        if columns and not (names and _COMMENT.match(lines[at].text)):
            clean = all(map(_is_value, filter(None, row)))
            yield _Layout(columns, separator, above.number, above.end, len(_filled(row)), clean)


def _named(rows: Sequence[Sequence[str]], names: Sequence[str]) -> list[str]:
    """Return a name for each column of rows, "" for those that are not filled where `names` are fewer."""
    width = max(len(_filled(row)) for row in rows)
    if len(names) == width:
        return list(names)
    rest = iter(names)
    full = [all(place < len(row) and _is_value(row[place]) for row in rows) for place in range(width)]
    return [next(rest) if filled else "" for filled in full] if sum(full) == len(names) else []


def _header(lines: Sequence[_Line], rows: Sequence[Sequence[str]], separator: str, row: Sequence[str]) -> Sequence[str]:
    """Return the names of the columns above a row; [] if there are none."""
    # Directly above it are lines of names, units and comments, in any order.
    group: list[Sequence[str]] = []
    units: Sequence[str] = ()
    for line, cells in zip(reversed(lines[-_HEADER_LINES:]), reversed(rows[-_HEADER_LINES:]), strict=True):
        cells = _header_cells(line.text, separator, row) if separator == " " else _filled(cells)
        cells = [_COMMENT.sub("", cell) if not number else cell for number, cell in enumerate(cells)]
        # Names may be numbers, too, where a line of units is below them.
        if _meets(cells, row) and (group or not units or all(map(_is_value, filter(None, cells)))):
            break
        if len(cells) < len(_filled(row)):
            continue
        if _are_units(cells) and not units:
            units = cells
        elif sum(map(bool, cells)) > 1:
            group.append(cells)
    if not group:
        # Names that are units only, as `s` above `V`.
        return units
    widths = len(row), len(_filled(row))
    names = max(group, key=lambda cells: (not any(map(_is_value, cells)), _known_words(cells), len(cells) in widths))
    if units:
        plain = [unit.strip("()[] ") for unit in units] + [""] * len(names)
        names = [f"{name} [{unit}]" if unit else name for name, unit in zip(names, plain, strict=False)]
    return names


def _known_words(cells: Sequence[str]) -> int:
    return sum(any(begins(cell, q) or unit_in(cell, q) for q in QUANTITIES) for cell in cells)


def _are_units(cells: Sequence[str]) -> bool:
    units = [cell.strip("()[] ") for cell in cells]
    return sum(map(bool, units)) > 1 and all(is_unit(unit) for unit in units if unit)


def _first_line(lines: Sequence[_Line], path: Path) -> _Layout:
    """Return the first line as the header, for a text without a line of names above numbers."""
    if not lines:
        raise RecordError(f"{path}: no names in the first line; begin with a line such as time_s,x_V")
    split = ((_filled(_cells(lines[0].text, s)), s) for s in _SEPARATORS[:-1])
    columns, separator = max(split, key=lambda one: len(one[0]))
    return _Layout(columns, separator, lines[0].number, lines[0].end)


def _plain(line: str) -> str:
    return " ".join(line.split())


def _cells(line: str, separator: str) -> list[str]:
    """Return the cells of a line, stripped of white space; an empty list if the line is not part of a table."""
    try:
        plain = _plain(line) if separator == " " else line
        return [cell.strip() for cell in next(csv.reader([plain], delimiter=separator), [])]
    except csv.Error:
        return []


def _header_cells(line: str, separator: str, row: Sequence[str]) -> list[str]:
    """Return the names in a line whose columns are separated by white space, of which names may hold some."""
    text = _COMMENT.sub("", line.strip())
    ways = [_cells(text, separator), re.split(r"\s{2,}|\t", text), re.split(r"\s+(?![(\[])", text)]
    return next((cells for cells in ways if len(cells) == len(row)), ways[0])


def _filled(cells: Sequence[str]) -> Sequence[str]:
    """Return cells without empty ones at their end."""
    last = max((number for number, cell in enumerate(cells) if cell), default=-1)
    return cells[: last + 1]


def _is_data(cells: Sequence[str]) -> bool:
    """Return whether cells are a row of data: all that are not empty, or at least two, are numbers or dates."""
    numbers = sum(map(_is_number, cells))
    values = sum(map(_is_value, cells))
    return numbers > 0 and (values > 1 or values == sum(map(bool, cells)))


def _meets(cells: Sequence[str], row: Sequence[str]) -> bool:
    """Return whether cells have a value in the place of one of a row of data, so that they are none of its header."""
    return any(_is_value(cell) and _is_value(below) for cell, below in zip(cells, row, strict=False))


def _is_value(text: str) -> bool:
    return _is_number(text) or bool(_WHEN.fullmatch(text))


def _is_number(text: str) -> bool:
    try:
        _to_float(text.replace(",", "."))
    except ValueError:
        return False
    return True


def _to_float(text: str) -> float:
    """Return `float` of a cell; ValueError also for the digits of other scripts and for underscores between digits."""
    if "_" in text or not text.strip().isascii():
        raise ValueError(text)
    return float(text)
