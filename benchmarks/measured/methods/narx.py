"""Polynomial NARX model with the change of the input and its sign as regressors.

Structure by orthogonal forward regression (FROLS: Billings, Chen and Korenberg 1989, doi:10.1080/00207178908953472).
For hysteresis the regressors are those of Martins and Aguirre (2016, doi:10.1016/j.ymssp.2015.12.010): the change of
the input and its sign. Own least squares: the package sysidentpy asks for another version of numpy than the package.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations_with_replacement

import numpy as np
from numpy.typing import NDArray

from benchmarks.measured.methods import operators
from benchmarks.measured.methods.base import SEARCH_ROWS, FloatArray, Scale, Series, prepare

IntArray = NDArray[np.int64]

# Highest degree of a term, and most terms.
DEGREE, MOST_TERMS = 3, 22
# Blocks left out in turn: the polynomial is the one whose free run predicts them best.
BLOCKS = 5
# Its free run stays within this share of the range around the mean, also where the fitted voltages pass at these paces.
WITHIN, PACES = 1.0, (0.5, 1.0, 2.0)
# Samples of all records together at which the model is computed; several are tried.
SAMPLES = (1500, 4000, 12000)
# Numbers of terms that are tried.
SIZES = (3, 5, 7, 9, 12, 15, 18, 22)


def candidates() -> IntArray:
    """Return the exponents of y(k-1), y(k-2), u(k), u(k-1), change and sign in each term, (T, 6)."""
    rows: set[tuple[int, ...]] = {(0,) * 6}
    for degree in range(1, DEGREE + 1):
        for chosen in combinations_with_replacement(range(6), degree):
            powers = [chosen.count(i) for i in range(6)]
            # The square of a sign is 1, the change times its sign is no new direction: at most one of the two, once.
            if powers[5] <= 1:
                rows.add(tuple(powers))
    return np.array(sorted(rows), dtype=np.int64)


def regressors(y: FloatArray, u: FloatArray, powers: IntArray) -> FloatArray:
    """Return the terms at the samples from the third on, (N - 2, T)."""
    change = np.diff(u)[1:]
    values = np.stack([y[1:-1], y[:-2], u[2:], u[1:-1], change, np.sign(change)])
    return np.stack([np.prod(values ** row[:, None], axis=0) for row in powers], axis=1)


def chosen_terms(x: FloatArray, y: FloatArray, most: int) -> list[int]:
    """Return the terms in the order of their error reduction ratio (FROLS), at most `most`."""
    order: list[int] = []
    left = x.copy()
    rest = y.copy()
    original = np.sum(x**2, axis=0)
    for _ in range(most):
        size = np.sum(left**2, axis=0)
        usable = size > 1e-10 * original
        usable[order] = False
        if not usable.any():
            break
        ratio = np.where(usable, (left.T @ rest) ** 2 / np.where(usable, size, 1.0), -1.0)
        best = int(np.argmax(ratio))
        order.append(best)
        direction = left[:, best] / np.sqrt(size[best])
        rest = rest - direction * (direction @ rest)
        left = left - np.outer(direction, direction @ left)
    return order


@dataclass(frozen=True)
class Run:
    """A scaled record, with its history, at a uniform step of time from `start` (s) on."""

    name: str
    start: float
    u: FloatArray
    y: FloatArray
    fitted: NDArray[np.bool_]


@dataclass(frozen=True)
class NarxModel:
    """A fitted polynomial with its step of time (s)."""

    scale: Scale
    step: float
    powers: IntArray
    gains: FloatArray
    constants: dict[str, float]

    def simulate(self, name: str, t: FloatArray, v: FloatArray, history: tuple[float, ...]) -> FloatArray:
        """Return the displacement, shape (N,)."""
        before = [float(x) for x in self.scale.voltage(np.asarray(history, dtype=np.float64))]
        prepared = prepare(t, self.scale.voltage(v), before)
        grid = np.arange(prepared.t[0], prepared.t[-1] + self.step, self.step)
        u = np.interp(grid, prepared.t, prepared.u)
        y = operators.polynomial_run(u, self.powers, self.gains, 0.0)
        constant = self.constants.get(name, 0.0)
        return self.scale.back(np.interp(t, grid, y) + constant)


@dataclass(frozen=True)
class NarxMethod:
    """The method: the step of time and the terms whose free run has the least error on blocks left out."""

    name: str = "NARX"

    def fit(self, records: Sequence[Series]) -> NarxModel:
        """Choose terms for each step of time, and keep the best free run."""
        scale, powers = Scale.of(records), candidates()
        total = sum(float(one.t[-1] - one.t[0]) for one in records)
        shortest = min(float(np.median(np.diff(one.t))) for one in records)
        best: tuple[bool, float, NarxModel] | None = None
        for samples in SAMPLES:
            step = max(total / samples, shortest)
            runs = [resampled(one, scale, step) for one in records]
            inside = [run.fitted[2:] & run.fitted[1:-1] & run.fitted[:-2] for run in runs]
            x = np.vstack([regressors(run.y, run.u, powers)[own] for run, own in zip(runs, inside, strict=True)])
            y = np.concatenate([run.y[2:][own] for run, own in zip(runs, inside, strict=True)])
            share = max(1, len(y) // (2 * SEARCH_ROWS))
            # Without past outputs a free run cannot grow without bound.
            usable = [np.arange(len(powers)), np.flatnonzero(powers[:, :2].sum(axis=1) == 0)]
            orders = [own[chosen_terms(x[::share][:, own], y[::share], MOST_TERMS)] for own in usable]
            for terms in (order[:size] for order in orders for size in SIZES):
                model = _solved(runs, scale, step, powers[terms], x[:, terms], y)
                found = _fails(runs, model), _left_out(runs, inside, model.powers, x[:, terms], y), model
                if best is None or found[:2] < best[:2]:
                    best = found
            if step == shortest:
                break
        assert best is not None
        return best[2]


def resampled(one: Series, scale: Scale, step: float) -> Run:
    before = [float(x) for x in scale.voltage(np.asarray(one.history, dtype=np.float64))]
    prepared = prepare(one.t, scale.voltage(one.v), before)
    # The last one is not before the end of the record.
    grid = prepared.t[0] + step * np.arange(int(np.ceil((prepared.t[-1] - prepared.t[0]) / step)) + 1)
    known = np.isfinite(one.y)
    y = np.interp(grid, one.t[known], scale.displacement(one.y[known]))
    fitted = np.interp(grid, one.t, one.fitted.astype(np.float64), left=0.0, right=0.0) > 0.999
    return Run(one.name, float(grid[0]), np.interp(grid, prepared.t, prepared.u), y, fitted)


def _left_out(
    runs: Sequence[Run], inside: Sequence[NDArray[np.bool_]], powers: IntArray, x: FloatArray, y: FloatArray
) -> float:
    """Return the mean square of the free-run errors of blocks left out, without their means."""
    total = 0.0
    for block in np.array_split(np.arange(y.size), BLOCKS):
        gains = _gains(np.delete(x, block, axis=0), np.delete(y, block))
        found = [operators.polynomial_run(run.u, powers, gains, 0.0)[2:] for run in runs]
        errors = y - np.concatenate([one[own] for one, own in zip(found, inside, strict=True)])
        total += float(np.var(errors[block])) * block.size
    return total / y.size


def _gains(x: FloatArray, y: FloatArray) -> FloatArray:
    return np.asarray(np.linalg.lstsq(x, y, rcond=None)[0], dtype=np.float64)


def _fails(runs: Sequence[Run], model: NarxModel) -> bool:
    """Return whether a free run leaves the bounds at any pace, or explains the fitted samples worse than a line."""
    own, line = 0.0, 0.0
    for run in runs:
        at = np.arange(run.u.size)
        for pace in PACES:
            u = np.interp(np.arange(0.0, at.size - 1.0, pace), at, run.u)
            if np.max(np.abs(operators.polynomial_run(u, model.powers, model.gains, 0.0))) > WITHIN:
                return True
        error = run.y - operators.polynomial_run(run.u, model.powers, model.gains, 0.0)
        u, y = run.u[run.fitted], run.y[run.fitted]
        own += float(np.var(error[run.fitted])) * y.size
        line += float(np.var(y - np.polyval(np.polyfit(u, y, 1), u))) * y.size
    return own > line


def _solved(
    runs: Sequence[Run], scale: Scale, step: float, powers: IntArray, x: FloatArray, y: FloatArray
) -> NarxModel:
    """Return the model with the constant of each record."""
    gains = _gains(x, y)
    errors = {run.name: (run.y - operators.polynomial_run(run.u, powers, gains, 0.0))[run.fitted] for run in runs}
    return NarxModel(scale, step, powers, gains, {name: float(np.mean(error)) for name, error in errors.items()})


NARX = NarxMethod()
