"""What the reference pages take from the code and the schemas: each function returns MyST Markdown."""

import argparse
import json
import pkgutil
import re
import textwrap
from importlib import import_module
from pathlib import Path

from slpi_ros import cli, nodes
from slpi_ros.compensator.motion import MEANING, REPLACED_BY, Kind
from slpi_ros.effects.registry import EFFECTS
from slpi_ros.nodes import start

ROOT = Path(__file__).resolve().parents[1]
SCHEMAS = ROOT / "msg_schemas"


def table(header, rows):
    """Return a Markdown table; cells are text without line breaks."""
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join("| " + " | ".join(cell.replace("|", "\\|") for cell in line) + " |" for line in lines)


def code(text):
    return f"`{text}`" if text else ""


def parameters():
    """Return the parameters of every node, from the tables that the nodes declare them by."""
    sections = []
    for name in node_names():
        rows = [
            [code(each.name), code(_value(each.default)), _allowed(each), each.description + _fixed(each)]
            for each in import_module(f"slpi_ros.nodes.{name}").DECLARATIONS
        ]
        sections.append(f"## {name}\n\n{table(['name', 'default', 'allowed', 'meaning'], rows)}")
    return "\n\n".join(sections)


def node_names():
    """Return the modules of nodes: those with an executable."""
    return [
        module.name for module in pkgutil.iter_modules(nodes.__path__) if callable(getattr(start, module.name, None))
    ]


def _value(value):
    if isinstance(value, float) and value != value:
        return ".nan"
    return json.dumps(value) if not isinstance(value, str) or not value else value


def _allowed(declaration):
    if declaration.choices:
        return ", ".join(map(code, declaration.choices))
    if bounds := declaration.between or declaration.lists:
        low, high = (f"{bound:g}" for bound in bounds)
        return f"{low} to {high}"
    return ""


def _fixed(declaration):
    return " Read-only." if declaration.read_only else ""


def topics():
    """Return all topics, from ``topics.json``."""
    sections = []
    for each in json.loads((SCHEMAS / "topics.json").read_text())["topics"]:
        qos = each["qos"]
        ends = [", ".join(map(code, each[end])) or "your nodes" for end in ("publishers", "subscribers")]
        rows = [
            ["type", ", ".join(code(kind.replace("/msg/", "/")) for kind in each["types"])],
            ["unit", each["unit"] or "none"],
            ["from, to", f"{ends[0]} → {ends[1]}"],
            ["QoS", f"{qos['reliability']}, {qos['durability']}, depth {qos['depth']}".replace("_", " ")],
        ]
        sections.append(f"## {each['name']}\n\n{each['meaning']}\n\n{table(['', ''], rows)}")
    return "\n\n".join(sections)


def motions():
    """Return all motions of an axis, and what may replace them."""
    every = set(Kind)
    rows = []
    for kind, meaning in MEANING.items():
        others = [each.value for each in Kind if each in REPLACED_BY[kind]]
        rows.append([code(kind.value), meaning, "any" if REPLACED_BY[kind] == every else ", ".join(map(code, others))])
    return table(["motion", "what the axis does", "may be replaced by"], rows)


def effects():
    """Return all effects beside hysteresis, from their facts."""
    rows = [[code(name), kind.side, kind.what, kind.compensated] for name, kind in EFFECTS.items()]
    return table(["effect", "side", "what it is", "compensated"], rows)


def documents():
    """Return the fields of every document, from its JSON Schema."""
    return "\n\n".join(_document(path) for path in sorted(SCHEMAS.glob("*.schema.json")))


def _document(path):
    schema = json.loads(path.read_text())
    definitions = schema.get("$defs", {})
    name = path.name.split(".")[0].replace("_", " ")
    about = f"{schema['title']}. {schema.get('description', '')}"
    parts = [f"## {name.capitalize()}\n\n{about} Schema: `{path.name}`, `{schema['properties']['schema']['const']}`."]
    parts.append(_fields(schema, definitions))
    for part_name, part in definitions.items():
        if fields := _fields(part, definitions):
            parts.append(f"### {part_name} ({name})\n\n{part.get('description', '')}\n\n{fields}")
    return "\n\n".join(part.strip() for part in parts)


def _fields(schema, definitions):
    rows = list(_rows(schema, definitions, "", set()))
    return table(["field", "type", "required", "meaning"], rows) if rows else ""


def _rows(schema, definitions, prefix, required):
    """Yield one row for each field, those of nested objects and of alternatives included."""
    required = {*required, *schema.get("required", ())} if not prefix else set(schema.get("required", ()))
    for name, field in schema.get("properties", {}).items():
        kind, target = _kind(field, definitions)
        if "description" in field or kind or "const" in field:
            meaning = field.get("description") or (target.get("description", "") if target is not field else "")
            yield [code(prefix + name), kind, "yes" if name in required else "no", meaning]
        yield from _rows(field, definitions, f"{prefix}{name}.", set())
    inside = prefix.removesuffix(".")
    for key, ending in (("items", "[]."), ("additionalProperties", ".NAME.")):
        if isinstance(schema.get(key), dict):
            yield from _rows(schema[key], definitions, (inside + ending).lstrip("."), set())
    for key in ("allOf", "anyOf", "oneOf"):
        for part in schema.get(key, ()):
            then = part.get("then", part)
            when = part.get("if", {}).get("properties", {})
            where = next((f"{name} = {rule['const']}" for name, rule in when.items() if "const" in rule), None)
            for row in _rows(then, definitions, prefix, set()):
                yield [row[0], row[1], row[2], f"{row[3]} Only with {where}.".strip() if where else row[3]]


def _kind(field, definitions):
    """Return the type of a field in words, and the definition that it refers to (else itself)."""
    reference = field.get("$ref") or next((part["$ref"] for part in field.get("allOf", ()) if "$ref" in part), None)
    if reference:
        name = reference.rpartition("/")[2]
        return _named(name, definitions[name], definitions), definitions[name]
    if "const" in field:
        return code(json.dumps(field["const"])), field
    if "enum" in field:
        return ", ".join(code(json.dumps(value)) for value in field["enum"]), field
    kind = field.get("type", "")
    kind = " or ".join(kind) if isinstance(kind, list) else kind
    if kind == "array" and isinstance(field.get("items"), dict):
        return f"array of {_kind(field['items'], definitions)[0] or 'values'}", field
    if isinstance(field.get("additionalProperties"), dict):
        inner = _kind(field["additionalProperties"], definitions)[0]
        return f"object by name{': ' + inner if inner else ''}", field
    return kind, field


def _named(name, definition, definitions):
    """Return the name of a definition that has a table of its own, else its type."""
    return name if "properties" in definition or "allOf" in definition else _kind(definition, definitions)[0] or name


def commands():
    """Return the command line, from its parsers."""
    whole = cli.parser()
    (subparsers,) = (action for action in whole._actions if isinstance(action, argparse._SubParsersAction))
    sections = []
    for choice in subparsers._choices_actions:
        parser = subparsers.choices[choice.dest]
        usage = _usage(parser.format_usage().removeprefix("usage: "))
        rows = [
            [code(_option(action)), _default(action, parser)]
            for action in parser._actions
            if not isinstance(action, argparse._HelpAction)
        ]
        text = f"{choice.help[0].upper()}{choice.help[1:]}."
        sections.append(
            f"## slpi {choice.dest}\n\n{text}\n\n```text\n{usage}\n```\n\n{table(['option', 'meaning'], rows)}"
        )
    return "\n\n".join(sections)


def _usage(text):
    """Wrap a usage line without breaking between an option and its value."""
    text = re.sub(r"\s+", " ", text).strip()
    whole = re.sub(r"\[[^][]*(\[[^][]*\])?[^][]*\]|-\S+ [A-Z]\S*", lambda one: one[0].replace(" ", "\0"), text)
    lines = textwrap.wrap(whole, 84, subsequent_indent="    ", break_long_words=False, break_on_hyphens=False)
    return "\n".join(lines).replace("\0", " ")


def _option(action):
    metavar = action.metavar or (action.dest.upper() if action.option_strings else action.dest)
    metavar = metavar if isinstance(metavar, str) else " ".join(metavar)
    several = "..." if action.nargs in ("+", "*") else ""
    if not action.option_strings:
        return metavar + several
    value = "" if action.nargs == 0 else f" {metavar}{several}"
    return ", ".join(action.option_strings) + value


def _default(action, parser):
    text = (action.help or "") % {**vars(action), "prog": parser.prog}
    choices = f"one of {', '.join(map(code, action.choices))}" if action.choices else ""
    return "; ".join(filter(None, [text, choices]))


def example(path):
    """Return a file of the repository as a block of code."""
    language = {".py": "python", ".yaml": "yaml"}[Path(path).suffix]
    return f"```{language}\n{(ROOT / path).read_text().strip()}\n```"


GENERATORS = {
    function.__name__: function for function in (parameters, topics, motions, effects, documents, commands, example)
}
