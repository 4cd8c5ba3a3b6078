"""Voltage limits and the rate limiter of an axis."""

from dataclasses import dataclass, replace
from math import inf, sqrt

from slpi_ros.errors import UsageError

# Longest time between two samples that counts for the rate limiter, seconds.
MAX_DT = 0.1


@dataclass(frozen=True)
class Limits:
    """Limits of voltage, slew rate and acceleration of an axis.

    Parameters
    ----------
    lower, upper : float, volts
    slew : float, V/s
        Maximum rate of change; inf (default): no limit.
    acceleration : float, V/s^2
        Maximum change of the rate; inf (default): no limit.

    Raises
    ------
    UsageError
        If lower exceeds upper, or a rate limit is not positive.
    """

    lower: float
    upper: float
    slew: float = inf
    acceleration: float = inf

    def __post_init__(self) -> None:
        """Validate the limits."""
        if not self.lower <= self.upper or not self.slew > 0 or not self.acceleration > 0:
            raise UsageError(
                f"voltage limits {self.lower:g}..{self.upper:g} V with slew {self.slew:g} V/s and acceleration "
                f"{self.acceleration:g} V/s^2 are not valid; give lower <= upper, and positive slew and acceleration"
            )

    def within(self, voltage_range: tuple[float, float]) -> "Limits":
        """Return these limits, restricted to the voltage range (V) of a model; UsageError if they do not overlap."""
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
    """Limit the voltage change from one sample to the next by slew rate and acceleration.

    With an acceleration limit every step leaves enough distance to stop at the voltage limits, and at the goal unless
    the goal itself reverses faster than the acceleration limit allows.

    Parameters
    ----------
    limits : Limits
        May be replaced at any time; a voltage outside new limits returns within the slew and acceleration limits.

    Attributes
    ----------
    rate : float, V/s
        Rate of the last step.
    """

    __slots__ = ("_dt", "limits", "rate")

    def __init__(self, limits: Limits) -> None:
        self.limits = limits
        self.rate = self._dt = 0.0

    @property
    def in_motion(self) -> bool:
        """Whether the acceleration limit prevents the voltage from stopping at the next sample."""
        return abs(self.rate) > self.limits.acceleration * self._dt

    def clamp_dt(self, elapsed: float) -> float:
        """Return the elapsed time (s) limited to 0..`MAX_DT`; after a longer pause, reset the rate to zero."""
        if elapsed > MAX_DT:
            self.rest()
            return MAX_DT
        return max(elapsed, 0.0)

    def reach(self, present: float, dt: float) -> tuple[float, float]:
        """Return the lowest and highest voltage (V) reachable from `present` (V) within `dt` (s)."""
        limits = self.limits
        lower, upper = limits.lower, limits.upper
        if limits.acceleration < inf:
            down, up = self._ways(present, dt)
        elif limits.slew < inf:
            up = limits.slew * dt
            down = -up
        else:
            return lower, upper
        # A voltage outside its limits returns at the maximum rate.
        lowest, highest = present + down, present + up
        lowest = max(lowest, min(lower, highest))
        return lowest, min(highest, max(upper, lowest))

    def toward(self, present: float, goal: float, goal_before: float, dt: float) -> tuple[float, float]:
        """Return the interval of `reach`, restricted so that the voltage need not overshoot a goal of constant rate.

        Parameters
        ----------
        present, goal, goal_before : float, volts
            Present voltage, goal now, and goal at the previous sample.
        dt : float, seconds
            Time since the previous sample.
        """
        lowest, highest = self.reach(present, dt)
        if self.limits.acceleration == inf:
            return lowest, highest
        behind, along = goal_before - present, present + (goal - goal_before)
        low, high = along - self._braking_way(-behind, dt), along + self._braking_way(behind, dt)
        return min(max(low, lowest), highest), min(max(high, lowest), highest)

    def step(self, present: float, goal: float, dt: float, goal_before: float | None = None) -> float:
        """Return the next voltage (V) from `present` (V) towards `goal` (V) after `dt` (s)."""
        lowest, highest = self.toward(present, goal, goal if goal_before is None else goal_before, dt)
        v = min(max(goal, lowest), highest)
        self.moved(v - present, dt)
        return v

    def moved(self, way: float, dt: float) -> None:
        """Store the rate of the last step: a change of `way` (V) in `dt` (s)."""
        if dt > 0.0:
            self.rate, self._dt = way / dt, dt

    def rest(self) -> None:
        """Reset the rate to zero."""
        self.rate = 0.0

    def go_on(self, before: "RateLimiter") -> None:
        """Take over the rate of another rate limiter."""
        self.rate, self._dt = before.rate, before._dt

    def _ways(self, present: float, dt: float) -> tuple[float, float]:
        """Return the largest steps (V) down and up that slew rate, acceleration and stopping distance allow."""
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
    """Return the reversal voltages (V) of a decaying oscillation, followed by the final voltage.

    The first cycle reaches both limits and so erases every loop between the limits. The amplitude then decreases
    linearly over the cycles; on each side it is proportional to the distance from the final voltage to the limit.

    Parameters
    ----------
    limits : Limits
    final : float, volts
        Final voltage, within the limits.
    cycles : int
        Number of cycles, at least 1.

    Raises
    ------
    UsageError
        If `cycles` is below 1, or `final` is outside the limits.
    """
    if cycles < 1 or not limits.lower <= final <= limits.upper:
        raise UsageError(
            f"a reset of {cycles} cycles to {final:g} V within {limits.lower:g}..{limits.upper:g} V; "
            "give at least one cycle and a final voltage within the limits"
        )
    above, below = limits.upper - final, limits.lower - final
    # The upper limit is visited once more, so that the result does not depend on the limit reached first.
    turns = [limits.upper, limits.lower]
    for left in range(cycles, 0, -1):
        share = left / cycles
        turns += [final + share * above, final + share * below]
    return [*(limits.clip(v) for v in turns), final]
