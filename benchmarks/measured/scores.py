"""Errors of a method on the judged parts of records, with intervals from a bootstrap over blocks."""

import time
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.signal import savgol_filter

from benchmarks.measured.manifest import Span, Task
from benchmarks.measured.methods import (
    Fitted,
    Invertible,
    Method,
    Series,
    chosen_history,
    likely_history,
    possible_histories,
)
from benchmarks.measured.methods.operators import plays
from slpi_ros.errors import SlpiError
from slpi_ros.hysteresis.reversals import reversals
from slpi_ros.io.record import Record
from slpi_ros.io.tables import import_table

FloatArray = NDArray[np.float64]
Mask = NDArray[np.bool_]

# A record that was not fitted: its beginning, until the voltage has gone this share of its way, chooses the history and
# is not judged. A hold says nothing of the history, nor do moves within this share of the range, noise for example.
WARM_UP, STANDS = 0.1, 0.005
# A measured displacement is smoothed before it is inverted, by polynomials of degree 2 over this share of a move from
# turn to turn, at least so many samples. Turns of less than a share of the range do not count.
SMOOTHED, FEWEST, SMALLEST = 0.05, 5, 0.02
# Blocks of a judged part, draws, and the interval, %: neighbouring errors are alike, blocks nearly independent.
BLOCKS, DRAWS, INTERVAL = 20, 4000, (2.5, 97.5)


@dataclass(frozen=True)
class Score:
    """Errors of one method on one judged part, % of its range.

    Parameters
    ----------
    rms : float
        Free-run error without its mean.
    low, high : float
        95 % interval of `rms`.
    blocks : tuple of float
        Mean squares of the error without its mean in `BLOCKS` equal parts of what is judged, %^2.
    absolute : float
        Rms error with its mean.
    fit_seconds, sample_microseconds : float
        Processor time of the fit, and of a free run for each sample.
    fitted : float
        Free-run error on the records of the fit, each without its mean, % of its range.
    inverse : float, optional
        Rms error of the voltage that the inverse gives for the measured displacement, smoothed and without the mean
        error of the free run, % of the range of the voltage. None without an inverse.
    said : str
        What the method says of the fit.
    """

    rms: float
    low: float
    high: float
    blocks: tuple[float, ...]
    absolute: float
    fit_seconds: float
    sample_microseconds: float
    fitted: float
    inverse: float | None = None
    said: str = ""


class Tables:
    """The tables of a folder, each read once."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._records: dict[str, Record] = {}

    def series(self, name: str, axis: str, spans: Sequence[Span]) -> Series:
        """Return a record of one axis, of which the parts `spans` count."""
        if name not in self._records:
            self._records[name] = import_table(self._folder / f"{name}.csv")
        record = self._records[name]
        counted = np.zeros(len(record), dtype=np.bool_)
        for span in spans:
            if span.record == name:
                counted |= (record.t >= span.start) & (record.t < span.stop)
        return Series(name, record.t, record.voltage[axis], 1e6 * record.displacement[axis], counted)


def fitted_series(tables: Tables, task: Task) -> list[Series]:
    """Return the records that are fitted in a task. What is judged is taken out of them."""
    names = list(dict.fromkeys(span.record for span in task.fitted))
    found = []
    for name in names:
        one = tables.series(name, task.axis, task.fitted)
        # A method that looks beyond its part shall find nothing there.
        found.append(Series(name, one.t, one.v, np.where(one.fitted, one.y, np.nan), one.fitted))
    return [replace(one, history=likely_history(found, one)) for one in found]


def mean_squares(error: FloatArray) -> tuple[float, ...]:
    """Return the mean squares of equal parts of errors (N,)."""
    return tuple(float(np.mean(block**2)) for block in np.array_split(error, BLOCKS))


def interval(blocks: Sequence[float], others: Sequence[float] | None = None) -> tuple[float, float]:
    """Return the 95 % interval of an rms error, or of its ratio to another one, by a bootstrap over blocks.

    Errors of two methods on the same samples are alike: blocks are drawn for both together (Kuensch 1989).
    """
    drawn = np.random.default_rng(0).integers(BLOCKS, size=(DRAWS, BLOCKS))
    squares = np.asarray(blocks)[drawn].sum(axis=1) / (
        BLOCKS if others is None else np.asarray(others)[drawn].sum(axis=1)
    )
    low, high = np.percentile(np.sqrt(squares), INTERVAL)
    return float(low), float(high)


def score(tables: Tables, task: Task, method: Method) -> dict[str, Score | str]:
    """Fit a method, and return its errors on each judged part by name; the reason where it refuses.

    The state at the start of a record is unknown to every method. It is chosen as in ``slpi verify``, see
    `chosen_history`, but by samples that are not judged: the fitted part of the same record, or the beginning of
    another one.
    """
    records = fitted_series(tables, task)
    began = time.process_time()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            model = method.fit(records)
    except (SlpiError, ValueError, np.linalg.LinAlgError) as error:
        return {str(span): f"{type(error).__name__}: {error}" for span in task.judged}
    took = time.process_time() - began
    fitted = _fitted(model, records)
    return {str(span): _judged(model, tables, task, span, records, took, fitted) for span in task.judged}


def _fitted(model: Fitted, records: Sequence[Series]) -> float:
    """Return the error on the fitted samples, %."""
    errors = []
    for one in records:
        y = one.y[one.fitted]
        error = (free_run(model, one, records)[0][one.fitted] - y)[np.isfinite(y)]
        errors.append((error - np.mean(error)) / float(np.nanmax(y) - np.nanmin(y)))
    return 100.0 * float(np.std(np.concatenate(errors)))


def _judged(
    model: Fitted, tables: Tables, task: Task, span: Span, records: Sequence[Series], took: float, fitted: float
) -> Score | str:
    one = tables.series(span.record, task.axis, [span])
    try:
        run, history, seconds = free_run(model, one, records)
    except SlpiError as refusal:
        return f"{type(refusal).__name__}: {refusal}"
    judged = split(one, records)[1]
    error = (run - one.y)[judged]
    share = 100.0 / float(np.ptp(one.y[judged]))
    mean = float(np.mean(error))
    blocks = mean_squares(share * (error - mean))
    low, high = interval(blocks)
    return Score(
        rms=share * float(np.std(error)),
        low=low,
        high=high,
        blocks=blocks,
        absolute=share * float(np.sqrt(np.mean(error**2))),
        fit_seconds=took,
        sample_microseconds=1e6 * seconds / one.t.size,
        fitted=fitted,
        inverse=_inverse(model, replace(one, y=one.y + mean), judged, history),
        said=str(getattr(model, "said", "")),
    )


def free_run(model: Fitted, one: Series, records: Sequence[Series]) -> tuple[FloatArray, tuple[float, ...], float]:
    """Return the free run of a judged record (N,), its history, V, and the least processor time of one, s."""
    chooses, _ = split(one, records)
    runs, seconds = {}, []
    v = float(one.v[np.isfinite(one.v)][0])
    for history in possible_histories(records, v):
        began = time.process_time()
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            runs[history] = model.simulate(one.name, one.t, one.v, history)
        seconds.append(time.process_time() - began)
    errors = [float(np.std((runs[history] - one.y)[chooses])) for history in possible_histories(records, v)]
    rested = getattr(model, "rested", not records[0].history)
    chosen = chosen_history(records, v, errors, rested=rested and bool(np.isclose(v, records[0].v[0])))
    return runs[chosen], chosen, min(seconds)


def split(one: Series, records: Sequence[Series]) -> tuple[Mask, Mask]:
    """Return the samples of a judged record that choose its history, and those that are judged."""
    judged = one.fitted & np.isfinite(one.y)
    for record in records:
        if record.name == one.name:
            return record.fitted & np.isfinite(record.y), judged
    known = np.isfinite(one.v)
    v = np.interp(one.t, one.t[known], one.v[known])
    moved = plays(v, np.array([STANDS * float(np.ptp(v))]), np.arange(v.size))[:, 0]
    way = np.cumsum(np.where(judged, np.abs(np.diff(moved, prepend=moved[0])), 0.0))
    begins = way <= WARM_UP * way[-1]
    return judged & begins, judged & ~begins


def _window(one: Series) -> int:
    """Return the odd number of samples over which a displacement is smoothed."""
    v = one.v[np.isfinite(one.v)]
    moves = np.diff(reversals(v, SMALLEST * float(np.ptp(v))))
    return max(FEWEST, 2 * int(SMOOTHED * float(np.median(moves)) / 2.0) + 1)


def _inverse(model: Fitted, one: Series, judged: Mask, history: tuple[float, ...]) -> float | None:
    """Return the error of the inverse, % of the range of the voltage; None if there is none."""
    if not isinstance(model, Invertible):
        return None
    known = np.isfinite(one.y)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            # Noise would make reversals that nobody desires.
            y = savgol_filter(np.interp(one.t, one.t[known], one.y[known]), _window(one), 2)
            v = model.invert(one.name, one.t, y, history)
    except (SlpiError, ValueError):
        return None
    return 100.0 * float(np.sqrt(np.mean((v - one.v)[judged] ** 2)) / np.ptp(one.v[judged]))
