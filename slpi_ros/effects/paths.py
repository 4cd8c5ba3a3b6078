"""Compiled batch evaluation of effects with a state that changes from sample to sample."""

from math import exp

import numpy as np
from numpy.typing import NDArray

from slpi_ros.hysteresis.compiled import compiled

FloatArray = NDArray[np.float64]


@compiled
def settled_rate(t: FloatArray, v: FloatArray, settling: float) -> FloatArray:
    """Return the rate (V/s) of `v` (V) at times `t` (s), shape (N,) each, low-pass filtered over `settling` (s).

    It starts at 0. Between samples `v` is linear, so that the rate of a step does not act before the step.
    """
    settled, now = np.zeros_like(v), 0.0
    for k in range(1, v.size):
        dt = t[k] - t[k - 1]
        if dt > 0.0:
            rate = abs(v[k] - v[k - 1]) / dt
            now = rate + (now - rate) * (exp(-dt / settling) if settling else 0.0)
        settled[k] = now
    return settled


@compiled
def play(v: FloatArray, half_width: FloatArray) -> FloatArray:
    """Return the output of a play operator for a path `v` and a varying half-width, shape (N,) each, volts."""
    seen, now = np.empty_like(v), v[0] if v.size else 0.0
    for k in range(v.size):
        now = min(max(now, v[k] - half_width[k]), v[k] + half_width[k])
        seen[k] = now
    return seen


def smoothed(signal: FloatArray, count: int) -> FloatArray:
    """Return the mean of a signal over `count` samples around each, shape (N,); its ends go on at their values."""
    from scipy.ndimage import uniform_filter1d

    return np.asarray(uniform_filter1d(signal, max(count, 1), mode="nearest"), dtype=np.float64)


@compiled
def direction(u: FloatArray, transition: float) -> FloatArray:
    """Return the direction of a path, shape (N,), volts, from -1 to 1, smoothed over a voltage `transition` (V)."""
    directions, now = np.empty_like(u), 0.0
    for k in range(u.size):
        moved = u[k] - u[max(k - 1, 0)]
        if moved:
            toward = 1.0 if moved > 0.0 else -1.0
            now = toward + (now - toward) * exp(-abs(moved) / transition)
        directions[k] = now
    return directions


@compiled
def relaxed(moved: FloatArray, gains: FloatArray, holds: FloatArray) -> FloatArray:
    """Return the sum of first-order relaxations of a displacement, shape (N,), metres.

    `gains` has shape (K,); `holds`, shape (K, 3), are coefficients as in `slpi_ros.effects.filters.Hold`.
    """
    crept, before, states = np.empty_like(moved), 0.0, np.zeros(gains.size)
    for k in range(moved.size):
        total = 0.0
        for i in range(gains.size):
            states[i] = holds[i, 0] * moved[k] + holds[i, 1] * before + holds[i, 2] * states[i]
            total += gains[i] * states[i]
        crept[k], before = total, moved[k]
    return crept


@compiled
def unrelaxed(crept: FloatArray, gains: FloatArray, holds: FloatArray) -> FloatArray:
    """Return the displacement, shape (N,), metres, whose sum with its relaxations, as in `relaxed`, is `crept`."""
    moved, last, states = np.empty_like(crept), 0.0, np.zeros(gains.size)
    # `states` are without the part of the present input, which is added with the next sample.
    step, kept, direct = np.empty(gains.size), np.empty(gains.size), 1.0
    for i in range(gains.size):
        step[i], kept[i] = holds[i, 1] + holds[i, 2] * holds[i, 0], holds[i, 2]
        direct += gains[i] * holds[i, 0]
    if crept.size:
        moved[0] = last = crept[0] / direct
    for k in range(1, crept.size):
        total = 0.0
        for i in range(gains.size):
            states[i] = step[i] * last + kept[i] * states[i]
            total += gains[i] * states[i]
        moved[k] = last = (crept[k] - total) / direct
    return moved


@compiled
def smoothed_slope(x: FloatArray) -> FloatArray:
    """Return the change per sample of a signal, shape (N >= 7,), by quadratic fits over seven samples (Savitzky-Golay).

    The first and the last three values are taken from the first and the last fit.
    """
    slope, last = np.empty_like(x), x.size - 4
    for k in range(x.size):
        middle = min(max(k, 3), last)
        linear = quadratic = 0.0
        for i in range(-3, 4):
            linear += i * x[middle + i]
            quadratic += (i * i - 4) * x[middle + i]
        slope[k] = linear / 28.0 + (k - middle) * quadratic / 42.0
    return slope
