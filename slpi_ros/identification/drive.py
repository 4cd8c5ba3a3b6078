"""What the voltage of a record does: where it turns, how fast it goes, where it rests."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter1d, minimum_filter1d

from slpi_ros.hysteresis.reversals import reversals

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

# Cells on each side of the map of turning points and voltages.
_CELLS = 10
# Runs of nearly one swing are compared, and speeds that differ by less than this factor are one.
_SWING_FACTOR = 1.6
SPEED_FACTOR = 1.5
# Anything shorter is a turn; creep shows from here on.
_SHORTEST_HOLD = 0.5
# Turns smaller than this share of the range say nothing about loops; larger ones than that are never noise.
_SMALLEST_TURN, _LARGEST_DEAD_BAND = 0.005, 0.1


@dataclass(frozen=True)
class Runs:
    """The stretches between turning points.

    Parameters
    ----------
    ends : ndarray of int, shape (M + 1,)
        Samples at which they begin and end, as from `reversals`.
    swing : ndarray, shape (M,), volts
        How far each goes, with its sign.
    duration : ndarray, shape (M,), seconds
    """

    ends: IntArray
    swing: FloatArray
    duration: FloatArray

    @classmethod
    def of(cls, t: FloatArray, v: FloatArray, dead_band: float) -> "Runs":
        """Cut a voltage, shape (N,), at its turns; smaller ones than the dead band (V) do not count."""
        ends = reversals(v, dead_band)
        return cls(ends, np.diff(v[ends]), np.diff(t[ends]))

    @property
    def turns(self) -> int:
        """Number of turning points."""
        return max(self.ends.size - 2, 0)

    @property
    def speeds(self) -> tuple[float, ...]:
        """Speeds (V/s) at which swings of one size are run through, from slow to fast; the most varied size counts."""
        timed = (self.duration > 0.0) & (self.swing != 0.0)
        swing, speed = np.abs(self.swing[timed]), np.abs(self.swing[timed]) / self.duration[timed]
        best: tuple[float, ...] = ()
        for size in np.unique(np.round(np.log(swing) / np.log(_SWING_FACTOR))).tolist():
            alike = np.abs(np.log(swing) / np.log(_SWING_FACTOR) - size) < 0.5
            found = _distinct(np.sort(speed[alike]))
            # Of equally varied sizes the largest.
            if len(found) >= max(len(best), 1):
                best = found
        return best

    @property
    def speed_range(self) -> tuple[float, float]:
        """Speeds (V/s) of the slowest and the fastest stretch; zeros where none takes time."""
        timed = (self.duration > 0.0) & (self.swing != 0.0)
        speed = np.abs(self.swing[timed]) / self.duration[timed]
        return (float(speed.min()), float(speed.max())) if speed.size else (0.0, 0.0)


def _distinct(speeds: FloatArray) -> tuple[float, ...]:
    """Return one of each group of sorted speeds, of those that come at least twice."""
    result: list[float] = []
    for group in np.split(speeds, np.flatnonzero(speeds[1:] > speeds[:-1] * np.sqrt(SPEED_FACTOR)) + 1):
        middle = float(np.median(group))
        if group.size > 1 and (not result or middle > SPEED_FACTOR * result[-1]):
            result.append(middle)
    return tuple(result)


def covered(v: FloatArray, runs: Runs) -> float:
    """Return the share of all pairs of turning point and voltage that the record visits, of a map of cells."""
    low, high = float(v.min()), float(v.max())
    cell = np.minimum((v - low) * (_CELLS / (high - low)), _CELLS - 1).astype(np.int8)
    origin = np.repeat(cell[runs.ends[:-1]], np.diff(runs.ends))
    visited = np.bincount(_CELLS * origin + cell[runs.ends[0] : runs.ends[-1]], minlength=_CELLS**2) > 0
    # The diagonal is where every turn begins.
    off_diagonal = ~np.eye(_CELLS, dtype=bool).ravel()
    return float(np.mean(visited[off_diagonal]))


def smallest_turn(v: FloatArray, noise: float) -> float:
    """Return the swing (V) up to which a reversal of `v`, shape (N,), volts, with `noise` (V rms) says nothing."""
    span = float(np.ptp(v))
    return float(np.clip(8.0 * noise, _SMALLEST_TURN * span, _LARGEST_DEAD_BAND * span))


def hold_band(v: FloatArray, noise: float, digit: float) -> float:
    """Return within how many volts a voltage rests, for its noise (V rms) and the step between its readings (V)."""
    return max(1e-4 * float(np.ptp(v)), 6.0 * noise, 1.5 * digit)


def resting(t: FloatArray, v: FloatArray, band: float) -> tuple[IntArray, IntArray]:
    """Find where the voltage rests within `band` (V).

    Returns
    -------
    starts, stops : ndarray of int, shape (H,)
        Samples ``start:stop`` of each hold.
    """
    period = float(np.median(np.diff(t)))
    width = max(5, round(_SHORTEST_HOLD / period)) if period > 0.0 else 5
    if width >= v.size:
        return np.empty(0, np.int64), np.empty(0, np.int64)
    # A window that begins at each sample.
    low, high = (filtered(v, width, origin=-(width // 2)) for filtered in (minimum_filter1d, maximum_filter1d))
    high -= low
    still = (high <= band)[: v.size - width + 1]
    edges = np.flatnonzero(np.diff(np.concatenate([[False], still, [False]]).astype(np.int8)))
    return edges[::2], edges[1::2] + width - 1


def holds(t: FloatArray, v: FloatArray, band: float) -> FloatArray:
    """Return how long the voltage rests, within `band` (V), each time it does so, shape (H,), seconds."""
    starts, stops = resting(t, v, band)
    return np.asarray(t[stops - 1] - t[starts])
