"""Voltage limits and the rate limiter of an axis."""

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, replace
from math import inf, sqrt

from slpi_ros.effects.excitation import MEAN_SPEED
from slpi_ros.errors import UsageError
from slpi_ros.model.mean_rate import Travelled

# Longest time between two samples that counts for effects and for the rate of a path, seconds.
MAX_DT = 0.1
# Default output period of a node that publishes voltages, seconds.
PERIOD = 1e-3


@dataclass(frozen=True)
class Limits:
    """Limits of voltage, slew rate and acceleration of an axis; UsageError if empty or not positive."""

    lower: float  # V
    upper: float  # V
    slew: float = inf  # V/s; inf: no limit
    acceleration: float = inf  # V/s^2; inf: no limit
    mean_rate: float = inf  # V/s, mean of |dV/dt| over 10 s; inf: no limit

    def __post_init__(self) -> None:
        if not self.lower <= self.upper or not all(rate > 0 for rate in (self.slew, self.acceleration, self.mean_rate)):
            raise UsageError(
                f"voltage limits {self.lower:g}..{self.upper:g} V with slew {self.slew:g} V/s, acceleration "
                f"{self.acceleration:g} V/s^2 and mean rate {self.mean_rate:g} V/s are not valid; give lower <= upper, "
                "and positive rates"
            )

    @property
    def span(self) -> float:
        """Voltage range, volts."""
        return self.upper - self.lower

    @property
    def gentle(self) -> float:
        """Rate (V/s) at which a stage may return to rest: the slew limit, where there is none a moderate one."""
        return self.slew if self.slew < inf else MEAN_SPEED * self.span

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
    """Voltage of one axis at the output: the last limits before publishing, by the steady clock of the process (ns)."""

    # The voltage changes by at most the slew limit times the time since its last change, of which at most two output
    # periods count: a late step is made up, a pause is not. With an acceleration limit every step leaves enough
    # distance to stop at the voltage limits and at the goal; a step after a pause starts from rest and counts one
    # output period. `voltage` (V) is the last output, or found at the amplifier, `rate` (V/s) that of the last step,
    # `period` in seconds, `travelled` the way to the voltage, `fastest` (V/s) what the slew limit and the mean rate
    # allowed last. The slew limit falls before the mean rate is reached, but not of a path that is known to keep it
    # (`checked`).
    __slots__ = (
        "_changed_ns", "_goal", "_limits", "_pending", "checked", "fastest", "period", "rate", "travelled", "voltage",
    )  # fmt: skip

    def __init__(self, limits: Limits, period: float = PERIOD, voltage: float = 0.0) -> None:
        self._limits, self.period, self.fastest = limits, period, limits.slew
        self.travelled, self.checked = Travelled(), False
        self._pending: tuple[Limits, float] | None = None
        self.start(voltage)

    def start(self, voltage: float) -> None:
        """Continue from a voltage (V) that was found at the amplifier, at rest."""
        self.voltage, self.rate = voltage, 0.0
        self._changed_ns: int | None = None
        self._goal: float | None = None
        self._apply_pending()

    @property
    def limits(self) -> Limits:
        """Limits in force. An axis that is moving within an acceleration limit stops within the old ones first."""
        return self._limits

    @limits.setter
    def limits(self, limits: Limits) -> None:
        self.change(limits)

    def change(self, limits: Limits, period: float | None = None) -> None:
        """Replace limits and output period (s; None: unchanged), at once or as soon as the axis has stopped."""
        self._pending = limits, period or (self._pending[1] if self._pending else self.period)
        if not self.in_motion:
            # Without acceleration limit so far, the axis stops at once.
            self.rate = 0.0
            self._apply_pending()
        else:
            # Steps that come less often from now on are no pause.
            self.period = max(self.period, self._pending[1])

    @property
    def period_ns(self) -> int:
        """Output period, nanoseconds."""
        return max(round(self.period * 1e9), 1)

    @property
    def in_motion(self) -> bool:
        """Whether the voltage moves within an acceleration limit, and so has to brake before it rests."""
        return self.rate != 0.0 and self._limits.acceleration < inf

    def elapsed(self, now_ns: int) -> float:
        """Return the time (s) since the last change that counts for a step at `now_ns`."""
        if self._changed_ns is not None:
            elapsed = (now_ns - self._changed_ns) * 1e-9
            if elapsed <= 2.0 * self.period:
                return max(elapsed, 0.0)
        return self.period if self._limits.acceleration < inf else 2.0 * self.period

    def reach(self, now_ns: int, fastest: float = inf) -> tuple[float, float]:
        """Return the lowest and highest voltage (V) that can be output at `now_ns`, no faster than `fastest` (V/s)."""
        if self._pending is not None and not (self.in_motion and self._recent(now_ns)):
            self._apply_pending()
        limits, present = self._limits, self.voltage
        lower, upper = limits.lower, limits.upper
        fastest = min(limits.slew, fastest)
        if limits.mean_rate < inf:
            allowed = self.travelled.left(limits.mean_rate, now_ns) / (2.0 * self.period)
            if not self.checked:
                allowed = min(allowed, self.travelled.fastest(limits.mean_rate, now_ns))
            self.fastest = fastest = min(fastest, allowed)
        if limits.acceleration < inf:
            down, up = self._ways(now_ns, fastest)
        elif fastest < inf:
            up = fastest * self.elapsed(now_ns)
            down = -up
        else:
            return lower, upper
        # A voltage outside its limits returns at the maximum rate.
        lowest, highest = present + down, present + up
        lowest = max(lowest, min(lower, highest))
        return lowest, min(highest, max(upper, lowest))

    def limit(self, goal: float, now_ns: int, fastest: float = inf) -> float:
        """Return the voltage (V) that a step towards `goal` (V) at `now_ns` would output; nothing changes."""
        lowest, highest = self.reach(now_ns, fastest)
        if self._limits.acceleration < inf and lowest < highest:
            # No overshoot: of a goal at rest, or of one that moves on as in the last step.
            dt, present = self.elapsed(now_ns), self.voltage
            before = self._goal if self._goal is not None and self._recent(now_ns) else goal
            behind, along = before - present, present + (goal - before)
            low, high = along - self._braking_way(-behind, dt), along + self._braking_way(behind, dt)
            lowest, highest = min(max(low, lowest), highest), min(max(high, lowest), highest)
        return min(max(goal, lowest), highest)

    def step(self, goal: float, now_ns: int, fastest: float = inf) -> float:
        """Move towards `goal` (V) at `now_ns`; return the voltage (V) to output."""
        v = self.limit(goal, now_ns, fastest)
        self._moved(v, now_ns, goal)
        return v

    def move(self, voltage: float, now_ns: int, reach: tuple[float, float] | None = None) -> float:
        """Move to `voltage` (V) as far as `reach` at `now_ns` allows, if that is known; return the voltage (V)."""
        lowest, highest = reach or self.reach(now_ns)
        v = min(max(voltage, lowest), highest)
        self._moved(v, now_ns, voltage)
        return v

    def brake(self, now_ns: int) -> float:
        """Slow down as fast as the acceleration limit allows; return the voltage (V) to output."""
        return self.move(self.voltage, now_ns)

    def play(self, voltages: Sequence[float], period: float, now_ns: int) -> None:
        """Continue at rest after voltages (V), `period` (s) apart, that a device has output by itself until now."""
        if not voltages:
            return
        if self._limits.mean_rate < inf:
            last = self.voltage
            for ago, v in enumerate(voltages, 1 - len(voltages)):
                self.travelled.move(abs(v - last), now_ns + round(ago * period * 1e9))
                last = v
        self.start(voltages[-1])

    def begin(self, now_ns: int) -> None:
        """Count the time of the next step from `now_ns` on, as if the voltage had just changed."""
        self._changed_ns = now_ns

    def copy(self) -> "RateLimiter":
        """Return an independent copy."""
        other = copy(self)
        other.travelled = self.travelled.copy()
        return other

    def _moved(self, v: float, now_ns: int, goal: float) -> None:
        if not self._recent(now_ns):
            self.rate = 0.0
        if v != self.voltage or self.in_motion:
            dt = self.elapsed(now_ns)
            if dt > 0.0:
                self.rate, self._changed_ns = (v - self.voltage) / dt, now_ns
            elif self._changed_ns is None or now_ns > self._changed_ns:
                self._changed_ns = now_ns
            if self._limits.mean_rate < inf:
                self.travelled.move(abs(v - self.voltage), now_ns)
            self.voltage = v
        self._goal = goal
        if self._pending is not None and not self.in_motion:
            self._apply_pending()

    def _recent(self, now_ns: int) -> bool:
        """Return whether the last change is so recent that the axis is in motion with `rate`."""
        return self._changed_ns is not None and (now_ns - self._changed_ns) * 1e-9 <= 2.0 * self.period

    def _apply_pending(self) -> None:
        if self._pending is not None:
            (self._limits, self.period), self._pending = self._pending, None

    def _ways(self, now_ns: int, fastest: float) -> tuple[float, float]:
        """Return the largest steps (V) down and up that slew rate, acceleration and stopping distance allow."""
        limits, present, dt = self._limits, self.voltage, self.elapsed(now_ns)
        rate = self.rate if self._recent(now_ns) else 0.0
        slowest, quickest = rate - limits.acceleration * dt, rate + limits.acceleration * dt
        if self._pending is not None:
            # New limits wait until the axis has stopped within the old ones.
            braking = min(max(0.0, slowest), quickest) * dt
            return braking, braking
        # The acceleration limit precedes a slew limit that has been lowered.
        down, up = max(slowest, min(-fastest, quickest)) * dt, min(quickest, max(fastest, slowest)) * dt
        to_lower, to_upper = present - limits.lower, limits.upper - present
        if to_upper >= 0.0:
            up = max(min(up, self._braking_way(to_upper, dt)), slowest * dt)
        if to_lower >= 0.0:
            down = min(max(down, -self._braking_way(to_lower, dt)), quickest * dt)
        return min(down, up), max(down, up)

    def _braking_way(self, distance: float, dt: float) -> float:
        """Return the longest step (V) in `dt` after which the voltage can still stop within `distance` (V)."""
        if distance <= 0.0:
            return 0.0
        acceleration = self._limits.acceleration
        return min(acceleration * dt * (sqrt(dt * dt + 2.0 * distance / acceleration) - dt), distance)


class StageLimiter:
    """Voltages of the axes of a checked drive, each by its own `RateLimiter`; `voltages` (V) are the last ones."""

    def __init__(self, limits: Sequence[Limits], period: float) -> None:
        self._limits = tuple(limits)
        self._each = [RateLimiter(one, period) for one in limits]
        for each in self._each:
            each.checked = True

    @property
    def voltages(self) -> tuple[float, ...]:
        """Voltages that were output last, or found at the amplifier, volts."""
        return tuple(each.voltage for each in self._each)

    def start(self, voltages: Sequence[float]) -> None:
        """Continue from voltages (V) that were found at the amplifier, at rest."""
        for each, v in zip(self._each, voltages, strict=True):
            each.start(v)

    def step(self, goals: Sequence[float], now_ns: int, *, gently: bool = False) -> tuple[float, ...]:
        """Move towards the goals (V) at `now_ns`, at most at a gentle rate on demand; return the voltages (V)."""
        return tuple(
            each.step(goal, now_ns, limits.gentle if gently else inf)
            for each, limits, goal in zip(self._each, self._limits, goals, strict=True)
        )

    def within(self, voltages: Sequence[float], goals: Sequence[float], share: float) -> bool:
        """Return whether voltages are these goals (V) within a share of each range."""
        every = zip(voltages, goals, self._limits, strict=True)
        return all(abs(v - goal) <= share * limits.span for v, goal, limits in every)


def decaying_turns(limits: Limits, final: float, cycles: int) -> list[float]:
    """Return the reversal voltages (V) of a decaying oscillation, followed by the final voltage `final` (V)."""
    # The first cycle reaches both limits and so erases every loop between the limits. The amplitude then decreases
    # linearly over the cycles; on each side it is proportional to the distance from the final voltage to the limit.
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


def volts(*voltages: float) -> str:
    """Return voltages (V) as text, to 10 microvolts: what rounding leaves of 0 V is 0."""
    return ", ".join(f"{round(v, 5) + 0.0:.6g}" for v in voltages)
