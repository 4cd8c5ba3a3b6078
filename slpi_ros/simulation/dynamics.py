"""What makes a stage depend on time: the amplifier before the hysteresis, creep and a flexure mode behind it."""

import math

import numpy as np

from slpi_ros.errors import UsageError
from slpi_ros.simulation.creep import Creep
from slpi_ros.simulation.mechanics import FlexureMode
from slpi_ros.simulation.parameters import StageParameters
from slpi_ros.simulation.relaxation import Relaxation


class Dynamics:
    """Amplifier lag, creep and flexure mode of one axis; each may be absent.

    Parameters
    ----------
    parameters : StageParameters
        Of which `amplifier_lag`, the ones of creep and those of the resonance are used.
    """

    def __init__(self, parameters: StageParameters) -> None:
        p = parameters
        self._amplifier = Relaxation(np.array([p.amplifier_lag])) if p.amplifier_lag else None
        self._creep = Creep(p.creep_gain, p.creep_shortest, p.creep_longest) if p.creep_gain else None
        self._mode = FlexureMode(p.resonance_frequency, p.resonance_damping) if p.resonance_frequency else None
        self.rest()

    def rest(self) -> None:
        """Forget the past and the time."""
        self._time: float | None = None
        for part in (self._amplifier, self._creep, self._mode):
            if part:
                part.rest()

    def advance(self, t: float) -> float:
        """Set the clock.

        Parameters
        ----------
        t : float, seconds
            Not before the last one.

        Returns
        -------
        float, seconds
            Time passed since the last call; 0 for the first one after rest.

        Raises
        ------
        UsageError
            If the time is not finite or before the last one.
        """
        last = t if self._time is None else self._time
        if not last <= t < math.inf:
            raise UsageError(f"stage: time {t} s after {last} s; times must be finite and never go back")
        self._time = t
        return t - last

    def amplify(self, duration: float, command: float) -> float:
        """Return the voltage at the piezo (V) once the command (V) has been reached in `duration` (s)."""
        return float(self._amplifier.step(duration, command)[0]) if self._amplifier else command

    def follow(self, duration: float, displacement: float) -> float:
        """Return where the stage is (m) once the hysteresis has gone to `displacement` (m) in `duration` (s)."""
        crept = self._creep.step(duration, displacement) if self._creep else displacement
        return self._mode.step(duration, crept) if self._mode else crept
