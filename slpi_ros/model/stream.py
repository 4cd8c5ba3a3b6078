"""Compensation sample by sample: what the compensator node runs for each axis."""

from collections.abc import Mapping
from copy import copy
from dataclasses import dataclass, field
from math import inf, isfinite
from typing import Any, ClassVar

from slpi_ros.errors import UnreachableError, UsageError
from slpi_ros.hysteresis.memory import Memory, MemoryState
from slpi_ros.model.limits import LONGEST_STEP, Limits, Pace

__all__ = ["LONGEST_STEP", "ROUNDING", "AxisStream", "Limits", "Pace", "StreamState", "accepted_range", "refusal"]

# A wish farther outside the identified displacements than this share of their span is taken for a mistake (a wrong
# unit, another stage) and refused; nearer ones are held at the voltage limit.
TOLERATED_SHARE = 0.2
# A displacement missed by less than this share of the range is met: it is rounding.
ROUNDING = 1e-9


@dataclass(frozen=True)
class StreamState:
    """The whole state of an axis that is followed sample by sample.

    Parameters
    ----------
    memory : MemoryState
    voltage, goal : float, volts
        Present voltage, and what the last wish asked for.
    rate : float, V/s
    wish, own : float, metres
        What the hysteresis was asked for, and the place that came of it.
    effects : mapping of effect name to its state
    """

    memory: MemoryState
    voltage: float
    goal: float
    rate: float
    wish: float
    own: float
    effects: Mapping[str, Any] = field(default_factory=dict)


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

    Attributes
    ----------
    accepted : (float, float), metres
        Smallest and largest displacement that may be wished for.
    pace : Pace
    wish : float, metres
        What the hysteresis was asked for last.
    coupled : float, metres
        What other axes add to the displacement; set it before a wish that is to reckon with it.
    """

    # Whether it does not matter how long a voltage stays.
    timeless: ClassVar[bool] = True

    def __init__(self, memory: Memory, displacement_range: tuple[float, float], limits: Limits) -> None:
        self.memory = memory
        self.accepted = accepted_range(displacement_range)
        self.pace = Pace(limits)
        self._t = -inf
        # The axis may rest outside its limits; the first voltage it is given is inside.
        memory.forward(limits.clip(memory.voltage))
        self.wish = memory.displacement
        self.coupled = 0.0
        self._goal = memory.voltage
        self._rounding = ROUNDING * (displacement_range[1] - displacement_range[0])

    @property
    def limits(self) -> Limits:
        """Voltage limits; new ones count from the next sample on."""
        return self.pace.limits

    @limits.setter
    def limits(self, limits: Limits) -> None:
        self.pace.limits = limits

    @property
    def voltage(self) -> float:
        """Present voltage, volts."""
        return self.memory.voltage

    @property
    def own(self) -> float:
        """Displacement (m) that the model gives the present voltage, before other axes come in."""
        return self.memory.displacement

    def unseen(self, y: float) -> float:
        """Return the place (m) at which a sensor sees the displacement `y` (m)."""
        return y

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
        if not self.accepted[0] <= y <= self.accepted[1]:
            raise UnreachableError(refusal(y, self.accepted))

    def step(self, t: float, y: float) -> float:
        """Return the voltage (V) for the desired displacement `y` (m) at time `t` (s).

        Raises
        ------
        SlpiError
            As in `check`; nothing has moved then.
        """
        self.check(t, y)
        # At the first sample no time has passed yet: the voltage stays and catches up from there.
        v = self.move(t - self._t if self._t > -inf else 0.0, y)
        self._t = t
        return v

    __call__ = step

    def move(self, dt: float, y: float) -> float:
        """Return the voltage (V) for the desired displacement `y` (m), `dt` (s) after the last one; neither is checked.

        Raises
        ------
        UsageError
            If the model has no voltage for it; nothing has moved then.
        """
        memory, pace = self.memory, self.pace
        if pace.limits.acceleration < inf:
            v = self._move_gently(dt, y)
        else:
            lower, upper = pace.reach(memory.voltage, dt)
            v = memory.inverse(y, lower, upper)
        self.wish = y
        return v

    def drive(self, voltage: float, dt: float = 0.0) -> float:
        """Move to a voltage (V), `dt` (s) after the last one, whatever is wished for; return the displacement (m)."""
        self.wish = self.memory.forward(voltage)
        self._goal = voltage
        return self.wish

    def wait(self, duration: float) -> None:
        """Let time (s) pass without a wish."""

    def snapshot(self) -> StreamState:
        """Return the whole state, to be given back to `restore`."""
        return StreamState(self.memory.snapshot(), self.voltage, self._goal, self.pace.rate, self.wish, self.own)

    def restore(self, state: StreamState) -> None:
        """Take over a state from `snapshot`."""
        self.memory.restore(state.memory)
        self._goal, self.pace.rate, self.wish = state.goal, state.rate, state.wish

    def resume(self, before: "AxisStream") -> None:
        """Go on where another model's stream has been; its voltage stays, and what its effects have begun."""
        self.pace.go_on(before.pace)
        if self.voltage != before.voltage:
            self.drive(before.voltage)

    def twin(self) -> "AxisStream":
        """Return a stream in the same state, which moves on its own."""
        twin = copy(self)
        twin.memory, twin.pace = copy(self.memory), copy(self.pace)
        twin.memory.restore(self.memory.snapshot())
        return twin

    def _move_gently(self, dt: float, y: float) -> float:
        """Move within the limit of acceleration: slow down before the voltage that the wish asks for."""
        memory, pace = self.memory, self.pace
        present, state = memory.voltage, memory.snapshot()
        goal = memory.inverse(y, pace.limits.lower, pace.limits.upper)
        lowest, highest = pace.toward(present, goal, self._goal, dt)
        if lowest <= goal <= highest:
            v = goal
        else:
            memory.restore(state)
            v = memory.inverse(y, lowest, highest)
        pace.moved(v - present, dt)
        self._goal = goal
        return v

    @property
    def held(self) -> bool:
        """Whether the voltage waits at the limit beyond which the last wish lies."""
        missing, v, limits = self.wish - self.memory.displacement, self.memory.voltage, self.pace.limits
        return (missing > self._rounding and v >= limits.upper) or (missing < -self._rounding and v <= limits.lower)

    @property
    def missed(self) -> bool:
        """Whether the last wish is not met, for whatever limit."""
        return abs(self.memory.displacement - self.wish) > self._rounding


def accepted_range(displacement_range: tuple[float, float]) -> tuple[float, float]:
    """Return the smallest and largest displacement (m) that may be wished for, given the identified ones (m)."""
    low, high = displacement_range
    margin = TOLERATED_SHARE * (high - low)
    return low - margin, high + margin


def refusal(y: float, accepted: tuple[float, float], kind: str = "desired") -> str:
    """Say that the displacement `y` (m), desired or measured, is refused."""
    return (
        f"{kind} displacement {y * 1e6:.6g} um is far outside what the model was identified on "
        f"(accepted: {accepted[0] * 1e6:.6g} to {accepted[1] * 1e6:.6g} um); "
        "check units and offset, or identify on a larger range"
    )
