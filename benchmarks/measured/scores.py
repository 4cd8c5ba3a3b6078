"""Errors of a method on the judged parts of records, with intervals from a bootstrap over blocks."""

import time
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.measured.manifest import Span, Task
from benchmarks.measured.methods import Fitted, Method, Series, possible_histories
from slpi_ros.errors import SlpiError
from slpi_ros.io.record import Record
from slpi_ros.io.tables import import_table

FloatArray = NDArray[np.float64]

# Blocks of a judged part, draws, and the interval, %: neighbouring errors are alike, blocks nearly independent.
BLOCKS, DRAWS, INTERVAL = 20, 1000, (2.5, 97.5)


@dataclass(frozen=True)
class Score:
    """Errors of one method on one judged part, % of its range.

    Parameters
    ----------
    rms : float
        Free-run error without its mean.
    low, high : float
        95 % interval of `rms`.
    absolute : float
        Rms error with its mean.
    fit_seconds, sample_microseconds : float
        Time of the fit, and of a free run for each sample.
    said : str
        What the method says of the fit.
    """

    rms: float
    low: float
    high: float
    absolute: float
    fit_seconds: float
    sample_microseconds: float
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
    return found


def interval(error: FloatArray, seed: int = 0) -> tuple[float, float]:
    """Return the 95 % interval of the rms of errors (N,) by a bootstrap over blocks (Kuensch 1989)."""
    blocks = np.array_split(error, BLOCKS)
    squares = np.array([float(np.sum(block**2)) for block in blocks])
    sizes = np.array([block.size for block in blocks], dtype=np.float64)
    drawn = np.random.default_rng(seed).integers(BLOCKS, size=(DRAWS, BLOCKS))
    rms = np.sqrt(squares[drawn].sum(axis=1) / sizes[drawn].sum(axis=1))
    low, high = np.percentile(rms, INTERVAL)
    return float(low), float(high)


def score(tables: Tables, task: Task, method: Method) -> dict[str, Score | str]:
    """Fit a method, and return its errors on each judged part by name; the reason where it refuses.

    The state at the start of a record is unknown to every method: each has the best of the same three histories.
    """
    records = fitted_series(tables, task)
    began = time.perf_counter()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            model = method.fit(records)
    except (SlpiError, ValueError, np.linalg.LinAlgError) as error:
        return {str(span): f"{type(error).__name__}: {error}" for span in task.judged}
    took = time.perf_counter() - began
    return {str(span): _judged(model, tables, task, span, records, took) for span in task.judged}


def _judged(
    model: Fitted, tables: Tables, task: Task, span: Span, records: Sequence[Series], took: float
) -> Score | str:
    one = tables.series(span.record, task.axis, [span])
    counted = one.fitted & np.isfinite(one.y)
    errors, seconds = [], []
    for history in possible_histories(records):
        began = time.perf_counter()
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                run = model.simulate(one.name, one.t, one.v, history)
        except SlpiError as error:
            return f"{type(error).__name__}: {error}"
        seconds.append(time.perf_counter() - began)
        errors.append(run[counted] - one.y[counted])
    best = min(errors, key=lambda error: float(np.std(error)))
    share = 100.0 / float(np.ptp(one.y[counted]))
    centred = share * (best - np.mean(best))
    low, high = interval(centred)
    return Score(
        rms=float(np.sqrt(np.mean(centred**2))),
        low=low,
        high=high,
        absolute=share * float(np.sqrt(np.mean(best**2))),
        fit_seconds=took,
        sample_microseconds=1e6 * min(seconds) / one.t.size,
        said=str(getattr(model, "said", "")),
    )
