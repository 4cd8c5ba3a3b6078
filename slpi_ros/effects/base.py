"""The `Effect` protocol, its context and fit candidates, and validation of effect parameters."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, fields, is_dataclass, replace
from functools import wraps
from math import inf, isfinite
from textwrap import shorten
from typing import Any, ClassVar, Literal, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from slpi_ros.effects.filters import Uniform
from slpi_ros.errors import ModelError
from slpi_ros.hysteresis.turning_points import Memory

FloatArray = NDArray[np.float64]

# The voltage, the hysteresis itself (between the voltage that it feels and its displacement), or the displacement.
Signal = Literal["voltage", "hysteresis", "displacement"]
# What an effect belongs to. Stage: the compensator inverts it. Sensor: it is taken out of measurements and never
# inverted into the stage, which would follow the error of its sensor. Record: it is taken out of the fit of its record.
Side = Literal["stage", "sensor", "record"]
# Number of spectral bins on either side of a peak that are attributed to the peak.
LINE_WIDTH = 12


@dataclass(frozen=True)
class EffectContext:
    """Signals other than the input that an effect may depend on.

    Parameters
    ----------
    t : ndarray, shape (N,), seconds
        Time from the first stamp, non-decreasing.
    others : mapping of axis name to ndarray, shape (N,), metres
        Displacement of the other axes relative to their start, before coupling.
    records : tuple of EffectContext
        Contexts of the records that the signals are concatenated from; empty for a single record.
    grid : Uniform, optional
        Grid that covers `t`, if already computed.
    start : float, optional, volts or metres
        Constant signal before the first stamp; a first sample that differs is a step. Default: the first sample.
    """

    t: FloatArray
    others: Mapping[str, FloatArray] = field(default_factory=dict)
    records: "tuple[EffectContext, ...]" = ()
    grid: Uniform | None = None
    start: float | None = None

    @classmethod
    def since_start(
        cls, t: FloatArray, others: Mapping[str, FloatArray] | None = None, start: float | None = None
    ) -> "EffectContext":
        """Return the context for stamps `t`, shape (N,), seconds, counted from the first one."""
        return cls(t - t[0] if t.size and t[0] else t, others or {}, start=start)

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


Effected = TypeVar("Effected")


def by_record(
    apply: Callable[[Effected, FloatArray, EffectContext], FloatArray],
) -> Callable[[Effected, FloatArray, EffectContext], FloatArray]:
    """Decorate `apply` of an effect with memory so that its state restarts at every record."""

    @wraps(apply)
    def applied(effect: Effected, signal: FloatArray, around: EffectContext) -> FloatArray:
        if not around.records:
            return apply(effect, signal, around)
        parts = zip(around.split(signal), around.records, strict=True)
        return np.concatenate([apply(effect, part, record) for part, record in parts])

    return applied


class Streaming(Protocol):
    """Streaming (sample by sample) evaluation of an effect, including its state."""

    def start(self, x: float) -> None:
        """Initialise the state to equilibrium at the constant input `x` (V or m)."""

    def forward(self, dt: float, x: float) -> float:
        """Advance the state by `dt` (s) to the input `x` and return the output: what the hysteresis feels, or m."""

    def resume(self, other: Any, x: float) -> None:
        """Continue from the state of the same effect of another model, at the input `x` (V or m)."""

    def snapshot(self) -> Any:
        """Return the complete state as JSON-compatible numbers and tuples of numbers."""

    def restore(self, state: Any) -> None:
        """Replace the state by one returned by `snapshot`."""


class StreamingEffect(Streaming, Protocol):
    """Streaming evaluation of an effect on the voltage or on the displacement."""

    def inverse(self, dt: float, wanted: float) -> float:
        """Return the input, or a stable approximation, for the output `wanted` after `dt` (s); keep the state."""


class StreamingAround(Streaming, Protocol):
    """Streaming evaluation of an effect around the hysteresis: what the hysteresis feels, and what goes beside it."""

    def inverse(self, dt: float, wanted: float, memory: Memory, lower: float, upper: float) -> float:
        """Return the voltage (V) for the displacement `wanted` (m); `memory` moves, within `lower` and `upper` (V)."""

    @property
    def beside(self) -> float:
        """Displacement (m) beside that of the hysteresis."""


class StreamingBase:
    """What streaming effects do unless they say otherwise: they have no state."""

    def start(self, x: float) -> None:
        """Do nothing."""

    def snapshot(self) -> Any:
        """Return nothing."""
        return ()

    def restore(self, state: Any) -> None:
        """Do nothing."""

    def resume(self, other: Any, x: float) -> None:
        """Keep the state: this effect does not continue from that of another model."""


class EffectBase(Protocol):
    """What effects are unless they say otherwise."""

    side: ClassVar[Side]

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

    @property
    def lasting(self) -> "Effect | None":
        """The effect as it is after its record; None if it ends with it."""
        return None if self.side == "record" else self  # type: ignore[return-value]

    @property
    def passes(self) -> tuple[float, float]:
        """Lowest and highest voltage (V) that the effect lets through."""
        return -inf, inf

    @property
    def shift(self) -> float:
        """Transport delay, seconds."""
        return 0.0

    @property
    def coupling(self) -> Mapping[str, float]:
        """Gains by which motions of other axes are added, by their names."""
        return {}


class Effect(EffectBase, Protocol):
    """One effect: a frozen dataclass whose fields are its parameters in SI units and their `uncertainty`."""

    name: ClassVar[str]

    @property
    def acts_on(self) -> Signal:
        """Signal on which the effect acts: the voltage, the hysteresis, or the displacement."""

    @property
    def uncertainty(self) -> Mapping[str, float]:
        """Standard deviation by place, such as ``gains.y`` or ``modes.0.gain``, in the unit of the parameter."""

    def apply(self, signal: FloatArray, around: EffectContext) -> FloatArray:
        """Return the output of the effect for an input signal, shape (N,), volts or metres, starting at equilibrium."""

    def invert(self, signal: FloatArray, around: EffectContext) -> FloatArray:
        """Return the input signal for an output signal, shape (N,), volts or metres."""

    @classmethod
    def fit(cls, left: "ResidualView") -> "Iterator[Candidate | Effect]":
        """Yield candidates for a fit: forms that are linear in their gains, or effects with fixed parameters."""

    def describe(self) -> str:
        """Describe the effect with its parameter values in one sentence."""


class AroundHysteresis(Effect, Protocol):
    """An effect around the hysteresis: its `apply` returns the voltage that the hysteresis feels."""

    def beside(self, v: FloatArray, u: FloatArray) -> FloatArray:
        """Return the displacement (m) beside the hysteresis for applied and felt voltages (V), shape (N,) each."""


@dataclass(frozen=True)
class Candidate:
    """One form of an effect for the identification, linear in its gains.

    Parameters
    ----------
    columns : ndarray, shape (N, k), metres
        Contribution to the displacement for a unit value of each of the k gains.
    effect : callable
        Returns the effect for gains of shape (k,), or None if the gains are not admissible.
    positive : int
        Number of trailing columns whose gains must be non-negative; if not 0, `effect` receives only these gains.
    starting : int
        Number of leading columns that describe the initial state of the records; each belongs to one record.
    group : int
        Forms of different groups are refined each by itself, as they lead to different parameters.
    """

    columns: FloatArray
    effect: Callable[[FloatArray], Effect | None]
    positive: int = 0
    starting: int = 0
    group: int = 0


class ResidualView(Protocol):
    """The hysteresis and effects identified so far, and the residual of a record of N samples."""

    @property
    def t(self) -> FloatArray:
        """Time, shape (N,), seconds."""

    @property
    def u(self) -> FloatArray:
        """Voltage that drives the hysteresis, shape (N,), volts."""

    @property
    def h(self) -> FloatArray:
        """Displacement of the hysteresis, shape (N,), metres."""

    @property
    def y(self) -> FloatArray:
        """Measured displacement, shape (N,), metres."""

    @property
    def used(self) -> NDArray[np.bool_]:
        """Mask of the samples used in the fit, shape (N,)."""

    @property
    def residual(self) -> FloatArray:
        """Residual, measured - model, shape (N,), metres."""

    @property
    def others(self) -> Mapping[str, FloatArray]:
        """Displacement of the other axes relative to their start, shape (N,), metres."""

    @property
    def around(self) -> EffectContext:
        """Context passed to the effects."""

    def respond(self, u: FloatArray) -> FloatArray:
        """Return the displacement of the hysteresis, shape (N,), metres, for the voltage `u`, shape (N,), volts."""


def usual_step(t: FloatArray) -> float:
    """Return the median sampling interval (s)."""
    return float(np.median(np.diff(t)))


def longest(around: EffectContext) -> float:
    """Return the duration (s) of the longest record."""
    return max(float(t[-1] - t[0]) for t in around.split(around.t))


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


def rhythms(left: ResidualView, count: int, lowest: float) -> list[float]:
    """Return the strongest frequencies (Hz) in the residual, at or above `lowest` (Hz)."""
    from scipy.fft import next_fast_len

    dt, around = usual_step(left.t), left.around
    size = 4 * next_fast_len(round(longest(around) / dt) + 1)
    frequency = np.fft.rfftfreq(size, dt)
    power = np.zeros(frequency.size)
    residual = np.where(left.used, left.residual, 0.0)
    for t, own in zip(around.split(left.t), around.split(residual), strict=True):
        grid = np.arange(t[0], t[-1], dt)
        power += np.abs(np.fft.rfft(np.interp(grid, t, own) * np.hanning(grid.size), size)) ** 2
    power[frequency < lowest] = 0.0
    return strongest_lines(power, frequency, count)


# Place of a parameter, such as ``modes.0.gain``, whether the rule holds, and the requirement as text.
Rule = tuple[str, bool, str]


def require(effect: Any, *rules: Rule) -> None:
    """Raise ModelError if a parameter is not finite or violates a rule."""
    for name, value in parameters_of(effect).items():
        for place, _, number in leaves(name, value):
            if not isfinite(number):
                raise ModelError(f"effect '{effect.name}': {place} is {number}; give finite numbers")
    require_rules(effect, *rules)


def require_rules(effect: Any, *rules: Rule) -> None:
    """Raise ModelError if a parameter violates a rule or an uncertainty belongs to no parameter."""
    for place, holds, need in rules:
        if not holds:
            value = effect
            for key in place.split("."):
                value = value[int(key)] if isinstance(value, tuple) else getattr(value, key)
            raise ModelError(f"effect '{effect.name}': {place} is {shorten(str(value), 80)}; it must be {need}")
    names = parameters_of(effect)
    for name, deviation in effect.uncertainty.items():
        if name.split(".")[0] not in names or not (isfinite(deviation) and deviation >= 0):
            raise ModelError(
                f"effect '{effect.name}': uncertainty of {name[:40]!r} is {deviation}; give 0 or more for one of "
                f"{', '.join(names)}"
            )


def parameters_of(effect: Any) -> dict[str, Any]:
    """Return the parameters of an effect by name, without `uncertainty`."""
    return {item.name: getattr(effect, item.name) for item in fields(effect) if item.name != "uncertainty"}


def leaves(place: str, value: Any, owner: str = "") -> Iterator[tuple[str, str, float]]:
    """Yield the numbers in a parameter, each with its place, such as ``modes.0.gain``, and the field that holds it."""
    owner = owner or place
    if is_dataclass(value):
        for item in fields(value):
            yield from leaves(f"{place}.{item.name}", getattr(value, item.name), item.name)
    elif isinstance(value, Mapping | tuple):
        for key, one in value.items() if isinstance(value, Mapping) else enumerate(value):
            yield from leaves(f"{place}.{key}", one, owner)
    else:
        yield place, owner, value


def with_leaves(value: Any, numbers: Iterator[float]) -> Any:
    """Return a parameter with other numbers, in the order of `leaves`."""
    if is_dataclass(value) and not isinstance(value, type):
        return replace(value, **{item.name: with_leaves(getattr(value, item.name), numbers) for item in fields(value)})
    if isinstance(value, Mapping):
        return {key: with_leaves(one, numbers) for key, one in value.items()}
    return tuple(with_leaves(one, numbers) for one in value) if isinstance(value, tuple) else next(numbers)
