"""JSON Schemas of all documents that are published or stored in files, and validation against them."""

import json
import textwrap
from collections.abc import Iterator, Mapping
from functools import cache
from importlib.resources import files
from itertools import islice
from operator import ge, gt, le, lt
from typing import Any

from slpi_ros.errors import ModelError, UsageError, dependencies_needed
from slpi_ros.io.input_limits import LONGEST_NAME, MOST_AXES, MOST_ERRORS


def load_schema(name: str) -> dict[str, Any]:
    """Read the schema ``msg_schemas/NAME.schema.json``, for example of ``"model"``; UsageError if there is none."""
    # In the source tree slpi_ros/msg_schemas is a link to the top-level folder, in an installation a copy of it.
    folder = files("slpi_ros") / "msg_schemas"
    try:
        text = (folder / f"{name}.schema.json").read_text(encoding="utf-8")
    except FileNotFoundError:
        names = sorted(entry.name for entry in folder.iterdir())
        known = ", ".join(each.removesuffix(".schema.json") for each in names if each.endswith(".schema.json"))
        raise UsageError(f"there is no schema {name!r} in {folder}; use one of: {known}") from None
    schema: dict[str, Any] = json.loads(text)
    return schema


def validate(document: object, name: str, source: str) -> None:
    """Check a document, as from ``json.loads``, against the schema `name`; `source` is named in the ModelError."""
    axes = document.get("axes") if isinstance(document, dict) else None
    if isinstance(axes, dict):
        # The validator would take minutes to tell what is wrong with each of a million axes.
        if len(axes) > MOST_AXES:
            raise ModelError(f"{source}: {len(axes)} axes, more than {MOST_AXES}; give a document of one stage")
        if wrong := [axis for axis in axes if len(axis) > LONGEST_NAME]:
            raise ModelError(
                f"{source}: axis {wrong[0][:20]!r}... has a name of {len(wrong[0])} characters, more than "
                f"{LONGEST_NAME}; rename it"
            )
    schema = _schema(name)
    if _conforms(document, schema, schema):
        return
    # Loading jsonschema takes longer than everything else in `slpi show`.
    with dependencies_needed():
        from jsonschema.exceptions import best_match

    error = best_match(islice(_validator(name).iter_errors(document), MOST_ERRORS))
    if error is not None:
        place = textwrap.shorten(error.json_path.replace("\\n", " "), width=200, placeholder=" ...")
        reason = textwrap.shorten(error.message, width=200, placeholder=" ...")
        raise ModelError(f"{source}: not a valid {name} document: at {place}: {reason}; write it anew")


def format_document(document: Mapping[str, Any], name: str) -> str:
    """Return the JSON text of a new document of the kind `name`; ModelError if it does not conform to its schema."""
    validate(document, name, f"the new {name}")
    return json.dumps(document, allow_nan=False, indent=1)


_schema = cache(load_schema)

_TYPES = {"object": (dict,), "array": (list,), "string": (str,), "number": (float, int), "null": (type(None),)}
_TYPES |= {"integer": (int,), "boolean": (bool,)}
# Keywords that restrict nothing, or that are evaluated with another one.
_NEUTRAL = frozenset(("description", "title", "$schema", "$defs", "then"))
_BOUNDS = {"minimum": ge, "maximum": le, "exclusiveMinimum": gt, "exclusiveMaximum": lt}
_SIZES = {"minItems": list, "maxItems": list, "minProperties": dict, "maxProperties": dict, "maxLength": str}


def _conforms(value: Any, schema: Any, root: Mapping[str, Any]) -> bool:
    """Return True if a value is certainly valid for `schema`, a part of `root`; False if only jsonschema can tell."""
    if isinstance(schema, bool):
        return schema
    return all(_satisfies(value, keyword, schema, root) for keyword in schema if keyword not in _NEUTRAL)


def _satisfies(value: Any, keyword: str, schema: Mapping[str, Any], root: Mapping[str, Any]) -> bool:
    wanted = schema[keyword]
    match keyword:
        case "type":
            return type(value) in {
                kind for name in ([wanted] if isinstance(wanted, str) else wanted) for kind in _TYPES[name]
            }
        case "$ref":
            return _conforms(value, root["$defs"][wanted.removeprefix("#/$defs/")], root)
        case "allOf":
            return all(_conforms(value, part, root) for part in wanted)
        case "const":
            return isinstance(value, str) and value == wanted
        case "enum":
            return isinstance(value, str) and value in wanted
        case _ if keyword in _BOUNDS:
            return type(value) not in (int, float) or bool(_BOUNDS[keyword](value, wanted))
        case _ if keyword in _SIZES:
            if not isinstance(value, _SIZES[keyword]):
                return True
            return len(value) <= wanted if keyword.startswith("max") else len(value) >= wanted
        case "items":
            return not isinstance(value, list) or all(_conforms(item, wanted, root) for item in _extremes(value))
    if not isinstance(value, dict):
        return keyword in ("required", "properties", "additionalProperties", "propertyNames")
    match keyword:
        case "required":
            return all(name in value for name in wanted)
        case "properties":
            return all(_conforms(value[name], part, root) for name, part in wanted.items() if name in value)
        case "additionalProperties":
            return all(_conforms(value[name], wanted, root) for name in value.keys() - schema.get("properties", ()))
        case "propertyNames":
            return all(_conforms(name, wanted, root) for name in value)
        case "if":
            # The only condition in these schemas: one property is a certain text.
            ((name, condition),) = wanted["properties"].items()
            if not isinstance(value.get(name), str):
                return False
            return value[name] != condition["const"] or _conforms(value, schema["then"], root)
    return False


def _extremes(values: list[Any]) -> list[Any]:
    """Return the items of an array that decide whether it is valid: of floats, only the minimum and the maximum."""
    floats = len(values) > 2 and all(type(value) is float for value in values)
    return [min(values), max(values)] if floats else values


@cache
def _validator(name: str) -> Any:
    with dependencies_needed():
        from jsonschema import Draft202012Validator
        from jsonschema.validators import extend

    def items(validator: Any, schema: Any, values: Any, parent: Any) -> Iterator[Any]:
        """Check all items of an array of floats only if its minimum or maximum is invalid."""
        if isinstance(values, list) and len(values) > parent.get("maxItems", len(values)):
            # Too many items are an error as such; it would take long to check each of them.
            return
        check = Draft202012Validator.VALIDATORS["items"]
        few = _extremes(values) if isinstance(values, list) else values
        if few is values or any(True for _ in check(validator, schema, few, parent)):
            yield from check(validator, schema, values, parent)

    quick: Any = extend(Draft202012Validator, {"items": items})  # type: ignore[no-untyped-call]
    return quick(_schema(name))
