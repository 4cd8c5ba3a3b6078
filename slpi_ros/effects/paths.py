"""Compiled batch evaluation of effects with a state that changes from sample to sample."""

import numpy as np
from numpy.typing import NDArray

from slpi_ros.hysteresis.compiled import compiled

FloatArray = NDArray[np.float64]


@compiled
def relaxed(moved: FloatArray, gains: FloatArray, holds: FloatArray) -> FloatArray:
    """Return the sum of first-order relaxations of a displacement, shape (N,), metres.

    `gains` has shape (K,); `holds`, shape (K, 3), are coefficients as in `slpi_ros.effects.filters.Hold`.
    """
    crept, before, states = np.empty_like(moved), 0.0, np.zeros(gains.size)
    for k in range(moved.size):
        total = 0.0
        for i in range(gains.size):
            states[i] = holds[i, 0] * moved[k] + holds[i, 1] * before + holds[i, 2] * states[i]
            total += gains[i] * states[i]
        crept[k], before = total, moved[k]
    return crept


@compiled
def unrelaxed(crept: FloatArray, gains: FloatArray, holds: FloatArray) -> FloatArray:
    """Return the displacement, shape (N,), metres, whose sum with its relaxations, as in `relaxed`, is `crept`."""
    moved, last, states = np.empty_like(crept), 0.0, np.zeros(gains.size)
    # `states` are without the part of the present input, which is added with the next sample.
    step, kept, direct = np.empty(gains.size), np.empty(gains.size), 1.0
    for i in range(gains.size):
        step[i], kept[i] = holds[i, 1] + holds[i, 2] * holds[i, 0], holds[i, 2]
        direct += gains[i] * holds[i, 0]
    if crept.size:
        moved[0] = last = crept[0] / direct
    for k in range(1, crept.size):
        total = 0.0
        for i in range(gains.size):
            states[i] = step[i] * last + kept[i] * states[i]
            total += gains[i] * states[i]
        moved[k] = last = (crept[k] - total) / direct
    return moved
