"""Readings of a quantity in use: filters that take away noise, and make up for how late the readings are.

Both filters have one time constant T and take the last reading as it is held. The running mean is a first-order lag.
The running line has a value and a slope, with equal poles (Brookner, Tracking and Kalman Filtering Made Easy, Wiley
1998, Sec. 1.2: critically damped), and is continued by the time by which the held readings are late.
"""

from math import exp, sqrt
from typing import NamedTuple

import numpy as np

from slpi_ros.arrays import FloatArray
from slpi_ros.effects.filters import filtered
from slpi_ros.io.record import Course
from slpi_ros.io.surroundings import FEWEST_READINGS, clean, smoothed

# Time constants, in intervals of the readings; largest number of readings that they are chosen by; times for each
# interval at which they are compared.
TIME_CONSTANTS, MOST_READINGS, FINER = np.array([0.5, 1.0, 1.5, 2.0, 3.0, 4.0, 6.0, 8.0, 16.0, 32.0]), 100_000, 4


class ReadingsFilter(NamedTuple):
    """Filter of readings in use: time constant (s), 0: none; time by which the line is continued (s), 0: the mean.

    `error` is the rms by which it is off the quantity, in its unit.
    """

    time_constant: float = 0.0
    ahead: float = 0.0
    error: float = 0.0


def line_after(dt: float, time_constant: float, reading: float, value: float, slope: float) -> tuple[float, float]:
    """Return value and slope (1/s) of the running line after `dt` (s) with this reading."""
    x = dt / time_constant
    kept, off = exp(-x), value - reading
    return reading + kept * ((1.0 - x) * off + dt * slope), kept * ((1.0 + x) * slope - x / time_constant * off)


def best_filter(course: Course, lead: float = 0.0) -> ReadingsFilter:
    """Return the filter with which the readings of a record are nearest to the quantity `lead` (s) later.

    That is taken from all readings, those that follow among them.
    """
    t, value = clean(course)
    t, value = t[:MOST_READINGS], value[:MOST_READINGS]
    if t.size < FEWEST_READINGS or not float(np.ptp(t)) > lead:
        return ReadingsFilter()
    interval = float(np.median(np.diff(t)))
    step = max(interval, float(t[-1] - t[0]) / MOST_READINGS) / FINER
    grid = np.arange(t[0], t[-1] - lead, step)
    true = np.interp(grid + lead, *smoothed((t, value)))
    held = value[np.searchsorted(t, grid, side="right") - 1]
    least = float(np.mean((held - true) ** 2))
    best = ReadingsFilter(error=sqrt(least))
    for time_constant in (interval * TIME_CONSTANTS).tolist():
        for tried in (ReadingsFilter(time_constant), ReadingsFilter(time_constant, lead + 0.5 * interval)):
            error = float(np.mean((_filtered(tried, held - true[0], step) + true[0] - true) ** 2))
            if error < least:
                best, least = tried._replace(error=sqrt(error)), error
    return best


def _filtered(tried: ReadingsFilter, held: FloatArray, step: float) -> FloatArray:
    """Return held readings, shape (N,), every `step` (s), after a filter that begins at 0."""
    x = step / tried.time_constant
    kept = exp(-x)
    if not tried.ahead:
        return filtered([1.0 - kept], [1.0, -kept], held)
    # `line_after` as a transfer function: each of both from the reading, and from the other one.
    to_value, to_slope = 1.0 - kept * (1.0 - x), kept * x / tried.time_constant
    value = np.array([to_value, kept * (step * to_slope - (1.0 + x) * to_value)])
    slope = np.array([to_slope, -kept * ((1.0 - x) * to_slope + x / tried.time_constant * to_value)])
    return filtered(value + tried.ahead * slope, [1.0, -2.0 * kept, kept * kept], held)
