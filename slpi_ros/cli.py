"""The command line ``slpi``, usable without a running ROS graph.

Exit codes: 0 success, 1 the data do not allow the request or a verification failed, 2 wrong usage. Errors are reported
on one line.
"""

import argparse
import math
import sys
import warnings
from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, replace
from functools import partial
from io import TextIOWrapper
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

from slpi_ros.errors import ModelError, RecordError, SlpiError, UsageError
from slpi_ros.identification.progress import shown_on

# Each command imports its modules when it runs: the numerical and plotting modules load slowly.
if TYPE_CHECKING:
    from slpi_ros.identification.record_quality import Finding
    from slpi_ros.io.alignment import SeparateTopics
    from slpi_ros.io.record import FloatArray, Record
    from slpi_ros.model.stage_model import StageModel

# Default topic with voltage and displacement.
TOPIC = "stage_state"


class _Parser(argparse.ArgumentParser):
    """Argument parser that reports usage errors on one line."""

    def error(self, message: str) -> NoReturn:
        self.exit(2, f"{self.prog}: {message} (see {self.prog} --help)\n")


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
    whole = _Parser(prog="slpi", description="Hysteresis models of piezo stages: identify, diagnose, compensate.")
    commands = whole.add_subparsers(dest="command", required=True, metavar="COMMAND", parser_class=_Parser)
    for name, each in COMMANDS.items():
        own = commands.add_parser(name, help=each.help)
        if command in (None, name):
            each.options(own)
    return whole


def _import_options(command: Any) -> None:
    command.add_argument(
        "table", metavar="DATA.csv|DATA.mat",
        help="columns separated by comma, semicolon or tab; names include the unit: x_nm, x (nm), x [nm] or x in nm",
    )  # fmt: skip
    command.add_argument("-o", "--output", metavar="BAG", required=True, help="folder of the new bag")
    command.add_argument("--time", metavar="COLUMN", help="default: the column whose name starts with 'time'")
    command.add_argument("--voltage", metavar="COLUMN", nargs="+", default=(), help="one for all axes or one per axis")
    command.add_argument("--displacement", metavar="COLUMN", nargs="+", default=(), help="one column per axis")
    command.add_argument(
        "--displacement-unit", help="m, mm, um, nm or pm, for columns without a unit in the name; default: um"
    )
    command.add_argument(
        "--axes", metavar="NAME", nargs="+", default=(), help="names of the axes; default: from the column names"
    )
    command.add_argument("--hardware-id", metavar="ID", default="", help="identifier of the stage; default: none")
    command.add_argument("--storage", choices=("mcap", "sqlite3"), default="mcap")


def _identify_options(command: Any) -> None:
    from slpi_ros.identification.fit import KINDS

    command.add_argument("bags", metavar="BAG", nargs="+", help="rosbag2 folder, or a single mcap or sqlite3 file")
    command.add_argument("-o", "--output", metavar="MODEL.json", required=True, help="model document to write")
    command.add_argument("--kind", choices=KINDS, default="slpi", help="kind of model; default: slpi")
    command.add_argument(
        "--loops-at-rest", action="store_true", help="slpi-published: operators start at rest, as published"
    )
    _topic_options(command)
    _axes(command, help="default: every axis of the bag")
    _span(command)
    command.add_argument("--report", metavar="DIR", help="also write a report with plots of the first bag")
    command.add_argument("--uncertainty", action="store_true", help="also print the uncertainty of the curves")


def _diagnose_options(command: Any) -> None:
    command.add_argument(
        "bags", metavar="BAG", nargs="+",
        help="rosbag2 folder, or a single mcap or sqlite3 file; several records allow cross-validation of each cause",
    )  # fmt: skip
    command.add_argument("--model", metavar="MODEL.json", required=True, help="of the same stage")
    command.add_argument(
        "-o", "--output", metavar="DIR", required=True,
        help="folder of diagnosis.json, extended_model.json and report.html",
    )  # fmt: skip
    _topic_options(command)
    _axes(command, help="default: every axis that bag and model share")
    _span(command)


def _verify_options(command: Any) -> None:
    from slpi_ros.io.bag_reader import DESIRED

    command.add_argument("bags", metavar="BAG", nargs="+", help="rosbag2 folder, or a single mcap or sqlite3 file")
    command.add_argument("--model", metavar="MODEL.json", required=True, help="model of the same stage")
    command.add_argument(
        "--tolerance", metavar="UM", type=float,
        help="largest rms error that passes, micrometres; default: three times the repeatability floor of the record, "
        "at least 0.02 %% of the stroke",
    )  # fmt: skip
    command.add_argument("-o", "--output", metavar="DIR", help="folder of verification.json and report.html")
    command.add_argument("--json", action="store_true", help="print the document instead of its summary")
    command.add_argument(
        "--desired-topic", metavar="TOPIC",
        help=f"also evaluate the tracking error against this topic; default: {DESIRED}, if present in the bag",
    )  # fmt: skip
    _topic_options(command)
    _axes(command, help="default: every axis that bags and model share")


def _axes(command: Any, **options: Any) -> None:
    command.add_argument("--axis", metavar="NAME", nargs="+", action=_UniqueNames, **options)


def _span(command: Any) -> None:
    command.add_argument("--start", metavar="S", type=float, help="start of the fit, seconds from the first stamp")
    command.add_argument("--stop", metavar="S", type=float, help="end of the fit, seconds from the first stamp")


def _topic_options(command: Any) -> None:
    command.add_argument("--topic", help=f"topic with voltage and displacement; default: {TOPIC}")
    command.add_argument("--voltage-topic", metavar="TOPIC", help="for bags with separate topics: the voltage")
    command.add_argument("--displacement-topic", metavar="TOPIC", help="for separate topics: the displacement")
    clocks = ("displacement", "voltage")
    command.add_argument("--clock", choices=clocks, help=f"for separate topics: sample times; default: {clocks[0]}")
    command.add_argument("--voltage-measured", action="store_true", help="voltage is measured: interpolate it")


def _excite_options(command: Any) -> None:
    from slpi_ros.excitation.drives import DRIVES

    command.add_argument("-o", "--output", metavar="DRIVE.csv", required=True, help="columns time_s, <axis>_V")
    _axes(command, default=("x",), help="axes to excite, one after the other; default: x")
    command.add_argument("--voltage-min", metavar="V", type=float, required=True, help="lowest voltage")
    command.add_argument("--voltage-max", metavar="V", type=float, required=True, help="highest voltage")
    command.add_argument("--slew", metavar="V/S", type=float, default=0.0, help="rate limit; 0 (default): no limit")
    command.add_argument("--duration", metavar="S", type=float, default=30.0, help="duration; default: 30 s")
    command.add_argument("--rate", metavar="HZ", type=float, default=200.0, help="sample rate; default: 200 Hz")
    command.add_argument("--seed", metavar="N", type=int, default=0, help="seed of the random sequence; default: 0")
    command.add_argument(
        "--for", dest="drive", metavar="EFFECT", choices=DRIVES, default=DRIVES[0],
        help=f"effect that the record must distinguish from others: {', '.join(DRIVES[1:])}",
    )  # fmt: skip


def _refit_options(command: Any) -> None:
    command.add_argument("model", metavar="MODEL.json")
    command.add_argument("bag", metavar="BAG")
    command.add_argument("-o", "--output", metavar="MODEL.json", required=True, help="may be the input model file")
    command.add_argument("--topic", default=TOPIC, help=f"topic with voltage and displacement; default: {TOPIC}")


def _simulate_options(command: Any) -> None:
    command.add_argument("model", metavar="MODEL.json")
    command.add_argument("table", metavar="VOLTAGE.csv", help="columns time_s, <axis>_V")
    command.add_argument("-o", "--output", metavar="DISPLACEMENT.csv", required=True)


def _compensate_options(command: Any) -> None:
    from slpi_ros.model.axis_model import START_MEMORIES

    command.add_argument("model", metavar="MODEL.json")
    command.add_argument("table", metavar="DESIRED.csv", help="columns time_s, <axis>_m")
    command.add_argument("-o", "--output", metavar="VOLTAGE.csv", required=True)
    command.add_argument("--voltage-min", metavar="V", type=float, default=-math.inf, help="default: identified range")
    command.add_argument("--voltage-max", metavar="V", type=float, default=math.inf, help="default: identified range")
    command.add_argument(
        "--start-memory", choices=START_MEMORIES, default=START_MEMORIES[0],
        help="initial history of the stage: as at the end of the identified record (default), as at its start, "
        "or reset by a decaying oscillation",
    )  # fmt: skip


def _experiments_options(command: Any) -> None:
    command.add_argument("-o", "--output", metavar="DIR", required=True, help="folder of index.html")
    command.add_argument("--data", metavar="DIR", help="folder of measured records to include in the comparison")


def _show_options(command: Any) -> None:
    command.add_argument("model", metavar="MODEL.json")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; return the exit code."""
    arguments = sys.argv[1:] if arguments is None else arguments
    options = parser(arguments[0] if arguments else "").parse_args(arguments)
    for output in (sys.stdout, sys.stderr):
        # Characters that the terminal encoding lacks are printed as escape sequences.
        if isinstance(output, TextIOWrapper):
            output.reconfigure(errors="backslashreplace")
    warnings.showwarning = partial(_show_warning, options.command)
    try:
        with shown_on(sys.stderr):
            return COMMANDS[options.command].run(options) or 0
    except SlpiError as error:
        print(f"slpi {options.command}: {_one_line(error)}", file=sys.stderr)
        return error.exit_code
    except (OSError, MemoryError) as error:
        print(f"slpi {options.command}: {_one_line(error) or 'not enough memory'}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        return 130


def _show_warning(command: str, message: Warning | str, *_: object) -> None:
    print(f"slpi {command}: {' '.join(str(message).split())}", file=sys.stderr)


def _one_line(error: BaseException) -> str:
    return " ".join(str(error).split())


def _import(options: argparse.Namespace) -> None:
    from slpi_ros.io.bag_writer import write_bag
    from slpi_ros.io.columns import ColumnOptions
    from slpi_ros.io.tables import import_with_summary

    columns = ColumnOptions(
        time=options.time,
        voltage=tuple(options.voltage),
        displacement=tuple(options.displacement),
        displacement_unit=options.displacement_unit,
        axes=tuple(options.axes),
    )
    record, lines = import_with_summary(options.table, columns)
    record = replace(record, hardware_id=options.hardware_id)
    write_bag(options.output, record, storage=options.storage)
    print(f"{options.output}: {len(record)} samples of {', '.join(record.axes)}, {record.t[-1]:.6g} s")
    print("\n".join(lines))


def _identify(options: argparse.Namespace) -> None:
    from slpi_ros.identification.cross_validation import cross_validate
    from slpi_ros.identification.fit import fit_of, identify
    from slpi_ros.identification.uncertainty import curve_uncertainty, require_known_uncertainty
    from slpi_ros.io.atomic_file import make_folder
    from slpi_ros.io.bag_reader import read_bags
    from slpi_ros.model.document import save_model
    from slpi_ros.reports.text import describe_model

    topics = _topics(options)
    fit_of(options.kind, loops_at_rest=options.loops_at_rest)
    _require_another_file(options.output, *options.bags)
    target = Path(options.output)
    if target.is_dir() or not target.parent.is_dir():
        raise ModelError(f"{target}: cannot be written: it is a folder, or its parent is missing; choose another place")
    if options.uncertainty:
        require_known_uncertainty(options.kind)
    if options.report:
        make_folder(options.report)
    records = read_bags(options.bags, topics, axes=options.axis)
    found = [_assess_record(record, options) for record in records]
    model = identify(records, options.kind, start=options.start, stop=options.stop, loops_at_rest=options.loops_at_rest)
    save_model(model, options.output)
    lines = []
    part = {"start": options.start, "stop": options.stop}
    if options.report:
        from slpi_ros.reports.identification import write_report

        truth = {
            axis: cross_validate(records, axis, options.kind, loops_at_rest=options.loops_at_rest, **part)
            for axis in model.axes
        }
        write_report(Path(options.report), records[0], model, held_out=truth, found=found[0], **part)
        lines += [f"axis {axis}: {line}" for axis, held_out in truth.items() for line in held_out.lines()]
    if options.uncertainty:
        for axis in model.axes:
            lines.append(f"axis {axis}: {curve_uncertainty(records, axis, options.kind, **part).line()}")
    print("\n".join([*lines, *describe_model(model)]))


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


def _assess_record(record: "Record", options: argparse.Namespace) -> "dict[str, list[Finding]]":
    """Print and return the findings on a record, per axis; IdentificationError if one prevents a fit."""
    from slpi_ros.identification.record_quality import assess, findings, require_usable

    assessed = {}
    for axis in record.axes:
        assessed[axis] = found = findings(assess(record, axis, start=options.start, stop=options.stop))
        print("\n".join(f"axis {axis}: {finding.level:4} {finding.text}" for finding in found))
        require_usable(found, f"{record.source}: axis '{axis}'")
    return assessed


def _diagnose(options: argparse.Namespace) -> None:
    from slpi_ros.diagnosis.diagnose import diagnose
    from slpi_ros.identification.record_quality import assess, findings, require_usable
    from slpi_ros.io.atomic_file import output_folder
    from slpi_ros.io.bag_reader import require_one_stage
    from slpi_ros.model.document import load_model
    from slpi_ros.reports.diagnosis import FILES, PAGE, describe_diagnosis, write_files

    topics = _topics(options)
    model = load_model(options.model)
    for name in FILES:
        # The model is not checked: an extended model may be extended again.
        _require_another_file(str(Path(options.output) / name), *options.bags)
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
    print("\n".join(describe_diagnosis(diagnosis)))
    print(f"{folder / PAGE}: open it in a browser")


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


def _verify(options: argparse.Namespace) -> int:
    from slpi_ros.diagnosis.verify import verify
    from slpi_ros.io.alignment import SeparateTopics
    from slpi_ros.io.atomic_file import output_folder
    from slpi_ros.io.bag_reader import read_bags, read_desired
    from slpi_ros.io.schemas import format_document
    from slpi_ros.model.document import load_model
    from slpi_ros.reports.verification import FILES, describe_verification, write_files

    topics = _topics(options)
    if options.tolerance is not None and not 0.0 < options.tolerance < math.inf:
        raise UsageError(f"--tolerance {options.tolerance:g}: give a positive number of micrometres")
    model = load_model(options.model)
    if options.output is not None:
        for name in FILES:
            _require_another_file(str(Path(options.output) / name), options.model, *options.bags)
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
    document = format_document(found.to_document(), "verification")
    print(document if options.json else "\n".join(describe_verification(found)))
    return 0 if found.passed else 1


def _excite(options: argparse.Namespace) -> None:
    from slpi_ros.excitation.drives import excite
    from slpi_ros.io.tables import write_table

    drive = excite(
        options.axis,
        voltage_min=options.voltage_min,
        voltage_max=options.voltage_max,
        slew_limit=options.slew,
        duration=options.duration,
        rate=options.rate,
        seed=options.seed,
        drive=options.drive,
    )
    write_table(options.output, drive.t, drive.voltage, "V")
    print(f"{options.output}: {drive.t.size} voltages in {drive.t[-1]:.6g} s; {drive.why}")


def _refit(options: argparse.Namespace) -> None:
    from slpi_ros.identification.refit import refit
    from slpi_ros.io.bag_reader import read_bag
    from slpi_ros.model.document import load_model, save_model
    from slpi_ros.reports.text import describe_change

    _require_another_file(options.output, options.bag)
    model, changes = refit(load_model(options.model), read_bag(options.bag, options.topic))
    save_model(model, options.output)
    print("\n".join(line for axis, change in changes.items() for line in describe_change(axis, change)))


def _simulate(options: argparse.Namespace) -> None:
    from slpi_ros.io.tables import read_table, write_table
    from slpi_ros.model.document import load_model

    _require_another_file(options.output, options.model, options.table)
    model = load_model(options.model)
    t, voltage = read_table(options.table, "V")
    known = _model_columns(voltage, model, options.table)
    write_table(options.output, t, model.simulate(t, known), "m")
    for axis, v in known.items():
        low, high = model.axes[axis].voltage_range
        outside = int(((v < low) | (v > high)).sum())
        if outside:
            print(
                f"slpi simulate: axis '{axis}': {outside} of {v.size} voltages lie outside the identified "
                f"{low:.4g} to {high:.4g} V; there the model extrapolates",
                file=sys.stderr,
            )


def _compensate(options: argparse.Namespace) -> None:
    from slpi_ros.io.tables import read_table, write_table
    from slpi_ros.model.document import load_model
    from slpi_ros.model.limits import Limits
    from slpi_ros.model.stage_model import check_time, held_message
    from slpi_ros.reports.text import describe_start

    _require_another_file(options.output, options.model, options.table)
    model = load_model(options.model)
    t, desired = read_table(options.table, "m")
    check_time(t)
    known = _model_columns(desired, model, options.table)
    limits = Limits(options.voltage_min, options.voltage_max)
    try:
        answers = model.command(t, known, limits, options.start_memory)
    except SlpiError as error:
        raise type(error)(f"{options.table}, {error}") from None
    for axis, (_, held) in answers.items():
        if held.any():
            print(f"slpi compensate: axis '{axis}': {held_message(held)}", file=sys.stderr)
    write_table(options.output, t, {axis: v for axis, (v, _) in answers.items()}, "V")
    print(describe_start(model, answers, options.start_memory))


def _require_another_file(output: str, *inputs: str) -> None:
    """Raise UsageError if the output file is one of the inputs, or lies in the folder of an input bag."""
    for path in map(Path, inputs):
        within = path.is_dir() and path.resolve() in Path(output).resolve().parents
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


def _experiments(options: argparse.Namespace) -> None:
    from slpi_ros.papers.page import write_experiments

    data = Path(options.data) if options.data else None
    if data and not data.is_dir():
        raise UsageError(f"{data}: no such folder; give the folder of the measured records, or leave --data out")
    print(f"{write_experiments(Path(options.output), data)}: open it in a browser")


def _show(options: argparse.Namespace) -> None:
    from slpi_ros.model.document import load_model
    from slpi_ros.reports.text import describe_model

    print("\n".join(describe_model(load_model(options.model))))


@dataclass(frozen=True)
class _Command:
    """One command: help text, function that adds its options to a parser, and function that runs it."""

    help: str
    options: Callable[[Any], None]
    run: Callable[[argparse.Namespace], int | None]


COMMANDS: Mapping[str, _Command] = {
    "import": _Command("turn a table of measured data into a bag", _import_options, _import),
    "identify": _Command("identify the model of a stage from a bag", _identify_options, _identify),
    "diagnose": _Command(
        "find the causes of a model's errors on bags and extend the model", _diagnose_options, _diagnose
    ),
    "verify": _Command("test a model on bags not used to identify it: pass or fail", _verify_options, _verify),
    "excite": _Command("generate excitation voltages for an identification", _excite_options, _excite),
    "refit": _Command(
        "update a model with a new bag, keeping regions that the bag does not visit", _refit_options, _refit
    ),
    "simulate": _Command("compute the displacement for a voltage", _simulate_options, _simulate),
    "compensate": _Command("compute the voltage for a desired displacement", _compensate_options, _compensate),
    "experiments": _Command("reproduce the tables and figures of the two papers", _experiments_options, _experiments),
    "show": _Command("print the contents of a model", _show_options, _show),
}


if __name__ == "__main__":
    sys.exit(main())
