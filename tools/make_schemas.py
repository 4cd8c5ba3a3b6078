"""Write what the schemas of models and diagnoses say of effects anew, from the facts of the effects."""

import json
import textwrap
from collections.abc import Mapping
from dataclasses import MISSING, fields, is_dataclass
from math import isfinite
from pathlib import Path
from typing import get_args, get_origin

from slpi_ros.effects.parameters import facts_of
from slpi_ros.effects.registry import EFFECTS

SCHEMAS = Path(__file__).resolve().parents[1] / "msg_schemas"
# A unit without a name stands as it is.
UNITS = {"s": "Seconds", "V": "Volts", "m": "Metres", "Hz": "Hertz", "rad": "Radians"}
WIDTH = 120
# Characters of the name of a topic or field.
LONGEST_TEXT = 255


def model_schema(schema):
    """Return the schema of models with all effects."""
    effect = schema["$defs"]["effect"]
    effect["properties"]["name"]["enum"] = list(EFFECTS)
    effect["allOf"] = [
        {
            "if": {"properties": {"name": {"const": name}}},
            "then": {"properties": {"parameters": _fields(kind)}},
        }
        for name, kind in EFFECTS.items()
    ]
    schema["$defs"]["axis"]["properties"]["effects"]["maxItems"] = len(EFFECTS)
    return schema


def diagnosis_schema(schema):
    """Return the schema of diagnoses with all effects."""
    schema["$defs"]["effect"]["enum"] = list(EFFECTS)
    alternatives = schema["properties"]["axes"]["additionalProperties"]["properties"]["effects"]["items"]
    alternatives["properties"]["alternatives"]["items"] = {
        "type": "string",
        "pattern": f"^({'|'.join(EFFECTS)})( .+)?$",
    }
    return schema


def _fields(kind):
    """Return the schema of the parameters of an effect, or of an element of a list of dataclasses."""
    types = {item.name: item.type for item in fields(kind)}
    facts = facts_of(kind)
    texts = {item.name: item for item in fields(kind) if "text" in item.metadata}
    required = [name for name, item in texts.items() if item.default is MISSING]
    named = {
        name: {"type": "string", "maxLength": LONGEST_TEXT, "description": _sentence(item.metadata["text"])}
        for name, item in texts.items()
    }
    return {
        "required": [*required, *(name for name, each in facts.items() if each.required)],
        "additionalProperties": False,
        "properties": named | {name: _field(each, types[name]) for name, each in facts.items()},
    }


def _field(facts, kind):
    unit = f" {UNITS.get(facts.unit, facts.unit)}." if facts.unit else ""
    about = {"description": _sentence(f"{facts.meaning}{'; null: none' * facts.none}") + unit}
    few, most = facts.count
    holds = get_origin(kind)
    if holds is tuple:
        inner = get_args(kind)[0]
        items = {"type": "object", **_fields(inner)} if is_dataclass(inner) else _number(facts)
        return {"type": "array", "minItems": few, "maxItems": most, "items": items} | about
    if holds is Mapping:
        names = {"propertyNames": {"maxLength": 100}, "additionalProperties": _number(facts)}
        return {"type": "object", "minProperties": few, "maxProperties": most, **names} | about
    return _number(facts) | about


def _sentence(text):
    return f"{text[0].upper()}{text[1:]}."


def _number(facts):
    bounds = {
        "exclusiveMinimum" if facts.above else "minimum": facts.low,
        "exclusiveMaximum" if facts.below else "maximum": facts.high,
    }
    return {"type": ["number", "null"] if facts.none else "number"} | {
        key: int(bound) if bound == int(bound) else bound for key, bound in bounds.items() if isfinite(bound)
    }


def text(value, before=""):
    """Return JSON in which each object and each list is on one line if it fits."""
    line = json.dumps(value, ensure_ascii=False)
    if len(before) + len(line) < WIDTH or not isinstance(value, dict | list) or not value:
        return line
    indent = " " * (len(before) - len(before.lstrip()) + 2)
    if isinstance(value, list) and not any(isinstance(one, dict | list) for one in value):
        parts = [textwrap.fill(line[1:-1], WIDTH, initial_indent=indent, subsequent_indent=indent)]
    elif isinstance(value, dict):
        parts = [
            f"{indent}{json.dumps(key)}: {text(one, f'{indent}{json.dumps(key)}: ')}" for key, one in value.items()
        ]
    else:
        parts = [indent + text(one, indent) for one in value]
    return "\n".join([line[0], ",\n".join(parts), indent[2:] + line[-1]])


def read(source):
    """Return parsed JSON in which whole numbers are integers, as `text` writes them."""
    return json.loads(
        source, parse_float=lambda number: int(float(number)) if float(number) % 1 == 0 else float(number)
    )


GENERATED = {"model": model_schema, "diagnosis": diagnosis_schema}


def main():
    """Write the schemas."""
    for name, generated in GENERATED.items():
        path = SCHEMAS / f"{name}.schema.json"
        path.write_text(text(generated(read(path.read_text()))) + "\n")


if __name__ == "__main__":
    main()
