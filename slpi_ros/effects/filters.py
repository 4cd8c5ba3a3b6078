"""A lightly damped second-order mode, exact where its input is linear between samples (first-order hold)."""

from dataclasses import dataclass
from math import cos, exp, sin, sqrt

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class Mode:
    """``y'' + 2 z w y' + w^2 y = w^2 h``.

    Parameters
    ----------
    omega : float, rad/s
        ``w``, undamped.
    damping : float
        ``z``, from above 0 to below 1.
    """

    omega: float
    damping: float

    @property
    def lag(self) -> float:
        """How much later than its input the mode follows a ramp, seconds."""
        return 2 * self.damping / self.omega

    def free(self, dt: float) -> tuple[float, float, float, float]:
        """Return the matrix, row by row, that moves position and velocity on over `dt` (s) without input."""
        decay_rate, rate = self.damping * self.omega, self.omega * sqrt(1 - self.damping**2)
        decay = exp(-decay_rate * dt)
        cosine, sine = decay * cos(rate * dt), decay * sin(rate * dt) / rate
        return cosine + decay_rate * sine, sine, -(self.omega**2) * sine, cosine - decay_rate * sine

    def ringing(self, dt: float) -> tuple[float, float]:
        """Return sum and product of the two poles ``exp(s dt)``."""
        decay = exp(-self.damping * self.omega * dt)
        return 2 * decay * cos(self.omega * sqrt(1 - self.damping**2) * dt), decay * decay

    def transfer(self, dt: float) -> tuple[FloatArray, FloatArray]:
        """Return numerator and denominator, shape (3,) each, of the mode sampled every `dt` (s)."""
        m11, m12, m21, m22 = self.free(dt)
        late = self.lag / dt
        # Position and velocity after a step: by the input before it, and by the input at its end.
        position = late - m11 * (1 + late) + m12 / dt, 1 - late + m11 * late - m12 / dt
        velocity = -1 / dt - m21 * (1 + late) + m22 / dt, 1 / dt + m21 * late - m22 / dt
        total, product = self.ringing(dt)
        middle = position[0] - m22 * position[1] + m12 * velocity[1]
        numerator = np.array([position[1], middle, m12 * velocity[0] - m22 * position[0]])
        denominator = np.array([1.0, -total, product])
        # Rounding must not change what the mode makes of a rest.
        return numerator * (denominator.sum() / numerator.sum()), denominator
