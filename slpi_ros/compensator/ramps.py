"""Motion of an axis without desired displacements: voltage ramps, and deceleration to rest."""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from math import inf

from slpi_ros.errors import UsageError
from slpi_ros.model.limits import RateLimiter

# Sample period of a ramp, seconds.
PERIOD = 0.004
# Distance at which a target voltage counts as reached, volts: covers rounding, and the slow end of a deceleration.
NEAR = 1e-9


@dataclass(frozen=True)
class Safety:
    """Reaction to a command timeout and to deactivation.

    Parameters
    ----------
    command_timeout : float, seconds
        Timeout of the command watchdog; 0 disables the watchdog.
    ramps_on_timeout, ramps_on_deactivate : bool
        Whether to ramp to the safe voltages at a timeout, and at deactivation; if False, the voltages are held.
    voltages : tuple of float, length of axes, volts
        Safe voltage of each axis.
    rate : float, V/s
        Rate of the ramp to the safe voltages.
    """

    command_timeout: float
    ramps_on_timeout: bool
    ramps_on_deactivate: bool
    voltages: tuple[float, ...]
    rate: float


class Ramp:
    """Voltage ramp through a sequence of target voltages, each reached before the next one is approached.

    Parameters
    ----------
    goals : iterable of float, volts
    rate : float, V/s
        Maximum rate of change, further limited by the slew limit.

    Raises
    ------
    UsageError
        If the rate is not positive, or a target voltage is not finite.
    """

    def __init__(self, goals: Iterable[float], rate: float) -> None:
        self._goals = list(goals)[::-1]
        self._rate = rate
        if not rate > 0.0 or not all(-inf < goal < inf for goal in self._goals):
            raise UsageError(f"a ramp at {rate} V/s through {self._goals[::-1]} V; give a positive rate, finite goals")

    @property
    def done(self) -> bool:
        """Whether the last target voltage has been reached."""
        return not self._goals

    def step(self, present: float, dt: float, pace: RateLimiter) -> float:
        """Return the voltage (V) `dt` (s, at most `MAX_DT`) after `present` (V), as the rate limiter `pace` allows."""
        if self.done:
            return present
        limits, dt = pace.limits, pace.clamp_dt(dt)
        goal = limits.clip(self._goals[-1])
        # An axis that moves faster than the ramp is decelerated within its acceleration limit.
        fastest = max(self._rate, abs(pace.rate) - limits.acceleration * dt) if dt else inf
        slowed = RateLimiter(replace(limits, slew=min(limits.slew, fastest)))
        slowed.go_on(pace)
        v = slowed.step(present, goal, dt)
        pace.go_on(slowed)
        if abs(v - goal) <= NEAR:
            self._goals.pop()
        return v


class Brake:
    """Deceleration to rest within the acceleration limit.

    Attributes
    ----------
    done : bool
        Whether the voltage is at rest.
    """

    def __init__(self) -> None:
        self.done = False

    def step(self, present: float, dt: float, pace: RateLimiter) -> float:
        """Return the voltage (V) `dt` (s) after `present` (V), as the rate limiter `pace` allows."""
        v = pace.step(present, present, pace.clamp_dt(dt))
        self.done = not pace.in_motion
        return v
