"""Which voltages an axis may be given, and how far it may go from one sample to the next."""

from dataclasses import dataclass, replace
from math import inf, sqrt

from slpi_ros.errors import UsageError

# A longer pause between two samples frees no longer way than this one, seconds.
MAX_DT = 0.1


@dataclass(frozen=True)
class Limits:
    """Voltages that an axis may be given, and how fast.

    Parameters
    ----------
    lower, upper : float, volts
    slew : float, V/s
        Fastest change; inf: no limit.
    acceleration : float, V/s^2
        Fastest change of that change; inf: no limit.

    Raises
    ------
    UsageError
        If they leave no voltage or no motion.
    """

    lower: float
    upper: float
    slew: float = inf
    acceleration: float = inf

    def __post_init__(self) -> None:
        """Refuse limits that leave no voltage."""
        if not self.lower <= self.upper or not self.slew > 0 or not self.acceleration > 0:
            raise UsageError(
                f"voltage limits {self.lower:g}..{self.upper:g} V with slew {self.slew:g} V/s and acceleration "
                f"{self.acceleration:g} V/s^2 leave nothing to do; give lower <= upper, and the others positive"
            )

    def within(self, voltage_range: tuple[float, float]) -> "Limits":
        """Return these limits, narrowed to a model's identified voltages."""
        lower, upper = max(self.lower, voltage_range[0]), min(self.upper, voltage_range[1])
        if lower > upper:
            raise UsageError(
                f"the model was identified from {voltage_range[0]:g} to {voltage_range[1]:g} V, outside the voltage "
                f"limits {self.lower:g}..{self.upper:g} V; identify it again within them, or correct the limits"
            )
        return replace(self, lower=lower, upper=upper)

    def clip(self, voltage: float) -> float:
        """Return the allowed voltage (V) nearest to `voltage` (V)."""
        return min(max(voltage, self.lower), self.upper)


class RateLimiter:
    """How far a voltage may go from one sample to the next.

    With a limit of acceleration every step leaves room to brake: before the voltage limits always, and before the goal
    unless the goal itself turns too sharply.

    Parameters
    ----------
    limits : Limits
        They may be replaced at any time; a voltage outside new ones goes inside as fast as slew and acceleration allow.

    Attributes
    ----------
    rate : float, V/s
        Of the last step.
    """

    __slots__ = ("_dt", "limits", "rate")

    def __init__(self, limits: Limits) -> None:
        self.limits = limits
        self.rate = self._dt = 0.0

    @property
    def in_motion(self) -> bool:
        """Whether the limit of acceleration forbids to stand still at the next sample."""
        return abs(self.rate) > self.limits.acceleration * self._dt

    def clamp_dt(self, elapsed: float) -> float:
        """Return how much of the time since the last step (s) counts; after a pause the voltage starts from rest."""
        if elapsed > MAX_DT:
            self.rest()
            return MAX_DT
        return max(elapsed, 0.0)

    def reach(self, present: float, dt: float) -> tuple[float, float]:
        """Return the lowest and the highest voltage (V) that may follow `present` (V) after `dt` (s)."""
        limits = self.limits
        lower, upper = limits.lower, limits.upper
        if limits.acceleration < inf:
            down, up = self._ways(present, dt)
        elif limits.slew < inf:
            up = limits.slew * dt
            down = -up
        else:
            return lower, upper
        # A voltage outside its limits goes inside at full pace.
        lowest, highest = present + down, present + up
        lowest = max(lowest, min(lower, highest))
        return lowest, min(highest, max(upper, lowest))

    def toward(self, present: float, goal: float, goal_before: float, dt: float) -> tuple[float, float]:
        """Return what `reach` does, narrowed so that the voltage can stop at a goal that moves on as it just did.

        Parameters
        ----------
        present, goal, goal_before : float, volts
            The goal now, and at the sample before.
        dt : float, seconds
        """
        lowest, highest = self.reach(present, dt)
        if self.limits.acceleration == inf:
            return lowest, highest
        behind, along = goal_before - present, present + (goal - goal_before)
        low, high = along - self._braking_way(-behind, dt), along + self._braking_way(behind, dt)
        return min(max(low, lowest), highest), min(max(high, lowest), highest)

    def step(self, present: float, goal: float, dt: float, goal_before: float | None = None) -> float:
        """Return the voltage (V) that follows `present` (V) on the way to a `goal` (V) after `dt` (s)."""
        lowest, highest = self.toward(present, goal, goal if goal_before is None else goal_before, dt)
        v = min(max(goal, lowest), highest)
        self.moved(v - present, dt)
        return v

    def moved(self, way: float, dt: float) -> None:
        """Remember how fast the last step went: `way` (V) in `dt` (s)."""
        if dt > 0.0:
            self.rate, self._dt = way / dt, dt

    def rest(self) -> None:
        """Start anew from a voltage at rest."""
        self.rate = 0.0

    def go_on(self, before: "RateLimiter") -> None:
        """Go on as fast as another pace has been going."""
        self.rate, self._dt = before.rate, before._dt

    def _ways(self, present: float, dt: float) -> tuple[float, float]:
        """Return how far (V) down and up slew, acceleration and room to brake allow."""
        limits = self.limits
        change, fastest = limits.acceleration * dt, limits.slew
        down = max(self.rate - change, -fastest) * dt
        up = min(self.rate + change, fastest) * dt
        to_lower, to_upper = present - limits.lower, limits.upper - present
        if to_upper >= 0.0:
            up = min(up, self._braking_way(to_upper, dt))
        if to_lower >= 0.0:
            down = max(down, -self._braking_way(to_lower, dt))
        return min(down, up), max(down, up)

    def _braking_way(self, distance: float, dt: float) -> float:
        """Return the longest step (V) in `dt` after which the voltage can still stop within `distance` (V)."""
        if distance <= 0.0:
            return 0.0
        acceleration = self.limits.acceleration
        return min(acceleration * dt * (sqrt(dt * dt + 2.0 * distance / acceleration) - dt), distance)


def decaying_turns(limits: Limits, final: float, cycles: int) -> list[float]:
    """Return the voltages (V) at which a decaying oscillation turns, the final one last.

    The first cycle reaches both limits and closes every loop between them. The amplitude then falls by the same
    amount each cycle, on either side of the final voltage by as much as there is room.

    Parameters
    ----------
    limits : Limits
    final : float, volts
        Within the limits.
    cycles : int
        At least 1.

    Raises
    ------
    UsageError
        If there is no cycle, or the final voltage is outside.
    """
    if cycles < 1 or not limits.lower <= final <= limits.upper:
        raise UsageError(
            f"a reset of {cycles} cycles to {final:g} V within {limits.lower:g}..{limits.upper:g} V; "
            "give at least one cycle and a final voltage within the limits"
        )
    above, below = limits.upper - final, limits.lower - final
    # Which limit came first must not matter: the upper one is visited once more.
    turns = [limits.upper, limits.lower]
    for left in range(cycles, 0, -1):
        share = left / cycles
        turns += [final + share * above, final + share * below]
    return [*(limits.clip(v) for v in turns), final]
