"""Reference path for the evaluation of models and of the compensation."""

import math

import numpy as np
from numpy.typing import NDArray

from slpi_ros.errors import UsageError

FloatArray = NDArray[np.float64]

_TONES_HZ = (0.23, 0.61, 1.37)
_SMOOTHING_S = 0.05


def scan_path(
    y_min: float, y_max: float, *, duration: float = 30.0, rate: float = 200.0, seed: int = 0
) -> tuple[FloatArray, FloatArray]:
    """Return a smooth random path of desired displacements that differs from calibration drives.

    Parameters
    ----------
    y_min, y_max : float, metres
        Limits of the path, which rises from `y_min`.
    duration : float, seconds
        Time of the last sample, at least 4 s, divided equally into a sum of sines, ramps as in a raster scan, and
        random reversals.
    rate : float, hertz
        Samples per second.
    seed : int
        The same seed gives the same path.

    Returns
    -------
    t : ndarray, shape (N,), seconds
        Times from 0 to `duration`.
    y : ndarray, shape (N,), metres
        Desired displacements.

    Raises
    ------
    UsageError
        If the limits are not in order or the duration is below 4 s.
    """
    if not -math.inf < y_min < y_max < math.inf:
        raise UsageError(f"scan path: limits {y_min} m and {y_max} m; the first must be the lower one")
    if not (0 < duration < math.inf and 0 < rate < math.inf):
        raise UsageError(f"scan path: {duration} s at {rate} Hz; both must be more than 0")
    if duration < 4:
        raise UsageError(f"scan path: {duration} s are too short for its three parts; give at least 4 s")
    rng = np.random.default_rng(seed)
    t = np.arange(round(duration * rate) + 1) / rate
    ramps, turns = duration / 3, duration * 2 / 3
    tones = _tones(t, t < ramps, rng)
    start = float(tones[t < ramps][-1])
    knots, levels = _corners(ramps, turns, duration, start, rng)
    path = _smooth(np.where(t < ramps, tones, np.interp(t, knots, levels)), round(_SMOOTHING_S * rate))
    return t, np.clip(y_min + (y_max - y_min) * path, y_min, y_max)


def _tones(t: FloatArray, within: NDArray[np.bool_], rng: np.random.Generator) -> FloatArray:
    """Return a sum of sines, faded in from 0 and scaled to 0..1, for the samples selected by `within`."""
    phases = rng.uniform(0, 2 * np.pi, len(_TONES_HZ))
    wave = sum(np.sin(2 * np.pi * f * t + phase) / f for f, phase in zip(_TONES_HZ, phases, strict=True))
    low, high = np.min(wave[within]), np.max(wave[within])
    fade = (1 - np.cos(np.pi * np.clip(t - _SMOOTHING_S, 0, 1))) / 2
    return np.asarray(np.clip((wave - low) / (high - low), 0, 1) * fade)


def _corners(
    ramps: float, turns: float, end: float, level: float, rng: np.random.Generator
) -> tuple[list[float], list[float]]:
    """Return times and levels of corners: a raster from `ramps` on, random reversals from `turns` to `end`."""
    times, levels = [ramps], [level]
    window = rng.uniform(0.02, 0.35), rng.uniform(0.65, 0.98)
    while times[-1] < end:
        level = window[len(levels) % 2] if times[-1] < turns else rng.uniform(0.02, 0.98)
        times.append(times[-1] + 0.1 + abs(level - levels[-1]))
        levels.append(level)
    return times, levels


def _smooth(path: FloatArray, half_width: int) -> FloatArray:
    kernel = np.hanning(2 * half_width + 3)[1:-1]
    return np.convolve(np.pad(path, half_width, mode="edge"), kernel / kernel.sum(), mode="valid")
