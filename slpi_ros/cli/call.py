"""``slpi call``: calls a Trigger service of a node, and says first what that moves."""

from argparse import ArgumentParser, Namespace

from slpi_ros.cli import options as common
from slpi_ros.cli.command import Result, command_line, say

HELP = "call a service of a running node, such as arm or reset_memory, and say first what that moves"
EXAMPLE = "slpi call /compensator arm"

# What each service of the nodes moves.
MOVES = {
    "arm": "nothing now; the next command moves the stage, from the voltage that is reported",
    "reset_memory": "a decaying oscillation over the whole voltage range, or from reset_min to reset_max: tip and "
    "sample must be away",
    "set_zero": "nothing; goals and holds end",
    "forget": "nothing now; the next pass of a path is driven without what was learned",
    "start": "the drive of an exciter, or all drives of a calibrator, over the voltages that it was given",
    "pause": "nothing; the voltage is held",
    "stop": "exciter and calibrator go back to the rest voltage at the slew limit; a driver holds, also within a block",
    "identify": "nothing",
    "diagnose": "nothing",
}
UNKNOWN = "what the node does with it, which is not known here"
# A reset may last minutes.
PATIENCE = 300.0


def add_options(command: ArgumentParser) -> None:
    """Add the options of the command."""
    command.add_argument("node", metavar="NODE", help="name of the node, as /compensator")
    command.add_argument("service", metavar="SERVICE", help=f"one of its services: {', '.join(MOVES)}")
    command.add_argument(
        "--seconds", metavar="S", type=common.seconds, default=PATIENCE,
        help=f"longest time to wait for the answer; default: {PATIENCE:g} s",
    )  # fmt: skip


def run(options: Namespace) -> Result:
    """Run the command."""
    from slpi_ros.nodes.graph_calls import NodeCalls, joined

    service = options.service.removeprefix("~/")
    moves = MOVES.get(service, UNKNOWN)
    with joined("slpi_call") as (node, executor):
        calls = NodeCalls(node, executor, options.node)
        if not options.json:
            say(f"{options.node} {service} moves: {moves}")
        success, message = calls.trigger(service, options.seconds)
    document = {"node": options.node, "service": service, "moves": moves, "success": success, "message": message}
    following = command_line("slpi", "doctor") if success else "see what it says, and /diagnostics"
    return Result([], document, following, f"{'done' if success else 'FAILED'}: {message or service}", passed=success)
