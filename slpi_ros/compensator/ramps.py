"""Motion of an axis without desired displacements: voltage ramps, and deceleration to rest."""

from collections.abc import Iterable
from dataclasses import dataclass
from math import inf

from slpi_ros.errors import UsageError
from slpi_ros.model.limits import RateLimiter

# Distance at which a target voltage counts as reached, volts: covers rounding, and the slow end of a deceleration.
NEAR = 1e-9
# Share of the slew limit that planned motion uses, so that a late step can be made up.
PLANNED_SHARE = 0.8


@dataclass(frozen=True)
class Safety:
    """Reaction to a command timeout and to deactivation: hold the voltages, or ramp to the safe ones."""

    command_timeout: float  # s; 0 disables the watchdog
    ramps_on_timeout: bool
    ramps_on_deactivate: bool
    voltages: tuple[float, ...]  # V, one per axis
    rate: float  # V/s


class Ramp:
    """Voltage ramp through a sequence of target voltages, each reached before the next one is approached."""

    def __init__(self, goals: Iterable[float], rate: float) -> None:
        self._goals = list(goals)[::-1]  # V
        self._rate = rate  # V/s, at most `PLANNED_SHARE` of the slew limit
        if not rate > 0.0 or not all(-inf < goal < inf for goal in self._goals):
            raise UsageError(f"a ramp at {rate} V/s through {self._goals[::-1]} V; give a positive rate, finite goals")

    @property
    def done(self) -> bool:
        """Whether the last target voltage has been reached."""
        return not self._goals

    def step(self, pace: RateLimiter, now_ns: int) -> float:
        """Return the next voltage (V) at `now_ns` (ns), as the rate limiter `pace` allows."""
        if self.done:
            return pace.voltage
        goal = pace.limits.clip(self._goals[-1])
        v = pace.step(goal, now_ns, min(self._rate, PLANNED_SHARE * pace.limits.slew) if self._rate < inf else inf)
        if abs(v - goal) <= NEAR:
            self._goals.pop()
        return v


class Brake:
    """Deceleration to rest within the acceleration limit; `done` once the voltage is at rest."""

    def __init__(self) -> None:
        self.done = False

    def step(self, pace: RateLimiter, now_ns: int) -> float:
        """Return the next voltage (V) at `now_ns` (ns), as the rate limiter `pace` allows."""
        v = pace.brake(now_ns)
        self.done = not pace.in_motion
        return v
