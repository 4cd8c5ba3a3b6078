"""What an axis is doing: one motion at a time, and the one table of which motion may replace which."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from enum import Enum
from math import inf
from typing import Protocol

from slpi_ros.compensator import validation as rejection
from slpi_ros.compensator.samples import Samples
from slpi_ros.errors import UsageError
from slpi_ros.io.messages import SECOND_NS
from slpi_ros.model.limits import Limits, RateLimiter
from slpi_ros.model.streaming import StreamingInverse

# Distance at which a target voltage counts as reached, volts: covers rounding, and the slow end of a deceleration.
NEAR = 1e-9
# Share of the slew limit that planned motion uses, so that a late step can be made up.
PLANNED_SHARE = 0.8
# A held voltage is at rest if it changes by less than this share of the range per second over this time; it is then
# looked at once in this time.
REST_SHARE, REST_NS, RESTING_NS = 1e-5, SECOND_NS // 10, SECOND_NS


class Kind(Enum):
    """Kinds of motion."""

    IDLE = "idle"
    APPROACH = "approach"
    STREAM = "stream"
    HOLD = "hold"
    TRAJECTORY = "trajectory"
    RAMP = "ramp"
    RESET = "reset"
    BLOCK = "block"
    FAULT = "fault"


# What an axis does in each motion, and where the motion ends; docs/reference/motions.md is made from these tables.
MEANING = {
    Kind.IDLE: "The voltage stays; nothing follows.",
    Kind.APPROACH: "The voltage goes on to that of the last setpoint, as fast as the limits allow.",
    Kind.STREAM: "Setpoints arrive; between two of them the feedforward voltage stays.",
    Kind.HOLD: "No setpoint has come for some time: the displacement is held, so that lag and creep settle.",
    Kind.TRAJECTORY: "Points of a trajectory are pending; they are output at output_rate.",
    Kind.RAMP: "The voltage goes to given values: to rest, to a safe voltage, or back inside the limits.",
    Kind.RESET: "The voltage oscillates with a decaying amplitude, which resets the memory.",
    Kind.BLOCK: "A device plays a block of voltages by itself.",
    Kind.FAULT: "Somebody else moves the stage; nothing is output until ~/arm.",
}
_ALL = frozenset(Kind)
# Which motion may replace the present one. Whatever may not is rejected, and changes nothing.
REPLACED_BY: dict[Kind, frozenset[Kind]] = {
    Kind.IDLE: _ALL,
    Kind.APPROACH: _ALL,
    Kind.STREAM: _ALL,
    Kind.HOLD: _ALL,
    Kind.TRAJECTORY: frozenset({Kind.IDLE, Kind.TRAJECTORY, Kind.RAMP, Kind.FAULT}),
    Kind.RAMP: _ALL,
    Kind.RESET: frozenset({Kind.IDLE, Kind.RAMP, Kind.RESET, Kind.FAULT}),
    Kind.BLOCK: frozenset({Kind.IDLE, Kind.FAULT}),
    Kind.FAULT: frozenset({Kind.IDLE}),
}
# Cause of the rejection, and what to do.
REFUSALS = {
    Kind.TRAJECTORY: (rejection.FOLLOWING, "wait, or cancel it with an empty one"),
    Kind.RESET: (rejection.RESETTING, "wait until reset_memory answers"),
    Kind.BLOCK: (rejection.FOLLOWING, "wait, or cancel it with an empty trajectory"),
}


@dataclass(frozen=True)
class Safety:
    """Reaction to a command timeout and to deactivation: hold the voltages, or ramp to the safe ones."""

    command_timeout: float  # s; 0 disables the watchdog
    ramps_on_timeout: bool
    ramps_on_deactivate: bool
    voltages: tuple[float, ...]  # V, one per axis
    rate: float  # V/s


class Moved(Protocol):
    """What a motion knows of its axis, and may do to it."""

    motion: "Motion"
    stream: StreamingInverse
    output: RateLimiter
    samples: Samples
    slewing: bool

    @property
    def holds(self) -> bool:
        """Whether the voltage of a constant displacement changes."""

    def begin(self, motion: "Motion", now_ns: int) -> None:
        """Begin a motion that follows no setpoint."""

    def hold(self, now_ns: int) -> None:
        """Output the voltage for the last setpoint now, as far as the limits allow."""

    def drive(self, voltage: float, now_ns: int) -> None:
        """Let memory and effects follow a voltage (V)."""

    def settle(self, now_ns: int) -> None:
        """Let setpoints go on from the present voltage."""

    def return_inside(self, now_ns: int) -> None:
        """Go to the nearest voltage limit if the voltage is outside."""

    def note_reset(self, spanned: tuple[float, float] | None) -> None:
        """Set the confidence in the memory after a reset over voltages (V); None: it was interrupted."""


class Motion:
    """What an axis is doing: `step` does what is due at `due_ns` (steady clock; None: nothing), `end` leaves it."""

    kind = Kind.IDLE
    follows = drives = False  # setpoints, so that feedback corrects; the voltage without setpoints
    swing = 0  # number of that over the range, from the first limit on, where the memory is known; 0: none

    def __init_subclass__(cls) -> None:
        super().__init_subclass__()
        cls.follows = cls.kind in (Kind.STREAM, Kind.APPROACH, Kind.HOLD)
        cls.drives = cls.kind in (Kind.RAMP, Kind.RESET, Kind.BLOCK)

    def __init__(self, due_ns: int | None = None) -> None:
        self.due_ns = due_ns

    def step(self, axis: Moved, now_ns: int) -> None:
        """Do what is due at `now_ns`."""
        self.due_ns = None

    def end(self, axis: Moved, now_ns: int) -> None:
        """Leave the axis at its present voltage, for the next motion."""

    def wake(self, due_ns: int = 0) -> None:
        """Look at the voltage again at `due_ns`, as another axis moves, or limits, model or surroundings changed."""


class Idle(Motion):
    """Nothing follows."""


class Fault(Motion):
    """Somebody else moves the stage."""

    kind = Kind.FAULT


class Approach(Motion):
    """On the way to the voltage of the last setpoint, which the limits have held back."""

    kind = Kind.APPROACH

    def step(self, axis: Moved, now_ns: int) -> None:
        """Go on towards that voltage."""
        axis.hold(now_ns)
        follow(axis, now_ns, max(axis.samples.hold_ns, now_ns + axis.output.period_ns))


class Stream(Motion):
    """Between two setpoints."""

    kind = Kind.STREAM

    def step(self, axis: Moved, now_ns: int) -> None:
        """Begin to hold the displacement if no setpoint has come for long enough."""
        begin_ns = axis.samples.hold_ns
        if now_ns < begin_ns:
            self.due_ns = begin_ns
        else:
            axis.motion = Hold()
            axis.motion.step(axis, now_ns)


class Hold(Motion):
    """The displacement of the last setpoint is held, until the voltage is at rest, then looked at now and then."""

    kind = Kind.HOLD

    def __init__(self) -> None:
        super().__init__()
        # Since when the feedforward voltage (V) is nearly at rest, its lowest and its highest value since.
        self._rest: tuple[int, float, float] | None = None

    def step(self, axis: Moved, now_ns: int) -> None:
        """Output the voltage that holds the displacement now."""
        axis.hold(now_ns)
        v, limits = axis.stream.voltage, axis.output.limits
        since_ns, lowest, highest = self._rest or (now_ns, v, v)
        lowest, highest, still_ns = min(lowest, v), max(highest, v), now_ns - since_ns
        self._rest = since_ns, lowest, highest
        if highest - lowest > REST_SHARE * (limits.upper - limits.lower) * max(still_ns, REST_NS) * 1e-9:
            self._rest, still_ns = (now_ns, v, v), 0
        self.due_ns = now_ns + (RESTING_NS if still_ns >= REST_NS else axis.output.period_ns)

    def wake(self, due_ns: int = 0) -> None:
        """Look at the voltage again soon."""
        self._rest, self.due_ns = None, due_ns


def follow(axis: Moved, now_ns: int, hold_ns: int) -> None:
    """Begin what follows a setpoint: the way on to its voltage if that was held back, else the wait for the next one.

    The displacement is held from `hold_ns` on at the earliest.
    """
    following: type[Approach | Stream] = Stream
    due_ns = hold_ns if axis.holds else None
    if axis.slewing or axis.output.in_motion:
        following, due_ns = Approach, now_ns + axis.output.period_ns
    if type(axis.motion) is following:
        axis.motion.due_ns = due_ns
    else:
        axis.motion = following(due_ns)


class Ramp(Motion):
    """Voltage ramp through target voltages (V) at a rate (V/s), each reached before the next one is approached.

    Planned motion uses at most `PLANNED_SHARE` of the slew limit; an infinite rate means the slew limit itself.
    """

    kind = Kind.RAMP

    def __init__(self, goals: Iterable[float], rate: float) -> None:
        super().__init__()
        self._goals, self._rate = list(goals)[::-1], rate
        self.done = not self._goals  # whether the last target voltage has been reached
        if not rate > 0.0 or not all(-inf < goal < inf for goal in self._goals):
            raise UsageError(f"a ramp at {rate} V/s through {self._goals[::-1]} V; give a positive rate, finite goals")

    def next(self, pace: RateLimiter, now_ns: int) -> float:
        """Return the next voltage (V) at `now_ns` (ns), as the rate limiter `pace` allows."""
        if self.done:
            return pace.voltage
        goal = pace.limits.clip(self._goals[-1])
        v = pace.step(goal, now_ns, min(self._rate, PLANNED_SHARE * pace.limits.slew) if self._rate < inf else inf)
        if abs(v - goal) <= NEAR:
            self._goals.pop()
            self.done = not self._goals
        return v

    def step(self, axis: Moved, now_ns: int) -> None:
        """Output the next voltage; after the last one, nothing follows."""
        axis.drive(self.next(axis.output, now_ns), now_ns)
        self.due_ns = now_ns + axis.output.period_ns
        if self.done:
            axis.begin(Idle(), now_ns)
            axis.return_inside(now_ns)

    def end(self, axis: Moved, now_ns: int) -> None:
        """Let setpoints go on from the present voltage and rate."""
        axis.settle(now_ns)


class Brake(Ramp):
    """Deceleration to rest within the acceleration limit."""

    def __init__(self) -> None:
        super().__init__((), inf)
        self.done = False

    def next(self, pace: RateLimiter, now_ns: int) -> float:
        """Return the next voltage (V) at `now_ns` (ns), as the rate limiter `pace` allows."""
        v = pace.brake(now_ns)
        self.done = not pace.in_motion
        return v


class Reset(Ramp):
    """Decaying oscillation that resets the memory: it is known afterwards over the voltages that were reached."""

    kind = Kind.RESET

    def __init__(self, goals: Iterable[float], rate: float, voltage: float) -> None:
        super().__init__(goals, rate)
        self._low = self._high = voltage

    def next(self, pace: RateLimiter, now_ns: int) -> float:
        """Return the next voltage (V)."""
        left = len(self._goals)
        v = super().next(pace, now_ns)
        self._low, self._high = min(self._low, v), max(self._high, v)
        self.swing += left - len(self._goals)
        return v

    def end(self, axis: Moved, now_ns: int) -> None:
        """Set the confidence in the memory: of a completed or of an interrupted reset."""
        axis.note_reset((self._low, self._high) if self.done else None)
        super().end(axis, now_ns)


class Block(Motion):
    """A device plays voltages by itself; what it has played comes with `Axis.play`."""

    kind = Kind.BLOCK

    def end(self, axis: Moved, now_ns: int) -> None:
        """Go on from the voltage that was played last."""
        axis.samples.given_ns = now_ns
        axis.settle(now_ns)


def reset_limits(axes: Iterable[Moved], spans: Sequence[tuple[float, float]] = ()) -> list[Limits]:
    """Return the limits of the oscillation of a reset for each axis, within `spans` (V) if given."""
    every = [axis.stream.limits for axis in axes]
    if not spans:
        return every
    return [
        replace(limits, lower=limits.clip(low), upper=limits.clip(high))
        for limits, (low, high) in zip(every, spans, strict=True)
    ]
