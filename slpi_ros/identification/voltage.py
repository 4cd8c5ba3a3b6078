"""A measured voltage without its noise: every reading of noise would be a reversal, and small turns would be lost."""

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter1d
from scipy.signal import savgol_filter

from slpi_ros.hysteresis.runs import without_small_reversals
from slpi_ros.identification import signal_statistics as readings

FloatArray = NDArray[np.float64]

# A commanded voltage has less noise than the first share of its range; what looks like more than the other one is none.
LEAST_NOISE, MOST_NOISE = 1e-4, 5e-3
# Orders of the differences in which noise is all that is left, and readings that are enough to tell it from.
_ORDERS = (3, 4, 5, 6)
_ENOUGH = 100_000
# Samples over which a parabola may take the place of the readings: as many as it fits.
_WINDOWS = (5, 9, 17, 33, 65, 129)
# Reversals up to so many standard deviations are still noise.
_DEAD_BAND = 2.0


def voltage_noise(t: FloatArray, v: FloatArray) -> float:
    """Return the noise (V rms) of a measured voltage, shape (N,), volts; 0 for a commanded one, which has next to none.

    Noise changes from sample to sample; differences of a high order pass over what does so smoothly.
    """
    if v.size <= max(_ORDERS):
        return 0.0
    part = v[:_ENOUGH]
    estimates = [readings.noise(v, t)]
    for order in _ORDERS:
        # The squares of the binomial coefficients of a difference add up to another one.
        size = np.sqrt(_central_binomial(order))
        estimates.append(float(1.4826 * np.median(np.abs(np.diff(part, order)))) / size)
    noise = min(estimates)
    span = float(np.ptp(v))
    return noise if LEAST_NOISE * span < noise < MOST_NOISE * span else 0.0


def _central_binomial(order: int) -> float:
    k = np.arange(1, order + 1)
    return float(np.prod((order + k) / k))


def without_noise(t: FloatArray, v: FloatArray) -> FloatArray:
    """Return a voltage, shape (N,), without the noise of its measurement; a commanded one as it is.

    Each reading gives way to a parabola through those around it, as many as lie on it but for their noise. What still
    turns back by no more than the noise is flattened.
    """
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
