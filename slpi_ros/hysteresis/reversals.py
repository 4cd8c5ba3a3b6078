"""Find reversals and monotone runs of a signal; between two reversals a hysteresis model is a monotone function."""

from itertools import pairwise

import numpy as np

from slpi_ros.arrays import FloatArray, IntArray
from slpi_ros.errors import UsageError


def reversals(x: FloatArray, dead_band: float = 0.0) -> IntArray:
    """Return the samples at which a signal `x`, shape (N,), reverses, ascending and with its ends, shape (M,)."""
    # Reversals of at most `dead_band` (unit of `x`) are ignored: from one sample to the next, `x` changes by more than
    # that, alternately up and down. A flat extremum gives its last sample. Without a dead band the ends are the first
    # and the last sample; with one, the extrema before the first and after the last change larger than the dead band. A
    # constant signal gives only sample 0.
    if not x.size:
        return np.empty(0, dtype=np.int64)
    candidates = np.append(0, _run_ends(x)[1:])
    if not dead_band > 0.0:
        return candidates
    # Direction of the current change above the dead band, and minimum and maximum since its start.
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
    """Divide `x`, (N,), into monotone runs ``start:stop``; the first sample and its equals are a run of their own."""
    # Later equal neighbours belong to the preceding run.
    return list(pairwise([0, *(_run_ends(x) + 1).tolist()])) if x.size else []


def _run_ends(x: FloatArray) -> IntArray:
    """Return the last sample of every monotone run of `x`, shape (N,), N >= 1."""
    # Booleans need less memory than indices for long records.
    rising, level = x[1:] > x[:-1], x[1:] == x[:-1]
    first = 0
    if level.any():
        first = int(np.argmin(level)) if not level.all() else level.size
        # A constant section has the direction of the preceding move.
        rising = rising[np.maximum.accumulate(np.where(level, 0, np.arange(level.size)))]
    turns = np.flatnonzero(rising[first + 1 :] != rising[first:-1]) + first + 1
    return np.unique(np.concatenate([[first], turns, [x.size - 1]]))


def require_finite(x: FloatArray) -> None:
    """Raise UsageError if a sample of `x`, shape (N,), is not finite."""
    finite = np.isfinite(x)
    if not finite.all():
        at = int(np.argmin(finite))
        raise UsageError(f"sample {at} is {x[at]}; remove samples that are not finite")


def count_before(x: FloatArray, direction: int, bound: float) -> int:
    """Return the number of samples of `x`, monotone in `direction` (+1 or -1), that lie strictly before `bound`."""
    if direction > 0:
        return int(np.searchsorted(x, bound, side="left"))
    return x.size - int(np.searchsorted(x[::-1], bound, side="right"))


def without_small_reversals(x: FloatArray, dead_band: float) -> FloatArray:
    """Return `x`, shape (N,), with reversals of at most `dead_band` flattened and larger reversals unchanged."""
    if not dead_band > 0.0:
        return x
    turns = reversals(x, dead_band).tolist()
    flattened = np.full_like(x, x[turns[0]])
    for start, stop in pairwise(turns):
        accumulate = np.maximum.accumulate if x[stop] >= x[start] else np.minimum.accumulate
        flattened[start : stop + 1] = accumulate(x[start : stop + 1])
    flattened[turns[-1] :] = x[turns[-1]]
    return flattened
