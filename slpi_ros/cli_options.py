"""What the command line ``slpi`` can be told."""

import argparse
from collections.abc import Sequence
from typing import Any, NoReturn

import numpy as np

from slpi_ros.excitation.drives import DRIVES
from slpi_ros.identification.fit import KINDS

# Where a bag holds voltage and displacement, if nothing else is said.
TOPIC = "stage_state"


class _Parser(argparse.ArgumentParser):
    """A parser that says what is wrong in one line."""

    def error(self, message: str) -> NoReturn:
        self.exit(2, f"{self.prog}: {message} (see {self.prog} --help)\n")


class _EachOnce(argparse.Action):
    """Several names, none of them twice."""

    def __call__(
        self,
        parser: argparse.ArgumentParser,
        namespace: argparse.Namespace,
        values: str | Sequence[Any] | None,
        option_string: str | None = None,
    ) -> None:
        names = list(values or ())
        for name in names:
            if names.count(name) > 1:
                raise argparse.ArgumentError(self, f"'{name}' comes more than once; name each axis once")
        setattr(namespace, self.dest, names)


def parser() -> argparse.ArgumentParser:
    """Return the parser of all commands; the chosen one is the option ``command``."""
    whole = _Parser(prog="slpi", description="Hysteresis models of piezo stages: identify, diagnose, compensate.")
    commands = whole.add_subparsers(dest="command", required=True, metavar="COMMAND", parser_class=_Parser)
    _import(commands.add_parser("import", help="turn a table of measured data into a bag"))
    _identify(commands.add_parser("identify", help="identify the model of a stage from a bag"))
    _diagnose(commands.add_parser("diagnose", help="say what a model gets wrong on a bag, why, and what mends it"))
    _excite(commands.add_parser("excite", help="make the voltages to record for an identification"))
    _refit(commands.add_parser("refit", help="update a model with a new bag; what the bag does not visit stays"))
    _simulate(commands.add_parser("simulate", help="voltage to displacement"))
    _compensate(commands.add_parser("compensate", help="desired displacement to voltage"))
    _experiments(commands.add_parser("experiments", help="compute the two papers' tables and figures anew"))
    commands.add_parser("show", help="say what a model holds").add_argument("model", metavar="MODEL.json")
    return whole


def _import(command: Any) -> None:
    command.add_argument(
        "table", metavar="DATA.csv|DATA.mat",
        help="columns by comma, semicolon or tab; their names say the units, as in x_nm, x (nm), x [nm] or x in nm",
    )  # fmt: skip
    command.add_argument("-o", "--output", metavar="BAG", required=True, help="folder of the new bag")
    command.add_argument("--time", metavar="COLUMN", help="default: the column whose name starts with 'time'")
    command.add_argument("--voltage", metavar="COLUMN", nargs="+", default=(), help="one for all axes or one for each")
    command.add_argument("--displacement", metavar="COLUMN", nargs="+", default=(), help="one for each axis")
    command.add_argument(
        "--displacement-unit", help="m, mm, um, nm or pm, where column names do not say it; default: um"
    )
    command.add_argument(
        "--axes", metavar="NAME", nargs="+", default=(), help="names of the axes; default: from the columns"
    )
    command.add_argument("--hardware-id", metavar="ID", default="", help="which stage it is")
    command.add_argument("--storage", choices=("mcap", "sqlite3"), default="mcap")


def _identify(command: Any) -> None:
    command.add_argument("bags", metavar="BAG", nargs="+", help="rosbag2 folder, or a lone mcap or sqlite3 file")
    command.add_argument("-o", "--output", metavar="MODEL.json", required=True)
    command.add_argument("--kind", choices=KINDS, default="slpi")
    command.add_argument(
        "--loops-at-rest", action="store_true", help="slpi-published: operators start at rest, as published"
    )
    _where_in_the_bag(command)
    _axes(command, help="default: every axis of the bag")
    _span(command)
    command.add_argument("--report", metavar="DIR", help="also write a page with plots, of the first bag")
    command.add_argument("--uncertainty", action="store_true", help="also say how surely the curves are known")


def _diagnose(command: Any) -> None:
    command.add_argument("bag", metavar="BAG", help="rosbag2 folder, or a lone mcap or sqlite3 file")
    command.add_argument("--model", metavar="MODEL.json", required=True, help="of the same stage")
    command.add_argument(
        "-o", "--output", metavar="DIR", required=True,
        help="folder of diagnosis.json, extended_model.json and report.html",
    )  # fmt: skip
    _where_in_the_bag(command)
    _axes(command, help="default: every axis that bag and model share")
    _span(command)


def _axes(command: Any, **told: Any) -> None:
    command.add_argument("--axis", metavar="NAME", nargs="+", action=_EachOnce, **told)


def _span(command: Any) -> None:
    command.add_argument("--start", metavar="S", type=float, help="fit only from here on, seconds from the first stamp")
    command.add_argument("--stop", metavar="S", type=float, help="fit only up to here")


def _where_in_the_bag(command: Any) -> None:
    command.add_argument("--topic", help=f"default: {TOPIC}")
    command.add_argument("--voltage-topic", metavar="TOPIC", help="where voltage and displacement are apart")
    command.add_argument("--displacement-topic", metavar="TOPIC")
    clocks = ("displacement", "voltage")
    command.add_argument("--clock", choices=clocks, help=f"whose stamps count there; default: {clocks[0]}")
    command.add_argument("--voltage-measured", action="store_true", help="voltage is a reading, no command that holds")


def _excite(command: Any) -> None:
    command.add_argument("-o", "--output", metavar="DRIVE.csv", required=True, help="columns time_s, <axis>_V")
    _axes(command, default=("x",), help="they move one after the other")
    command.add_argument("--voltage-min", metavar="V", type=float, required=True, help="never left")
    command.add_argument("--voltage-max", metavar="V", type=float, required=True)
    command.add_argument("--slew", metavar="V/S", type=float, default=0.0, help="fastest change; 0: none")
    command.add_argument("--duration", metavar="S", type=float, default=30.0)
    command.add_argument("--rate", metavar="HZ", type=float, default=200.0)
    command.add_argument("--seed", metavar="N", type=int, default=0)
    command.add_argument(
        "--for", dest="drive", metavar="EFFECT", choices=DRIVES, default=DRIVES[0],
        help=f"what the record is to tell from others: {', '.join(DRIVES[1:])}",
    )  # fmt: skip


def _refit(command: Any) -> None:
    command.add_argument("model", metavar="MODEL.json")
    command.add_argument("bag", metavar="BAG")
    command.add_argument("-o", "--output", metavar="MODEL.json", required=True, help="may be the same file")
    command.add_argument("--topic", default=TOPIC)


def _simulate(command: Any) -> None:
    command.add_argument("model", metavar="MODEL.json")
    command.add_argument("table", metavar="VOLTAGE.csv", help="columns time_s, <axis>_V")
    command.add_argument("-o", "--output", metavar="DISPLACEMENT.csv", required=True)


def _compensate(command: Any) -> None:
    command.add_argument("model", metavar="MODEL.json")
    command.add_argument("table", metavar="DESIRED.csv", help="columns time_s, <axis>_m")
    command.add_argument("-o", "--output", metavar="VOLTAGE.csv", required=True)
    command.add_argument("--voltage-min", metavar="V", type=float, default=-np.inf, help="default: what was identified")
    command.add_argument("--voltage-max", metavar="V", type=float, default=np.inf)


def _experiments(command: Any) -> None:
    command.add_argument("-o", "--output", metavar="DIR", required=True, help="folder of index.html")
    command.add_argument("--data", metavar="DIR", help="folder of measured records, to be compared too")
