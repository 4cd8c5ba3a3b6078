"""The displacement sensor of a simulated stage."""

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]


class Sensor:
    """A sensor with Gaussian noise and a last digit.

    Parameters
    ----------
    noise_rms : float, metres
        Standard deviation of the noise.
    quantisation : float, metres
        Step of the readings; 0 for none.
    seed : int
        The same seed gives the same noise.
    """

    def __init__(self, noise_rms: float, quantisation: float, seed: int) -> None:
        self._noise_rms = noise_rms
        self._quantisation = quantisation
        self._rng = np.random.default_rng(seed)

    def read(self, displacement: FloatArray) -> FloatArray:
        """Read displacements one after the other.

        Parameters
        ----------
        displacement : ndarray, any shape, metres
            What the stage does.

        Returns
        -------
        ndarray, same shape, metres
            What the sensor says.
        """
        reading = displacement + self._noise_rms * self._rng.standard_normal(displacement.shape)
        if self._quantisation:
            reading = self._quantisation * np.round(reading / self._quantisation)
        return np.asarray(reading, dtype=np.float64)
