"""Voltage paths of the experiments."""

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]


def ramps(turns: Sequence[float], step: float) -> FloatArray:
    """Return straight ramps through turning points, a sample every `step`; every turn is a sample too.

    Parameters
    ----------
    turns : sequence of float
        Neighbours differ.
    step : float
        In the unit of `turns`.

    Returns
    -------
    ndarray, shape (N,)
    """
    parts = [np.append(np.arange(a, b, step if b > a else -step)[1:], b) for a, b in pairwise(turns)]
    return np.concatenate([np.array([turns[0]], dtype=np.float64), *parts])


def triangles(amplitude: float, frequency: float, cycles: int, samples: int = 2000) -> tuple[FloatArray, FloatArray]:
    """Return a triangle wave from 0 to `amplitude` and back.

    Parameters
    ----------
    amplitude : float, volts or metres
    frequency : float, hertz
    cycles : int
    samples : int
        In one cycle; even.

    Returns
    -------
    t : ndarray, shape (cycles * samples,), seconds
    x : ndarray, shape (cycles * samples,), in the unit of `amplitude`
    """
    k = np.arange(cycles * samples)
    phase = (k % samples) / samples
    return k / (samples * frequency), amplitude * (1.0 - np.abs(2.0 * phase - 1.0))


def turning_points(x: FloatArray) -> list[int]:
    """Return the first sample of `x`, shape (N,), those at which it turns back, and the last one."""
    moves = np.flatnonzero(np.diff(x))
    signs = np.sign(np.diff(x)[moves])
    turns = moves[1:][np.diff(signs) != 0]
    return [0, *turns.tolist(), x.size - 1]


def straight_between_turns(x: FloatArray, at: FloatArray) -> FloatArray:
    """Return `x`, shape (N,), made a straight line of `at`, shape (N,), between neighbouring turns of `at`."""
    path = np.empty_like(x)
    for a, b in pairwise(turning_points(at)):
        path[a : b + 1] = x[a] + (x[b] - x[a]) * (at[a : b + 1] - at[a]) / (at[b] - at[a])
    return path
