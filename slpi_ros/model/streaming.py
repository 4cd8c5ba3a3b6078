"""The causal inverse of one axis, sample by sample, and of several axes that move along with each other."""

from collections.abc import Callable, Iterable, Mapping
from copy import copy, deepcopy
from dataclasses import dataclass, field, replace
from math import inf, isfinite
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from slpi_ros.effects.base import DrivenStreamingEffect, Effect, StreamingEffect
from slpi_ros.effects.chain import Chain
from slpi_ros.effects.creep import StreamingCreep
from slpi_ros.effects.cross_coupling import Coupling
from slpi_ros.effects.rate_dependence import RateDependence, StreamingCoercivity
from slpi_ros.effects.saturation import Saturation
from slpi_ros.errors import SlpiError, UnreachableError, UsageError
from slpi_ros.hysteresis.turning_points import Memory, MemoryState
from slpi_ros.model.limits import MAX_DT, Limits, RateLimiter

FloatArray = NDArray[np.float64]
StreamingEffects = dict[str, StreamingEffect]

# A desired displacement farther outside the identified ones than this share of their span is taken for a mistake (a
# wrong unit, another stage) and refused; nearer ones are held at the voltage limit.
TOLERATED_SHARE = 0.2
# Rounding, as a share of the displacement range, or of the voltage.
ROUNDING = 1e-9
# A coercivity depends on the voltage that it leads to, but little: so often it is tried again.
TRIALS = 4


@dataclass(frozen=True)
class StreamState:
    """The whole state of a `StreamingInverse`.

    Parameters
    ----------
    memory : MemoryState
    voltage, goal : float, volts
        Present command, and what the last desired displacement asked for.
    rate : float, V/s
    desired, displacement : float, metres
        What the hysteresis was asked for last, and the displacement of the axis before other axes come in.
    effects : mapping of effect name to its state
    """

    memory: MemoryState
    voltage: float
    goal: float
    rate: float
    desired: float
    displacement: float
    effects: Mapping[str, Any] = field(default_factory=dict)


class StreamingInverse:
    """Causal compensation of one axis: ``v = step(t, y)``.

    A desired displacement goes back through the effects behind the hysteresis, the hysteresis, and the effects before
    it. The voltage it asks for is kept within the limits, and what comes of it goes forward again: the memory follows
    the voltage that reaches the hysteresis, and the effects what is really done. So limits do the memory no harm.

    Parameters
    ----------
    memory : Memory
        The model's memory, in its state at the start; owned by the stream from here on. Effects are at rest there.
    displacement_range : (float, float), metres
        Smallest and largest displacement the model was identified on.
    limits : Limits
        Of the command; an amplifier that clips narrows them.
    effects : tuple of Effect
        None by default.
    middle : callable, optional
        Middle of the largest loop (m) at voltages (V), shape (N,); for rate dependence.

    Attributes
    ----------
    memory : Memory
    pace : RateLimiter
    accepted : (float, float), metres
        Smallest and largest displacement that is not refused.
    desired : float, metres
        What the hysteresis was asked for last.
    coupled : float, metres
        What other axes add to the displacement; set it before a sample that is to reckon with it.
    """

    def __init__(
        self,
        memory: Memory,
        displacement_range: tuple[float, float],
        limits: Limits,
        effects: tuple[Effect, ...] = (),
        middle: Callable[[FloatArray], FloatArray] | None = None,
    ) -> None:
        chain = Chain.of(effects)
        self.memory, self._clipped, self._without_effects = memory, chain.clipped, not effects
        self.accepted = self._lowest, self._highest = accepted_range(displacement_range)
        self._rounding = ROUNDING * (displacement_range[1] - displacement_range[0])
        self._t = -inf
        self.coupled = 0.0
        # An amplifier that clips narrows the limits, and needs no follower.
        self._before = _streaming(effect for effect in chain.before if not isinstance(effect, Saturation))
        self._behind, self._shared = _streaming(chain.own), _streaming(chain.shared)
        self._find()
        self.pace = RateLimiter(limits)
        self.limits = limits
        # The axis may rest outside its limits; the first voltage it is given is inside.
        memory.forward(self.limits.clip(memory.voltage))
        for streaming in self._before.values():
            streaming.start(memory.voltage)
        for streaming in (*self._behind.values(), *self._shared.values()):
            streaming.start(memory.displacement)
        if self._driven and middle:
            self._driven.attach(lambda u: float(middle(np.array(u))))
            self._driven.drive(0.0, memory.voltage)
        self._command = self._goal = memory.voltage
        self.desired = memory.displacement
        # What the last sample asks of the voltage beyond what it gives (m or V), and of the axis as a whole (m).
        self._missing = self._short = 0.0
        self._follow(0.0)

    def _find(self) -> None:
        """Note the streaming effects that need more than the displacement."""
        self._streaming: StreamingEffects = {**self._before, **self._behind, **self._shared}
        rate = self._streaming.get(RateDependence.name)
        self._play = rate if isinstance(rate, StreamingCoercivity) else None
        self._driven = None if self._play else cast(DrivenStreamingEffect | None, rate)

    @property
    def limits(self) -> Limits:
        """Voltage limits; new ones count from the next sample on."""
        return self.pace.limits

    @limits.setter
    def limits(self, limits: Limits) -> None:
        lower = min(max(limits.lower, self._clipped[0]), limits.upper)
        self.pace.limits = limits = replace(limits, lower=lower, upper=max(min(limits.upper, self._clipped[1]), lower))
        # The inverse of the hysteresis is all there is to do.
        self._bare = self._without_effects and limits.slew == limits.acceleration == inf

    @property
    def timeless(self) -> bool:
        """Whether it does not matter how long a voltage stays."""
        return not self._streaming

    @property
    def voltage(self) -> float:
        """Present command, volts."""
        return self._command if self._before else self.memory.voltage

    @property
    def uncoupled_displacement(self) -> float:
        """Displacement (m) that the model gives the present voltage, before other axes come in."""
        return self._displacement if self._streaming else self.memory.displacement

    @property
    def missed(self) -> bool:
        """Whether the last desired displacement is not met, for whatever limit."""
        return (self._missing if self._streaming else self._beyond_rounding(self.desired)) != 0.0

    @property
    def held(self) -> bool:
        """Whether the voltage waits at the limit beyond which the last desired displacement lies."""
        missing = short = self._beyond_rounding(self.desired)
        if self._streaming:
            missing, short = self._missing, self._short
        limits, v = self.pace.limits, self.voltage
        # What goes through effects comes to a limit but for rounding; what undoes them may ask for a detour.
        if min(missing, short) > 0.0:
            return v >= limits.upper - ROUNDING * (1.0 + abs(limits.upper))
        return max(missing, short) < 0.0 and v <= limits.lower + ROUNDING * (1.0 + abs(limits.lower))

    def remove_sensor_effects(self, y: float) -> float:
        """Return the displacement of the stage (m) at which a sensor reads `y` (m)."""
        for streaming in self._shared.values():
            y = streaming.inverse(0.0, y)
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
        if not self._lowest <= y <= self._highest:
            raise UnreachableError(refusal(y, self.accepted))

    def step(self, t: float, y: float) -> float:
        """Return the voltage (V) for the desired displacement `y` (m) at time `t` (s).

        Raises
        ------
        SlpiError
            As in `check`; nothing has moved then.
        """
        dt = t - self._t
        if not (0.0 <= dt < inf and self._lowest <= y <= self._highest):
            self.check(t, y)
            # At the first sample no time has passed yet: the voltage stays and catches up from there.
            dt = 0.0
        if self._bare:
            limits = self.pace.limits
            v = self.memory.inverse(y, limits.lower, limits.upper)
            self.desired = y
        else:
            v = self.move(dt, y)
        self._t = t
        return v

    __call__ = step

    def move(self, dt: float, y: float) -> float:
        """Return the voltage (V) for the desired displacement `y` (m), `dt` (s) after the last one; neither is checked.

        Raises
        ------
        UsageError
            If the model has no voltage for it; without effects nothing has moved then.
        """
        if not self._streaming:
            h = y - self.coupled
            v = self._move(dt, dt, h)
            self.desired = h
            return v
        counted = dt
        if dt > MAX_DT:
            # The voltage has stayed: only the last part of a pause may lead to the new one.
            counted = MAX_DT
            self.wait(dt - counted)
        h = displacement = self.remove_sensor_effects(y) - self.coupled
        for streaming in reversed(self._behind.values()):
            h = streaming.inverse(counted, h)
        v = self._move(dt, counted, h)
        self.desired, self._command = h, v
        self._follow(counted)
        self._short = displacement - self._displacement
        return v

    def drive(self, voltage: float, dt: float = 0.0) -> float:
        """Move to a voltage (V), `dt` (s) after the last one, whatever is desired; return the displacement (m)."""
        self._command = self._goal = voltage
        self.memory.forward(self._reaching(dt, voltage))
        self.desired, self._missing = self.memory.displacement, 0.0
        self._follow(dt)
        y = self.uncoupled_displacement + self.coupled
        for streaming in self._shared.values():
            y = streaming.forward(0.0, y)
        return y

    def wait(self, duration: float) -> None:
        """Let time (s) pass at the present voltage."""
        if self._streaming:
            self.drive(self.voltage, duration)

    def snapshot(self) -> StreamState:
        """Return the whole state, to be given back to `restore`."""
        return StreamState(
            self.memory.snapshot(),
            self.voltage,
            self._goal,
            self.pace.rate,
            self.desired,
            self.uncoupled_displacement,
            {name: each.snapshot() for name, each in self._streaming.items()},
        )

    def restore(self, state: StreamState) -> None:
        """Take over a state from `snapshot`."""
        self.memory.restore(state.memory)
        self._command, self._goal, self.pace.rate = state.voltage, state.goal, state.rate
        self.desired, self._displacement = state.desired, state.displacement
        for name, streaming in self._streaming.items():
            streaming.restore(state.effects[name])

    def resume(self, before: "StreamingInverse") -> None:
        """Go on where another model's stream has been; its voltage stays, and what its effects have begun."""
        self.pace.go_on(before.pace)
        self._command = self._goal = before.voltage
        if self._play and before._play:
            self._play.restore(before._play.snapshot())
        # The command jumps there, and no time passes.
        self.memory.forward(self._reaching(0.0, before.voltage))
        self.desired = self.memory.displacement
        for name, streaming in self._behind.items():
            other = before._behind.get(name)
            if isinstance(streaming, StreamingCreep) and isinstance(other, StreamingCreep):
                streaming.resume(other, self.memory.displacement)
        self._follow(0.0)

    def copy(self) -> "StreamingInverse":
        """Return a stream in the same state, which moves on its own."""
        other = copy(self)
        other.memory, other.pace = copy(self.memory), copy(self.pace)
        other.memory.restore(self.memory.snapshot())
        other._before, other._behind, other._shared = deepcopy((self._before, self._behind, self._shared))
        other._find()
        return other

    def _move(self, dt: float, counted: float, h: float) -> float:
        """Move command and memory towards a displacement of the hysteresis (m); return the command (V).

        `counted` (s) is how much of `dt` (s) the effects are told.
        """
        memory, pace = self.memory, self.pace
        if not self._before and pace.limits.acceleration == inf:
            v = memory.inverse(h, *pace.reach(memory.voltage, dt))
            if self._streaming:
                self._missing = self._beyond_rounding(h)
            return v
        state, present = memory.snapshot(), self.voltage
        goal, reversible_bypass = self._played(h)
        u = memory.voltage
        self._missing = self._beyond_rounding(h - reversible_bypass)
        for streaming in reversed(self._before.values()):
            if streaming is not self._play:
                goal = streaming.inverse(counted, goal)
        v = pace.step(present, goal, dt, self._goal)
        if not self._missing and abs(goal - v) > ROUNDING * (1.0 + abs(goal)):
            self._missing = goal - v
        self._goal = goal
        reached = self._reaching(counted, v)
        if reached != u:
            memory.restore(state)
            memory.forward(reached)
        return v

    def _played(self, h: float) -> tuple[float, float]:
        """Move the memory to a displacement (m); return the voltage (V) before the play, and what goes round it (m)."""
        memory, limits, play = self.memory, self.pace.limits, self._play
        if not play:
            return memory.inverse(h, limits.lower, limits.upper), 0.0
        state, rest = memory.snapshot(), memory.displacement
        v, direction = play.within(h - rest)
        if v is not None:
            return v, play.between(v, memory.voltage)
        u, reversible_bypass = memory.voltage, 0.0
        for _ in range(TRIALS):
            v = play.ahead(u, direction)
            reversible_bypass = play.between(v, u)
            wanted = max(h - reversible_bypass, rest) if direction > 0 else min(h - reversible_bypass, rest)
            memory.restore(state)
            u = memory.inverse(wanted, limits.lower, limits.upper)
        v = play.ahead(u, direction)
        return v, play.between(v, u)

    def _beyond_rounding(self, h: float) -> float:
        """Return how far (m) the hysteresis is from where it is asked to be; 0 where that is rounding."""
        missing = h - self.memory.displacement
        return missing if abs(missing) > self._rounding else 0.0

    def _reaching(self, dt: float, v: float) -> float:
        """Let a command (V) go through to the hysteresis; return the voltage (V) that arrives."""
        for streaming in self._before.values():
            v = streaming.forward(dt, v)
        return v

    def _follow(self, dt: float) -> None:
        """Let the effects behind the hysteresis follow what it does."""
        y = self.memory.displacement + (self._play.reversible_bypass if self._play else 0.0)
        if self._driven:
            self._driven.drive(dt, self.memory.voltage)
        for streaming in self._behind.values():
            y = streaming.forward(dt, y)
        self._displacement = y


def _streaming(effects: Iterable[Effect]) -> StreamingEffects:
    """Return the streaming effects of effects, of those that have one, by the effect's name."""
    return {effect.name: streaming for effect in effects if (streaming := effect.streaming())}


def accepted_range(displacement_range: tuple[float, float]) -> tuple[float, float]:
    """Return the smallest and largest displacement (m) that may be desired, given the identified ones (m)."""
    low, high = displacement_range
    margin = TOLERATED_SHARE * (high - low)
    return low - margin, high + margin


def refusal(y: float, accepted: tuple[float, float], kind: str = "desired") -> str:
    """Return the message for a displacement `y` (m), desired or measured, that is refused."""
    return (
        f"{kind} displacement {y * 1e6:.6g} um is far outside what the model was identified on "
        f"(accepted: {accepted[0] * 1e6:.6g} to {accepted[1] * 1e6:.6g} um); "
        "check units and offset, or identify on a larger range"
    )


class StageStream:
    """Causal compensation of several axes: ``{axis: v} = step(t, {axis: y})``.

    Parameters
    ----------
    streams : mapping of axis name to StreamingInverse
        Owned by the stage from here on.
    coupling : Coupling
    origins : mapping of axis name to float, metres
        From there the motion of an axis counts for the others.

    Attributes
    ----------
    streams : dict of axis name to StreamingInverse
    """

    def __init__(
        self, streams: Mapping[str, StreamingInverse], coupling: Coupling, origins: Mapping[str, float]
    ) -> None:
        self.streams = dict(streams)
        self._coupling, self._origins = coupling, origins

    def step(self, t: float, y: Mapping[str, float]) -> dict[str, float]:
        """Return the voltages (V) for desired displacements `y` (m) at time `t` (s); other axes keep theirs.

        Raises
        ------
        SlpiError
            As `StreamingInverse.check`, or if there is no such axis; nothing has moved then.
        """
        for name, desired in y.items():
            if name not in self.streams:
                raise UsageError(f"no axis '{name}'; there are {', '.join(self.streams)}")
            try:
                self.streams[name].check(t, desired)
            except SlpiError as error:
                raise type(error)(f"axis '{name}': {error}") from None
        self.decouple(y)
        return {name: self.streams[name].step(t, desired) for name, desired in y.items()}

    __call__ = step

    def decouple(self, y: Mapping[str, float]) -> None:
        """Tell every axis what the others will add once the named ones are at `y` (m)."""
        if not self._coupling.on:
            return
        streams, origins = self.streams, self._origins
        moving = {name: streams[name].remove_sensor_effects(desired) - origins[name] for name, desired in y.items()}
        resting = {
            name: each.uncoupled_displacement - origins[name] for name, each in streams.items() if name not in moving
        }
        motions = self._coupling.decouple(moving, resting)
        motions.update(resting)
        for name, stream in streams.items():
            stream.coupled = float(self._coupling.part(name, motions))

    def snapshot(self) -> dict[str, StreamState]:
        """Return the whole state, to be given back to `restore`."""
        return {name: stream.snapshot() for name, stream in self.streams.items()}

    def restore(self, state: Mapping[str, StreamState]) -> None:
        """Take over a state from `snapshot`."""
        for name, stream in self.streams.items():
            stream.restore(state[name])
