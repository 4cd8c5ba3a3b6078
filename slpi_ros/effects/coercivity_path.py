"""The coercivity along whole paths, in machine code; `coercivity` has it sample by sample."""

from math import exp

import numpy as np
from numpy.typing import NDArray

from slpi_ros.hysteresis.compiled import compiled

FloatArray = NDArray[np.float64]


@compiled
def settled_rate(t: FloatArray, v: FloatArray, settling: float) -> FloatArray:
    """Return the rate (V/s) that a path, shape (N,), volts, has of late, from rest, at times `t`, shape (N,), s."""
    settled, now, last = np.empty_like(v), 0.0, v.size - 1
    for k in range(v.size):
        # From the sample before to the one after; a follower knows only the one before.
        before, after = max(k - 1, 0), min(k + 1, last)
        dt = t[after] - t[before]
        rate = abs(v[after] - v[before]) / dt if dt > 0.0 else 0.0
        now = rate + (now - rate) * (exp((t[before] - t[k]) / settling) if settling else 0.0)
        settled[k] = now
    return settled


@compiled
def play(v: FloatArray, half_width: FloatArray) -> FloatArray:
    """Return what is seen of a path, shape (N,), through a play of changing half-width, shape (N,), volts."""
    seen, now = np.empty_like(v), v[0] if v.size else 0.0
    for k in range(v.size):
        now = min(max(now, v[k] - half_width[k]), v[k] + half_width[k])
        seen[k] = now
    return seen
