"""The `Effect` protocol with the facts of an effect, its context, and the candidates and views of a fit."""

import re
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial, wraps
from math import inf
from typing import Any, ClassVar, Literal, NamedTuple, Self, TypeVar

import numpy as np
from numpy.typing import NDArray

from slpi_ros.arrays import FloatArray, Mask
from slpi_ros.arrays.rates import fastest
from slpi_ros.effects.excitation import Excitation
from slpi_ros.effects.filters import AT_ONCE, Dynamics, Mode, Uniform
from slpi_ros.effects.parameters import Leaf, facts_of, leaves, require_facts, with_leaves
from slpi_ros.hysteresis.turning_points import Memory
from slpi_ros.io.record import Course

# The voltage, the hysteresis itself (between the voltage that it feels and its displacement), or the displacement.
Signal = Literal["voltage", "hysteresis", "displacement"]
# What an effect belongs to. Stage: the compensator inverts it. Sensor: it is taken out of measurements and never
# inverted into the stage, which would follow the error of its sensor. Record: it is taken out of the fit of its record.
Side = Literal["stage", "sensor", "record"]
# Whether the parameters are shared by all records of a fit, separate in each (always if it belongs to the record), or
# either.
Sharing = Literal["shared", "separate", "either"]
# Whether an effect shifts the displacement in time: not at all, among other things, or only that.
TimeShift = Literal["none", "partly", "only"]
# Time shifts below this share of the sampling period may be due to the hold of commands between samples.
HELD = 0.6
# Largest distance of the origin of an effect from the measured displacements, as a share of their range: with an origin
# far away a change of the sensitivity is a drift.
NEAR = 0.3
# Fewest knots whose ratio counts, and largest ratio of a slow change: see `is_course`.
FEWEST_KNOTS, LARGEST_RATIO = 5, 0.5
# Number of spectral bins on either side of a peak that are attributed to the peak.
LINE_WIDTH = 12


@dataclass(frozen=True)
class EffectContext:
    """Time (s) from the first stamp, non-decreasing, and signals other than the input that an effect may depend on."""

    t: FloatArray
    # Displacement (m) of the other axes relative to their start, before coupling.
    others: Mapping[str, FloatArray] = field(default_factory=dict)
    # Contexts of the records that the signals are concatenated from; empty for a single record.
    records: "tuple[EffectContext, ...]" = ()
    # Grid that covers `t`, if already computed.
    grid: Uniform | None = None
    start: float | None = None
    # Voltage (V) at the piezo, shape (N,), for effects on the displacement; None: it rests.
    voltage: FloatArray | None = None
    # Recorded quantities by name, shape (N,), in their units.
    surroundings: Mapping[str, FloatArray] = field(default_factory=dict)
    # Times (s, below 0) and displacements (m) of the session before the first stamp, as read, or `without` effects;
    # None: unknown.
    before: Course | None = None

    @classmethod
    def since_start(
        cls, t: FloatArray, others: Mapping[str, FloatArray] | None = None, start: float | None = None
    ) -> "EffectContext":
        """Return the context for stamps `t`, shape (N,), seconds, counted from the first one."""
        return cls(t - t[0] if t.size and t[0] else t, others or {}, start=start)

    def driven(self, voltage: FloatArray) -> "EffectContext":
        """Return the context with the voltage at the piezo, shape (N,), volts."""
        parts = zip(self.records, self.split(voltage), strict=False)
        return replace(self, voltage=voltage, records=tuple(record.driven(part) for record, part in parts))

    def without(self, effects: "Sequence[Effect]") -> "EffectContext":
        """Return the context with the displacements `before` it without what effects have added."""
        before = self.before
        for effect in effects:
            before = before and effect.hysteresis_before(before)
        return replace(self, before=before, records=tuple(record.without(effects) for record in self.records))

    @property
    def uniform(self) -> Uniform:
        """Uniform grid that covers `t`."""
        return self.grid or Uniform.over(self.t)

    @property
    def since(self) -> FloatArray:
        """Time from the first stamp, shape (N,), seconds."""
        return self.t - self.t[:1]

    def step(self, signal: FloatArray) -> float:
        """Return the step of a signal at the first stamp, from `start` to its first sample; 0 without one."""
        return float(signal[0]) - self.start if self.start is not None and signal.size else 0.0

    def split(self, signal: NDArray[Any]) -> list[NDArray[Any]]:
        """Split a signal, shape (N, ..), into its records and return the list of parts."""
        return (
            np.split(signal, np.cumsum([record.t.size for record in self.records[:-1]])) if self.records else [signal]
        )

    def each(self, of: Callable[..., FloatArray], *signals: FloatArray) -> FloatArray:
        """Return what `of` returns for each record, of its parts of the signals and its context, concatenated."""
        parts = zip(*map(self.split, signals), self.records or (self,), strict=True)
        return np.concatenate([of(*each) for each in parts])


class Followed(NamedTuple):
    """A recorded quantity that an effect follows: name, reference value, and recorded range, in its unit."""

    key: str
    reference: float
    lowest: float
    highest: float


class FollowedGain(NamedTuple):
    """By how much a stage follows a quantity: of zero (m per unit) and sensitivity (1 per unit), with uncertainties."""

    followed: Followed
    gains: tuple[float, float]
    uncertainty: tuple[float, float]
    error: float  # standard uncertainty of a reading in use, in the unit of the quantity


class Unsure(NamedTuple):
    """What an effect leaves unsure in use, after the records that it was fitted to."""

    # Time constants (s), and shares of a motion that each still has to go: in use they begin in an unknown state.
    relaxations: tuple[tuple[float, float], ...] = ()
    # Standard uncertainty of what goes on for each factor of e in time beyond the records: share of a motion, and V.
    slow_share: float = 0.0
    slow_volts: float = 0.0
    # Mean square relative change of the sensitivity in a second, as of a random walk.
    gain_drift: float = 0.0
    quantities: tuple[FollowedGain, ...] = ()
    # Displacement (m) that does not change with the sensitivity.
    origin: float = 0.0


Effected = TypeVar("Effected")


def by_record(
    apply: Callable[[Effected, FloatArray, EffectContext], FloatArray],
) -> Callable[[Effected, FloatArray, EffectContext], FloatArray]:
    """Decorate `apply` of an effect with memory so that its state restarts at every record."""

    @wraps(apply)
    def applied(effect: Effected, signal: FloatArray, around: EffectContext) -> FloatArray:
        return around.each(partial(apply, effect), signal) if around.records else apply(effect, signal, around)

    return applied


class Streaming:
    """Streaming (sample by sample) evaluation of an effect, including its state; by default there is none."""

    def start(self, x: float) -> None:
        """Initialise the state to equilibrium at the constant input `x` (V or m)."""

    def forward(self, dt: float, x: float) -> float:
        """Advance the state by `dt` (s) to the input `x` and return the output: what the hysteresis feels, or m."""
        raise NotImplementedError

    def resume(self, other: Any, x: float) -> None:
        """Continue from the state of the same effect of another model, at the input `x` (V or m); by default do not."""

    def snapshot(self) -> Any:
        """Return the complete state as JSON-compatible numbers and tuples of numbers."""
        return ()

    def restore(self, state: Any) -> None:
        """Replace the state by one returned by `snapshot`."""


class StreamingEffect(Streaming):
    """Streaming evaluation of an effect on the voltage or on the displacement."""

    @property
    def relaxing(self) -> tuple[float, ...]:
        """Distances from equilibrium (m) that outlast a restart of the process; of most effects none."""
        return ()

    def relax_from(self, distances: Sequence[float]) -> None:
        """Continue from distances as `relaxing` returned them; others are ignored."""

    def reach(self, voltage: float) -> None:
        """Note the voltage (V) at the piezo for the next `forward`; called if the effect `needs_voltage`."""

    def surround(self, key: str, value: float) -> None:
        """Note the value of a recorded quantity for the next sample; called if the effect has `keys`."""

    def inverse(self, dt: float, wanted: float) -> float:
        """Return the input, or a stable approximation, for the output `wanted` after `dt` (s); keep the state."""
        raise NotImplementedError


class StreamingAround(Streaming):
    """Streaming evaluation of an effect around the hysteresis: what the hysteresis feels, and what goes beside it."""

    def inverse(self, dt: float, wanted: float, memory: Memory, lower: float, upper: float) -> float:
        """Return the voltage (V) for the displacement `wanted` (m); `memory` moves, within `lower` and `upper` (V)."""
        raise NotImplementedError

    @property
    def applied(self) -> float:
        """Applied voltage (V), of which the hysteresis feels another."""
        raise NotImplementedError

    @property
    def beside(self) -> float:
        """Displacement (m) beside that of the hysteresis."""
        raise NotImplementedError

    def undo(self, state: Any) -> None:
        """Go back to `snapshot`, for the same sample once more."""
        raise NotImplementedError


@dataclass(frozen=True)
class Effect(ABC):
    """One effect: a frozen dataclass whose fields are its parameters (`parameter`), in SI units, and `uncertainty`.

    It says what it is and does in `apply`, `fit` and `describe`; all else is as here unless it says otherwise.
    """

    name: ClassVar[str]
    side: ClassVar[Side]
    acts_on: ClassVar[Signal] = "displacement"
    # For the documentation: what it is, and whether it is compensated.
    what: ClassVar[str]
    compensated: ClassVar[str]
    # The drive that separates it from other effects.
    excitation: ClassVar[Excitation]
    # Whether only feedback undoes it, because it follows time and not the voltage, or comes before the voltage.
    needs_feedback: ClassVar[bool] = False
    # Whether the inverse of a whole path is better than that sample by sample, as it looks ahead.
    looks_ahead: ClassVar[bool] = False
    # Whether it is a linear filter of the displacement.
    is_filter: ClassVar[bool] = False
    # Whether it acts on the displacement, and depends on the voltage at the piezo, too.
    needs_voltage: ClassVar[bool] = False
    sharing: ClassVar[Sharing] = "shared"
    time_shift: ClassVar[TimeShift] = "none"
    # Whether a single drive frequency cannot tell it from the other effects of which this is true.
    dynamic: ClassVar[bool] = False
    # Whether a change of the sensitivity between records may be its doing.
    changes_gain: ClassVar[bool] = False
    # Whether it follows recorded quantities.
    follows_quantities: ClassVar[bool] = False

    # Standard deviation by place, such as ``gains.y`` or ``modes.0.gain``, in the unit of the parameter.
    uncertainty: Mapping[str, float] = field(default_factory=dict, kw_only=True)

    @abstractmethod
    def apply(self, signal: FloatArray, around: EffectContext) -> FloatArray:
        """Return the output of the effect for an input signal, shape (N,), volts or metres, starting at equilibrium."""

    @classmethod
    @abstractmethod
    def fit(cls, context: "FitContext") -> "Iterator[Candidate | Effect]":
        """Yield candidates for a fit: forms that are linear in their gains, or effects with fixed parameters."""

    def column(self, context: "FitContext") -> FloatArray:
        """Return by how much the displacement in a fit would change with it, shape (N,), metres."""
        if self.acts_on == "displacement":
            return self.apply(context.h, context.around) - context.h
        return context.respond(self.apply(context.u, context.around)) - context.h

    @abstractmethod
    def describe(self) -> str:
        """Describe the effect with its parameter values in one sentence."""

    def __init_subclass__(cls) -> None:
        """Name an effect after its class, unless it says otherwise: `RateDependence` is ``rate_dependence``."""
        if "name" not in vars(cls):
            cls.name = re.sub(r"(?<=[a-z])(?=[A-Z])", "_", cls.__name__).lower()

    def __post_init__(self) -> None:
        require_facts(self)

    def plausible(self, context: "FitContext") -> bool:
        """Return whether the parameters are plausible, so that the effect does not imitate another cause."""
        # Where others shift in time, too, a short shift may be the hold of commands between samples.
        others = any(other.time_shift != "none" and other.name != self.name for other in context.effects)
        return self.time_shift != "only" or not others or abs(self.slow_shift) > HELD * context.step

    def agrees(self, other: Any, context: "FitContext") -> bool:
        """Return whether the same effect on another record has the parameters that all records share."""
        return True

    def only_plausible(self, context: "FitContext") -> Self | None:
        """Return the effect without those of its parts, such as jumps, that are not plausible; None without parts."""
        return None

    @property
    def courses(self) -> tuple[tuple[float, ...], ...]:
        """Values at the knots of an effect with a free course, record by record, from one origin; else none."""
        return ()

    def in_phase(self, context: "FitContext") -> bool:
        """Return whether one set of parameters can hold for all records of a fit, and for others."""
        return True

    def joined(self, other: Self) -> Self | None:
        """Return one effect that stands for both; None if an axis has it once, or if it would hold too much."""
        return None

    def remembered(self, before: Course, t: FloatArray) -> FloatArray:
        """Return what goes on (m, (N,)) at times `t` (s) from what the hysteresis did `before` a record (m)."""
        return np.zeros_like(t)

    def hysteresis_before(self, before: Course) -> Course:
        """Return displacements of a session without what the effect has added to them, if it is remembered."""
        return before

    def starting(self, around: EffectContext, used: Mask) -> FloatArray:
        """Return what is left (m, (N, k)) of its state before each record."""
        return np.empty((around.t.size, 0))

    def started(self, amplitudes: FloatArray, records: int) -> Self:
        """Return the effect with its state before the records, from the amplitudes (m) of the columns of `starting`."""
        return self

    @cached_property
    def leaves(self) -> tuple[Leaf, ...]:
        """The numbers in all parameters."""
        known = facts_of(type(self)).items()
        return tuple(leaf for name, facts in known for leaf in leaves(name, facts, getattr(self, name)))

    def __getstate__(self) -> dict[str, Any]:
        # To other processes go the parameters alone: their facts hold functions.
        return {name: value for name, value in vars(self).items() if name != "leaves"}

    def free_leaves(self) -> list[Leaf]:
        """Return the fitted numbers."""
        return [leaf for leaf in self.leaves if leaf.free]

    def with_free(self, numbers: Iterable[float]) -> Self:
        """Return the effect with other fitted numbers, in the order of `free_leaves`, limited by `limited`."""
        left = iter(numbers)
        every = iter([next(left) if leaf.free else leaf.value for leaf in self.leaves])
        changed = {name: with_leaves(getattr(self, name), every) for name in facts_of(type(self))}
        return replace(self, **self.limited(changed))

    @classmethod
    def limited(cls, changed: dict[str, Any]) -> dict[str, Any]:
        """Return new parameters, by name, within bounds that concern several of them."""
        return changed

    def anchored(self, rest: float) -> Self:
        """Return the effect with the displacement `rest` (m) as its origin, if it needs one and has none."""
        return self

    def from_end(self) -> tuple[Self, float]:
        """Return the effect counted from the end of its record, and the displacement (m) that it had there."""
        return self, 0.0

    def shifted(self, by: float) -> Self:
        """Return the effect for a zero of the displacement that has moved by `by` (m)."""
        if "origin" not in facts_of(type(self)):
            return self
        return replace(self, origin=self.origin + by)  # type: ignore[attr-defined, call-arg]

    def streaming(self) -> Any:
        """Return the `StreamingEffect` or `StreamingAround`; None if it is not compensated sample by sample."""
        return

    def laws(self) -> Mapping[str, Any] | None:
        """Return the fields of `slpi_ros.effects.paths.Laws` for the compiled inverse; None if it has no such form."""
        return None

    def invert(self, signal: FloatArray, around: EffectContext) -> FloatArray:
        """Return the input, shape (N,), volts or metres, for an output signal, sample by sample from equilibrium."""
        whole: list[float] = []
        for t, wanted in zip(around.split(around.t), around.split(signal), strict=True):
            streaming, dt = self.streaming(), np.diff(t, prepend=t[:1]).tolist()
            for k, sample in enumerate(zip(dt, wanted.tolist(), strict=True)):
                if not k:
                    streaming.start(sample[1] if around.start is None else around.start)
                whole.append(streaming.inverse(*sample))
                streaming.forward(sample[0], whole[-1])
        return np.array(whole)

    def beside(self, v: FloatArray, u: FloatArray) -> FloatArray:
        """Return the displacement (m) beside the hysteresis for applied and felt voltages (V), shape (N,) each."""
        return np.zeros_like(v)

    @property
    def lasting(self) -> "Effect | None":
        """The effect as it is after its record; None if it ends with it."""
        return None if self.side == "record" else self

    @property
    def without_records(self) -> Self:
        """The effect for another fit, without what it knows of the records of this one."""
        return self

    @property
    def rested(self) -> Self:
        """The effect on a record before which the stage had rested."""
        return self

    def of_record(self, k: int) -> "Effect":
        """Return the effect as it is on the record of number `k` of those that it was fitted to."""
        return self

    @property
    def passes(self) -> tuple[float, float]:
        """Lowest and highest voltage (V) that the effect lets through."""
        return -inf, inf

    @property
    def shift(self) -> float:
        """Transport delay, seconds."""
        return 0.0

    @property
    def slow_shift(self) -> float:
        """Time (s) by which it shifts a slow motion."""
        return self.shift

    @property
    def settling_time(self) -> float:
        """Time (s) after which the piezo has the voltage of the command."""
        return abs(self.shift)

    @property
    def dynamics(self) -> Dynamics:
        """Its linear dynamics, without a transport delay, as a fast closed loop sees them; of most effects none."""
        return AT_ONCE

    @property
    def ringing(self) -> Sequence[Mode]:
        """Its modes, as a fast closed loop excites them; of most effects none."""
        return ()

    def detuned(self, scales: Sequence[float], uncertain: float) -> "Effect":
        """Return it with the frequencies of `ringing` scaled, and dampings less by so many standard uncertainties."""
        return self

    @property
    def steepest(self) -> float:
        """Largest factor by which it multiplies the slope of the displacement."""
        return 1.0

    @property
    def unsure(self) -> Unsure:
        """What is unsure of it in use; of most effects nothing besides the error of the model."""
        return Unsure()

    @property
    def followed(self) -> "tuple[Followed, ...]":
        """Recorded quantities that it follows; of most effects none."""
        return ()

    @property
    def keys(self) -> tuple[str, ...]:
        """Names of the recorded quantities that it follows."""
        return tuple(one.key for one in self.followed)

    def with_filters(self, courses: Mapping[str, Sequence[Course]]) -> Self:
        """Return the effect with filters for readings like these, the courses of its quantities in each record."""
        return self

    def only(self, keys: Sequence[str]) -> "Effect | None":
        """Return the effect with some of the quantities that it follows; None without any."""
        return None

    @property
    def coupling(self) -> Mapping[str, float]:
        """Gains by which motions of other axes are added, by their names."""
        return {}


class Additive(Effect):
    """An effect that adds a displacement, whatever the signal is."""

    @abstractmethod
    def added(self, around: EffectContext) -> FloatArray:
        """Return the displacement that it adds, shape (N,), metres."""

    def apply(self, signal: FloatArray, around: EffectContext) -> FloatArray:
        """Return the displacement with it, shape (N,), metres."""
        return signal + self.added(around)

    def invert(self, signal: FloatArray, around: EffectContext) -> FloatArray:
        """Return the displacement without it, shape (N,), metres."""
        return signal - self.added(around)


@dataclass(frozen=True)
class Candidate:
    """One form of an effect for the identification, linear in its gains."""

    # Contribution to the displacement (m) for a unit value of each of the k gains, shape (N, k): of the initial states
    # of the records first, each of which belongs to one record, then of the effect.
    columns: FloatArray
    # Returns the effect for gains of shape (k,), or None if the gains are not admissible.
    effect: Callable[[FloatArray], Effect | None]
    # Number of trailing columns whose gains must be non-negative; if not 0, `effect` receives only these gains.
    positive: int = 0
    # Forms of different groups are refined each by itself, as they lead to different parameters.
    group: int = 0


@dataclass(frozen=True)
class FitContext:
    """A fit and its records as the candidates and the plausibility of an effect see them; signals, shape (N,)."""

    # Time from the start of each record (s), applied and felt voltage (V), displacement of the hysteresis, measured
    # displacement, and residual, measured - model (m).
    t: FloatArray
    v: FloatArray
    u: FloatArray
    h: FloatArray
    y: FloatArray
    used: Mask
    residual: FloatArray
    around: EffectContext
    # Rms rounding error of the sensor (m).
    rounding: float
    effects: Sequence[Effect]
    # Return the displacement of the hysteresis (m) for another felt voltage (V), (N,) each; the highest frequency (Hz)
    # that any record excites; of each record the single drive frequency (Hz), 0 if there are several, and the duration
    # (s); the displacement (m) at the centre of the largest loop of each record; the mask of the samples, (N,), on the
    # way to the largest displacement so far, which happens once; and what would be left (m) without the effect of a
    # name, everything else unchanged.
    respond: Callable[[FloatArray], FloatArray]
    excited_frequency: Callable[[], float]
    drives: Callable[[], Sequence[tuple[float, float]]]
    zeros: Callable[[], FloatArray]
    first_rise: Callable[[], Mask]
    left_without: Callable[[str], FloatArray]

    def of_record(self, k: int) -> "FitContext":
        """Return what concerns record `k`, of which no other voltage is felt."""
        if not self.around.records:
            return self
        first = sum(record.t.size for record in self.around.records[:k])
        own = slice(first, first + self.around.records[k].t.size)
        signals = {name: getattr(self, name)[own] for name in ("t", "v", "u", "h", "y", "used", "residual")}
        return replace(
            self,
            around=self.around.records[k],
            drives=lambda: [self.drives()[k]],
            zeros=lambda: self.zeros()[k : k + 1],
            first_rise=lambda: self.first_rise()[own],
            left_without=lambda name: self.left_without(name)[own],
            **signals,
        )

    @property
    def step(self) -> float:
        """Median sampling interval, seconds."""
        return usual_step(self.t)

    @property
    def fastest(self) -> float:
        """Fastest rate of the voltage in any record (V/s), without jumps."""
        return max(fastest(*parts) for parts in zip(self.around.split(self.t), self.around.split(self.v), strict=True))

    @property
    def motion(self) -> float:
        """Range of the measured displacement, metres."""
        return float(np.ptp(self.y[self.used]))

    def near_motion(self, displacement: float) -> bool:
        """Return whether a displacement (m) is at most the share `NEAR` of the motion away from the measured ones."""
        y, margin = self.y[self.used], NEAR * self.motion
        return float(y.min()) - margin <= displacement <= float(y.max()) + margin


def usual_step(t: FloatArray) -> float:
    """Return the median sampling interval (s)."""
    return float(np.median(np.diff(t)))


def longest(around: EffectContext) -> float:
    """Return the duration (s) of the longest record."""
    return max(float(t[-1] - t[0]) for t in around.split(around.t))


def decays(time_constants: Sequence[float], around: EffectContext) -> FloatArray:
    """Return what is left of 1 at the start of each record for each time constant (s), shape (N, k), by record."""
    from scipy.linalg import block_diag

    parts = [np.exp(-(t - t[:1])[:, None] / np.array(time_constants)) for t in around.split(around.t)]
    return np.asarray(block_diag(*parts))


def is_course(*records: Sequence[float]) -> bool:
    """Return whether the values at knots are those of a slow change that the knots resolve, not up and down by turns.

    Von Neumann's ratio of the mean square of successive differences within a record to twice the variance: 1 for
    independent values; of all records together, as in some nothing may change, and between two of them much.
    """
    values = [np.asarray(knots) for knots in records if len(knots) >= FEWEST_KNOTS]
    if not values:
        return True
    turns, together = sum(float(np.sum(np.diff(own) ** 2)) for own in values), np.concatenate(values)
    return turns <= 2.0 * LARGEST_RATIO * float(np.sum((together - together.mean()) ** 2))


def wave(phase: FloatArray) -> FloatArray:
    """Return sine and cosine of a phase (rad), shape (N, 2), as a basis of any sinusoid; see `amplitude_and_phase`."""
    return np.column_stack([np.sin(phase), np.cos(phase)])


def amplitude_and_phase(gains: FloatArray) -> tuple[float, float]:
    """Return amplitude and phase (rad) of a sinusoid from its two gains for the columns of `wave`."""
    return float(np.hypot(gains[0], gains[1])), float(np.arctan2(gains[1], gains[0]))


def strongest_lines(
    power: FloatArray, at: NDArray[np.floating[Any]], count: int, width: int = LINE_WIDTH
) -> list[float]:
    """Return the frequencies of the highest peaks of a spectrum, shape (n,), in the unit of `at`, strongest first."""
    power, found = power.copy(), []
    for _ in range(count):
        k = int(np.argmax(power))
        if not power[k] > 0:
            break
        found.append(float(at[k]))
        power[max(0, k - width) : k + width + 1] = 0.0
    return found


def rhythms(context: FitContext, count: int, lowest: float) -> list[float]:
    """Return the strongest frequencies (Hz) in the residual, at or above `lowest` (Hz)."""
    from scipy.fft import next_fast_len

    dt, around = usual_step(context.t), context.around
    size = 4 * next_fast_len(round(longest(around) / dt) + 1)
    frequency = np.fft.rfftfreq(size, dt)
    power = np.zeros(frequency.size)
    residual = np.where(context.used, context.residual, 0.0)
    for t, own in zip(around.split(context.t), around.split(residual), strict=True):
        grid = np.arange(t[0], t[-1], dt)
        power += np.abs(np.fft.rfft(np.interp(grid, t, own) * np.hanning(grid.size), size)) ** 2
    power[frequency < lowest] = 0.0
    return strongest_lines(power, frequency, count)
