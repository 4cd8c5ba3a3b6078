"""What the drive does at each sample: what errors are looked at over, to see what they follow."""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from slpi_ros.identification import signal_statistics as readings
from slpi_ros.identification.design_matrix import Walk
from slpi_ros.identification.drive import hold_band, resting, smallest_turn, turning_points

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

# Samples to each side over which the speed is taken.
_REACH = 3
# A turn begins this near to its end (share of the range): what rests there has stopped before it turns.
_ARRIVED = 1e-3
_FEWEST = 5


@dataclass(frozen=True)
class Motion:
    """What the drive does at each sample.

    Parameters
    ----------
    speed : ndarray, shape (N,), volts per second
        Negative where the voltage falls.
    since_turn : ndarray, shape (N,), seconds
        Since the voltage last turned or came to rest.
    branch_from : ndarray, shape (N,), volts
        Where the branch of the hysteresis began on which the sample lies.
    runs : ndarray of int, shape (M + 1,)
        Samples at which the voltage turns, with the first and the last one.
    """

    speed: FloatArray
    since_turn: FloatArray
    branch_from: FloatArray
    runs: IntArray

    @classmethod
    def of(cls, t: FloatArray, v: FloatArray) -> "Motion":
        """Look at a voltage, shape (N,), volts, finite, over time, shape (N,), seconds."""
        if v.size < _FEWEST or not np.ptp(v) > 0.0:
            return cls(np.zeros(v.size), t - t[:1], v.copy(), np.array([0, max(v.size - 1, 0)]))
        noise = readings.noise(v, t)
        runs = turning_points(v, smallest_turn(v, noise))
        rests, _ = resting(t, v, hold_band(v, noise, readings.digit(v)))
        stops = np.unique(np.concatenate([[0], runs, _arrivals(v, runs), rests]))
        last = stops[np.searchsorted(stops, np.arange(v.size), side="right") - 1]
        branch_from = Walk.along(_one_way(v, runs), symmetric_rest=False, primed=False).v_origin
        return cls(_speed(t, v), t - t[last], branch_from, runs)


def _arrivals(v: FloatArray, runs: IntArray) -> IntArray:
    """Return the samples at which each run has come as far as it goes."""
    near = _ARRIVED * float(np.ptp(v))
    return np.array(
        [start + int(np.argmax(np.abs(v[start : stop + 1] - v[stop]) <= near)) for start, stop in pairwise(runs)],
        dtype=np.int64,
    )


def _one_way(v: FloatArray, runs: IntArray) -> FloatArray:
    """Return the voltage without the noise of going back between two turns."""
    clean = v.copy()
    for start, stop in pairwise(runs):
        further = np.maximum if v[stop] > v[start] else np.minimum
        clean[start : stop + 1] = further.accumulate(clean[start : stop + 1])
    return clean


def _speed(t: FloatArray, v: FloatArray) -> FloatArray:
    here = np.arange(v.size)
    before, after = np.maximum(here - _REACH, 0), np.minimum(here + _REACH, v.size - 1)
    step = t[after] - t[before]
    return np.divide(v[after] - v[before], step, out=np.zeros(v.size), where=step > 0.0)
