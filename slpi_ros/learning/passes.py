"""A pass of a path that repeats: is its measurement to be believed, and which samples of it are a bump."""

import math
from dataclasses import dataclass

import numpy as np

from slpi_ros.arrays import FloatArray, Mask

# A reading follows the path with at least this correlation coefficient: less is another axis's, or noise.
LEAST_CORRELATION = 0.7
# A sensor is frozen where it says one value while the path moves by this share of its range and ten times the noise.
FROZEN_SHARE, FROZEN_ABOVE_NOISE = 0.1, 10.0
# A reading is late by a share of its deviation, explained by a shift in time; it has jumped, explained by one step.
LATE_SHARE, JUMP_SHARE = 0.5, 0.6
# Share of the error of the pass before that a jump exceeds, over `UNEXPECTED`.
JUMP_OF_ERROR = 0.05
# Share of a pass at both its ends where a step is taken for something that settles.
JUMP_INSIDE = 0.1
# A pass does not answer to what was commanded from this many times the expected deviation on.
UNEXPECTED = 6.0
# Samples beyond this many (robust) standard deviations are a bump; their neighbours within `BESIDE` go with them; more
# than this share of a pass is no bump.
BUMP, BESIDE, MOST_BUMP = 6.0, 3, 0.25
# Largest share of the first two passes in which one of them may have a bump.
MOST_SUDDEN = 0.1
# Largest share of samples without a reading.
MOST_MISSING = 0.1
# Samples of the running median that finds a glitch in the first pass.
MEDIAN = 5
# Samples in a row at a voltage limit that count as held there, and share of the range by which it is reached.
HELD_SAMPLES, AT_LIMIT = 3, 1e-6


@dataclass(frozen=True)
class Judged:
    """What a pass says: the readings (m, (N,)) to learn from, or why there are none."""

    measured: FloatArray
    bumps: Mask  # samples, (N,), that were replaced by what was expected
    deviating: Mask  # samples, (N,), that deviate from what was expected, whether or not they were replaced
    reason: str = ""  # why the pass is not learned from; "": it is


def judge(
    measured: FloatArray, expected: FloatArray, spread: float, noise: float, before: Mask | None, error: float
) -> Judged:
    """Judge the readings of a pass.

    Parameters
    ----------
    measured : ndarray, shape (N,), metres
        NaN where there is no reading.
    expected : ndarray, shape (N,), metres
        What the passes before lead one to expect; before the first pass, the desired path.
    spread, noise : float, metres
        Standard deviation of a reading about `expected`, and its sensor noise.
    before : ndarray of bool, shape (N,), or None
        Samples that deviated in the pass before; None before the first pass.
    error : float, metres
        Rms error of the pass before; a pass may deviate by as much. Infinite before the first pass.
    """
    nowhere = np.zeros(measured.size, dtype=np.bool_)
    known = np.isfinite(measured)
    missing = 1.0 - float(np.mean(known))
    if missing > MOST_MISSING:
        return Judged(measured, nowhere, nowhere, f"{100 * missing:.0f} % of its samples have no reading")
    if reason := _lies(np.where(known, measured, np.nan), known, expected, noise):
        return Judged(measured, nowhere, nowhere, reason)
    surprise = np.where(known, measured - expected, 0.0)
    surprise -= np.median(surprise[known])
    if not math.isfinite(spread):
        # Nothing tells a bump of the first pass from what its turns excite, but the second: there it is once more.
        glitches = _glitches(surprise, noise)
        bumps = ~known if before is None else (glitches & ~_widened(before)) | ~known
        return Judged(_replaced(measured, expected, bumps), bumps, glitches)
    scale = max(float(np.median(np.abs(surprise[known]))) / 0.6745, noise, 0.5 * spread)
    deviating = np.abs(surprise) > BUMP * scale
    # What deviates in two passes at the same samples repeats, and is learned.
    repeated = nowhere if before is None else _widened(before)
    bumps = _widened(deviating) & ~repeated if deviating.any() else nowhere
    if float(np.mean(bumps)) > MOST_BUMP:
        bumps = nowhere
    bumps = bumps | ~known
    rms = math.sqrt(float(np.mean(surprise[~bumps] ** 2)))
    if rms > UNEXPECTED * spread and rms > error:
        return Judged(measured, nowhere, deviating, _why(surprise, expected))
    step = _step(surprise, max(spread, JUMP_OF_ERROR * error))
    if step and not (before is not None and before.any()):
        return Judged(measured, nowhere, deviating, step)
    return Judged(_replaced(measured, expected, bumps), bumps, deviating)


def agreed(first: FloatArray, second: Judged, desired: FloatArray, noise: float) -> Judged:
    """Return the second pass with what the first one (m, (N,)) says instead where they differ and it errs less.

    Of two passes nothing tells which one has the bump. Where they differ, the next pass is not taken for a bump.
    """
    differing = second.measured - first
    differing -= np.median(differing)
    scale = max(float(np.median(np.abs(differing))) / 0.6745, noise)
    apart = np.abs(differing) > BUMP * scale
    # What has not settled since the beginning of the first pass is no bump.
    settling = np.arange(apart.size) <= int(np.argmin(_widened(apart)))
    errors = [x - desired - np.median(x - desired) for x in (first, second.measured)]
    better = _widened(apart & ~settling & (np.abs(errors[0]) < np.abs(errors[1])))
    if not better.any() or float(np.mean(better)) > MOST_SUDDEN:
        return Judged(second.measured, second.bumps, apart)
    instead = first + np.median(second.measured - first)
    return Judged(np.where(better, instead, second.measured), second.bumps | better, apart)


def held_back(voltage: FloatArray, limits: tuple[float, float]) -> str:
    """Return that a limit held the voltage (V, (N,)) back; "" if none did."""
    (low, high), margin = limits, AT_LIMIT * (limits[1] - limits[0])
    at = (voltage <= low + margin) | (voltage >= high - margin)
    runs = np.convolve(at, np.ones(HELD_SAMPLES), "valid") >= HELD_SAMPLES - 0.5
    return f"the voltage is held at a limit at {int(np.count_nonzero(at))} of its samples" if runs.any() else ""


def _lies(measured: FloatArray, known: Mask, expected: FloatArray, noise: float) -> str:
    """Return what is wrong with a sensor that does not follow the path at all; "" if it does."""
    wanted, seen = expected[known], measured[known]
    moved = float(np.ptp(wanted))
    if moved <= FROZEN_ABOVE_NOISE * noise:
        return ""
    starts = np.flatnonzero(np.append(True, np.diff(seen) != 0.0))
    for begin, end in zip(starts, np.append(starts[1:], seen.size), strict=True):
        if end - begin > 2 and np.ptp(wanted[begin:end]) > max(FROZEN_SHARE * moved, FROZEN_ABOVE_NOISE * noise):
            return f"the sensor is frozen for {end - begin} samples while the path moves"
    wanted, seen = wanted - wanted.mean(), seen - seen.mean()
    spread = float(np.sqrt((wanted @ wanted) * (seen @ seen)))
    alike = float(wanted @ seen) / spread if spread > 0.0 else 0.0
    if alike < -LEAST_CORRELATION:
        return "the sensor says the opposite of the path: its sign is flipped"
    if alike < LEAST_CORRELATION:
        return f"the sensor does not follow the path (correlation {alike:.2f}): is it that of another axis?"
    return ""


def _why(surprise: FloatArray, expected: FloatArray) -> str:
    """Return what a deviation that is too large looks like."""
    rate = np.gradient(expected)
    power, whole = float(rate @ rate), float(surprise @ surprise)
    shift = float(surprise @ rate) / power if power > 0.0 else 0.0
    if shift * shift * power > LATE_SHARE * whole:
        return (
            f"the reading is {'late' if shift < 0.0 else 'early'} by {abs(shift):.2g} samples against the passes before"
        )
    return _step(surprise, 0.0) or "the reading does not answer to what was commanded"


def _step(surprise: FloatArray, spread: float) -> str:
    """Return that the zero has jumped within the pass, if one step explains the deviation; else ""."""
    n = surprise.size
    before, at = np.cumsum(surprise)[:-1], np.arange(1, n)
    size = (surprise.sum() - before) / (n - at) - before / at
    explained = size**2 * at * (n - at) / n
    inside = (at > JUMP_INSIDE * n) & (at < (1.0 - JUMP_INSIDE) * n)
    k = int(np.argmax(np.where(inside, explained, 0.0)))
    whole = float(np.sum((surprise - surprise.mean()) ** 2))
    # A jump is sudden: the samples on either side of it differ by as much as the halves of the pass do.
    sudden = float(np.mean(surprise[k + 1 : k + 3]) - np.mean(surprise[max(k - 1, 0) : k + 1]))
    if abs(sudden) < JUMP_SHARE * abs(size[k]):
        return ""
    if abs(size[k]) > UNEXPECTED * spread and explained[k] > JUMP_SHARE * whole:
        return f"the reading jumps by {1e9 * size[k]:.3g} nm at sample {k + 1}"
    return ""


def _glitches(surprise: FloatArray, noise: float) -> Mask:
    """Return the samples that stand out from their neighbours, (N,)."""
    half = MEDIAN // 2
    smooth = np.median(np.lib.stride_tricks.sliding_window_view(np.pad(surprise, half, "edge"), MEDIAN), axis=1)
    rough = np.abs(surprise - smooth)
    return np.asarray(rough > 1.5 * BUMP * max(float(np.median(rough)) / 0.6745, noise))


def _widened(mask: Mask) -> Mask:
    return np.asarray(np.convolve(mask, np.ones(2 * BESIDE + 1), "same") > 0.5)


def _replaced(measured: FloatArray, expected: FloatArray, bumps: Mask) -> FloatArray:
    """Return the readings with what was expected in the place of bumps, at the level of the others."""
    if not bumps.any():
        return measured
    level = float(np.mean((measured - expected)[~bumps])) if not bumps.all() else 0.0
    return np.where(bumps, expected + level, measured)
