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
from benchmarks.measured.methods.linear import likely_histories

IntArray = NDArray[np.int64]

# Highest degree of a term, and most terms.
DEGREE, MOST_TERMS = 3, 22
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
    """The method: the step of time and the number of terms with the least free-run error of the fitted samples."""

    name: str = "NARX"

    def fit(self, records: Sequence[Series]) -> NarxModel:
        """Choose terms for each step of time, and keep the best free run."""
        scale, powers = Scale.of(records), candidates()
        histories = likely_histories(records)
        total = sum(float(one.t[-1] - one.t[0]) for one in records)
        shortest = min(float(np.median(np.diff(one.t))) for one in records)
        best: tuple[float, NarxModel] | None = None
        for samples in SAMPLES:
            step = max(total / samples, shortest)
            runs = [resampled(one, scale, step, history) for one, history in zip(records, histories, strict=True)]
            pairs = [_fitted_rows(run, powers) for run in runs]
            x, y = np.vstack([a for a, _ in pairs]), np.concatenate([b for _, b in pairs])
            share = max(1, len(y) // (2 * SEARCH_ROWS))
            order = chosen_terms(x[::share], y[::share], MOST_TERMS)
            for size in SIZES:
                terms = order[:size]
                gains = np.linalg.lstsq(x[:, terms], y, rcond=None)[0]
                found = _judged(runs, scale, step, powers[terms], gains)
                if best is None or found[0] < best[0]:
                    best = found
            if step == shortest:
                break
        assert best is not None
        return best[1]


def resampled(one: Series, scale: Scale, step: float, history: tuple[float, ...]) -> Run:
    before = [float(x) for x in scale.voltage(np.asarray(history, dtype=np.float64))]
    prepared = prepare(one.t, scale.voltage(one.v), before)
    grid = np.arange(prepared.t[0], prepared.t[-1], step)
    known = np.isfinite(one.y)
    y = np.interp(grid, one.t[known], scale.displacement(one.y[known]))
    fitted = np.interp(grid, one.t, one.fitted.astype(np.float64), left=0.0) > 0.999
    return Run(one.name, float(grid[0]), np.interp(grid, prepared.t, prepared.u), y, fitted)


def _fitted_rows(run: Run, powers: IntArray) -> tuple[FloatArray, FloatArray]:
    inside = run.fitted[2:] & run.fitted[1:-1] & run.fitted[:-2]
    return regressors(run.y, run.u, powers)[inside], run.y[2:][inside]


def _judged(
    runs: Sequence[Run], scale: Scale, step: float, powers: IntArray, gains: FloatArray
) -> tuple[float, NarxModel]:
    """Return the free-run rms error of the fitted samples, and the model with the constant of each record."""
    errors, constants = [], {}
    for run in runs:
        error = run.y - operators.polynomial_run(run.u, powers, gains, 0.0)
        kept = error[run.fitted]
        constants[run.name] = float(np.mean(kept))
        errors.append(kept - np.mean(kept))
    rms = float(np.sqrt(np.mean(np.concatenate(errors) ** 2)))
    return rms, NarxModel(scale, step, powers, gains, constants)


NARX = NarxMethod()
