"""What every fit hands back."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from slpi_ros.hysteresis.kinds import Hysteresis
from slpi_ros.model.stage_model import Start

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class Fitted:
    """A fitted hysteresis model.

    Parameters
    ----------
    hysteresis : Hysteresis
    start : Start
    y : ndarray, shape (number fitted,), metres
        Displacements it was fitted to.
    voltage_range : (float, float), volts
        Covered by them.
    errors : ndarray, shape (number fitted,), metres
        Model minus measurement, free-run, on the samples fitted.
    held_out : ndarray, shape (N,), metres
        Error of every sample given, on blocks left out of the fit: model minus measurement, free-run; NaN where a
        sample never was left out.
    covered : float
        Share of the model that the samples determine, 0..1.
    """

    hysteresis: Hysteresis
    start: Start
    y: FloatArray
    voltage_range: tuple[float, float]
    errors: FloatArray
    held_out: FloatArray
    covered: float

    @property
    def held_out_rms(self) -> float:
        """Error on blocks left out of the fit, metres; every sample counts alike."""
        return float(np.sqrt(np.nanmean(self.held_out**2)))
