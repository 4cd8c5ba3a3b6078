"""Streaming (sample by sample) causal inverse of one axis, and of several cross-coupled axes."""

from collections.abc import Iterable, Mapping
from copy import copy, deepcopy
from dataclasses import dataclass, field, replace
from math import inf, isfinite
from typing import Any

import numpy as np

from slpi_ros.arrays import FloatArray, Mask
from slpi_ros.effects.base import Effect, StreamingAround, StreamingEffect
from slpi_ros.effects.chain import Chain
from slpi_ros.errors import SlpiError, UnreachableError, UsageError
from slpi_ros.hysteresis.turning_points import Memory, MemoryState, worth_compiling
from slpi_ros.io.messages import SECOND_NS
from slpi_ros.model.coupling import Coupling
from slpi_ros.model.limits import MAX_DT, Limits, RateLimiter

StreamingEffects = dict[str, StreamingEffect]

# A desired displacement outside the identified range by more than this share of its span is refused as an error (wrong
# unit, another stage); one closer to the range is held at the voltage limit.
TOLERATED_SHARE = 0.2
# Steps to the displacement at which a stage has relaxed: the slow part is a small share of it.
RELAXED_STEPS = 10
# Tolerance for rounding errors, as a share of the displacement range, or of the voltage.
ROUNDING = 1e-9


@dataclass(frozen=True)
class StreamState:
    """Complete state of a `StreamingInverse`."""

    memory: MemoryState
    voltage: float  # V, present command
    desired: float  # m, last setpoint of the hysteresis
    displacement: float  # m, of the axis without cross-coupling
    effects: Mapping[str, Any] = field(default_factory=dict)  # states by name


class StreamingInverse:
    """Causal compensation of one axis: ``v = step(t, y)``."""

    # The desired displacement of the stage is inverted through the effects after the hysteresis, the hysteresis, and
    # the effects before it. The resulting voltage is limited and then propagated forward, so that the hysteresis memory
    # and the effects follow the voltage that is really applied. The effects start in equilibrium; those of sensor and
    # record are ignored. Displacements in the range `accepted` (m), wider than the identified one, are accepted. `pace`
    # limits voltage, slew rate and acceleration; alone, in the time of the samples, of which at most `MAX_DT` counts. A
    # compensator gives it that of its output, on the steady clock.
    def __init__(
        self, memory: Memory, displacement_range: tuple[float, float], limits: Limits, effects: tuple[Effect, ...] = ()
    ) -> None:
        chain = Chain.of(effects)
        self.memory, self._chain, self._clipped = memory, chain, chain.clipped
        self.accepted = self._lowest, self._highest = accepted_range(displacement_range)
        self._rounding = ROUNDING * (displacement_range[1] - displacement_range[0])
        self._t = -inf
        self.coupled = 0.0  # m, displacement added by other axes, to be set before each sample
        self._before, self._behind = _streaming(chain.before), _streaming(chain.own)
        self._around: StreamingAround | None = chain.around.streaming() if chain.around else None
        self._around_name = chain.around.name if chain.around else ""
        # Effects after the hysteresis that follow the voltage, too.
        needing = [effect.name for effect in chain.own if effect.needs_voltage]
        self._driven = tuple(self._behind[name] for name in needing if name in self._behind)
        self._following = tuple(self._behind[effect.name] for effect in chain.own if effect.keys)
        # Only the hysteresis, and what is around it: the command alone determines where the axis is.
        self._direct = not (self._before or self._behind)
        self._alone = not (chain.before or chain.own or chain.shared)
        self.timeless = not self._streaming  # whether the model does not depend on time
        self.pace = RateLimiter(limits, MAX_DT / 2)
        self.limits = limits
        # Shortfall of the last sample: of the hysteresis or the voltage (m or V), and of the axis as a whole (m).
        self._missing = self._short = 0.0
        # The axis may start outside its limits; the first output voltage is inside.
        self.rest_at(self.limits.clip(memory.voltage))

    def rest_at(self, voltage: float, measured: float | None = None) -> float:
        """Continue from a voltage (V) at which the stage rests, all effects in equilibrium; return where it is (m).

        Slow effects have relaxed where the stage is `measured` to be (m), whatever the memory says, but within the
        largest loop.
        """
        if voltage != self.pace.voltage:
            self.pace.start(voltage)
        self._command = felt = voltage
        for streaming in self._before.values():
            streaming.start(felt)
            felt = streaming.forward(0.0, felt)
        felt = min(max(felt, self._clipped[0]), self._clipped[1])
        if self._around:
            self._around.start(felt)
        self.memory.forward(felt)
        if self._driven:
            for streaming in self._driven:
                streaming.reach(self._applied)
        y = rested = self._inside
        if measured is not None and any(streaming.relaxing for streaming in self._behind.values()):
            rested = self._rested(felt, measured - self.coupled)
        for streaming in self._behind.values():
            streaming.start(rested if streaming.relaxing else y)
            y = streaming.forward(0.0, y)
        self.desired, self._missing, self._displacement = self._inside, 0.0, y
        return y + self.coupled

    def _rested(self, felt: float, measured: float) -> float:
        """Return the displacement (m) of the hysteresis, at the voltage it feels (V), of a stage that rests there."""
        memory, state, ends = copy(self.memory), self.memory.snapshot(), list[float]()
        for end in (self._v_min, self._v_max):
            memory.restore(state)
            memory.forward(end)
            ends.append(memory.forward(felt))
        beside = self._inside - self.memory.displacement
        low, high = min(ends) + beside, max(ends) + beside
        rested = min(max(measured, low), high)
        for _ in range(RELAXED_STEPS):
            y = rested
            for streaming in self._behind.values():
                streaming.start(y)
                y = streaming.forward(0.0, y)
            rested = min(max(rested + measured - y, low), high)
        return rested

    @property
    def _streaming(self) -> "dict[str, StreamingEffect | StreamingAround]":
        """All streaming effects by name."""
        around = {self._around_name: self._around} if self._around else {}
        return {**self._before, **around, **self._behind}

    @property
    def limits(self) -> Limits:
        """Voltage limits; new limits apply from the next sample on."""
        return self.pace.limits

    @limits.setter
    def limits(self, limits: Limits) -> None:
        self.pace.limits = limits = self.restricted(limits)
        self._v_min, self._v_max = limits.lower, limits.upper
        self._free = self._alone and limits.slew == limits.acceleration == inf

    def restricted(self, limits: Limits) -> Limits:
        """Return limits, restricted to the voltages that pass the effects."""
        lower = min(max(limits.lower, self._clipped[0]), limits.upper)
        return replace(limits, lower=lower, upper=max(min(limits.upper, self._clipped[1]), lower))

    @property
    def voltage(self) -> float:
        """Present command, volts."""
        return self._command if self._before or self._around else self.memory.voltage

    @property
    def uncoupled_displacement(self) -> float:
        """Displacement (m) of the model for the present voltage, without cross-coupling."""
        return self._inside if self._direct else self._displacement

    @property
    def _applied(self) -> float:
        """Voltage (V) at the piezo."""
        return self._around.applied if self._around else self.memory.voltage

    @property
    def _inside(self) -> float:
        """Displacement (m) of the hysteresis and what goes beside it."""
        return self.memory.displacement + (self._around.beside if self._around else 0.0)

    @property
    def missed(self) -> bool:
        """Whether any limit prevented the model from reaching the last desired displacement."""
        return self._beyond_rounding(self.desired) != 0.0 if self._direct else self._missing != 0.0

    @property
    def held(self) -> bool:
        """Whether the voltage is held at the limit beyond which the last desired displacement lies."""
        if self._direct:
            missing = short = self._beyond_rounding(self.desired)
        else:
            missing, short = self._missing, self._short
        limits, v = self.pace.limits, self.voltage
        # With effects, a limit is reached only up to rounding errors, and their inverse may overshoot.
        if min(missing, short) > 0.0:
            return v >= limits.upper - ROUNDING * (1.0 + abs(limits.upper))
        return max(missing, short) < 0.0 and v <= limits.lower + ROUNDING * (1.0 + abs(limits.lower))

    def surround(self, values: Mapping[str, float]) -> None:
        """Note values of quantities, by name, for the next sample; what the stage does not follow is ignored."""
        for key, value in values.items():
            for streaming in self._following:
                streaming.surround(key, value)

    def check(self, t: float, y: float) -> None:
        """Raise the error that `step` would raise for `t` (s) and `y` (m), without a change of state."""
        if not (isfinite(t) and isfinite(y)):
            raise UsageError(f"sample t = {t} s, displacement = {y} m is not finite; omit the sample")
        if t < self._t:
            raise UsageError(f"time runs backwards: {t:.9g} s after {self._t:.9g} s; send samples in order")
        if not self._lowest <= y <= self._highest:
            raise UnreachableError(refusal(y, self.accepted))

    def step(self, t: float, y: float, surroundings: Mapping[str, float] | None = None) -> float:
        """Return the voltage (V) for the desired displacement `y` (m) at time `t` (s); errors as in `check`.

        `surroundings` are new values of quantities that the stage follows, by name; others stay as they were.
        """
        if surroundings:
            self.surround(surroundings)
        if not (self._t <= t < inf and self._lowest <= y <= self._highest):
            self.check(t, y)
        if self._free:
            self.desired = y
            if self._around:
                dt = t - self._t if self._t > -inf else 0.0
                v = self._command = self._around.inverse(dt, y, self.memory, self._v_min, self._v_max)
            else:
                v = self.memory.inverse(y, self._v_min, self._v_max)
        else:
            now_ns, before = nanoseconds(t), t if self._t == -inf else self._t
            # Rate limits count from the last sample, whether the voltage changed or not; before the first, no time.
            self.pace.begin(nanoseconds(before))
            v = self.move(t - before, y, now_ns)
        self._t = t
        return v

    __call__ = step

    def move(self, dt: float, y: float, now_ns: int) -> float:
        """Return the voltage (V) for the displacement `y` (m), `dt` (s) after the last sample, without checks."""
        if self._direct:
            self.desired = y - self.coupled
            self._command = self._move(dt, dt, self.desired, now_ns)
            return self._command
        counted = dt
        if dt > MAX_DT:
            # The voltage was held during the pause; only its last part counts for the new voltage, except in the effect
            # around the hysteresis, which knows only its voltages at the samples.
            counted, held = MAX_DT, self._command
            for before in self._before.values():
                held = before.forward(dt - counted, held)
            self._follow(dt - counted)
        h = displacement = y - self.coupled
        for streaming in reversed(self._behind.values()):
            h = streaming.inverse(counted, h)
        v = self._move(counted, dt, h, now_ns)
        self.desired, self._command = h, v
        self._follow(counted)
        self._short = displacement - self._displacement
        return v

    def run(self, t: FloatArray, y: FloatArray, coupled: FloatArray | float = 0.0) -> tuple[FloatArray, Mask]:
        """Return what `step` gives for each sample of a path (s, m), and where it is `held`, shape (N,) each."""
        # For a new stream only, whose state afterwards is not defined: long paths are evaluated by compiled code, equal
        # to `step` but for rounding errors.
        limits = self.pace.limits
        unlimited = limits.slew == limits.acceleration == inf
        if unlimited and self.timeless:
            return self._run_hysteresis(y - coupled)
        v, held = np.empty(y.size), np.zeros(y.size, dtype=bool)
        if unlimited and (laws := self._laws()) is not None and worth_compiling(y.size):
            from slpi_ros.effects.paths import Laws, inverse_path

            h, dt, voltages = y - coupled, np.diff(t, prepend=t[:1]), (float(limits.lower), float(limits.upper))
            direction, point, turns, depth = self.memory.arrays(4 * y.size + 4)
            done = inverse_path(
                *(dt, h, *voltages, MAX_DT, (self._rounding, ROUNDING), self.memory.far, Laws(**laws), v, held),
                *(point, turns, direction, depth, *self.memory.shape_arrays()),
            )
            if done < y.size:
                raise UsageError(
                    f"sample {done}: displacement {y[done]} m cannot be reached by this model; leave it out"
                )
            return v, held
        parts = np.broadcast_to(np.asarray(coupled, dtype=np.float64), y.shape).tolist()
        for k, (now, desired, self.coupled) in enumerate(zip(t.tolist(), y.tolist(), parts, strict=True)):
            try:
                v[k], held[k] = self.step(now, desired), self.held
            except SlpiError as error:
                raise type(error)(f"sample {k}: {error}") from None
        return v, held

    def _laws(self) -> dict[str, Any] | None:
        """Return the fields of `slpi_ros.effects.paths.Laws`; None if an effect has no compiled form."""
        chain, found = self._chain, dict[str, Any]()
        for effect in (*chain.before, *([chain.around] if chain.around else []), *chain.own):
            if effect.name in self._streaming:
                laws = effect.laws()
                if laws is None:
                    return None
                found |= laws
        return found

    def _run_hysteresis(self, h: FloatArray) -> tuple[FloatArray, Mask]:
        """Return the result of `run` without effects, for displacements (m), shape (N,)."""
        limits, again = self.pace.limits, copy(self.memory)
        again.restore(self.memory.snapshot())
        v = self.memory.inverse_array(h, limits.lower, limits.upper)
        if not v.size or (v.min() > limits.lower and v.max() < limits.upper):
            return v, np.zeros(v.size, dtype=bool)
        return v, self._beyond(v, h - again.forward_array(v))

    def _beyond(self, v: FloatArray, missing: FloatArray) -> Mask:
        """Return where voltages (V) are at the limit beyond which the displacement `missing` (m) lies, shape (N,)."""
        lower, upper = self.pace.limits.lower, self.pace.limits.upper
        above = (missing > self._rounding) & (v >= upper - ROUNDING * (1.0 + abs(upper)))
        return np.asarray(above | ((missing < -self._rounding) & (v <= lower + ROUNDING * (1.0 + abs(lower)))))

    def drive(self, voltage: float, dt: float = 0.0) -> float:
        """Apply a voltage (V), `dt` (s) after the last sample, without a setpoint; return where the stage is (m)."""
        if voltage != self.pace.voltage:
            self.pace.start(voltage)
        self._apply(dt, voltage)
        return self.uncoupled_displacement + self.coupled

    def wait(self, duration: float) -> None:
        """Advance the effects by `duration` (s) at the present voltage; `pace` stays where the amplifier is."""
        if not self.timeless:
            self._apply(duration, self.voltage)

    def _apply(self, dt: float, voltage: float) -> None:
        """Let memory and effects follow a voltage (V), `dt` (s) after the last sample."""
        self._command = voltage
        self.memory.forward(self._reaching(dt, voltage))
        self.desired, self._missing = self._inside, 0.0
        self._follow(dt)

    def snapshot(self) -> StreamState:
        """Return the complete state for `restore`."""
        return StreamState(
            self.memory.snapshot(),
            self.voltage,
            self.desired,
            self.uncoupled_displacement,
            {name: each.snapshot() for name, each in self._streaming.items()},
        )

    def restore(self, state: StreamState) -> None:
        """Restore a state from `snapshot`."""
        self.memory.restore(state.memory)
        self._command = state.voltage
        self.desired, self._displacement = state.desired, state.displacement
        for name, streaming in self._streaming.items():
            streaming.restore(state.effects[name])
        if state.voltage != self.pace.voltage:
            self.pace.start(state.voltage)

    def resume(self, before: "StreamingInverse") -> None:
        """Continue from the inverse of another model: same voltage, and the state of the effects that it also has."""
        self._command = before.voltage
        if self._around and before._around and self._around_name == before._around_name:
            self._around.resume(before._around, before.voltage)
        # The command is set without elapsed time.
        self.memory.forward(self._reaching(0.0, before.voltage))
        self.desired = self._inside
        y = self.desired
        for name, streaming in self._behind.items():
            if name in before._behind:
                streaming.resume(before._behind[name], y)
            y = streaming.forward(0.0, y)
        self._follow(0.0)

    def relaxing(self, seconds: float) -> dict[str, tuple[float, ...]]:
        """Return the distances (m) of slow effects from equilibrium, `seconds` after the last sample."""
        later = self.copy()
        later.wait(seconds)
        return {name: distances for name, effect in later._behind.items() if (distances := effect.relaxing)}

    def relax_from(self, distances: Mapping[str, tuple[float, ...]], seconds: float) -> None:
        """Continue from distances as of `relaxing`, after `seconds` at the present voltage."""
        for name in distances.keys() & self._behind.keys():
            self._behind[name].relax_from(distances[name])
        self.wait(seconds)

    def copy(self) -> "StreamingInverse":
        """Return an independent copy in the same state."""
        other = copy(self)
        other.memory, other.pace = copy(self.memory), self.pace.copy()
        other.memory.restore(self.memory.snapshot())
        own = self._before, self._around, self._behind, self._driven, self._following
        other._before, other._around, other._behind, other._driven, other._following = deepcopy(own)
        return other

    def _move(self, dt: float, elapsed: float, h: float, now_ns: int) -> float:
        """Move command and memory towards a displacement of the hysteresis (m); return the command (V)."""
        # `dt` (s) is the time for the effects, `elapsed` (s) that for the effect around the hysteresis, `now_ns` (ns)
        # that for the rate limits.
        memory, pace, around = self.memory, self.pace, self._around
        if not self._before and pace.limits.acceleration == inf:
            reach = pace.reach(now_ns)
            v = pace.move(self._invert(elapsed, h, *reach), now_ns, reach)
            self._missing = self._beyond_rounding(h)
            return v
        state, felt, limits = memory.snapshot(), around.snapshot() if around else None, pace.limits
        goal = inside = self._invert(elapsed, h, limits.lower, limits.upper)
        self._missing = self._beyond_rounding(h)
        for streaming in reversed(self._before.values()):
            goal = streaming.inverse(dt, goal)
        v = reached = pace.step(goal, now_ns)
        if not self._missing and abs(goal - v) > ROUNDING * (1.0 + abs(goal)):
            self._missing = goal - v
        for streaming in self._before.values():
            reached = streaming.forward(dt, reached)
        if reached != inside:
            memory.restore(state)
            if around:
                around.undo(felt)
                reached = around.forward(elapsed, reached)
            memory.forward(reached)
        return v

    def _invert(self, dt: float, h: float, lower: float, upper: float) -> float:
        """Move the memory towards a displacement (m) and return the voltage (V) for it, within limits (V)."""
        if self._around:
            return self._around.inverse(dt, h, self.memory, lower, upper)
        return self.memory.inverse(h, lower, upper)

    def _beyond_rounding(self, h: float) -> float:
        """Return the setpoint `h` minus the displacement inside (m); 0 if it is only a rounding error."""
        missing = h - self._inside
        return missing if abs(missing) > self._rounding else 0.0

    def _reaching(self, dt: float, v: float) -> float:
        """Return the voltage (V) that the hysteresis feels for a command `v` (V), `dt` (s) later."""
        for streaming in self._before.values():
            v = streaming.forward(dt, v)
        v = min(max(v, self._clipped[0]), self._clipped[1])
        return self._around.forward(dt, v) if self._around else v

    def _follow(self, dt: float) -> None:
        """Propagate the output of the hysteresis through the effects after it."""
        if self._driven:
            for streaming in self._driven:
                streaming.reach(self._applied)
        y = self._inside
        for streaming in self._behind.values():
            y = streaming.forward(dt, y)
        self._displacement = y


def nanoseconds(t: float) -> int:
    """Return a time `t` (s) in whole nanoseconds, on the clock of a rate limiter."""
    whole = int(t)
    return whole * SECOND_NS + round((t - whole) * SECOND_NS)


def _streaming(effects: Iterable[Effect]) -> StreamingEffects:
    """Return the streaming forms of the effects by name; effects without a streaming form are omitted."""
    return {effect.name: streaming for effect in effects if (streaming := effect.streaming())}


def accepted_range(displacement_range: tuple[float, float]) -> tuple[float, float]:
    """Return the smallest and largest accepted displacement (m) for the identified range (m)."""
    low, high = displacement_range
    margin = TOLERATED_SHARE * (high - low)
    return low - margin, high + margin


def refusal(y: float, accepted: tuple[float, float], kind: str = "desired") -> str:
    """Return the message for a refused displacement `y` (m); `kind` is "desired" or "measured"."""
    return (
        f"{kind} displacement {y * 1e6:.6g} µm is far outside the identified range "
        f"(accepted: {accepted[0] * 1e6:.6g} to {accepted[1] * 1e6:.6g} µm); "
        "check units and offset, or identify on a larger range"
    )


class StageStream:
    """Causal compensation of several axes: ``{axis: v} = step(t, {axis: y})``."""

    # `origins` (m) are the displacements from which the motion of each axis is measured for cross-coupling.
    def __init__(
        self, streams: Mapping[str, StreamingInverse], coupling: Coupling, origins: Mapping[str, float]
    ) -> None:
        self.streams = dict(streams)
        self._coupling, self._origins = coupling, origins

    def step(self, t: float, y: Mapping[str, float]) -> dict[str, float]:
        """Return voltages (V) for displacements `y` (m) at `t` (s), or raise unchanged; other axes hold theirs."""
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
        """Set `coupled` of every axis for the desired displacements `y` (m) of the named axes."""
        if not self._coupling.on:
            return
        origins = self._origins
        moving = {name: desired - origins[name] for name, desired in y.items()}
        resting = {
            name: each.uncoupled_displacement - origins[name]
            for name, each in self.streams.items()
            if name not in moving
        }
        for name, part in self._coupling.parts(moving, resting).items():
            self.streams[name].coupled = part

    def snapshot(self) -> dict[str, StreamState]:
        """Return the complete state for `restore`."""
        return {name: stream.snapshot() for name, stream in self.streams.items()}

    def restore(self, state: Mapping[str, StreamState]) -> None:
        """Restore a state from `snapshot`."""
        for name, stream in self.streams.items():
            stream.restore(state[name])
