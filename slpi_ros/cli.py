# PYTHON_ARGCOMPLETE_OK
"""The command line ``slpi``, usable without a running ROS graph.

Exit codes: 0 success, 1 the data do not allow the request, a verification failed or ``slpi doctor`` found a fault, 2
wrong usage. Errors are reported on one line. A command prints its verdict first, then at most `MOST_LINES` lines (all
with ``-v``), and last the command that follows; with ``--json`` it prints one JSON document instead.
"""

import argparse
import json
import math
import os
import re
import shlex
import sys
import warnings
from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext, suppress
from dataclasses import dataclass, replace
from io import TextIOWrapper
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

from slpi_ros.errors import (
    LONGEST_SHOWN,
    DependencyError,
    ModelError,
    RecordError,
    SlpiError,
    UsageError,
    dependencies_needed,
    shown,
)
from slpi_ros.identification.progress import report_progress, shown_on

# Each command imports its modules when it runs: the numerical and plotting modules load slowly.
if TYPE_CHECKING:
    from slpi_ros.identification.record_quality import Finding
    from slpi_ros.identification.refit import AxisChange
    from slpi_ros.io.alignment import SeparateTopics
    from slpi_ros.io.record import FloatArray, Record
    from slpi_ros.model.stage_model import StageModel

# Default topic with voltage and displacement.
TOPIC = "stage_state"
COMMANDS_TOPIC = "voltage_command"
# Longest time to watch a running graph, seconds.
LONGEST_WATCH = 3600.0
# Lines between the verdict and the next command, without -v.
MOST_LINES = 10
# A first voltage that differs by more than this share of the range is told as a jump.
SMALLEST_JUMP = 1e-3


@dataclass(frozen=True)
class Result:
    """What a command has to say.

    Parameters
    ----------
    lines : sequence of str
        In words, the most important first.
    document : str or mapping
        The figures, for ``--json``: the text of a document, or what becomes one; SI units.
    next : str
        The command that follows, or what to do.
    verdict : str
        First line; "" (default): none.
    details : sequence of str, optional
        All lines, printed instead of `lines` with ``-v``; default: `lines`.
    passed : bool
        Whether the exit code is 0, else 1; default True.
    """

    lines: Sequence[str]
    document: str | Mapping[str, Any]
    next: str
    verdict: str = ""
    details: Sequence[str] | None = None
    passed: bool = True

    def show(self, *, as_document: bool, verbose: bool) -> None:
        """Print the result."""
        if as_document:
            text = self.document if isinstance(self.document, str) else json.dumps(_finite(self.document), indent=2)
            _say(*text.splitlines(), most=sys.maxsize)
            return
        everything = list(self.lines if self.details is None else self.details)
        lines = everything if verbose else list(self.lines)
        if not verbose and self.verdict:
            kept = lines if len(lines) <= MOST_LINES else lines[: MOST_LINES - 1]
            left_out = len(everything) - len(kept)
            if left_out > 0 and len(kept) < MOST_LINES:
                kept = [*kept, f"({left_out} more lines with -v)"]
            lines = kept
        _say(*([self.verdict] if self.verdict else []), *lines, f"next: {self.next}")


def _finite(value: Any) -> Any:
    """Return a value of a document with null for every number that JSON does not have."""
    if isinstance(value, Mapping):
        return {key: _finite(each) for key, each in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(each) for each in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _command_line(*words: object) -> str:
    """Return a command that can be typed."""
    return shlex.join(str(word) for word in words)


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
        _say(f"slpi {found}")
        parser.exit()


class _Parser(argparse.ArgumentParser):
    """Argument parser that reports usage errors on one line."""

    def error(self, message: str) -> NoReturn:
        self.exit(2, f"{self.prog}: {shown(message)} (see {self.prog} --help)\n")


class _UniqueNames(argparse.Action):
    """Store a list of names and reject duplicates."""

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
                raise argparse.ArgumentError(self, f"'{name}' is given more than once; name each axis once")
        setattr(namespace, self.dest, names)


def parser(command: str | None = None) -> argparse.ArgumentParser:
    """Return the parser of all commands; its result contains the name of the chosen command as ``command``.

    Parameters
    ----------
    command : str, optional
        Add the options of this command only; default: of all commands.
    """
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
            help=each.help,
            description=f"{each.help[0].upper()}{each.help[1:]}.",
            epilog=_epilog(each.example),
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )
        if command in (None, name):
            each.options(own)
            own.add_argument("--json", action="store_true", help="print one JSON document, in SI units; default: text")
            own.add_argument("-v", "--verbose", action="store_true", help="print every line; default: the main ones")
    return whole


def _epilog(example: str) -> str:
    return f"example:\n  {example}"


def _import_options(command: Any) -> None:
    command.add_argument(
        "table", metavar="DATA.csv|DATA.mat",
        help="columns separated by comma, semicolon or tab; names include the unit: x_nm, x (nm), x [nm] or x in nm",
    )  # fmt: skip
    _output(command, "BAG", "folder of the new bag")
    command.add_argument("--time", metavar="COLUMN", help="default: the column whose name starts with 'time'")
    command.add_argument(
        "--voltage", metavar="COLUMN", nargs="+", default=(),
        help="one for all axes or one per axis; default: the columns in volts",
    )  # fmt: skip
    command.add_argument(
        "--displacement", metavar="COLUMN", nargs="+", default=(),
        help="one column per axis; default: the columns in units of length",
    )  # fmt: skip
    command.add_argument(
        "--displacement-unit", help="m, mm, um, nm or pm, for columns without a unit in the name; default: um"
    )
    command.add_argument(
        "--axes", metavar="NAME", nargs="+", default=(), help="names of the axes; default: from the column names"
    )
    command.add_argument("--hardware-id", metavar="ID", default="", help="identifier of the stage; default: none")
    command.add_argument(
        "--storage", choices=("mcap", "sqlite3"), default="mcap", help="file format of the bag; default: mcap"
    )


def _identify_options(command: Any) -> None:
    from slpi_ros.identification.fit import KINDS

    command.add_argument("bags", metavar="BAG", nargs="+", help="rosbag2 folder, or a single mcap or sqlite3 file")
    _output(command, "MODEL.json", "model document to write")
    command.add_argument("--kind", choices=KINDS, default="slpi", help="kind of model; default: slpi")
    command.add_argument(
        "--loops-at-rest",
        action="store_true",
        help="slpi-published: operators start at rest, as published; default: no",
    )
    _topic_options(command)
    _axes(command, help="default: every axis of the bag")
    _span(command)
    _sensor(command, "0")
    command.add_argument(
        "--report", metavar="DIR", help="also write a report with plots of the first bag; default: none"
    )
    command.add_argument(
        "--uncertainty", action="store_true", help="also print the uncertainty of the curves; default: no"
    )


def _diagnose_options(command: Any) -> None:
    command.add_argument(
        "bags", metavar="BAG", nargs="+",
        help="rosbag2 folder, or a single mcap or sqlite3 file; several records allow cross-validation of each cause",
    )  # fmt: skip
    command.add_argument("--model", metavar="MODEL.json", required=True, help="of the same stage")
    _output(command, "DIR", "folder of diagnosis.json, extended_model.json and report.html")
    _topic_options(command)
    _axes(command, help="default: every axis that bag and model share")
    _span(command)
    _sensor(command)


def _verify_options(command: Any) -> None:
    from slpi_ros.io.bag_reader import DESIRED

    command.add_argument("bags", metavar="BAG", nargs="+", help="rosbag2 folder, or a single mcap or sqlite3 file")
    command.add_argument("--model", metavar="MODEL.json", required=True, help="model of the same stage")
    command.add_argument(
        "--tolerance", metavar="UM", type=float,
        help="largest rms error that passes, micrometres; default: three times the repeatability floor of the record, "
        "at least 0.02 %% of the stroke",
    )  # fmt: skip
    _output(command, "DIR", "folder of verification.json and report.html; default: none", required=False)
    command.add_argument(
        "--desired-topic", metavar="TOPIC",
        help=f"also evaluate the tracking error against this topic; default: {DESIRED}, if present in the bag",
    )  # fmt: skip
    _topic_options(command)
    _axes(command, help="default: every axis that bags and model share")
    _sensor(command)


def _output(command: Any, metavar: str, text: str, *, required: bool = True) -> None:
    command.add_argument("-o", "--output", metavar=metavar, required=required, help=text)
    command.add_argument(
        "--overwrite", action="store_true", help="replace outputs that slpi did not write; default: refuse to"
    )


def _axes(command: Any, **options: Any) -> None:
    command.add_argument("--axis", metavar="NAME", nargs="+", action=_UniqueNames, **options)


def _span(command: Any) -> None:
    command.add_argument(
        "--start", metavar="S", type=_seconds, help="start of the fit, s from the first stamp; default: 0"
    )
    command.add_argument(
        "--stop", metavar="S", type=_seconds, help="end of the fit, s from the first stamp; default: the last"
    )


def _sensor(command: Any, default: str = "that of the model") -> None:
    command.add_argument(
        "--sensor-delay", metavar="S", type=_sensor_seconds,
        help=f"known delay of the sensor, s, taken out of its readings; default: {default}",
    )  # fmt: skip
    command.add_argument(
        "--sensor-lag", metavar="S", type=_sensor_seconds,
        help=f"known time constant of the sensor's low-pass filter, s, taken out of its readings; default: {default}",
    )  # fmt: skip


def _sensor_seconds(text: str) -> float:
    """Return a delay or lag of a sensor, seconds."""
    from slpi_ros.model.sensor import LONGEST

    seconds = _seconds(text)
    if not 0.0 <= seconds <= LONGEST:
        raise argparse.ArgumentTypeError(f"{text} s; give seconds from 0 to {LONGEST:g}, such as 0.002 for 2 ms")
    return seconds


def _seconds(text: str) -> float:
    """Return a finite number of seconds."""
    try:
        seconds = float(text)
    except ValueError:
        seconds = math.nan
    if not math.isfinite(seconds):
        raise argparse.ArgumentTypeError(
            f"{text!r} is no time; give a finite number of seconds, or leave the option out"
        )
    return seconds


def _topic_options(command: Any) -> None:
    command.add_argument("--topic", help=f"topic with voltage and displacement; default: {TOPIC}")
    command.add_argument(
        "--voltage-topic", metavar="TOPIC", help="for bags with separate topics: the voltage; default: none"
    )
    command.add_argument(
        "--displacement-topic", metavar="TOPIC", help="for separate topics: the displacement; default: none"
    )
    clocks = ("displacement", "voltage")
    command.add_argument("--clock", choices=clocks, help=f"for separate topics: sample times; default: {clocks[0]}")
    command.add_argument(
        "--voltage-measured", action="store_true", help="voltage is measured: interpolate it; default: hold it"
    )


def _excite_options(command: Any) -> None:
    from slpi_ros.excitation.drives import DRIVES

    _output(command, "DRIVE.csv", "columns time_s, <axis>_V")
    _axes(command, default=("x",), help="axes to excite, one after the other; default: x")
    command.add_argument("--voltage-min", metavar="V", type=float, required=True, help="lowest voltage")
    command.add_argument("--voltage-max", metavar="V", type=float, required=True, help="highest voltage")
    command.add_argument(
        "--slew", metavar="V/S", type=float,
        help="slew limit, of which the drive uses 80 %%; default: the voltage range in 0.1 s; 0: no limit",
    )  # fmt: skip
    command.add_argument("--duration", metavar="S", type=float, default=30.0, help="duration; default: 30 s")
    command.add_argument("--rate", metavar="HZ", type=float, default=200.0, help="sample rate; default: 200 Hz")
    command.add_argument("--seed", metavar="N", type=int, default=0, help="seed of the random sequence; default: 0")
    command.add_argument(
        "--for", dest="drive", metavar="EFFECT", choices=DRIVES, default=DRIVES[0],
        help=f"effect that the record must distinguish from others: {', '.join(DRIVES[1:])}; default: {DRIVES[0]}",
    )  # fmt: skip


def _refit_options(command: Any) -> None:
    command.add_argument("model", metavar="MODEL.json", help="model to be corrected")
    command.add_argument("bags", metavar="BAG", nargs="+", help="in any order; the oldest record is used first")
    _output(command, "MODEL.json", "may be the input model file")
    command.add_argument("--topic", default=TOPIC, help=f"topic with voltage and displacement; default: {TOPIC}")
    _axes(command, help="default: every axis that bag and model share")
    _span(command)
    _sensor(command)
    command.add_argument(
        "--report", metavar="DIR", help="also write a report with plots of the last bag; default: none"
    )


def _simulate_options(command: Any) -> None:
    command.add_argument("model", metavar="MODEL.json", help="model of the stage")
    command.add_argument("table", metavar="VOLTAGE.csv", help="columns time_s, <axis>_V")
    _output(command, "DISPLACEMENT.csv", "columns time_s, <axis>_m")


def _compensate_options(command: Any) -> None:
    from slpi_ros.model.axis_model import START_MEMORIES

    command.add_argument("model", metavar="MODEL.json", help="model of the stage")
    command.add_argument("table", metavar="DESIRED.csv", help="columns time_s, <axis>_m")
    _output(command, "VOLTAGE.csv", "columns time_s, <axis>_V")
    command.add_argument("--voltage-min", metavar="V", type=float, default=-math.inf, help="default: identified range")
    command.add_argument("--voltage-max", metavar="V", type=float, default=math.inf, help="default: identified range")
    command.add_argument(
        "--slew", metavar="V/S", type=float, default=0.0,
        help="rate limit; the voltage then begins where the stage is; 0 (default): no limit",
    )  # fmt: skip
    command.add_argument(
        "--start-memory", choices=START_MEMORIES, default=START_MEMORIES[0],
        help="initial history of the stage: as at the end of the identified record (default), as at its start, "
        "or reset by a decaying oscillation",
    )  # fmt: skip


def _fleet_options(command: Any) -> None:
    command.add_argument(
        "sources", metavar="SOURCE", nargs="+", help="bag, folder of bags (recursively), or CSV list of bag and stage"
    )
    _output(command, "DIR", "folder of results.parquet, index.html and models; an interrupted run is continued there")
    command.add_argument("--models", metavar="DIR", help="reference models; default: of the first bag of each stage")
    where = command.add_mutually_exclusive_group()
    where.add_argument(
        "--scheduler", metavar="ADDRESS",
        help="of a Dask cluster whose workers see the bags and DIR at the same paths; default: a local cluster",
    )  # fmt: skip
    where.add_argument("--workers", metavar="N", type=int, help="processes of the local cluster; default: one per core")
    command.add_argument(
        "--since", metavar="DATE", help="only bags that begin at or after this date (UTC); default: all"
    )
    command.add_argument("--no-diagnose", action="store_true", help="no search for causes of errors; default: search")
    command.add_argument("--watch", action="store_true", help="go on with bags that are completed later; default: end")
    command.add_argument("--topic", default=TOPIC, help=f"topic with voltage and displacement; default: {TOPIC}")


def _experiments_options(command: Any) -> None:
    _output(command, "DIR", "folder of index.html")
    command.add_argument(
        "--data", metavar="DIR", help="folder of measured records to include in the comparison; default: none"
    )


def _calibrate_options(command: Any) -> None:
    command.add_argument("-o", "--output", metavar="DIR", required=True, help="folder of bags, model and page")
    command.add_argument("--axis", metavar="NAME", nargs="+", default=("x",), action=_UniqueNames, help="default: x")
    command.add_argument("--voltage-min", metavar="V", type=float, required=True, help="lowest voltage")
    command.add_argument("--voltage-max", metavar="V", type=float, required=True, help="highest voltage")
    command.add_argument(
        "--slew", metavar="V/S", type=float, help="slew limit; default: the voltage range in 0.1 s; 0: no limit"
    )


def _doctor_options(command: Any) -> None:
    command.add_argument("bags", metavar="BAG", nargs="*", help="records to be checked; default: none")
    command.add_argument("--model", metavar="MODEL.json", help="model to be checked; default: that on stage_model")
    command.add_argument("--voltage-min", metavar="V", type=float, help="lowest voltage allowed; default: not checked")
    command.add_argument("--voltage-max", metavar="V", type=float, help="highest voltage allowed; default: not checked")
    command.add_argument("--topic", default=TOPIC, help=f"topic with voltage and displacement; default: {TOPIC}")
    command.add_argument(
        "--command-topic", metavar="TOPIC", default=COMMANDS_TOPIC,
        help=f"topic of the voltage commands; default: {COMMANDS_TOPIC}",
    )  # fmt: skip
    command.add_argument("--namespace", metavar="NAME", default="", help="namespace of the stage; default: none")
    command.add_argument(
        "--seconds", metavar="S", type=_seconds, default=3.0, help="time to watch a running graph; default: 3 s"
    )
    command.add_argument("--no-ros", action="store_true", help="check the files only; default: also a running graph")


def _show_options(command: Any) -> None:
    command.add_argument("model", metavar="MODEL.json", help="model to be shown")


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


def _say(*lines: str, most: int = LONGEST_SHOWN) -> None:
    """Print lines of at most `most` characters; that a reader such as `head` has left is no error of the command."""
    try:
        print("\n".join(shown(line, most) for line in lines), flush=True)
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _import(options: argparse.Namespace) -> Result:
    from slpi_ros.io.bag_writer import write_bag
    from slpi_ros.io.columns import ColumnOptions
    from slpi_ros.io.outputs import allow_bag
    from slpi_ros.io.tables import import_with_summary

    columns = ColumnOptions(
        time=options.time,
        voltage=tuple(options.voltage),
        displacement=tuple(options.displacement),
        displacement_unit=options.displacement_unit,
        axes=tuple(options.axes),
    )
    options.remarks += allow_bag(options.output, overwrite=options.overwrite)
    record, lines = import_with_summary(options.table, columns)
    record = replace(record, hardware_id=options.hardware_id)
    # What a link leads to is replaced, not the link.
    place = os.path.realpath(options.output) if options.overwrite else options.output
    write_bag(place, record, storage=options.storage, replace=options.overwrite)
    return Result(
        [f"{options.output}: {len(record)} samples of {', '.join(record.axes)}, {record.t[-1]:.6g} s", *lines],
        {"bag": options.output, "samples": len(record), "axes": list(record.axes), "seconds": float(record.t[-1])},
        _command_line("slpi", "identify", options.output, "-o", "model.json"),
    )


def _identify(options: argparse.Namespace) -> Result:
    from slpi_ros.identification.cross_validation import cross_validate
    from slpi_ros.identification.fit import fit_of, identify
    from slpi_ros.identification.uncertainty import curve_uncertainty, require_known_uncertainty
    from slpi_ros.io.atomic_file import output_folder
    from slpi_ros.io.bag_reader import read_bags
    from slpi_ros.model.document import format_model, save_model
    from slpi_ros.model.sensor import Sensor, corrected
    from slpi_ros.reports.text import describe_model, model_limits, verdict

    topics = _topics(options)
    sensor = Sensor(options.sensor_delay or 0.0, options.sensor_lag or 0.0)
    fit_of(options.kind, loops_at_rest=options.loops_at_rest)
    _allow_model_and_report(options)
    if options.uncertainty:
        require_known_uncertainty(options.kind)
    lines = []
    part = {"start": options.start, "stop": options.stop}
    with output_folder(options.report) if options.report else nullcontext() as folder:
        read = read_bags(options.bags, topics, axes=options.axis)
        records = [corrected(record, dict.fromkeys(record.axes, sensor.undo)) for record in read] if sensor else read
        found = [_assess_record(_told(record, sensor.delay), options) for record in records]
        model = identify(
            read,
            options.kind,
            loops_at_rest=options.loops_at_rest,
            sensor_delay=sensor.delay,
            sensor_lag=sensor.lag,
            **part,
        )
        save_model(model, options.output)
        if folder:
            from slpi_ros.reports.identification import write_report

            truth = {
                axis: cross_validate(records, axis, options.kind, loops_at_rest=options.loops_at_rest, **part)
                for axis in model.axes
            }
            write_report(folder, read[0], model, held_out=truth, found=found[0], **part)
            lines += [f"axis {axis}: {line}" for axis, held_out in truth.items() for line in held_out.lines()]
    if options.uncertainty:
        for axis in model.axes:
            lines.append(f"axis {axis}: {curve_uncertainty(records, axis, options.kind, **part).line()}")
    limits = model_limits(model)
    warned = [line for one in found for line in _finding_lines(one, all_levels=False)]
    told = [line for one in found for line in _finding_lines(one)]
    if limits:
        next_command = _command_line(
            "slpi", "diagnose", *options.bags, "--model", options.output, "-o", "diagnosis", *_same_record(options)
        )
    else:
        next_command = f"slpi verify OTHER_BAG --model {shlex.quote(options.output)}"
    return Result(
        [*warned, *describe_model(model, details=False), *lines],
        format_model(model),
        next_command,
        verdict(limits),
        [*told, *lines, *describe_model(model)],
    )


def _allow_model_and_report(options: argparse.Namespace) -> None:
    """Check that ``-o`` and ``--report`` may be written."""
    from slpi_ros.io.outputs import allow_document

    _require_another_file(options.output, *options.bags)
    options.remarks += allow_document(options.output, "model", overwrite=options.overwrite)
    if options.report:
        _allow_folder(options, options.report, "report.html")


def _allow_folder(options: argparse.Namespace, folder: str, *names: str, inputs: Sequence[str] = ()) -> None:
    """Check that these files may be written into a folder, and that none of them is a bag or one of the inputs."""
    from slpi_ros.io.outputs import allow_folder

    for name in names:
        _require_another_file(str(Path(folder) / name), *options.bags, *inputs)
    options.remarks += allow_folder(folder, *names, overwrite=options.overwrite)


def _same_record(options: argparse.Namespace) -> list[str]:
    """Return the options that select topics, axes and a part of a record, as they were given."""
    words = []
    names = ["topic", "voltage_topic", "displacement_topic", "clock", "start", "stop"]
    # The model of `slpi identify` keeps what is known of the sensor.
    names += [] if options.command == "identify" else ["sensor_delay", "sensor_lag"]
    for name in names:
        value = getattr(options, name, None)
        if value is not None and (name, value) != ("topic", TOPIC):
            words.append(f"--{name.replace('_', '-')}={value}")
    if getattr(options, "voltage_measured", False):
        words.append("--voltage-measured")
    if options.axis:
        words += ["--axis", *options.axis]
    return words


def _with_sensor(model: "StageModel", options: argparse.Namespace) -> "StageModel":
    """Return the model with the delay and lag of the sensor that the options give; remark where these are others."""
    axes = [axis for axis in options.axis or model.axes if axis in model.axes]
    known = model.with_sensor(delay=options.sensor_delay, lag=options.sensor_lag, axes=axes)
    told = [
        f"axis '{axis}': {one.sensor.describe()} given, {model.axes[axis].sensor.describe()} in the model"
        for axis, one in known.axes.items()
        if one.sensor != model.axes[axis].sensor
    ]
    if told:
        options.remarks.append(f"the given timing of the sensor is used: {'; '.join(told)}")
    return known


def _topics(options: argparse.Namespace) -> "str | SeparateTopics":
    """Return the topic or topics of voltage and displacement that the options select."""
    from slpi_ros.io.alignment import SeparateTopics

    voltage, displacement = options.voltage_topic, options.displacement_topic
    if bool(voltage) != bool(displacement):
        raise UsageError("--voltage-topic and --displacement-topic go together; give both, or --topic")
    if voltage and options.topic is not None:
        raise UsageError("--topic excludes --voltage-topic and --displacement-topic; give either the one or the two")
    if voltage:
        held = not options.voltage_measured
        return SeparateTopics(voltage, displacement, clock=options.clock or "displacement", held=held)
    if options.clock or options.voltage_measured:
        raise UsageError("--clock and --voltage-measured require --voltage-topic and --displacement-topic; give both")
    return TOPIC if options.topic is None else str(options.topic)


def _told(record: "Record", delay: float) -> "Record":
    """Return the record without its last `delay` (s), of which a late sensor had not yet told: that is no gap."""
    ends_ns = record.time_ns[-1:] - round(delay * 1e9)
    return record.part(slice(int((record.time_ns <= ends_ns).sum())))


def _assess_record(record: "Record", options: argparse.Namespace) -> "dict[str, list[Finding]]":
    """Return the findings on a record, per axis; print them, and raise IdentificationError, if one prevents a fit."""
    from slpi_ros.identification.record_quality import assess, findings, require_usable

    assessed = {}
    for axis in record.axes:
        assessed[axis] = found = findings(assess(record, axis, start=options.start, stop=options.stop))
        try:
            require_usable(found, f"{record.source}: axis '{axis}'")
        except SlpiError:
            if not options.json:
                _say(*_finding_lines(assessed))
            raise
    return assessed


def _finding_lines(found: "Mapping[str, Sequence[Finding]]", *, all_levels: bool = True) -> list[str]:
    return [
        f"axis {axis}: {finding.level:4} {finding.text}"
        for axis, own in found.items()
        for finding in own
        if all_levels or finding.level != "ok"
    ]


def _diagnose(options: argparse.Namespace) -> Result:
    from slpi_ros.diagnosis.diagnose import diagnose
    from slpi_ros.identification.record_quality import assess, findings, require_usable
    from slpi_ros.io.atomic_file import output_folder
    from slpi_ros.io.bag_reader import require_different, require_one_stage
    from slpi_ros.io.schemas import format_document
    from slpi_ros.model.document import load_model
    from slpi_ros.reports.diagnosis import FILES, PAGE, describe_diagnosis, diagnosis_limits, write_files
    from slpi_ros.reports.text import verdict

    topics = _topics(options)
    require_different(options.bags)
    model = _with_sensor(load_model(options.model), options)
    # The model is not checked: an extended model may be extended again.
    _allow_folder(options, options.output, *FILES)
    with output_folder(options.output, *FILES) as folder:
        records = [_read_all_axes(bag, options, topics) for bag in options.bags]
        require_one_stage(records)
        try:
            axes = options.axis or [axis for axis in model.axes if all(axis in record.axes for record in records)]
            for record, axis in ((record, axis) for record in records for axis in axes):
                record.require_axis(axis)
                model.axis(axis)
                require_usable(findings(assess(record, axis)), f"{record.source}: axis '{axis}'")
            diagnosis = diagnose(records, model, axes=axes, start=options.start, stop=options.stop)
        except UsageError as error:
            # Exit code 1: the mismatch between bag and model is found in the data, not in the call.
            raise ModelError(str(error)) from None
        write_files(folder, diagnosis)
    limits = diagnosis_limits(diagnosis)
    found_any = any(found.effects for found in diagnosis.axes.values())
    page, lines = f"{folder / PAGE}: open it in a browser", describe_diagnosis(diagnosis)
    if found_any or not limits:
        tested = Path(options.output) / "extended_model.json" if found_any else options.model
        next_command = f"slpi verify OTHER_BAG --model {shlex.quote(str(tested))}"
    else:
        experiments = (found.next_experiment for found in diagnosis.axes.values())
        next_command = next(filter(None, experiments), f"slpi show {shlex.quote(options.model)}")
    return Result(
        [*lines[: MOST_LINES - 2], page] if len(lines) >= MOST_LINES else [*lines, page],
        format_document(diagnosis.to_document(), "diagnosis"),
        next_command,
        verdict(limits),
        [*lines, page],
    )


def _read_all_axes(bag: str, options: argparse.Namespace, topics: "str | SeparateTopics") -> "Record":
    """Read all axes of the bag, to identify cross-coupling; only the requested axes if the others are unreadable."""
    from slpi_ros.io.alignment import SeparateTopics
    from slpi_ros.io.bag_reader import read_bag

    if options.axis and isinstance(topics, SeparateTopics):
        # Separate topics may not name their axes; the names are then those of the options.
        return read_bag(bag, topics, axes=options.axis)
    try:
        return read_bag(bag, topics)
    except RecordError:
        if not options.axis:
            raise
        return read_bag(bag, topics, axes=options.axis)


def _verify(options: argparse.Namespace) -> Result:
    from slpi_ros.diagnosis.verify import verify
    from slpi_ros.io.alignment import SeparateTopics
    from slpi_ros.io.atomic_file import output_folder
    from slpi_ros.io.bag_reader import read_bags, read_desired
    from slpi_ros.io.schemas import format_document
    from slpi_ros.model.document import load_model
    from slpi_ros.reports.text import verdict
    from slpi_ros.reports.verification import (
        FILES,
        describe_verification,
        verification_good,
        verification_limits,
        write_files,
    )

    topics = _topics(options)
    if options.tolerance is not None and not 0.0 < options.tolerance < math.inf:
        raise UsageError(f"--tolerance {options.tolerance:g}: give a positive number of micrometres")
    model = _with_sensor(load_model(options.model), options)
    if options.output is not None:
        _allow_folder(options, options.output, *FILES, inputs=[options.model])
    # Read all axes because of cross-coupling; separate topics may not name their axes, so the options name them.
    axes = options.axis if isinstance(topics, SeparateTopics) else None
    with nullcontext() if options.output is None else output_folder(options.output, *FILES) as folder:
        records = read_bags(options.bags, topics, axes=axes)
        desired = [
            read_desired(bag, record, options.desired_topic) for bag, record in zip(options.bags, records, strict=True)
        ]
        tolerance = None if options.tolerance is None else 1e-6 * options.tolerance
        try:
            found = verify(records, model, tolerance, axes=options.axis, desired=desired)
        except UsageError as error:
            # Exit code 1: the mismatch between bags and model is found in the data, not in the call.
            raise ModelError(str(error)) from None
        if folder:
            write_files(folder, found)
    if found.passed:
        next_command = f"slpi compensate {shlex.quote(options.model)} DESIRED.csv -o VOLTAGE.csv"
    else:
        next_command = _command_line(
            "slpi", "diagnose", *options.bags, "--model", options.model, "-o", "diagnosis", *_same_record(options)
        )
    return Result(
        describe_verification(found, details=False),
        format_document(found.to_document(), "verification"),
        next_command,
        verdict(verification_limits(found), verification_good(found)),
        describe_verification(found),
        found.passed,
    )


def _excite(options: argparse.Namespace) -> Result:
    from slpi_ros.excitation.drives import SLEW_USED, excite, slew_limits
    from slpi_ros.io.outputs import allow_table
    from slpi_ros.io.tables import table_header, write_table

    _require_axis_names(options.axis)
    options.remarks += allow_table(options.output, table_header(options.axis, "V"), overwrite=options.overwrite)
    (slew,) = slew_limits(
        None if options.slew is None else (options.slew,), (options.voltage_min,), (options.voltage_max,)
    )
    drive = excite(
        options.axis,
        voltage_min=options.voltage_min,
        voltage_max=options.voltage_max,
        slew_limit=SLEW_USED * slew,
        duration=options.duration,
        rate=options.rate,
        seed=options.seed,
        drive=options.drive,
    )
    write_table(options.output, drive.t, drive.voltage, "V")
    return Result(
        [f"{options.output}: {drive.t.size} voltages in {drive.t[-1]:.6g} s; {drive.why}"],
        {"table": options.output, "samples": drive.t.size, "seconds": float(drive.t[-1]), "why": drive.why},
        "slpi import DATA.csv -o BAG, with DATA.csv the voltage and the displacement measured during this drive",
    )


def _refit(options: argparse.Namespace) -> Result:
    from slpi_ros.identification.refit import refit
    from slpi_ros.io.atomic_file import output_folder
    from slpi_ros.io.bag_reader import read_bags
    from slpi_ros.model.document import load_model, save_model
    from slpi_ros.reports.text import change_limits, describe_change, verdict

    _allow_model_and_report(options)
    model, lines, document = _with_sensor(load_model(options.model), options), [], []
    last: dict[str, AxisChange] = {}
    part = {"start": options.start, "stop": options.stop}
    # Each record corrects the model that the earlier ones have given.
    for record in sorted(read_bags(options.bags, options.topic), key=lambda record: int(record.time_ns[0])):
        report_progress(f"refit to {record.source}")
        model, last = refit(model, record, axes=options.axis, **part)
        of_record = f"{record.source}: " if len(options.bags) > 1 else ""
        lines += [of_record + line for axis, change in last.items() for line in describe_change(axis, change)]
        document.append({"source": record.source, "axes": {axis: _numbers(change) for axis, change in last.items()}})
    with output_folder(options.report) if options.report else nullcontext() as folder:
        if folder:
            from slpi_ros.reports.identification import write_report

            drawn = {axis: model.axes[axis] for axis in last}
            write_report(folder, record, replace(model, axes=drawn), **part)
        save_model(model, options.output)
    limits = change_limits(last, model)
    return Result(
        lines,
        {"model": options.output, "records": document},
        f"slpi verify OTHER_BAG --model {shlex.quote(options.output)}",
        verdict(limits, "at the repeatability of the stage"),
    )


def _numbers(change: "AxisChange") -> dict[str, float | bool | None]:
    """Return the figures of a refit of one axis: metres and shares."""
    match = change.match
    return {
        "error_before_rms_m": change.error_before,
        "error_after_rms_m": change.error_after,
        "repeatability_m": change.repeatability,
        "changed": bool(change.drifted),
        "gain_change": change.gain,
        "largest_change_m": change.largest,
        "offset_m": match.offset,
        "offset_uncertainty_m": match.offset_uncertainty,
        "zero_moved": bool(match.zero_moved),
    }


def _simulate(options: argparse.Namespace) -> Result:
    from slpi_ros.io.outputs import allow_table
    from slpi_ros.io.tables import read_table, table_header, write_table
    from slpi_ros.model.document import load_model

    _require_another_file(options.output, options.model, options.table)
    model = load_model(options.model)
    t, voltage = read_table(options.table, "V")
    known = _model_columns(voltage, model, options.table)
    options.remarks += allow_table(options.output, table_header(known, "m"), overwrite=options.overwrite)
    reached = model.simulate(t, known)
    write_table(options.output, t, reached, "m")
    for axis, v in known.items():
        low, high = model.axes[axis].voltage_range
        outside = int(((v < low) | (v > high)).sum())
        if outside:
            options.remarks.append(
                f"axis '{axis}': {outside} of {v.size} voltages lie outside the identified {low:.4g} to {high:.4g} V; "
                "there the model extrapolates"
            )
    ranges = {axis: (float(y.min()), float(y.max())) for axis, y in reached.items()}
    return Result(
        [f"axis {axis}: {low * 1e6:.4g} to {high * 1e6:.4g} µm" for axis, (low, high) in ranges.items()],
        {"table": options.output, "samples": t.size, "displacement_range_m": {a: list(r) for a, r in ranges.items()}},
        _command_line("slpi", "compensate", options.model, options.output, "-o", "VOLTAGE.csv"),
    )


def _compensate(options: argparse.Namespace) -> Result:
    import numpy as np

    from slpi_ros.io.outputs import allow_table
    from slpi_ros.io.tables import read_table, table_header, write_table
    from slpi_ros.model.document import load_model
    from slpi_ros.model.limits import MAX_DT, Limits
    from slpi_ros.model.stage_model import check_time, held_message
    from slpi_ros.reports.text import describe_start

    _require_another_file(options.output, options.model, options.table)
    model = load_model(options.model)
    t, desired = read_table(options.table, "m")
    check_time(t)
    known = _model_columns(desired, model, options.table)
    options.remarks += allow_table(options.output, table_header(known, "V"), overwrite=options.overwrite)
    if options.slew < 0.0 or math.isnan(options.slew):
        raise UsageError(f"--slew {options.slew:g}: give a positive number of V/s, or 0 for no limit")
    limits = Limits(options.voltage_min, options.voltage_max, options.slew or math.inf)
    try:
        answers = model.command(t, known, limits, options.start_memory)
    except SlpiError as error:
        raise type(error)(f"{options.table}, {error}") from None
    for axis, (_, held) in answers.items():
        if held.any():
            options.remarks.append(f"axis '{axis}': {held_message(held)}")
    write_table(options.output, t, {axis: v for axis, (v, _) in answers.items()}, "V")
    lines = [describe_start(model, answers, options.start_memory)]
    document: dict[str, Any] = {"table": options.output, "samples": t.size, "axes": {}}
    for axis, (v, held) in answers.items():
        start = model.axes[axis].initial(options.start_memory)
        jump, (low, high) = float(v[0] - start.voltage), model.axes[axis].voltage_range
        # The largest step between samples that the slew limit allows; a longer pause counts as MAX_DT.
        most = options.slew * np.minimum(np.diff(t), MAX_DT)
        limited = int(np.count_nonzero(np.abs(np.diff(v)) >= most * (1.0 - 1e-9))) if options.slew else 0
        if abs(jump) > SMALLEST_JUMP * (high - low):
            lines.append(
                f"axis {axis}: the first sample jumps by {jump:+.4g} V, to {known[axis][0] * 1e6:.4g} µm from "
                f"{start.displacement * 1e6:.6g} µm; begin the path there, or give --slew"
            )
        if limited:
            lines.append(f"axis {axis}: {limited} of {v.size} samples are at the slew limit; the path is late there")
        document["axes"][axis] = {
            "first_jump_V": jump, "held": int(held.sum()), "slew_limited": limited,
            "voltage_range_V": [float(v.min()), float(v.max())],
        }  # fmt: skip
    return Result(
        lines,
        document,
        _command_line("slpi", "simulate", options.model, options.output, "-o", "REACHED.csv"),
    )


def _require_another_file(output: str, *inputs: str) -> None:
    """Raise UsageError if the output file is one of the inputs, or lies in the folder of an input bag."""
    for path in map(Path, inputs):
        # Of a link that leads to itself, `Path.resolve` makes an error of its own.
        within = path.is_dir() and Path(os.path.realpath(path)) in Path(os.path.realpath(output)).parents
        if within or (path.exists() and Path(output).exists() and path.samefile(output)):
            raise UsageError(f"{output}: is also read from; give another output (-o)")


def _model_columns(columns: "dict[str, FloatArray]", model: "StageModel", table: str) -> "dict[str, FloatArray]":
    """Return the columns of a table; SlpiError if the model lacks one of their axes."""
    for axis in columns:
        if axis not in model.axes:
            raise SlpiError(
                f"{table}: column of axis '{axis}', but the model has axes {', '.join(model.axes)}; rename the column"
            )
    return columns


def _fleet(options: argparse.Namespace) -> Result:
    from slpi_ros.fleet.pages import DOCUMENT, PAGE, report_fleet
    from slpi_ros.fleet.results import JOURNAL, TABLE
    from slpi_ros.io.outputs import allow_folder

    for source in [*options.sources, *filter(None, [options.models])]:
        if os.path.realpath(source) == os.path.realpath(options.output):
            raise UsageError(f"{options.output}: is also read from; give another output (-o)")
    options.remarks += allow_folder(options.output, PAGE, DOCUMENT, TABLE, JOURNAL, overwrite=options.overwrite)
    lines, usable = report_fleet(
        options.sources,
        options.output,
        as_document=options.json,
        told=lambda text: print(text, file=sys.stderr),
        scheduler=options.scheduler,
        workers=options.workers,
        models=options.models,
        since=options.since,
        diagnose=not options.no_diagnose,
        watch=options.watch,
        topic=options.topic,
    )
    text = "\n".join(lines)
    return Result(text.splitlines(), text, "slpi refit MODEL.json BAG... of a stage that has changed", passed=usable)


def _experiments(options: argparse.Namespace) -> Result:
    from slpi_ros.io.outputs import allow_folder
    from slpi_ros.papers.page import COLUMNS, PAGE, TABLE, write_experiments

    data = Path(options.data) if options.data else None
    if data and not data.is_dir():
        raise UsageError(f"{data}: no such folder; give the folder of the measured records, or leave --data out")
    options.remarks += allow_folder(options.output, PAGE, tables={TABLE: COLUMNS}, overwrite=options.overwrite)
    page = write_experiments(Path(options.output), data)
    return Result([f"{page}: the tables and figures"], {"page": str(page)}, f"open {page} in a browser")


def _show(options: argparse.Namespace) -> Result:
    from slpi_ros.model.document import format_model, load_model
    from slpi_ros.reports.text import describe_model, model_limits, verdict

    model = load_model(options.model)
    limits, own = model_limits(model), shlex.quote(options.model)
    return Result(
        describe_model(model, details=False),
        format_model(model),
        f"slpi diagnose BAG... --model {own} -o diagnosis" if limits else f"slpi verify OTHER_BAG --model {own}",
        verdict(limits),
        describe_model(model),
    )


def _doctor(options: argparse.Namespace) -> Result:
    from importlib.util import find_spec

    from slpi_ros.io.bag_reader import read_bag
    from slpi_ros.model.document import load_model
    from slpi_ros.reports.doctor import (
        MEND,
        NOTE,
        Check,
        check_graph,
        check_model,
        check_record,
        described,
        doctor_document,
    )

    limits = None
    if (options.voltage_min is None) != (options.voltage_max is None):
        raise UsageError("--voltage-min and --voltage-max go together; give both or none")
    if options.voltage_min is not None:
        if not -math.inf < options.voltage_min < options.voltage_max < math.inf:
            raise UsageError(f"--voltage-min {options.voltage_min:g}: give a voltage below --voltage-max")
        limits = options.voltage_min, options.voltage_max
    if not 0.0 < options.seconds <= LONGEST_WATCH:
        raise UsageError(f"--seconds {options.seconds:g}: give a time of up to {LONGEST_WATCH:g} s")
    checks, model, files = [], None, [*options.bags, *filter(None, [options.model])]
    if options.model:
        try:
            model = load_model(options.model)
            checks += check_model(model, limits)
        except SlpiError as error:
            checks.append(Check(MEND, str(error)))
    for bag in options.bags:
        report_progress(f"reading {bag}")
        try:
            checks += check_record(read_bag(bag, options.topic), model, limits)
        except SlpiError as error:
            checks.append(Check(MEND, str(error)))
    if options.no_ros or find_spec("rclpy") is None:
        why = "--no-ros" if options.no_ros else "no rclpy; source the setup file of ROS 2 to check a running graph"
        checks.append(Check(NOTE if files or options.no_ros else MEND, f"ROS: not checked: {why}"))
    else:
        from slpi_ros.nodes.graph_probe import probe

        report_progress("watching the ROS graph")
        graph = probe(options.topic, options.command_topic, options.namespace, options.seconds)
        if graph.nodes or not files:
            checks += check_graph(graph, model)
        else:
            checks.append(Check(NOTE, "ROS: no node is running; only the files were checked"))
    verdict, lines, details = described(checks)
    well = not any(check.level == MEND for check in checks)
    if not well:
        next_command = _command_line("slpi", "doctor", *options.bags, *(["--model", options.model] if model else []))
    elif options.bags and model is None:
        next_command = _command_line("slpi", "identify", *options.bags, "-o", "model.json")
    elif options.bags:
        next_command = _command_line("slpi", "verify", *options.bags, "--model", options.model)
    elif model is not None:
        next_command = f"slpi verify OTHER_BAG --model {shlex.quote(options.model)}"
    else:
        next_command = "slpi calibrate -o DIR --voltage-min V --voltage-max V"
    return Result(lines, doctor_document(checks), next_command, verdict, details, well)


def _require_axis_names(axes: Sequence[str]) -> None:
    """Raise UsageError for something that is no name of a new axis."""
    from slpi_ros.io.record import is_axis_name

    for axis in axes:
        if "," in axis or not axis.strip() or not is_axis_name(axis):
            raise UsageError(f"--axis {axis!r}: no name of an axis; for two axes write --axis x y")


def _calibrate(options: argparse.Namespace) -> Result:
    from slpi_ros.excitation.drives import slew_limits
    from slpi_ros.excitation.legs import DriveSpec

    _require_axis_names(options.axis)
    (slew,) = slew_limits(
        None if options.slew is None else (options.slew,), (options.voltage_min,), (options.voltage_max,)
    )
    DriveSpec(options.voltage_min, options.voltage_max, duration=1.0, rate=1.0, slew_limit=slew)
    given = {
        "axes": "['" + "', '".join(options.axis) + "']",
        "voltage_min": options.voltage_min,
        "voltage_max": options.voltage_max,
        "slew_limit": slew,
        "output": Path(options.output).absolute(),
    }
    command = "ros2 run slpi_ros calibrator --ros-args " + " ".join(
        f'-p "{key}:={value}"' for key, value in given.items()
    )
    return Result(
        ["Where ROS 2 and the driver of the stage run, with nobody else publishing voltage_command:", command],
        {"command": command},
        _command_line("slpi", "show", Path(options.output) / "model.json"),
    )


@dataclass(frozen=True)
class _Command:
    """One command: help text, example, function that adds its options to a parser, and function that runs it."""

    help: str
    example: str
    options: Callable[[Any], None]
    run: Callable[[argparse.Namespace], Result]


COMMANDS: Mapping[str, _Command] = {
    "import": _Command(
        "turn a table of measured data into a bag",
        "slpi import data.csv -o calibration",
        _import_options,
        _import,
    ),
    "identify": _Command(
        "identify the model of a stage from a bag",
        "slpi identify calibration -o model.json --report report",
        _identify_options,
        _identify,
    ),
    "diagnose": _Command(
        "find the causes of a model's errors on bags and extend the model",
        "slpi diagnose calibration check --model model.json -o diagnosis",
        _diagnose_options,
        _diagnose,
    ),
    "verify": _Command(
        "test a model on bags not used to identify it: pass or fail",
        "slpi verify check --model model.json --tolerance 0.05",
        _verify_options,
        _verify,
    ),
    "excite": _Command(
        "generate excitation voltages for an identification",
        "slpi excite -o drive.csv --voltage-min 0 --voltage-max 100",
        _excite_options,
        _excite,
    ),
    "refit": _Command(
        "update a model with new bags, keeping regions that these do not visit",
        "slpi refit model.json monday -o model.json",
        _refit_options,
        _refit,
    ),
    "fleet": _Command(
        "identify, verify and follow many stages from many bags, on Dask",
        "slpi fleet bags -o fleet --workers 4",
        _fleet_options,
        _fleet,
    ),
    "simulate": _Command(
        "compute the displacement for a voltage",
        "slpi simulate model.json voltage.csv -o displacement.csv",
        _simulate_options,
        _simulate,
    ),
    "compensate": _Command(
        "compute the voltage for a desired displacement",
        "slpi compensate model.json desired.csv -o voltage.csv --slew 1000",
        _compensate_options,
        _compensate,
    ),
    "doctor": _Command(
        "check bags, a model and a running ROS graph, and say what to mend",
        "slpi doctor calibration --model model.json",
        _doctor_options,
        _doctor,
    ),
    "calibrate": _Command(
        "print how to let a stage calibrate itself",
        "slpi calibrate -o my_stage --voltage-min 0 --voltage-max 100",
        _calibrate_options,
        _calibrate,
    ),
    "experiments": _Command(
        "reproduce the tables and figures of the two papers",
        "slpi experiments -o experiments",
        _experiments_options,
        _experiments,
    ),
    "show": _Command(
        "print the contents of a model",
        "slpi show model.json",
        _show_options,
        _show,
    ),
}


if __name__ == "__main__":
    sys.exit(main())
