"""First-order lags in parallel: what creep and an amplifier are made of."""

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

# Seconds. In less time an input jumps: its slope would cost the state its last digits.
SHORTEST_STEP = 1e-12


class Relaxation:
    """Elements that each follow one common input with a time constant of their own, ``tau_j dz_j/dt = u - z_j``.

    The update is exact, for steps of any length, where the input is linear between two samples (first-order hold).

    Parameters
    ----------
    time_constants : ndarray, shape (n,), seconds
        More than 0.
    """

    def __init__(self, time_constants: FloatArray) -> None:
        self._rate = 1.0 / time_constants
        self.rest()

    def rest(self) -> None:
        """Return to rest: input and elements at 0."""
        self._input = 0.0
        self._state: FloatArray = np.zeros_like(self._rate)

    def step(self, duration: float, value: float) -> FloatArray:
        """Let time pass while the input goes to a value.

        Parameters
        ----------
        duration : float, seconds
            0 or more; in less than `SHORTEST_STEP` the input jumps and the elements stay.
        value : float
            The input at the end of the step.

        Returns
        -------
        ndarray, shape (n,), in the unit of the input
            The elements at the end of the step.
        """
        if duration >= SHORTEST_STEP:
            x = duration * self._rate
            left = self._state - self._input
            self._state = value + np.exp(-x) * left + np.expm1(-x) / x * (value - self._input)
        self._input = value
        return self._state
