"""Properties of the voltage signal of a record: reversals, speeds, holds and coverage."""

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import maximum_filter1d, minimum_filter1d

from slpi_ros.arrays import FloatArray, IntArray
from slpi_ros.hysteresis.reversals import reversals

# Cells per dimension of the grid of last reversal voltage and present voltage.
_CELLS = 10
# Voltage changes, and speeds, that differ by less than these factors count as equal.
_SWING_FACTOR = 1.6
SPEED_FACTOR = 1.5
# Shortest hold, seconds; creep becomes visible after this time.
_SHORTEST_HOLD = 0.5
# Smallest and largest dead band for reversals, as shares of the voltage range.
_SMALLEST_TURN, _LARGEST_DEAD_BAND = 0.005, 0.1


@dataclass(frozen=True)
class Runs:
    """Monotone runs of the voltage between reversals."""

    ends: IntArray  # (M + 1,), samples at which the runs begin and end, as from `reversals`
    swing: FloatArray  # V, signed, (M,)
    duration: FloatArray  # s, (M,)

    @classmethod
    def of(cls, t: FloatArray, v: FloatArray, dead_band: float) -> "Runs":
        """Split a voltage, shape (N,), at its reversals; reversals smaller than the dead band (V) are ignored."""
        ends = reversals(v, dead_band)
        return cls(ends, np.diff(v[ends]), np.diff(t[ends]))

    @property
    def turns(self) -> int:
        """Number of reversals."""
        return max(self.ends.size - 2, 0)

    @property
    def speeds(self) -> tuple[float, ...]:
        """Distinct speeds (V/s), ascending, of the runs with that voltage change which has the most of them.

        Only runs of one direction are compared: rises that are slower than the falls tell nothing of the speed.
        """
        timed = (self.duration > 0.0) & (self.swing != 0.0)
        swing, speed = np.abs(self.swing[timed]), np.abs(self.swing[timed]) / self.duration[timed]
        rises = self.swing[timed] > 0.0
        best: tuple[float, ...] = ()
        for size in np.unique(np.round(np.log(swing) / np.log(_SWING_FACTOR))).tolist():
            alike = np.abs(np.log(swing) / np.log(_SWING_FACTOR) - size) < 0.5
            either = _distinct(np.sort(speed[alike]))
            ways = (_present(either, speed[alike & (rises == way)]) for way in (True, False))
            found = max(ways, key=len)
            # Of sizes with equally many speeds, take the largest.
            if len(found) >= max(len(best), 1):
                best = found
        return best

    def speed_range(self, way: int) -> tuple[float, float]:
        """Return speeds (V/s) of the slowest and the fastest run that rises (1) or falls (-1); zeros if there is none.

        Runs without a duration do not count.
        """
        timed = (self.duration > 0.0) & (way * self.swing > 0.0)
        speed = np.abs(self.swing[timed]) / self.duration[timed]
        return (float(speed.min()), float(speed.max())) if speed.size else (0.0, 0.0)


def _present(among: tuple[float, ...], speeds: FloatArray) -> tuple[float, ...]:
    """Return those of some speeds that occur in others, (n,), within `SPEED_FACTOR`."""
    near = np.sqrt(SPEED_FACTOR)
    return tuple(one for one in among if np.any((speeds > one / near) & (speeds < one * near)))


def _distinct(speeds: FloatArray) -> tuple[float, ...]:
    """Return the median of each group of similar speeds that has at least two members; `speeds` are sorted."""
    result: list[float] = []
    for group in np.split(speeds, np.flatnonzero(speeds[1:] > speeds[:-1] * np.sqrt(SPEED_FACTOR)) + 1):
        middle = float(np.median(group))
        if group.size > 1 and (not result or middle > SPEED_FACTOR * result[-1]):
            result.append(middle)
    return tuple(result)


def covered(v: FloatArray, runs: Runs) -> float:
    """Return the share, 0..1, of all pairs of last reversal voltage and present voltage that a record visits."""
    low, high = float(v.min()), float(v.max())
    cell = np.minimum((v - low) * (_CELLS / (high - low)), _CELLS - 1).astype(np.int8)
    origin = np.repeat(cell[runs.ends[:-1]], np.diff(runs.ends))
    visited = np.bincount(_CELLS * origin + cell[runs.ends[0] : runs.ends[-1]], minlength=_CELLS**2) > 0
    # Every run visits the diagonal, where present voltage and reversal voltage are equal.
    off_diagonal = ~np.eye(_CELLS, dtype=bool).ravel()
    return float(np.mean(visited[off_diagonal]))


def smallest_turn(v: FloatArray, noise: float) -> float:
    """Return the dead band (V) that excludes reversals due to `noise` (V rms) in the voltage `v`, shape (N,), volts."""
    span = float(np.ptp(v))
    return float(np.clip(8.0 * noise, _SMALLEST_TURN * span, _LARGEST_DEAD_BAND * span))


def hold_band(v: FloatArray, noise: float, digit: float) -> float:
    """Return the largest voltage range (V) within a hold, given `noise` (V rms) and resolution `digit` (V)."""
    return max(1e-4 * float(np.ptp(v)), 6.0 * noise, 1.5 * digit)


def resting(t: FloatArray, v: FloatArray, band: float) -> tuple[IntArray, IntArray]:
    """Return the samples ``start:stop`` (two arrays) of holds: 0.5 s or more with `v` within a `band` (V)."""
    period = float(np.median(np.diff(t)))
    width = max(5, round(_SHORTEST_HOLD / period)) if period > 0.0 else 5
    if width >= v.size:
        return np.empty(0, np.int64), np.empty(0, np.int64)
    # Filter windows that begin at each sample.
    low, high = (filtered(v, width, origin=-(width // 2)) for filtered in (minimum_filter1d, maximum_filter1d))
    high -= low
    still = (high <= band)[: v.size - width + 1]
    edges = np.flatnonzero(np.diff(np.concatenate([[False], still, [False]]).astype(np.int8)))
    return edges[::2], edges[1::2] + width - 1


def holds(t: FloatArray, v: FloatArray, band: float) -> FloatArray:
    """Return the duration of each hold found by `resting`, shape (H,), seconds."""
    starts, stops = resting(t, v, band)
    return np.asarray(t[stops - 1] - t[starts])
