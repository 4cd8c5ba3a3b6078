"""The lightly damped mode of a flexure that carries a mass."""

import math

from slpi_ros.simulation.relaxation import SHORTEST_STEP


class FlexureMode:
    """A second-order mode, ``d2x/dt2 + 2 z w dx/dt + w^2 x = w^2 u``, with a static gain of 1.

    The update is exact, for steps of any length, where the input is linear between two samples (first-order hold): the
    steady answer to the ramp is known, and what differs from it decays by the closed form of the matrix exponential.

    Parameters
    ----------
    frequency : float, hertz
        Undamped, ``w / 2 pi``.
    damping : float
        Damping ratio ``z``, from 0 to below 1.
    """

    def __init__(self, frequency: float, damping: float) -> None:
        self._omega = 2 * math.pi * frequency
        self._damping = damping
        self.rest()

    def rest(self) -> None:
        """Return to rest at 0."""
        self._input = self._position = self._velocity = 0.0

    def step(self, duration: float, value: float) -> float:
        """Let time pass while the input goes to a value.

        Parameters
        ----------
        duration : float, seconds
            0 or more; in less than `SHORTEST_STEP` the input jumps and the mass stays.
        value : float, metres
            The input at the end of the step.

        Returns
        -------
        float, metres
            Position of the mass at the end of the step.
        """
        if duration >= SHORTEST_STEP:
            slope = (value - self._input) / duration
            lag = 2 * self._damping * slope / self._omega
            position, velocity = self._ringing(duration, self._position - self._input + lag, self._velocity - slope)
            self._position, self._velocity = value - lag + position, slope + velocity
        self._input = value
        return self._position

    def _ringing(self, duration: float, position: float, velocity: float) -> tuple[float, float]:
        """Return position and velocity of the free motion from the given ones."""
        decay_rate = self._damping * self._omega
        ringing_rate = self._omega * math.sqrt(1 - self._damping**2)
        decay = math.exp(-decay_rate * duration)
        cosine, sine = math.cos(ringing_rate * duration), math.sin(ringing_rate * duration) / ringing_rate
        return (
            decay * (position * cosine + (velocity + decay_rate * position) * sine),
            decay * (velocity * cosine - (self._omega**2 * position + decay_rate * velocity) * sine),
        )
