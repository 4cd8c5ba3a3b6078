"""Driving an axis on its own, at a rate: through given voltages to the last of them."""

from collections.abc import Iterable
from dataclasses import replace
from math import inf

from slpi_ros.errors import UsageError
from slpi_ros.stream import LONGEST_STEP, Pace

# So near a voltage counts as reached, volts: rounding, and the slow end of a gentle stop.
NEAR = 1e-9


class Ramp:
    """A way through voltages, each reached before the next one.

    Parameters
    ----------
    goals : iterable of float, volts
    rate : float, V/s
        Fastest change; the slew limit may be lower.

    Raises
    ------
    UsageError
        If the rate is not positive, or a goal not finite.
    """

    def __init__(self, goals: Iterable[float], rate: float) -> None:
        self._goals = list(goals)[::-1]
        self._rate = rate
        if not rate > 0.0 or not all(-inf < goal < inf for goal in self._goals):
            raise UsageError(f"a ramp at {rate} V/s through {self._goals[::-1]} V leads nowhere; give a positive rate")

    @property
    def done(self) -> bool:
        """Whether the last goal is reached."""
        return not self._goals

    def step(self, present: float, dt: float, pace: Pace) -> float:
        """Return the voltage (V) that follows `present` (V) after `dt` (s); a pause frees no longer way than usual."""
        if self.done:
            return present
        limits = pace.limits
        goal = limits.clip(self._goals[-1])
        own = Pace(replace(limits, slew=min(limits.slew, self._rate)))
        own.rate = pace.rate
        v = own.step(present, goal, min(dt, LONGEST_STEP))
        pace.rate = own.rate
        if abs(v - goal) <= NEAR:
            self._goals.pop()
        return v
