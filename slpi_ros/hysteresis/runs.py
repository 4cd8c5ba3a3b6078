"""Monotone runs of a signal: between two of its reversals a hysteresis model is one monotone function."""

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]


def monotone_runs(x: FloatArray) -> list[tuple[int, int]]:
    """Cut `x`, shape (N,), into stretches ``start:stop`` that go one way; the first sample is on its own.

    Equal neighbours belong to the stretch before them.
    """
    if x.size < 2:
        return [(0, x.size)] if x.size else []
    rising = x[1:] > x[:-1]
    level = x[1:] == x[:-1]
    if level.any():
        # A level stretch inherits the direction of the last move before it.
        last_move = np.where(level, 0, np.arange(level.size))
        rising = rising[np.maximum.accumulate(last_move)]
    bounds = np.flatnonzero(rising[1:] != rising[:-1]) + 2
    edges = [0, 1, *bounds.tolist(), x.size]
    return list(zip(edges[:-1], edges[1:], strict=True))


def count_before(x: FloatArray, direction: int, bound: float) -> int:
    """Count the samples of a run `x`, monotone in `direction` (+1 or -1), that come strictly before `bound`."""
    if direction > 0:
        return int(np.searchsorted(x, bound, side="left"))
    return x.size - int(np.searchsorted(x[::-1], bound, side="right"))
