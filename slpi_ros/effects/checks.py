"""Checks of an effect's parameters."""

from collections.abc import Iterator, Mapping
from dataclasses import fields
from math import isfinite
from typing import Any

from slpi_ros.errors import ModelError

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
