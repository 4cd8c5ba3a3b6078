"""Free parameters of effects as vectors, with their bounds, step sizes and uncertainties."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from math import exp, log

import numpy as np

from slpi_ros.arrays import FloatArray
from slpi_ros.effects.base import Candidate, Effect, EffectContext, FitContext, usual_step
from slpi_ros.effects.parameters import Fit, Leaf, Scales

# Largest change of a parameter in one step, relative to its magnitude, and of the logarithm of one that ranges over
# decades.
LARGEST_STEP, LARGEST_LOG_STEP = 0.7, 2.0


@dataclass(frozen=True)
class EachRecord(Effect):
    """An effect with separate parameters in each record, such as drift or lines: its `parts`."""

    parts: tuple[Effect, ...]
    side = "record"

    def __post_init__(self) -> None:
        """Do nothing: each part has been validated."""

    @classmethod
    def of(cls, parts: Sequence[Effect | None]) -> "EachRecord | None":
        """Return the effect of these parts; None if one is missing."""
        found = tuple(part for part in parts if part is not None)
        return cls(found) if len(found) == len(parts) else None

    @property
    def name(self) -> str:  # type: ignore[override]
        """The effect's name."""
        return self.parts[0].name

    def apply(self, signal: FloatArray, around: EffectContext) -> FloatArray:
        """Return the output for the concatenated signals of all records, shape (N,), metres."""
        parts = iter(self.parts)
        return around.each(lambda own, record: next(parts).apply(own, record), signal)

    def invert(self, signal: FloatArray, around: EffectContext) -> FloatArray:
        """Return the input signal, shape (N,), metres, for an output signal of all records."""
        parts = iter(self.parts)
        return around.each(lambda own, record: next(parts).invert(own, record), signal)

    def joined(self, other: "EachRecord") -> "EachRecord | None":
        """Return the effects of both, record by record."""
        return EachRecord.of([one.joined(two) for one, two in zip(self.parts, other.parts, strict=True)])

    @property
    def courses(self) -> tuple[tuple[float, ...], ...]:
        """Values at the knots of each record, of an effect with a free course."""
        return tuple(course for part in self.parts for course in part.courses)

    def plausible(self, view: FitContext) -> bool:
        """Return whether the parameters of each record are plausible, and agree where they belong to all."""
        first = self.parts[0]
        return all(part.plausible(view.of_record(k)) and first.agrees(part, view) for k, part in enumerate(self.parts))

    def only_plausible(self, view: FitContext) -> "EachRecord | None":
        """Return the effect of each record without those of its parts that are not plausible."""
        return EachRecord.of([part.only_plausible(view.of_record(k)) for k, part in enumerate(self.parts)])

    def free_leaves(self) -> list[Leaf]:
        """Return the fitted numbers of all records."""
        return [leaf for part in self.parts for leaf in part.free_leaves()]

    def with_free(self, numbers: Iterable[float]) -> "EachRecord":
        """Return the effect with other fitted numbers."""
        left = iter(numbers)
        return EachRecord(tuple(part.with_free([next(left) for _ in part.free_leaves()]) for part in self.parts))

    def describe(self) -> str:
        """Describe the effect in each record."""
        return "; ".join(f"record {k}: {part.describe()}" for k, part in enumerate(self.parts, 1))

    @classmethod
    def fit(cls, left: FitContext) -> Iterator[Candidate | Effect]:
        """Yield nothing: candidates come from the effect of each record."""
        yield from ()


# Largest standard deviation that a model document holds: of what is not determined at all.
LEAST_KNOWN = 1e12


def _fitted(effect: Effect) -> list[tuple[str, Fit, float]]:
    """Return place, kind of fit and value of each free parameter, such as ``modes.0.gain``."""
    return [(leaf.place, leaf.facts.fit, leaf.value) for leaf in effect.free_leaves() if leaf.facts.fit]


def names(effect: Effect) -> list[str]:
    """Return the names of the free parameters; elements of a field have names such as ``gains.0``."""
    return [place for place, _, _ in _fitted(effect)]


def free(effect: Effect) -> FloatArray:
    """Return the values of the free parameters, shape (k,), SI, or their logarithms for logarithmic ones."""
    values = [log(max(value, fit.least)) if fit.kind == "logarithmic" else value for _, fit, value in _fitted(effect)]
    return np.array(values, dtype=np.float64)


def moved(
    effect: Effect, values: FloatArray, longest: float = np.inf, near: tuple[float, float] = (-np.inf, np.inf)
) -> Effect:
    """Return the effect with new free parameters, clipped to their bounds.

    `longest` is the largest time constant (s), and `near` are the bounds (m) of a displacement near the motion.
    """
    new = []
    for (_, fit, _), value in zip(_fitted(effect), values.tolist(), strict=True):
        number = exp(min(value, 300.0)) if fit.kind == "logarithmic" else value
        low, high = near if fit.near_motion else (fit.least, longest if fit.within_record else fit.most)
        new.append(min(max(number, low), high))
    return effect.with_free(new)


def steps(effect: Effect, t: FloatArray, v: FloatArray) -> FloatArray:
    """Return the step of each free parameter for numerical derivatives, shape (k,), SI."""
    scales, found = Scales(usual_step(t), float(np.ptp(t)), float(np.ptp(v))), []
    for _, fit, value in _fitted(effect):
        step = fit.step(value, scales) if callable(fit.step) else fit.step
        # Downwards where there is an upper bound: at the bound, a step upwards would change nothing.
        found.append(-step if fit.most < np.inf and value - step >= fit.least else step)
    return np.array(found)


def independent(effect: Effect) -> list[dict[int, int | None]]:
    """Return groups of free parameters of which no sample depends on two: record (None: all) by place in `free`."""
    if not isinstance(effect, EachRecord):
        return [{k: None} for k in range(free(effect).size)]
    counts = [free(part).size for part in effect.parts]
    firsts = np.cumsum([0, *counts]).tolist()
    return [
        {firsts[record] + k: record for record, count in enumerate(counts) if k < count} for k in range(max(counts))
    ]


def bounded(effect: Effect, change: FloatArray) -> FloatArray:
    """Return a change of the free parameters, limited to the range in which the linearised fit is valid."""
    limits = {"linear": np.inf, "angle": LARGEST_STEP, "logarithmic": LARGEST_LOG_STEP}
    limit = np.array([limits.get(fit.kind, LARGEST_STEP * abs(value)) for _, fit, value in _fitted(effect)])
    return np.clip(change, -limit, limit)


def certain(effect: Effect, spread: Sequence[float]) -> Effect:
    """Return the effect with `spread`, the standard deviations of its free parameters in order, as its uncertainty."""
    if isinstance(effect, EachRecord):
        left = list(spread)
        return EachRecord(tuple(certain(part, [left.pop(0) for _ in part.free_leaves()]) for part in effect.parts))
    found = {
        place: min(deviation * (value if fit.kind == "logarithmic" else 1.0), LEAST_KNOWN)
        for (place, fit, value), deviation in zip(_fitted(effect), spread, strict=True)
    }
    return replace(effect, uncertainty=found)
