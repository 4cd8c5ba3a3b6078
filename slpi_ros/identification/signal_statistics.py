"""Statistics of sensor readings: noise, resolution, repeated values, outliers and the repeatability floor.

All tests take the voltage into account: a displacement may rest or reverse where the voltage does.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import maximum_filter1d, median_filter, uniform_filter1d
from scipy.special import ndtri

from slpi_ros.errors import RecordError, UsageError
from slpi_ros.hysteresis.reversals import reversals, without_small_reversals
from slpi_ros.identification.drive import hold_band, resting, smallest_turn


@dataclass(frozen=True)
class ErrorMetrics:
    """Error metrics of a model against a measurement, or of a measurement against a setpoint.

    The MPI paper's "mean square error" is `root_mean_square` in all places: Tables 2 and 4, 0.1201 µm (feedforward) and
    0.2949 µm (feedforward and PID). Its unit is µm, and it exceeds the mean absolute error as a root must. A mean
    square cannot exceed the product of maximum and mean absolute error; Table 2 from 20 to 100 V, Table 4 at 20 and
    40 V and the 0.1201 do. Of the others, R² of 0.9996 at 120 V (Table 3) goes with the root only.

    Parameters
    ----------
    maximum : float, metres
        Maximum absolute error.
    mean : float, metres
        Mean absolute error.
    root_mean_square : float, metres
        What the paper calls mean square error.
    mean_square : float, square metres
        Mean square error proper.
    r_squared : float
        ``R² = 1 - SSE / SST``, MPI paper, Eq. 3.
    """

    maximum: float
    mean: float
    root_mean_square: float
    mean_square: float
    r_squared: float


def error_metrics(measured: ArrayLike, model: ArrayLike) -> ErrorMetrics:
    """Compute the error metrics of a model against a measurement, or of a measurement against a setpoint.

    Parameters
    ----------
    measured : array_like, shape (N,), metres
        The reference; R² is relative to its variation.
    model : array_like, shape (N,), metres
        Values to compare with the reference.

    Raises
    ------
    UsageError
        If the two are not equally long, not finite, or `measured` does not vary.
    """
    y, y_model = np.asarray(measured, dtype=np.float64), np.asarray(model, dtype=np.float64)
    if y.ndim != 1 or y.shape != y_model.shape or y.size == 0:
        raise UsageError(f"error metrics: {y.shape} measured and {y_model.shape} modelled values; give as many of each")
    if not (np.isfinite(y).all() and np.isfinite(y_model).all()):
        raise UsageError("error metrics: values that are not finite; leave such samples out")
    total = np.sum((y - y.mean()) ** 2)
    if not total > 0.0:
        raise UsageError(f"error metrics: all measured values are {y[0]:g} m; R² needs some variation")
    error = np.abs(y - y_model)
    mean_square = float(np.mean(error**2))
    return ErrorMetrics(
        maximum=float(error.max()),
        mean=float(error.mean()),
        root_mean_square=float(np.sqrt(mean_square)),
        mean_square=mean_square,
        r_squared=float(1.0 - np.sum(error**2) / total),
    )


FloatArray = NDArray[np.float64]
Mask = NDArray[np.bool_]

# Expected number of false alarms of each test on a clean record.
FALSE_ALARMS = 0.01
# Least gain of a piezo after a reversal, as a share of the mean gain.
LEAST_GAIN = 0.2
# Number of readings from which noise and resolution are estimated.
_ENOUGH = 100_000
# Block size, in readings, for long records.
_BLOCK = 1_000_000
# Number of preceding readings with which a reading is compared.
_EARLIER = 3
# Largest delay of a displacement reversal, and duration of ringing after a jump, in samples.
_TURN_REACH, _RINGING = 5, 200


def digit(x: FloatArray) -> float:
    """Return the resolution of readings `x`, shape (N,), in their unit; 0 if they are continuous.

    The largest step of which (nearly) all small differences between sorted readings are multiples.
    """
    differences = np.diff(np.unique(x[:: max(1, x.size // _ENOUGH)]))
    if differences.size < 5:
        return 0.0
    for step in np.unique(np.quantile(differences, (0.02, 0.1, 0.25, 0.5, 0.75)))[::-1].tolist():
        multiples = differences[differences < 30.0 * step] / step
        whole = np.rint(multiples)
        if multiples.size > 0.5 * differences.size and np.mean(np.abs(multiples - whole) < 0.05) > 0.97:
            return float(step * multiples[whole > 0].sum() / whole.sum())
    return 0.0


def spread(x: FloatArray) -> float:
    """Return the range of readings `x`, shape (N,), between the 1st and 99th percentile."""
    low, high = np.percentile(x[:: max(1, x.size // _ENOUGH)], (1, 99))
    return float(high - low) or float(np.ptp(x))


def noise(x: FloatArray, *drivers: FloatArray) -> float:
    """Return the robust rms of the noise from reading to reading.

    The least of several estimates: deviations from a line or a cubic through the neighbours, and from a line in a
    driver, which is insensitive to an uneven rate. The curvature of the signal increases each estimate; medians reduce
    this effect. Noise correlated over several samples is not detected.

    Parameters
    ----------
    x : ndarray, shape (N,), N >= 5
        Readings.
    *drivers : ndarray, shape (N,)
        Signals that the readings follow: time, or a voltage.
    """
    every = max(1, x.size // _ENOUGH)
    far_before, before, own, after, far_after = (x[first : x.size - 4 + first : every] for first in range(5))
    line = 0.5 * (before + after) - own
    curve = (4.0 * (before + after) - (far_before + far_after)) / 6.0 - own
    estimates = [_rms(line) / np.sqrt(1.5), _rms(curve) / np.sqrt(35.0 / 18.0)]
    for driver in drivers:
        start, middle, end = (driver[first : x.size - 4 + first : every] for first in (1, 2, 3))
        with np.errstate(divide="ignore", invalid="ignore"):
            w = (end - middle) / (end - start)
        between = (w > 0.0) & (w < 1.0)
        if np.count_nonzero(between) > 0.2 * own.size:
            w = w[between]
            off = w * before[between] + (1.0 - w) * after[between] - own[between]
            estimates.append(_rms(off / np.sqrt(1.0 + w**2 + (1.0 - w) ** 2)))
    return float(min(estimates))


def _rms(deviation: FloatArray) -> float:
    """Return the standard deviation, outliers apart; 0 where most do not deviate at all."""
    return float(1.4826 * np.median(np.abs(deviation)))


@dataclass(frozen=True)
class Repeats:
    """Runs of equal consecutive readings.

    Parameters
    ----------
    first : ndarray of int, shape (M,)
        First reading of each run.
    length : ndarray of int, shape (M,)
        Number of readings in each run, at least 2.
    """

    first: NDArray[np.int64]
    length: NDArray[np.int64]

    @classmethod
    def within(cls, x: FloatArray) -> "Repeats":
        """Find all runs in `x`, shape (N,)."""
        bounds = np.concatenate([[0], np.flatnonzero(x[1:] != x[:-1]) + 1, [x.size]])
        length = np.diff(bounds)
        several = length > 1
        return cls(bounds[:-1][several], length[several])

    def spans(self, x: FloatArray) -> FloatArray:
        """Return the range of `x`, shape (N,), during each run, shape (M,)."""
        if not self.first.size:
            return np.empty(0)
        # Every second range of reduceat is one of ours, and what lies between is left out.
        bounds = np.column_stack([self.first, self.first + self.length]).ravel()
        padded = np.append(x, x[-1])
        high, low = (extreme.reduceat(padded, bounds)[::2] for extreme in (np.maximum, np.minimum))
        return np.asarray(high - low)

    def where(self, chosen: Mask) -> "Repeats":
        """Return the runs that are `chosen`, a mask of shape (M,)."""
        return Repeats(self.first[chosen], self.length[chosen])

    @property
    def readings(self) -> int:
        """Number of readings that repeat the preceding one."""
        return int(np.sum(self.length - 1))


def frozen(y: FloatArray, v: FloatArray, gain: float, noise_rms: float, step: float) -> Repeats:
    """Return the repeats of a displacement that are not due to chance.

    Either the voltage moved so that the displacement had to follow, or equal readings are improbable given the noise.

    Parameters
    ----------
    y, v : ndarray, shape (N,), metres and volts
        Displacement and voltage.
    gain : float, metres per volt
        Mean gain of the stage.
    noise_rms, step : float, metres
        Noise and resolution of the displacement.
    """
    repeats = Repeats.within(y)
    moved = repeats.spans(v)
    due = LEAST_GAIN * gain * moved > 3.0 * step + 6.0 * noise_rms
    # Two readings of Gaussian noise have the same digits with probability step / (2 sqrt(pi) noise).
    with np.errstate(divide="ignore"):
        alike = np.minimum(np.log(step) - np.log(2.0 * np.sqrt(np.pi) * noise_rms), 0.0) if noise_rms else 0.0
    improbable = (repeats.length - 1) * alike < np.log(FALSE_ALARMS / y.size)
    return repeats.where(due | (improbable & (moved > 0.0)))


def stuck(y: FloatArray, v: FloatArray) -> NDArray[np.int64]:
    """Return repeated readings, in runs of three or more, of a displacement `y` (m) with noise above its resolution.

    If the noise is below the resolution, repeats are expected and none is returned. `v` (V) is the voltage.
    """
    repeats = Repeats.within(y)
    if not np.any(repeats.length > 2):
        return np.empty(0, np.int64)
    noise_rms, step = noise(y, v), digit(y)
    if noise_rms <= step:
        return np.empty(0, np.int64)
    repeats = frozen(y, v, spread(y) / spread(v), noise_rms, step)
    repeats = repeats.where(repeats.length > 2)
    again = [np.arange(first + 1, first + length) for first, length in zip(repeats.first, repeats.length, strict=True)]
    return np.concatenate([np.empty(0, np.int64), *again])


def stopped(v: FloatArray, y: FloatArray, gain: float, noise_rms: float) -> Repeats:
    """Return the repeats of a voltage during which the displacement moves and after which the voltage jumps.

    Parameters as for `frozen`. A hold after a voltage jump is excluded: there the displacement still follows the jump.
    """
    repeats = Repeats.within(v)
    moved = repeats.spans(y) / gain
    last = repeats.first + repeats.length - 1
    before = np.abs(v[repeats.first] - v[np.maximum(repeats.first - _TURN_REACH, 0)])
    after = np.abs(v[np.minimum(last + 1, v.size - 1)] - v[last])
    least = 0.02 * np.ptp(v) + 6.0 * noise_rms / gain
    return repeats.where((moved > least) & (before < 0.5 * moved) & (after > 0.5 * moved))


def lone_outliers(y: FloatArray, v: FloatArray, gain: float, noise_y: float, noise_v: float) -> NDArray[np.int64]:
    """Return the readings that deviate from a line through their four neighbours where the voltage does not.

    Parameters
    ----------
    y, v : ndarray, shape (N,), metres and volts
        Displacement and voltage.
    gain : float, metres per volt
    noise_y, noise_v : float, metres and volts
        Their noise.

    Returns
    -------
    ndarray of int, shape (M,)
    """
    if not noise_y:
        return np.empty(0, np.int64)
    limit = -float(ndtri(0.5 * FALSE_ALARMS / y.size)) * np.sqrt(1.25) * noise_y
    every = max(1, v.size // _ENOUGH)
    jump = 5.0 * np.quantile(np.abs(v[every::every] - v[every - 1 : -1 : every]), 0.9) + 8.0 * noise_v
    found = [np.empty(0, np.int64)]
    for start in range(0, y.size, _BLOCK):
        # A block sees enough of those beside it.
        first, end = max(start - _RINGING, 0), start + _BLOCK + _RINGING
        here = _outliers_of_block(y[first:end], v[first:end], gain, noise_y, limit, jump) + first
        found.append(here[(here >= start) & (here < start + _BLOCK)])
    return np.concatenate(found)


def _outliers_of_block(
    y: FloatArray, v: FloatArray, gain: float, noise_y: float, limit: float, jump: float
) -> NDArray[np.int64]:
    if y.size < 5:
        return np.empty(0, np.int64)
    off, turns = _off_neighbours(y), np.abs(_off_neighbours(v))
    explained = 2.0 * gain * maximum_filter1d(turns, 2 * _TURN_REACH + 1)
    found = np.flatnonzero((np.abs(off) > limit + explained) & ~_after_jumps(v, jump)[2:-2])
    # Kinks and ringing bend the line of the neighbours too.
    before, after = y[found + 1] - y[found], y[found + 4] - y[found + 3]
    across = y[found + 3] - y[found + 1]
    size = np.abs(off[found])
    straight = np.abs(before - after) < np.maximum(8.0 * noise_y, 0.5 * size)
    straight &= np.abs(across - before - after) < np.maximum(12.0 * noise_y, 0.5 * size)
    return np.asarray(found[straight] + 2)


def _after_jumps(v: FloatArray, jump: float) -> Mask:
    """Return the mask, shape (N,), of samples within `_RINGING` samples after a voltage jump above `jump` (V)."""
    jumps = np.flatnonzero(np.abs(np.diff(v, prepend=v[0])) > jump)
    last = np.zeros(v.size, np.int64)
    last[jumps] = jumps + _RINGING
    return np.asarray(np.arange(v.size) < np.maximum.accumulate(last))


def _off_neighbours(x: FloatArray) -> FloatArray:
    return np.asarray(x[2:-2] - 0.25 * (x[:-4] + x[1:-3] + x[3:-1] + x[4:]))


def stale(y: FloatArray, outliers: NDArray[np.int64], noise_rms: float) -> NDArray[np.int64]:
    """Return the outliers that repeat one of the preceding readings within the noise.

    If outliers match later readings about as often, the matches are due to chance and none is returned.
    """
    near = 3.0 * np.sqrt(2.0) * noise_rms
    reach = np.arange(1, _EARLIER + 1)
    earlier, later = (
        (np.abs(y[outliers][:, None] - y[np.clip(outliers[:, None] + way * reach, 0, y.size - 1)]) < near).any(axis=1)
        for way in (-1, 1)
    )
    by_chance = np.count_nonzero(earlier) < 2 * np.count_nonzero(later)
    return outliers[:0] if by_chance else outliers[earlier]


# A reading is compared with so many on either side.
_BESIDE = 3
# Readings are found to be mixed with the next or the one before where more than this share of them lie off by more than
# half of the way to it, so many times as many as on the other side; judged by those whose way noise leaves to be seen.
_MIXED_SHARE, _MIXED_TIMES, _MIXED_NOISE = 0.02, 5.0, 0.12
# One of them lies off by this share of that way at least, by a line through others and by a model, and by so many
# robust standard deviations.
_MIXED_BY_LINE, _MIXED_BY_MODEL, _MIXED_DEVIATIONS = 0.2, 0.05, 4.0
# Hardly any lies farther off than the next reading.
_MIXED_MOST = 1.3


class Mixed(NamedTuple):
    """Readings of a displacement that are early, late or a mixture of two neighbouring values.

    Parameters
    ----------
    readings : ndarray of int, shape (M,)
        Those readings.
    judged : int
        Number of readings among which they were found; those beside a turn are not.
    side : int
        1 where they are mixed with the next one, -1 with the one before, 0 where there are none but by chance.
    """

    readings: NDArray[np.int64]
    judged: int
    side: int


def mixed_readings(y: FloatArray, v: FloatArray) -> Mixed:
    """Find the readings of a displacement that are early, late or a mixture of two neighbouring values.

    Such a reading lies between its true value and that of a neighbour, as from a link that delivers an old value or
    parts of two. All deviate to the same side, unlike noise and outliers.

    Parameters
    ----------
    y, v : ndarray, shape (N,), metres and volts
        Displacement and voltage.
    """
    off, way = _beside_lines(y[:_ENOUGH], v[:_ENOUGH])
    clear = np.abs(way) * _MIXED_NOISE > _rms(off[way != 0.0]) if way.any() else way != 0.0
    count = int(np.count_nonzero(clear))
    ways = off[clear] / way[clear]
    early, late, far = (np.count_nonzero(at) for at in (ways > 0.5, ways < -0.5, np.abs(ways) > _MIXED_MOST))
    many, few = max(early, late), min(early, late)
    if count < FEWEST or many < max(_MIXED_SHARE * count, _MIXED_TIMES * few) or far > 0.1 * many:
        return Mixed(np.empty(0, np.int64), count, 0)
    side = 1 if early > late else -1
    found, judged = [], 0
    for start in range(0, y.size, _ENOUGH):
        first = max(start - _RINGING, 0)
        here = slice(first, start + _ENOUGH + _RINGING)
        off, way = (x[start - first :][:_ENOUGH] for x in _beside_lines(y[here], v[here]))
        found.append(start + _mixed(side * off, way, _MIXED_BY_LINE))
        judged += int(np.count_nonzero(way))
    return Mixed(np.concatenate(found), judged, side)


def mixed_beside(path: FloatArray, y: FloatArray, fitted: Mask, side: int) -> NDArray[np.int64]:
    """Return the `fitted` readings, of a displacement with mixed ones, that are mixed by a model; those at turns too.

    Parameters
    ----------
    path, y : ndarray, shape (N,), metres
        Displacement by the model, and as it was read.
    fitted : ndarray of bool, shape (N,)
    side : int
        As in `Mixed`.
    """
    at = np.flatnonzero(fitted)
    off = (y - path)[at]
    # What the model gets wrong is alike in neighbouring readings.
    off = off - median_filter(off, 4 * _BESIDE + 3)
    way = np.diff(path, append=path[-1]) if side > 0 else np.diff(path, prepend=path[0])
    return at[_mixed(side * off, way[at], _MIXED_BY_MODEL)]


def _mixed(off: FloatArray, way: FloatArray, least: float) -> NDArray[np.int64]:
    """Return which readings, `off` by so much (m) and a share of their way to the next one, `way` (m), are mixed."""
    known, ahead = way != 0.0, np.sign(way) * off
    noise_off = _MIXED_DEVIATIONS * _rms(off[known]) if known.any() else 0.0
    found = ahead > np.maximum(least * np.abs(way), noise_off)
    # What lies beyond the next reading is something else.
    return np.flatnonzero(known & found & (ahead < _MIXED_MOST * np.abs(way) + noise_off))


def _beside_lines(y: FloatArray, v: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return how far each reading, shape (N,), metres, lies from a line through others, and the way between two.

    Both are 0 for readings that are not in the middle of a move.
    """
    width = 2 * _BESIDE + 1
    off, way = np.zeros(y.size), np.zeros(y.size)
    if y.size < 2 * width:
        return off, way
    y_beside, v_beside = sliding_window_view(y, width), sliding_window_view(v, width)
    steps = np.diff(v_beside, axis=1)
    one_way = (steps > 0.0).all(axis=1) | (steps < 0.0).all(axis=1)
    at = np.flatnonzero(one_way)
    y_beside, steps = y_beside[at], steps[at]
    gain = np.median(np.diff(y_beside, axis=1) / steps, axis=1)
    line = np.median(y_beside - gain[:, None] * (v_beside[at] - v[at + _BESIDE][:, None]), axis=1)
    off[at + _BESIDE] = y[at + _BESIDE] - line
    way[at + _BESIDE] = gain * np.median(steps, axis=1)
    known = way != 0.0
    # A branch bends, so that all readings of a part of it lie beside the line: as many steps, whichever way it goes.
    steps_off = np.divide(off, way, out=np.zeros_like(off), where=known)
    off[known] -= (median_filter(steps_off, 2 * width + 1) * way)[known]
    return np.where(known, off, 0.0), way


_FEWEST_READINGS = 5
# Fewer differences than this do not tell their rms to 10 %.
FEWEST = 100
# Enough moves and holds of a long record, taken evenly from all of it, and how far back a move is looked for.
_ENOUGH_PIECES, _LOOK_BACK = 1000, 1000
# Turns this close to each other (share of the voltage range) are the same; so are voltages along a move, in rms.
_SAME_TURN, _SAME_VOLTAGE = 0.005, 0.003
_FEWEST_OF_MOVE, _FEWEST_OF_HOLD = 10, 20
# A longer hold is cut, so that what is slow in it is nearly a parabola.
_LONGEST_PIECE = 2.0
# What lies farther out, in standard deviations, is an outlier; the rms of a Gaussian cut off there; how often to cut.
_OUTLIER, _CUT_GAUSSIAN, _CUTS = 2.5, 0.95460, 5
_ROBUST_FITS = 3


# Smaller than this share of the range it is the rounding of numbers.
NO_NOISE = 1e-9


@dataclass(frozen=True)
class Floor:
    """Repeatability floor of a record.

    Parameters
    ----------
    rms : float, metres
        Rms of the differences between repetitions, per reading.
    source : str
        Data from which it was estimated, with numbers.
    """

    rms: float
    source: str


def floor_of(t: FloatArray, v: FloatArray, y: FloatArray, residual: FloatArray | None = None) -> Floor:
    """Estimate the repeatability floor of a record, without outliers.

    Estimated from repeated moves between the same reversals if there are enough; else from holds; else from the
    sample-to-sample noise. Slow and smooth differences (drift, creep) do not count.

    Parameters
    ----------
    t, v : ndarray, shape (N,), seconds and volts
        Time and voltage.
    y : ndarray, shape (N,), metres
        Displacement; NaN where there is none.
    residual : ndarray, shape (N,), metres, optional
        Residual of a model. It replaces `y` in the estimate, so that drift and hum described by the model do not
        count.

    Returns
    -------
    Floor

    Raises
    ------
    RecordError
        If there are fewer than 5 samples.
    """
    signal = y if residual is None else residual
    usable = np.isfinite(v) & np.isfinite(signal)
    t, v, y, signal = t[usable], v[usable], y[usable], signal[usable]
    if t.size < _FEWEST_READINGS:
        raise RecordError(f"{t.size} samples have no noise floor; give at least {_FEWEST_READINGS}")
    found = _seen(t, v, signal, alone=residual is not None)
    step = digit(y)
    if found.rms < step / np.sqrt(12.0):
        return Floor(step / np.sqrt(12.0), f"digits: {step * 1e9:.3g} nm from one reading to the next")
    if found.rms < NO_NOISE * np.ptp(y):
        return Floor(0.0, f"no noise in {found.source}")
    return found


def _seen(t: FloatArray, v: FloatArray, signal: FloatArray, *, alone: bool) -> Floor:
    for name, seen in (("repeats", _repeats(t, v, signal)), ("holds", _holds(t, v, signal))):
        parts = list(seen)
        pooled = np.concatenate([np.empty(0), *parts])
        if pooled.size >= FEWEST:
            what = {"repeats": "moves made again", "holds": "pieces of holds"}[name]
            return Floor(robust_rms(pooled), f"{name}: {len(parts)} {what}, {pooled.size} samples")
    level = noise(signal, t) if alone else noise(signal, t, v)
    return Floor(level, f"high frequencies: {signal.size} samples, each beside its neighbours; slow noise is not seen")


def robust_rms(x: FloatArray) -> float:
    """Return the rms of `x`, shape (N,), without outliers; unbiased for a Gaussian distribution."""
    size = np.abs(x)
    spread = 1.4826 * float(np.median(size))
    for _ in range(_CUTS):
        spread = float(np.sqrt(np.mean(size[size <= _OUTLIER * spread] ** 2))) / _CUT_GAUSSIAN
    # Where most are equal (coarse digits), nothing is an outlier.
    return spread or float(np.sqrt(np.mean(x**2)))


def _repeats(t: FloatArray, v: FloatArray, signal: FloatArray) -> Iterator[FloatArray]:
    """Yield the difference of each repeated move from its earlier repetition (m), scaled to the noise of one reading.

    Between two reversals the stage follows one branch until the enclosing loop closes; motion before the previous
    reversal has no influence.
    """
    span = float(np.ptp(v))
    ends = reversals(v, smallest_turn(v, noise(v, t)))
    # Each move: the turn before it, its own, and where it goes.
    turns = np.column_stack([v[ends[:-2]], v[ends[1:-1]], v[ends[2:]]])
    for move in range(1, len(turns), max(1, len(turns) // _ENOUGH_PIECES)):
        earliest = max(0, move - _LOOK_BACK)
        alike = np.flatnonzero(np.abs(turns[earliest:move] - turns[move]).max(axis=1) < _SAME_TURN * span)
        if not alike.size:
            continue
        own, other = (
            Move(t[part] - t[part.start], v[part], signal[part])
            for part in (slice(ends[k + 1], ends[k + 2] + 1) for k in (move, earliest + int(alike[-1])))
        )
        direction = np.sign(turns[move, 2] - turns[move, 1])
        within = direction * (own.v - turns[move, 0]) <= 0.0
        difference = _difference(own, other, within, _SAME_VOLTAGE * span)
        if difference.size:
            yield difference


class Move(NamedTuple):
    """Time (s) since the turn, voltage (V) and signal (m) from one turn to the next."""

    t: FloatArray
    v: FloatArray
    signal: FloatArray


def _difference(own: Move, other: Move, within: NDArray[np.bool_], same: float) -> FloatArray:
    """Return how `own` differs from `other` where it is `within`; empty where their voltages are not the `same` (V)."""
    t, v, signal = (x[within] for x in own)
    if min(t.size, other.t.size) < _FEWEST_OF_MOVE:
        return np.empty(0)
    shift = _shift(t, v, other.t, other.v)
    inside = (t + shift >= other.t[0]) & (t + shift <= other.t[-1])
    t, v, signal = t[inside], v[inside], signal[inside]
    if t.size < _FEWEST_OF_MOVE:
        return np.empty(0)
    after = np.clip(np.searchsorted(other.t, t + shift), 1, other.t.size - 1)
    before = after - 1
    step = other.t[after] - other.t[before]
    share = np.divide(t + shift - other.t[before], step, out=np.zeros_like(t), where=step > 0.0)
    v_other, signal_other = ((1.0 - share) * x[before] + share * x[after] for x in (other.v, other.signal))
    if np.sqrt(np.mean((v - v_other) ** 2)) > same:
        return np.empty(0)
    # A reading between two others is less noisy than they are.
    weight = 1.0 / np.sqrt(1.0 + share**2 + (1.0 - share) ** 2)
    # Where the voltages differ a little, the displacements do by a gain, which changes along the move.
    beside = v - v_other
    return _without(weight * (signal - signal_other), *(weight * x for x in (np.ones_like(t), t, beside, beside * t)))


def _shift(t: FloatArray, v: FloatArray, t_other: FloatArray, v_other: FloatArray) -> float:
    """Return the delay (s) of the other move at equal voltages."""
    rate = np.gradient(v, np.maximum.accumulate(t) + 1e-12 * np.arange(t.size))
    shift = 0.0
    for _ in range(3):
        behind = v - np.interp(t + shift, t_other, v_other)
        shift += float(behind @ rate / max(rate @ rate, 1e-300))
    return shift


def _holds(t: FloatArray, v: FloatArray, signal: FloatArray) -> Iterator[FloatArray]:
    """Yield the residual (m) of a parabola fitted to each piece of a hold."""
    starts, stops = resting(t, v, hold_band(v, noise(v, t), digit(v)))
    every = max(1, starts.size // _ENOUGH_PIECES)
    for start, stop in zip(starts[::every].tolist(), stops[::every].tolist(), strict=True):
        # At first the stage still follows the move before.
        first = (start + stop) // 2
        pieces = max(1, round((t[stop - 1] - t[first]) / _LONGEST_PIECE))
        for piece in np.array_split(np.arange(first, stop), pieces):
            if piece.size >= _FEWEST_OF_HOLD:
                since = t[piece] - t[piece[0]]
                yield _without(signal[piece], np.ones(piece.size), since, since**2)


def _without(x: FloatArray, *columns: FloatArray) -> FloatArray:
    """Return the residual of a robust fit of `columns` to `x`, shape (n,), corrected for the degrees of freedom."""
    design = np.column_stack(columns)
    size = np.sqrt((design**2).sum(axis=0))
    design = design[:, size > 0.0] / size[size > 0.0]
    left = x
    for _ in range(_ROBUST_FITS):
        kept = np.abs(left) <= _OUTLIER * 1.4826 * np.median(np.abs(left)) if left is not x else slice(None)
        left = x - design @ np.linalg.lstsq(design[kept], x[kept], rcond=1e-9)[0]
    return np.asarray(left * np.sqrt(x.size / (x.size - design.shape[1])))


# A commanded voltage has less noise than the first share of its range; what looks like more than the other one is none.
LEAST_NOISE, MOST_NOISE = 1e-4, 5e-3
# Orders of the differences in which noise is all that is left.
_ORDERS = (3, 4, 5, 6)
# Samples over which a parabola may take the place of the readings: as many as it fits.
_WINDOWS = (5, 9, 17, 33, 65, 129)
# Reversals up to so many standard deviations are still noise.
_DEAD_BAND = 2.0


def voltage_noise(t: FloatArray, v: FloatArray) -> float:
    """Return the noise (V rms) of a measured voltage, shape (N,), volts; 0 for a commanded voltage.

    Noise is estimated from high-order differences, which suppress smooth signals.
    """
    if v.size <= max(_ORDERS):
        return 0.0
    part = v[:_ENOUGH]
    estimates = [noise(v, t)]
    for order in _ORDERS:
        # The squares of the binomial coefficients of a difference add up to another one.
        size = np.sqrt(_central_binomial(order))
        estimates.append(float(1.4826 * np.median(np.abs(np.diff(part, order)))) / size)
    level = min(estimates)
    span = float(np.ptp(v))
    return level if LEAST_NOISE * span < level < MOST_NOISE * span else 0.0


def _central_binomial(order: int) -> float:
    k = np.arange(1, order + 1)
    return float(np.prod((order + k) / k))


def without_noise(t: FloatArray, v: FloatArray) -> FloatArray:
    """Return a voltage, shape (N,), volts, with measurement noise removed; a commanded voltage is unchanged.

    Each reading is replaced by a parabola over the largest window that fits within the noise. Remaining reversals
    within the noise are flattened.
    """
    # SciPy's signal package takes a second to load, and most commands do without.
    from scipy.signal import savgol_filter

    noise = voltage_noise(t, v)
    if not noise:
        return v
    smooth = v
    for window in _WINDOWS:
        if window > v.size:
            break
        parabola = savgol_filter(v, window, 2)
        off = uniform_filter1d((v - parabola) ** 2, window, mode="nearest")
        # Of so few readings the parabola takes three, and chance some.
        explained = noise**2 * (1.0 - _weight_of_own(window)) * (1.0 + np.sqrt(2.0 / window)) ** 2
        smooth = np.where(off < explained, parabola, smooth)
    return without_small_reversals(smooth, _DEAD_BAND * noise)


def _weight_of_own(window: int) -> float:
    """Return the weight of the middle reading in the parabola's value there."""
    n = window // 2
    return 3.0 * (3.0 * n * (n + 1) - 1.0) / ((2 * n + 3) * (2 * n + 1) * (2 * n - 1))
