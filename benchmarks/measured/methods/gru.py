"""A small recurrent network: one layer of gated recurrent units and a linear output, in numpy and Numba.

Cho et al. (2014, arXiv:1406.1078). No deep-learning package is needed: the network has some 900 weights. It is trained
by backpropagation through windows whose initial states come from a free run over the whole record, with Adam (Kingma
and Ba 2015, arXiv:1412.6980) and a falling step. Inputs: the voltage and its change. The weights of the lowest free-run
error on the fitted samples are kept.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from benchmarks.measured.methods.base import FloatArray, Scale, Series
from benchmarks.measured.methods.narx import Run, resampled

IntArray = NDArray[np.int64]

# Hidden units, window (samples), windows a step, steps, steps between two free runs, and samples in all.
HIDDEN, WINDOW, BATCH, STEPS, EVERY, SAMPLES = 16, 160, 12, 3000, 60, 6000
# Inputs and a constant 1.
INPUTS = 3
# Adam: first step size, its decays, and the largest norm of a gradient.
STEP, FIRST, SECOND, NORM = 1e-2, 0.9, 0.999, 1.0


@njit(cache=True)
def forward(
    x: FloatArray, w: FloatArray, r: FloatArray, out: FloatArray, h: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the outputs (N,) and the hidden states before each sample (N + 1, H).

    x (N, 3); w (3, H, 3) input and r (3, H, H) recurrent weights of update gate, reset gate and candidate; out (H + 1,)
    output weights; h (H,) first hidden state.
    """
    count, size = x.shape[0], h.size
    y = np.empty(count)
    states = np.empty((count + 1, size))
    states[0] = h
    z, s, c = np.empty(size), np.empty(size), np.empty(size)
    for k in range(count):
        before, after = states[k], states[k + 1]
        for i in range(size):
            a, b = 0.0, 0.0
            for j in range(3):
                a += w[0, i, j] * x[k, j]
                b += w[1, i, j] * x[k, j]
            for j in range(size):
                a += r[0, i, j] * before[j]
                b += r[1, i, j] * before[j]
            z[i] = 1.0 / (1.0 + np.exp(-a))
            s[i] = before[i] / (1.0 + np.exp(-b))
        total = out[size]
        for i in range(size):
            a = 0.0
            for j in range(3):
                a += w[2, i, j] * x[k, j]
            for j in range(size):
                a += r[2, i, j] * s[j]
            c[i] = np.tanh(a)
            after[i] = (1.0 - z[i]) * before[i] + z[i] * c[i]
            total += out[i] * after[i]
        y[k] = total
    return y, states


@njit(cache=True)
def gradient(
    x: FloatArray,
    target: FloatArray,
    weight: FloatArray,
    w: FloatArray,
    r: FloatArray,
    out: FloatArray,
    h: FloatArray,
    dw: FloatArray,
    dr: FloatArray,
    dout: FloatArray,
) -> None:
    """Add the gradient of the weighted squared error of a window to `dw`, `dr` and `dout`."""
    y, states = forward(x, w, r, out, h)
    count, size = x.shape[0], h.size
    carried = np.zeros(size)
    z, g, s, c = np.empty(size), np.empty(size), np.empty(size), np.empty(size)
    da, db, dc, ds = np.empty(size), np.empty(size), np.empty(size), np.empty(size)
    for k in range(count - 1, -1, -1):
        before, after = states[k], states[k + 1]
        for i in range(size):
            a, b = 0.0, 0.0
            for j in range(3):
                a += w[0, i, j] * x[k, j]
                b += w[1, i, j] * x[k, j]
            for j in range(size):
                a += r[0, i, j] * before[j]
                b += r[1, i, j] * before[j]
            z[i] = 1.0 / (1.0 + np.exp(-a))
            g[i] = 1.0 / (1.0 + np.exp(-b))
            s[i] = g[i] * before[i]
        for i in range(size):
            a = 0.0
            for j in range(3):
                a += w[2, i, j] * x[k, j]
            for j in range(size):
                a += r[2, i, j] * s[j]
            c[i] = np.tanh(a)
        error = weight[k] * (y[k] - target[k])
        dout[size] += error
        for i in range(size):
            dout[i] += error * after[i]
            dh = carried[i] + error * out[i]
            da[i] = dh * (c[i] - before[i]) * z[i] * (1.0 - z[i])
            dc[i] = dh * z[i] * (1.0 - c[i] * c[i])
            carried[i] = dh * (1.0 - z[i])
            ds[i] = 0.0
        for i in range(size):
            for j in range(size):
                ds[j] += dc[i] * r[2, i, j]
                dr[2, i, j] += dc[i] * s[j]
        for i in range(size):
            db[i] = ds[i] * before[i] * g[i] * (1.0 - g[i])
            carried[i] += ds[i] * g[i]
        for i in range(size):
            for j in range(3):
                dw[0, i, j] += da[i] * x[k, j]
                dw[1, i, j] += db[i] * x[k, j]
                dw[2, i, j] += dc[i] * x[k, j]
            for j in range(size):
                dr[0, i, j] += da[i] * before[j]
                dr[1, i, j] += db[i] * before[j]
                carried[j] += da[i] * r[0, i, j] + db[i] * r[1, i, j]


@dataclass(frozen=True)
class GruModel:
    """A trained network with its step of time (s)."""

    scale: Scale
    step: float
    speed: float
    weights: tuple[FloatArray, FloatArray, FloatArray]
    constants: dict[str, float]

    def simulate(self, name: str, t: FloatArray, v: FloatArray, history: tuple[float, ...]) -> FloatArray:
        """Return the displacement, shape (N,)."""
        one = Series(name, t, v, np.zeros(t.size), np.ones(t.size, dtype=np.bool_), history)
        run = resampled(one, self.scale, self.step)
        w, r, out = self.weights
        y, _ = forward(_inputs(run.u, self.speed), w, r, out, np.zeros(HIDDEN))
        grid = run.start + self.step * np.arange(y.size)
        return self.scale.back(np.interp(t, grid, y) + self.constants.get(name, 0.0))


def _inputs(u: FloatArray, speed: float) -> FloatArray:
    return np.stack([u, np.diff(u, prepend=u[0]) / speed, np.ones(u.size)], axis=1)


@dataclass(frozen=True)
class GruEnsemble:
    """The mean of several networks, which differ in their first weights."""

    members: tuple[GruModel, ...]

    def simulate(self, name: str, t: FloatArray, v: FloatArray, history: tuple[float, ...]) -> FloatArray:
        """Return the displacement, shape (N,)."""
        return np.asarray(np.mean([one.simulate(name, t, v, history) for one in self.members], axis=0))


@dataclass(frozen=True)
class GruMethod:
    """The method; the random numbers are the same for every record."""

    name: str = "GRU"
    steps: int = STEPS
    seeds: tuple[int, ...] = (0, 1, 2)

    def fit(self, records: Sequence[Series]) -> GruEnsemble:
        """Train a network for each seed."""
        return GruEnsemble(tuple(self.trained(records, seed) for seed in self.seeds))

    def trained(self, records: Sequence[Series], seed: int) -> GruModel:
        """Train, and keep the weights of the best free run."""
        rng = np.random.default_rng(seed)
        scale = Scale.of(records)
        total = sum(float(one.t[-1] - one.t[0]) for one in records)
        shortest = min(float(np.median(np.diff(one.t))) for one in records)
        step = max(total / SAMPLES, shortest)
        runs = [resampled(one, scale, step) for one in records]
        constants = _constants(runs, scale)
        speed = float(np.sqrt(np.mean(np.concatenate([np.diff(run.u) for run in runs]) ** 2))) + 1e-12
        xs = [_inputs(run.u, speed) for run in runs]
        targets = [run.y - constants[run.name] for run in runs]
        weights = [run.fitted.astype(np.float64) for run in runs]
        w = rng.normal(0.0, 0.5, (3, HIDDEN, INPUTS))
        # Update gates that are nearly closed: the units remember from the start.
        w[0, :, 2] -= rng.uniform(0.0, 4.0, HIDDEN)
        r = rng.normal(0.0, 1.0 / np.sqrt(HIDDEN), (3, HIDDEN, HIDDEN))
        out = np.append(rng.normal(0.0, 0.1, HIDDEN), 0.0)
        parameters = [w, r, out]
        moments = [(np.zeros_like(p), np.zeros_like(p)) for p in parameters]
        best, kept = np.inf, [p.copy() for p in parameters]
        places = [(k, start) for k, run in enumerate(runs) for start in _starts(run)]
        states: list[FloatArray] = []
        for number in range(self.steps + 1):
            if number % EVERY == 0:
                ran = [forward(x, w, r, out, np.zeros(HIDDEN)) for x in xs]
                states = [state for _, state in ran]
                error = _error([y for y, _ in ran], targets, weights)
                if error < best:
                    best, kept = error, [p.copy() for p in parameters]
            gradients = [np.zeros_like(p) for p in parameters]
            for at in rng.integers(len(places), size=BATCH):
                k, start = places[at]
                part = slice(start, start + WINDOW)
                gradient(xs[k][part], targets[k][part], weights[k][part], w, r, out, states[k][start], *gradients)
            _adam(parameters, gradients, moments, number, self.steps)
        return GruModel(scale, step, speed, (kept[0], kept[1], kept[2]), constants)


def _starts(run: Run) -> list[int]:
    last = max(run.u.size - WINDOW, 1)
    inside = [start for start in range(0, last, WINDOW // 8) if run.fitted[start : start + WINDOW].mean() > 0.5]
    return inside or [max(int(np.flatnonzero(run.fitted)[0]) if run.fitted.any() else 0, 0)]


def _constants(runs: Sequence[Run], scale: Scale) -> dict[str, float]:
    """Return the constant of each record against the common straight line."""
    slopes = [np.polyfit(run.u[run.fitted], run.y[run.fitted], 1)[0] for run in runs]
    slope = float(np.mean(slopes))
    levels = [float(np.mean(run.y[run.fitted] - slope * run.u[run.fitted])) for run in runs]
    if len(runs) == 1:
        return {runs[0].name: 0.0}
    middle = float(np.mean(levels))
    return {run.name: level - middle for run, level in zip(runs, levels, strict=True)}


def _error(found: Sequence[FloatArray], targets: Sequence[FloatArray], weights: Sequence[FloatArray]) -> float:
    errors = [(y - target)[weight > 0.0] for y, target, weight in zip(found, targets, weights, strict=True)]
    return float(np.sqrt(np.mean(np.concatenate(errors) ** 2)))


def _adam(
    parameters: list[FloatArray],
    gradients: list[FloatArray],
    moments: list[tuple[FloatArray, FloatArray]],
    number: int,
    steps: int,
) -> None:
    """Make one step of Adam, with a step size that falls to nothing as a cosine."""
    for gradient_ in gradients:
        gradient_ /= BATCH * WINDOW
    norm = float(np.sqrt(sum(float(np.sum(g**2)) for g in gradients)))
    factor = min(1.0, NORM / (norm + 1e-12))
    size = STEP * 0.5 * (1.0 + np.cos(np.pi * number / (steps + 1)))
    for p, g, (m, v) in zip(parameters, gradients, moments, strict=True):
        m *= FIRST
        m += (1.0 - FIRST) * factor * g
        v *= SECOND
        v += (1.0 - SECOND) * (factor * g) ** 2
        corrected = m / (1.0 - FIRST ** (number + 1))
        p -= size * corrected / (np.sqrt(v / (1.0 - SECOND ** (number + 1))) + 1e-8)


GRU = GruMethod()
