# PYTHON_ARGCOMPLETE_OK
"""The command line ``slpi``, usable without a running ROS graph; each command is a module of this folder."""
# Exit codes: 0 success, 1 the data do not allow the request, a verification failed or ``slpi doctor`` found a fault, 2
# wrong usage. Errors are reported on one line. A command prints its verdict first, then at most `MOST_LINES` lines (all
# with ``-v``), and last the command that follows; with ``--json`` it prints one JSON document instead.

import argparse
import os
import re
import sys
import warnings
from collections.abc import Mapping, Sequence
from contextlib import suppress
from io import TextIOWrapper
from typing import Any, NoReturn, Protocol

from slpi_ros.cli import (
    calibrate,
    call,
    compensate,
    diagnose,
    doctor,
    excite,
    experiments,
    export,
    fleet,
    identify,
    import_,
    learn,
    param,
    refit,
    show,
    simulate,
    tune,
    verify,
)
from slpi_ros.cli.command import MOST_LINES, Result, say
from slpi_ros.errors import DependencyError, SlpiError, dependencies_needed, shown
from slpi_ros.identification.progress import report_progress, shown_on

__all__ = ["COMMANDS", "MOST_LINES", "main", "parser"]


class Command(Protocol):
    """A module with one command. What loads slowly (the numerical and plotting modules) is imported by its `run`."""

    HELP: str
    EXAMPLE: str

    def add_options(self, command: argparse.ArgumentParser, /) -> None:
        """Add the options of the command."""

    def run(self, options: argparse.Namespace, /) -> Result:
        """Run the command."""


# In the order of ``slpi --help``.
COMMANDS: Mapping[str, Command] = {
    "import": import_, "identify": identify, "diagnose": diagnose, "verify": verify, "excite": excite, "refit": refit,
    "fleet": fleet, "simulate": simulate, "compensate": compensate, "learn": learn, "export": export, "tune": tune,
    "doctor": doctor, "call": call, "param": param, "calibrate": calibrate, "experiments": experiments, "show": show,
}  # fmt: skip


class _ShowVersion(argparse.Action):
    """Print the version of the installed package."""

    def __init__(self, option_strings: Sequence[str], dest: str, **_: Any) -> None:
        super().__init__(option_strings, argparse.SUPPRESS, nargs=0, help="print the version and exit")

    def __call__(self, parser: argparse.ArgumentParser, *_: Any) -> None:
        from importlib.metadata import PackageNotFoundError, version

        try:
            found = version("slpi_ros")
        except PackageNotFoundError:
            found = "(not installed)"
        say(f"slpi {found}")
        parser.exit()


class _Parser(argparse.ArgumentParser):
    """Argument parser that reports usage errors on one line."""

    def error(self, message: str) -> NoReturn:
        self.exit(2, f"{self.prog}: {shown(message)} (see {self.prog} --help)\n")


def parser(command: str | None = None) -> argparse.ArgumentParser:
    """Return the parser of all commands, of which only `command` (default: all) has its options."""
    whole = _Parser(
        prog="slpi",
        description="Hysteresis models of piezo stages: identify, diagnose, compensate.",
        epilog=_epilog("slpi identify calibration -o model.json"),
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    whole.add_argument("--version", action=_ShowVersion)
    commands = whole.add_subparsers(dest="command", required=True, metavar="COMMAND", parser_class=_Parser)
    for name, each in COMMANDS.items():
        own = commands.add_parser(
            name,
            help=each.HELP,
            description=f"{each.HELP[0].upper()}{each.HELP[1:]}.",
            epilog=_epilog(each.EXAMPLE),
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )
        if command in (None, name):
            each.add_options(own)
            own.add_argument("--json", action="store_true", help="print one JSON document, in SI units; default: text")
            own.add_argument("-v", "--verbose", action="store_true", help="print every line; default: the main ones")
    return whole


def _epilog(example: str) -> str:
    return f"example:\n  {example}"


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; return the exit code."""
    arguments = sys.argv[1:] if arguments is None else arguments
    if "_ARGCOMPLETE" in os.environ:
        _complete()
    if not arguments:
        parser("").print_help()
    for argument in arguments:
        # argparse reads the first as an empty list, and no file can have the second in its name.
        if re.fullmatch(r"--[^=]+=--", argument) or "\0" in argument:
            parser("").error(f"argument {argument!r} has no valid value")
    try:
        with dependencies_needed():
            options = parser(arguments[0] if arguments else "").parse_args(arguments)
    except DependencyError as error:
        print(f"{' '.join(['slpi', *arguments[:1]])}: {error}", file=sys.stderr)
        return error.exit_code
    for output in (sys.stdout, sys.stderr):
        # Characters that the terminal encoding lacks are printed as escape sequences.
        if isinstance(output, TextIOWrapper):
            output.reconfigure(errors="backslashreplace")
    # Told at the end of a command that succeeds; an error is the only line of one that fails.
    options.remarks = []
    warnings.showwarning = lambda message, *_: options.remarks.append(str(message))
    try:
        with shown_on(sys.stderr), dependencies_needed():
            report_progress(options.command)
            result = COMMANDS[options.command].run(options)
        result.show(as_document=options.json, verbose=options.verbose)
        code, remarks = 0 if result.passed else 1, options.remarks
    except SlpiError as error:
        code, remarks = error.exit_code, [str(error)]
    except (OSError, MemoryError) as error:
        code, remarks = 1, [str(error) or "not enough memory"]
    except KeyboardInterrupt:
        return 130
    for remark in remarks:
        print(f"slpi {options.command}: {shown(remark)}", file=sys.stderr)
    return code


def _complete() -> None:
    """Answer the shell that asks for completions, and exit; without the package argcomplete do nothing."""
    with suppress(ImportError):
        import argcomplete

        argcomplete.autocomplete(parser())
