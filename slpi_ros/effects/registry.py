"""Registry of the effects by name, and their conversion to and from documents."""

from collections.abc import Iterable, Mapping
from dataclasses import MISSING, fields
from math import isinf
from typing import Any, get_origin

from slpi_ros.effects.base import Effect, parameters_of
from slpi_ros.effects.creep import Creep
from slpi_ros.effects.cross_coupling import CrossCoupling
from slpi_ros.effects.delay import Delay
from slpi_ros.effects.gain_drift import GainDrift
from slpi_ros.effects.hum import Hum
from slpi_ros.effects.lag import Lag
from slpi_ros.effects.rate_dependence import RateDependence
from slpi_ros.effects.resonance import Resonance
from slpi_ros.effects.saturation import Saturation
from slpi_ros.effects.sensor_periodic import SensorPeriodic
from slpi_ros.effects.thermal_drift import ThermalDrift
from slpi_ros.errors import ModelError

# Listed in the order in which the effects act.
EFFECTS: dict[str, type[Any]] = {
    kind.name: kind
    for kind in (
        *(Delay, Lag, Saturation),
        *(RateDependence, Creep, Resonance, GainDrift, CrossCoupling, ThermalDrift, SensorPeriodic, Hum),
    )
}
_PLACE = {name: place for place, name in enumerate(EFFECTS)}


def in_order(effects: Iterable[Effect]) -> tuple[Effect, ...]:
    """Return effects in the order in which they act.

    Raises
    ------
    ModelError
        If an effect occurs twice.
    """
    ordered = tuple(sorted(effects, key=lambda effect: _PLACE[effect.name]))
    for one, other in zip(ordered, ordered[1:], strict=False):
        if one.name == other.name:
            raise ModelError(f"effect '{one.name}' comes twice; an axis has each effect once")
    return ordered


def to_document(effect: Effect) -> dict[str, Any]:
    """Return an effect as a JSON document in SI units."""
    return {
        "name": effect.name,
        "parameters": {name: _plain(value) for name, value in parameters_of(effect).items()},
        "uncertainty": dict(effect.uncertainty),
    }


def from_document(document: Any) -> Effect:
    """Build an effect from a document.

    Raises
    ------
    ModelError
        If the effect is unknown or its parameters are invalid.
    """
    name = _member(document, "name")
    if not isinstance(name, str) or name not in EFFECTS:
        found = name[:40] if isinstance(name, str) else type(name).__name__
        raise ModelError(f"no effect {found!r}; this version knows {', '.join(EFFECTS)}")
    given, kind = _mapping(name, "parameters", _member(document, "parameters")), EFFECTS[name]
    wanted = {item.name: item for item in fields(kind) if item.name != "uncertainty"}
    needed = {key for key, item in wanted.items() if item.default is MISSING}
    if not needed <= given.keys() <= wanted.keys():
        raise ModelError(
            f"effect '{name}' has parameters {', '.join(map(str, given))[:80]!r}; give {', '.join(wanted)}"
        )
    read = {key: _read(name, wanted[key], value) for key, value in given.items()}
    spread = _mapping(name, "uncertainty", document.get("uncertainty", {}))
    uncertainty = {str(key): _number(name, f"uncertainty of {str(key)[:40]!r}", value) for key, value in spread.items()}
    effect: Effect = kind(**read, uncertainty=uncertainty)
    return effect


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return dict(value)
    if isinstance(value, tuple):
        return list(value)
    return None if isinf(value) else value


def _read(effect: str, item: Any, value: Any) -> Any:
    """Convert one parameter to the type of its field: a number, a tuple of numbers, or a mapping of numbers."""
    holds = get_origin(item.type) or item.type
    if holds is tuple:
        if not isinstance(value, list | tuple):
            raise ModelError(
                f"effect '{effect}': {item.name} is of type {type(value).__name__}; give a list of numbers"
            )
        return tuple(_number(effect, item.name, each) for each in value)
    if holds is Mapping:
        pairs = _mapping(effect, item.name, value).items()
        return {str(key): _number(effect, item.name, each) for key, each in pairs}
    if value is None and isinstance(item.default, float):
        return item.default
    return _number(effect, item.name, value)


def _number(effect: str, what: str, value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise ModelError(f"effect '{effect}': {what} is of type {type(value).__name__}; give a number")
    try:
        return float(value)
    except OverflowError:
        raise ModelError(f"effect '{effect}': {what} is too large; give a finite number") from None


def _member(document: Any, key: str) -> Any:
    if not isinstance(document, Mapping) or key not in document:
        raise ModelError(f"an effect needs 'name' and 'parameters'; {key!r} is missing")
    return document[key]


def _mapping(effect: str, what: str, value: Any) -> Mapping[Any, Any]:
    if not isinstance(value, Mapping):
        raise ModelError(f"effect '{effect}': {what} is of type {type(value).__name__}; give names with numbers")
    return value
