"""Materials of a simulated stage: how its relays are spread over their thresholds, and the reversible curve."""

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from slpi_ros.simulation.parameters import StageParameters

FloatArray = NDArray[np.float64]


class Material(Protocol):
    """What a stage needs to know of its piezo."""

    def density(self, bias: FloatArray, width: FloatArray) -> FloatArray:
        """Return weights of relays by bias and width (V), any unit, for RelayTriangle."""

    def reversible(self, voltage: float) -> float:
        """Return the part of the displacement without memory, any unit, at a voltage (V)."""


class ExponentialMaterial:
    """Relays whose number falls exponentially with their width and changes with bias; a cubic reversible curve.

    Parameters
    ----------
    parameters : StageParameters
        Of which the threshold range, `width_scale` and `width_growth`, `bias_slope`, `bias_bow` and `curvature` are
        used.
    """

    def __init__(self, parameters: StageParameters) -> None:
        self._parameters = parameters
        low, high = parameters.threshold_min, parameters.threshold_max
        self._centre, self._half_range = (low + high) / 2, (high - low) / 2

    def density(self, bias: FloatArray, width: FloatArray) -> FloatArray:
        """Return weights of relays.

        Parameters
        ----------
        bias, width : ndarray, one shape, volts
            Mean of the two thresholds and their distance.

        Returns
        -------
        ndarray, same shape
            In arbitrary units.
        """
        # The fall with width changes with bias too: a mere product of the two would be too easy a stage.
        b = (bias - self._centre) / self._half_range
        scale = self._parameters.width_scale * (1 + self._parameters.width_growth * b)
        density = np.exp(self._parameters.bias_slope * b + self._parameters.bias_bow * b**2 - width / scale)
        return np.asarray(density, dtype=np.float64)

    def reversible(self, voltage: float) -> float:
        """Return the reversible part at a voltage (V), in arbitrary units."""
        x = (voltage - self._centre) / self._half_range
        return x + self._parameters.curvature * x**3


class PowerLawMaterial:
    """Relays without a scale of their own: loops of every amplitude look alike.

    With thresholds counted from `origin`, the density of relays that switch up at ``a`` and down at ``b <= a`` is
    ``mu(a, b) = a^(p-2) (b/a)^m``, ``p`` the `exponent` and ``m`` the `width_exponent`: a relay's width counts relative
    to its voltage, and the wider ones are rarer. Below the origin the density is its mirror image, and no relay has
    one threshold on either side: a preloaded stack comes back to where it started. The sum over a triangle of relays
    is the Everett function

    ``E(a, b) = a^p [(1 - r^p) / p - (1 - r^(m+1)) / (m+1)] / (m+1-p)``, ``r = b/a``,

    homogeneous of degree ``p``. The rise from the origin is ``V^p``, nearly straight where ``p`` is nearly 1; the fall
    has the slope ``r^(p-1) - r^m``, little after the turn and more and more later: for ``p = m = 1`` the parabola of
    Rayleigh's law, whose opening here grows with the amplitude and not with its square.

    Parameters
    ----------
    parameters : StageParameters
        Of which the threshold range, `levels`, `exponent`, `origin` and `width_exponent` are used.

    References
    ----------
    I. D. Mayergoyz, Mathematical Models of Hysteresis, Springer 1991, Sec. 1.2 (Everett function).
    """

    def __init__(self, parameters: StageParameters) -> None:
        self._origin, self._exponent = parameters.origin, parameters.exponent
        self._width_exponent = parameters.width_exponent
        self._half_cell = (parameters.threshold_max - parameters.threshold_min) / parameters.levels / 2

    def density(self, bias: FloatArray, width: FloatArray) -> FloatArray:
        """Return weights of relays, integrated over the cells of the grid.

        The middle of a cell does not stand for the cell close to the origin, where the loops of small amplitude live.

        Parameters
        ----------
        bias, width : ndarray, one shape, volts
            Mean of the two thresholds and their distance, in the middle of each cell.

        Returns
        -------
        ndarray, same shape
            In arbitrary units.
        """
        up, down = bias + width / 2, bias - width / 2
        up_low, up_high = up - self._half_cell, up + self._half_cell
        down_low, down_high = down - self._half_cell, down + self._half_cell
        outer = self.everett(up_high, down_low) + self.everett(up_low, down_high)
        return np.maximum(outer - self.everett(up_low, down_low) - self.everett(up_high, down_high), 0.0)

    def everett(self, up: FloatArray, down: FloatArray) -> FloatArray:
        """Return the sum of the relays that a fall from one voltage to another switches.

        Parameters
        ----------
        up, down : ndarray, one shape, volts
            Where the fall begins and ends; where it would rise, the sum is 0.

        Returns
        -------
        ndarray, same shape
            In arbitrary units.
        """
        a, b = up - self._origin, down - self._origin
        return self._above_origin(a, b) + self._above_origin(-b, -a)

    def reversible(self, voltage: float) -> float:
        """Return the reversible part at a voltage (V), in arbitrary units."""
        x = voltage - self._origin
        return float(np.sign(x) * abs(x) ** self._exponent)

    def _above_origin(self, up: FloatArray, down: FloatArray) -> FloatArray:
        p, m = self._exponent, self._width_exponent
        up = np.maximum(up, 0.0)
        ratio = np.divide(np.clip(down, 0.0, up), up, out=np.ones_like(up), where=up > 0)
        fall = (1 - ratio**p) / p - (1 - ratio ** (m + 1)) / (m + 1)
        return np.asarray(up**p * fall / (m + 1 - p), dtype=np.float64)


def material(parameters: StageParameters) -> Material:
    """Return the material of a stage.

    Parameters
    ----------
    parameters : StageParameters
        With an `exponent` relays spread by a power law, without one exponentially.

    Returns
    -------
    Material
        Its density and its reversible curve.
    """
    return PowerLawMaterial(parameters) if parameters.exponent else ExponentialMaterial(parameters)
