"""Registry of the effects by name, and their conversion to and from documents."""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import MISSING, fields, is_dataclass
from importlib import import_module
from math import isinf
from typing import Any, get_args, get_origin

from slpi_ros.effects.base import Effect
from slpi_ros.effects.parameters import facts_of
from slpi_ros.errors import ModelError

# Modules of the effects, in the order in which the effects act.
MODULES = (
    "delay",
    "lag",
    "slew",
    "saturation",
    "rate_dependence",
    "creep",
    "contact",
    "resonance",
    "self_heating",
    "surroundings",
    "gain_drift",
    "cross_coupling",
    "thermal_drift",
    "clock",
    "steps",
    "sensor_periodic",
    "hum",
)
# Effects by name. The class of the module ``rate_dependence`` is ``RateDependence``, and so on.
EFFECTS: dict[str, type[Any]] = {
    name: getattr(import_module(f"slpi_ros.effects.{name}"), name.title().replace("_", "")) for name in MODULES
}

# What documents have for parameters, and for a parameter with one number for each name.
NAMED = "names with numbers"


def base_name(label: str) -> str:
    """Return the name of the effect of an alternative, such as ``surroundings /room/temperature``."""
    return label.partition(" ")[0]


def in_order(effects: Iterable[Effect]) -> tuple[Effect, ...]:
    """Return effects in the order in which they act; ModelError if an effect occurs twice."""
    place = list(EFFECTS).index
    ordered = tuple(sorted(effects, key=lambda effect: place(effect.name)))
    for one, other in zip(ordered, ordered[1:], strict=False):
        if one.name == other.name:
            raise ModelError(f"effect '{one.name}' comes twice; an axis has each effect once")
    return ordered


def to_document(effect: Effect) -> dict[str, Any]:
    """Return an effect as a JSON document in SI units."""
    return {
        "name": effect.name,
        "parameters": {name: _plain(value) for name, value in _given(effect)},
        "uncertainty": dict(effect.uncertainty),
    }


def from_document(document: Any) -> Effect:
    """Build an effect from a document; ModelError if it is unknown or its parameters are invalid."""
    name = _member(document, "name")
    if not isinstance(name, str) or name not in EFFECTS:
        found = name[:40] if isinstance(name, str) else type(name).__name__
        raise ModelError(f"no effect {found!r}; this version knows {', '.join(EFFECTS)}")
    read = _built(name, "parameters", EFFECTS[name], _member(document, "parameters"))
    spread = _of_type(name, "uncertainty", document.get("uncertainty", {}), Mapping, NAMED)
    read["uncertainty"] = {
        str(key): _number(name, f"uncertainty of {str(key)[:40]!r}", value) for key, value in spread.items()
    }
    effect: Effect = EFFECTS[name](**read)
    return effect


def _given(effect: Effect) -> Iterator[tuple[str, Any]]:
    """Yield the parameters by name, but optional lists that are empty and what counts only instead of one."""
    for name, facts in facts_of(type(effect)).items():
        value = getattr(effect, name)
        if (facts.required or value != ()) and not (facts.instead and getattr(effect, facts.instead)):
            yield name, value


def _plain(value: Any) -> Any:
    if is_dataclass(value):
        return {item.name: _plain(getattr(value, item.name)) for item in fields(value)}
    if isinstance(value, Mapping):
        return dict(value)
    if isinstance(value, tuple):
        return [_plain(one) for one in value]
    return None if isinstance(value, float) and isinf(value) else value


def _built(effect: str, what: str, kind: Any, value: Any) -> dict[str, Any]:
    """Convert a mapping to the fields of a dataclass other than `uncertainty`, by name."""
    given = _of_type(effect, what, value, Mapping, NAMED)
    wanted = {item.name: item for item in fields(kind) if item.name != "uncertainty"}
    if not {key for key, item in wanted.items() if item.default is MISSING} <= given.keys() <= wanted.keys():
        raise ModelError(f"effect '{effect}': {what} are {', '.join(map(str, given))[:80]!r}; give {', '.join(wanted)}")
    place = "" if what == "parameters" else f"{what}."
    return {key: _read(effect, place + key, wanted[key].type, one, wanted[key].default) for key, one in given.items()}


def _read(effect: str, what: str, kind: Any, value: Any, default: Any = MISSING) -> Any:
    """Convert a value to the type `kind`: a number, a tuple or mapping of numbers, or a tuple of dataclasses."""
    holds: Any = get_origin(kind) or kind
    if holds is tuple:
        each = enumerate(_of_type(effect, what, value, list | tuple, "a list"))
        return tuple(_read(effect, f"{what}.{k}", get_args(kind)[0], one) for k, one in each)
    if holds is Mapping:
        return {
            str(key): _number(effect, what, each) for key, each in _of_type(effect, what, value, Mapping, NAMED).items()
        }
    if holds is str:
        return _of_type(effect, what, value, str, "a text")
    if is_dataclass(holds):
        return kind(**_built(effect, what, kind, value))
    return default if value is None and isinstance(default, float) else _number(effect, what, value)


def _number(effect: str, what: str, value: Any) -> float:
    try:
        return float(_of_type(effect, what, value, int | float, "a number"))
    except OverflowError:
        raise ModelError(f"effect '{effect}': {what} is too large; give a finite number") from None


def _member(document: Any, key: str) -> Any:
    if not isinstance(document, Mapping) or key not in document:
        raise ModelError(f"an effect needs 'name' and 'parameters'; {key!r} is missing")
    return document[key]


def _of_type(effect: str, what: str, value: Any, kind: Any, need: str) -> Any:
    """Return a value that is of the type `kind`; a truth value is no number."""
    if isinstance(value, bool) or not isinstance(value, kind):
        raise ModelError(f"effect '{effect}': {what} is of type {type(value).__name__}; give {need}")
    return value
