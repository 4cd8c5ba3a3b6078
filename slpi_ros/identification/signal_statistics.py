"""What is wrong with the readings of a sensor: noise, digits, values that repeat or stand alone.

All tests know the voltage: a displacement may rest while the voltage rests, and turn where the voltage turns.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter1d
from scipy.special import ndtri

FloatArray = NDArray[np.float64]
Mask = NDArray[np.bool_]

# False alarms that a clean record may give, of each kind.
FALSE_ALARMS = 0.01
# After a turn a piezo moves less per volt than on average; this share of it is left at least.
LEAST_GAIN = 0.2
# So many readings tell as much of noise and digits as all of a long record.
_ENOUGH = 100_000
# Readings of a long record that are judged together.
_BLOCK = 1_000_000
# A reading is compared with so many before it.
_EARLIER = 3
# A displacement may turn this many samples away from the voltage, and ring so many after it jumped.
_TURN_REACH, _RINGING = 5, 200


def digit(x: FloatArray) -> float:
    """Return the step between possible readings, 0 where they are continuous.

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
    """Return how far the readings reach, outliers apart."""
    low, high = np.percentile(x[:: max(1, x.size // _ENOUGH)], (1, 99))
    return float(high - low) or float(np.ptp(x))


def noise(x: FloatArray, *drivers: FloatArray) -> float:
    """Return the rms of what changes from reading to reading, outliers apart.

    From what each reading differs from the line, or the curve, through its neighbours; or from the line along a driver,
    which an uneven rate does not disturb. Where the signal bends, each of them sees more than noise, and a median
    passes over that; the least one counts. Noise that lasts for several samples is not seen.

    Parameters
    ----------
    x : ndarray, shape (N,), N >= 5
        Readings.
    *drivers : ndarray, shape (N,)
        What the readings follow: time, or a voltage.
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
    """Stretches of equal readings in a row.

    Parameters
    ----------
    first : ndarray of int, shape (M,)
        The first reading of each.
    length : ndarray of int, shape (M,)
        Readings in each, at least 2.
    """

    first: NDArray[np.int64]
    length: NDArray[np.int64]

    @classmethod
    def within(cls, x: FloatArray) -> "Repeats":
        """Find all in `x`, shape (N,)."""
        bounds = np.concatenate([[0], np.flatnonzero(x[1:] != x[:-1]) + 1, [x.size]])
        length = np.diff(bounds)
        several = length > 1
        return cls(bounds[:-1][several], length[several])

    def spans(self, x: FloatArray) -> FloatArray:
        """Return how far `x`, shape (N,), moves during each, shape (M,)."""
        if not self.first.size:
            return np.empty(0)
        # Every second range of reduceat is one of ours, and what lies between is left out.
        bounds = np.column_stack([self.first, self.first + self.length]).ravel()
        padded = np.append(x, x[-1])
        high, low = (extreme.reduceat(padded, bounds)[::2] for extreme in (np.maximum, np.minimum))
        return np.asarray(high - low)

    def where(self, chosen: Mask) -> "Repeats":
        """Return the `chosen` ones, shape (M,)."""
        return Repeats(self.first[chosen], self.length[chosen])

    @property
    def readings(self) -> int:
        """How many readings repeat the one before."""
        return int(np.sum(self.length - 1))


def frozen(y: FloatArray, v: FloatArray, gain: float, noise_rms: float, step: float) -> Repeats:
    """Return the repeats of a displacement that are none by chance.

    Either it would have had to follow the voltage, or so many equal readings are improbable in the noise.

    Parameters
    ----------
    y, v : ndarray, shape (N,), metres and volts
        Displacement and voltage.
    gain : float, metres per volt
    noise_rms, step : float, metres
        Of the displacement.
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
    """Return the readings that repeat the one before, three and more in a row, though noise should tell them apart.

    Digits coarser than the noise repeat readings too; of such a displacement, shape (N,), metres, none is returned.
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
    """Return the repeats of a voltage that it must have missed: the displacement moves on, and then the voltage jumps.

    Parameters are those of `frozen`. A voltage that rests after a jump is none: the displacement still follows.
    """
    repeats = Repeats.within(v)
    moved = repeats.spans(y) / gain
    last = repeats.first + repeats.length - 1
    before = np.abs(v[repeats.first] - v[np.maximum(repeats.first - _TURN_REACH, 0)])
    after = np.abs(v[np.minimum(last + 1, v.size - 1)] - v[last])
    least = 0.02 * np.ptp(v) + 6.0 * noise_rms / gain
    return repeats.where((moved > least) & (before < 0.5 * moved) & (after > 0.5 * moved))


def lone_outliers(y: FloatArray, v: FloatArray, gain: float, noise_y: float, noise_v: float) -> NDArray[np.int64]:
    """Return the readings that stand off the line of their four neighbours, which they share, unlike the voltage.

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
    """Return where the voltage has jumped not long ago, shape (N,)."""
    jumps = np.flatnonzero(np.abs(np.diff(v, prepend=v[0])) > jump)
    last = np.zeros(v.size, np.int64)
    last[jumps] = jumps + _RINGING
    return np.asarray(np.arange(v.size) < np.maximum.accumulate(last))


def _off_neighbours(x: FloatArray) -> FloatArray:
    return np.asarray(x[2:-2] - 0.25 * (x[:-4] + x[1:-3] + x[3:-1] + x[4:]))


def stale(y: FloatArray, outliers: NDArray[np.int64], noise_rms: float) -> NDArray[np.int64]:
    """Return those of the outliers that repeat, but for the noise, one of the readings before.

    Outliers of any size now and then do so by chance; but then they hit a reading after them as often.
    """
    near = 3.0 * np.sqrt(2.0) * noise_rms
    reach = np.arange(1, _EARLIER + 1)
    earlier, later = (
        (np.abs(y[outliers][:, None] - y[np.clip(outliers[:, None] + way * reach, 0, y.size - 1)]) < near).any(axis=1)
        for way in (-1, 1)
    )
    by_chance = np.count_nonzero(earlier) < 2 * np.count_nonzero(later)
    return outliers[:0] if by_chance else outliers[earlier]
