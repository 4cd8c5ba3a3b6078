"""Wrong sensor readings: repeated, outlying, stale, early, late and mixed ones; a rest of the voltage explains one."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from scipy.ndimage import maximum_filter1d, median_filter, minimum_filter1d
from scipy.special import betainc, ndtri

from slpi_ros.arrays import FloatArray, IntArray, Mask
from slpi_ros.hysteresis.reversals import reversals
from slpi_ros.identification.signal_statistics import ENOUGH, FEWEST, digit, median_rms, noise, spread

# Expected number of false alarms of each test on a clean record.
FALSE_ALARMS = 0.01
# Least gain of a piezo after a reversal, as a share of the mean gain.
LEAST_GAIN = 0.2
# Block size, in readings, for long records.
_BLOCK = 1_000_000
# Number of preceding readings with which a reading is compared.
_EARLIER = 3
# Noise below this share of the range is the round-off error of a signal without noise.
ROUND_OFF = 1e-9
# Least size of an outlier as a share of the range; piecewise excitation signals have smaller kinks.
LEAST_SPIKE = 0.001
# Large outliers: distance from the running median, as multiples of the median (non-zero) distance in the record and of
# that in the window; number of passes.
_FAR, _APART, _PASSES = 15.0, 5.0, 5
# Window length of the running median of a model error, in readings.
_MODEL_WINDOW = 15
# The deviation changes by more than this share of an outlier from the reading before and to the reading after it.
_SUDDEN = 0.5
# Largest delay of a displacement reversal, and duration of ringing after a jump, in samples.
_TURN_REACH, _RINGING = 5, 200
# Window length of the running median, in readings: the longest run of outliers is shorter than half of it, and it spans
# the readings in which the other signal may explain a deviation. At the ends of a record, where a jump and a delay look
# like outliers, the other signal is taken over this many windows.
_WINDOW, _END_WINDOWS = 2 * _TURN_REACH + 1, 3


@dataclass(frozen=True)
class Repeats:
    """Runs of equal consecutive readings: index of the `first` one and number (`length`, at least 2), shape (M,)."""

    first: IntArray
    length: IntArray

    @classmethod
    def within(cls, x: FloatArray) -> "Repeats":
        """Find all runs of equal consecutive readings in `x`, shape (N,), in any unit."""
        bounds = np.concatenate([[0], np.flatnonzero(x[1:] != x[:-1]) + 1, [x.size]])
        length = np.diff(bounds)
        several = length > 1
        return cls(bounds[:-1][several], length[several])

    def spans(self, x: FloatArray) -> FloatArray:
        """Return the range of `x`, shape (N,), during each run, shape (M,)."""
        if not self.first.size:
            return np.empty(0)
        # Every second range of reduceat is a run; the ranges between runs are discarded.
        bounds = np.column_stack([self.first, self.first + self.length]).ravel()
        padded = np.append(x, x[-1])
        high, low = (extreme.reduceat(padded, bounds)[::2] for extreme in (np.maximum, np.minimum))
        return np.asarray(high - low)

    def where(self, chosen: Mask) -> "Repeats":
        """Return the runs selected by the mask `chosen`, shape (M,)."""
        return Repeats(self.first[chosen], self.length[chosen])

    @property
    def readings(self) -> int:
        """Number of readings that repeat the preceding one."""
        return int(np.sum(self.length - 1))


def frozen(y: FloatArray, v: FloatArray, gain: float, noise_rms: float, step: float) -> Repeats:
    """Return the runs of equal displacements (m) that indicate a frozen sensor; noise (rms) and resolution in m."""
    # The voltage changed so much that the displacement must have moved, or such a run is improbable given the noise.
    repeats = Repeats.within(y)
    moved = repeats.spans(v)
    due = LEAST_GAIN * gain * moved > 3.0 * step + 6.0 * noise_rms
    # Two readings of Gaussian noise have the same digits with probability step / (2 sqrt(pi) noise).
    with np.errstate(divide="ignore"):
        alike = np.minimum(np.log(step) - np.log(2.0 * np.sqrt(np.pi) * noise_rms), 0.0) if noise_rms else 0.0
    improbable = (repeats.length - 1) * alike < np.log(FALSE_ALARMS / y.size)
    return repeats.where(due | (improbable & (moved > 0.0)))


def stuck(y: FloatArray, v: FloatArray) -> IntArray:
    """Return repeated displacements (m), in runs of three or more; none if the noise is below the resolution."""
    repeats = Repeats.within(y)
    if not np.any(repeats.length > 2):
        return np.empty(0, np.int64)
    noise_rms, step = noise(y, v), digit(y)
    if noise_rms <= step:
        return np.empty(0, np.int64)
    if noise_rms < ROUND_OFF * spread(y):
        # Without noise, coarse sampling hides the resolution; it is at most the smallest change between two readings.
        changes = np.abs(np.diff(y))
        step = float(np.min(changes[changes > ROUND_OFF * spread(y)], initial=np.inf))
    repeats = frozen(y, v, spread(y) / spread(v), noise_rms, step)
    repeats = repeats.where(repeats.length > 2)
    again = [np.arange(first + 1, first + length) for first, length in zip(repeats.first, repeats.length, strict=True)]
    return np.concatenate([np.empty(0, np.int64), *again])


def stopped(v: FloatArray, y: FloatArray, gain: float, noise_rms: float) -> Repeats:
    """Return the runs of equal voltages (V) in which the displacement (m) moves and after which the voltage jumps."""
    # A hold after a voltage jump is excluded: there the displacement still follows the jump.
    repeats = Repeats.within(v)
    moved = repeats.spans(y) / gain
    last = repeats.first + repeats.length - 1
    before = np.abs(v[repeats.first] - v[np.maximum(repeats.first - _TURN_REACH, 0)])
    after = np.abs(v[np.minimum(last + 1, v.size - 1)] - v[last])
    least = 0.02 * np.ptp(v) + 6.0 * noise_rms / gain
    return repeats.where((moved > least) & (before < 0.5 * moved) & (after > 0.5 * moved))


def far_outliers(v: FloatArray, y: FloatArray) -> tuple[IntArray, IntArray]:
    """Return the indices of large outliers in `v` (V) and `y` (m), (N,), that the other signal does not explain."""
    # Unlike `lone_outliers`, this needs no noise estimate, which such large outliers would distort. Readings where both
    # signals are suddenly 0 are outliers of both: a lost message, and no motion that the other signal explains.
    found = np.zeros((2, v.size), dtype=bool)
    zero = (v == 0.0) & (y == 0.0)
    for _ in range(_PASSES):
        # Neighbouring outliers mask each other.
        cleaned = [without(x, np.flatnonzero(off)) for x, off in zip((v, y), found, strict=True)]
        (beyond_v, unexplained_v), (beyond_y, unexplained_y) = _far(*cleaned), _far(*cleaned[::-1])
        lost = _sudden(zero & beyond_v & beyond_y, v, y)
        more = np.array([unexplained_v | lost, unexplained_y | lost])
        if not more.any():
            break
        found |= more
    return np.flatnonzero(found[0]), np.flatnonzero(found[1])


def _sudden(off: Mask, *signals: FloatArray) -> Mask:
    """Return the runs of a mask, shape (N,), at whose ends every signal changes by most of what it does around them."""
    kept = off.copy()
    bounds = np.flatnonzero(np.diff(off, prepend=False, append=False))
    for first, end in zip(bounds[::2].tolist(), bounds[1::2].tolist(), strict=True):
        for x in signals:
            around = np.median(x[max(first - _TURN_REACH, 0) : end + _TURN_REACH])
            least = _SUDDEN * max(abs(x[first:end] - around))
            if (first and abs(x[first] - x[first - 1]) < least) or (end < x.size and abs(x[end] - x[end - 1]) < least):
                kept[first:end] = False
    return kept


def _far(x: FloatArray, other: FloatArray) -> tuple[Mask, Mask]:
    """Return the masks of the readings far from the running median, and of those that `other` does not explain."""
    middle = _running_median(x)
    off = np.abs(x - middle)
    if not off.any():
        return off > 0.0, off > 0.0
    moved = maximum_filter1d(other, _WINDOW) - minimum_filter1d(other, _WINDOW)
    ends = _END_WINDOWS * _WINDOW
    moved[:_TURN_REACH], moved[-_TURN_REACH:] = np.ptp(other[:ends]), np.ptp(other[-ends:])
    # During a monotone move the median is the reading itself, at distance 0.
    least = max(_FAR * float(np.median(off[off > 0.0])), LEAST_SPIKE * spread(middle))
    far = off > least
    if far.any():
        # Ringing moves all readings away from the median, an outlier only one.
        far &= off > _APART * _running_median(off)
    gain = spread(middle) / (spread(other) or np.inf)
    return far, np.asarray(far & (off > least + 2.0 * gain * moved))


def _running_median(x: FloatArray) -> FloatArray:
    """Return the median of each reading and its neighbours, shape (N,); at the ends that of the outermost window."""
    middle = np.asarray(median_filter(x, _WINDOW, mode="nearest"))
    middle[:_TURN_REACH], middle[-_TURN_REACH:] = np.median(x[:_WINDOW]), np.median(x[-_WINDOW:])
    return middle


def outliers_by_model(path: FloatArray, y: FloatArray, v: FloatArray) -> IntArray:
    """Return the indices of displacements (m) that deviate suddenly from a model's (m), which no reversal explains."""
    # This includes groups of outliers and outliers at kinks, which cannot be distinguished from motion without a model.
    kept = np.arange(y.size)
    for _ in range(_PASSES):
        # Neighbouring outliers mask each other.
        off = _sudden_deviations(path[kept], y[kept], v[kept])
        if not off.any():
            break
        kept = kept[~off]
    found = np.setdiff1d(np.arange(y.size), kept)
    if not found.size:
        return found
    # Outliers lie anywhere; what is found at reversals more often than elsewhere is an error of the model.
    near = np.zeros(v.size, dtype=bool)
    near[reversals(v)] = True
    near = maximum_filter1d(near, 4 * _MODEL_WINDOW + 1)
    groups = near[found[np.diff(found, prepend=-_MODEL_WINDOW) >= _MODEL_WINDOW]]
    share = float(np.mean(near))
    # Chance of at least as many of n independent groups near reversals, the tail of the binomial distribution.
    k, n = int(groups.sum()), groups.size
    coincidental = k == 0 or float(betainc(k, n - k + 1, share)) > FALSE_ALARMS
    return found if coincidental else found[~near[found]]


def _sudden_deviations(path: FloatArray, y: FloatArray, v: FloatArray) -> Mask:
    if y.size < 5:
        return np.zeros(y.size, dtype=bool)
    error = y - path
    # The error of the model itself is similar in neighbouring readings.
    off = np.abs(error - median_filter(error, _MODEL_WINDOW, mode="mirror"))
    if not off.any():
        return np.zeros(y.size, dtype=bool)
    turned = np.pad(np.abs(_off_neighbours(v)), 2)
    explained = 2.0 * spread(y) / spread(v) * maximum_filter1d(turned, 2 * _TURN_REACH + 1)
    # The model error is larger while the stage moves than at rest.
    usual = 1.4826 * median_filter(off, 2 * _MODEL_WINDOW + 1, mode="mirror")
    least = np.maximum(_FAR * np.maximum(usual, median_rms(off[off > 0.0])), LEAST_SPIKE * spread(y))
    far: Mask = off > least + explained
    if not far.any():
        return far
    # A model error comes or goes gradually or without a step of the readings, an outlier with one.
    bounds = np.flatnonzero(np.diff(far, prepend=False, append=False))
    first, last = bounds[::2], bounds[1::2] - 1
    steps = np.diff(y)
    steps = np.minimum(np.abs(steps - median_filter(steps, _MODEL_WINDOW, mode="mirror")), np.abs(np.diff(error)))
    jumps = np.concatenate([[np.inf], steps, [np.inf]])
    size = _SUDDEN * np.maximum.reduceat(np.append(off, 0.0), bounds)[::2]
    sudden = (jumps[first] > size) & (jumps[last + 1] > size)
    far[far] = np.repeat(sudden, np.diff(bounds)[::2])
    return far


def without(x: FloatArray, outliers: IntArray) -> FloatArray:
    """Return readings `x`, shape (N,), with outliers replaced by linear interpolation between their neighbours."""
    if not outliers.size:
        return x
    kept = np.ones(x.size, dtype=bool)
    kept[outliers] = False
    good = np.flatnonzero(kept)
    cleaned = x.copy()
    cleaned[outliers] = np.interp(outliers, good, x[good])
    return cleaned


def lone_of(t: FloatArray, v: FloatArray, y: FloatArray, at_kinks: bool = True) -> tuple[IntArray, IntArray]:
    """Return the indices of the isolated outliers of a voltage (V) and of a displacement (m), neither constant."""
    # An outlier of both signals at the same sample is attributed to the voltage, which the displacement follows.
    gain, noise_v, noise_y = spread(y) / spread(v), noise(v, t), noise(y, v, t)
    if noise_y < ROUND_OFF * spread(y):
        # Without noise, the usual distance from the neighbours, by curvature or by digits, stands in its place.
        off = _off_neighbours(y)
        noise_y = max(noise_y, median_rms(off[off != 0.0])) if off.any() else 0.0
    off_v = lone_outliers(v, y, 1.0 / gain, max(noise_v, digit(v), LEAST_SPIKE * float(np.ptp(v))), noise_y)
    off_y = lone_outliers(y, v, gain, max(noise_y, digit(y)), noise_v, at_kinks)
    return off_v, np.setdiff1d(off_y, off_v)


def lone_outliers(
    y: FloatArray, v: FloatArray, gain: float, noise_y: float, noise_v: float, at_kinks: bool = True
) -> IntArray:
    """Return the readings that deviate from a line through their four neighbours although the voltage does not."""
    # `at_kinks` includes readings that a kink in the displacement plus noise (rms, m and V) could explain.
    if not noise_y:
        return np.empty(0, np.int64)
    deviations = -float(ndtri(0.5 * FALSE_ALARMS / y.size)) * noise_y
    limit, beyond_kink = np.sqrt(1.25) * deviations, -np.inf if at_kinks else np.sqrt(3.5) * deviations
    every = max(1, v.size // ENOUGH)
    jump = 5.0 * np.quantile(np.abs(v[every::every] - v[every - 1 : -1 : every]), 0.9) + 8.0 * noise_v
    found = [np.empty(0, np.int64)]
    for start in range(0, y.size, _BLOCK):
        # Blocks overlap their neighbours.
        first, end = max(start - _RINGING, 0), start + _BLOCK + _RINGING
        here = _outliers_of_block(y[first:end], v[first:end], gain, noise_y, (limit, beyond_kink), jump) + first
        found.append(here[(here >= start) & (here < start + _BLOCK)])
    if y.size >= _END_WINDOWS * _WINDOW:
        still = ~after_jumps(v[-2 * _RINGING :], jump)
        at_start = _outliers_at_start(y, v, gain, limit)
        at_end = _outliers_at_start(y[::-1], v[::-1], gain, limit, follows=False)
        found += [at_start, np.asarray(y.size - 1 - at_end[still[-1 - at_end]])]
    return np.unique(np.concatenate(found))


def _outliers_at_start(y: FloatArray, v: FloatArray, gain: float, limit: float, follows: bool = True) -> IntArray:
    """Return which of the first two readings deviate from a line through the next five, but not the voltage."""
    # `limit` (m) is the largest deviation of a reading from the mean of four others by noise. If `follows`, one signal
    # may jump at the start and the other follow later.
    at, inner = np.arange(2), np.arange(2, 7)
    off = np.abs(y[at] - np.polyval(np.polyfit(inner, y[inner], 1), at))
    near = np.arange(_WINDOW)
    explained = float(np.abs(v[near] - np.polyval(np.polyfit(inner, v[inner], 1), near)).max())
    if follows:
        # As long as this signal stays where it is after the jump, any motion of the other one is due to the jump.
        away = np.abs(y[2 : _END_WINDOWS * _WINDOW] - y[2]) > 0.25 * off.max()
        until = int(np.argmax(away)) if away.any() else away.size
        explained = max(explained, float(np.ptp(v[: max(2 + until, _WINDOW)])))
    # The line does not account for a reversal, a kink or a curve beside it.
    steps = np.diff(y[2:_WINDOW])
    bent = 5.0 * np.abs(steps).max() + 10.0 * np.abs(np.diff(steps)).max()
    # Variance of the distance from the line, relative to that from the mean of four readings.
    variance = (1.2 + 0.1 * (at - inner.mean()) ** 2) / 1.25
    return np.asarray(at[off > limit * np.sqrt(variance) + 2.0 * gain * explained + bent])


def _outliers_of_block(
    y: FloatArray, v: FloatArray, gain: float, noise_y: float, limits: tuple[float, float], jump: float
) -> IntArray:
    if y.size < 5:
        return np.empty(0, np.int64)
    limit, beyond_kink = limits
    off, turns = _off_neighbours(y), np.abs(_off_neighbours(v))
    explained = 2.0 * gain * maximum_filter1d(turns, 2 * _TURN_REACH + 1)
    found = np.flatnonzero((np.abs(off) > limit + explained) & ~after_jumps(v, jump)[2:-2])
    # At kinks and during ringing, the neighbours do not lie on a line either.
    before, after = y[found + 1] - y[found], y[found + 4] - y[found + 3]
    across = y[found + 3] - y[found + 1]
    size = np.abs(off[found])
    straight = np.abs(before - after) < np.maximum(8.0 * noise_y, 0.5 * size)
    straight &= np.abs(across - before - after) < np.maximum(12.0 * noise_y, 0.5 * size)
    # At a kink, a reading deviates from its neighbours by 3/4 of the change of slope.
    straight &= size - 0.75 * np.sign(off[found]) * (before - after) > beyond_kink
    return np.asarray(found[straight] + 2)


def after_jumps(v: FloatArray, jump: float) -> Mask:
    """Return the mask, shape (N,), of samples within `_RINGING` samples after a voltage jump above `jump` (V)."""
    jumps = np.flatnonzero(np.abs(np.diff(v, prepend=v[0])) > jump)
    last = np.zeros(v.size, np.int64)
    last[jumps] = jumps + _RINGING
    return np.asarray(np.arange(v.size) < np.maximum.accumulate(last))


def _off_neighbours(x: FloatArray) -> FloatArray:
    return np.asarray(x[2:-2] - 0.25 * (x[:-4] + x[1:-3] + x[3:-1] + x[4:]))


def stale(y: FloatArray, outliers: IntArray, noise_rms: float) -> IntArray:
    """Return the outliers that are equal, within the noise, to one of the preceding readings."""
    # If outliers match later readings almost as often, the matches are coincidental and none is returned.
    near = 3.0 * np.sqrt(2.0) * noise_rms
    reach = np.arange(1, _EARLIER + 1)
    earlier, later = (
        (np.abs(y[outliers][:, None] - y[np.clip(outliers[:, None] + way * reach, 0, y.size - 1)]) < near).any(axis=1)
        for way in (-1, 1)
    )
    by_chance = np.count_nonzero(earlier) < 2 * np.count_nonzero(later)
    return outliers[:0] if by_chance else outliers[earlier]


# Number of readings on either side with which a reading is compared.
_BESIDE = 3
# A record has mixed readings if more than this share of the readings deviates by more than half a step towards one
# neighbour (next or preceding), and this many times as many as towards the other. Readings count only if the ratio of
# noise to step is below the last value.
_MIXED_SHARE, _MIXED_TIMES, _MIXED_NOISE = 0.02, 5.0, 0.12
# Least deviation of a mixed reading: as a share of the step, from a line through neighbours and from a model; and in
# robust standard deviations.
_MIXED_BY_LINE, _MIXED_BY_MODEL, _MIXED_DEVIATIONS = 0.2, 0.05, 4.0
# Largest deviation of a mixed reading, in steps, with a margin for errors.
_MIXED_MOST = 1.3


class Mixed(NamedTuple):
    """Readings of a displacement that are early, late or a mixture of two neighbouring values."""

    readings: IntArray  # indices
    judged: int  # number of readings tested: those not next to a reversal
    side: int  # 1: mixed with the next reading, -1: with the preceding one, 0: none found


def mixed_readings(y: FloatArray, v: FloatArray) -> Mixed:
    """Find the readings of a displacement (m, (N,)) that are early, late or a mixture of two neighbouring values."""
    # Such a reading lies between its true value and that of a neighbour: a data link has delivered an old value or
    # parts of two. Unlike noise and outliers, all deviate towards the next reading, or all towards the last one.
    off, way = _beside_lines(y[:ENOUGH], v[:ENOUGH])
    clear = np.abs(way) * _MIXED_NOISE > median_rms(off[way != 0.0]) if way.any() else way != 0.0
    count = int(np.count_nonzero(clear))
    ways = off[clear] / way[clear]
    early, late, far = (np.count_nonzero(at) for at in (ways > 0.5, ways < -0.5, np.abs(ways) > _MIXED_MOST))
    many, few = max(early, late), min(early, late)
    if count < FEWEST or many < max(_MIXED_SHARE * count, _MIXED_TIMES * few) or far > 0.1 * many:
        return Mixed(np.empty(0, np.int64), count, 0)
    side = 1 if early > late else -1
    found, judged = [], 0
    for start in range(0, y.size, ENOUGH):
        first = max(start - _RINGING, 0)
        here = slice(first, start + ENOUGH + _RINGING)
        off, way = (x[start - first :][:ENOUGH] for x in _beside_lines(y[here], v[here]))
        found.append(start + _mixed(side * off, way, _MIXED_BY_LINE))
        judged += int(np.count_nonzero(way))
    return Mixed(np.concatenate(found), judged, side)


def mixed_by_model(path: FloatArray, y: FloatArray, fitted: Mask, side: int) -> IntArray:
    """Return the mixed ones of the `fitted` readings, also near reversals, by the displacement of a model (m, (N,))."""
    at = np.flatnonzero(fitted)
    off = (y - path)[at]
    # The error of the model itself is similar in neighbouring readings.
    off = off - median_filter(off, _MODEL_WINDOW)
    way = np.diff(path, append=path[-1]) if side > 0 else np.diff(path, prepend=path[0])
    return at[_mixed(side * off, way[at], _MIXED_BY_MODEL)]


def _mixed(off: FloatArray, way: FloatArray, least: float) -> IntArray:
    """Return the readings whose deviation `off` (m) exceeds the share `least` of the step `way` (m) to a neighbour."""
    known, ahead = way != 0.0, np.sign(way) * off
    noise_off = _MIXED_DEVIATIONS * median_rms(off[known]) if known.any() else 0.0
    found = ahead > np.maximum(least * np.abs(way), noise_off)
    # A deviation beyond the neighbouring reading has another cause.
    return np.flatnonzero(known & found & (ahead < _MIXED_MOST * np.abs(way) + noise_off))


def _beside_lines(y: FloatArray, v: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return deviations (m) of readings from lines through their neighbours, and steps (m), (N,); 0 at turns."""
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
    # A branch is curved, so that all readings of a section deviate from the line by the same number of steps.
    steps_off = np.divide(off, way, out=np.zeros_like(off), where=known)
    off[known] -= (median_filter(steps_off, 2 * width + 1) * way)[known]
    return np.where(known, off, 0.0), way
