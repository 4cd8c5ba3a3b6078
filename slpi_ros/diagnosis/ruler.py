"""The criterion of a diagnosis: which of two joint fits predicts better what was not fitted."""

from collections.abc import Sequence
from functools import cache

import numpy as np
from scipy.special import stdtr

from slpi_ros.arrays import FloatArray
from slpi_ros.diagnosis.held_out import Loss, in_blocks

# Level of significance of all sets that were tried, together.
CHANCE = 0.001
# A contribution below this share of the sensor's noise is not told.
LEAST = 0.1
# Least share, of the mean square that is there as an effect predicts it, that it explains.
EXPLAINED = 0.8
# It acts in blocks with at least this share of the largest contribution.
SMALLEST = 1e-6
# Largest ratio of the errors on a record left out with a set that is better, and without.
NO_WORSE = 1.05
# Random signs of the blocks, and the share of them by which the number of independent sets is estimated.
SURROGATES, TAIL, SIGNED_BLOCKS = 1999, 0.05, 40
# Smallest p-value.
LEAST_CHANCE = 1e-12


def beats(one: Loss, other: Loss, noise: float, trials: float = 1.0, *, contained: bool = True) -> bool:
    """Return whether a joint fit predicts better than another one, by more than chance and `LEAST` of the noise (m).

    And, where the other one is `contained` in it, is clearly worse on no record that is left out: what is added must
    carry over. Of two different causes either may be the better one on some record.
    """
    own, its = one.beside(other)
    fall = float(np.mean(its**2) - np.mean(own**2))
    if not fall > (LEAST * noise) ** 2 or (contained and not carries_over(one, other)):
        return False
    return chance(one, other, trials) <= CHANCE


def carries_over(one: Loss, other: Loss) -> bool:
    """Return whether a joint fit is worse than the other one on no record that is left out."""
    both = np.isfinite(one.records) & np.isfinite(other.records)
    return bool(np.all(one.records[both] <= NO_WORSE**2 * other.records[both]))


def share(one: Loss, without: Loss, noise: float) -> float:
    """Return the share that an effect explains of what is there as it predicts it, beyond the noise (m).

    Block by block of the errors without it, the mean square along its contribution: what another cause leaves beside
    it does not count, and what imitates another cause fits some blocks and not others.
    """
    own, its = one.beside(without)
    d = its - own
    size, left, there = in_blocks(d * d), in_blocks(d * own), in_blocks(d * its)
    acts = size > SMALLEST * size.max(initial=0.0)
    if not acts.any():
        return 0.0
    left_square, there_square = (float(np.sum(each[acts] ** 2 / size[acts] - noise**2)) for each in (left, there))
    return 1.0 - left_square / there_square if there_square > 0.0 else 0.0


def chance(one: Loss, other: Loss, trials: float = 1.0) -> float:
    """Return the probability that a fit that is no better looks so much better, as the best of `trials` ones."""
    alone = min(1.0, 2.0 * min(_by_products(one, other), _by_shares(one, other)))
    return float(max(-np.expm1(trials * np.log1p(-min(alone, 1.0 - 1e-12))), LEAST_CHANCE))


def _by_products(one: Loss, other: Loss) -> float:
    """Return the p-value of the fall of the squares, for what acts in few blocks.

    With the difference ``d`` of the predictions the squares differ by ``d^2 + 2 d e``, where ``e`` are the errors of
    the better fit: chance is in the products ``d e`` alone.
    """
    e, without = one.beside(other)
    products, fall = in_blocks((without - e) * e), float(np.sum(without**2 - e**2))
    return _p_value(fall, 2.0 * float(np.sqrt(np.sum(products**2))), products.size, _in_a_row(products))


def _by_shares(one: Loss, other: Loss) -> float:
    """Return the p-value of the mean share by which the squares of a block fall, whatever their size.

    Blocks are independent that are longer than errors are alike.
    """
    errors = one.beside(other)
    a, b = (in_blocks(each**2) for each in errors)
    shares = (b - a) / np.maximum(a + b, 1e-300)
    around = shares - shares.mean()
    row = max(alike_in_a_row(each) for each in errors) * shares.size / errors[0].size
    return _p_value(float(np.sum(shares)), float(np.sqrt(np.sum(around**2))), shares.size, max(row, 1.0))


def _p_value(gain: float, deviation: float, count: int, row: float) -> float:
    """Return the one-sided p-value of a sum over `count` blocks, of which `row` successive ones are alike."""
    if not deviation > 0.0:
        return LEAST_CHANCE if gain > 0.0 else 1.0
    return float(stdtr(max(count / row - 1.0, 1.0), -gain / (deviation * np.sqrt(row))))


def independent_trials(before: FloatArray, tried: Sequence[FloatArray]) -> float:
    """Return the number of independent sets whose best gain is by chance as large as that of those `tried`.

    `before` and `tried` are sums of squares of blocks, shape (blocks,), without them and with each. From the maximum
    over all sets for random signs of the blocks: Westfall and Young, Resampling-Based Multiple Testing, Wiley 1993,
    Sec. 2.6.
    """
    if not tried:
        return 1.0
    parts = np.array_split(np.arange(before.size), min(SIGNED_BLOCKS, before.size))
    gains = np.array([[float(np.sum((before - after)[own])) for own in parts] for after in tried])
    largest, count = np.abs(gains).max(axis=1), len(parts)
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


def alike_in_a_row(errors: FloatArray) -> float:
    """Return the number of samples per independent error, from the autocorrelation up to its first zero."""
    return _in_a_row(errors - errors.mean())


def _in_a_row(values: FloatArray) -> float:
    power = np.abs(np.fft.rfft(values, 2 * values.size)) ** 2
    correlation = np.fft.irfft(power)[: values.size]
    if not correlation[0] > 0.0:
        return 1.0
    correlation = correlation / correlation[0]
    positive = int(np.argmax(correlation <= 0.0)) or correlation.size
    return float(max(1.0, 2.0 * correlation[:positive].sum() - 1.0))
