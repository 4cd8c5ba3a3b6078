"""Ways of an axis without desired displacements: to a voltage, through a decaying oscillation, or to rest."""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from math import inf

from slpi_ros.errors import UsageError
from slpi_ros.model.limits import RateLimiter

# Seconds from one voltage of a ramp to the next.
PERIOD = 0.004
# So near a voltage counts as reached, volts: rounding, and the slow end of a gentle stop.
NEAR = 1e-9


@dataclass(frozen=True)
class Safety:
    """What happens when commands end.

    Parameters
    ----------
    command_timeout : float, seconds
        0: none.
    ramps_on_timeout, ramps_on_deactivate : bool
        Whether to go to the safe voltages then; if not, voltages are held.
    voltages : tuple of float, volts
        The safe ones, one for each axis.
    rate : float, V/s
        How fast to go there.
    """

    command_timeout: float
    ramps_on_timeout: bool
    ramps_on_deactivate: bool
    voltages: tuple[float, ...]
    rate: float


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
            raise UsageError(f"a ramp at {rate} V/s through {self._goals[::-1]} V; give a positive rate, finite goals")

    @property
    def done(self) -> bool:
        """Whether the last goal is reached."""
        return not self._goals

    def step(self, present: float, dt: float, pace: RateLimiter) -> float:
        """Return the voltage (V) that follows `present` (V) after `dt` (s), of which at most `MAX_DT` counts."""
        if self.done:
            return present
        limits, dt = pace.limits, pace.clamp_dt(dt)
        goal = limits.clip(self._goals[-1])
        # An axis that is faster than the ramp at first has to brake.
        fastest = max(self._rate, abs(pace.rate) - limits.acceleration * dt) if dt else inf
        slowed = RateLimiter(replace(limits, slew=min(limits.slew, fastest)))
        slowed.go_on(pace)
        v = slowed.step(present, goal, dt)
        pace.go_on(slowed)
        if abs(v - goal) <= NEAR:
            self._goals.pop()
        return v


class Brake:
    """A way to rest, as short as the limit of acceleration allows.

    Attributes
    ----------
    done : bool
        Whether the voltage may stay.
    """

    def __init__(self) -> None:
        self.done = False

    def step(self, present: float, dt: float, pace: RateLimiter) -> float:
        """Return the voltage (V) that follows `present` (V) after `dt` (s)."""
        v = pace.step(present, present, pace.clamp_dt(dt))
        self.done = not pace.in_motion
        return v
