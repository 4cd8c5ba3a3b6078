"""What ``--help`` of a node program prints: its purpose, topics and parameters, from the code and ``topics.json``."""

import inspect
import json
import re
import shutil
import sys
import textwrap
from collections.abc import Iterator, Sequence
from importlib.resources import files

from rclpy.node import Node

from slpi_ros.nodes.parameters import Declaration

# Widest line, characters.
WIDEST = 110


def help_asked(name: str, node: type[Node], declarations: Sequence[Declaration]) -> bool:
    """Print the help of a node program, from the docstring of its class, if asked for; return whether it was."""
    if not {"-h", "--help"} & set(sys.argv[1:]):
        return False
    print("\n".join(_lines(name, node, declarations)))
    return True


def _lines(name: str, node: type[Node], declarations: Sequence[Declaration]) -> Iterator[str]:
    width = min(WIDEST, shutil.get_terminal_size((WIDEST, 24)).columns)
    yield from (f"usage: ros2 run slpi_ros {name} [--ros-args -p PARAMETER:=VALUE... -r TOPIC:=NEW_TOPIC...]", "")
    for paragraph in _purpose(node):
        yield from (*textwrap.wrap(paragraph, width), "")
    yield "topics:"
    for topic in json.loads((files("slpi_ros") / "msg_schemas" / "topics.json").read_text(encoding="utf-8"))["topics"]:
        kinds = " or ".join(kind.replace("/msg/", "/") for kind in topic["types"])
        for role, direction in (("subscribers", "in"), ("publishers", "out")):
            if name in topic[role]:
                yield from _entry(f"{topic['name']} ({direction}, {kinds})", topic["meaning"], width)
    yield from ("", "parameters:")
    for each in declarations:
        fixed = " Read-only." if each.read_only else ""
        # As YAML, which is what the option -p takes.
        default = ".nan" if each.default != each.default else json.dumps(each.default)
        yield from _entry(f"{each.name} (default: {default})", each.description + fixed, width)


def _purpose(node: type[Node]) -> list[str]:
    """Return the paragraphs of the docstring of a node, without its numpydoc sections and markup."""
    text = re.split(r"\n\n[A-Z]\w+\n---", inspect.getdoc(node) or "")[0]
    text = re.sub(r"[;,.]? parameters in `\w+`", "", text, flags=re.IGNORECASE)
    return [" ".join(paragraph.split()).replace("`", "") for paragraph in text.split("\n\n")]


def _entry(head: str, text: str, width: int) -> list[str]:
    indent = "      "
    return [f"  {head}", *textwrap.wrap(text, width, initial_indent=indent, subsequent_indent=indent)]
