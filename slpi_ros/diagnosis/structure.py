"""What may be wrong with the hysteresis itself: loops that do not close, loops whose shape depends on the level."""

from collections.abc import Callable, Mapping

import numpy as np
from numpy.typing import NDArray

from slpi_ros.diagnosis.explanation import Explanation
from slpi_ros.hysteresis.reversals import monotone_runs

FloatArray = NDArray[np.float64]

# What a kind of model gets wrong that the loop family gets right.
BIAS = "loops that depend on bias"
# What the loop family gets wrong.
NOT_CLOSING, LEVEL = "loops that do not close", "loops that depend on level"
# Ways (share of the voltage range) over which a material without return-point memory may forget.
FORGETS_WITHIN = (0.02, 0.05, 0.12, 0.3, 0.7)


def _do_not_close(now: Explanation) -> FloatArray:
    """Return what forgets with the way, not at turning points: Duhem operators, such as Bouc and Wen's.

    Each follows ``dz = dv - z |dv| / w`` for a way ``w``; at whatever speed.
    """
    v = now.evidence.v
    span = float(np.ptp(v))
    return np.column_stack([_duhem(v, share * span) for share in FORGETS_WITHIN]) / span * float(np.ptp(now.h))


def _duhem(v: FloatArray, way: float) -> FloatArray:
    z, state = np.empty_like(v), 0.0
    for start, stop in monotone_runs(v):
        gone = np.abs(v[start:stop] - v[max(start - 1, 0)])
        limit = way * np.sign(v[stop - 1] - v[max(start - 1, 0)])
        z[start:stop] = limit + (state - limit) * np.exp(-gone / way)
        state = float(z[stop - 1])
    return z


def _bent(now: Explanation) -> FloatArray:
    """Return what bends the displacement: then loops between the same turns differ with the level they hang on."""
    x = now.h - now.h.mean()
    x = x / np.abs(x).max()
    return np.column_stack([x**2, x**3]) * float(np.ptp(now.h))


STRUCTURES: Mapping[str, Callable[[Explanation], FloatArray]] = {
    NOT_CLOSING: _do_not_close,
    LEVEL: _bent,
}
