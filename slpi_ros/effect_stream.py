"""Compensation sample by sample of an axis that does more than its hysteresis says."""

from collections.abc import Callable
from copy import deepcopy
from dataclasses import replace
from typing import cast

import numpy as np
from numpy.typing import NDArray

from slpi_ros.chain import Chain
from slpi_ros.effects.creep import CreepFollower
from slpi_ros.effects.effect import DrivenFollower, Follower
from slpi_ros.effects.rate_dependence import RateDependence
from slpi_ros.hysteresis.memory import Memory
from slpi_ros.stream import LONGEST_STEP, ROUNDING, AxisStream, Limits, StreamState

FloatArray = NDArray[np.float64]
Followers = dict[str, Follower]


class EffectStream(AxisStream):
    """An axis with effects around its hysteresis, each followed sample by sample.

    A wish goes back through the effects behind the hysteresis, the hysteresis, and those before it. The voltage it asks
    for is then kept within the limits, and what really comes of it goes forward again: the memory follows the voltage
    that reaches the hysteresis, and the effects what is really done.

    Parameters
    ----------
    memory : Memory
        As in `AxisStream`; the effects are at rest there.
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
        self._own: Followers = {effect.name: follower for effect in chain.own if (follower := effect.follower())}
        self._sensor: Followers = {effect.name: follower for effect in chain.shared if (follower := effect.follower())}
        for follower in self._before.values():
            follower.start(memory.voltage)
        for follower in (*self._own.values(), *self._sensor.values()):
            follower.start(memory.displacement)
        if (rate := self._driven()) and middle:
            rate.attach(lambda u: float(middle(np.array(u))))
            rate.drive(0.0, memory.voltage)
        self._v, self._place = memory.voltage, memory.displacement
        self._late = self._stuck = False

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
    def own(self) -> float:
        """Displacement (m) that the model gives the present voltage, before other axes come in."""
        return self._place

    @property
    def missed(self) -> bool:
        """Whether the last wish is not met, for whatever limit."""
        return self._late

    @property
    def held(self) -> bool:
        """Whether the last wish could not be met: the voltage waits at one of its limits."""
        return self._late and (self._stuck or self._v in (self.limits.lower, self.limits.upper))

    def unseen(self, y: float) -> float:
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
        if dt > LONGEST_STEP:
            # The voltage has stayed: only the last part of a pause may lead to the new one.
            counted = LONGEST_STEP
            self.wait(dt - counted)
        h = self.unseen(y) - self.coupled
        for follower in reversed(self._own.values()):
            h = follower.inverse(counted, h)
        v = self._move_before(dt, counted, h) if self._before else self._move_at_once(dt, h)
        self.wish, self._v = h, v
        self._answer(counted)
        return v

    def drive(self, voltage: float, dt: float = 0.0) -> float:
        """Move to a voltage (V), `dt` (s) after the last one, whatever is wished for; return the displacement (m)."""
        self._v = self._goal = voltage
        self.memory.forward(self._reaching(dt, voltage))
        self.wish, self._late = self.memory.displacement, False
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

    def resume(self, before: AxisStream) -> None:
        """Go on where another model's stream has been; its voltage stays, and what its effects have begun."""
        self.pace.rate, self._v, self._goal = before.pace.rate, before.voltage, before.voltage
        if not self._before:
            self.memory.forward(before.voltage)
        for follower in self._before.values():
            # The command jumps there, and no time passes.
            follower.forward(0.0, before.voltage)
        if isinstance(before, EffectStream):
            for name, follower in self._own.items():
                other = before._own.get(name)
                if isinstance(follower, CreepFollower) and isinstance(other, CreepFollower):
                    follower.resume(other, self.memory.displacement)
        self._answer(0.0)

    def twin(self) -> "EffectStream":
        """Return a stream in the same state, which moves on its own."""
        twin = super().twin()
        assert isinstance(twin, EffectStream)
        twin._before, twin._own, twin._sensor = deepcopy((self._before, self._own, self._sensor))
        return twin

    def _move_at_once(self, dt: float, h: float) -> float:
        """Move where the command reaches the hysteresis as it is."""
        v = super().move(dt, h)
        self._late = abs(self.memory.displacement - h) > self._rounding
        return v

    def _move_before(self, dt: float, counted: float, h: float) -> float:
        """Move where something stands between command and hysteresis."""
        memory, pace = self.memory, self.pace
        limits, state = pace.limits, memory.snapshot()
        goal = u = memory.inverse(h, limits.lower, limits.upper)
        self._stuck = abs(memory.displacement - h) > self._rounding
        for follower in reversed(self._before.values()):
            goal = follower.inverse(counted, goal)
        v = pace.step(self._v, goal, dt, self._goal)
        self._late = self._stuck or abs(v - goal) > ROUNDING * (1.0 + abs(goal))
        self._goal = goal
        reached = self._reaching(counted, v)
        if reached != u:
            memory.restore(state)
            memory.forward(reached)
        return v

    def _reaching(self, dt: float, v: float) -> float:
        """Let a command (V) go through to the hysteresis; return the voltage (V) that arrives."""
        for follower in self._before.values():
            v = follower.forward(dt, v)
        return v

    def _answer(self, dt: float) -> None:
        """Let the effects follow what the hysteresis does."""
        place = self.memory.displacement
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
