"""Compensation sample by sample of an axis that does more than its hysteresis says."""

from collections.abc import Callable, Mapping
from copy import copy, deepcopy
from dataclasses import dataclass, field, replace
from math import inf, isfinite
from typing import Any, ClassVar, cast

import numpy as np
from numpy.typing import NDArray

from slpi_ros.effects.base import DrivenFollower, Follower
from slpi_ros.effects.chain import Chain
from slpi_ros.effects.creep import CreepFollower
from slpi_ros.effects.cross_coupling import Coupling
from slpi_ros.effects.rate_dependence import CoercivityFollower, RateDependence
from slpi_ros.errors import SlpiError, UnreachableError, UsageError
from slpi_ros.hysteresis.turning_points import Memory, MemoryState
from slpi_ros.model.limits import MAX_DT, Limits, RateLimiter

__all__ = [
    "MAX_DT",
    "ROUNDING",
    "StreamingInverse",
    "Limits",
    "RateLimiter",
    "StreamState",
    "accepted_range",
    "refusal",
]

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


class StreamingInverse:
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
        self.pace = RateLimiter(limits)
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
    def uncoupled_displacement(self) -> float:
        """Displacement (m) that the model gives the present voltage, before other axes come in."""
        return self.memory.displacement

    def remove_sensor_effects(self, y: float) -> float:
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
        return StreamState(
            self.memory.snapshot(), self.voltage, self._goal, self.pace.rate, self.wish, self.uncoupled_displacement
        )

    def restore(self, state: StreamState) -> None:
        """Take over a state from `snapshot`."""
        self.memory.restore(state.memory)
        self._goal, self.pace.rate, self.wish = state.goal, state.rate, state.wish

    def resume(self, before: "StreamingInverse") -> None:
        """Go on where another model's stream has been; its voltage stays, and what its effects have begun."""
        self.pace.go_on(before.pace)
        if self.voltage != before.voltage:
            self.drive(before.voltage)

    def copy(self) -> "StreamingInverse":
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


FloatArray = NDArray[np.float64]
Followers = dict[str, Follower]

# A coercivity depends on the voltage that it leads to, but little: so often it is tried again.
TRIALS = 4


class EffectStream(StreamingInverse):
    """An axis with effects around its hysteresis, each followed sample by sample.

    A wish goes back through the effects behind the hysteresis, the hysteresis, and those before it. The voltage it asks
    for is then kept within the limits, and what really comes of it goes forward again: the memory follows the voltage
    that reaches the hysteresis, and the effects what is really done.

    Parameters
    ----------
    memory : Memory
        As in `StreamingInverse`; the effects are at rest there.
    displacement_range : (float, float), metres
    limits : Limits
        Of the command; an amplifier that clips narrows them.
    chain : Chain
    middle : callable, optional
        Middle of the largest loop (m) at voltages (V), shape (N,); for rate dependence.
    """

    timeless = False

    def __init__(
        self,
        memory: Memory,
        displacement_range: tuple[float, float],
        limits: Limits,
        chain: Chain,
        middle: Callable[[FloatArray], FloatArray] | None = None,
    ) -> None:
        self._clipped = chain.clipped
        super().__init__(memory, displacement_range, self._narrowed(limits))
        # Limits are kept without followers.
        self._before: Followers = {
            effect.name: follower
            for effect in chain.before
            if effect.name != "saturation" and (follower := effect.follower())
        }
        played = self._before.get(RateDependence.name)
        self._play = played if isinstance(played, CoercivityFollower) else None
        self._own: Followers = {effect.name: follower for effect in chain.own if (follower := effect.follower())}
        self._sensor: Followers = {effect.name: follower for effect in chain.shared if (follower := effect.follower())}
        for follower in self._before.values():
            follower.start(memory.voltage)
        for follower in (*self._own.values(), *self._sensor.values()):
            follower.start(memory.displacement)
        if (rate := self._driven()) and middle:
            rate.attach(lambda u: float(middle(np.array(u))))
            rate.drive(0.0, memory.voltage)
        self._v = memory.voltage
        self._answer(0.0)
        # What the last wish asks of the voltage beyond what it gives (m or V), and of the axis as a whole (m).
        self._missing = self._short = 0.0

    @property
    def limits(self) -> Limits:
        """Voltage limits; new ones count from the next sample on."""
        return self.pace.limits

    @limits.setter
    def limits(self, limits: Limits) -> None:
        self.pace.limits = self._narrowed(limits)

    @property
    def voltage(self) -> float:
        """Present voltage of the command, volts."""
        return self._v

    @property
    def uncoupled_displacement(self) -> float:
        """Displacement (m) that the model gives the present voltage, before other axes come in."""
        return self._place

    @property
    def missed(self) -> bool:
        """Whether the last wish is not met, for whatever limit."""
        return self._missing != 0.0

    @property
    def held(self) -> bool:
        """Whether the voltage waits at the limit beyond which the last wish lies."""
        limits = self.pace.limits
        # What goes through effects comes to a limit but for rounding; what undoes them may ask for a detour.
        if min(self._missing, self._short) > 0.0:
            return self._v >= limits.upper - ROUNDING * (1.0 + abs(limits.upper))
        below = max(self._missing, self._short) < 0.0
        return below and self._v <= limits.lower + ROUNDING * (1.0 + abs(limits.lower))

    def remove_sensor_effects(self, y: float) -> float:
        """Return the place (m) at which a sensor sees the displacement `y` (m)."""
        for follower in self._sensor.values():
            y = follower.inverse(0.0, y)
        return y

    def move(self, dt: float, y: float) -> float:
        """Return the voltage (V) for the desired displacement `y` (m), `dt` (s) after the last one; neither is checked.

        Raises
        ------
        UsageError
            If the model has no voltage for it.
        """
        counted = dt
        if dt > MAX_DT:
            # The voltage has stayed: only the last part of a pause may lead to the new one.
            counted = MAX_DT
            self.wait(dt - counted)
        h = wish = self.remove_sensor_effects(y) - self.coupled
        for follower in reversed(self._own.values()):
            h = follower.inverse(counted, h)
        v = self._move_before(dt, counted, h) if self._before else self._move_at_once(dt, h)
        self.wish, self._v = h, v
        self._answer(counted)
        self._short = wish - self._place
        return v

    def drive(self, voltage: float, dt: float = 0.0) -> float:
        """Move to a voltage (V), `dt` (s) after the last one, whatever is wished for; return the displacement (m)."""
        self._v = self._goal = voltage
        self.memory.forward(self._reaching(dt, voltage))
        self.wish, self._missing = self.memory.displacement, 0.0
        self._answer(dt)
        return self._seen()

    def wait(self, duration: float) -> None:
        """Let time (s) pass without a wish."""
        self.drive(self._v, duration)

    def snapshot(self) -> StreamState:
        """Return the whole state, to be given back to `restore`."""
        followers = {**self._before, **self._own, **self._sensor}
        return replace(super().snapshot(), effects={name: each.snapshot() for name, each in followers.items()})

    def restore(self, state: StreamState) -> None:
        """Take over a state from `snapshot`."""
        super().restore(state)
        self._v, self._place = state.voltage, state.own
        for followers in (self._before, self._own, self._sensor):
            for name, follower in followers.items():
                follower.restore(state.effects[name])

    def resume(self, before: StreamingInverse) -> None:
        """Go on where another model's stream has been; its voltage stays, and what its effects have begun."""
        self.pace.go_on(before.pace)
        self._v = self._goal = before.voltage
        if self._play and isinstance(before, EffectStream) and before._play:
            self._play.restore(before._play.snapshot())
        # The command jumps there, and no time passes.
        self.memory.forward(self._reaching(0.0, before.voltage))
        if isinstance(before, EffectStream):
            for name, follower in self._own.items():
                other = before._own.get(name)
                if isinstance(follower, CreepFollower) and isinstance(other, CreepFollower):
                    follower.resume(other, self.memory.displacement)
        self._answer(0.0)

    def copy(self) -> "EffectStream":
        """Return a stream in the same state, which moves on its own."""
        twin = super().copy()
        assert isinstance(twin, EffectStream)
        twin._before, twin._own, twin._sensor, twin._play = deepcopy(
            (self._before, self._own, self._sensor, self._play)
        )
        return twin

    def _move_at_once(self, dt: float, h: float) -> float:
        """Move where the command reaches the hysteresis as it is."""
        v = super().move(dt, h)
        self._missing = self._beyond_rounding(h)
        return v

    def _move_before(self, dt: float, counted: float, h: float) -> float:
        """Move where something stands between command and hysteresis."""
        memory, pace = self.memory, self.pace
        state = memory.snapshot()
        goal, reversible_bypass = self._played(h)
        u = memory.voltage
        self._missing = self._beyond_rounding(h - reversible_bypass)
        for follower in reversed(self._before.values()):
            if follower is not self._play:
                goal = follower.inverse(counted, goal)
        v = pace.step(self._v, goal, dt, self._goal)
        if not self._missing and abs(goal - v) > ROUNDING * (1.0 + abs(goal)):
            self._missing = goal - v
        self._goal = goal
        reached = self._reaching(counted, v)
        if reached != u:
            memory.restore(state)
            memory.forward(reached)
        return v

    def _beyond_rounding(self, h: float) -> float:
        """Return how far (m) the hysteresis is from where it is asked to be; 0 where that is rounding."""
        missing = h - self.memory.displacement
        return missing if abs(missing) > self._rounding else 0.0

    def _played(self, h: float) -> tuple[float, float]:
        """Move the memory for a wish (m); return the voltage (V) it takes before the play, and what goes round (m)."""
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

    def _reaching(self, dt: float, v: float) -> float:
        """Let a command (V) go through to the hysteresis; return the voltage (V) that arrives."""
        for follower in self._before.values():
            v = follower.forward(dt, v)
        return v

    def _answer(self, dt: float) -> None:
        """Let the effects follow what the hysteresis does."""
        place = self.memory.displacement + (self._play.reversible_bypass if self._play else 0.0)
        if rate := self._driven():
            rate.drive(dt, self.memory.voltage)
        for follower in self._own.values():
            place = follower.forward(dt, place)
        self._place = place

    def _driven(self) -> DrivenFollower | None:
        """Return the follower that looks at the voltage, if there is one."""
        return cast(DrivenFollower | None, self._own.get(RateDependence.name))

    def _seen(self) -> float:
        """Return what a sensor sees (m)."""
        y = self._place + self.coupled
        for follower in self._sensor.values():
            y = follower.forward(0.0, y)
        return y

    def _narrowed(self, limits: Limits) -> Limits:
        lower = min(max(limits.lower, self._clipped[0]), limits.upper)
        return replace(limits, lower=lower, upper=max(min(limits.upper, self._clipped[1]), lower))


class StageStream:
    """Causal compensation of several axes: ``{axis: v} = step(t, {axis: y})``.

    Parameters
    ----------
    streams : mapping of axis name to AxisStream
        Owned by the stage from here on.
    coupling : Coupling
    origins : mapping of axis name to float, metres
        From there the motion of an axis counts for the others.

    Attributes
    ----------
    streams : dict of axis name to AxisStream
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
            As `AxisStream.check`, or if there is no such axis; nothing has moved then.
        """
        for name, wish in y.items():
            if name not in self.streams:
                raise UsageError(f"no axis '{name}'; there are {', '.join(self.streams)}")
            try:
                self.streams[name].check(t, wish)
            except SlpiError as error:
                raise type(error)(f"axis '{name}': {error}") from None
        self.decouple(y)
        return {name: self.streams[name].step(t, wish) for name, wish in y.items()}

    __call__ = step

    def decouple(self, y: Mapping[str, float]) -> None:
        """Tell every axis what the others will add once the named ones are at `y` (m)."""
        if not self._coupling.on:
            return
        streams, origins = self.streams, self._origins
        seen = {name: streams[name].remove_sensor_effects(wish) - origins[name] for name, wish in y.items()}
        resting = {
            name: each.uncoupled_displacement - origins[name] for name, each in streams.items() if name not in seen
        }
        motions = self._coupling.decouple(seen, resting)
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
