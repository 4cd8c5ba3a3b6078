"""Mean rate of a voltage, which an amplifier's average current and a piezo's heat limit.

An amplifier that drives a capacitance C gives C |dV/dt|; in a sine of frequency f and amplitude Vpp the mean of |dV/dt|
is 2 f Vpp, and the average current of a data sheet, f C Vpp, half of C times that.
"""

from collections import deque
from collections.abc import Callable
from itertools import takewhile

import numpy as np

from slpi_ros.arrays import FloatArray

# The mean is taken over this time, seconds; ways within a piece are counted together, for the whole piece, ns.
WINDOW, PIECE_NS = 10.0, 20_000_000
# What is free now is used up within this many pieces.
FREE_PIECES = 50
# Bisections for a factor.
HALVINGS = 40
# Relative rounding error of a sum of ways.
ROUNDING = 1e-9


class Travelled:
    """The way (V) that a voltage has gone, up and down, within the last `WINDOW`; times in ns."""

    __slots__ = ("_pieces", "_sum")

    def __init__(self, pieces: "tuple[tuple[int, float], ...]" = ()) -> None:
        self._pieces = deque(pieces)
        self._sum = sum(way for _, way in pieces)

    def move(self, way: float, now_ns: int) -> None:
        """Count a way (V)."""
        number = now_ns // PIECE_NS
        if self._pieces and self._pieces[-1][0] >= number:
            # What is told late is counted late.
            number, way_before = self._pieces.pop()
            self._sum -= way_before
            way += way_before
        self._pieces.append((number, way))
        self._sum += way

    def left(self, limit: float, now_ns: int) -> float:
        """Return the way (V) that may still be gone within a mean rate (V/s)."""
        return max(limit * WINDOW - self.within(now_ns), 0.0)

    def fastest(self, limit: float, now_ns: int) -> float:
        """Return the rate (V/s) at which in a second what is left is used up, and what the window then loses."""
        left = self.left(limit, now_ns)
        until = (now_ns - int(WINDOW * 1e9)) // PIECE_NS + FREE_PIECES
        lost = sum(way for _, way in takewhile(lambda piece: piece[0] < until, self._pieces))
        return (left + lost) / (FREE_PIECES * PIECE_NS * 1e-9)

    def within(self, now_ns: int) -> float:
        """Return the way (V) within the window that ends now."""
        oldest = (now_ns - int(WINDOW * 1e9)) // PIECE_NS
        while self._pieces and self._pieces[0][0] < oldest:
            self._sum -= self._pieces.popleft()[1]
        # Rounding must not leave anything.
        self._sum = max(self._sum, 0.0) if self._pieces else 0.0
        return self._sum

    def until(self, now_ns: int) -> tuple[FloatArray, FloatArray]:
        """Return times (s, (N,), now is 0) within the window, and the way (V, (N,)) until each of them."""
        self.within(now_ns)
        pieces = np.array([number for number, _ in self._pieces], dtype=np.int64) * PIECE_NS - now_ns
        times = np.minimum(np.stack([pieces, pieces + PIECE_NS], 1), 0).ravel() * 1e-9
        ways = np.cumsum([0.0, *(way for _, way in self._pieces)])
        return times, np.stack([ways[:-1], ways[1:]], 1).ravel()

    def copy(self) -> "Travelled":
        """Return an independent copy."""
        return Travelled(tuple(self._pieces))


def highest_mean_rate(t: FloatArray, v: FloatArray, window: float = WINDOW) -> float:
    """Return the highest mean of |dV/dt| (V/s) over a window (s) of voltages (V, (N,)) at times (s, (N,)).

    The voltage rests before and after them.
    """
    way = np.concatenate(([0.0], np.cumsum(np.abs(np.diff(v)))))
    # The highest one begins or ends at a sample.
    begins, ends = np.interp(t + window, t, way) - way, way - np.interp(t - window, t, way)
    return float(max(np.max(begins, initial=0.0), np.max(ends, initial=0.0))) / window


def slower_by(t: FloatArray, v: FloatArray, limit: float) -> float:
    """Return the factor by which voltages (V, (N,)) at times (s, (N,)) must be slower for a mean rate (V/s)."""

    def too_fast(factor: float) -> bool:
        # As `Travelled` counts. Slower by a factor, the window holds that part less of the path.
        window = (WINDOW + PIECE_NS * 1e-9) / factor
        return highest_mean_rate(t, v, window) * window > limit * WINDOW

    if not too_fast(1.0):
        return 1.0
    low, high = 1.0, 2.0
    while too_fast(high):
        low, high = high, 2.0 * high
    return _bisected(low, high, too_fast)


def later_by(before: Travelled, now_ns: int, t: FloatArray, v: FloatArray, limit: float) -> float:
    """Return by how much later (s) voltages must begin for a mean rate (V/s) that holds the way before them, too.

    Voltages (V, (N,)) at times (s, (N,)) from now on, that keep the mean rate by themselves.
    """
    times, ways = before.until(now_ns)
    if not times.size or not t.size:
        return 0.0
    window = WINDOW + PIECE_NS * 1e-9
    every = np.concatenate((ways, ways[-1] + np.concatenate(([0.0], np.cumsum(np.abs(np.diff(v)))))))

    def too_fast(seconds: float) -> bool:
        begin, later = t[0] + seconds, np.concatenate((times, t + seconds))
        # The highest mean begins before the voltages, and ends among them: one of both at a sample.
        ends = np.concatenate((t + seconds, times + window))
        ends = ends[ends > begin]
        most = np.max(np.interp(ends, later, every) - np.interp(ends - window, later, every), initial=0.0)
        return bool(most > limit * WINDOW * (1.0 + ROUNDING))

    if not too_fast(0.0):
        return 0.0
    return _bisected(0.0, window, too_fast)


def _bisected(low: float, high: float, too_fast: Callable[[float], bool]) -> float:
    """Return the least number that is not too fast, between `low`, which is, and `high`, which is not."""
    for _ in range(HALVINGS):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if too_fast(middle) else (low, middle)
    return high
