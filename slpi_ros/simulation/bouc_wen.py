"""A piezo stage with the Bouc-Wen equation, whose minor loops do not close."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from slpi_ros.errors import UsageError

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class BoucWen:
    """Displacement ``y = d v - h`` with ``dh = a d dv - b h |dv| - c |h| dv``: exponent 1, rate-independent.

    Between two reversals the equation is linear where the sign of ``h`` is constant, and is solved in closed form. It
    has no return-point memory: a minor loop does not return to its start.

    Parameters
    ----------
    gain : float, m/V
        Slope of the linear part, ``d``.
    share : float
        Initial slope of the hysteretic variable after a reversal, ``a``, as a share of `gain`, between 0 and 1.
    softening, asymmetry : float, 1/V
        Constants ``b`` and ``c``; ``b`` exceeds the magnitude of ``c``.
    offset : float, metres
        Displacement at rest at 0 V.

    References
    ----------
    T. S. Low, W. Guo, Modeling of a three-layer piezoelectric bimorph beam with hysteresis, J. MEMS 4 (1995).

    Raises
    ------
    UsageError
        If the parameters are invalid.
    """

    gain: float = 0.25e-6
    share: float = 0.35
    softening: float = 0.025
    asymmetry: float = 0.01
    offset: float = 0.0

    def __post_init__(self) -> None:
        """Validate the parameters."""
        if not (self.gain > 0 and 0 < self.share < 1 and self.softening > abs(self.asymmetry)):
            raise UsageError(f"stage: {self} is none; give more softening than asymmetry, and a share between 0 and 1")

    def run(self, v: FloatArray) -> FloatArray:
        """Return the displacement for a voltage signal, starting from rest at 0 V.

        Parameters
        ----------
        v : ndarray, shape (N,), volts
            Voltage, linear between samples.

        Returns
        -------
        ndarray, shape (N,), metres
            The displacement.
        """
        h, last, hysteretic = 0.0, 0.0, np.empty(v.size)
        for index, voltage in enumerate(v.tolist()):
            h = self._move(h, voltage - last)
            hysteretic[index], last = h, voltage
        return self.offset + self.gain * v - hysteretic

    def _move(self, h: float, dv: float) -> float:
        """Return the hysteretic variable (m) after a linear voltage change `dv` (V)."""
        # A fall is the mirror image of a rise.
        way, left = (1.0, dv) if dv >= 0 else (-1.0, -dv)
        h *= way
        slope = self.share * self.gain
        if h < 0.0:
            rate = self.softening - self.asymmetry
            to_zero = math.log1p(-h * rate / slope) / rate
            if to_zero >= left:
                return way * _relaxed(h, slope / rate, rate * left)
            h, left = 0.0, left - to_zero
        rate = self.softening + self.asymmetry
        return way * _relaxed(h, slope / rate, rate * left)


def _relaxed(start: float, end: float, constants: float) -> float:
    return end + (start - end) * math.exp(-constants)
