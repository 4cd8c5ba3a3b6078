"""Significance of a gain: whether held-out errors fall by more than chance, over all candidates that were tried."""

from collections.abc import Sequence
from functools import cache

import numpy as np
from scipy.special import stdtr

from slpi_ros.arrays import FloatArray
from slpi_ros.diagnosis.joint_fit import Score

# Smallest relative reduction of the held-out error by an effect.
LEAST_GAIN = 0.05
# Largest p-value for a gain to be significant, and for two effects to differ.
CHANCE, ALIKE = 0.01, 0.05
# The p-value of an effect that acts in a few blocks only, such as a saturation, is never small: limit for a large gain.
LARGE_GAIN, CHANCE_OF_LARGE_GAIN = 0.3, 0.05
# Number of random sign patterns, and the share of them by which the number of independent candidates is estimated.
SURROGATES, TAIL = 1999, 0.05
# Lower bound of losses, for records without noise (m^2), and smallest p-value.
TINY, LEAST_CHANCE = 1e-30, 1e-12
# Largest accepted ratio of the error with an effect to that without it, on any record; and largest rise of its mean
# square there, as a share of the fall of the mean square of all: what is left may be divided otherwise, more so on
# records that are left out.
NO_WORSE, RISE, RISE_LEFT_OUT = 1.05, 0.05, 0.4


def chance_of_gain(before: Score, after: Score, trials: float = 1.0) -> float:
    """Return the p-value of a reduction of the block losses, the best of so many independent `trials`, by a t-test."""
    # Of absolute and of logarithmic reductions, so that a single block with large errors does not hide the others; the
    # smaller p-value counts.
    alone = min(_chance(gains) for gains in _gains_of_blocks(before, after))
    return float(max(-np.expm1(trials * np.log1p(-min(alone, 1.0 - 1e-12))), LEAST_CHANCE))


def _gains_of_blocks(before: Score, after: Score) -> tuple[FloatArray, FloatArray]:
    logarithms = np.log(np.maximum(before.losses, TINY) / np.maximum(after.losses, TINY))
    return before.losses - after.losses, logarithms


def _chance(gains: FloatArray) -> float:
    """Return the one-sided p-value of a positive mean of gains, shape (n,)."""
    error = float(np.std(gains, ddof=1)) / np.sqrt(gains.size)
    mean = float(np.mean(gains))
    if not error > 0.0:
        return LEAST_CHANCE if mean > 0.0 else 1.0
    return float(stdtr(gains.size - 1, -mean / error))


def independent_trials(before: Score, tried: Sequence[Score]) -> float:
    """Return the number of independent candidates whose best gain is by chance as large as that of those `tried`.

    From the maximum over all candidates for random signs of the blocks: Westfall and Young, Resampling-Based Multiple
    Testing, Wiley 1993, Sec. 2.6.
    """
    if not tried:
        return 1.0
    gains = np.array([part for after in tried for part in _gains_of_blocks(before, after)])
    # A form far from the data may have losses beyond all bounds, of which the squares would overflow.
    largest, count = np.abs(gains).max(axis=1), before.losses.size
    usable = (largest > 0.0) & np.isfinite(largest)
    gains = gains[usable] / largest[usable, None]
    directions = gains / np.linalg.norm(gains, axis=1, keepdims=True)
    shares = (_signs(count) @ directions.T).max(axis=1, initial=0.0)
    # The sum of gains with random signs, relative to the root of the sum of their squares, as Student's t.
    share = float(np.clip(np.quantile(shares, 1.0 - TAIL), 0.0, np.sqrt(count) * 0.99))
    alone = float(stdtr(count - 1, -share * np.sqrt((count - 1) / (count - share**2))))
    return float(max(1.0, np.log1p(-TAIL) / np.log1p(-alone)))


@cache
def _signs(blocks: int) -> FloatArray:
    """Return random sign patterns, shape (surrogates, blocks), the same ones at every call."""
    return np.random.default_rng(0).choice([-1.0, 1.0], (SURROGATES, blocks))


def gain(before: Score, after: Score) -> float:
    """Return the relative reduction of the held-out error on blocks."""
    return 1.0 - after.rms / before.rms


def carries_over(before: Score, after: Score) -> bool:
    """Return whether the error falls on each held-out record, or clearly on all together; True for one record."""
    # Clearly: by `LEAST_GAIN`, and it is worse on none.
    both = np.isfinite(before.records) & np.isfinite(after.records)
    if before.records.size == 0 or not both.any() or (after.records[both] < before.records[both]).all():
        return True
    less = after.rms_of_records <= (1.0 - LEAST_GAIN) * before.rms_of_records
    return less and worse_on_none(before.records[both], after.records[both], RISE_LEFT_OUT)


def worse_on_none(before: FloatArray, after: FloatArray, rise: float = RISE) -> bool:
    """Return whether mean squares (m^2, (records,)) rise on no record, but for a share of what all fall by."""
    fall = float(np.mean(before - after))
    return bool(np.all((after <= NO_WORSE**2 * before) | (after - before <= rise * fall)))


def counts(before: Score, after: Score, *, own: bool = True, least: float = LEAST_GAIN, trials: float = 1.0) -> bool:
    """Return whether a gain is at least `least`, significant and, unless the effect is of one record, carries over."""
    found = gain(before, after)
    # An effect of which one record alone shows much acts in few of all blocks, too.
    if found >= LARGE_GAIN or (not own and found >= least and _most_on_one_record(before, after) >= LARGE_GAIN):
        significant = chance_of_gain(before, after) <= CHANCE_OF_LARGE_GAIN
    else:
        significant = found >= least and chance_of_gain(before, after, trials) <= CHANCE
    return significant and (own or carries_over(before, after))


def _most_on_one_record(before: Score, after: Score) -> float:
    """Return the largest relative reduction of the error on a held-out record; 0 for one record."""
    both = np.isfinite(before.records) & np.isfinite(after.records) & (before.records > 0.0)
    return 1.0 - float(np.sqrt(np.min(after.records[both] / before.records[both], initial=1.0)))


def clearly_better(best: Score, other: Score, noise: float) -> bool:
    """Return whether an explanation is better than another one by more than it leaves itself beyond the `noise` (m)."""
    # What is left beyond the noise is a defect of the model, and a difference within it may be its doing.
    return other.rms**2 - best.rms**2 > max(best.rms**2 - noise**2, 0.0)


def worse_left_out(best: Score, other: Score) -> bool:
    """Return whether an explanation is worse than another one on records that are left out; False for one record."""
    return bool(best.records.size) and other.rms_of_records > NO_WORSE * best.rms_of_records
