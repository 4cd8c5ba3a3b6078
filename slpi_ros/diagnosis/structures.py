"""Defects of a hysteresis model that are no effect: what its loops do that those of its kind cannot."""

from collections.abc import Callable, Mapping

import numpy as np

from slpi_ros.arrays import FloatArray
from slpi_ros.diagnosis.joint_fit import JointFit
from slpi_ros.hysteresis.reversals import monotone_runs

# Defect of other kinds of hysteresis model than the loop family.
BIAS = "loops that depend on bias"
# Defects of the loop family.
NOT_CLOSING, LEVEL = "loops that do not close", "loops that depend on level"
# Memory lengths (voltage travel, share of the voltage range) for hysteresis without return-point memory.
FORGETS_WITHIN = (0.02, 0.05, 0.12, 0.3, 0.7)


def _do_not_close(now: JointFit) -> FloatArray:
    """Return columns, shape (N, k), metres, for loops that do not close: Duhem operators, as in the Bouc-Wen model."""
    # Each follows ``dz = dv - z |dv| / w`` with a memory length ``w`` (V), independent of the rate.
    span = float(np.ptp(now.evidence.v))
    columns = [
        np.concatenate([_duhem(part.v, share * span) for part in now.evidence.parts]) for share in FORGETS_WITHIN
    ]
    return np.column_stack(columns) / span * float(np.ptp(now.h))


def _duhem(v: FloatArray, way: float) -> FloatArray:
    z, state = np.empty_like(v), 0.0
    for start, stop in monotone_runs(v):
        gone = np.abs(v[start:stop] - v[max(start - 1, 0)])
        limit = way * np.sign(v[stop - 1] - v[max(start - 1, 0)])
        z[start:stop] = limit + (state - limit) * np.exp(-gone / way)
        state = float(z[stop - 1])
    return z


def _bent(now: JointFit) -> FloatArray:
    """Return columns, shape (N, 2), metres, for loops that depend on level: square and cube of the displacement."""
    x = now.h - now.h.mean()
    x = x / np.abs(x).max()
    return np.column_stack([x**2, x**3]) * float(np.ptp(now.h))


STRUCTURES: Mapping[str, Callable[[JointFit], FloatArray]] = {NOT_CLOSING: _do_not_close, LEVEL: _bent}
