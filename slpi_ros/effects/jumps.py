"""Sudden shifts of a noisy signal that stay."""

from math import comb

import numpy as np

from slpi_ros.arrays import FloatArray, IntArray
from slpi_ros.hysteresis.reversals import reversals

# Shortest length of the lines on either side of a jump (samples), and the longest as a share of the signal.
SHORTEST, LONGEST = 16, 1 / 16
# Size of a jump, and of one whose place is sought, relative to the usual distance of two lines of that length.
LEAST, SEEN = 8.0, 5.0
# Smallest and largest share of a jump that happens within a few samples; places that are tried for each jump.
SHARP, TRIES = (0.5, 2.0), 4
# Samples within which a jump follows a turn or a jump of the voltage, each tried, as a stage that rings jumps late;
# shares of the voltage range of the smallest turn and of the smallest jump of one sample; probability below which jumps
# are there by more than chance.
NEAR, TURN, LEAP, CHANCE = (8, 16, 32, 64), 0.01, 0.02, 0.01


def jumps(x: FloatArray, most: int) -> list[tuple[int, float]]:
    """Return the first sample and the size of up to `most` sudden shifts of `x`, shape (N,), the clearest first."""
    # A jump is the distance, at one place, of the lines fitted to the samples before and after it. Lines, so that drift
    # is none; relative to the usual distance at all places, so that whatever is everywhere is none, noise included.
    left, found = x - np.mean(x), dict[int, float]()
    widths = [SHORTEST]
    while 2 * widths[-1] <= LONGEST * x.size:
        widths.append(2 * widths[-1])
    # Where a change is gradual, no jump is sought any more.
    gradual = np.zeros(x.size + 1, dtype=bool)
    for _ in range(TRIES * most if x.size >= 4 * SHORTEST else 0):
        if len(found) == most:
            break
        scores = [_scores(left, width) for width in widths]
        for width, (score, _) in zip(widths, scores, strict=True):
            score[gradual[width : x.size - width + 1]] = 0.0
        best = max(range(len(widths)), key=lambda one: float(np.max(np.abs(scores[one][0]))))
        k = widths[best] + int(np.argmax(np.abs(scores[best][0])))
        score, usual = scores[best]
        if not abs(score[k - widths[best]]) >= LEAST:
            break
        size = float(score[k - widths[best]]) * usual
        # Shorter lines tell the place better, as long as they show the jump.
        reach = widths[best]
        for one in reversed(range(best)):
            first = max(k - reach - widths[one], 0)
            near = np.abs(scores[one][0][first : max(k + reach - widths[one], first + 1)])
            if not near.size or near.max() < SEEN:
                break
            k, reach = first + widths[one] + int(np.argmax(near)), widths[one]
        k = _divide(left, k, reach)
        if not sudden(left, k, size):
            gradual[max(k - widths[best], 0) : k + widths[best]] = True
            continue
        k = next((other for other in found if abs(other - k) < SHORTEST), k)
        found[k] = found.get(k, 0.0) + size
        left = left - size * (np.arange(x.size) >= k)
    return list(found.items())


def _scores(x: FloatArray, width: int) -> tuple[FloatArray, float]:
    """Return the distances at samples `width` .. N - `width`, of lines before and after, in units of the usual one."""
    at = np.arange(x.size + 1)
    total, moment = np.append(0.0, np.cumsum(x)), np.append(0.0, np.cumsum(x * at[:-1]))
    sums = total[width:] - total[:-width]
    slopes = moment[width:] - moment[:-width] - (at[: sums.size] + 0.5 * (width - 1)) * sums
    # Mean of a line, and its rise from the middle to the end.
    mean, rise = sums / width, slopes * 6.0 / (width**2 - 1.0)
    apart = (mean - rise)[width:] - (mean + rise)[:-width]
    usual = max(1.4826 * float(np.median(np.abs(apart))), 1e-300)
    return apart / usual, usual


def _divide(x: FloatArray, k: int, reach: int) -> int:
    """Return the sample near `k` before and after which the means within `reach` differ most."""
    first = max(k - reach, 0)
    part = x[first : k + reach]
    before = np.arange(1, part.size)
    total = np.cumsum(part)
    after = part.size - before
    apart = (total[-1] - total[:-1]) / after - total[:-1] / before
    return first + 1 + int(np.argmax(apart**2 * before * after))


def sudden(x: FloatArray, k: int, size: float) -> bool:
    """Return whether a jump of `size` at sample `k` of `x`, shape (N,), happens within a few samples."""
    return SHARP[0] <= _sharpness(x, k, size) <= SHARP[1]


def _sharpness(x: FloatArray, k: int, size: float) -> float:
    """Return the share of a jump of `size` at sample `k` of `x`, shape (N,), that happens within a few samples."""
    noise = 1.4826 * float(np.median(np.abs(np.diff(x, 2)))) / 6.0**0.5
    # As many as make its noise less than a fifth of the size, and the place need not be exact.
    few = int(np.clip(64.0 * (noise / max(abs(size), 1e-300)) ** 2, 6, 8 * SHORTEST))
    before, after = x[max(k - few, 0) : k], x[k : k + few]
    return float(np.mean(after) - np.mean(before)) / size if before.size and after.size else 0.0


def follows_drive(places: IntArray, v: FloatArray) -> bool:
    """Return whether samples `places` are at turns or jumps of the voltage `v`, shape (N,), by more than chance."""
    span = float(np.ptp(v))
    events = np.concatenate([reversals(v, TURN * span), np.flatnonzero(np.abs(np.diff(v)) > LEAP * span) + 1])
    return any(_are_near(places, events, v.size, reach) for reach in NEAR)


def _are_near(places: IntArray, events: IntArray, size: int, reach: int) -> bool:
    """Return whether most of the `places` are within `reach` samples after `events`, by more than chance."""
    mark = np.zeros(size + 1)
    # A turn of a sampled voltage is known within some samples.
    np.add.at(mark, np.maximum(events - NEAR[0], 0), 1.0)
    np.add.at(mark, np.minimum(events + reach + 1, size), -1.0)
    near = np.cumsum(mark)[:-1] > 0
    share, count, there = float(near.mean()), places.size, int(near[places].sum())
    return 2 * there > count and comb(count, there) * share**there < CHANCE / len(NEAR)
