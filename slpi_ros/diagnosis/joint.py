"""A hysteresis model and whatever columns are put beside it, refitted together and scored on blocks left out.

The hysteresis is linear in its parameters ``x``, and so is an effect in its gains ``g``, or in a small change of its
parameters: ``y = A x + J g``. With the hysteresis eliminated once for every fold (Frisch-Waugh), trying other columns
``J`` takes a few products with sparse matrices; so hundreds of them can compete.
"""

import operator
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, reduce
from typing import TypeVar

import numpy as np
import scipy.linalg
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.optimize import lsq_linear

from slpi_ros.identification.least_squares import Problem, blocked_folds

FloatArray = NDArray[np.float64]
Factor = tuple[FloatArray, bool]
Summed = TypeVar("Summed", FloatArray, "_Equations")

# Keeps the gains definite where columns are alike, relative to the columns' own size.
ALIKE = 1e-9
# Share of the record that is its beginning.
BEGINNING = 0.08
# Blocks of a fold are told apart when scores are compared.
BLOCKS = 40


@dataclass(frozen=True)
class Score:
    """How well columns and hysteresis together predict blocks left out of the fit.

    Parameters
    ----------
    losses : ndarray, shape (blocks,), m^2
        Mean square of the errors of each block.
    gains : ndarray, shape (k,)
        Of the columns, fitted to all blocks.
    """

    losses: FloatArray
    gains: FloatArray

    @property
    def rms(self) -> float:
        """Held-out error, metres."""
        return float(np.sqrt(np.mean(self.losses)))


class Joint:
    """The normal equations of one axis's hysteresis on every fold, ready for columns to be put beside it.

    Parameters
    ----------
    problem : Problem
        The hysteresis on the record; samples of no weight are neither fitted nor scored.
    smoothness : float
        Of the hysteresis.
    lead : int
        Rows of the problem before the record's first: what is assumed to have moved the stage before.
    """

    def __init__(self, problem: Problem, smoothness: float, lead: int = 0) -> None:
        self.problem, self._lead = problem, lead
        design = problem.design
        self._rows = _groups(problem)
        self._local = [design.local[rows] for rows in self._rows]
        self._pick = [design.pick[rows] for rows in self._rows]
        self._at_turns = design.at_turns
        grams = [self._gram(local, pick) for local, pick in zip(self._local, self._pick, strict=True)]
        total = _sum(grams)
        count = problem.count
        self._factors = [
            _factor(total - gram + problem.penalty(smoothness, count - rows.size))
            for gram, rows in zip(grams[1:], self._rows[1:], strict=True)
        ]
        self._factor = _factor(total + problem.penalty(smoothness, count))

    @cached_property
    def blocks(self) -> list[NDArray[np.int64]]:
        """Rows of the blocks that are left out, in the order of time."""
        return np.array_split(np.sort(np.concatenate(self._rows[1:])), BLOCKS)

    def _gram(self, local: sp.csr_array, pick: sp.csr_array) -> FloatArray:
        at_turns = self._at_turns
        mixed = (local.T @ pick) @ at_turns
        gram: FloatArray = (local.T @ local).toarray() + mixed + mixed.T + at_turns.T @ ((pick.T @ pick) @ at_turns)
        return gram

    def _grouped(self, signals: FloatArray) -> list[FloatArray]:
        """Return the rows of each group of signals of shape (N, k), metres, in units of the problem's scale."""
        padded = np.concatenate([np.zeros((self._lead, signals.shape[1])), signals / self.problem.scale])
        return [padded[rows] for rows in self._rows]

    def _project(self, groups: list[FloatArray]) -> list[FloatArray]:
        """Return ``A' J`` of each group of rows, shape (p, k)."""
        parts = zip(groups, self._local, self._pick, strict=True)
        return [local.T @ part + self._at_turns.T @ (pick.T @ part) for part, local, pick in parts]

    def predict(self, x: FloatArray) -> FloatArray:
        """Return what the hysteresis gives for parameters `x`, shape (N,), metres."""
        return self.problem.design.predict(x)[self._lead :] * self.problem.scale

    def score(self, y: FloatArray, columns: FloatArray, *, positive: int = 0) -> Score:
        """Score hysteresis and columns on blocks left out.

        Parameters
        ----------
        y : ndarray, shape (N,), metres
            What they are to explain.
        columns : ndarray, shape (N, k), metres
        positive : int
            Number of the last columns whose gains may not be negative.
        """
        sums = _Sums.of(self, y, columns)
        errors = np.full(self._lead + y.size, np.nan)
        for k, factor in enumerate(self._factors, start=1):
            x, gains = sums.without(k).solve(factor, positive=positive)
            predicted = self._local[k] @ x + self._pick[k] @ (self._at_turns @ x)
            errors[self._rows[k]] = predicted + sums.columns[k] @ gains - sums.y[k]
        gains = sums.all().solve(self._factor, positive=positive)[1]
        losses = [float(np.mean(errors[rows] ** 2)) for rows in self.blocks]
        return Score(np.array(losses) * self.problem.scale**2, gains)

    def fit(self, y: FloatArray, columns: FloatArray | None = None) -> "Fit":
        """Fit hysteresis and columns, as in `score`, to all samples."""
        equations = _Sums.of(self, y, columns).all()
        x, gains = equations.solve(self._factor, positive=0)
        return Fit(x, gains, equations.precision(self._factor) * self.problem.scale**2)


@dataclass(frozen=True)
class Fit:
    """Hysteresis and columns fitted together.

    Parameters
    ----------
    x : ndarray, shape (p,)
        Of the hysteresis, in units of the problem's scale; branches may fall a little.
    gains : ndarray, shape (k,)
    precision : ndarray, shape (k, k), m^2
        Inverse covariance of the gains for errors of 1 m, one sample independent of the other.
    """

    x: FloatArray
    gains: FloatArray
    precision: FloatArray


@dataclass(frozen=True)
class _Equations:
    """``A'J``, ``A'y``, ``J'J`` and ``J'y``."""

    a_j: FloatArray
    a_y: FloatArray
    j_j: FloatArray
    j_y: FloatArray

    def __sub__(self, other: "_Equations") -> "_Equations":
        return _Equations(self.a_j - other.a_j, self.a_y - other.a_y, self.j_j - other.j_j, self.j_y - other.j_y)

    def __add__(self, other: "_Equations") -> "_Equations":
        return _Equations(self.a_j + other.a_j, self.a_y + other.a_y, self.j_j + other.j_j, self.j_y + other.j_y)

    def precision(self, factor: Factor) -> FloatArray:
        """Return what is left of ``J'J`` beside the hysteresis."""
        left: FloatArray = self.j_j - self.a_j.T @ scipy.linalg.cho_solve(factor, self.a_j, check_finite=False)
        return left

    def solve(self, factor: Factor, *, positive: int) -> tuple[FloatArray, FloatArray]:
        """Return the parameters of the hysteresis, shape (p,), and the gains, shape (k,)."""
        alone = scipy.linalg.cho_solve(factor, self.a_y, check_finite=False)
        if not self.j_y.size:
            return alone, np.empty(0)
        beside = scipy.linalg.cho_solve(factor, self.a_j, check_finite=False)
        matrix = self.j_j - self.a_j.T @ beside
        size = np.sqrt(np.maximum(np.diag(self.j_j), 1e-300))
        matrix = matrix / np.outer(size, size) + ALIKE * np.eye(size.size)
        vector = (self.j_y - self.a_j.T @ alone) / size
        if positive:
            # With M = R' R the bounded minimum of g' M g / 2 - b' g is that of |R g - R^-T b|.
            root = scipy.linalg.cholesky(matrix)
            wanted = scipy.linalg.solve_triangular(root, vector, trans="T")
            lower = np.repeat([-np.inf, 0.0], [size.size - positive, positive])
            gains = lsq_linear(root, wanted, (lower, np.full(size.size, np.inf))).x / size
        else:
            gains = scipy.linalg.solve(matrix, vector, assume_a="pos") / size
        return alone - beside @ gains, gains


@dataclass(frozen=True)
class _Sums:
    """The equations of every group of rows."""

    columns: list[FloatArray]
    y: list[FloatArray]
    groups: list[_Equations]

    @classmethod
    def of(cls, joint: Joint, y: FloatArray, columns: FloatArray | None) -> "_Sums":
        j = joint._grouped(np.empty((y.size, 0)) if columns is None else columns)
        own_y = joint._grouped(y[:, None])
        a_j, a_y = joint._project(j), joint._project(own_y)
        groups = [
            _Equations(of_j, of_y[:, 0], part.T @ part, part.T @ part_y[:, 0])
            for of_j, of_y, part, part_y in zip(a_j, a_y, j, own_y, strict=True)
        ]
        return cls(j, [part[:, 0] for part in own_y], groups)

    def all(self) -> _Equations:
        return _sum(self.groups)

    def without(self, k: int) -> _Equations:
        return self.all() - self.groups[k]


def _groups(problem: Problem) -> list[NDArray[np.int64]]:
    """Return the rows that are always fitted, then those of each fold.

    The beginning is never left out: what settles there from before the record shows nowhere else.
    """
    always = problem.weights > 0
    settled = int(np.flatnonzero(always)[int(BEGINNING * problem.count)])
    walk = problem.design.walk
    # While it has not moved yet the memory does not matter: what shows there comes from outside.
    judged = (problem.judged & ~walk.first_rise) | (walk.direction == 0)
    folds = [fold[fold >= settled] for fold in blocked_folds(always & judged)]
    for fold in folds:
        always[fold] = False
    return [np.flatnonzero(always), *folds]


def _factor(matrix: FloatArray) -> Factor:
    factor: Factor = scipy.linalg.cho_factor(matrix, check_finite=False)
    return factor


def _sum(parts: Sequence[Summed]) -> Summed:
    return reduce(operator.add, parts)
