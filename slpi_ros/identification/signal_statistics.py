"""Statistics of sensor readings: error metrics, resolution and noise; noise removal for a voltage."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.ndimage import uniform_filter1d

from slpi_ros.arrays import FloatArray
from slpi_ros.errors import UsageError
from slpi_ros.hysteresis.reversals import without_small_reversals


@dataclass(frozen=True)
class ErrorMetrics:
    """Error metrics (m) of a model against a measurement, or of a measurement against a setpoint."""

    # The "mean square error" of the MPI paper is `root_mean_square` throughout: Tables 2 and 4, 0.1201 µm (feedforward)
    # and 0.2949 µm (feedforward and PID). Its unit is µm, and it exceeds the mean absolute error, as an rms must. A
    # mean square cannot exceed the product of maximum and mean absolute error, but the values in Table 2 from 20 to 100
    # V, in Table 4 at 20 and 40 V, and 0.1201 do. The value at 120 V matches R² = 0.9996 (Table 3) only as an rms.
    maximum: float
    mean: float  # of the absolute errors
    root_mean_square: float
    mean_square: float  # m²
    r_squared: float  # ``R² = 1 - SSE / SST``, MPI paper, Eq. 3


def error_metrics(measured: ArrayLike, model: ArrayLike) -> ErrorMetrics:
    """Compute the errors of a model against a measurement, or of a measurement against a setpoint, (N,), metres."""
    y, y_model = np.asarray(measured, dtype=np.float64), np.asarray(model, dtype=np.float64)
    if y.ndim != 1 or y.shape != y_model.shape or y.size == 0:
        raise UsageError(f"error metrics: {y.shape} measured and {y_model.shape} modelled values; give as many of each")
    if not (np.isfinite(y).all() and np.isfinite(y_model).all()):
        raise UsageError("error metrics: values that are not finite; leave such samples out")
    total = np.sum((y - y.mean()) ** 2)
    if not total > 0.0:
        raise UsageError(f"error metrics: all measured values are {y[0]:g} m; R² needs some variation")
    error = np.abs(y - y_model)
    mean_square = float(np.mean(error**2))
    return ErrorMetrics(
        maximum=float(error.max()),
        mean=float(error.mean()),
        root_mean_square=float(np.sqrt(mean_square)),
        mean_square=mean_square,
        r_squared=float(1.0 - np.sum(error**2) / total),
    )


# Number of readings from which noise and resolution are estimated.
ENOUGH = 100_000
# Fewest differences that determine their rms to 10 %.
FEWEST = 100


def digit(x: FloatArray) -> float:
    """Return the resolution of readings `x`, shape (N,), in their unit; 0 if they are continuous."""
    # The resolution is the largest step of which (nearly) all small differences between sorted readings are multiples.
    differences = np.diff(np.sort(x[:: max(1, x.size // ENOUGH)]))
    differences = differences[differences > 0.0]
    if differences.size < 5:
        return 0.0
    for step in np.unique(np.quantile(differences, (0.02, 0.1, 0.25, 0.5, 0.75)))[::-1].tolist():
        multiples = differences[differences < 30.0 * step] / step
        whole = np.rint(multiples)
        if multiples.size > 0.5 * differences.size and np.mean(np.abs(multiples - whole) < 0.05) > 0.97:
            return float(step * multiples[whole > 0].sum() / whole.sum())
    return 0.0


def spread(x: FloatArray) -> float:
    """Return the range of readings `x`, shape (N,), between the 1st and 99th percentile."""
    low, high = np.percentile(x[:: max(1, x.size // ENOUGH)], (1, 99))
    return float(high - low) or float(np.ptp(x))


def median_rms(deviation: FloatArray) -> float:
    """Return a robust standard deviation, from the median absolute value of `deviation`; 0 if most values are 0."""
    return float(1.4826 * np.median(np.abs(deviation)))


def noise(x: FloatArray, *drivers: FloatArray) -> float:
    """Return the robust rms of the noise from reading to reading, in the unit of `x`, shape (N,), N >= 5."""
    # The smallest of several estimates: deviations from a line or a cubic through the neighbours, and from a line over
    # each of the `drivers`, signals that the readings follow, which allows for uneven sampling. Curvature of the signal
    # increases each estimate; medians reduce this effect. Noise correlated over several samples is not detected.
    every = max(1, x.size // ENOUGH)
    far_before, before, own, after, far_after = (x[first : x.size - 4 + first : every] for first in range(5))
    line = 0.5 * (before + after) - own
    curve = (4.0 * (before + after) - (far_before + far_after)) / 6.0 - own
    estimates = [median_rms(line) / np.sqrt(1.5), median_rms(curve) / np.sqrt(35.0 / 18.0)]
    for driver in drivers:
        start, middle, end = (driver[first : x.size - 4 + first : every] for first in (1, 2, 3))
        with np.errstate(divide="ignore", invalid="ignore"):
            w = (end - middle) / (end - start)
        between = (w > 0.0) & (w < 1.0)
        if np.count_nonzero(between) > 0.2 * own.size:
            w = w[between]
            off = w * before[between] + (1.0 - w) * after[between] - own[between]
            estimates.append(median_rms(off / np.sqrt(1.0 + w**2 + (1.0 - w) ** 2)))
    return float(min(estimates))


# Lengths (samples) of the pieces whose spectra are pooled: the longest one, and the shortest that has a spectrum.
_LONGEST, _SHORTEST = 1024, 64


def white_noise(x: FloatArray) -> float:
    """Return the rms of the white noise in `x`, shape (N,): the level between the lines of its spectrum's top octave.

    `x` is a residual, or a signal that is smooth from sample to sample. Values that are not finite are left out.
    """
    x = x[np.isfinite(x)]
    length = min(_LONGEST, x.size)
    if length < _SHORTEST:
        return median_rms(np.diff(x)) / np.sqrt(2.0) if x.size > 1 else 0.0
    pieces = x[: x.size // length * length].reshape(-1, length)
    window = np.hanning(length)
    power = np.abs(np.fft.rfft((pieces - pieces.mean(axis=1, keepdims=True)) * window)) ** 2 / np.sum(window**2)
    # Power at one frequency is distributed exponentially, with a median of log 2 times its mean.
    return float(np.sqrt(np.median(power[:, length // 4 : (length - 1) // 2 + 1]) / np.log(2.0)))


# Range of plausible noise of a measured voltage, as shares of its range: a commanded voltage has less, motion more.
LEAST_NOISE, MOST_NOISE = 1e-4, 5e-3
# Orders of the differences that leave only noise.
_ORDERS = (3, 4, 5, 6)
# Window lengths (samples) of the parabolas that replace readings; the largest window that fits is used.
_WINDOWS = (5, 9, 17, 33, 65, 129)
# Dead band for reversals, in standard deviations of the noise.
_DEAD_BAND = 2.0


def voltage_noise(t: FloatArray, v: FloatArray) -> float:
    """Return the noise (V rms) of a measured voltage, shape (N,), volts, by high-order differences; 0 if commanded."""
    if v.size <= max(_ORDERS):
        return 0.0
    level = _level(t, v)
    # A command that is read more often than it is sent is a staircase, whose steps are no noise: those of noise are
    # there without the readings that repeat the one before, too.
    fresh = np.diff(v, prepend=np.nan) != 0.0
    if level and max(_ORDERS) < np.count_nonzero(fresh) < v.size:
        level = min(level, _level(t[fresh], v[fresh]))
    span = float(np.ptp(v))
    return level if LEAST_NOISE * span < level < MOST_NOISE * span else 0.0


def _level(t: FloatArray, v: FloatArray) -> float:
    """Return the smallest estimate of the noise (V rms) by differences of several orders."""
    part = v[:ENOUGH]
    estimates = [noise(v, t)]
    for order in _ORDERS:
        # The squares of the binomial coefficients of a difference add up to the central binomial coefficient.
        size = np.sqrt(_central_binomial(order))
        estimates.append(float(1.4826 * np.median(np.abs(np.diff(part, order)))) / size)
    return min(estimates)


def _central_binomial(order: int) -> float:
    k = np.arange(1, order + 1)
    return float(np.prod((order + k) / k))


def without_noise(t: FloatArray, v: FloatArray) -> FloatArray:
    """Return a voltage, shape (N,), volts, with measurement noise removed; a commanded voltage is unchanged."""
    # Each reading is replaced by a parabola over the largest window that fits within the noise. Remaining reversals
    # within the noise are flattened.
    noise = voltage_noise(t, v)
    if not noise:
        return v
    # SciPy's signal package takes half a second to load, and a commanded voltage does not need it.
    from scipy.signal import savgol_filter

    smooth = v
    for window in _WINDOWS:
        if window > v.size:
            break
        parabola = savgol_filter(v, window, 2)
        off = uniform_filter1d((v - parabola) ** 2, window, mode="nearest")
        # The parabola takes part of the noise, and the mean square of few readings scatters.
        explained = noise**2 * (1.0 - _weight_of_own(window)) * (1.0 + np.sqrt(2.0 / window)) ** 2
        smooth = np.where(off < explained, parabola, smooth)
    # A parabola overshoots where the voltage reaches a limit of the amplifier.
    return without_small_reversals(np.clip(smooth, v.min(), v.max()), _DEAD_BAND * noise)


def _weight_of_own(window: int) -> float:
    """Return the weight of the middle reading of a window in the value of the fitted parabola at that reading."""
    n = window // 2
    return 3.0 * (3.0 * n * (n + 1) - 1.0) / ((2 * n + 3) * (2 * n + 1) * (2 * n - 1))
