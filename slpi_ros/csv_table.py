"""A text file with comma-separated numbers: fast where it is clean, precise about where it is not."""

import csv
import io
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from slpi_ros.errors import RecordError
from slpi_ros.identification.record import FloatArray


@dataclass(frozen=True)
class CsvTable:
    """The text of a table.

    Parameters
    ----------
    path : Path
        Where it came from, for messages.
    columns : tuple of str
        Names in the first line.
    body : str
        The lines below it.
    """

    path: Path
    columns: tuple[str, ...]
    body: str

    def listing(self) -> str:
        """Return the names of the columns for a message."""
        return listed(self.columns)

    def read(self, wanted: Sequence[str]) -> dict[str, FloatArray]:
        """Return the wanted columns as numbers, each of shape (N,), N >= 2; an empty cell is NaN.

        Raises
        ------
        RecordError
            If there is no such column, a cell holds something else, or there are fewer than two rows.
        """
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
        """Let NumPy read a table of nothing but numbers; None where it is not one."""
        if not self.body.strip():
            return np.empty((0, len(places)))
        try:
            rows = np.loadtxt(io.StringIO(self.body), delimiter=",", quotechar='"', comments=None, ndmin=2)
        except ValueError:
            return None
        # a decimal comma makes a regular table too, but one that is wider than its header
        return rows[:, places] if rows.shape[1] == len(self.columns) else None

    def _read_carefully(self, places: Sequence[int]) -> FloatArray:
        """Read cell by cell: finds empty cells, and the line that is wrong."""
        rows = []
        for line, cells in self._lines():
            if len(cells) != len(self.columns):
                raise RecordError(
                    f"{self.path}: line {line} has {len(cells)} cells, the first line {len(self.columns)}; "
                    "write numbers with a decimal point, and one cell for each column"
                )
            rows.append([self._number(cells[place], line, self.columns[place]) for place in places])
        return np.array(rows, float).reshape(-1, len(places))

    def _number(self, cell: str, line: int, column: str) -> float:
        try:
            return float(cell) if cell.strip() else np.nan
        except ValueError:
            raise RecordError(
                f"{self.path}: line {line}, column '{column}': {cell[:40]!r} is not a number; "
                "correct it or leave the cell empty"
            ) from None

    def _lines(self) -> Iterator[tuple[int, list[str]]]:
        """Yield number in the file and cells of every line that is not blank."""
        reader = csv.reader(io.StringIO(self.body))
        try:
            for cells in reader:
                if len(cells) > 1 or "".join(cells).strip():
                    yield reader.line_num + 1, cells
        except csv.Error as error:
            raise RecordError(f"{self.path}: line {reader.line_num + 1}: not a table ({error})") from error

    def require(self, good: NDArray[np.bool_], column: str, values: FloatArray, rule: str) -> None:
        """Raise RecordError for the first value that is not good.

        Parameters
        ----------
        good : ndarray of bool, shape (N,)
            What holds of the values.
        column : str
            Their column.
        values : ndarray, shape (N,)
            The values, one for each row.
        rule : str
            What the message says that must hold.
        """
        if not good.all():
            row = int(np.argmin(good))
            line, _ = next(islice(self._lines(), row, None))
            raise RecordError(f"{self.path}: line {line}, column '{column}': {values[row]:.12g}; {rule}")


def load_csv(path: Path) -> CsvTable:
    """Read the text and the names of the columns.

    Raises
    ------
    RecordError
        If the file cannot be read, or is not a table with names in the first line.
    """
    try:
        text = path.read_text("utf-8-sig")
    except FileNotFoundError:
        raise RecordError(f"{path}: no such file; give a table with comma-separated values") from None
    except OSError as error:
        raise RecordError(f"{path}: cannot be read ({error.strerror}); give a CSV file") from error
    except UnicodeDecodeError:
        text = "\0"
    if "\0" in text:
        raise RecordError(f"{path}: not a text file; give a table with comma-separated values in UTF-8")
    header, _, body = text.partition("\n")
    try:
        columns = tuple(name.strip() for name in next(csv.reader([header]), []))
    except csv.Error as error:
        raise RecordError(f"{path}: the first line holds no names of columns ({error})") from error
    if not any(columns):
        raise RecordError(f"{path}: no names in the first line; begin with a line such as time_s,x_V")
    if all(_is_number(name) for name in columns):
        raise RecordError(f"{path}: numbers in the first line; put the names of the columns above them")
    return CsvTable(path, columns, body)


def listed(names: Sequence[str]) -> str:
    """Return names for a message, not too many and without what would spoil a terminal."""
    text = ", ".join(names)
    return "".join(c if c.isprintable() else "?" for c in text[:200]) + ("..." if len(text) > 200 else "")


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True
