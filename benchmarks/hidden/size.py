"""Size of the part of a signal that no rate-independent hysteresis can explain."""

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from slpi_ros.identification.fit import identify
from slpi_ros.io.record import Record
from slpi_ros.simulation.preisach import RelayTriangle

FloatArray = NDArray[np.float64]

LEVELS = 30
# Extension of the thresholds below the lowest voltage, as a fraction of the range. Relays there never switch back, so
# that the first rise may differ from all later ones.
BELOW = 0.2
SAMPLES = 4000
# Relative ridge regularization, which suppresses relays that are rarely switched.
RIDGE = 1e-7


def beyond_hysteresis(v: FloatArray, signal: FloatArray) -> float:
    """Return the rms residual of a signal after the best fit by relays, a function of the voltage and an offset.

    The relays form a Preisach operator with `LEVELS` threshold levels, from somewhat below the lowest voltage to the
    highest one, and weights of either sign, fitted by least squares to `SAMPLES` random samples. It explains as much of
    an effect as a model identified from the record itself.

    Parameters
    ----------
    v : ndarray, shape (N,), volts
        Recorded voltage.
    signal : ndarray, shape (N,), metres
        Reading with an effect minus the reading without it.

    Returns
    -------
    float, metres
    """
    rows, columns, gram = _regression(v.tobytes())
    target = signal[rows] - signal[rows].mean()
    left = target - columns @ np.linalg.solve(gram, columns.T @ target)
    return float(np.sqrt(np.mean(left**2)))


def beyond_identified(time_ns: NDArray[np.int64], v: FloatArray, reading: FloatArray) -> float:
    """Return the rms error (m) of a model identified from the noise-free reading itself.

    For effects without memory, such as a clipped voltage: relays explain them except for a kink between two vertices,
    whose size depends on the grid that the identification chooses.
    """
    return float(identify(Record(time_ns, {"x": v}, {"x": reading})).axes["x"].quality.rms)


# Each strength of an effect is tried on one voltage.
@lru_cache(maxsize=1)
def _regression(voltage: bytes) -> tuple[NDArray[np.int64], FloatArray, FloatArray]:
    """Return samples, centred columns and regularized normal matrix of a voltage (float64, V)."""
    v = np.frombuffer(voltage)
    rows = np.sort(np.random.default_rng(0).choice(v.size, min(SAMPLES, v.size), replace=False))
    columns = _columns(v, rows)
    columns -= columns.mean(axis=0)
    gram = columns.T @ columns
    gram[np.diag_indices_from(gram)] += RIDGE * np.trace(gram) / gram.shape[0]
    return rows, columns, gram


def _columns(v: FloatArray, rows: NDArray[np.int64]) -> FloatArray:
    low, high = float(v.min()), float(v.max())
    relays = RelayTriangle(low - BELOW * (high - low), high, LEVELS, lambda bias, width: np.ones_like(bias))
    lower = np.tril_indices(LEVELS)
    turns = np.flatnonzero(np.diff(np.sign(np.diff(v))) != 0) + 1
    wanted = set(rows.tolist())
    states = []
    for index in np.union1d(rows, turns).tolist():
        relays.step(float(v[index]))
        if index in wanted:
            states.append(relays.state[lower])
    knots = np.linspace(low, high, LEVELS + 1)
    hats = np.maximum(0.0, 1.0 - np.abs(v[rows, None] - knots) / (knots[1] - knots[0]))
    return np.column_stack([np.array(states), hats])
