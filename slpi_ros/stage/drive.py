"""Waveforms that drive a stage: voltages to identify it by, and desired displacements to judge it by."""

import math

import numpy as np
from numpy.typing import NDArray

from slpi_ros.errors import UsageError

FloatArray = NDArray[np.float64]

# Ranges of travel per second: about 70 V/s on a 100 V stage, slow enough for 100 Hz to follow every branch.
_TRAVEL_RATE = 0.7
# Smaller ramps take as long as one of this many ranges: several samples each.
_SHORTEST_RAMP = 0.05
_TONES_HZ = (0.23, 0.61, 1.37)
_SMOOTHING_S = 0.05


def calibration_drive(
    voltage_min: float, voltage_max: float, *, duration: float, rate: float, seed: int | None = None
) -> tuple[FloatArray, FloatArray]:
    """Visit the Preisach plane evenly: major loops, reversal curves from both ends, nested loops.

    Major loops wipe the memory first. Rising branches from evenly spaced minima and falling branches from
    evenly spaced maxima follow, then loops within loops. A drive of more than 25 s has more of them at the
    same slew rate, at most 1.3 ranges a second; a shorter one is faster.

    Parameters
    ----------
    voltage_min, voltage_max : float, volts
        Never left; the drive begins and ends at `voltage_min`.
    duration : float, seconds
        Time of the last sample; 30 to 80 s suit most stages.
    rate : float, hertz
        Samples per second.
    seed : int, optional
        Moves each reversal within its share of the range; without it they are evenly spaced.

    Returns
    -------
    t : ndarray, shape (N,), seconds
        Times from 0 to `duration`.
    v : ndarray, shape (N,), volts
        The voltage, in raised-cosine ramps between reversals.

    Raises
    ------
    UsageError
        If the limits are not in order, or `duration` or `rate` allow too few samples for the reversals.
    """
    count = _check("calibration drive", voltage_min, voltage_max, duration, rate, "V")
    # Two major loops travel 4 ranges, each pair of reversal curves 2, the nested loops 1 for each level.
    levels = max(4, round((duration * _TRAVEL_RATE - 4) / 3))
    turns = _reversals(levels, None if seed is None else np.random.default_rng(seed))
    travel = np.concatenate([[0.0], np.cumsum(np.maximum(np.abs(np.diff(turns)), _SHORTEST_RAMP))])
    knots = np.round(travel / travel[-1] * (count - 1))
    if np.any(np.diff(knots) < 2):
        raise UsageError(
            f"calibration drive: {count} samples are too few for {len(turns)} reversals; raise the rate"
        )
    share = _raised_cosines(np.arange(count, dtype=np.float64), knots, turns)
    v = np.clip(voltage_min + (voltage_max - voltage_min) * share, voltage_min, voltage_max)
    return np.arange(count) / rate, v


def scan_path(
    y_min: float, y_max: float, *, duration: float = 30.0, rate: float = 200.0, seed: int = 0
) -> tuple[FloatArray, FloatArray]:
    """Draw a smooth path of desired displacements that no calibration has seen.

    Parameters
    ----------
    y_min, y_max : float, metres
        Never left; the path rises from `y_min`.
    duration : float, seconds
        Time of the last sample, at least 4 s: equal parts of several tones, of ramps as of a raster scan, and
        of turns at random places.
    rate : float, hertz
        Samples per second.
    seed : int
        The same seed gives the same path.

    Returns
    -------
    t : ndarray, shape (N,), seconds
        Times from 0 to `duration`.
    y : ndarray, shape (N,), metres
        The path.

    Raises
    ------
    UsageError
        If the limits are not in order or the duration is below 4 s.
    """
    count = _check("scan path", y_min, y_max, duration, rate, "m")
    if duration < 4:
        raise UsageError(f"scan path: {duration} s are too short for its three parts; give at least 4 s")
    rng = np.random.default_rng(seed)
    t = np.arange(count) / rate
    ramps, turns = duration / 3, duration * 2 / 3
    tones = _tones(t, t < ramps, rng)
    start = float(tones[t < ramps][-1])
    knots, levels = _corners(ramps, turns, duration, start, rng)
    path = _smooth(np.where(t < ramps, tones, np.interp(t, knots, levels)), round(_SMOOTHING_S * rate))
    return t, np.clip(y_min + (y_max - y_min) * path, y_min, y_max)


def _check(what: str, low: float, high: float, duration: float, rate: float, unit: str) -> int:
    """Return the number of samples."""
    if not -math.inf < low < high < math.inf:
        raise UsageError(f"{what}: limits {low} {unit} and {high} {unit}; the first must be the lower one")
    if not (0 < duration < math.inf and 0 < rate < math.inf):
        raise UsageError(f"{what}: {duration} s at {rate} Hz; both must be more than 0")
    return round(duration * rate) + 1


def _reversals(levels: int, rng: np.random.Generator | None) -> FloatArray:
    """Return turning points as shares of the range, beginning and ending at 0."""
    major = [0.0, 1.0, 0.0, 1.0]
    rising = [turn for level in _spaced(levels, rng) for turn in (level, 1.0)]
    falling = [turn for level in _spaced(levels, rng) for turn in (level, 0.0)]
    low_spiral, high_spiral = (_spiral(centre, levels // 2) for centre in (0.3, 0.7))
    return np.array(major + rising + [0.0] + falling + low_spiral + [0.0] + high_spiral + [0.0])


def _spaced(levels: int, rng: np.random.Generator | None) -> FloatArray:
    jitter = np.zeros(levels) if rng is None else rng.uniform(-0.4, 0.4, levels)
    return np.asarray((np.arange(levels) + 0.5 + jitter) / levels)


def _spiral(centre: float, loops: int) -> list[float]:
    """Loops within loops, closing in on `centre`."""
    spans = 1 - (np.arange(loops) + 0.5) / loops
    return [turn for span in spans for turn in (centre + (1 - centre) * span, centre - centre * span)]


def _raised_cosines(x: FloatArray, knots: FloatArray, levels: FloatArray) -> FloatArray:
    segment = np.clip(np.searchsorted(knots, x, side="right") - 1, 0, len(knots) - 2)
    phase = (x - knots[segment]) / (knots[segment + 1] - knots[segment])
    rise = levels[segment + 1] - levels[segment]
    return np.asarray(levels[segment] + rise * (1 - np.cos(np.pi * phase)) / 2)


def _tones(t: FloatArray, within: NDArray[np.bool_], rng: np.random.Generator) -> FloatArray:
    """Several sines filling 0 to 1 while `within`, faded in from 0."""
    phases = rng.uniform(0, 2 * np.pi, len(_TONES_HZ))
    wave = sum(np.sin(2 * np.pi * f * t + phase) / f for f, phase in zip(_TONES_HZ, phases, strict=True))
    low, high = np.min(wave[within]), np.max(wave[within])
    fade = (1 - np.cos(np.pi * np.clip(t - _SMOOTHING_S, 0, 1))) / 2
    return np.asarray(np.clip((wave - low) / (high - low), 0, 1) * fade)


def _corners(
    ramps: float, turns: float, end: float, level: float, rng: np.random.Generator
) -> tuple[list[float], list[float]]:
    """Return times and levels of corners: a raster from `ramps` on, random turns from `turns` to `end`."""
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
