"""Monotone runs of a signal: between two of its reversals a hysteresis model is one monotone function."""

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from slpi_ros.errors import UsageError

FloatArray = NDArray[np.float64]


def monotone_runs(x: FloatArray) -> list[tuple[int, int]]:
    """Cut `x`, shape (N,), into stretches ``start:stop`` that go one way.

    The first sample, with those equal to it that follow at once, is a stretch of its own; later equal neighbours belong
    to the stretch before them.
    """
    if not x.size:
        return []
    rising, level = x[1:] > x[:-1], x[1:] == x[:-1]
    first = 1
    if level.any():
        first += int(np.argmin(level)) if not level.all() else level.size
        # A level stretch inherits the direction of the last move before it.
        rising = rising[np.maximum.accumulate(np.where(level, 0, np.arange(level.size)))]
    bounds = np.flatnonzero(rising[first:] != rising[first - 1 : -1]) + first + 1
    edges = [0, first, *bounds.tolist(), x.size]
    return [(start, stop) for start, stop in pairwise(edges) if start < stop]


def require_finite(x: FloatArray) -> None:
    """Raise UsageError, which names the first one, when samples are not finite."""
    finite = np.isfinite(x)
    if not finite.all():
        at = int(np.argmin(finite))
        raise UsageError(f"sample {at} is {x[at]}; leave samples that are not finite out")


def count_before(x: FloatArray, direction: int, bound: float) -> int:
    """Count the samples of a run `x`, monotone in `direction` (+1 or -1), that come strictly before `bound`."""
    if direction > 0:
        return int(np.searchsorted(x, bound, side="left"))
    return x.size - int(np.searchsorted(x[::-1], bound, side="right"))
