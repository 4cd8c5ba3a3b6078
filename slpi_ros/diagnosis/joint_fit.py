"""Joint fit of the hysteresis and the effects of one axis to records, and its cross-validation.

The displacement is linear in the hysteresis parameters ``x`` and in the gains ``g`` of effects or small changes of
their parameters: ``y = A x + J g``. The hysteresis is eliminated once per fold (Frisch-Waugh theorem); then other
columns ``J`` need only a few sparse matrix products, so that hundreds of candidates can be compared.

Blocks of every record are held out and, if there are several, each record in turn: the hysteresis is fitted to the
other records, and only offset and initial relaxation are estimated from the held-out record itself.
"""

import operator
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, reduce
from itertools import pairwise

import numpy as np
import scipy.linalg

from slpi_ros.arrays import FloatArray, IntArray, Mask
from slpi_ros.diagnosis.effect_parameters import bounded, certain, free, independent, moved, steps
from slpi_ros.diagnosis.held_out import Division, HeldOut, Loss, solved
from slpi_ros.diagnosis.prepare import Evidence, Part
from slpi_ros.diagnosis.ruler import alike_in_a_row
from slpi_ros.effects.base import Effect, EffectContext, longest
from slpi_ros.effects.chain import Chain, forward
from slpi_ros.effects.registry import in_order
from slpi_ros.errors import ModelError
from slpi_ros.hysteresis.kinds import Hysteresis
from slpi_ros.identification.design_matrix import Rows
from slpi_ros.identification.least_squares import FOLDS, Problem, blocked_folds
from slpi_ros.identification.linear_kinds import SMOOTHNESS
from slpi_ros.identification.samples import Samples
from slpi_ros.identification.signal_statistics import white_noise

Factor = tuple[FloatArray, bool]

# Effects and hysteresis are updated in turn: largest number of iterations, and change (share of the error) below which
# they stop.
MOST_TURNS, SETTLED = 15, 0.001
# Earlier iterations that are mixed, and samples between those by which they are.
DEPTH, MIXED_EVERY = 4, 7
# Gauss-Newton steps end when one lowers the objective by less than this share.
ENOUGH = 1e-3
# Upper bound of time constants, as a multiple of the duration of the longest record.
SLOWEST = 10.0
# Bounds of an origin of displacements, beyond the measured ones, as a share of their range.
NEAR_MOTION = 0.25
# Shares of a Gauss-Newton step, tried in this order until one lowers the objective.
SHARES = (1.0, 0.4, 0.1)
# Initial share of a record, which is never held out.
BEGINNING = 0.08
# Largest number of samples that are fitted and held out. Longer records are thinned for this, but hysteresis
# and effects are simulated at every sample.
MOST_ROWS = 20_000
# The other records cover a hysteresis parameter with at least this sum of squares in them, and can predict a sample if
# it depends on other parameters by less than this weight. Fewest samples for the held-out error of a record.
SEEN, UNSEEN, FEWEST_JUDGED = 0.1, 0.02, 200
# They cannot predict a sample with more than this multiple of the median prediction variance; approximate number of
# samples of a record at which the variance is computed.
UNCERTAIN, LOOKED_AT = 10.0, 1000
# An error below this share of the displacement range is beyond the resolution of any sensor.
FINEST = 1e-6


class Equations:
    """Normal equations of the hysteresis of one axis, to which columns of effects can be added."""

    # The voltage `u` (V, (N,)) drives the hysteresis. `like` are equations of the same records.
    def __init__(self, evidence: Evidence, u: FloatArray, like: "Equations | None" = None) -> None:
        if like and len(evidence.parts) > 1:
            self.predictable = like.predictable
        self.problem, self.evidence, self.u = evidence.problem(u), evidence, u
        # The same samples are judged whatever voltage the effects let through.
        self._groups: list[IntArray] = like._groups if like else _groups(evidence.problem(evidence.v), evidence)
        self.everything = self.problem.design.rows(np.concatenate(self._groups))
        self._ends = np.cumsum([0, *(rows.size for rows in self._groups)]).tolist()
        # Sample of each row of the problem, and of each fitted row in the order of the groups.
        self._sample = np.empty(self.problem.y.size, dtype=np.int64)
        self._sample[evidence.rows] = np.arange(evidence.rows.size)
        self._samples = self._sample[np.concatenate(self._groups)]

    @cached_property
    def factor(self) -> Factor:
        """Cholesky factor of the normal equations of the hysteresis for all samples."""
        return self._factored(self.everything.gram(), self._ends[-1])

    def _factored(self, gram: FloatArray, count: int) -> Factor:
        matrix = self.problem.penalty(self.evidence.smoothness, float(count))
        matrix += gram
        return _factor(matrix)

    @cached_property
    def rows(self) -> list[Rows]:
        """Rows of the design matrix by group of samples."""
        return [self.problem.design.rows(rows) for rows in self._groups]

    @cached_property
    def _left(self) -> list[tuple[list[int], Factor, int]]:
        """Groups left out, the factor of the normal equations of the others, and the record (-1: blocks)."""
        grams = [rows.gram() for rows in self.rows]
        whole, each = _sum(grams), FOLDS + 1

        def left(groups: list[int], record: int = -1) -> tuple[list[int], Factor, int]:
            count = self._ends[-1] - sum(self._groups[group].size for group in groups)
            return groups, self._factored(whole - _sum([grams[group] for group in groups]), count), record

        alone = self._judged_alone
        folds = [[k * each + fold for k in alone] for fold in range(1, each)] if alone else []
        records = [k for k in range(len(self.evidence.parts)) if k not in alone]
        return [*map(left, folds), *(left(list(range(k * each, (k + 1) * each)), k) for k in records)]

    @cached_property
    def _judged_alone(self) -> list[int]:
        """Records of which blocks are left out, as the others, if there are any, cover too little of them."""
        if len(self.evidence.parts) == 1:
            return [0]
        judged = [np.count_nonzero(self.predictable[self._samples[slice(*ends)]]) for ends in pairwise(self._ends)]
        first = range(0, len(judged), FOLDS + 1)
        return [k for k, group in enumerate(first) if sum(judged[group + 1 : group + FOLDS + 1]) < FEWEST_JUDGED]

    def held_out(self, at: FloatArray) -> HeldOut:
        """Return the errors, on data left out, of columns `at` the fitted samples, shape (n, K), as of `sampled`."""
        parts, each = self.grouped(at), FOLDS + 1
        projected = [rows.project(own) for rows, own in zip(self.rows, parts, strict=True)]
        products = [own.T @ own for own in parts]
        whole, inner = _sum(projected), _sum(products)
        size = np.sqrt(np.diag(inner))
        held = [np.diag(_sum(products[k * each : (k + 1) * each])) > 0.0 for k in range(len(self.evidence.parts))]
        place, samples, records = self._places()
        divisions = []
        for groups, factor, record in self._left:
            of_rest = whole - _sum([projected[group] for group in groups])
            x = _solved(factor, of_rest)
            rest = inner - _sum([products[group] for group in groups]) - of_rest.T @ x
            missed = np.concatenate([parts[group] - self.rows[group].predict(x) for group in groups])
            own = np.zeros(at.shape[1], dtype=bool)
            if record >= 0:
                own = held[record] & ~np.any([each for k, each in enumerate(held) if k != record], axis=0)
            rest[own], rest[:, own] = 0.0, 0.0
            sizes = [parts[group].shape[0] for group in groups]
            fold = np.repeat([group % each if record >= 0 else 0 for group in groups], sizes)
            places = np.concatenate([place[group] for group in groups])
            # What the others cannot predict of a record says nothing of its zero, nor of its drift.
            ends = [slice(self._ends[group], self._ends[group + 1]) for group in groups]
            known = np.concatenate([self.predictable[self._samples[rows]] | (record < 0) for rows in ends])
            divisions.append(Division(np.asfortranarray(missed[known]), rest, size, places[known], fold[known], own))
        total = inner - whole.T @ _solved(self.factor, whole)
        return HeldOut(divisions, total, samples, records, len(held), self.problem.scale)

    def _places(self) -> tuple[list[IntArray], IntArray, IntArray]:
        """Return for each group where its rows are among the judged ones, in time order; samples, records."""
        record, fold = np.divmod(np.repeat(np.arange(len(self._groups)), np.diff(self._ends)), FOLDS + 1)
        judged = (fold > 0) & (np.isin(record, self._judged_alone) | self.predictable[self._samples])
        places = np.full(self._samples.size, -1)
        places[judged] = np.argsort(np.argsort(self._samples[judged], kind="stable"), kind="stable")
        samples = np.sort(self._samples[judged])
        return [places[slice(*ends)] for ends in pairwise(self._ends)], samples, np.sort(record[judged])

    @cached_property
    def predictable(self) -> Mask:
        """Mask of the samples, shape (N,), that the other records can predict for any initial state."""
        if len(self.evidence.parts) == 1:
            return np.zeros(self.evidence.t.size, dtype=bool)
        whole = self.everything.gram()
        found = np.zeros(self.evidence.t.size, dtype=bool)
        for k, samples in enumerate(self.evidence.slices):
            rows = np.sort(np.concatenate(self._groups[k * (FOLDS + 1) : (k + 1) * (FOLDS + 1)]))
            own = self.problem.design.rows(rows)
            rest = whole - own.gram()
            factor = self._factored(rest, self._ends[-1] - rows.size)
            every = -(-rows.size // LOOKED_AT)
            # The first rise, once in each record, may be in the others, too.
            walk, size = self.problem.design.walk, self.evidence.basis.size
            masks = _judged(self.problem)[rows], self.problem.judged[rows] | (walk.direction[rows] == 0)
            tried = [_predicted(own, known, rest, factor, size, every) for known in masks]
            predicted = max(tried, key=np.count_nonzero)
            # A sample that is not fitted is treated like the preceding fitted one.
            place = np.searchsorted(self._sample[rows], np.arange(samples.start, samples.stop), side="right") - 1
            found[samples] = predicted[np.maximum(place, 0)]
        return found

    @property
    def first_rise(self) -> Mask:
        """Mask of the samples, shape (N,), before the first motion or on the first rise, which happen once."""
        walk = self.problem.design.walk
        return np.asarray((walk.first_rise | (walk.direction == 0))[self.evidence.rows])

    def padded(self, signal: FloatArray) -> FloatArray:
        """Return a signal, shape (N,), metres, at the rows of the problem, in units of its scale; 0 at others."""
        whole = np.zeros(self.problem.y.size)
        whole[self.evidence.rows] = signal / self.problem.scale
        return whole

    def sampled(self, signals: FloatArray) -> FloatArray:
        """Return signals, shape (N, ..), metres, at the fitted samples, group by group, in units of the scale."""
        chosen: FloatArray = signals[self._samples] / self.problem.scale
        return chosen

    def grouped(self, signals: FloatArray) -> list[FloatArray]:
        """Split the result of `sampled` into its groups."""
        return [signals[first:end] for first, end in pairwise(self._ends)]

    def predict(self, x: FloatArray) -> FloatArray:
        """Return the displacement of the hysteresis, shape (N,), metres, for parameters `x`, shape (p,)."""
        return self.problem.design.predict(x)[self.evidence.rows] * self.problem.scale

    def columns(self, *signals: FloatArray) -> "Columns":
        """Return signals, shape (N,) or (N, k) each, metres, as columns of a joint fit with the hysteresis."""
        return Columns(self, self.sampled(np.column_stack(signals)))


@dataclass(frozen=True)
class Columns:
    """Columns of a joint fit with the hysteresis, shape (n, k), `at` the fitted samples, from `Equations.sampled`."""

    equations: Equations
    at: FloatArray

    @cached_property
    def whole(self) -> FloatArray:
        """Product ``A'J`` of all groups, shape (p, k)."""
        return self.equations.everything.project(self.at)

    @cached_property
    def solved(self) -> FloatArray:
        """Hysteresis parameters, shape (p, k), of the best fit to each column."""
        return _solved(self.equations.factor, self.whole)

    @cached_property
    def _products(self) -> FloatArray:
        return self.at.T @ self.at

    @property
    def precision(self) -> FloatArray:
        """Inverse covariance of the gains of the columns, shape (k, k), m^2, for independent errors of 1 m."""
        left: FloatArray = self._products - self.whole.T @ self.solved
        return left * self.equations.problem.scale**2

    def fit(self, y: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Fit hysteresis and columns to all samples of `y` (m, (N,)); return parameters (p,) and gains (k,)."""
        # The parameters are in units of the problem's scale, without the constraint of monotone branches.
        own = self.equations.columns(y)
        # Products with the design matrix, and the best hysteresis, of target and columns, shape (p, 1 + k) each.
        projected = np.column_stack([own.whole, self.whole])
        parameters = np.column_stack([own.solved, self.solved])
        left = np.column_stack([self.at.T @ own.at, self._products]) - projected[:, 1:].T @ parameters
        gains = solved(left[:, 1:], left[:, 0])
        return parameters @ np.concatenate([[1.0], -gains]), gains


def _solved(factor: Factor, of: FloatArray) -> FloatArray:
    solution: FloatArray = scipy.linalg.cho_solve(factor, of, check_finite=False)
    return solution


def _groups(problem: Problem, evidence: Evidence) -> list[IntArray]:
    """Return, for each record, the rows that are in every fit, followed by the rows of each fold."""
    # The beginning of a record is never held out, because relaxation from before the record is visible only there.
    judged, groups = _judged(problem), []
    for rows in evidence.slices:
        fitted = evidence.rows[rows][problem.weights[evidence.rows[rows]] > 0]
        fitted = _thinned(fitted, -(-problem.count // MOST_ROWS))
        settled = int(fitted[int(BEGINNING * fitted.size)]) if fitted.size else 0
        allowed = np.zeros(problem.y.size, dtype=bool)
        allowed[fitted] = judged[fitted]
        folds = [fold[fold >= settled] for fold in blocked_folds(allowed)]
        always = np.setdiff1d(fitted, np.concatenate(folds), assume_unique=True)
        groups += [always, *folds]
    return groups


def _thinned(rows: IntArray, every: int) -> IntArray:
    """Return one of every so many rows, shape (n,), at irregular distances, so that no line becomes another one."""
    first = np.arange(0, rows.size, every)
    taken: IntArray = rows[np.minimum(first + np.random.default_rng(0).integers(0, every, first.size), rows.size - 1)]
    return taken


def _judged(problem: Problem) -> Mask:
    """Return the mask of the rows, shape (N,), that other parts of the record or other records can predict."""
    walk = problem.design.walk
    # Before the first motion the hysteresis state does not matter; the signal there is not due to hysteresis.
    return np.asarray((problem.judged & ~walk.first_rise) | (walk.direction == 0))


def _predicted(own: Rows, known: Mask, rest: FloatArray, factor: Factor, size: int, every: int) -> Mask:
    """Return the mask of the rows of a record, shape (n,), that the other records can predict."""
    # The record has the rows `own`; to those where `known`, shape (n,), the initial state only adds a constant.
    # `rest`, shape (p, p), are the normal equations of the other records, and `factor` is their factor with the
    # penalty; after the first `size` parameters, of the hysteresis, follow the displacements at rest. The prediction
    # variance is computed at every `every`-th row.
    if not known.any():
        return known
    # Parameters on which only the preceding path depends add a constant to these samples.
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
    """Return the Cholesky factor of a symmetric matrix, which is overwritten."""
    # Transposed it is in the order of LAPACK, which then needs no copy.
    factor: Factor = scipy.linalg.cho_factor(matrix.T, overwrite_a=True, check_finite=False)
    return factor


def _sum(parts: Sequence[FloatArray]) -> FloatArray:
    return reduce(operator.add, parts)


class Anderson:
    """Anderson's mixing for a fixed point ``x = x + change(x)``: Walker and Ni, SIAM J. Numer. Anal. 49 (2011) 1715."""

    def __init__(self) -> None:
        self._points: list[FloatArray] = []
        self._changes: list[FloatArray] = []

    def next(self, x: FloatArray, change: FloatArray) -> FloatArray:
        """Return the next point after `x` with its `change`, shape (N,)."""
        self._points, self._changes = [*self._points[-DEPTH:], x], [*self._changes[-DEPTH:], change]
        if len(self._points) == 1:
            return x + change
        of_x, of_change = (np.diff(np.array(each), axis=0) for each in (self._points, self._changes))
        gains = np.linalg.lstsq(of_change[:, ::MIXED_EVERY].T, change[::MIXED_EVERY], rcond=1e-8)[0]
        return np.asarray(x + change - gains @ (of_x + of_change))


class JointFit:
    """Joint fit of the hysteresis and of effects, which are in the order of the signal chain; signals (m, (N,))."""

    # The equations of `like`, a fit to the same evidence, are reused if the same voltage `u` (V) drives the hysteresis.
    # `h` is the displacement of the hysteresis, `added` the contribution of the effects on the displacement and of the
    # reversible path parallel to the hysteresis, and `settling` the relaxation in each record from moves before it,
    # with the columns `beside` of the evidence. `began` (m, (k,)) holds its amplitudes, record by record, by effect.
    equations: Equations
    h: FloatArray
    added: FloatArray
    settling: FloatArray

    def __init__(self, evidence: Evidence, effects: Sequence[Effect] = (), like: "JointFit | None" = None) -> None:
        self.evidence, self.effects = evidence, in_order(effects)
        self.t, self.y, self.used = evidence.t, evidence.y, evidence.used
        applied, self.u, self._aside = Chain.of(self.effects).reaching(evidence.v, evidence.around)
        # Context passed to the effects.
        self.around = evidence.around.without(self.effects).driven(applied)
        if like and not evidence.poses_as(like.evidence):
            like = None
        if like and np.array_equal(like.u, self.u):
            self.equations = like.equations
        else:
            self.equations = Equations(evidence, self.u, like.equations if like else None)
        starting = [one.starting(evidence.around, evidence.used) for one in self.effects]
        self.starts = np.cumsum([0, *(columns.shape[1] for columns in starting)]).tolist()
        self.before = np.column_stack([*starting, evidence.beside])
        beside = self.equations.columns(self.before)
        behind = any(effect.acts_on == "displacement" for effect in self.effects)
        self.added = self._aside
        if not behind or not like:
            self._fit(beside)
        if not behind:
            return
        if like:
            self.h, self.added, self.settling = like.h, like.added, like.settling
        mixing = Anderson()
        for _ in range(MOST_TURNS):
            missed = self.y - _behind(self.effects, self.h + self._aside, self.around) - self.settling
            change = self.y - self.h - self.settling - self._back(missed) - self.added
            self.added = mixing.next(self.added, change)
            self._fit(beside)
            if np.ptp(change) < SETTLED * np.std(self.target - self.h):
                break
        self.added = _behind(self.effects, self.h + self._aside, self.around) - self.h

    def _back(self, signal: FloatArray) -> FloatArray:
        """Return a signal, shape (N,), through the adjoint of the effects that are filters of the displacement."""
        # In reversed time a filter is its own adjoint.
        filters = [effect for effect in self.effects if effect.is_filter]
        if not filters:
            return signal
        parts = []
        for around, own in zip(self.evidence.reversed, self.around.split(signal), strict=True):
            own = own[::-1]
            for effect in reversed(filters):
                own = effect.apply(own, around)
            parts.append(own[::-1])
        return np.concatenate(parts)

    def _fit(self, beside: Columns) -> None:
        self._x, gains = beside.fit(self.target)
        self.h = self.equations.predict(self._x)
        self.settling = self.before @ gains
        self.began = {
            effect.name: gains[first:end]
            for effect, (first, end) in zip(self.effects, pairwise(self.starts), strict=True)
        }

    @property
    def target(self) -> FloatArray:
        """Measured displacement minus the contribution of the effects, shape (N,), metres."""
        return self.evidence.y - self.added

    @property
    def predicted(self) -> FloatArray:
        """Predicted displacement, shape (N,), metres."""
        return self.h + self.added + self.settling

    @property
    def residual(self) -> FloatArray:
        """Residual, measured - predicted, shape (N,), metres."""
        return self.evidence.y - self.predicted

    def respond(self, u: FloatArray) -> FloatArray:
        """Return the displacement of the hysteresis, shape (N,), metres, for another voltage `u`, shape (N,), volts."""
        response = self.evidence.predict(self.evidence.samples(u), self._x)[self.evidence.rows]
        return response * self.equations.problem.scale

    @cached_property
    def tangents(self) -> FloatArray:
        """Derivative of the prediction by each free parameter of the effects, shape (N, k), metres per unit."""
        found = [np.empty((self.evidence.t.size, 0))]
        for place, effect in enumerate(self.effects):
            values, by = free(effect), steps(effect, self.evidence.t, self.evidence.v)
            columns = np.zeros((self.evidence.t.size, values.size))
            for group in independent(effect):
                changed = values.copy()
                changed[[*group]] += by[[*group]]
                effects = [*self.effects[:place], moved(effect, changed), *self.effects[place + 1 :]]
                change = self._whole(effects) - self.predicted
                for k, record in group.items():
                    rows = slice(None) if record is None else self.evidence.slices[record]
                    columns[rows, k] = change[rows] / by[k]
            found.append(columns)
        return np.column_stack(found)

    def _whole(self, effects: Sequence[Effect]) -> FloatArray:
        """Return the prediction, shape (N,), metres, of the same hysteresis with other effects."""
        applied, u, beside = Chain.of(tuple(effects)).reaching(self.evidence.v, self.evidence.around)
        h = self.h if np.array_equal(u, self.u) else self.respond(u)
        return self.settling + _behind(effects, h + beside, self.evidence.around.without(effects).driven(applied))

    def prediction_without(self, name: str) -> FloatArray:
        """Return the prediction, shape (N,), metres, without one of the effects and with everything else unchanged."""
        return self._whole([effect for effect in self.effects if effect.name != name])

    @cached_property
    def held_out(self) -> Loss:
        """Held-out errors of this fit."""
        columns = np.column_stack([self.target, self.before, self.tangents])
        return self.equations.held_out(self.equations.sampled(columns)).loss([0], range(1, columns.shape[1]))

    @property
    def objective(self) -> float:
        """Mean square of the residual plus the roughness penalty of the hysteresis, m^2."""
        used, problem = self.used, self.equations.problem
        rough = float(self._x @ problem.penalty(self.evidence.smoothness, problem.count) @ self._x) / problem.count
        return float(np.mean(self.residual[used] ** 2)) + rough * problem.scale**2

    def refined(self, times: int) -> "JointFit":
        """Return the fit after up to `times` Gauss-Newton steps of hysteresis and all effect parameters."""
        best = self
        for _ in range(times if self.effects else 0):
            better = best._step()
            gain = 1.0 - better.objective / best.objective
            best = better
            if gain < ENOUGH:
                break
        return best

    def _step(self) -> "JointFit":
        """Return the fit after one Gauss-Newton step, shortened until the objective falls; else the fit itself."""
        change = self.equations.columns(self.before, self.tangents).fit(self.target)[1][self.before.shape[1] :]
        for share in SHARES:
            try:
                effects = self._stepped(share * change)
            except ModelError:
                # The step is too long: the effect parameters are invalid.
                continue
            stepped = JointFit(self.evidence, effects, self)
            if stepped.objective < self.objective:
                return stepped
        return self

    def _stepped(self, change: FloatArray) -> list[Effect]:
        effects, first = [], 0
        limit, used = SLOWEST * longest(self.evidence.around), self.y[self.used]
        around = NEAR_MOTION * float(np.ptp(used))
        near = float(used.min()) - around, float(used.max()) + around
        for effect in self.effects:
            values = free(effect)
            step = change[first : first + values.size]
            first += values.size
            effects.append(moved(effect, values + bounded(effect, step), limit, near))
        return effects

    @cached_property
    def noise(self) -> float:
        """Sensor noise (m rms): the white part of the residual, the largest of the records.

        At least the rounding error, and the resolution of the best of sensors.
        """
        finest = FINEST * float(np.ptp(self.y[self.used]))
        return max([finest, self.evidence.rounding, *(white_noise(residual) for _, residual in self.residuals)])

    @property
    def residuals(self) -> list[tuple[Part, FloatArray]]:
        """The data of each record with its residual (m), NaN at samples that are not used."""
        parts = zip(self.evidence.parts, self.evidence.slices, strict=True)
        return [(part, np.where(part.used, self.residual[rows], np.nan)) for part, rows in parts]

    def hysteresis(self) -> tuple[Hysteresis, tuple[float, ...]]:
        """Return the hysteresis with monotone branches, and its displacement at the start of each record, m."""
        problem = replace(self.equations.problem, y=self.equations.padded(self.target - self.settling))
        x = problem.solve(self.evidence.smoothness).x
        h = problem.design.predict(x)[self.evidence.rows] * problem.scale
        starts = tuple(float(h[rows.start]) for rows in self.evidence.slices)
        return problem.basis.shape(x[: problem.basis.size + 1] * problem.scale, problem.gain), starts

    def with_uncertainty(self) -> list[Effect]:
        """Return the effects with the standard deviations of their free parameters."""
        if not self.effects:
            return []
        # Errors of neighbouring samples are correlated, so there are fewer independent errors than samples.
        precision = self.equations.columns(self.tangents, self.before).precision
        errors = self.residual[self.evidence.used]
        size = np.sqrt(np.maximum(np.diag(precision), 1e-300))
        inverse = np.linalg.pinv(precision / np.outer(size, size), rcond=1e-12) / np.outer(size, size)
        variances = np.maximum(np.diag(inverse), 0.0) * np.mean(errors**2) * alike_in_a_row(errors)
        spread = iter(np.sqrt(variances).tolist())
        return [certain(effect, [next(spread) for _ in free(effect)]) for effect in self.effects]

    def smoothed(self) -> "JointFit":
        """Return the fit with the smoothness of the hysteresis reselected by cross-validation, given the effects."""
        problem = replace(self.equations.problem, y=self.equations.padded(self.target))
        best = problem.smoothness_near(self.evidence.smoothness, SMOOTHNESS)
        if best == self.evidence.smoothness:
            return self
        smoothed = JointFit(replace(self.evidence, smoothness=best), self.effects).refined(2)
        # That choice is based on one division into blocks and on fixed effects; therefore compare after a refit.
        return min(self.refined(2), smoothed, key=lambda one: one.held_out.rms)

    @cached_property
    def zeros(self) -> FloatArray:
        """Displacement at the centre of the largest loop of each record, shape (records,), metres."""
        low, high = float(self.u.min()), float(self.u.max())
        middle, zeros = 0.5 * (low + high), []
        for part, rows in zip(self.evidence.parts, self.evidence.slices, strict=True):
            first = float(self.u[rows.start])
            path = np.array([first, low, high, middle, low, middle])
            whole = Samples(path, path, np.ones(path.size, dtype=bool)).after(part.history)
            x = self._x[: self.evidence.basis.size + 1]
            y = self.evidence.predict([whole], x)[-path.size :] * self.equations.problem.scale
            zeros.append(0.5 * (y[3] + y[5]) + float(self.h[rows.start]) - y[0])
        return np.array(zeros)

    def effect(self, name: str) -> Effect:
        """Return the effect of this name."""
        return next(effect for effect in self.effects if effect.name == name)

    def adding(self, effect: Effect) -> "JointFit":
        """Return the fit with one more effect, or with more of one that is there; ModelError if it has that once."""
        more = {other.name: other.joined(effect) for other in self.effects if other.name == effect.name}
        joined = [more.get(other.name) or other for other in self.effects]
        return JointFit(self.evidence, joined if all(more.values()) and more else [*joined, effect], self)

    def replacing(self, name: str, effect: Effect) -> "JointFit":
        """Return the fit with an effect in place of another one."""
        return JointFit(self.evidence, [effect if one.name == name else one for one in self.effects], self)

    def predicted_with(self, effect: Effect) -> FloatArray:
        """Return the prediction, shape (N,), metres, with one more effect and with everything else unchanged."""
        return self._whole(in_order([*(one for one in self.effects if one.name != effect.name), effect]))

    def only(self, names: Collection[str], *, refine: bool = True) -> "JointFit":
        """Return the fit with only the named effects, refitted (default) if any effect is removed."""
        kept = [effect for effect in self.effects if effect.name in names]
        if len(kept) == len(self.effects):
            return self
        fit = JointFit(self.evidence, kept, self)
        return fit.refined(2) if refine else fit

    def without(self, name: str) -> "JointFit":
        """Return the fit without one effect, with the others refitted."""
        return self.only([effect.name for effect in self.effects if effect.name != name])

    def beside(self, columns: FloatArray) -> "JointFit":
        """Return the fit with additional `columns`, shape (N, k), metres, whose gains are free."""
        evidence = replace(self.evidence, beside=np.column_stack([self.evidence.beside, columns]))
        return JointFit(evidence, self.effects, self)


def _behind(effects: Sequence[Effect], h: FloatArray, around: EffectContext) -> FloatArray:
    """Return the displacement, shape (N,), metres, after effects have been applied to the hysteresis output `h`."""
    return forward([effect for effect in effects if effect.acts_on == "displacement"], h, around)
