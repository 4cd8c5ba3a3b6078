"""Every method of the measured records beside a second, independent way to its error, on the same samples.

    python -m benchmarks.measured.twins [--only TASK ..] [--method NAME ..]

PI, SLPI, SLPI with causes: the commands ``slpi import``, ``identify``, ``diagnose``, and what ``slpi verify`` computes.
All others: slow implementations from the equations in plain NumPy, one sample after the other, with solvers of SciPy.
They take delay, lag, shape and penalty that the method found (PI with a lag searches its own) and the history that it
was given, find their weights anew, and simulate the judged record. A ratio beyond `AGREES` is marked with ``!``.
"""

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import argparse
import sys
import tempfile
import warnings
from collections.abc import Callable, Sequence
from contextlib import redirect_stdout
from io import StringIO
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import least_squares, lsq_linear, minimize

from benchmarks.measured.bench import data_folder
from benchmarks.measured.manifest import Task, read_manifest
from benchmarks.measured.methods import METHODS, Method, Series
from benchmarks.measured.methods.base import FloatArray, Mask, prepare
from benchmarks.measured.methods.gru import GruEnsemble, GruModel
from benchmarks.measured.methods.linear import Creep, LinearModel, Plays, Preisach, RatePlays
from benchmarks.measured.methods.narx import NarxModel
from benchmarks.measured.methods.nonlinear import BoucWen, EnvelopePlays, ModifiedModel
from benchmarks.measured.scores import Tables, fitted_series, free_run, split
from slpi_ros import load_model, read_bag
from slpi_ros.cli import main as slpi
from slpi_ros.verification.verify import verify

# One task of each device with a motor of its own kind, small ones.
TASKS = ("picma", "piezo_150v", "afm_double_sine", "ntnu2 20 Hz", "tendon 0.3 Hz")
AGREES = 0.1
# Rows of a least-squares problem, parts of a step of Bouc-Wen, and points of each cell of the Preisach plane.
ROWS, PARTS, POINTS = 4000, 20, 12
History = tuple[float, ...]
Columns = Callable[[FloatArray, FloatArray], FloatArray]


def play(rising: FloatArray, falling: FloatArray, radii: FloatArray) -> FloatArray:
    """Return generalised play operators, (N, K), of envelopes (N,) with radii (K,) or (N, K)."""
    radii = np.broadcast_to(radii, (rising.size, radii.shape[-1]))
    state = np.full(radii.shape[1], (rising[0] + falling[0]) / 2.0)
    found = np.empty(radii.shape)
    for k, (up, down, r) in enumerate(zip(rising, falling, radii, strict=True)):
        state = np.maximum(up - r, np.minimum(down + r, state))
        found[k] = state
    return found


def preisach(u: FloatArray, cells: int) -> FloatArray:
    """Return the part of each cell of the plane that is switched on, (N, C).

    A relay that switches off at b is on if it switches on below A(b), the highest input since the last one below b.
    """
    edges = np.linspace(-1.0, 1.0, cells + 1)
    step = 2.0 / cells
    off = (np.arange(cells * POINTS) + 0.5) * step / POINTS - 1.0
    highest, pairs = -off + 2.0 * u[0], np.tril_indices(cells)
    found = np.empty((u.size, pairs[0].size))
    for k, x in enumerate(u):
        highest = np.where(x <= off, -1.0, np.maximum(highest, x))
        ends = np.clip(highest, edges[:-1, None], edges[1:, None]) - np.clip(off, edges[:-1, None], edges[1:, None])
        found[k] = np.maximum(ends, 0.0).reshape(cells, cells, POINTS).mean(axis=2)[pairs]
    return found


def bouc_wen(u: FloatArray, beta: float, gamma: float, power: float) -> FloatArray:
    """Return the hysteretic variable, (N,), by the midpoint rule with `PARTS` steps from sample to sample."""
    found, z = np.zeros(u.size), 0.0

    def slope(z: float, d: float) -> float:
        return float(d - (beta * abs(d) * np.sign(z) + gamma * d) * abs(z) ** power)

    for k, du in enumerate(np.diff(u), 1):
        for _ in range(PARTS):
            z += slope(z + 0.5 * slope(z, du / PARTS), du / PARTS)
        found[k] = z
    return found


def late(t: FloatArray, u: FloatArray, delay: float, lag: float) -> FloatArray:
    """Return a voltage behind a delay and a lag (s), (N,)."""
    found = np.interp(t - delay, t, u)
    if lag > 0.0:
        for k in range(1, u.size):
            found[k] = found[k - 1] + (1.0 - np.exp((t[k - 1] - t[k]) / lag)) * (found[k] - found[k - 1])
    return found


def columns_of(features: Any) -> Columns:
    """Return what gives the columns of a method, (N, C), from times (s) and a scaled voltage behind delay and lag."""
    radii = np.arange(getattr(features, "count", 1)) / getattr(features, "count", 1)

    def creep(t: FloatArray, u: FloatArray) -> FloatArray:
        slow = np.array(features.times)
        own = play(u, u, np.array(features.creeping))
        states, found = np.repeat(own[0][:, None], slow.size, axis=1), []
        for dt, x in zip(np.diff(t, prepend=t[0]), own, strict=True):
            states = states + (1.0 - np.exp(-dt / slow)) * (x[:, None] - states)
            found.append(states.ravel())
        return np.hstack([play(u, u, radii), found])

    def rate(t: FloatArray, u: FloatArray) -> FloatArray:
        speed = np.abs(np.gradient(u, t))
        smooth = np.array([speed[np.clip(np.arange(k - 2, k + 3), 0, u.size - 1)].mean() for k in range(u.size)])
        return play(u, u, radii + features.widening * smooth[:, None])

    def envelopes(t: FloatArray, u: FloatArray) -> FloatArray:
        a, b, c, d, e, f = features.shape
        rising, falling = np.tanh(a * u + b) + c * u, np.tanh(d * u + e) + f * u
        return np.column_stack([u, play(rising, falling, max(np.ptp(rising), np.ptp(falling)) / 2.0 * radii)])

    def differential(t: FloatArray, u: FloatArray) -> FloatArray:
        beta, gamma, power = features.shape
        z = bouc_wen(u, np.exp(beta), np.tanh(gamma) * np.exp(beta), 0.5 + np.exp(np.clip(power, -4.0, 2.0)))
        return np.column_stack([u, u**2, u**3, z])

    match features:
        case Plays():
            return lambda t, u: play(u, u, radii)
        case Creep():
            return creep
        case RatePlays():
            return rate
        case Preisach():
            return lambda t, u: np.column_stack([u, preisach(u, features.cells)])
        case EnvelopePlays():
            return envelopes
        case BoucWen():
            return differential
    return lambda t, u: u[:, None]


def columns_behind(model: LinearModel, one: Series, history: History, lags: tuple[float, float]) -> FloatArray:
    """Return the columns of a record, (N, C), behind a delay and a lag, s."""
    scaled = [float(x) for x in (np.array(history) - model.scale.v_middle) / model.scale.v_half]
    ready = prepare(one.t, (one.v - model.scale.v_middle) / model.scale.v_half, scaled)
    return columns_of(model.features)(ready.t, late(ready.t, ready.u, *lags))[ready.skipped :]


def weights_of(
    columns: Sequence[FloatArray], ys: Sequence[FloatArray], free: int, ridges: Sequence[float], largest: bool = False
) -> FloatArray:
    """Return the weights (C,), of which those after the first `free` are not negative; each record has a constant.

    Of several ridges that which predicts fifths left out best, or the `largest` within one standard error of it.
    """
    a = np.vstack([own - own.mean(axis=0) for own in columns])
    b = np.concatenate([y - y.mean() for y in ys])
    low = np.append(np.full(free, -np.inf), np.zeros(a.shape[1] - free))

    def solved(rows: FloatArray, y: FloatArray, ridge: float) -> FloatArray:
        size = np.sqrt(ridge * y.size * np.mean(a**2))
        system = np.vstack([rows, size * np.eye(a.shape[1])])
        return np.asarray(lsq_linear(system, np.append(y, np.zeros(a.shape[1])), (low, np.inf)).x)

    if len(ridges) == 1:
        return solved(a, b, ridges[0])
    fifth = np.arange(b.size) * 5 // b.size
    errors = np.array(
        [
            [np.var(a[fifth == k] @ solved(a[fifth != k], b[fifth != k], one) - b[fifth == k]) for k in range(5)]
            for one in ridges
        ]
    )
    chosen = int(np.argmin(errors.mean(axis=1)))
    if not largest:
        return solved(a, b, ridges[chosen])
    best = errors[chosen]
    as_good = errors.mean(axis=1) <= best.mean() + np.std(best, ddof=1) / np.sqrt(5.0)
    return solved(a, b, max(one for one, good in zip(ridges, as_good, strict=True) if good))


def linear(model: LinearModel, records: Sequence[Series], one: Series, history: History, search: bool) -> FloatArray:
    """Return the free run of the twin of a method that is linear in its weights, (N,)."""
    used = [np.flatnonzero(own.fitted & np.isfinite(own.y)) for own in records]
    thin = max(1, sum(map(len, used)) // ROWS)
    ys = [own.y[at][::thin] for own, at in zip(records, used, strict=True)]

    def fit(lags: tuple[float, float], ridges: Sequence[float]) -> tuple[FloatArray, list[FloatArray]]:
        columns = [
            columns_behind(model, own, own.history, lags)[at][::thin] for own, at in zip(records, used, strict=True)
        ]
        alone = isinstance(model.features, Plays | RatePlays)
        return weights_of(columns, ys, getattr(model.features, "free", 0), ridges, alone), columns

    lags = model.delay, model.lag
    if search:
        period = float(np.median(np.diff(records[0].t)))

        def cost(x: FloatArray) -> float:
            weights, columns = fit((abs(x[0]) * period, abs(x[1]) * period), (1e-6,))
            errors = [y - own @ weights for y, own in zip(ys, columns, strict=True)]
            return float(np.sqrt(np.mean(np.concatenate([error - error.mean() for error in errors]) ** 2)))

        found = minimize(cost, (1.0, 2.0), method="Nelder-Mead", options={"maxfev": 40})
        lags = abs(found.x[0]) * period, abs(found.x[1]) * period
    # Those of the method, but for Bouc-Wen and lines, whose few weights need none.
    many = isinstance(model.features, Plays | Creep | RatePlays | EnvelopePlays | Preisach)
    ridges = (1e-6, 1e-5, 1e-4, 1e-3, 1e-2) if many else (1e-6,)
    return columns_behind(model, one, history, lags) @ fit(lags, ridges)[0]


def modified(model: ModifiedModel, records: Sequence[Series], one: Series, history: History) -> FloatArray:
    """Return the free run, (N,), of play operators behind one-sided dead zones (Kuhnen 2003), fitted together."""
    base = model.base
    used = [np.flatnonzero(own.fitted & np.isfinite(own.y)) for own in records]
    thin = max(1, sum(map(len, used)) // ROWS)
    lags = base.delay, base.lag
    columns = [columns_behind(base, own, own.history, lags)[at][::thin] for own, at in zip(records, used, strict=True)]
    y = np.concatenate([own.y[at][::thin] for own, at in zip(records, used, strict=True)]) / base.scale.y_range
    number = np.concatenate([np.full(len(own), k) for k, own in enumerate(columns)])
    x, thresholds, plays = np.vstack(columns), np.linspace(-0.4, 0.4, 9), columns[0].shape[1]
    last, heavy = plays + 2 + thresholds.size, np.sqrt(model.penalty * y.size)

    def shaped(p: FloatArray, x: FloatArray) -> FloatArray:
        # The weights of the dead zones are the changes of the slopes, which stay positive.
        inner, slopes = x @ p[:plays] + p[plays], p[plays + 1 : last]
        zones = np.maximum(inner[:, None] - thresholds, 0.0)
        return np.asarray(slopes[0] * inner + zones @ np.diff(slopes))

    def residual(p: FloatArray) -> FloatArray:
        wide, bends = p[1:plays], np.diff(p[plays + 1 : last])
        return np.concatenate([shaped(p, x) + p[last:][number] - y, heavy * wide, heavy * bends])

    ys = [y[number == k] for k in range(len(columns))]
    ends = [float(np.mean(own)) for own in ys]
    start = np.concatenate([weights_of(columns, ys, 0, (1e-6,)) + 1e-6, [0.0], np.ones(thresholds.size + 1), ends])
    low = np.full(start.size, -np.inf)
    low[:plays], low[plays + 1 : last] = 0.0, 0.05
    p = least_squares(residual, start, bounds=(low, np.inf), max_nfev=60, x_scale="jac").x
    return base.scale.y_range * shaped(p, columns_behind(base, one, history, lags))


def grid_of(model: NarxModel | GruModel, one: Series, history: History) -> tuple[FloatArray, FloatArray]:
    """Return times (s) and scaled voltages at the step of the model, (M,)."""
    scaled = [float(x) for x in (np.array(history) - model.scale.v_middle) / model.scale.v_half]
    ready = prepare(one.t, (one.v - model.scale.v_middle) / model.scale.v_half, scaled)
    grid = ready.t[0] + model.step * np.arange(int(np.ceil((ready.t[-1] - ready.t[0]) / model.step)) + 1)
    return grid, np.interp(grid, ready.t, ready.u)


def narx(model: NarxModel, records: Sequence[Series], one: Series, history: History) -> FloatArray:
    """Return the free run, (N,), of the polynomial, whose gains are found anew."""

    def terms(y1: float, y2: float, u: float, before: float) -> FloatArray:
        values = np.array([y1, y2, u, before, u - before, np.sign(u - before)])
        return np.asarray(np.prod(values**model.powers, axis=1))

    rows, wanted = [], []
    for own in records:
        grid, u = grid_of(model, own, own.history)
        known = np.isfinite(own.y)
        y = (np.interp(grid, own.t[known], own.y[known]) - model.scale.y_mean) / model.scale.y_range
        inside = np.interp(grid, own.t, own.fitted.astype(np.float64), left=0.0) > 0.999
        for k in range(2, grid.size):
            if inside[k - 2 : k + 1].all():
                rows.append(terms(y[k - 1], y[k - 2], u[k], u[k - 1]))
                wanted.append(y[k])
    gains = np.linalg.lstsq(np.array(rows), np.array(wanted), rcond=None)[0]
    grid, u = grid_of(model, one, history)
    y1, y2, found = 0.0, 0.0, []
    for x, before in zip(u, np.append(u[0], u[:-1]), strict=True):
        y1, y2 = float(np.clip(terms(y1, y2, x, before) @ gains, -3.0, 3.0)), y1
        found.append(y1)
    return model.scale.y_range * np.interp(one.t, grid, found)


def gru(model: GruModel, one: Series, history: History) -> FloatArray:
    """Return the free run, (N,), by the equations of Cho et al. (2014)."""
    grid, u = grid_of(model, one, history)
    (wz, wr, wc), (rz, rr, rc), out = *model.weights[:2], model.weights[2]
    h, found = np.zeros(rz.shape[0]), []
    for x in np.column_stack([u, np.append(0.0, np.diff(u)) / model.speed, np.ones(u.size)]):
        z, r = (1.0 / (1.0 + np.exp(-(w @ x + q @ h))) for w, q in ((wz, rz), (wr, rr)))
        h = (1.0 - z) * h + z * np.tanh(wc @ x + rc @ (r * h))
        found.append(float(out[:-1] @ h + out[-1]))
    return model.scale.y_range * np.interp(one.t, grid, found)


def commanded(folder: Path, task: Task, span_record: str, tables: Path, kind: str, causes: bool) -> FloatArray:
    """Return model - measured, (N,), of a model made by commands, as ``slpi verify`` has it; unit of the table."""

    def run(*arguments: object) -> None:
        with redirect_stdout(StringIO()):
            if slpi([str(one) for one in arguments]):
                raise RuntimeError(f"slpi {arguments[0]} failed")

    names = list(dict.fromkeys(span.record for span in task.fitted))
    for name in {*names, span_record}:
        if not (folder / name).exists():
            run("import", tables / f"{name}.csv", "-o", folder / name)
    bags, model = [folder / name for name in names], folder / f"{kind}.json"
    span: list[object] = ["--axis", task.axis] if task.axis != "x" else []
    if len(task.fitted) == 1 and np.isfinite(task.fitted[0].stop):
        span += ["--start", task.fitted[0].start, "--stop", task.fitted[0].stop]
    run("identify", *bags, "-o", model, "--kind", kind, *span)
    if causes:
        run("diagnose", *bags, "--model", model, "-o", folder / "diagnosis", *span)
        model = folder / "diagnosis" / "extended_model.json"
    record = read_bag(folder / span_record)
    judged = verify(record, load_model(model), axes=[task.axis]).axes[task.axis].records[0]
    found = np.full(len(record), np.nan)
    found[np.searchsorted(record.t, judged.t)] = 1e6 * (judged.model - judged.measured)
    return found


def twin(folder: Path, task: Task, method: Method) -> list[tuple[str, str, float, float]]:
    """Return method, row, and the errors of the method and of its twin, % of range, of each judged part."""
    tables = Tables(folder)
    records, found = fitted_series(tables, task), []
    with warnings.catch_warnings(), tempfile.TemporaryDirectory(prefix="twins_") as place:
        warnings.simplefilter("ignore")
        model: Any = method.fit(records)
        for span in task.judged:
            one = tables.series(span.record, task.axis, [span])
            run, history, _ = free_run(model, one, records)
            judged: Mask = split(one, records)[1]
            match model:
                case ModifiedModel():
                    error = modified(model, records, one, history) - one.y
                case NarxModel():
                    error = narx(model, records, one, history) - one.y
                case GruEnsemble():
                    error = np.mean([gru(member, one, history) for member in model.members], axis=0) - one.y
                case LinearModel() if method.name != "PI":
                    error = linear(model, records, one, history, method.name == "PI, lag") - one.y
                case _:
                    kind = "pi" if method.name == "PI" else "slpi"
                    error = commanded(Path(place), task, span.record, folder, kind, method.name == "SLPI, causes")
            # The same samples: those that both judge.
            both = judged & np.isfinite(error)
            scale = 100.0 / float(np.ptp(one.y[judged]))
            ours, theirs = (scale * float(np.std(e[both])) if both.any() else np.nan for e in (run - one.y, error))
            found.append((method.name, f"{task.name}: {span}", ours, theirs))
    return found


def _twin(job: tuple[Path, Task, str]) -> list[tuple[str, str, float, float]]:
    folder, task, name = job
    return twin(folder, task, next(one for one in METHODS if one.name == name))


def main() -> int:
    """Print the table of methods beside their twins; the exit code is 1 where there are no records."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", nargs="+", metavar="TASK", default=list(TASKS), help="these tasks alone")
    parser.add_argument("--method", nargs="+", metavar="NAME", default=[one.name for one in METHODS])
    parser.add_argument("--processes", type=int, default=2)
    options = parser.parse_args()
    folder = data_folder()
    if folder is None:
        return 1
    chosen = [task for task in read_manifest().tasks if task.name in options.only]
    jobs = [(folder, task, one.name) for task in chosen for one in METHODS if one.name in options.method]
    print(f"{'method':<16}{'row':<46}{'bench':>9}{'twin':>9}{'ratio':>8}")
    with get_context("spawn").Pool(options.processes) as pool:
        for rows in pool.imap(_twin, jobs, chunksize=1):
            for name, row, ours, theirs in rows:
                mark = "" if abs(np.log(theirs / ours)) <= np.log1p(AGREES) else " !"
                print(f"{name:<16}{row:<46}{ours:9.3f}{theirs:9.3f}{theirs / ours:8.3f}{mark}", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
