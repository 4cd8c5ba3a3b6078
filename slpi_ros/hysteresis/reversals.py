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


def without_small_reversals(x: FloatArray, dead_band: float) -> FloatArray:
    """Return `x`, shape (N,), with every reversal of at most `dead_band` flattened; larger turns keep their values."""
    if not dead_band > 0.0:
        return x
    extremes = _large_turns(x, dead_band)
    flattened = np.full_like(x, x[extremes[0]])
    for start, stop in pairwise(extremes):
        accumulate = np.maximum.accumulate if x[stop] >= x[start] else np.minimum.accumulate
        flattened[start : stop + 1] = accumulate(x[start : stop + 1])
    flattened[extremes[-1] :] = x[extremes[-1]]
    return flattened


def _large_turns(x: FloatArray, dead_band: float) -> list[int]:
    """Return the samples between which `x` moves by more than `dead_band`, alternately up and down."""
    lowest = highest = 0
    extremes: list[int] = []
    way = 0
    for turn in [0, *(stop - 1 for _, stop in monotone_runs(x))]:
        if x[turn] < x[lowest]:
            lowest = turn
        if x[turn] > x[highest]:
            highest = turn
        if way <= 0 and x[turn] - x[lowest] > dead_band:
            extremes.append(lowest)
            way, highest = 1, turn
        elif way >= 0 and x[highest] - x[turn] > dead_band:
            extremes.append(highest)
            way, lowest = -1, turn
    return [*extremes, highest if way > 0 else lowest if way < 0 else 0]
