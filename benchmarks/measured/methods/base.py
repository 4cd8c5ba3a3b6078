"""What every method is given and gives back, and what several of them share: scaling, histories, lag and delay."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from slpi_ros.identification.free_run import AS_WELL, AT_END, MIDDLE_LOOPS, ways_to

FloatArray = NDArray[np.float64]
Mask = NDArray[np.bool_]

# Most samples of all fitted records together that enter a least-squares problem, and that of a search.
MOST_ROWS, SEARCH_ROWS = 8000, 2500
# Lag and delay that are tried, in sampling periods.
LAGS = (0.0, *np.geomspace(0.5, 100.0, 10).tolist())
DELAYS = (0.0, *np.geomspace(0.25, 30.0, 8).tolist())
# A lag or delay is kept if it lowers the rms error of the fit by more than this share.
WORTHWHILE = 0.01
# Inverse by iteration: most steps, first share of the error, change (of half the range) at which it ends, largest error
# (of the range) of a solution, and how far voltages may go (times half the range).
ITERATIONS, FIRST_SHARE, CONVERGED, SOLVED, BEYOND = 80, 0.8, 1e-5, 0.005, 1.2


@dataclass(frozen=True)
class Series:
    """One record of one axis.

    Parameters
    ----------
    name : str
    t : ndarray, shape (N,), s
    v : ndarray, shape (N,), V
    y : ndarray, shape (N,), in the unit of the table; NaN where nothing was read
    fitted : ndarray of bool, shape (N,)
        The samples that may be fitted. Earlier voltages may be used, other displacements not.
    history : tuple of float, V
        Of a fitted record: the voltages before it that are likely, see `chosen_history`.
    """

    name: str
    t: FloatArray
    v: FloatArray
    y: FloatArray
    fitted: Mask
    history: tuple[float, ...] = ()


class Fitted(Protocol):
    """A fitted model."""

    def simulate(self, name: str, t: FloatArray, v: FloatArray, history: tuple[float, ...]) -> FloatArray:
        """Return the displacement, shape (N,), of a free run: from voltages alone.

        `history` are the voltages (V) between which the actuator had moved before the record, oldest first; empty: it
        had never moved. `name` is that of the record: a fitted one has a constant and an initial state of its own.
        """
        ...


@runtime_checkable
class Invertible(Protocol):
    """A fitted model that has an inverse."""

    def invert(self, name: str, t: FloatArray, y: FloatArray, history: tuple[float, ...]) -> FloatArray:
        """Return the voltage (V), shape (N,), that gives the displacement `y`, (N,); ValueError if none is found."""
        ...


class Method(Protocol):
    """A kind of model and the way in which it is fitted."""

    @property
    def name(self) -> str:
        """Name in the table."""
        ...

    def fit(self, records: Sequence[Series]) -> Fitted:
        """Fit the model to all records together."""
        ...


def voltage_range(records: Sequence[Series]) -> tuple[float, float]:
    """Return the lowest and the highest voltage, V."""
    return min(float(np.nanmin(one.v)) for one in records), max(float(np.nanmax(one.v)) for one in records)


def possible_histories(records: Sequence[Series], v: float) -> list[tuple[float, ...]]:
    """Return the histories before a record that begins at `v` (V) that are tried: those of ``slpi verify``.

    They come from the ends of the fitted range; never moved; and continued where the last fitted record ends.
    """
    return [*ways_to(*voltage_range(records), v), (), remembered(records[-1].v)]


def remembered(v: FloatArray) -> tuple[float, ...]:
    """Return the reversals that are remembered after voltages `v` (N,), oldest first, V; of many the largest."""
    v = v[np.isfinite(v)]
    turns: list[float] = []
    at, side = 0, 1.0 if np.argmax(v) <= np.argmin(v) else -1.0
    while at < v.size - 1 and len(turns) < 2 * MIDDLE_LOOPS:
        at = v.size - 1 - int(np.argmax(side * v[at:][::-1]))
        turns.append(float(v[at]))
        side = -side
    return tuple(turns)


def chosen_history(
    records: Sequence[Series], v: float, errors: Sequence[float], *, rested: bool = False
) -> tuple[float, ...]:
    """Return one of the possible histories of a record that begins at `v` (V), V.

    As in ``slpi verify`` a record that begins at an end of the fitted range comes from the other end (or had never
    moved, if the model `rested` there), unless another history has one of `errors`, (H,), that is smaller by a tenth;
    any other record has the history with the least error.
    """
    histories, (low, high) = possible_histories(records, v), voltage_range(records)
    near, best = AT_END * (high - low), int(np.argmin(errors))
    swept = 0 if v >= high - near else 1 if v <= low + near else best
    at_end = min([swept, histories.index(())] if rested else [swept], key=lambda one: errors[one])
    return histories[at_end if swept != best and errors[at_end] <= AS_WELL * errors[best] else best]


@dataclass(frozen=True)
class Scale:
    """Voltage to -1..1 of the fitted range, displacement to shares of the fitted range around its mean."""

    v_middle: float
    v_half: float
    y_mean: float
    y_range: float

    @classmethod
    def of(cls, records: Sequence[Series]) -> "Scale":
        """Return the scale of the fitted samples."""
        v = np.concatenate([one.v for one in records])
        y = np.concatenate([one.y[one.fitted] for one in records])
        low, high = float(np.nanmin(v)), float(np.nanmax(v))
        return cls((low + high) / 2.0, (high - low) / 2.0, float(np.nanmean(y)), float(np.nanmax(y) - np.nanmin(y)))

    def voltage(self, v: FloatArray) -> FloatArray:
        """Return V as shares."""
        return (v - self.v_middle) / self.v_half

    def volts(self, u: FloatArray) -> FloatArray:
        """Return shares as V."""
        return self.v_middle + self.v_half * u

    def displacement(self, y: FloatArray) -> FloatArray:
        """Return displacements as shares."""
        return (y - self.y_mean) / self.y_range

    def back(self, y: FloatArray) -> FloatArray:
        """Return shares as displacements."""
        return self.y_mean + self.y_range * y


def invert_by_iteration(
    model: Fitted, scale: Scale, name: str, t: FloatArray, y: FloatArray, history: tuple[float, ...]
) -> FloatArray:
    """Return the voltage (V), (N,), with which a free run gives `y`, (N,); ValueError if the steps do not converge.

    The voltage moves by a share of the error (Picard), which converges for operators whose slope stays positive; the
    share is halved where the error grows.
    """
    slope, share = scale.y_range / (2.0 * scale.v_half), FIRST_SHARE
    low, high = scale.volts(np.array([-BEYOND, BEYOND]))
    v = np.clip(scale.v_middle + (y - scale.y_mean) / slope, low, high)
    error = y - model.simulate(name, t, v, history)
    for _ in range(ITERATIONS):
        new = np.clip(v + share * error / slope, low, high)
        left = y - model.simulate(name, t, new, history)
        if float(np.std(left)) > float(np.std(error)):
            share /= 2.0
            continue
        change, v, error = float(np.std(new - v)), new, left
        if change < CONVERGED * scale.v_half:
            break
    if not float(np.std(error)) < SOLVED * scale.y_range:
        raise ValueError(
            f"the inverse does not converge: {100.0 * float(np.std(error)) / scale.y_range:.2g} % are left"
        )
    return v


@dataclass(frozen=True)
class Prepared:
    """A scaled record with a history in front of it.

    Parameters
    ----------
    t : ndarray, shape (M + N,), s
    u : ndarray, shape (M + N,)
        Scaled voltage; the first M samples are the history.
    skipped : int
        M.
    """

    t: FloatArray
    u: FloatArray
    skipped: int

    @property
    def period(self) -> float:
        """Sampling period, s."""
        return float(np.median(np.diff(self.t[self.skipped :])))


def prepare(t: FloatArray, u: FloatArray, history: Sequence[float]) -> Prepared:
    """Put a history, scaled voltages, in front of a record: straight lines with the record's own mean speed."""
    finite = np.isfinite(u)
    if not finite.all():
        u = np.interp(t, t[finite], u[finite])
    if not history:
        return Prepared(t, u, 0)
    period = float(np.median(np.diff(t)))
    moving = np.abs(np.diff(u))
    step = float(np.mean(moving[moving > 0.1 * moving.max()])) if moving.max() > 0.0 else 0.1
    corners = [*history, float(u[0])]
    legs = [
        np.linspace(a, b, max(2, min(5000, int(abs(b - a) / step) + 1)), endpoint=False)
        for a, b in zip(corners, corners[1:], strict=False)
    ]
    before = np.concatenate(legs)
    times = t[0] - period * np.arange(before.size, 0, -1)
    return Prepared(np.concatenate((times, t)), np.concatenate((before, u)), before.size)


def delayed(prepared: Prepared, delay: float, lag: float) -> FloatArray:
    """Return the scaled voltage behind a delay and a first-order lag (s), exact for a voltage that is held.

    Before the first sample the voltage had its first value.
    """
    t, u = prepared.t, prepared.u
    if delay > 0.0:
        u = np.interp(t - delay, t, u)
    if lag <= 0.0:
        return u
    steps = np.diff(t, prepend=t[0])
    return _lagged(u, -np.expm1(-steps / lag))


def advanced(t: FloatArray, v: FloatArray, delay: float, lag: float) -> FloatArray:
    """Return the voltage (N,) that is `v` behind a delay and a first-order lag, s; after the end `v` holds."""
    led = v + lag * np.gradient(v, t) if lag > 0.0 else v
    return np.interp(t + delay, t, led)


def _lagged(u: FloatArray, shares: FloatArray) -> FloatArray:
    from benchmarks.measured.methods.operators import lagged

    return lagged(u, shares)


def rows_of(records: Sequence[Series], most: int) -> list[NDArray[np.int64]]:
    """Return the indices of fitted samples, evenly spaced, at most `most` in all."""
    known = [np.flatnonzero(one.fitted & np.isfinite(one.y)) for one in records]
    share = max(1.0, sum(each.size for each in known) / most)
    counts = [int(np.ceil(each.size / share)) for each in known]
    # A product may be rounded up to the next index.
    return [
        each[np.minimum((share * np.arange(count)).astype(np.int64), each.size - 1)]
        for each, count in zip(known, counts, strict=True)
    ]


def search_lag(cost: Callable[[float, float], float], period: float) -> tuple[float, float]:
    """Return the delay and the lag (s) with the least cost: grids, then finer ones around their best.

    Parameters
    ----------
    cost : callable
        The rms error of the fit with a delay and a lag, s.
    period : float, s
        Sampling period.
    """
    bare = cost(0.0, 0.0)
    lag, least = _finest(lambda x: cost(0.0, x), [period * x for x in LAGS])
    delay, both = _finest(lambda x: cost(x, lag), [period * x for x in DELAYS])
    only_delay, alone = _finest(lambda x: cost(x, 0.0), [period * x for x in DELAYS])
    if both < (1.0 - WORTHWHILE) * min(least, alone):
        lag, both = _finest(lambda x: cost(delay, x), [lag * x for x in (0.3, 0.5, 0.7, 0.85, 1.0, 1.2)])
        return delay, lag
    if min(least, alone) < (1.0 - WORTHWHILE) * bare:
        return (0.0, lag) if least <= alone else (only_delay, 0.0)
    return 0.0, 0.0


def _finest(cost: Callable[[float], float], values: Sequence[float]) -> tuple[float, float]:
    found = {x: cost(x) for x in values}
    for _ in range(2):
        ordered = sorted(found)
        best = min(found, key=lambda x: found[x])
        at = ordered.index(best)
        beside = [ordered[max(at - 1, 0)], ordered[min(at + 1, len(ordered) - 1)]]
        found |= {(best + other) / 2.0: cost((best + other) / 2.0) for other in beside if other != best}
    best = min(found, key=lambda x: found[x])
    return best, found[best]
