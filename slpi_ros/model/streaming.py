"""Compensation sample by sample of an axis that does more than its hysteresis says."""

from collections.abc import Callable
from copy import deepcopy
from dataclasses import replace
from typing import cast

import numpy as np
from numpy.typing import NDArray

from slpi_ros.effects.chain import Chain
from slpi_ros.effects.coercivity import CoercivityFollower
from slpi_ros.effects.creep import CreepFollower
from slpi_ros.effects.effect import DrivenFollower, Follower
from slpi_ros.effects.rate_dependence import RateDependence
from slpi_ros.hysteresis.memory import Memory
from slpi_ros.model.stream import LONGEST_STEP, ROUNDING, AxisStream, Limits, StreamState

FloatArray = NDArray[np.float64]
Followers = dict[str, Follower]

# A coercivity depends on the voltage that it leads to, but little: so often it is tried again.
TRIALS = 4


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
        self._v, self._place = memory.voltage, memory.displacement
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
    def own(self) -> float:
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
        h = wish = self.unseen(y) - self.coupled
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

    def resume(self, before: AxisStream) -> None:
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

    def twin(self) -> "EffectStream":
        """Return a stream in the same state, which moves on its own."""
        twin = super().twin()
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
        goal, aside = self._played(h)
        u = memory.voltage
        self._missing = self._beyond_rounding(h - aside)
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
        u, aside = memory.voltage, 0.0
        for _ in range(TRIALS):
            v = play.ahead(u, direction)
            aside = play.between(v, u)
            wanted = max(h - aside, rest) if direction > 0 else min(h - aside, rest)
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
        place = self.memory.displacement + (self._play.aside if self._play else 0.0)
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
