"""Rates of sampled signals."""

import numpy as np

from slpi_ros.arrays import FloatArray

# Samples before and after one between which its rate is taken.
REACH = 2
# This share of the way may be faster than the rate of a signal: jumps and late stamps do not count.
FAST_SHARE = 0.05


def slopes(t: FloatArray, x: FloatArray, reach: int = REACH) -> FloatArray:
    """Return dx/dt, shape (N,), unit of `x` per second, by central differences over `reach` samples on either side."""
    at = np.arange(x.size)
    before, after = np.maximum(at - reach, 0), np.minimum(at + reach, x.size - 1)
    seconds = t[after] - t[before]
    return np.divide(x[after] - x[before], seconds, out=np.zeros(x.size), where=seconds > 0.0)


def rates(t: FloatArray, x: FloatArray) -> FloatArray:
    """Return the magnitude of dx/dt, shape (N,), unit of `x` per second; see `slopes`."""
    return np.abs(slopes(t, x))


def fastest(t: FloatArray, x: FloatArray) -> float:
    """Return the rate (unit of `x` per second) at or above which a signal, (N,), covers `FAST_SHARE` of its way."""
    rate, way = rates(t, x), np.abs(np.diff(x, prepend=x[:1]))
    order = np.argsort(rate)[::-1]
    far = np.cumsum(way[order])
    return float(rate[order][np.searchsorted(far, FAST_SHARE * far[-1])]) if far.size and far[-1] > 0.0 else 0.0
