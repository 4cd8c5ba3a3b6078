"""Errors of joint fits on data left out, for any choice of columns.

Whole records are left out in turn if there are several, blocks of a single one. The hysteresis is eliminated once for
each division of the data (Frisch-Waugh theorem); what a choice of columns leaves then takes a few small dense systems,
so that thousands of choices can be compared.
"""

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.linalg

from slpi_ros.arrays import FloatArray, IntArray, Mask

# Number of blocks in which errors are compared.
BLOCKS = 200
# Weight of a record that is left out in gains that the other records hardly determine.
UNDETERMINED = 0.05
# Largest error that is told, in multiples of the displacement.
FARTHEST = 1e6
# Regularisation that keeps the gains unique for collinear columns, relative to the size of the columns.
RIDGE = 1e-9


@dataclass(frozen=True)
class Loss:
    """Errors of one joint fit on data left out."""

    errors: FloatArray  # (n,), m, record by record in time order
    sample: IntArray  # (n,), the sample of each, ascending
    record: IntArray  # (n,), the record of each
    count: int  # number of records

    @cached_property
    def square(self) -> float:
        """Mean square, m^2."""
        return float(np.mean(self.errors**2))

    @property
    def rms(self) -> float:
        """Rms error, metres."""
        return float(np.sqrt(self.square))

    def beside(self, other: "Loss") -> tuple[FloatArray, FloatArray]:
        """Return the errors of both at the samples that both have, shape (n,) each."""
        if np.array_equal(self.sample, other.sample):
            return self.errors, other.errors
        _, own, its = np.intersect1d(self.sample, other.sample, assume_unique=True, return_indices=True)
        return self.errors[own], other.errors[its]

    @property
    def blocks(self) -> FloatArray:
        """Sums of squares of successive blocks, shape (blocks,), m^2."""
        return in_blocks(self.errors**2)

    @cached_property
    def records(self) -> FloatArray:
        """Mean square of each record, shape (records,), m^2; NaN: nothing of it is judged."""
        size = np.bincount(self.record, minlength=self.count).astype(np.float64)
        squares = np.bincount(self.record, self.errors**2, self.count)
        return np.asarray(squares / np.where(size > 0.0, size, np.nan))


def in_blocks(values: FloatArray) -> FloatArray:
    """Return the sums of values, shape (n,), over successive blocks, shape (blocks,)."""
    starts = np.unique(np.linspace(0, values.size, BLOCKS + 1).astype(np.int64))[:-1]
    sums: FloatArray = np.add.reduceat(values, starts)
    return sums


@dataclass(frozen=True)
class Division:
    """Rows left out: what the rest predicts of them."""

    errors: FloatArray  # (n, K), of each column, the hysteresis fitted to the rest
    rest: FloatArray  # (K, K), products of the columns in the rest, the hysteresis eliminated
    size: FloatArray  # (K,), root of the sum of squares of each column in all data
    place: IntArray  # (n,), where the errors belong; -1: not judged
    fold: IntArray  # (n,), fold of each row within a record that is left out; 0: never left out
    own: Mask  # (K,), columns that belong to the record left out alone; none for blocks of records

    @cached_property
    def _judged(self) -> list[IntArray]:
        """Rows of each fold that are judged."""
        folds = range(1, int(self.fold.max(initial=0)) + 1)
        return [np.flatnonzero((self.fold == fold) & (self.place >= 0)) for fold in folds]

    def left(self, target: Sequence[int], chosen: Sequence[int], positive: Collection[int]) -> FloatArray:
        """Return the errors, shape (n,), of the sum of the columns `target` after a fit of the columns `chosen`."""
        y, columns = self.errors[:, target].sum(axis=1), self.errors[:, chosen]
        matrix, vector = self.rest[np.ix_(chosen, chosen)], self.rest[np.ix_(chosen, target)].sum(axis=1)
        if not self.own.any() and not self.fold.any():
            gains = solved(matrix, vector, [k in positive for k in chosen], self.size[chosen])
            return np.asarray(y - columns @ gains)
        beside = np.column_stack([columns, np.ones(y.size)])
        whole = UNDETERMINED * (beside.T @ beside)
        whole[:-1, :-1] += matrix
        gains = solved(
            whole, UNDETERMINED * (beside.T @ y) + np.append(vector, 0.0), [*(k in positive for k in chosen), False]
        )
        own = np.append(self.own[list(chosen)], True)
        y = y - beside[:, ~own] @ gains[~own]
        beside = beside[:, own]
        square, product = beside.T @ beside, beside.T @ y
        size = np.sqrt(np.diag(square))
        left = np.asarray(y - beside @ solved(square, product))
        for rows in self._judged:
            part = beside[rows]
            left[rows] = y[rows] - part @ solved(square - part.T @ part, product - part.T @ y[rows], size=size)
        return left


class HeldOut:
    """Errors of columns on data left out."""

    # `divisions` and `whole`, the products of the columns, shape (K, K), the hysteresis eliminated, are in units of
    # the square of `unit` (m). `samples` and `records`, (n,), are of each judged sample.
    def __init__(
        self,
        divisions: Sequence[Division],
        whole: FloatArray,
        samples: IntArray,
        records: IntArray,
        count: int,
        unit: float,
    ) -> None:
        self._divisions, self.whole, self._unit = divisions, whole, unit
        self._samples, self._records, self._count = samples, records, count

    def loss(self, target: Sequence[int], chosen: Sequence[int], positive: Collection[int] = ()) -> Loss:
        """Return what a fit of columns leaves of the sum of others; gains in `positive` are not negative."""
        errors = np.zeros(self._records.size)
        for division in self._divisions:
            left, judged = division.left(target, chosen, positive), division.place >= 0
            errors[division.place[judged]] = left[judged]
        # A form far from the data may have errors beyond all bounds.
        errors = np.clip(np.nan_to_num(errors, nan=FARTHEST), -FARTHEST, FARTHEST)
        return Loss(errors * self._unit, self._samples, self._records, self._count)

    def gains(self, target: Sequence[int], chosen: Sequence[int], positive: Collection[int] = ()) -> FloatArray:
        """Return the gains, shape (k,), of a fit to all data."""
        vector = self.whole[np.ix_(chosen, target)].sum(axis=1)
        return solved(self.whole[np.ix_(chosen, chosen)], vector, [k in positive for k in chosen])


def solved(
    matrix: FloatArray, vector: FloatArray, positive: Sequence[bool] = (), size: FloatArray | None = None
) -> FloatArray:
    """Return the solution, shape (k,), of normal equations, with unknowns that are not negative where `positive`.

    `size`, shape (k,), is that of the columns; what the equations do not determine beside it is zero.
    """
    gains = np.zeros(vector.size)
    kept = np.arange(vector.size)
    size = np.maximum(np.sqrt(np.maximum(np.diag(matrix), 0.0)) if size is None else size, 1e-150)
    while kept.size:
        own = matrix[np.ix_(kept, kept)] / np.outer(size[kept], size[kept])
        found = _solved(own + RIDGE * np.eye(kept.size), vector[kept] / size[kept])
        bad = [k for k in range(kept.size) if positive and positive[kept[k]] and found[k] < 0.0]
        if not bad:
            gains[kept] = found / size[kept]
            break
        kept = np.delete(kept, min(bad, key=lambda k: float(found[k])))
    return gains


def _solved(matrix: FloatArray, vector: FloatArray) -> FloatArray:
    try:
        return np.asarray(scipy.linalg.solve(matrix, vector, assume_a="pos", check_finite=False))
    except np.linalg.LinAlgError:
        return np.asarray(np.linalg.lstsq(matrix, vector, rcond=RIDGE)[0])
