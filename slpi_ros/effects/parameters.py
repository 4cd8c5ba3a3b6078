"""Facts of the parameters of effects, stored with their fields, and what follows from them: validation and vectors."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import MISSING, dataclass, field, fields, is_dataclass, replace
from functools import cache
from math import inf, isfinite, isinf, nan
from textwrap import shorten
from typing import Any, Literal, NamedTuple

from slpi_ros.errors import ModelError

# How a parameter is fitted. Linear: the displacement is linear in it, or nearly so, and a Gauss-Newton step is not
# limited; relative and angle: a step is limited in relation to the value, or absolutely; logarithmic: its logarithm is
# fitted, as it ranges over decades.
Kind = Literal["linear", "relative", "angle", "logarithmic"]


class Scales(NamedTuple):
    """Scales of a record: median sampling interval (s), duration (s), and voltage range (V)."""

    interval: float
    duration: float
    voltage: float


def in_samples(value: float, scales: Scales) -> float:
    """Return the step of numerical derivatives by a short time."""
    return 0.05 * scales.interval


@dataclass(frozen=True)
class Fit:
    """How a parameter is fitted: with steps of numerical derivatives, and bounds."""

    kind: Kind
    step: float | Callable[[float, Scales], float] = lambda value, scales: 1e-4 * abs(value) + 1e-12
    least: float = -inf
    most: float = inf
    # Whether a multiple of the duration of the record is the upper bound instead.
    within_record: bool = False
    # Whether it is a displacement that stays near those of the record.
    near_motion: bool = False
    # Whether it is the state at the start of each record; an entry that is 0 stays 0.
    start: bool = False
    # Value that stays, as 0 of what is not there, or 1 of a mode that has all of the motion.
    stays: float = nan
    # Whether it may mean something where the fit ends at a bound.
    ends: bool = False


@dataclass(frozen=True)
class Parameter:
    """Facts of one parameter, or of every number in a list or mapping, with the bounds `low` and `high`."""

    unit: str
    meaning: str
    low: float
    high: float
    # Whether documents must contain it.
    required: bool
    # Whether the bounds themselves are excluded; whether it may be infinite, null in documents: there is none.
    above: bool = False
    below: bool = False
    none: bool = False
    # Smallest and largest length of a list or mapping.
    count: tuple[int, int] = (1, 10000)
    # The list instead of which it is given, if any.
    instead: str = ""
    # None if it is not fitted but chosen.
    fit: Fit | None = None

    def holds(self, value: float) -> bool:
        """Return whether a value is valid."""
        if not isfinite(value):
            return self.none and isinf(value)
        excluded = (self.above and value == self.low) or (self.below and value == self.high)
        return self.low <= value <= self.high and not excluded

    @property
    def need(self) -> str:
        """What a value must be, in words."""
        low = f"{'more than' if self.above else 'at least'} {self.low:g}"
        high = f"{'less than' if self.below else 'at most'} {self.high:g}"
        return f"a finite number, {low} and {high} {self.unit}".rstrip() + ", or infinite for none" * self.none


def parameter(
    unit: str,
    meaning: str,
    low: float = -inf,
    high: float = inf,
    *,
    default: Any = MISSING,
    required: bool = False,
    **facts: Any,
) -> Any:
    """Return a dataclass field with the facts of `Parameter`; documents must contain it if it has no default."""
    must = required or default is MISSING
    return field(default=default, metadata={"parameter": Parameter(unit, meaning, low, high, must, **facts)})


def text(meaning: str, *, default: Any = MISSING) -> Any:
    """Return a dataclass field with a name, such as that of a topic; documents must contain it without a default."""
    return field(default=default, metadata={"text": meaning})


def _facts_of(kind: Any) -> dict[str, Parameter]:
    """Return the facts of the parameters of a kind of effect, or of the elements of a list in one, by field."""
    return {item.name: item.metadata["parameter"] for item in fields(kind) if "parameter" in item.metadata}


facts_of: Callable[[Any], dict[str, Parameter]] = cache(_facts_of)


class Leaf(NamedTuple):
    """A number in a parameter: its place, such as ``modes.0.gain``, its facts, and its value."""

    place: str
    facts: Parameter
    value: float

    @property
    def at_bound(self) -> bool:
        """Whether its fit ended at a bound, where it stands for something else; gains may be 0 or 1."""
        fit = self.facts.fit
        if fit is None or fit.ends or fit.kind == "linear":
            return False
        return bool(self.value) and not fit.least < self.value < fit.most

    @property
    def free(self) -> bool:
        """Whether it is fitted: what is not there, or an equilibrium at the start, stays as it is."""
        fit = self.facts.fit
        return (
            fit is not None and isfinite(self.value) and (bool(self.value) or not fit.start) and self.value != fit.stays
        )


def leaves(place: str, facts: Parameter, value: Any) -> Iterator[Leaf]:
    """Yield the numbers in a parameter."""
    if isinstance(value, float):  # first, as most are
        yield Leaf(place, facts, value)
    elif is_dataclass(value):
        for name, own in facts_of(type(value)).items():
            yield from leaves(f"{place}.{name}", own, getattr(value, name))
    elif isinstance(value, Mapping | tuple):
        for key, one in value.items() if isinstance(value, Mapping) else enumerate(value):
            yield from leaves(f"{place}.{key}", facts, one)
    else:
        yield Leaf(place, facts, value)


def with_leaves(value: Any, numbers: Iterator[float]) -> Any:
    """Return a parameter with other numbers, in the order of `leaves`."""
    if isinstance(value, float):
        return next(numbers)
    if is_dataclass(value) and not isinstance(value, type):
        names = facts_of(type(value))
        return replace(value, **{name: with_leaves(getattr(value, name), numbers) for name in names})
    if isinstance(value, Mapping):
        return {key: with_leaves(one, numbers) for key, one in value.items()}
    return tuple(with_leaves(one, numbers) for one in value) if isinstance(value, tuple) else next(numbers)


def require_facts(effect: Any) -> None:
    """Raise ModelError if a parameter violates its facts or an uncertainty belongs to no parameter."""
    known = facts_of(type(effect))
    for name, facts in known.items():
        value, (fewest, most) = getattr(effect, name), facts.count
        if isinstance(value, tuple | Mapping):
            require(effect, (name, fewest <= len(value) <= most, f"{fewest} to {most} of them"))
    for leaf in effect.leaves:
        if not leaf.facts.holds(leaf.value):
            raise ModelError(f"effect '{effect.name}': {leaf.place} is {leaf.value}; it must be {leaf.facts.need}")
    for name, deviation in effect.uncertainty.items():
        if name.split(".")[0] not in known or not (isfinite(deviation) and deviation >= 0):
            raise ModelError(
                f"effect '{effect.name}': uncertainty of {name[:40]!r} is {deviation}; give 0 or more for one of "
                f"{', '.join(known)}"
            )


def require(effect: Any, *rules: tuple[str, bool, str]) -> None:
    """Raise ModelError if a rule is violated: name of a parameter, whether the rule holds, and the requirement."""
    for name, holds, need in rules:
        if not holds:
            value = shorten(str(getattr(effect, name)), 80)
            raise ModelError(f"effect '{effect.name}': {name} is {value}; it must be {need}")
