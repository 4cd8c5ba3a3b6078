"""Reading of text tables and MATLAB files, with errors that name the line and column."""

import csv
import io
import re
import struct
import zlib
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray
from scipy.io import loadmat, whosmat

from slpi_ros.arrays import FloatArray, Mask
from slpi_ros.errors import RecordError
from slpi_ros.io.columns import is_unit, joined, printable
from slpi_ros.io.input_limits import (
    ARRAY_BYTES,
    LONGEST_HEADER,
    MOST_COLUMNS,
    TABLE_BYTES,
    LimitError,
    most_unpacked,
    open_input,
    read_input,
    require_count,
)

# The comma is last: in tables with another separator it may be the decimal mark.
_SEPARATORS = (";", "\t", ",")
_LINES_TO_SEARCH = 100
_UTF_16_MARKS = (b"\xff\xfe", b"\xfe\xff")
_NO_TEXT = re.compile(r"[\0-\x08\x0e-\x19\x7f]")
_ENOUGH = 10_000
# Bytes of a MATLAB file that are unpacked at once, and type of a compressed element.
_UNPACKED_AT_ONCE, _MAT_COMPRESSED = 2**20, 15
_ENDLESS = 2**64
# Types of the parts of a matrix: flags, shape, name; numbers. Classes of numeric matrices, and flag of a complex one.
_MAT_HEADER, _MAT_NUMBERS = ({6}, {5, 6}, {1, 16}), {1, 2, 3, 4, 5, 6, 7, 9, 12, 13}
_MAT_NUMERIC, _MAT_COMPLEX = range(6, 16), 0x800


@dataclass(frozen=True)
class CsvTable:
    """Table in a text file."""

    path: Path
    columns: tuple[str, ...]
    body: str  # text below the line of column names
    separator: str = ","  # if not a comma, numbers may have a decimal comma
    header_line: int = 1

    def listing(self) -> str:
        """Return the names of the columns for a message."""
        return joined(self.columns)

    def read(self, wanted: Sequence[str]) -> dict[str, FloatArray]:
        """Return the wanted columns as numbers, each of shape (N,), N >= 2; an empty cell is NaN."""
        for column in wanted:
            if self.columns.count(column) != 1:
                problem = "two columns" if column in self.columns else "no column"
                raise RecordError(f"{self.path}: {problem} '{column}'; there is {self.listing()}")
        places = [self.columns.index(column) for column in wanted]
        rows = self._read_fast(places)
        if rows is None:
            rows = self._read_carefully(places)
        if len(rows) < 2:
            raise RecordError(f"{self.path}: {len(rows)} rows of data; at least two are needed")
        return dict(zip(wanted, rows.T.copy(), strict=True))

    def _read_fast(self, places: Sequence[int]) -> FloatArray | None:
        """Read a purely numeric table with NumPy; return None if the table contains anything else."""
        if not self.body.strip():
            return np.empty((0, len(places)))
        body = self.body
        if self.separator != "," and "," in body:
            if "." in body:
                return None
            body = body.replace(",", ".")
        try:
            rows = np.loadtxt(io.StringIO(body), delimiter=self.separator, quotechar='"', comments=None, ndmin=2)
        except ValueError:
            return None
        # Decimal commas in a comma-separated table give regular rows too, but more cells than the header has.
        return rows[:, places] if rows.shape[1] == len(self.columns) else None

    def _read_carefully(self, places: Sequence[int]) -> FloatArray:
        """Read the table cell by cell; slower, but allows empty cells and names the line of an error."""
        rows = []
        marks = set[str]()
        for line, cells in self._lines():
            if len(cells) != len(self.columns):
                raise RecordError(
                    f"{self.path}: line {line} has {len(cells)} cells, the header {len(self.columns)}; write one cell "
                    "for each column, and numbers with a decimal point unless the separator is a semicolon or tab"
                )
            rows.append([self._number(cells[place], line, self.columns[place]) for place in places])
            if self.separator != ",":
                marks |= {",", "."} & set("".join(cells[place] for place in places))
            if len(marks) > 1:
                raise RecordError(
                    f"{self.path}: line {line}: decimal commas and points in one table; write all numbers alike"
                )
        return np.array(rows, float).reshape(-1, len(places))

    def _number(self, cell: str, line: int, column: str) -> float:
        text = cell if self.separator == "," else cell.replace(",", ".")
        try:
            return _to_float(text) if text.strip() else np.nan
        except ValueError:
            raise RecordError(
                f"{self.path}: line {line}, column '{column}': {cell[:40]!r} is not a number; "
                "correct it or leave the cell empty"
            ) from None

    def _lines(self) -> Iterator[tuple[int, list[str]]]:
        """Yield the line number and the cells of every line that is not blank."""
        reader = csv.reader(io.StringIO(self.body), delimiter=self.separator)
        try:
            for cells in reader:
                if any(map(str.strip, cells)):
                    yield reader.line_num + self.header_line, cells
        except csv.Error as error:
            raise RecordError(
                f"{self.path}: line {reader.line_num + self.header_line}: not a table ({error})"
            ) from error

    def require(self, good: Mask, column: str, values: FloatArray, rule: str) -> None:
        """Raise RecordError, with the `rule`, for the first of the values (N,) that is not `good`."""
        if not good.all():
            row = int(np.argmin(good))
            line, _ = next(islice(self._lines(), row, None))
            raise RecordError(f"{self.path}: line {line}, column '{column}': {values[row]:.12g}; {rule}")


def load_csv(path: Path) -> CsvTable:
    """Read the text and the column names of a table; encoding, separator and header line are detected."""
    text = _text(path)
    try:
        lines = _first_lines(text)
        header = next(filter(None, (_header(lines, separator) for separator in _SEPARATORS)), None)
        header = header or _first_line(lines, path)
        require_count(len(header.columns), MOST_COLUMNS, "columns")
    except LimitError as error:
        raise RecordError(f"{path}: {error.strerror}; give a table with the columns of the stage only") from None
    if len(header.columns) < 2:
        raise RecordError(
            f"{path}: no line with the names of columns above lines of as many numbers, separated by comma, semicolon "
            "or tab; begin with a line such as time_s,x_V"
        )
    if all(_is_number(name) for name in header.columns):
        raise RecordError(f"{path}: numbers in the first line; put the names of the columns above them")
    columns = tuple(printable(name) for name in header.columns)
    return CsvTable(path, columns, text[header.end :], header.separator, header.line)


@dataclass(frozen=True)
class _Line:
    """A line that is not blank: its number, its text, and the offset of its end in the whole text."""

    number: int
    text: str
    end: int


@dataclass(frozen=True)
class _Header:
    columns: tuple[str, ...]
    separator: str
    line: int
    end: int


def _text(path: Path) -> str:
    """Return the text of a file, with line feeds as line ends."""
    try:
        content = read_input(path, TABLE_BYTES)
    except FileNotFoundError:
        raise RecordError(f"{path}: no such file; give a table with comma-separated values") from None
    except OSError as error:
        raise RecordError(f"{path}: cannot be read ({error.strerror}); give a CSV file") from error
    encodings = ("utf-16",) if content[:2] in _UTF_16_MARKS else ("utf-8-sig", "latin-1")
    for encoding in encodings:
        with suppress(UnicodeError):
            text = io.TextIOWrapper(io.BytesIO(content), encoding).read()
            if not _NO_TEXT.search(text, 0, _ENOUGH) and "\0" not in text:
                return text
    raise RecordError(f"{path}: not a text file; give a table with comma-separated values in UTF-8")


def _first_lines(text: str) -> list[_Line]:
    """Return the first lines that are not blank, to be searched for the column names."""
    lines: list[_Line] = []
    end = 0
    for number in range(1, _LINES_TO_SEARCH + 1):
        begin, end = end, (text.find("\n", end) + 1 or len(text))
        require_count(end - begin, LONGEST_HEADER, f"characters in line {number}")
        if text[begin:end].strip():
            lines.append(_Line(number, text[begin:end], end))
    return lines


def _header(lines: Sequence[_Line], separator: str) -> _Header | None:
    """Return the header: the line of names directly above a line of as many numbers; if several, the widest one."""
    # If that line contains units only, the names are in the line above it.
    rows = [_cells(line.text, separator) for line in lines]
    tops = [at for at in range(len(rows) - 1) if _are_names(rows[at]) and _are_numbers(rows[at + 1], rows[at])]
    if not tops:
        return None
    at = max(tops, key=lambda at: len(rows[at]))
    columns, above = rows[at], rows[at - 1] if at else []
    units = [name.strip("()[] ") for name in columns]
    if len(above) == len(columns) and _are_names(above) and all(is_unit(unit) for unit in units if unit):
        columns = [f"{name} [{unit}]" if unit else name for name, unit in zip(above, units, strict=True)]
    return _Header(tuple(columns), separator, lines[at].number, lines[at].end)


def _first_line(lines: Sequence[_Line], path: Path) -> _Header:
    """Return the first line as the header, for a text without a line of names above numbers."""
    if not lines:
        raise RecordError(f"{path}: no names in the first line; begin with a line such as time_s,x_V")
    columns, separator = max(((_cells(lines[0].text, s), s) for s in _SEPARATORS), key=lambda split: len(split[0]))
    return _Header(tuple(columns), separator, lines[0].number, lines[0].end)


def _cells(line: str, separator: str) -> list[str]:
    """Return the cells of a line, stripped of white space; an empty list if the line is not part of a table."""
    try:
        return [cell.strip() for cell in next(csv.reader([line], delimiter=separator), [])]
    except csv.Error:
        return []


def _are_names(cells: Sequence[str]) -> bool:
    return sum(map(bool, cells)) > 1 and not any(_is_number(cell) for cell in cells)


def _are_numbers(cells: Sequence[str], names: Sequence[str]) -> bool:
    """Return whether the cells below `names` are a row of data: all non-empty cells, or at least two, are numbers."""
    numbers = sum(map(_is_number, cells))
    return len(cells) == len(names) and (numbers > 1 or numbers == sum(map(bool, cells)) > 0)


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


_NUMERIC = {"double", "single", "logical", *(f"{sign}int{bits}" for sign in ("", "u") for bits in (8, 16, 32, 64))}


@dataclass(frozen=True)
class MatTable:
    """Vectors in a MATLAB file; a matrix is split into vectors along its longer side."""

    path: Path
    columns: tuple[str, ...]  # ``name`` of a vector; ``name(:,1)``, .. or ``name(1,:)``, .. of a matrix

    def listing(self) -> str:
        """Return the names of the columns for a message."""
        return joined(self.columns)

    def read(self, wanted: Sequence[str]) -> dict[str, FloatArray]:
        """Return the wanted columns, each of shape (N,), N >= 2."""
        for column in wanted:
            if column not in self.columns:
                raise RecordError(f"{self.path}: no numeric array '{column}'; there is {self.listing()}")
        variables = {column: column.partition("(")[0] for column in wanted}
        arrays = _loaded(self.path, list(variables.values()))
        values = {column: _vector(arrays[variables[column]], column) for column in wanted}
        for column, vector in values.items():
            if np.iscomplexobj(vector):
                raise RecordError(f"{self.path}: '{column}' is complex; save its real part")
            if vector.size != values[wanted[0]].size or vector.size < 2:
                raise RecordError(
                    f"{self.path}: '{column}' has {vector.size} values, '{wanted[0]}' {values[wanted[0]].size}; "
                    "as many are needed of each, at least two"
                )
        return {column: vector.astype(np.float64) for column, vector in values.items()}

    def require(self, good: Mask, column: str, values: FloatArray, rule: str) -> None:
        """Raise RecordError for the first value that is not good; see `CsvTable.require`."""
        if not good.all():
            at = int(np.argmin(good))
            raise RecordError(f"{self.path}: value {at + 1} of '{column}': {values[at]:.12g}; {rule}")


def load_mat(path: Path) -> MatTable:
    """Find the numeric vectors and matrices in a MATLAB file."""
    columns: list[str] = []
    others = []
    for name, shape, kind in _joined(path):
        plain = name.isidentifier() and kind in _NUMERIC and len(shape) == 2
        if not plain or 0 in shape or len(columns) + min(shape) > MOST_COLUMNS:
            others.append(f"{name} ({kind}, {'x'.join(map(str, shape))})")
        elif 1 in shape:
            columns.append(name)
        else:
            along = "{name}(:,{number})" if shape[0] >= shape[1] else "{name}({number},:)"
            columns += [along.format(name=name, number=number + 1) for number in range(min(shape))]
    if not columns:
        raise RecordError(f"{path}: no numeric vector; there is {joined(others) or 'nothing'}; save plain arrays")
    return MatTable(path, tuple(columns))


def _joined(path: Path) -> list[tuple[str, tuple[int, ...], str]]:
    """Return name, shape and class of the variables in a file."""
    try:
        with open_input(path, TABLE_BYTES) as file:
            _require_small(file)
            return list(whosmat(file))
    except LimitError as error:
        raise RecordError(f"{path}: {error.strerror}; save only the vectors of the record") from None
    except FileNotFoundError:
        raise RecordError(f"{path}: no such file; give a MATLAB file") from None
    except NotImplementedError:
        raise RecordError(f"{path}: a MATLAB file of version 7.3; save it anew with `save(..., '-v7')`") from None
    except Exception as error:
        # SciPy raises exceptions of many types for files that are damaged or not MATLAB files.
        raise _unreadable(path, error) from error


def _require_small(file: BinaryIO) -> None:
    """Raise LimitError if a MATLAB file is too large for a record; ValueError if a numeric matrix has a wrong type."""
    # From version 5 on it is a header of 128 bytes and elements: type, size and data, each as a whole compressed or not
    # (https://www.mathworks.com/help/pdf_doc/matlab/matfile_format.pdf).
    size = file.seek(0, 2)
    left = min(ARRAY_BYTES, most_unpacked(size))
    file.seek(124)
    order = {b"IM": "<", b"MI": ">"}.get(file.read(4)[2:], "")
    variables, at = 0, 128
    while order and at + 8 <= size:
        file.seek(at)
        tag = file.read(8)
        kind, length = struct.unpack(f"{order}II", tag)
        at += 8 + length
        variables += 1
        require_count(variables, MOST_COLUMNS, "variables")
        matrix = _Matrix(order)
        if kind != _MAT_COMPRESSED:
            matrix.check(tag)
            for begin in range(0, length, _UNPACKED_AT_ONCE):
                matrix.check(file.read(min(length - begin, _UNPACKED_AT_ONCE)))
            matrix.finish()
            continue
        decoder, packed = zlib.decompressobj(), file.read(length)
        while packed:
            data = decoder.decompress(packed, _UNPACKED_AT_ONCE)
            packed = decoder.unconsumed_tail if data else b""
            left -= len(data)
            if left < 0:
                raise LimitError("unpacks to more than any record")
            matrix.check(data)
        matrix.finish()
    file.seek(0)


class _Matrix:
    """Check the parts of a numeric matrix in a MATLAB file: SciPy ends the process at some wrong types."""

    # A matrix is a sequence of words of 8 bytes: its own type, then type and content of its flags, shape, name, real
    # and imaginary data. The content of a short part is in the word of its type.
    def __init__(self, order: str) -> None:
        self._order = order
        self._words, self._begun, self._skipped, self._parts, self._expected = 0, b"", 0, 0, 0

    def check(self, data: bytes) -> None:
        """Check the next bytes of the matrix; ValueError for a wrong type."""
        at = 0
        while at < len(data):
            if self._skipped:
                skipped = min(self._skipped, len(data) - at)
                self._skipped -= skipped
                at += skipped
                continue
            taken = data[at : at + 8 - len(self._begun)]
            self._begun += taken
            at += len(taken)
            if len(self._begun) == 8:
                self._read_word(*struct.unpack(f"{self._order}II", self._begun))
                self._begun = b""
                self._words += 1

    def finish(self) -> None:
        """Check that no part is missing; ValueError."""
        if self._parts < self._expected:
            raise ValueError(f"{self._parts} of {self._expected} parts of a variable")

    def _read_word(self, kind: int, length: int) -> None:
        if self._words == 0:
            return
        if self._words == 2:
            # The flags; nothing of other classes is read.
            numeric, is_complex = kind & 0xFF in _MAT_NUMERIC, bool(kind & _MAT_COMPLEX)
            self._expected = 4 + is_complex if numeric else 0
            self._skipped = 0 if numeric else _ENDLESS
            return
        known = _MAT_HEADER[self._parts] if self._parts < len(_MAT_HEADER) else _MAT_NUMBERS
        if kind >> 16:
            kind &= 0xFFFF
        elif self._parts:
            # The content is padded to whole words.
            self._skipped = -(-length // 8) * 8
        if kind not in known:
            raise ValueError(f"part {self._parts + 1} of a variable has the wrong type {kind}")
        self._parts += 1


def _loaded(path: Path, variables: list[str]) -> dict[str, NDArray[np.generic]]:
    try:
        with open_input(path, TABLE_BYTES) as file:
            return dict(loadmat(file, variable_names=variables))
    except Exception as error:
        raise _unreadable(path, error) from error


def _unreadable(path: Path, error: Exception) -> RecordError:
    reason = " ".join(str(error).split())[:200] or type(error).__name__
    return RecordError(f"{path}: cannot be read as a MATLAB file ({reason}); save it anew with `save(..., '-v7')`")


def _vector(array: NDArray[np.generic], column: str) -> NDArray[np.generic]:
    """Return the vector of an array that the name of a column selects."""
    _, _, indices = column.rstrip(")").partition("(")
    if not indices:
        return array.ravel()
    row, column_number = (slice(None) if index == ":" else int(index) - 1 for index in indices.split(","))
    vector: NDArray[np.generic] = array[row, column_number]
    return vector
