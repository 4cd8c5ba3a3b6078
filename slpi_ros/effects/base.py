"""What every effect is: its verbs, what it may look at, its candidates for a fit, and checks of its parameters."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, fields
from functools import wraps
from math import isfinite
from typing import Any, ClassVar, Literal, Protocol, TypeVar

import numpy as np
import scipy.fft
from numpy.typing import NDArray

from slpi_ros.errors import ModelError

FloatArray = NDArray[np.float64]

Side = Literal["voltage", "displacement"]
# When an effect can be undone: sample by sample; where the whole path is known; on the record's clock only; never.
Removable = Literal["always", "path", "record", "never"]
# Neighbours of a spectrum's peak that belong to it, on either side.
LINE_WIDTH = 12


@dataclass(frozen=True)
class EffectContext:
    """What an effect may look at besides the signal it changes.

    Parameters
    ----------
    t : ndarray, shape (N,), seconds
        From the first stamp, not decreasing.
    u : ndarray, shape (N,), volts, optional
        Voltage that drives the hysteresis.
    middle : callable, optional
        Displacement (m) half-way between the two branches of the largest loop, at voltages (V).
    others : mapping of axis name to ndarray, shape (N,), metres
        Motion of the other axes from their start, before coupling.
    records : tuple of EffectContext
        Of each record, where signals hold several records, one behind the other; empty for one.
    """

    t: FloatArray
    u: FloatArray | None = None
    middle: Callable[[FloatArray], FloatArray] | None = None
    others: Mapping[str, FloatArray] = field(default_factory=dict)
    records: "tuple[EffectContext, ...]" = ()

    def split(self, signal: NDArray[Any]) -> list[NDArray[Any]]:
        """Return the parts of a signal, shape (N, ..), that belong to each record."""
        return (
            np.split(signal, np.cumsum([record.t.size for record in self.records[:-1]])) if self.records else [signal]
        )


Effected = TypeVar("Effected")


def by_record(
    apply: Callable[[Effected, FloatArray, EffectContext], FloatArray],
) -> Callable[[Effected, FloatArray, EffectContext], FloatArray]:
    """Let an effect that remembers begin anew with every record."""

    @wraps(apply)
    def applied(effect: Effected, signal: FloatArray, around: EffectContext) -> FloatArray:
        if not around.records:
            return apply(effect, signal, around)
        parts = zip(around.split(signal), around.records, strict=True)
        return np.concatenate([apply(effect, part, record) for part, record in parts])

    return applied


class StreamingEffect(Protocol):
    """An effect sample by sample; it remembers what it needs of the past."""

    def start(self, x: float) -> None:
        """Be at rest at the input `x` (V or m), as after a long time."""

    def forward(self, dt: float, x: float) -> float:
        """Move to the input `x`, `dt` (s) later; return the output."""

    def inverse(self, dt: float, wanted: float) -> float:
        """Return the input that gives the wanted output `dt` (s) from now, or as near as is stable; nothing moves."""

    def snapshot(self) -> Any:
        """Return the whole state, JSON-like: numbers and tuples of them."""

    def restore(self, state: Any) -> None:
        """Take over a state from `snapshot`."""


class DrivenStreamingEffect(StreamingEffect, Protocol):
    """A follower that also looks at the voltage that drives the hysteresis."""

    def attach(self, middle: Callable[[float], float]) -> None:
        """Tell where the middle of the largest loop is: displacement (m) at a voltage (V)."""

    def drive(self, dt: float, u: float) -> None:
        """Note the voltage `u` (V), `dt` (s) after the last one."""


class Effect(Protocol):
    """One effect: a frozen dataclass whose fields are its parameters, SI units, and their `uncertainty`."""

    name: ClassVar[str]
    removable: ClassVar[Removable]

    @property
    def side(self) -> Side:
        """What it acts on."""

    @property
    def uncertainty(self) -> Mapping[str, float]:
        """Standard deviation by parameter, in the parameter's unit."""

    def apply(self, signal: FloatArray, around: EffectContext) -> FloatArray:
        """Return what becomes of a signal, shape (N,), volts or metres; it begins at rest."""

    def invert(self, signal: FloatArray, around: EffectContext) -> FloatArray:
        """Return the signal that becomes the given one, shape (N,), volts or metres; the whole path is known."""

    @classmethod
    def fit(cls, left: "ResidualView") -> "Iterator[Candidate | Effect]":
        """Yield what it may be in a record: forms for a fit to judge, linear in their gains, or effects as they are."""

    def describe(self) -> str:
        """Say in one sentence what it is, with numbers."""

    def streaming(self) -> StreamingEffect | None:
        """Return what follows it sample by sample; None: nothing can be done so."""


@dataclass(frozen=True)
class Candidate:
    """One form of an effect.

    Parameters
    ----------
    columns : ndarray, shape (N, k), metres
        What it would add, linear in k gains.
    effect : callable
        Returns the effect for gains of shape (k,), or None where they make none.
    positive : int
        Number of the last columns whose gains may not be negative; `effect` is given those alone, if there are any.
    starting : int
        Number of the first columns that tell how a record began; their gains are each record's own.
    """

    columns: FloatArray
    effect: Callable[[FloatArray], Effect | None]
    positive: int = 0
    starting: int = 0


class ResidualView(Protocol):
    """A hysteresis with the effects found so far, and what they leave of a record of N samples."""

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
        """Samples that count, shape (N,)."""

    @property
    def residual(self) -> FloatArray:
        """What is left of the measured displacement, shape (N,), metres."""

    @property
    def others(self) -> Mapping[str, FloatArray]:
        """Motion of the other axes from their start, shape (N,), metres."""

    @property
    def around(self) -> EffectContext:
        """What effects may look at."""

    def respond(self, u: FloatArray) -> FloatArray:
        """Return the displacement of the hysteresis, shape (N,), metres, for another voltage."""


def usual_step(t: FloatArray) -> float:
    """Return the median time (s) from one sample to the next."""
    return float(np.median(np.diff(t)))


def longest(around: EffectContext) -> float:
    """Return the duration (s) of the longest record."""
    return max(float(t[-1] - t[0]) for t in around.split(around.t))


def wave(phase: FloatArray) -> FloatArray:
    """Return the two columns, shape (N, 2), whose sum is any sine of that phase (rad); see `amplitude_and_phase`."""
    return np.column_stack([np.sin(phase), np.cos(phase)])


def amplitude_and_phase(gains: FloatArray) -> tuple[float, float]:
    """Return amplitude and phase (rad) of the sine that two gains of `wave` make."""
    return float(np.hypot(gains[0], gains[1])), float(np.arctan2(gains[1], gains[0]))


def strongest_lines(
    power: FloatArray, at: NDArray[np.floating[Any]], count: int, width: int = LINE_WIDTH
) -> list[float]:
    """Return where (as `at`, shape (n,)) a spectrum, shape (n,), is highest, strongest first."""
    power, found = power.copy(), []
    for _ in range(count):
        k = int(np.argmax(power))
        if not power[k] > 0:
            break
        found.append(float(at[k]))
        power[max(0, k - width) : k + width + 1] = 0.0
    return found


def rhythms(left: ResidualView, count: int, lowest: float) -> list[float]:
    """Return the frequencies (Hz), from `lowest` on, that are strongest in what is left."""
    dt, around = usual_step(left.t), left.around
    size = 4 * scipy.fft.next_fast_len(round(longest(around) / dt) + 1)
    frequency = np.fft.rfftfreq(size, dt)
    power = np.zeros(frequency.size)
    residual = np.where(left.used, left.residual, 0.0)
    for t, own in zip(around.split(left.t), around.split(residual), strict=True):
        grid = np.arange(t[0], t[-1], dt)
        power += np.abs(np.fft.rfft(np.interp(grid, t, own) * np.hanning(grid.size), size)) ** 2
    power[frequency < lowest] = 0.0
    return strongest_lines(power, frequency, count)


Rule = tuple[str, bool, str]


def require(effect: Any, *rules: Rule) -> None:
    """Refuse parameters that make no sense.

    Parameters
    ----------
    effect : Effect
        A frozen dataclass; every number in it has to be finite.
    rules : (str, bool, str)
        Name of a parameter, whether it holds, and what is needed.

    Raises
    ------
    ModelError
        It names the first bad one.
    """
    require_finite(effect)
    require_rules(effect, *rules)


def require_finite(effect: Any) -> None:
    """Refuse numbers that are not finite; ModelError."""
    for name, value in parameters_of(effect).items():
        if not all(isfinite(number) for number in numbers_in(value)):
            raise ModelError(f"effect '{effect.name}': {name} is {value}; give finite numbers")


def require_rules(effect: Any, *rules: Rule) -> None:
    """Refuse parameters for which a rule does not hold, and uncertainties of no parameter; ModelError."""
    for name, holds, need in rules:
        if not holds:
            raise ModelError(f"effect '{effect.name}': {name} is {getattr(effect, name)}; it must be {need}")
    names = parameters_of(effect)
    for name, deviation in effect.uncertainty.items():
        if name.split(".")[0] not in names or not (isfinite(deviation) and deviation >= 0):
            raise ModelError(
                f"effect '{effect.name}': uncertainty of {name[:40]!r} is {deviation}; give 0 or more for one of "
                f"{', '.join(names)}"
            )


def parameters_of(effect: Any) -> dict[str, Any]:
    """Return the parameters of an effect by name."""
    return {item.name: getattr(effect, item.name) for item in fields(effect) if item.name != "uncertainty"}


def numbers_in(value: Any) -> Iterator[float]:
    """Yield the numbers of a parameter: itself, those of a tuple, or those of a mapping."""
    if isinstance(value, Mapping):
        yield from value.values()
    elif isinstance(value, tuple):
        yield from value
    else:
        yield value
