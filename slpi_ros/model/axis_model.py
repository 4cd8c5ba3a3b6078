"""Model of one axis: hysteresis model, effects, initial state, and fit quality."""

import warnings
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property
from math import inf
from typing import Literal

import numpy as np

from slpi_ros.arrays import FloatArray, Mask
from slpi_ros.effects.base import Effect, EffectContext, Followed
from slpi_ros.effects.chain import Chain, backward, forward, lasting
from slpi_ros.effects.registry import in_order
from slpi_ros.errors import UnreachableError, UsageError
from slpi_ros.hysteresis import multi_slope as smpi
from slpi_ros.hysteresis import slpi_published as slpi
from slpi_ros.hysteresis.kinds import Hysteresis, PathModel
from slpi_ros.hysteresis.reversals import require_finite
from slpi_ros.hysteresis.turning_points import Memory
from slpi_ros.io.record import Course
from slpi_ros.model.limits import Limits, decaying_turns
from slpi_ros.model.sensor import IDEAL, Sensor, StreamingSensor
from slpi_ros.model.streaming import ROUNDING, StreamingInverse, accepted_range, refusal

StartMemory = Literal["end", "start", "wiped"]
START_MEMORIES: tuple[StartMemory, ...] = ("end", "start", "wiped")

# Maximum number of reversal voltages in a document.
MOST_TURNS = 1000
# Cycles of the decaying oscillation of a reset.
WIPING_CYCLES = 10


@dataclass(frozen=True)
class Start:
    """Initial state of the hysteresis memory."""

    voltage: float  # V, after the history
    displacement: float  # m, after the history
    history: tuple[float, ...] = ()  # V, earlier reversals, oldest first; empty: never moved
    from_rest: bool = False  # never moved before `history`; False: a long fall, which erased the memory, led there


# An error up to this multiple of the sensor noise counts as noise.
ABOVE_NOISE = 1.5
# Times that the voltage of a path known in advance is improved where effects on the displacement follow it, too.
VOLTAGE_TURNS = 8
# Best accuracy of a hysteresis model without noise, as a share of the displacement range.
RESOLUTION = 2e-4


@dataclass(frozen=True)
class FittedRecord:
    """A record that a model was identified from."""

    source: str
    sha256: str | None = None  # of its readings, see `slpi_ros.io.digests.record_digest`; None: unknown


@dataclass(frozen=True)
class FitQuality:
    """Free-run error of the model on the record, or records, `source` of its identification, at `samples` samples."""

    rms: float  # m, of the fitted samples
    maximum: float  # m
    held_out_rms: float  # m, from cross-validation
    floor_rms: float  # m, sensor noise: the white part of the residual
    samples: int
    covered: float  # 0..1, of the cells of the Everett function
    source: str
    fastest: float | None = None  # V/s, see `slpi_ros.model.coverage`; None: unknown, as in older documents
    # What the uncertainty needs, see `slpi_ros.model.uncertainty`; None: unknown, as in older documents.
    regions: tuple[float | None, ...] | None = None  # m, rms in equal parts of the displacement range; None: no samples
    drift: float | None = None  # m per square root of a second, of the zero
    duration: float | None = None  # s, of the longest record
    left_out_rms: float | None = None  # m, of records that were not fitted; None: there was only one
    verdict: str | None = None  # of the diagnosis that extended it; None: none did
    records: tuple[FittedRecord, ...] | None = None  # None: unknown, as in older documents

    @property
    def fitted(self) -> tuple[FittedRecord, ...]:
        """The records, as far as they are known."""
        return self.records or tuple(map(FittedRecord, self.source.split(", ")))

    @property
    def sources(self) -> list[str]:
        """Names of the records."""
        if self.records is None:
            return self.source.split(", ")
        return list(dict.fromkeys(record.source for record in self.records))


@dataclass(frozen=True)
class AxisModel:
    """Model of one axis: hysteresis and effects, for simulation, inversion and streaming.

    Parameters
    ----------
    kind : str
        Name of the hysteresis model.
    start : Start
        Initial state of the record.
    voltage_range : (float, float), volts
    displacement_range : (float, float), metres
        Ranges covered by the record. `compensate` returns only voltages within the voltage range.
    effects : tuple of Effect
        Effects besides the hysteresis, each at most once; default: none. Those of the stage are inverted; those of the
        sensor are taken out of measurements; those of the record hold for that record only.
    end : Start, optional
        State of the hysteresis at the end of the (last) record. None (default): unknown, as in older documents and for
        kinds that are not causal.
    sensor : Sensor
        Known delay and lag of the sensor, taken out of measurements; default: none.
    surroundings : mapping of str to (ndarray, ndarray), shape (n,) each
        Times (s) and values of quantities that the stage follows, by name; of those that are not in it, and by default
        of all, the reference values.
    """

    kind: str
    hysteresis: Hysteresis
    start: Start
    voltage_range: tuple[float, float]
    displacement_range: tuple[float, float]
    quality: FitQuality
    effects: tuple[Effect, ...] = ()
    end: Start | None = None
    sensor: Sensor = IDEAL
    surroundings: Mapping[str, Course] = field(default_factory=dict)

    def __post_init__(self) -> None:
        rest = self.start.displacement
        object.__setattr__(self, "effects", tuple(effect.anchored(rest) for effect in in_order(self.effects)))

    @property
    def causal(self) -> bool:
        """Whether the model allows streaming, without future samples."""
        return not isinstance(self.hysteresis, PathModel)

    def initial(self, start_memory: StartMemory) -> Start:
        """Return the initial state named by `start_memory`; UsageError if there is none of that name.

        ``end``: state at the end of the record, or at its start if the end is unknown; ``start``: state at the start of
        the record; ``wiped``, only for a causal model: state after a decaying oscillation over the identified voltage
        range to 0 V, or to the nearest voltage in that range.
        """
        match start_memory:
            case "start":
                return self.start
            case "end":
                return self.end or self.start
            case "wiped":
                limits = Limits(*self.hysteresis_range)
                return self.after(np.array(decaying_turns(limits, limits.clip(0.0), WIPING_CYCLES)), "end")
        raise UsageError(f"start_memory is '{start_memory}'; give one of {', '.join(START_MEMORIES)}")

    def memory(self, start_memory: StartMemory = "end") -> Memory:
        """Return a new memory with the initial state `start_memory`; UsageError if the model is not causal."""
        if isinstance(self.hysteresis, PathModel):
            raise UsageError(
                f"kind '{self.kind}' needs the complete path in advance and does not allow streaming; "
                "pass the complete path, or identify kind 'slpi'"
            )
        start = self.initial(start_memory)
        if not start.history:
            return Memory(self.hysteresis, start.voltage, start.displacement)
        first, *turns = (*start.history, start.voltage)
        # The displacement is given for the end of the history: one simulation yields the displacement at its start.
        primed = not start.from_rest
        way = Memory(self.hysteresis, first, 0.0, primed=primed).forward_array(np.array([first, *turns]))[-1]
        memory = Memory(self.hysteresis, first, start.displacement - float(way), primed=primed)
        for v in turns:
            memory.forward(v)
        return memory

    def after(self, u: FloatArray, start_memory: StartMemory = "start") -> Start:
        """Return the state of the memory after voltages `u`, shape (N,), volts, that reach the hysteresis.

        It is reduced to the remembered reversals; of more than `MOST_TURNS` some of the nested loops are omitted.
        UsageError as in `memory`.
        """
        start, memory = self.initial(start_memory), self.memory(start_memory)
        memory.forward_array(u)
        state = memory.snapshot()
        if not state.direction:
            return Start(state.voltage, state.displacement)
        from_rest = start.from_rest or not start.history
        turns = state.reversals
        if from_rest:
            turns = ((*start.history, start.voltage)[0], *turns)
        if len(turns) > MOST_TURNS:
            # Complete loops are omitted, evenly over the nested ones, so that the directions still alternate.
            loops = np.unique(np.linspace(0, len(turns) // 2 - 1, MOST_TURNS // 2 - 1).astype(np.int64)) * 2
            turns = tuple(turns[i] for first in loops for i in (first, first + 1)) + turns[len(turns) // 2 * 2 :]
        return Start(state.voltage, state.displacement, turns or (state.voltage,), from_rest)

    def at_rest(self, u: FloatArray, v: float, start_memory: StartMemory = "start") -> Start:
        """Return the state after voltages `u`, as of `after`, and a rest at the applied voltage `v` (V).

        The voltage that reaches the hysteresis follows the applied one late; at rest the two are equal.
        """
        return self.after(np.append(u, np.clip(v, *self.chain.clipped)), start_memory)

    def stream(self, limits: Limits | None = None, start_memory: StartMemory = "end") -> StreamingInverse:
        """Return a streaming inverse within `limits` and the identified voltage range, from `initial(start_memory)`."""
        return self.stream_from(self.memory(start_memory), self._allowed(limits))

    def rest(self, limits: Limits | None = None, start_memory: StartMemory = "end") -> float:
        """Return the displacement (m) without cross-coupling from which `command` begins."""
        if not self.causal:
            return self.initial(start_memory).displacement
        return self.stream(limits, start_memory).uncoupled_displacement

    def stream_from(self, memory: Memory, allowed: Limits) -> StreamingInverse:
        """Return a streaming inverse that continues from a memory of this axis; the effects start in equilibrium."""
        return StreamingInverse(memory, self.displacement_range, allowed, self.effects)

    def simulate(
        self, t: FloatArray, v: FloatArray, others: Mapping[str, FloatArray] | None = None, *, of_record: bool = False
    ) -> FloatArray:
        """Return what the sensor will say, shape (N,), metres, for a voltage `v`, shape (N,), volts, at times `t` (s).

        Other axes are at rest, but for `others`, as in `seen`. Without effects the time is ignored. With `of_record`
        also those effects act that belong to the record of the identification, on its clock.
        """
        chain = Chain.of(self.effects) if of_record else self.chain
        return self._seen(chain, t, self._uncoupled_displacement(chain, t, v), others or {})

    def uncoupled_displacement(self, t: FloatArray, v: FloatArray) -> FloatArray:
        """Return the stage's displacement, shape (N,), metres, for `v`, shape (N,), volts, without cross-coupling."""
        return self._uncoupled_displacement(self.chain, t, v)

    def _uncoupled_displacement(self, chain: Chain, t: FloatArray, v: FloatArray) -> FloatArray:
        if not self.effects:
            return self._path().forward_array(v)
        require_finite(v)
        around = self._around(t, start=self.start.voltage)
        applied, u, beside = chain.reaching(v, around)
        beside += self._path().forward_array(u)
        return forward(chain.own, beside, replace(around.driven(applied), start=self.start.displacement))

    def _around(
        self, t: FloatArray, others: Mapping[str, FloatArray] | None = None, start: float | None = None
    ) -> EffectContext:
        """Return the context of the effects at times `t`, shape (N,), seconds, on the clock of `surroundings`."""
        around = EffectContext.since_start(t, others, start)
        if not self.surroundings:
            return around
        return replace(around, surroundings={key: np.interp(t, *course) for key, course in self.surroundings.items()})

    @property
    def followed(self) -> tuple[Followed, ...]:
        """Quantities that the stage follows."""
        return tuple(one for effect in self.effects for one in effect.followed)

    @property
    def quantities(self) -> tuple[str, ...]:
        """Names of the quantities that the stage follows."""
        return tuple(one.key for one in self.followed)

    def surrounded(self, courses: Mapping[str, Course]) -> "AxisModel":
        """Return the model in surroundings; quantities that the stage does not follow are ignored."""
        known = {key: course for key, course in courses.items() if key in self.quantities and course[0].size}
        return replace(self, surroundings=known) if known or self.surroundings else self

    def seen(self, t: FloatArray, own: FloatArray, others: Mapping[str, FloatArray]) -> FloatArray:
        """Return what the sensor says, shape (N,), metres, at times `t` (s) for a result of `uncoupled_displacement`.

        `others`: motion of each other axis from its start, without cross-coupling, shape (N,), metres, by name.
        """
        return self._seen(self.chain, t, own, others)

    def _seen(self, chain: Chain, t: FloatArray, own: FloatArray, others: Mapping[str, FloatArray]) -> FloatArray:
        around = self._around(t, others)
        return self.sensor.apply(t, forward((*chain.shared, *chain.measured), own, around))

    @property
    def corrects(self) -> bool:
        """Whether `correct` changes readings."""
        return bool(self.sensor or self.chain.measured)

    def describe_correction(self) -> str:
        """Describe what `correct` takes out of the readings; "" if nothing."""
        timing = [self.sensor.describe()] if self.sensor else []
        return "; ".join([*(effect.describe() for effect in self.chain.measured), *timing])

    def measure(self, t: FloatArray, x: FloatArray) -> FloatArray:
        """Return the readings of the sensor, shape (N,), metres, for the displacement `x` (m) at times `t` (s)."""
        return self.sensor.apply(t, forward(self.chain.measured, x, EffectContext.since_start(t)))

    def correct(self, t: FloatArray, y: FloatArray) -> FloatArray:
        """Return where the stage was, shape (N,), metres, for the readings `y` (m) of its sensor at times `t` (s).

        The inverse of `measure`; NaN where there is no reading, or not yet, see `Sensor.undo`.
        """
        return backward(self.chain.measured, self.sensor.undo(t, y), EffectContext.since_start(t))

    def streaming_sensor(self) -> StreamingSensor:
        """Return the sensor for readings that come one by one."""
        return StreamingSensor(self.sensor, self.chain.measured)

    def shifted(self, by: float) -> "AxisModel":
        """Return the model with a zero that has moved by `by` (m)."""
        low, high = self.displacement_range
        return replace(
            self,
            start=replace(self.start, displacement=self.start.displacement + by),
            end=self.end and replace(self.end, displacement=self.end.displacement + by),
            displacement_range=(low + by, high + by),
            effects=tuple(effect.shifted(by) for effect in self.effects),
        )

    @cached_property
    def stage_only(self) -> "AxisModel":
        """The model from the voltage to where the stage is: without the effects of sensor and record."""
        return replace(self, effects=tuple(one for one in lasting(self.effects) if one.side == "stage"), sensor=IDEAL)

    @cached_property
    def hysteresis_only(self) -> "AxisModel":
        """The model without effects and sensor."""
        return replace(self, effects=(), sensor=IDEAL)

    def compensate(
        self, t: FloatArray, y: FloatArray, limits: Limits | None = None, start_memory: StartMemory = "end"
    ) -> tuple[FloatArray, Mask]:
        """Return the voltage to bring the stage to `y`, shape (N,), metres, and where it is held at a limit.

        Effects of the sensor and of the record are not inverted. Other axes are at rest. Time `t`, shape (N,), seconds,
        is ignored without effects. The initial state is `initial(start_memory)`. UnreachableError if a displacement
        lies far outside the identified range, UsageError if one is not finite.
        """
        self.require_reachable(y)
        return self.command(t, y, limits, start_memory)

    def in_advance(self, t: FloatArray, y: FloatArray) -> FloatArray:
        """Return the setpoints, shape (N,), m, at times `t` (s) with which the stage is at `y`, shape (N,), m, in time.

        Setpoints one by one come too late for the inverse to undo a delay, so that they are asked for early.
        """
        return np.interp(t + self.chain.delay, t, y)

    def require_reachable(self, y: FloatArray) -> None:
        """Raise an error, as `compensate`, unless `y`, (N,), metres, is finite and in the identified range."""
        require_finite(y)
        accepted = accepted_range(self.displacement_range)
        far = (y < accepted[0]) | (y > accepted[1])
        if far.any():
            at = int(np.argmax(far))
            raise UnreachableError(f"sample {at}: {refusal(float(y[at]), accepted)}")

    def command(
        self,
        t: FloatArray,
        y: FloatArray,
        limits: Limits | None = None,
        start_memory: StartMemory = "end",
        coupled: FloatArray | float = 0.0,
    ) -> tuple[FloatArray, Mask]:
        """Return the voltage, as `compensate`, and where it is held at a limit, shape (N,) each.

        It is that of `stream`, but for a delay, which is compensated by preview, for modes, which are inverted exactly
        where the limits allow the whole path, and for models that are not causal.
        `coupled` (m), a number or of shape (N,), is the displacement that other axes add.
        """
        allowed, around = self._allowed(limits), self._around(t)
        if not self.causal and max(allowed.slew, allowed.acceleration) == inf and not self.chain.around:
            return self._command_known_path(y - coupled, around, allowed, self.initial(start_memory))
        if ahead := self._looking_ahead:
            others = tuple(effect for effect in self.effects if effect not in ahead)
            stream = replace(self, effects=others).stream(limits, start_memory)
            start = replace(around, start=stream.uncoupled_displacement)
            with suppress(UsageError):
                v, held = stream.run(t, ahead[0].invert(backward(ahead[1:], y - coupled, around), start))
                if not held.any():
                    return backward([effect for effect in self.chain.before if effect.shift], v, around), held
        timed = self._timed
        if timed and self.surroundings:
            # They depend on time alone, and what comes after them is constant: undone for the whole path at once.
            y, coupled = backward(timed, y - coupled, around), 0.0
            rest = tuple(effect for effect in self.effects if effect not in timed)
            self = replace(self, effects=rest)
        v, held = self.stream(limits, start_memory).run(t, y, coupled)
        return backward([effect for effect in self.chain.before if effect.shift], v, around), held

    @property
    def _looking_ahead(self) -> tuple[Effect, ...]:
        """Effects on the axis itself from that on which looks ahead, if a path is inverted through all of them."""
        own = self.chain.own
        found = next((own[place:] for place, effect in enumerate(own) if effect.looks_ahead), ())
        return () if any(effect.needs_voltage for effect in found) else found

    @property
    def _timed(self) -> tuple[Effect, ...]:
        """Effects on the axis itself from that on which follows recorded quantities."""
        own = self.chain.own
        return next((own[place:] for place, effect in enumerate(own) if effect.keys), ())

    def _command_known_path(
        self, y: FloatArray, around: EffectContext, allowed: Limits, start: Start
    ) -> tuple[FloatArray, Mask]:
        """Return the result of `command` for a model that is not causal; limits do not act back on the effects."""
        (lowest, highest), axis = self.chain.clipped, replace(self, start=start)
        limits = replace(allowed, lower=max(allowed.lower, lowest), upper=max(min(allowed.upper, highest), lowest))
        behind = replace(around, start=start.displacement)
        h = backward(self.chain.own, y, behind)
        u = axis._path().inverse_array(h, limits.lower, limits.upper)
        if any(effect.needs_voltage for effect in self.chain.own):
            h, u = axis._with_voltage(y, u, behind, limits)
        held = (u <= limits.lower) | (u >= limits.upper)
        rounding = ROUNDING * (self.displacement_range[1] - self.displacement_range[0])
        if held.any():
            with warnings.catch_warnings():
                # The warning for loops that were not identified has already been issued.
                warnings.simplefilter("ignore", slpi.UnidentifiedLoopWarning)
                held &= np.abs(axis._path().forward_array(u) - h) > rounding
        wanted = backward(self.chain.before, u, replace(around, start=start.voltage))
        v = np.clip(wanted, allowed.lower, allowed.upper)
        return v, held | (np.abs(v - wanted) > ROUNDING * (self.voltage_range[1] - self.voltage_range[0]))

    def _with_voltage(
        self, y: FloatArray, u: FloatArray, behind: EffectContext, limits: Limits
    ) -> tuple[FloatArray, FloatArray]:
        """Return displacement (m) and voltage (V) of the hysteresis for effects on the displacement that follow it."""
        # From the voltage `u` (V) without that, in turn: it changes them little. A model of separate loops may take
        # another loop at the next turn, so that the best turn counts.
        own, tried = self.chain.own, []
        with warnings.catch_warnings():
            # The warning for loops that were not identified has already been issued.
            warnings.simplefilter("ignore", slpi.UnidentifiedLoopWarning)
            for _ in range(VOLTAGE_TURNS):
                h = backward(own, y, behind.driven(u))
                u = self._path().inverse_array(h, limits.lower, limits.upper)
                missed = forward(own, self._path().forward_array(u), behind.driven(u)) - y
                tried.append((float(missed @ missed), h, u))
        return min(tried, key=lambda one: one[0])[1:]

    @cached_property
    def chain(self) -> Chain:
        """The chain of the effects that outlast their record."""
        return Chain.of(lasting(self.effects))

    @cached_property
    def hysteresis_range(self) -> tuple[float, float]:
        """Voltage range (V) of the hysteresis in the record: `voltage_range` within the limits of a saturation."""
        (low, high), (lowest, highest) = self.voltage_range, self.chain.clipped
        return max(low, lowest), min(high, highest)

    @property
    def mean_slope(self) -> float:
        """Slope (m/V) of the largest loop from end to end; infinite without a voltage range."""
        (low, high), (first, last) = self.displacement_range, self.hysteresis_range
        return (high - low) / (last - first) if last > first else inf

    @cached_property
    def felt_range(self) -> tuple[float, float]:
        """Voltage range (V) that the hysteresis has felt: an effect around it may have kept it from the limits."""
        (low, high), turns = self.hysteresis_range, self.end.history if self.end and self.chain.around else ()
        return max(low, min(turns, default=low)), min(high, max(turns, default=high))

    def _allowed(self, limits: Limits | None) -> Limits:
        return (limits or Limits(-inf, inf)).within(self.voltage_range)

    def _path(self) -> slpi.KnownPath | smpi.KnownPath | Memory:
        """Return the hysteresis operator at the start of the record."""
        if isinstance(self.hysteresis, PathModel):
            return self.hysteresis.along(self.start.voltage, self.start.displacement)
        return self.memory("start")
