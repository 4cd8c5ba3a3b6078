"""How much of a signal no rate-independent hysteresis could explain."""

import numpy as np
from numpy.typing import NDArray

from slpi_ros.identification.fit import identify
from slpi_ros.io.record import Record
from slpi_ros.simulation.preisach import RelayTriangle

FloatArray = NDArray[np.float64]

LEVELS = 30
# Relays below the lowest voltage stay up once they are: so the first rise may differ from all later ones.
BELOW = 0.2
SAMPLES = 4000
# Relays that the drive hardly ever switches have no say.
RIDGE = 1e-7


def beyond_hysteresis(v: FloatArray, signal: FloatArray) -> float:
    """Return the rms of what is left of a signal after the best fit by relays, a curve of the voltage and an offset.

    The fit is that of a Preisach operator with `LEVELS` levels of thresholds from somewhat below the lowest voltage to
    the highest, weights of either sign, least squares over `SAMPLES` random samples. It takes up of an effect what a
    model identified from the record itself does.

    Parameters
    ----------
    v : ndarray, shape (N,), volts
        What the record says.
    signal : ndarray, shape (N,), metres
        The reading with an effect less the one without.

    Returns
    -------
    float, metres
    """
    rng = np.random.default_rng(0)
    rows = np.sort(rng.choice(v.size, min(SAMPLES, v.size), replace=False))
    columns = _columns(v, rows)
    target = signal[rows] - signal[rows].mean()
    columns -= columns.mean(axis=0)
    gram = columns.T @ columns
    gram[np.diag_indices_from(gram)] += RIDGE * np.trace(gram) / gram.shape[0]
    left = target - columns @ np.linalg.solve(gram, columns.T @ target)
    return float(np.sqrt(np.mean(left**2)))


def beyond_identified(time_ns: NDArray[np.int64], v: FloatArray, reading: FloatArray) -> float:
    """Return the rms of what a model identified from the record itself leaves of a reading without noise, metres.

    For effects without memory of their own, as a clipped voltage: relays take up all of them but a kink between two
    vertices, and how much that is depends on how fine a grid the identification takes.
    """
    return float(identify(Record(time_ns, {"x": v}, {"x": reading})).axes["x"].quality.rms)


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
