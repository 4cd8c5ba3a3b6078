"""Compensation sample by sample: what the compensator node runs for each axis."""

from dataclasses import dataclass
from math import inf, isfinite

from slpi_ros.errors import UnreachableError, UsageError
from slpi_ros.hysteresis.memory import Memory

# A wish farther outside the identified displacements than this share of their span is taken for a mistake (a wrong
# unit, another stage) and refused; nearer ones are held at the voltage limit.
TOLERATED_SHARE = 0.2
# A displacement missed by less than this share of the range is met: it is rounding.
ROUNDING = 1e-9


@dataclass(frozen=True)
class Limits:
    """Voltages that an axis may be given: `lower` to `upper` (V), changing by at most `slew` (V/s; inf: no limit)."""

    lower: float
    upper: float
    slew: float = inf

    def __post_init__(self) -> None:
        """Refuse limits that leave no voltage."""
        if not self.lower <= self.upper or not self.slew > 0:
            raise UsageError(
                f"voltage limits {self.lower:g}..{self.upper:g} V with slew {self.slew:g} V/s leave nothing to do; "
                "give lower <= upper and a positive slew"
            )

    def within(self, voltage_range: tuple[float, float]) -> "Limits":
        """Return these limits, narrowed to a model's identified voltages."""
        lower, upper = max(self.lower, voltage_range[0]), min(self.upper, voltage_range[1])
        if lower > upper:
            raise UsageError(
                f"the model was identified from {voltage_range[0]:g} to {voltage_range[1]:g} V, outside the voltage "
                f"limits {self.lower:g}..{self.upper:g} V; identify it again within them, or correct the limits"
            )
        return Limits(lower, upper, self.slew)


class AxisStream:
    """Causal compensation of one axis: ``v = step(t, y)``.

    Parameters
    ----------
    memory : Memory
        The model's memory, in its state at the start; owned by the stream from here on.
    displacement_range : (float, float), metres
        Smallest and largest displacement the model was identified on.
    limits : Limits
        The memory follows the voltage that is really given, so that limits do it no harm.
    """

    def __init__(self, memory: Memory, displacement_range: tuple[float, float], limits: Limits) -> None:
        self.memory = memory
        self.limits = limits
        self._accepted = accepted_range(displacement_range)
        self._t = -inf
        # The axis may rest outside its limits; the first voltage it is given is inside.
        memory.forward(min(max(memory.voltage, limits.lower), limits.upper))
        self._wish = memory.displacement
        self._rounding = ROUNDING * (displacement_range[1] - displacement_range[0])

    @property
    def voltage(self) -> float:
        """Present voltage, volts."""
        return self.memory.voltage

    def check(self, t: float, y: float) -> None:
        """Raise what `step` would raise, without moving.

        Raises
        ------
        UsageError
            If `t` (s) or `y` (m) is not finite, or time runs backwards.
        UnreachableError
            If `y` lies far outside the identified displacements.
        """
        if not (isfinite(t) and isfinite(y)):
            raise UsageError(f"sample t = {t} s, displacement = {y} m is not finite; leave it out")
        if t < self._t:
            raise UsageError(f"time runs backwards: {t:.9g} s after {self._t:.9g} s; send samples in order")
        if not self._accepted[0] <= y <= self._accepted[1]:
            raise UnreachableError(refusal(y, self._accepted))

    def step(self, t: float, y: float) -> float:
        """Return the voltage (V) for the desired displacement `y` (m) at time `t` (s).

        Raises
        ------
        SlpiError
            As in `check`; nothing has moved then.
        """
        self.check(t, y)
        limits = self.limits
        if limits.slew == inf:
            lower, upper = limits.lower, limits.upper
        else:
            # At the first sample no time has passed yet: the voltage stays and catches up from there.
            reach = limits.slew * (t - self._t) if self._t > -inf else 0.0
            present = self.memory.voltage
            lower, upper = max(limits.lower, present - reach), min(limits.upper, present + reach)
        v = self.memory.inverse(y, lower, upper)
        self._t, self._wish = t, y
        return v

    __call__ = step

    @property
    def held(self) -> bool:
        """Whether the last wish could not be met: the voltage waits at one of its limits."""
        at_limit = self.memory.voltage in (self.limits.lower, self.limits.upper)
        return at_limit and abs(self.memory.displacement - self._wish) > self._rounding


def accepted_range(displacement_range: tuple[float, float]) -> tuple[float, float]:
    """Return the smallest and largest displacement (m) that may be wished for, given the identified ones (m)."""
    low, high = displacement_range
    margin = TOLERATED_SHARE * (high - low)
    return low - margin, high + margin


def refusal(y: float, accepted: tuple[float, float]) -> str:
    """Say that the displacement `y` (m) is refused."""
    return (
        f"desired displacement {y * 1e6:.6g} um is far outside what the model was identified on "
        f"(accepted: {accepted[0] * 1e6:.6g} to {accepted[1] * 1e6:.6g} um); "
        "check units and offset, or identify on a larger range"
    )
