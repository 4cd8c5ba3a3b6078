"""Errors of joint fits on data left out, for any choice of columns.

Whole records are left out in turn if there are several, blocks of a single one. The hysteresis is eliminated once for
each division of the data (Frisch-Waugh theorem); what a choice of columns leaves then takes a few small dense systems,
so that thousands of choices can be compared.
"""

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

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


class Products:
    """Products of the columns, shape (n, K), of a matrix over groups of its rows, computed where they are asked for.

    The rows of a group follow each other, up to `ends`.
    """

    def __init__(self, columns: FloatArray, ends: Sequence[int]) -> None:
        self._columns, self._ends = columns, ends
        # What was asked for so far: places of the columns, copies of them, and their products in each group.
        self._place = np.full(columns.shape[1], -1)
        self._asked = np.empty((columns.shape[0], 0))
        self._products = np.empty((len(ends), 0, 0))

    def of(self, chosen: IntArray) -> FloatArray:
        """Return the products of columns, shape (groups, k, k)."""
        new = np.unique(chosen[self._place[chosen] < 0])
        if new.size:
            self._add(new)
        at = self._place[chosen]
        return self._products[:, at[:, None], at]

    def _add(self, new: IntArray) -> None:
        count = int(self._place.max()) + 1
        if count + new.size > self._asked.shape[1]:
            size = min(2 * (count + new.size), self._columns.shape[1])
            asked = np.empty((self._asked.shape[0], size), order="F")
            products = np.empty((len(self._ends), size, size))
            asked[:, :count], products[:, :count, :count] = self._asked[:, :count], self._products[:, :count, :count]
            self._asked, self._products = asked, products
        own, both = slice(count, count + new.size), slice(count + new.size)
        self._place[new] = np.arange(own.start, own.stop)
        self._asked[:, own] = self._columns[:, new]
        for product, (first, end) in zip(self._products, pairwise([0, *self._ends]), strict=True):
            product[both, own] = self._asked[first:end, both].T @ self._asked[first:end, own]
            product[own, both] = product[both, own].T


@dataclass(frozen=True)
class Division:
    """Rows left out, fold by fold up to `ends`: what the rest predicts of them.

    The rows of the first fold are not judged. In blocks all others are alike; a record that is left out has an offset
    of its own, and `own` columns, which are fitted to all of its folds but the judged one.
    """

    errors: FloatArray  # (n, K + 1), of each column, the hysteresis fitted to the rest; the last one is a constant
    ends: tuple[int, ...]
    rest: FloatArray  # (K, K), products of the columns in the rest, the hysteresis eliminated
    size: FloatArray  # (K,), root of the sum of squares of each column in all data
    place: IntArray  # (n,), where the errors belong
    own: Mask  # (K,), columns that belong to the record left out alone; none for blocks of records
    in_blocks: bool

    @cached_property
    def _products(self) -> Products:
        return Products(self.errors, self.ends)

    def coefficients(self, target: Sequence[int], chosen: Sequence[int], positive: Collection[int]) -> FloatArray:
        """Return the coefficients of the errors in each judged fold, shape (folds, k).

        Of the sum of the columns `target` after a fit of the columns `chosen`: those of both, and of the constant.
        """
        signs, count = [k in positive for k in chosen], len(target)
        matrix, vector = self.rest[np.ix_(chosen, chosen)], self.rest[np.ix_(chosen, target)].sum(axis=1)
        found = np.zeros((len(self.ends) - 1, count + len(chosen) + 1))
        found[:, :count] = 1.0
        if self.in_blocks:
            found[:, count:-1] = -solved(matrix, vector, signs, self.size[chosen])
            return found
        folds = self._products.of(self._columns(target, chosen))
        whole = folds.sum(axis=0)
        beside = UNDETERMINED * whole[count:]
        beside[:-1, count:-1] += matrix
        known = beside[:, :count].sum(axis=1)
        known[:-1] += vector
        gains = solved(beside[:, count:], known, [*signs, False])
        own = np.append(self.own[chosen], True)
        found[:, count:][:, ~own] = -gains[~own]
        at = count + np.flatnonzero(own)
        others = whole[at] - folds[1:, at]
        size = np.maximum(np.sqrt(np.diag(whole)[at]), 1e-150)
        matrices = others[:, :, at] / np.outer(size, size) + RIDGE * np.eye(at.size)
        found[:, at] = -_stack_solved(matrices, others @ found[0] / size) / size
        return found

    def square(self, target: Sequence[int], chosen: Sequence[int], positive: Collection[int]) -> float:
        """Return the sum of the squared errors of the judged rows."""
        found = self.coefficients(target, chosen, positive)
        folds = self._products.of(self._columns(target, chosen))[1:]
        return float(np.einsum("fi,fij,fj->", found, folds, found))

    def left(
        self, target: Sequence[int], chosen: Sequence[int], positive: Collection[int]
    ) -> tuple[IntArray, FloatArray]:
        """Return the places of the judged rows, and their errors, shape (n,) each."""
        columns, found = self._columns(target, chosen), self.coefficients(target, chosen, positive)
        errors = [
            self.errors[first:end, columns] @ own for own, (first, end) in zip(found, pairwise(self.ends), strict=True)
        ]
        return self.place[self.ends[0] :], np.concatenate([np.empty(0), *errors])

    def _columns(self, target: Sequence[int], chosen: Sequence[int]) -> IntArray:
        return np.array([*target, *chosen, self.rest.shape[0]], dtype=np.int64)


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

    def square(self, target: Sequence[int], chosen: Sequence[int], positive: Collection[int] = ()) -> float:
        """Return the mean square (m^2) of what a fit of columns leaves of the sum of others."""
        sums = [division.square(target, chosen, positive) for division in self._divisions]
        mean = float(np.sum(sums)) / max(self._records.size, 1)
        return min(max(mean, 0.0), FARTHEST**2) * self._unit**2 if np.isfinite(mean) else FARTHEST**2 * self._unit**2

    def loss(self, target: Sequence[int], chosen: Sequence[int], positive: Collection[int] = ()) -> Loss:
        """Return what a fit of columns leaves of the sum of others; gains in `positive` are not negative."""
        errors = np.zeros(self._records.size)
        for division in self._divisions:
            places, left = division.left(target, chosen, positive)
            errors[places] = left
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


def _stack_solved(matrices: FloatArray, vectors: FloatArray) -> FloatArray:
    """Return the solutions, shape (n, k), of normal equations of shape (n, k, k) and (n, k)."""
    try:
        return np.asarray(np.linalg.solve(matrices, vectors[:, :, None])[:, :, 0])
    except np.linalg.LinAlgError:
        return np.array([_solved(*each) for each in zip(matrices, vectors, strict=True)])


def _solved(matrix: FloatArray, vector: FloatArray) -> FloatArray:
    try:
        return np.asarray(scipy.linalg.solve(matrix, vector, assume_a="pos", check_finite=False))
    except np.linalg.LinAlgError:
        return np.asarray(np.linalg.lstsq(matrix, vector, rcond=RIDGE)[0])
