"""``slpi param``: tells or sets a parameter of a running node."""

import json
from argparse import ArgumentParser, Namespace
from typing import Any

from slpi_ros.cli.command import Result, command_line

HELP = "show or set a parameter of a running node"
EXAMPLE = "slpi param /compensator feedback true"


def add_options(command: ArgumentParser) -> None:
    """Add the options of the command."""
    command.add_argument("node", metavar="NODE", help="name of the node, as /compensator")
    command.add_argument("name", metavar="NAME", help="name of the parameter")
    command.add_argument(
        "value", metavar="VALUE", nargs="?", help="new value; [1.0, 2.0] for several axes; default: it is only shown"
    )


def run(options: Namespace) -> Result:
    """Run the command."""
    from slpi_ros.nodes.graph_calls import NodeCalls, joined

    with joined("slpi_param") as (node, executor):
        calls = NodeCalls(node, executor, options.node)
        before = calls.parameter(options.name)
        value = before if options.value is None else calls.set_parameter(options.name, options.value)
    said = f"{options.name}: {_shown(value)}"
    if options.value is not None:
        said += f" (was {_shown(before)})"
    document = {"node": options.node, "name": options.name, "value": _listed(value), "before": _listed(before)}
    following = command_line("slpi", "param", options.node, options.name, *(["VALUE"] if options.value is None else []))
    return Result([], document, following, said)


def _listed(value: Any) -> Any:
    """Return a value with a list for an array."""
    return value if isinstance(value, str) or not hasattr(value, "__len__") else list(value)


def _shown(value: Any) -> str:
    return value if isinstance(value, str) else json.dumps(_listed(value))
