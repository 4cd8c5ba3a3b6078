"""Creep of a piezo stage: after every move it goes on, as much in each decade of time as in the one before."""

import math

import numpy as np

from slpi_ros.simulation.relaxation import Relaxation

_ELEMENTS_PER_DECADE = 2


class Creep:
    """Log-time creep: a chain of relaxations whose time constants are evenly spaced in log time.

    The displacement is ``y = h + sum_j g_j z_j`` with ``tau_j dz_j/dt = h - z_j``, exact where ``h`` is linear between
    samples. All ``g_j`` are alike, so that after a step of ``h`` the displacement grows by `gain` of it in each decade
    between `shortest` and `longest`. Under periodic drive the peaks fall as ``f^b``, with ``b`` near ``-gain / ln 10``.

    Parameters
    ----------
    gain : float
        Creep in one decade of time, as a share of ``h``.
    shortest, longest : float, seconds
        Between these the time constants lie; longer than the first, the creep is over.

    Attributes
    ----------
    time_constants : ndarray, shape (n,), seconds
        Two or more for each decade.
    gains : ndarray, shape (n,)
        Shares of ``h``; their sum is `gain` times the number of decades.
    """

    def __init__(self, gain: float, shortest: float, longest: float) -> None:
        decades = math.log10(longest / shortest)
        count = math.ceil(_ELEMENTS_PER_DECADE * decades)
        self.time_constants = shortest * 10 ** (decades * (np.arange(count) + 0.5) / count)
        self.gains = np.full(count, gain * decades / count)
        self._chain = Relaxation(self.time_constants)

    def rest(self) -> None:
        """Forget the past, as after a long time at 0."""
        self._chain.rest()

    def step(self, duration: float, value: float) -> float:
        """Let time pass while the hysteresis goes to a value.

        Parameters
        ----------
        duration : float, seconds
            0 or more.
        value : float, metres
            Displacement without creep at the end of the step.

        Returns
        -------
        float, metres
            Displacement with creep.
        """
        return value + float(self.gains @ self._chain.step(duration, value))

    def after_ramp(self, duration: float) -> float:
        """Return what a ramp from rest has become at its end, as a multiple of its end without creep.

        Parameters
        ----------
        duration : float, seconds
            Of the ramp, more than 0.

        Returns
        -------
        float
            1 plus the creep.
        """
        chain = Relaxation(self.time_constants)
        return 1.0 + float(self.gains @ chain.step(duration, 1.0))
