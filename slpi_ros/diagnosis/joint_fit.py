"""The hysteresis of one axis with effects around it, fitted to records together and scored on what is left out.

The hysteresis is linear in its parameters ``x``, and so is an effect in its gains ``g``, or in a small change of its
parameters: ``y = A x + J g``. With the hysteresis eliminated once for every fold (Frisch-Waugh), trying other columns
``J`` takes a few products with sparse matrices; so hundreds of them can compete.

Left out are blocks of every record, and where there are several, each record in turn: the hysteresis is fitted to the
others, and of that one nothing is estimated but how it began and its constant.
"""

import operator
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property, reduce
from itertools import pairwise

import numpy as np
import scipy.linalg
from numpy.typing import NDArray
from scipy.optimize import lsq_linear

from slpi_ros.diagnosis.effect_parameters import bounded, certain, free, moved, steps
from slpi_ros.diagnosis.prepare import Evidence
from slpi_ros.effects.base import Candidate, Effect, EffectContext, longest
from slpi_ros.effects.chain import reaching
from slpi_ros.effects.creep import Creep, settling
from slpi_ros.effects.registry import in_order
from slpi_ros.errors import ModelError
from slpi_ros.hysteresis.kinds import Hysteresis
from slpi_ros.identification.design_matrix import Design, Rows
from slpi_ros.identification.least_squares import FOLDS, Problem, blocked_folds
from slpi_ros.identification.linear_kinds import SMOOTHNESS
from slpi_ros.identification.samples import Samples

FloatArray = NDArray[np.float64]
Factor = tuple[FloatArray, bool]

# What effects add is found in turns with the hysteresis, until a turn changes it by less than this share of the error.
MOST_TURNS, SETTLED = 15, 0.001
# Voltages at which the middle of the largest loop is found.
LEVELS = 60
# Steps towards the best parameters end when they gain less than this share of the error.
ENOUGH = 1e-3
# Time constants are no longer than so many times the longest record.
SLOWEST = 10.0
# Of a step, where all of it is too much.
SHARES = (1.0, 0.4, 0.1)
# Keeps the gains definite where columns are alike, relative to the columns' own size.
ALIKE = 1e-9
# Share of the record that is its beginning.
BEGINNING = 0.08
# Of more samples every so manieth is fitted and judged, from all that effects and memory do to every one of them.
MOST_ROWS = 20_000
# Others cover a parameter of the hysteresis that weighs so much in them (sum of squares), and can predict a sample of
# which less than this share depends on parameters that they do not cover. A record is judged by so many samples.
SEEN, UNSEEN, FEWEST_JUDGED = 0.1, 0.02, 200
# Nor can they predict a sample where the variance of the prediction is so many times the usual one; it is found at so
# many samples of a record.
UNCERTAIN, LOOKED_AT = 10.0, 1000
# Blocks of a fold are told apart when scores are compared.
BLOCKS = 40


@dataclass(frozen=True)
class Score:
    """How well columns and hysteresis together predict what is left out of the fit.

    Parameters
    ----------
    losses : ndarray, shape (blocks,), m^2
        Mean square of the errors of each block.
    gains : ndarray, shape (k,)
        Of the columns, fitted to all blocks.
    records : ndarray, shape (records,), m^2
        Mean square of the errors of each record, its constant apart, by a fit to the others; NaN where these cover too
        little of it, empty for one record.
    """

    losses: FloatArray
    gains: FloatArray
    records: FloatArray

    @property
    def rms(self) -> float:
        """Held-out error on blocks, metres."""
        return float(np.sqrt(np.mean(self.losses)))

    @property
    def rms_of_records(self) -> float:
        """Held-out error on records, metres; on blocks where there is one record."""
        return float(np.sqrt(np.nanmean(self.records))) if np.isfinite(self.records).any() else self.rms


class Joint:
    """The normal equations of one axis's hysteresis, ready for columns to be put beside it.

    Parameters
    ----------
    evidence : Evidence
    u : ndarray, shape (N,), volts
        What drives the hysteresis.
    like : Joint, optional
        Of the same records; they are judged by the same samples.
    """

    def __init__(self, evidence: Evidence, u: FloatArray, like: "Joint | None" = None) -> None:
        if like and len(evidence.parts) > 1:
            self.predictable = like.predictable
        self.problem, self.evidence, self.u = evidence.problem(u), evidence, u
        self._groups = _groups(self.problem, evidence)
        self.everything = self.problem.design.rows(np.concatenate(self._groups))
        self._ends = np.cumsum([0, *(rows.size for rows in self._groups)]).tolist()
        # Of each row of the problem, and of each that is fitted.
        self._sample = np.empty(self.problem.y.size, dtype=np.int64)
        self._sample[evidence.rows] = np.arange(evidence.rows.size)
        self._samples = self._sample[np.concatenate(self._groups)]

    @cached_property
    def factor(self) -> Factor:
        """Factor of the hysteresis's equations, all samples."""
        return self._factored(self.everything.gram(), self._ends[-1])

    def _factored(self, gram: FloatArray, count: int) -> Factor:
        return _factor(gram + self.problem.penalty(self.evidence.smoothness, float(count)))

    @cached_property
    def rows(self) -> list[Rows]:
        """Equations of each group."""
        return [self.problem.design.rows(rows) for rows in self._groups]

    @cached_property
    def held_out(self) -> tuple[list["_HeldOut"], list["_HeldOut"]]:
        """The folds, and the records where there are several."""
        grams = [rows.gram() for rows in self.rows]
        everything, whole = range(len(grams)), _sum(grams)

        def held_out(left: Sequence[int], *, record: bool) -> _HeldOut:
            count = self._ends[-1] - sum(self._groups[group].size for group in left)
            gram = whole - _sum([grams[group] for group in left])
            rest = [group for group in everything if group not in left]
            samples = self._sample[np.concatenate([self._groups[group] for group in left])]
            judged = self.predictable[samples] if record else np.empty(0, dtype=bool)
            return _HeldOut(left, rest, self._factored(gram, count), judged)

        folds = [held_out(everything[fold :: FOLDS + 1], record=False) for fold in range(1, FOLDS + 1)]
        if len(self.evidence.parts) == 1:
            return folds, []
        return folds, [held_out(everything[k : k + FOLDS + 1], record=True) for k in everything[:: FOLDS + 1]]

    @cached_property
    def predictable(self) -> NDArray[np.bool_]:
        """Samples, shape (N,), that the other records can predict, whatever their record's initial history."""
        whole = self.everything.gram()
        found = np.zeros(self.evidence.t.size, dtype=bool)
        for k, samples in enumerate(self.evidence.slices):
            rows = np.sort(np.concatenate(self._groups[k * (FOLDS + 1) : (k + 1) * (FOLDS + 1)]))
            own = self.problem.design.rows(rows)
            rest = whole - own.gram()
            factor = self._factored(rest, self._ends[-1] - rows.size)
            every = -(-rows.size // LOOKED_AT)
            predicted = _predicted(own, _judged(self.problem)[rows], rest, factor, self.evidence.basis.size, every)
            # A sample that is not fitted counts like the fitted one before it.
            place = np.searchsorted(self._sample[rows], np.arange(samples.start, samples.stop), side="right") - 1
            found[samples] = predicted[np.maximum(place, 0)]
        return found

    @cached_property
    def blocks(self) -> list[NDArray[np.int64]]:
        """Rows of the blocks that are left out, in the order of time."""
        left_out = [self._groups[group] for fold in self.held_out[0] for group in fold.left]
        return np.array_split(np.sort(np.concatenate(left_out)), BLOCKS)

    @cached_property
    def largest_loops(self) -> list[tuple[FloatArray, Design]]:
        """Of each record voltages (V), and the hysteresis from the record's first sample up, down and up over them."""
        levels, loops = np.linspace(float(self.u.min()), float(self.u.max()), LEVELS), []
        for part, rows in zip(self.evidence.parts, self.evidence.slices, strict=True):
            path = np.concatenate([self.u[rows.start : rows.start + 1], levels, levels[::-1], levels])
            whole = Samples(path, path, np.ones(path.size, dtype=bool)).after(part.history)
            loops.append((levels, self.evidence.design([whole])))
        return loops

    def padded(self, signal: FloatArray) -> FloatArray:
        """Return a signal, shape (N,), metres, on the rows of the problem, in units of its scale."""
        whole = np.zeros(self.problem.y.size)
        whole[self.evidence.rows] = signal / self.problem.scale
        return whole

    def sampled(self, signals: FloatArray) -> FloatArray:
        """Return signals, shape (N, ..), metres, at the rows of the equations, in units of the problem's scale."""
        chosen: FloatArray = signals[self._samples] / self.problem.scale
        return chosen

    def grouped(self, signals: FloatArray) -> list[FloatArray]:
        """Return signals at the rows of the equations as those of each group."""
        return [signals[first:end] for first, end in pairwise(self._ends)]

    def predict(self, x: FloatArray) -> FloatArray:
        """Return what the hysteresis gives for parameters `x`, shape (N,), metres."""
        return self.problem.design.predict(x)[self.evidence.rows] * self.problem.scale

    def columns(self, *signals: FloatArray) -> "Columns":
        """Return the equations of signals, shape (N,) or (N, k) each, metres, beside the hysteresis."""
        return Columns(self, self.sampled(np.column_stack(signals)))

    def score(self, signals: Sequence["Columns"], *, positive: int = 0, starting: Sequence[int] = ()) -> Score:
        """Score hysteresis and columns on what is left out.

        Parameters
        ----------
        signals : sequence of Columns
            The very first column is what the others are to explain, with the hysteresis.
        positive : int
            Number of the last columns whose gains may not be negative.
        starting : sequence of int
            Columns, the first one not counted, that tell how a record began: with its constant they are fitted to a
            record that is left out.
        """
        at = self.grouped(np.column_stack([one.at for one in signals]))
        projected = [np.column_stack(parts) for parts in zip(*(one.projected for one in signals), strict=True)]
        products = [own.T @ own for own in at]
        gains = _gains(_sum(projected), _sum(products), np.column_stack([one.solved for one in signals]), positive)
        errors, (folds, records) = np.full(self.problem.y.size, np.nan), self.held_out
        for k, fold in enumerate(folds):
            solved = np.column_stack([one.solved_of_folds[k] for one in signals])
            # Sums, not differences: a column that is zero in the others is exactly zero.
            rest, inner = (_sum([own[group] for group in fold.rest]) for own in (projected, products))
            of_rest = _gains(rest, inner, solved, positive)
            x = solved @ _missed(of_rest)
            for group in fold.left:
                errors[self._groups[group]] = self.rows[group].predict(x) - at[group] @ _missed(of_rest)
        losses = np.array([float(np.mean(errors[rows] ** 2)) for rows in self.blocks])
        left_out = []
        for record in records:
            # The gains of the columns are those of all records: one record at one speed does not tell them.
            rest = _sum([projected[group] for group in record.rest])
            x = _solved(record.factor, rest @ _missed(gains))
            missed = [self.rows[group].predict(x) - at[group] @ _missed(gains) for group in record.left]
            began = [at[group][:, 1:][:, starting] for group in record.left]
            left_out.append(_without_start(np.concatenate(missed)[record.judged], np.concatenate(began)[record.judged]))
        square = self.problem.scale**2
        return Score(losses * square, gains, np.array(left_out) * square)


def _without_start(missed: FloatArray, began: FloatArray) -> float:
    """Return the mean square of errors, shape (n,), without their constant and what columns, shape (n, k), explain.

    NaN where there are too few to judge by.
    """
    if missed.size < FEWEST_JUDGED:
        return np.nan
    own = np.column_stack([np.ones(missed.size), began[:, began.any(axis=0)]])
    return float(np.mean((missed - own @ np.linalg.lstsq(own, missed, rcond=None)[0]) ** 2))


@dataclass(frozen=True)
class _HeldOut:
    """Groups that are left out, the others, the factor of their equations, and which rows of a record they predict."""

    left: Sequence[int]
    rest: Sequence[int]
    factor: Factor
    judged: NDArray[np.bool_]


@dataclass(frozen=True)
class Columns:
    """Columns beside the hysteresis.

    Parameters
    ----------
    joint : Joint
    at : ndarray, shape (n, k)
        The columns at the rows of the equations.
    """

    joint: Joint
    at: FloatArray

    @cached_property
    def projected(self) -> list[FloatArray]:
        """``A'J`` of each group, shape (p, k)."""
        joint = self.joint
        return [rows.project(own) for rows, own in zip(joint.rows, joint.grouped(self.at), strict=True)]

    @cached_property
    def whole(self) -> FloatArray:
        """``A'J``, shape (p, k)."""
        return self.joint.everything.project(self.at)

    @cached_property
    def solved(self) -> FloatArray:
        """Parameters of the hysteresis that explains each column best, shape (p, k)."""
        return _solved(self.joint.factor, self.whole)

    @cached_property
    def solved_of_folds(self) -> list[FloatArray]:
        """The same without each fold."""
        return [
            _solved(fold.factor, _sum([self.projected[group] for group in fold.rest]))
            for fold in self.joint.held_out[0]
        ]

    @property
    def precision(self) -> FloatArray:
        """Inverse covariance of the gains of the columns, shape (k, k), m^2, for independent errors of 1 m."""
        left: FloatArray = self.at.T @ self.at - self.whole.T @ self.solved
        return left * self.joint.problem.scale**2

    def fit(self, y: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Fit hysteresis and columns to all samples of `y`, shape (N,), metres.

        Returns
        -------
        x : ndarray, shape (p,)
            Of the hysteresis, in units of the problem's scale; branches may fall a little.
        gains : ndarray, shape (k,)
        """
        own = self.joint.columns(y)
        solved = np.column_stack([own.solved, self.solved])
        at = np.column_stack([own.at, self.at])
        gains = _gains(np.column_stack([own.whole, self.whole]), at.T @ at, solved)
        return solved @ _missed(gains), gains


def _missed(gains: FloatArray) -> FloatArray:
    """Return the weights, shape (1 + k,), of a signal and the columns that explain it with some gains, shape (k,)."""
    return np.concatenate([[1.0], -gains])


def _gains(projected: FloatArray, products: FloatArray, solved: FloatArray, positive: int = 0) -> FloatArray:
    """Return the gains, shape (k,), of columns that explain the first one together with the hysteresis.

    Parameters
    ----------
    projected, solved : ndarray, shape (p, 1 + k)
        ``A'J`` and the hysteresis that explains each column.
    products : ndarray, shape (1 + k, 1 + k)
        ``J'J``.
    positive : int
        Number of the last columns whose gains may not be negative.
    """
    if products.shape[0] == 1:
        return np.empty(0)
    left = products[1:] - projected[:, 1:].T @ solved
    size = np.sqrt(np.maximum(np.diag(products)[1:], 1e-300))
    matrix, vector = left[:, 1:] / np.outer(size, size) + ALIKE * np.eye(size.size), left[:, 0] / size
    gains: FloatArray
    if not positive:
        gains = scipy.linalg.solve(matrix, vector, assume_a="pos")
    else:
        # The minimum of g' M g / 2 - b' g with M = R' R is that of |R g - R^-T b|.
        root = scipy.linalg.cholesky(matrix)
        wanted = scipy.linalg.solve_triangular(root, vector, trans="T")
        lower = np.repeat([-np.inf, 0.0], [size.size - positive, positive])
        gains = lsq_linear(root, wanted, (lower, np.full(size.size, np.inf))).x
    return gains / size


def _solved(factor: Factor, of: FloatArray) -> FloatArray:
    solution: FloatArray = scipy.linalg.cho_solve(factor, of, check_finite=False)
    return solution


def _groups(problem: Problem, evidence: Evidence) -> list[NDArray[np.int64]]:
    """Return of each record the rows that are always fitted, then those of each fold.

    The beginning is never left out: what settles there from before the record shows nowhere else.
    """
    judged, groups = _judged(problem), []
    for rows in evidence.slices:
        fitted = evidence.rows[rows][problem.weights[evidence.rows[rows]] > 0]
        fitted = fitted[:: -(-problem.count // MOST_ROWS)]
        settled = int(fitted[int(BEGINNING * fitted.size)]) if fitted.size else 0
        allowed = np.zeros(problem.y.size, dtype=bool)
        allowed[fitted] = judged[fitted]
        folds = [fold[fold >= settled] for fold in blocked_folds(allowed)]
        always = np.setdiff1d(fitted, np.concatenate(folds), assume_unique=True)
        groups += [always, *folds]
    return groups


def _judged(problem: Problem) -> NDArray[np.bool_]:
    """Return which rows other parts of a record, or other records, can predict, shape (N,)."""
    walk = problem.design.walk
    # While it has not moved yet the memory does not matter: what shows there comes from outside.
    return np.asarray((problem.judged & ~walk.first_rise) | (walk.direction == 0))


def _predicted(
    own: Rows, known: NDArray[np.bool_], rest: FloatArray, factor: Factor, size: int, every: int
) -> NDArray[np.bool_]:
    """Return which rows of a record, shape (n,), the others can predict.

    Parameters
    ----------
    own : Rows
        Of the record.
    known : ndarray of bool, shape (n,)
        Rows that do not depend on the initial history but for a constant.
    rest, factor : ndarray, shape (p, p), and its factor with the penalty
        Equations of the other records.
    size : int
        Number of parameters of the hysteresis; those behind it are displacements at rest.
    every : int
        The variance is found for one of so many rows.
    """
    if not known.any():
        return known
    # What only the way before these samples depends on is a constant for them.
    depends = abs(own.local[known]).sum(axis=0) > 0.0
    unseen = np.where(depends & (np.diag(rest) < SEEN), 1.0, 0.0)
    unseen[size:] = 0.0
    covered = np.asarray(known & (own.weight(unseen) < UNSEEN))
    if not covered.any():
        return covered
    some = np.arange(0, known.size, every)
    matrix = (own.local[some] + own.pick[some] @ own.at_turns).toarray()
    matrix[:, size:] = 0.0
    # While the stage has not moved yet there is nothing to predict.
    moved = matrix.any(axis=1)
    matrix -= matrix[known[some]].mean(axis=0) if known[some].any() else 0.0
    variance = (scipy.linalg.solve_triangular(factor[0], matrix.T, trans="T", check_finite=False) ** 2).sum(axis=0)
    usual = covered[some] & moved
    uncertain = variance > UNCERTAIN * float(np.median(variance[usual] if usual.any() else variance))
    return np.asarray(covered & ~np.repeat(uncertain, every)[: known.size])


def _factor(matrix: FloatArray) -> Factor:
    factor: Factor = scipy.linalg.cho_factor(matrix, check_finite=False)
    return factor


def _sum(parts: Sequence[FloatArray]) -> FloatArray:
    return reduce(operator.add, parts)


class Explanation:
    """Effects in the order of the signal chain, and the hysteresis that goes with them.

    Parameters
    ----------
    evidence : Evidence
    effects : sequence of Effect
    like : Explanation, optional
        Of the same evidence; its equations serve again where the same voltage drives the hysteresis.

    Attributes
    ----------
    u : ndarray, shape (N,), volts
        What drives the hysteresis.
    h : ndarray, shape (N,), metres
        What the hysteresis gives.
    added : ndarray, shape (N,), metres
        What the effects add behind the hysteresis, or lead round it.
    settling : ndarray, shape (N,), metres
        What still goes on at the start of the record from moves before it.
    began : ndarray, shape (k,), metres
        How much of it, of each record one behind the other.
    """

    joint: Joint
    h: FloatArray
    added: FloatArray
    _middles: "list[Callable[[FloatArray], FloatArray]]"

    def __init__(self, evidence: Evidence, effects: Sequence[Effect] = (), like: "Explanation | None" = None) -> None:
        self.evidence, self.effects = evidence, in_order(effects)
        self.u, self._aside = reaching(self.effects, evidence.v, evidence.around)
        if like and not (like.evidence.parts is evidence.parts and like.evidence.smoothness == evidence.smoothness):
            like = None
        if like and np.array_equal(like.u, self.u):
            self.joint = like.joint
        else:
            self.joint = Joint(evidence, self.u, like.joint if like else None)
        starting = settling(self._relaxations, evidence.around, evidence.used, older=evidence.older_moves)
        self._before = np.column_stack([starting, evidence.beside])
        self._starting = range(starting.shape[1])
        beside = self.joint.columns(self._before)
        behind = any(effect.side == "displacement" for effect in self.effects)
        self.added = self._aside
        if not behind or not like:
            self._fit(beside)
        if not behind:
            return
        if like:
            self.h, self.added, self._middles = like.h, like.added, like._middles
        for _ in range(MOST_TURNS):
            h, before = self.h, self.added
            self.added = self._behind(self.effects, h + self._aside, self.u) - h
            self._fit(beside)
            if np.ptp(self.added - before) < SETTLED * np.std(self.target - h):
                break

    def _fit(self, beside: Columns) -> None:
        self._x, gains = beside.fit(self.target)
        self.h = self.joint.predict(self._x)
        self.settling, self.began = self._before @ gains, gains[: len(self._starting)]
        self._middles = [self._middle(k) for k in range(len(self.evidence.parts))]

    @property
    def _relaxations(self) -> list[float]:
        return [tau for effect in self.effects if isinstance(effect, Creep) for tau in effect.time_constants]

    @property
    def t(self) -> FloatArray:
        """Time, shape (N,), seconds."""
        return self.evidence.t

    @property
    def y(self) -> FloatArray:
        """Measured displacement, shape (N,), metres."""
        return self.evidence.y

    @property
    def used(self) -> NDArray[np.bool_]:
        """Samples that count, shape (N,)."""
        return self.evidence.used

    @property
    def others(self) -> Mapping[str, FloatArray]:
        """Motion of the other axes from their start, shape (N,), metres."""
        return self.evidence.others

    @property
    def target(self) -> FloatArray:
        """What the hysteresis is to explain, shape (N,), metres."""
        return self.evidence.y - self.added

    @property
    def predicted(self) -> FloatArray:
        """What hysteresis and effects give, shape (N,), metres."""
        return self.h + self.added + self.settling

    @property
    def residual(self) -> FloatArray:
        """What they leave of the measured displacement, shape (N,), metres."""
        return self.evidence.y - self.predicted

    @property
    def around(self) -> EffectContext:
        """What effects may look at."""
        return self._around(self.u)

    def _around(self, u: FloatArray) -> EffectContext:
        around = self.evidence.around
        records = tuple(
            replace(record, u=u[rows], middle=self._middles[k])
            for k, (rows, record) in enumerate(zip(self.evidence.slices, around.records, strict=True))
        )
        return replace(around, u=u, middle=self._middles[0], records=records)

    def of_record(self, k: int) -> "RecordLeft":
        """Return what is left of one record."""
        rows, around = self.evidence.slices[k], self.around.records[k]
        t, u, h, y, residual = (x[rows] for x in (self.t, self.u, self.h, self.y, self.residual))
        return RecordLeft(t, u, h, y, self.used[rows], residual, around)

    def _behind(self, effects: Sequence[Effect], h: FloatArray, u: FloatArray) -> FloatArray:
        """Return the displacement, shape (N,), metres, that effects make of what the hysteresis gives, `h`."""
        around = self._around(u)
        for effect in effects:
            if effect.side == "displacement":
                h = effect.apply(h, around)
        return h

    def _middle(self, k: int) -> Callable[[FloatArray], FloatArray]:
        """Return what gives the displacement (m) of a record half-way between the branches of the largest loop.

        It is a function of voltages (V).
        """
        x, first = self._x[: self.evidence.basis.size + 1], float(self.h[self.evidence.slices[k].start])
        levels, whole = self.joint.largest_loops[k]
        # The function must not hold this object: others keep it, and a fit takes much room.
        scale = self.joint.problem.scale

        @cache
        def middle() -> FloatArray:
            y = whole.predict(x)[-1 - 3 * LEVELS :] * scale
            falling, rising = y[1 + LEVELS : 1 + 2 * LEVELS][::-1], y[1 + 2 * LEVELS :]
            centre: FloatArray = 0.5 * (falling + rising) + first - y[0]
            return centre

        return lambda u: np.asarray(np.interp(u, levels, middle()), dtype=np.float64)

    def respond(self, u: FloatArray) -> FloatArray:
        """Return what the hysteresis gives (m) for another voltage `u`, shape (N,), volts."""
        response = self.evidence.design(self.evidence.samples(u)).predict(self._x)[self.evidence.rows]
        return response * self.joint.problem.scale

    @cached_property
    def tangents(self) -> FloatArray:
        """How the prediction changes with each free parameter of the effects, shape (N, k), metres."""
        columns = []
        for place, effect in enumerate(self.effects):
            values = free(effect)
            for k, step in enumerate(steps(effect, self.evidence.t, self.evidence.v)):
                changed = values.copy()
                changed[k] += step
                effects = [*self.effects[:place], moved(effect, changed), *self.effects[place + 1 :]]
                columns.append((self._whole(effects) - self.predicted) / step)
        return np.column_stack([np.empty((self.evidence.t.size, 0)), *columns])

    def _whole(self, effects: Sequence[Effect]) -> FloatArray:
        """Return the prediction, shape (N,), metres, of the same hysteresis with other effects."""
        u, reversible_bypass = reaching(effects, self.evidence.v, self.evidence.around)
        h = self.h if np.array_equal(u, self.u) else self.respond(u)
        return self.settling + self._behind(effects, h + reversible_bypass, u)

    def prediction_without(self, name: str) -> FloatArray:
        """Return what it would give, shape (N,), metres, if one of its effects were not there and all else as it is."""
        return self._whole([effect for effect in self.effects if effect.name != name])

    def score(self, candidate: Candidate) -> Score:
        """Score it with a candidate beside it, all effects refitted."""
        first = self._before.shape[1] + self.tangents.shape[1]
        starting = [*self._starting, *range(first, first + candidate.starting)]
        signals = self._signals, self.joint.columns(candidate.columns)
        return self.joint.score(signals, positive=candidate.positive, starting=starting)

    @cached_property
    def _signals(self) -> Columns:
        """The target and what stands beside the hysteresis."""
        return self.joint.columns(self.target, self._before, self.tangents)

    @cached_property
    def held_out(self) -> Score:
        """Its own score."""
        return self.joint.score([self._signals], starting=self._starting)

    @property
    def objective(self) -> float:
        """Mean square (m^2) of what is left, and what its roughness costs the hysteresis."""
        used, problem = self.used, self.joint.problem
        rough = float(self._x @ problem.penalty(self.evidence.smoothness, problem.count) @ self._x) / problem.count
        return float(np.mean(self.residual[used] ** 2)) + rough * problem.scale**2

    def refined(self, times: int) -> "Explanation":
        """Return it with the parameters of all effects fitted together with the hysteresis (Gauss-Newton)."""
        best = self
        for _ in range(times if self.effects else 0):
            better = best._step()
            gain = 1.0 - better.objective / best.objective
            best = better
            if gain < ENOUGH:
                break
        return best

    def _step(self) -> "Explanation":
        """Return it after one step, shortened until it gains; itself where none does."""
        change = self.joint.columns(self._before, self.tangents).fit(self.target)[1][self._before.shape[1] :]
        for share in SHARES:
            try:
                effects = self._stepped(share * change)
            except ModelError:
                # Too far: no effect has such parameters.
                continue
            stepped = Explanation(self.evidence, effects, self)
            if stepped.objective < self.objective:
                return stepped
        return self

    def _stepped(self, change: FloatArray) -> list[Effect]:
        effects, first = [], 0
        limit = SLOWEST * longest(self.evidence.around)
        for effect in self.effects:
            values = free(effect)
            step = change[first : first + values.size]
            first += values.size
            effects.append(moved(effect, values + bounded(effect, step), limit))
        return effects

    def hysteresis(self) -> tuple[Hysteresis, tuple[float, ...]]:
        """Return the model with every branch rising, and the displacement at the start of each record, metres."""
        problem = replace(self.joint.problem, y=self.joint.padded(self.target - self.settling))
        x = problem.solve(self.evidence.smoothness)
        h = problem.design.predict(x)[self.evidence.rows] * problem.scale
        starts = tuple(float(h[rows.start]) for rows in self.evidence.slices)
        return problem.basis.shape(x[: problem.basis.size + 1] * problem.scale, problem.gain), starts

    def with_uncertainty(self) -> list[Effect]:
        """Return the effects with the standard deviations of their free parameters.

        Errors of neighbouring samples are alike, so that there are fewer independent ones than samples.
        """
        if not self.effects:
            return []
        precision = self.joint.columns(self.tangents, self._before).precision
        errors = self.residual[self.evidence.used]
        size = np.sqrt(np.maximum(np.diag(precision), 1e-300))
        inverse = np.linalg.pinv(precision / np.outer(size, size), rcond=1e-12) / np.outer(size, size)
        spread = np.sqrt(np.maximum(np.diag(inverse), 0.0) * np.mean(errors**2) * alike_in_a_row(errors)).tolist()
        effects = []
        for effect in self.effects:
            effects.append(certain(effect, [spread.pop(0) for _ in free(effect)]))
        return effects

    def smoothed(self) -> "Explanation":
        """Return it with the hysteresis as smooth as blocks left out say, now that effects no longer disturb it."""
        problem = replace(self.joint.problem, y=self.joint.padded(self.target))
        best = problem.smoothness_near(self.evidence.smoothness, SMOOTHNESS)
        if best == self.evidence.smoothness:
            return self
        smoothed = Explanation(replace(self.evidence, smoothness=best), self.effects).refined(2)
        # The blocks are one choice of several, and leave the effects as they are.
        return min(self.refined(2), smoothed, key=lambda one: one.held_out.rms_of_records)

    @cached_property
    def zeros(self) -> FloatArray:
        """Displacement of each record, shape (records,), metres, in the middle of the largest loop."""
        voltage = np.array([0.5 * (float(self.u.min()) + float(self.u.max()))])
        return np.array([float(middle(voltage)[0]) for middle in self._middles])

    def effect(self, name: str) -> Effect:
        """Return its effect of this name."""
        return next(effect for effect in self.effects if effect.name == name)

    def adding(self, effect: Effect) -> "Explanation":
        """Return it with one more effect."""
        return Explanation(self.evidence, [*self.effects, effect], self)

    def only(self, names: Collection[str]) -> "Explanation":
        """Return it with those of its effects that are named, fitted anew if others are gone."""
        kept = [effect for effect in self.effects if effect.name in names]
        return self if len(kept) == len(self.effects) else Explanation(self.evidence, kept, self).refined(2)

    def without(self, name: str) -> "Explanation":
        """Return it without an effect, the others fitted anew."""
        return self.only([effect.name for effect in self.effects if effect.name != name])

    def beside(self, columns: FloatArray) -> "Explanation":
        """Return it with `columns`, shape (N, k), beside the hysteresis, whatever their gains."""
        evidence = replace(self.evidence, beside=np.column_stack([self.evidence.beside, columns]))
        return Explanation(evidence, self.effects, self)

    def with_older_moves(self) -> "Explanation":
        """Return it with creep that goes on from moves long before each record as well."""
        return Explanation(replace(self.evidence, older_moves=True), self.effects, self).refined(2)

    def bare(self) -> "Explanation":
        """Return it without anything beside the hysteresis but effects, those fitted anew."""
        if not self.evidence.beside.shape[1]:
            return self
        evidence = replace(self.evidence, beside=self.evidence.beside[:, :0])
        return Explanation(evidence, self.effects, self).smoothed().refined(2)


@dataclass(frozen=True)
class RecordLeft:
    """What is left of one record, for effects that belong to it alone; as `slpi_ros.effects.base.ResidualView`."""

    t: FloatArray
    u: FloatArray
    h: FloatArray
    y: FloatArray
    used: NDArray[np.bool_]
    residual: FloatArray
    around: EffectContext

    @property
    def others(self) -> Mapping[str, FloatArray]:
        """Motion of the other axes from their start, shape (N,), metres."""
        return self.around.others

    def respond(self, u: FloatArray) -> FloatArray:
        """Refuse: an effect of one record alone does not act on the voltage."""
        raise NotImplementedError


def alike_in_a_row(errors: FloatArray) -> float:
    """Return how many errors in a row tell no more than one, from their correlation up to where it first vanishes."""
    errors = errors - errors.mean()
    power = np.abs(np.fft.rfft(errors, 2 * errors.size)) ** 2
    correlation = np.fft.irfft(power)[: errors.size]
    if not correlation[0] > 0.0:
        return 1.0
    correlation = correlation / correlation[0]
    positive = int(np.argmax(correlation <= 0.0)) or correlation.size
    return float(max(1.0, 2.0 * correlation[:positive].sum() - 1.0))
