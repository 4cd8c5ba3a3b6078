"""Dynamics of a stage: the amplifier before the hysteresis; rate dependence; creep and a flexure mode after it."""

import math

import numpy as np

from slpi_ros.arrays import FloatArray
from slpi_ros.errors import UsageError
from slpi_ros.simulation.parameters import StageParameters

# Shortest step (s); in a shorter one the input jumps, because its slope would cause a loss of precision.
SHORTEST_STEP = 1e-12


class Relaxation:
    """First-order elements with a common input and individual time constants, ``tau_j dz_j/dt = u - z_j``.

    The update is exact for steps of any length if the input is linear between samples (first-order hold).
    `time_constants`, shape (n,), are in seconds and more than 0.
    """

    def __init__(self, time_constants: FloatArray) -> None:
        self._rate = 1.0 / time_constants
        self.rest()

    def rest(self) -> None:
        """Reset the input and all elements to 0."""
        self._input = 0.0
        self._state: FloatArray = np.zeros_like(self._rate)

    def step(self, duration: float, value: float) -> FloatArray:
        """Advance by `duration` (s) with the input changing linearly to `value`; return the elements, shape (n,).

        In less than `SHORTEST_STEP` the input jumps, and the elements are unchanged.
        """
        if duration >= SHORTEST_STEP:
            x = duration * self._rate
            left = self._state - self._input
            self._state = value + np.exp(-x) * left + np.expm1(-x) / x * (value - self._input)
        self._input = value
        return self._state


class FlexureMode:
    """A second-order mode, ``d2x/dt2 + 2 z w dx/dt + w^2 x = w^2 u``, with a static gain of 1.

    The update is exact for steps of any length if the input is linear between samples (first-order hold): the response
    to the ramp in steady state is known, and the deviation decays by the closed-form matrix exponential. `frequency`
    (Hz) is ``w / 2 pi``, undamped; `damping` is the ratio ``z``, from 0 to below 1.
    """

    def __init__(self, frequency: float, damping: float) -> None:
        self._omega = 2 * math.pi * frequency
        self._damping = damping
        self.rest()

    def rest(self) -> None:
        """Reset position and velocity to 0."""
        self._input = self._position = self._velocity = 0.0

    def step(self, duration: float, value: float) -> float:
        """Advance by `duration` (s) with the input changing linearly to `value` (m); return the position (m).

        In less than `SHORTEST_STEP` the input jumps, and the position is unchanged.
        """
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
    """Logarithmic creep: parallel relaxations with logarithmically spaced time constants.

    The displacement is ``y = h + sum_j g_j z_j`` with ``tau_j dz_j/dt = h - z_j``, exact if ``h`` is linear between
    samples. All ``g_j`` (`gains`, shape (n,)) are equal, so that after a step of ``h`` the displacement grows by `gain`
    times the step per decade of time between the time constants `shortest` and `longest` (s), after which the creep is
    complete. `time_constants` (s, shape (n,)) are at least two per decade. Under a periodic input the peaks fall as
    ``f^b``, with ``b`` near ``-gain / ln 10``.
    """

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


class Dynamics:
    """Amplifier lag, creep and flexure mode of one axis; each is optional."""

    def __init__(self, parameters: StageParameters) -> None:
        p = parameters
        self._amplifier = Relaxation(np.array([p.amplifier_lag])) if p.amplifier_lag else None
        self._creep = Creep(p.creep_gain, p.creep_shortest, p.creep_longest) if p.creep_gain else None
        self._mode = FlexureMode(p.resonance_frequency, p.resonance_damping) if p.resonance_frequency else None
        self.rest()

    def rest(self) -> None:
        """Reset all states and the clock."""
        self._time: float | None = None
        for part in (self._amplifier, self._creep, self._mode):
            if part:
                part.rest()

    def advance(self, t: float) -> float:
        """Set the clock to `t` (s) and return the time (s) since the previous call, 0 after a reset.

        UsageError if the time is not finite or decreases.
        """
        last = t if self._time is None else self._time
        if not last <= t < math.inf:
            raise UsageError(f"stage: time {t} s after {last} s; times must be finite and non-decreasing")
        self._time = t
        return t - last

    def amplify(self, duration: float, command: float) -> float:
        """Return the voltage at the piezo (V) after the command has changed to `command` (V) in `duration` (s)."""
        return float(self._amplifier.step(duration, command)[0]) if self._amplifier else command

    def follow(self, duration: float, displacement: float) -> float:
        """Return the stage position (m) after the hysteresis has moved to `displacement` (m) in `duration` (s)."""
        crept = self._creep.step(duration, displacement) if self._creep else displacement
        return self._mode.step(duration, crept) if self._mode else crept
