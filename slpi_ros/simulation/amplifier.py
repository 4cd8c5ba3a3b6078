"""What happens to a voltage between the record and the piezo: it comes late, rounded, clipped."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from slpi_ros.errors import UsageError
from slpi_ros.simulation.relaxation import Relaxation

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class Amplifier:
    """An amplifier between the recorded command and the piezo.

    Parameters
    ----------
    delay : float, seconds
        By which the command comes late; less than 0: the displacement is stamped late. Before the first sample the
        command was what it is there.
    lag : float, seconds
        Time constant; 0 for none.
    lower, upper : float, volts
        What it can give at least and at most.
    softness : float, volts
        Width of the bend before either limit: within about this distance of it, the output falls behind already; 0 for
        a sharp one.

    Raises
    ------
    UsageError
        If no command gets through.
    """

    delay: float = 0.0
    lag: float = 0.0
    lower: float = -math.inf
    upper: float = math.inf
    softness: float = 0.0

    def __post_init__(self) -> None:
        """Refuse what is no amplifier."""
        if not self.lower < self.upper or self.lag < 0 or self.softness < 0 or not math.isfinite(self.delay):
            raise UsageError(f"stage: {self} gives nothing; limits must be in order, lag and softness 0 or more")

    @property
    def clips(self) -> bool:
        """Whether there is a limit."""
        return math.isfinite(self.lower) or math.isfinite(self.upper)

    def run(self, t: FloatArray, command: FloatArray) -> FloatArray:
        """Return the voltage at the piezo.

        Parameters
        ----------
        t : ndarray, shape (N,), seconds
            In order.
        command : ndarray, shape (N,), volts
            Linear between samples.

        Returns
        -------
        ndarray, shape (N,), volts
            At the same times.
        """
        return self._clip(self._lag(t, np.interp(t - self.delay, t, command) if self.delay else command))

    def _lag(self, t: FloatArray, command: FloatArray) -> FloatArray:
        if not self.lag or not t.size:
            return command
        element, rest = Relaxation(np.array([self.lag])), float(command[0])
        steps = zip(np.diff(t, prepend=t[0]).tolist(), (command - rest).tolist(), strict=True)
        return np.array([rest + element.step(duration, value)[0] for duration, value in steps])

    def _clip(self, voltage: FloatArray) -> FloatArray:
        below = voltage - self._bent(voltage - self.upper)
        return below + self._bent(self.lower - below)

    def _bent(self, beyond: FloatArray) -> FloatArray:
        """Return how much of a voltage is lost that goes so far beyond a limit, volts."""
        if not self.softness:
            return np.maximum(beyond, 0.0)
        return self.softness * np.logaddexp(0.0, beyond / self.softness)
