"""Readings of a sensor that is slower than its record: each one repeated until the next (sample and hold)."""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from slpi_ros.arrays import FloatArray, Mask
from slpi_ros.identification.bad_readings import after_jumps
from slpi_ros.identification.signal_statistics import FEWEST, digit, median_rms, spread
from slpi_ros.io.record import Record
from slpi_ros.model.sensor import corrected

# Share of repeated rows, beyond those that are equal by their digits, from which readings are held: one row in three
# where a sensor's readings last for one or two rows.
HELD = 0.3
# Log-likelihood of the held readings above that of fresh ones, for each change of the readings.
_BETTER = 0.7
# Share of changes by more than one digit below which it makes no difference whether readings are held.
_ABOVE = 0.1
# Ratio of rows from which a run is longer than usual, and a sensor has another rate.
_OTHER = 1.5
# A record is searched for changes of that rate in parts down to this one.
_PARTS = 16
# Rows that are compared, and the ratio by which they are spread.
_ENOUGH, _GOLDEN = 40_000, (np.sqrt(5.0) - 1.0) / 2.0
# Rows on either side from which the speed is taken: this many readings, and limits.
_READINGS, _LEAST, _MOST = 3, 4, 20_000
# Standard deviations of the noise, in digits, and shares of repeated rows that are tried.
_NOISES = np.geomspace(0.02, 3e3, 40)
_SHARES = np.concatenate([np.arange(0.0, 0.9, 0.1), 1.0 - np.geomspace(0.1, 1e-3, 14)])
# Probability of what is none of noise.
_ELSE = 1e-4
# A jump is larger than this multiple of what the voltage usually changes.
_JUMP = 5.0
# Resolution of readings without digits, as a share of their usual change.
_CONTINUOUS = 1e-3


@dataclass(frozen=True)
class Held:
    """Which readings of a displacement, (N,), are fresh, and the mean number of rows for which each one is held."""

    fresh: Mask
    rows: float  # 1: none is held

    @property
    def found(self) -> bool:
        """Whether readings are held."""
        return self.rows > 1.0


def held_readings(y: FloatArray, v: FloatArray) -> Held:
    """Find the readings of a displacement (m) that are fresh, at voltages (V), both finite, of shape (N,).

    A sensor that changes its rate is judged before and after the change by itself.
    """
    if y.size < FEWEST or np.count_nonzero(y[1:] == y[:-1]) <= HELD * (y.size - 1):
        return Held(np.ones(y.size, dtype=bool), 1.0)
    fresh, rates = _fresh(y, v, _rows(y, v)[0], y.size // _PARTS)
    return Held(fresh, rates[0] if len(set(rates)) == 1 else y.size / np.count_nonzero(fresh))


def _fresh(y: FloatArray, v: FloatArray, rows: float, shortest: int) -> tuple[Mask, list[float]]:
    """Return the fresh readings of a part of a record, (N,), and the rows that each one lasts, of all its parts."""
    at = _change(y)
    own = _rows_of_parts(y, v, at, rows)
    changed = max(own) > _OTHER * min(own)
    if not changed:
        # Of changes that undo each other one half shows more.
        at, own = y.size // 2, (rows, rows)
    if changed or at >= shortest:
        first, before = _fresh(y[:at], v[:at], own[0], shortest)
        last, after = _fresh(y[at:], v[at:], own[1], shortest)
        if len({*before, *after}) > 1:
            return np.concatenate([first, last]), before + after
    return (_with_fresh(y, rows) if rows > 1.0 else np.ones(y.size, dtype=bool)), [rows]


def _rows_of_parts(y: FloatArray, v: FloatArray, at: int, rows: float) -> tuple[float, float]:
    """Return the rows that each reading lasts before and after row `at`, `rows` where nothing speaks for others."""
    usual = _usual(y[:at]), _usual(y[at:])
    if max(usual) <= _OTHER * min(usual):
        return rows, rows
    before, after = _rows(y[:at], v[:at]), _rows(y[at:], v[at:])
    # Digits make the runs of a slow stage longer, too: the likelihood says then that fewer rows are repeated.
    one, other = (each if 1.0 < each < _OTHER / (1.0 - share) else rows for each, share in (before, after))
    return one, other


def _usual(y: FloatArray) -> float:
    """Return the mean number of rows, at least 1, from change to change of readings, without the longest ones."""
    runs = np.diff(np.flatnonzero(np.diff(y)))
    # A run that is longer than usual is of several readings with the same digits.
    return float(np.mean(runs[runs <= max(_OTHER * np.median(runs), 2.0)])) if runs.size else 1.0


def _change(y: FloatArray) -> int:
    """Return the row before and after which the numbers of rows from change to change differ most."""
    at = np.flatnonzero(np.diff(y))
    if at.size < FEWEST:
        return 0
    size = np.log(np.diff(at))
    count = np.arange(1, size.size)
    differ = np.abs(np.cumsum(size - size.mean())[:-1]) / np.sqrt(count * (size.size - count))
    return int(at[1 + np.argmax(differ)]) + 1


def _rows(y: FloatArray, v: FloatArray) -> tuple[float, float]:
    """Return the rows that each reading lasts, 1 if none is held, and the share that the likelihood says repeat.

    Equal readings in a row also come from coarse digits. Explanations of all changes from row to row are compared by
    their likelihood: fresh readings with noise and digits, of a stage that moves at its speed; or readings of which a
    share repeats the one before, or all but every k-th one, so that a change follows all of the motion since the last.
    """
    none = 1.0, 0.0
    same = y[1:] == y[:-1]
    at = np.flatnonzero(~same)
    if y.size < FEWEST or at.size < FEWEST // 4 or np.count_nonzero(same) <= HELD * same.size or not np.ptp(v):
        return none
    rows = same.size / at.size
    moves = y[at + 1] - y[at]
    # Too few levels to tell the digits lie no closer than the smallest change.
    step = digit(y) or max(_CONTINUOUS * median_rms(moves), float(np.abs(moves).min()))
    gain = spread(y) / spread(v)
    driven, ways = gain / step * np.diff(v), _speeds(y, round(_READINGS * rows)) / step
    slowest = np.where(np.abs(driven) < np.abs(ways), driven, ways)
    # What is near a jump of the voltage says nothing; nor does a stage at rest.
    jump = _JUMP * float(np.quantile(np.abs(np.diff(v)), 0.9))
    judged = ~(after_jumps(v, jump)[1:] | after_jumps(v[::-1], jump)[:0:-1]) & (slowest != 0.0)
    judged[: at[0] + 1] = False
    way = np.concatenate([[0.0], np.cumsum(ways)])
    before = at[np.maximum(np.cumsum(~same) - ~same - 1, 0)]
    since = way[1:] - way[before + 1]
    chosen = np.flatnonzero(judged)
    if chosen.size > _ENOUGH:
        # Spread evenly, but not every k-th row: of readings that last for k rows these would all be of one age.
        chosen = chosen[np.unique((np.arange(_ENOUGH) * _GOLDEN % 1.0 * chosen.size).astype(np.intp))]
    equal, changed = chosen[same[chosen]], chosen[~same[chosen]]
    if changed.size < FEWEST // 4:
        return none
    sizes = (y[changed + 1] - y[changed]) / step
    if np.mean(np.abs(sizes) > 1.5) < _ABOVE:
        return none
    # Neither speed is exact: the one counts that a fresh reading goes with better.
    nothing = np.zeros(equal.size)
    fresh = [
        _told(nothing, slowest[equal], noise) + _told(sizes, driven[changed], noise, ways[changed]) for noise in _NOISES
    ]
    best, share = max(_best_share(since[equal], sizes, since[changed], noise) for noise in _NOISES)
    runs = changed - before[changed]
    every = _regular(runs)
    new, met = (equal - before[equal]) % every == 0, runs % every == 0
    nothing, since_still, since_change = nothing[new], since[equal[new]], since[changed[met]]
    regular = max(
        _told(nothing, since_still, noise) + _told(sizes[met], since_change, noise) for noise in _NOISES
    ) + np.count_nonzero(~met) * np.log(_ELSE)
    best, share = max((best, share), (float(regular), 1.0 - 1.0 / every))
    if share < HELD or best - max(fresh) < _BETTER * changed.size:
        return none
    rows = _usual(y)
    # Where most runs are shorter the repeats are those of a stage at rest.
    return (rows, share) if 1.0 - 1.0 / rows >= HELD else none


def _regular(runs: NDArray[np.intp]) -> int:
    """Return the number of rows of which the rows from change to change, (K,), are multiples in most cases."""
    # That one of k phases is met by chance is the less likely the larger k is.
    tried = range(2, max(2, int(2.0 * np.median(runs))) + 1)
    return max(tried, key=lambda every: np.count_nonzero(runs % every == 0) * np.log(every))


def _with_fresh(y: FloatArray, rows: float) -> Mask:
    """Return the fresh readings, (N,), where each one is held for some rows."""
    at = np.arange(y.size)
    new = np.diff(y, prepend=np.nan) != 0.0
    # What stays equal for longer was read anew, with the same digits.
    age = at - np.maximum.accumulate(np.where(new, at, 0))
    again = (np.floor(age / rows) > np.floor((age - 1) / rows)) & (age >= _OTHER * rows)
    return np.asarray(new | again)


def without_held(record: Record, axis: str) -> tuple[Record, float]:
    """Return a record whose held readings of an axis are missing, and the rows for which each one is held."""
    v, y = record.voltage[axis], record.displacement[axis]
    known = np.flatnonzero(np.isfinite(v) & np.isfinite(y))
    found = held_readings(y[known], v[known])
    if not found.found:
        return record, 1.0
    fresh = y.copy()
    fresh[known[~found.fresh]] = np.nan
    return replace(record, displacement={**record.displacement, axis: fresh}), found.rows


def from_fresh(record: Record, axes: Iterable[str], change: Callable[[Record], Record]) -> Record:
    """Return what `change` makes of a record without the held readings of some axes; `left_out` tells these later.

    Readings that were equal are not after a change that depends on time, and would then count as fresh.
    """
    fresh, held = record, {}
    for axis in axes:
        if axis in record.axes:
            fresh, rows = without_held(fresh, axis)
            if rows > 1.0:
                held[axis] = rows
    changed = change(fresh)
    if held:
        # A change may also move readings to other rows, or leave rows out.
        whole = change(record)
        for axis, rows in held.items():
            missing = ~np.isfinite(changed.displacement[axis]) & np.isfinite(whole.displacement[axis])
            changed.derived[left_out, axis] = Held(~missing, rows)
    return changed


def corrected_fresh(
    record: Record, corrections: Mapping[str, Callable[[FloatArray, FloatArray], FloatArray]]
) -> Record:
    """Return `corrected` of the fresh readings of a record."""
    return from_fresh(record, corrections, lambda read: corrected(read, corrections))


def left_out(record: Record, axis: str) -> Held | None:
    """Return which readings of a record are missing because they were held, see `from_fresh`; None: none."""
    found: Held | None = record.derived.get((left_out, axis))
    return found


def slower_sensor(rows: float, period: float) -> str:
    """Return what is told of a sensor whose readings are held for a number of rows, at a `period` (s) of the rows."""
    fresh = f"each reading is repeated for {rows:.3g} samples, {1.0 / (rows * period):.4g} are fresh per second"
    return f"the sensor is slower than the record: {fresh}; only these are used"


def _speeds(y: FloatArray, rows: int) -> FloatArray:
    """Return the mean change of readings, (N,), from row to row over some rows on either side, (N - 1,)."""
    reach = int(np.clip(rows, _LEAST, _MOST))
    first = np.maximum(np.arange(y.size - 1) - reach, 0)
    last = np.minimum(np.arange(1, y.size) + reach, y.size - 1)
    return np.asarray((y[last] - y[first]) / (last - first))


def _probability(size: FloatArray, moved: FloatArray, noise: float) -> FloatArray:
    """Return the probability of changes between two readings with noise, after a motion; in digits, (N,) each."""
    # A digit is a uniform error of each reading, so that of two of them is triangular.
    scale = np.sqrt(2.0) * noise
    far, middle, near = (_integral(size + offset - moved, scale) for offset in (1.0, 0.0, -1.0))
    return np.asarray(np.clip(far - 2.0 * middle + near, 0.0, 1.0))


def _integral(x: FloatArray, scale: float) -> FloatArray:
    """Return the integral of the normal distribution with a standard deviation up to `x`, (N,)."""
    z = x / scale
    return np.asarray(x * ndtr(z) + scale * np.exp(-0.5 * z**2) / np.sqrt(2.0 * np.pi))


def _told(size: FloatArray, moved: FloatArray, noise: float, other: FloatArray | None = None) -> float:
    """Return the log-likelihood of changes after motions, or others, all in digits, (N,)."""
    likely = _probability(size, moved, noise)
    if other is not None:
        likely = np.maximum(likely, _probability(size, other, noise))
    return float(np.sum(np.log(likely + _ELSE)))


def _best_share(still: FloatArray, sizes: FloatArray, since: FloatArray, noise: float) -> tuple[float, float]:
    """Return the largest log-likelihood, and its share, of no change after motions (M,) and of changes (K,)."""
    by_chance = _probability(np.zeros(still.size), still, noise)
    changes = _told(sizes, since, noise)
    return max(
        (
            float(np.sum(np.log(share + (1.0 - share) * by_chance + _ELSE))) + changes + sizes.size * np.log1p(-share),
            share,
        )
        for share in _SHARES.tolist()
    )
