"""A MATLAB file of numeric arrays, read as a table with a column for each vector."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.io import loadmat, whosmat

from slpi_ros.errors import RecordError
from slpi_ros.io.record import FloatArray
from slpi_ros.io.table_files import listed

_NUMERIC = {"double", "single", "logical", *(f"{sign}int{bits}" for sign in ("", "u") for bits in (8, 16, 32, 64))}


@dataclass(frozen=True)
class MatTable:
    """The vectors of a MATLAB file; of a matrix, those along its longer side.

    Parameters
    ----------
    path : Path
        Where it came from.
    columns : tuple of str
        ``name`` of a vector; ``name(:,1)``, ``name(:,2)``, ... or ``name(1,:)``, ... of a matrix.
    """

    path: Path
    columns: tuple[str, ...]

    def listing(self) -> str:
        """Return the names of the columns for a message."""
        return listed(self.columns)

    def read(self, wanted: Sequence[str]) -> dict[str, FloatArray]:
        """Return the wanted columns, each of shape (N,), N >= 2.

        Raises
        ------
        RecordError
            If there is no such column, they differ in length, have fewer than two values, or are complex.
        """
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

    def require(self, good: NDArray[np.bool_], column: str, values: FloatArray, rule: str) -> None:
        """Raise RecordError for the first value that is not good; see `CsvTable.require`."""
        if not good.all():
            at = int(np.argmin(good))
            raise RecordError(f"{self.path}: value {at + 1} of '{column}': {values[at]:.12g}; {rule}")


def load_mat(path: Path) -> MatTable:
    """Find the numeric vectors and matrices in a file.

    Raises
    ------
    RecordError
        If the file cannot be read, is of MATLAB v7.3, or holds no numeric vector.
    """
    columns: list[str] = []
    others = []
    for name, shape, kind in _listed(path):
        if kind not in _NUMERIC or len(shape) != 2 or 0 in shape:
            others.append(f"{name} ({kind}, {'x'.join(map(str, shape))})")
        elif 1 in shape:
            columns.append(name)
        else:
            along = "{name}(:,{number})" if shape[0] >= shape[1] else "{name}({number},:)"
            columns += [along.format(name=name, number=number + 1) for number in range(min(shape))]
    if not columns:
        raise RecordError(f"{path}: no numeric vector; there is {listed(others) or 'nothing'}; save plain arrays")
    return MatTable(path, tuple(columns))


def _listed(path: Path) -> list[tuple[str, tuple[int, ...], str]]:
    """Return name, shape and class of the variables."""
    try:
        with path.open("rb") as file:
            return list(whosmat(file))
    except FileNotFoundError:
        raise RecordError(f"{path}: no such file; give a MATLAB file") from None
    except NotImplementedError:
        raise RecordError(f"{path}: a MATLAB file of version 7.3; save it anew with `save(..., '-v7')`") from None
    except Exception as error:
        # scipy tells in any way that a file is no MATLAB file, or a damaged one
        raise _unreadable(path, error) from error


def _loaded(path: Path, variables: list[str]) -> dict[str, NDArray[np.generic]]:
    try:
        with path.open("rb") as file:
            return dict(loadmat(file, variable_names=variables))
    except Exception as error:
        raise _unreadable(path, error) from error


def _unreadable(path: Path, error: Exception) -> RecordError:
    reason = " ".join(str(error).split())[:200] or type(error).__name__
    return RecordError(f"{path}: cannot be read as a MATLAB file ({reason}); save it anew with `save(..., '-v7')`")


def _vector(array: NDArray[np.generic], column: str) -> NDArray[np.generic]:
    """Return the vector that the name of a column means."""
    _, _, indices = column.rstrip(")").partition("(")
    if not indices:
        return array.ravel()
    row, column_number = (slice(None) if index == ":" else int(index) - 1 for index in indices.split(","))
    vector: NDArray[np.generic] = array[row, column_number]
    return vector
