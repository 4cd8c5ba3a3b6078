"""A pass of a path that repeats: is its measurement to be believed, and which samples of it are a bump."""

import math
from dataclasses import dataclass

import numpy as np

from slpi_ros.arrays import FloatArray, Mask

# Standard deviations beyond which a sample is a bump, or a whole pass no answer to what was commanded.
UNLIKELY = 6.0
# A reading follows the path with at least this correlation coefficient: less is another axis's, or noise.
LEAST_CORRELATION = 0.7
# A sensor is frozen where it says one value while the path moves by this share of its range.
FROZEN_SHARE = 0.1
# Samples on either side of a bump that go with it; more than this share of a pass is no bump. Largest share of samples
# without a reading.
BESIDE, MOST_BUMP, MOST_MISSING = 3, 0.25, 0.1
# Samples in a row at a voltage limit that count as held there, and share of the range by which it is reached.
HELD_SAMPLES, AT_LIMIT = 3, 1e-6


@dataclass(frozen=True)
class Judged:
    """What a pass says: the readings (m, (N,)) to learn from, or why there are none."""

    measured: FloatArray
    bumps: Mask  # samples, (N,), that were replaced by what was expected
    deviating: Mask | None  # samples, (N,), that deviate from what was expected; None: nothing was
    reason: str = ""  # why the pass is not learned from; "": it is


def judge(
    measured: FloatArray, desired: FloatArray, expected: FloatArray | None, spread: float, noise: float,
    before: Mask | None, error: float,
) -> Judged:  # fmt: skip
    """Judge the readings of a pass.

    Parameters
    ----------
    measured, desired : ndarray, shape (N,), metres
        NaN where there is no reading.
    expected : ndarray, shape (N,), metres, or None
        What the passes before lead one to expect; None before the first pass.
    spread, noise : float, metres
        Standard deviation of a reading about `expected` (infinite: that is but the pass before), and its sensor noise.
    before : ndarray of bool, shape (N,), or None
        Samples that deviated in the pass before.
    error : float, metres
        Rms error of the pass before; a pass may deviate by as much.
    """
    nowhere, known = np.zeros(measured.size, dtype=np.bool_), np.isfinite(measured)
    missing = 1.0 - float(np.mean(known))
    reason = f"{100 * missing:.0f} % of its samples have no reading" if missing > MOST_MISSING else ""
    if reason := reason or _lies(measured[known], desired[known], noise):
        return Judged(measured, nowhere, None, reason)
    if expected is None:
        return Judged(_replaced(measured, desired, ~known), ~known, None)
    surprise = np.where(known, measured - expected, 0.0)
    surprise -= np.median(surprise[known])
    first = math.isinf(spread)
    scale = max(float(np.median(np.abs(surprise[known]))) / 0.6745, noise, 0.0 if first else 0.5 * spread)
    deviating = np.abs(surprise) > UNLIKELY * scale
    bumps = _widened(deviating)
    if before is not None:
        # What deviates in two passes at the same samples repeats, and is learned.
        bumps &= ~_widened(before)
    if first:
        # Of two passes nothing tells which one has the bump: the one that errs less is believed.
        errors = [np.abs(x - desired - np.median((x - desired)[known])) for x in (expected, measured)]
        # What has not settled since the beginning of the first pass is no bump.
        settling = np.arange(bumps.size) <= int(np.argmin(_widened(deviating)))
        bumps = _widened(deviating & (errors[0] < errors[1]) & ~settling)
    if float(np.mean(bumps)) > MOST_BUMP:
        bumps = nowhere
    bumps = bumps | ~known
    rms = math.sqrt(float(np.mean(surprise[~bumps] ** 2)))
    if rms > UNLIKELY * spread and rms > error:
        reason = f"the reading does not answer to what was commanded: {1e9 * rms:.3g} nm rms from what was expected"
        return Judged(measured, nowhere, deviating, reason)
    return Judged(_replaced(measured, expected, bumps), bumps, deviating)


def held_back(voltage: FloatArray, limits: tuple[float, float]) -> str:
    """Return that a limit held the voltage (V, (N,)) back; "" if none did."""
    (low, high), margin = limits, AT_LIMIT * (limits[1] - limits[0])
    at = (voltage <= low + margin) | (voltage >= high - margin)
    runs = np.convolve(at, np.ones(HELD_SAMPLES), "valid") >= HELD_SAMPLES - 0.5
    return f"the voltage is held at a limit at {int(np.count_nonzero(at))} of its samples" if runs.any() else ""


def _lies(seen: FloatArray, wanted: FloatArray, noise: float) -> str:
    """Return what is wrong with a sensor that does not follow the path at all; "" if it does."""
    moved = float(np.ptp(wanted))
    if moved <= UNLIKELY * noise:
        return ""
    starts = np.flatnonzero(np.append(True, np.diff(seen) != 0.0))
    for begin, end in zip(starts, np.append(starts[1:], seen.size), strict=True):
        if end - begin > 2 and np.ptp(wanted[begin:end]) > max(FROZEN_SHARE * moved, UNLIKELY * noise):
            return f"the sensor is frozen for {end - begin} samples while the path moves"
    wanted, seen = wanted - wanted.mean(), seen - seen.mean()
    spread = float(np.sqrt((wanted @ wanted) * (seen @ seen)))
    alike = float(wanted @ seen) / spread if spread > 0.0 else 0.0
    if alike < LEAST_CORRELATION:
        return f"the sensor does not follow the path (correlation {alike:.2f}): is its sign wrong, or its axis?"
    return ""


def _widened(mask: Mask) -> Mask:
    return np.asarray(np.convolve(mask, np.ones(2 * BESIDE + 1), "same") > 0.5)


def _replaced(measured: FloatArray, expected: FloatArray, bumps: Mask) -> FloatArray:
    """Return the readings with what was expected in the place of bumps, at the level of the others."""
    if not bumps.any():
        return measured
    level = float(np.mean((measured - expected)[~bumps])) if not bumps.all() else 0.0
    return np.where(bumps, expected + level, measured)
