"""Reversals and monotone runs of a signal: between two reversals a hysteresis model is one monotone function."""

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from slpi_ros.errors import UsageError

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]


def reversals(x: FloatArray, dead_band: float = 0.0) -> IntArray:
    """Find the samples at which a signal turns.

    Parameters
    ----------
    x : ndarray, shape (N,), any unit
    dead_band : float, unit of `x`
        Reversals of at most this size do not count.

    Returns
    -------
    ndarray of int, shape (M,)
        The reversals in order, between the ends of the signal. Between neighbours `x` moves by more than `dead_band`,
        alternately up and down. Of a level extreme the last sample counts. Without a dead band the ends are the first
        and the last sample, with one they are the extremes beside the first and the last large move. Only sample 0
        where nothing moves.
    """
    if not x.size:
        return np.empty(0, dtype=np.int64)
    candidates = np.append(0, _run_ends(x)[1:])
    if not dead_band > 0.0:
        return candidates
    # Direction of the present large move, and the lowest and the highest sample since it began.
    direction, low, high = 0, 0, 0
    value = x[candidates].tolist()
    found: list[int] = []
    for i, now in enumerate(value):
        if now < value[low]:
            low = i
        if now > value[high]:
            high = i
        if direction <= 0 and now - value[low] > dead_band:
            found.append(low)
            direction, high = 1, i
        elif direction >= 0 and value[high] - now > dead_band:
            found.append(high)
            direction, low = -1, i
    return np.asarray(candidates[[*found, high if direction > 0 else low if direction < 0 else 0]], dtype=np.int64)


def monotone_runs(x: FloatArray) -> list[tuple[int, int]]:
    """Cut `x`, shape (N,), into runs ``start:stop`` that go one way.

    The first sample, with those equal to it that follow at once, is a run of its own; later equal neighbours belong to
    the run before them.
    """
    return list(pairwise([0, *(_run_ends(x) + 1).tolist()])) if x.size else []


def _run_ends(x: FloatArray) -> IntArray:
    """Return the last sample of every monotone run of `x`, shape (N,), N >= 1."""
    # Booleans: of a long record there may be no room for more.
    rising, level = x[1:] > x[:-1], x[1:] == x[:-1]
    first = 0
    if level.any():
        first = int(np.argmin(level)) if not level.all() else level.size
        # A level stretch inherits the direction of the last move before it.
        rising = rising[np.maximum.accumulate(np.where(level, 0, np.arange(level.size)))]
    turns = np.flatnonzero(rising[first + 1 :] != rising[first:-1]) + first + 1
    return np.unique(np.concatenate([[first], turns, [x.size - 1]]))


def require_finite(x: FloatArray) -> None:
    """Raise UsageError naming the first sample of `x`, shape (N,), that is not finite."""
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
    turns = reversals(x, dead_band).tolist()
    flattened = np.full_like(x, x[turns[0]])
    for start, stop in pairwise(turns):
        accumulate = np.maximum.accumulate if x[stop] >= x[start] else np.minimum.accumulate
        flattened[start : stop + 1] = accumulate(x[start : stop + 1])
    flattened[turns[-1] :] = x[turns[-1]]
    return flattened
