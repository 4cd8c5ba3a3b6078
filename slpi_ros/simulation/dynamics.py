"""Linear dynamics of a stage: relaxations, as of an amplifier, a flexure mode, and creep."""

import math

import numpy as np

from slpi_ros.arrays import FloatArray

# Shortest step (s); in a shorter one the input jumps, because its slope would cause a loss of precision.
SHORTEST_STEP = 1e-12


class Relaxation:
    """First-order elements with one input and time constants (s, (n,)), ``tau_j dz_j/dt = u - z_j``."""

    # The update is exact for steps of any length if the input is linear between samples (first-order hold).

    def __init__(self, time_constants: FloatArray) -> None:
        self._rate = 1.0 / time_constants
        self.rest()

    def rest(self) -> None:
        """Reset the input and all elements to 0."""
        self._input = 0.0
        self._state: FloatArray = np.zeros_like(self._rate)

    def step(self, duration: float, value: float) -> FloatArray:
        """Advance by `duration` (s) with the input changing linearly to `value`; return the elements, shape (n,)."""
        # In less than `SHORTEST_STEP` the input jumps, and the elements are unchanged.
        if duration >= SHORTEST_STEP:
            x = duration * self._rate
            left = self._state - self._input
            self._state = value + np.exp(-x) * left + np.expm1(-x) / x * (value - self._input)
        self._input = value
        return self._state


class FlexureMode:
    """A second-order mode, ``d2x/dt2 + 2 z w dx/dt + w^2 x = w^2 u``, with ``w`` in rad/s and damping ``z``."""

    # The update is exact for steps of any length if the input is linear between samples (first-order hold): the
    # response to the ramp in steady state is known, and the deviation decays by the closed-form matrix exponential.

    def __init__(self, frequency: float, damping: float) -> None:
        self._omega = 2 * math.pi * frequency
        self._damping = damping
        self.rest()

    def rest(self) -> None:
        """Reset position and velocity to 0."""
        self._input = self._position = self._velocity = 0.0

    def step(self, duration: float, value: float) -> float:
        """Advance by `duration` (s) with the input changing linearly to `value` (m); return the position (m)."""
        if duration >= SHORTEST_STEP:
            slope = (value - self._input) / duration
            lag = 2 * self._damping * slope / self._omega
            position, velocity = self._ringing(duration, self._position - self._input + lag, self._velocity - slope)
            self._position, self._velocity = value - lag + position, slope + velocity
        self._input = value
        return self._position

    def _ringing(self, duration: float, position: float, velocity: float) -> tuple[float, float]:
        """Return position and velocity after a free oscillation over `duration` (s)."""
        decay_rate = self._damping * self._omega
        ringing_rate = self._omega * math.sqrt(1 - self._damping**2)
        decay = math.exp(-decay_rate * duration)
        cosine, sine = math.cos(ringing_rate * duration), math.sin(ringing_rate * duration) / ringing_rate
        return (
            decay * (position * cosine + (velocity + decay_rate * position) * sine),
            decay * (velocity * cosine - (self._omega**2 * position + decay_rate * velocity) * sine),
        )


_ELEMENTS_PER_DECADE = 2


class Creep:
    """Logarithmic creep, ``y = h + sum_j g_j z_j`` with ``tau_j dz_j/dt = h - z_j``, exact if ``h`` is linear."""

    # All ``g_j`` are equal, so that after a step of ``h`` the displacement grows by `gain` times the step per decade of
    # time between the time constants `shortest` and `longest` (s). Under a periodic input the peaks fall as ``f^b``,
    # with ``b`` near ``-gain / ln 10``.

    def __init__(self, gain: float, shortest: float, longest: float) -> None:
        decades = math.log10(longest / shortest)
        count = math.ceil(_ELEMENTS_PER_DECADE * decades)
        self.time_constants = shortest * 10 ** (decades * (np.arange(count) + 0.5) / count)
        self.gains = np.full(count, gain * decades / count)
        self._chain = Relaxation(self.time_constants)

    def rest(self) -> None:
        """Reset to equilibrium at 0."""
        self._chain.rest()

    def step(self, duration: float, value: float) -> float:
        """Advance by `duration` (s) with the input changing linearly to `value` (m); return it with creep (m)."""
        return value + float(self.gains @ self._chain.step(duration, value))

    def after_ramp(self, duration: float) -> float:
        """Return the ratio of displacements with and without creep at the end of a ramp from rest in `duration` (s)."""
        chain = Relaxation(self.time_constants)
        return 1.0 + float(self.gains @ chain.step(duration, 1.0))
