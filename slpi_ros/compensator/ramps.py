"""All axes driven on their own: to a safe voltage, or to a known memory."""

from collections.abc import Iterable
from dataclasses import replace
from math import inf

from slpi_ros.errors import UsageError
from slpi_ros.model.streaming import RateLimiter

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

    def step(self, present: float, dt: float, pace: RateLimiter) -> float:
        """Return the voltage (V) that follows `present` (V) after `dt` (s); a pause frees no longer way than usual."""
        if self.done:
            return present
        limits, dt = pace.limits, pace.clamp_dt(dt)
        goal = limits.clip(self._goals[-1])
        # Where it is too fast at first, it has to brake.
        fastest = max(self._rate, abs(pace.rate) - limits.acceleration * dt) if dt else inf
        own = RateLimiter(replace(limits, slew=min(limits.slew, fastest)))
        own.go_on(pace)
        v = own.step(present, goal, dt)
        pace.go_on(own)
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
