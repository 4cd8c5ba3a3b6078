"""Uneven stamps: signals go to an even grid, through a filter, and back."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

# Stamps that stray by less than this share of a step are even.
EVEN = 0.01
# The grid has at most so many points for each sample.
FINEST = 4


@dataclass(frozen=True)
class Uniform:
    """An even grid over some stamps.

    Parameters
    ----------
    t : ndarray, shape (N,), seconds
        The stamps, not decreasing.
    grid : ndarray, shape (M,), seconds
        The same as `t` where that is even.
    dt : float, seconds
        Step of the grid; 0 where no time passes.
    """

    t: FloatArray
    grid: FloatArray
    dt: float

    @classmethod
    def over(cls, t: FloatArray) -> "Uniform":
        """Return the grid over stamps `t`, shape (N,), seconds: at their median step, and not too fine."""
        span = float(t[-1] - t[0]) if t.size else 0.0
        if span <= 0.0:
            return cls(t, t, 0.0)
        dt = span / (t.size - 1)
        even = t[0] + dt * np.arange(t.size)
        if np.abs(t - even).max() <= EVEN * dt:
            return cls(t, t, dt)
        step = max(float(np.median(np.diff(t))), span / (FINEST * t.size))
        points = int(np.ceil(span / step)) + 1
        return cls(t, np.linspace(t[0], t[-1], points), span / (points - 1))

    def on(self, signal: FloatArray) -> FloatArray:
        """Return a signal, shape (N,), on the grid, shape (M,)."""
        return signal if self.grid is self.t else np.interp(self.grid, self.t, signal)

    def off(self, signal: FloatArray) -> FloatArray:
        """Return a signal on the grid, shape (M,), at the stamps, shape (N,)."""
        return signal if self.grid is self.t else np.interp(self.t, self.grid, signal)
