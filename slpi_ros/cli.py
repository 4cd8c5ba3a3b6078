"""The command line ``slpi``: it needs no running ROS graph.

Exit codes: 0 done, 1 the data do not allow it, 2 wrong usage; what is wrong is said in one line.
"""

import argparse
import sys
import warnings
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from io import TextIOWrapper
from pathlib import Path
from typing import NoReturn

import numpy as np

from slpi_ros import bags, tables
from slpi_ros.errors import ModelError, SlpiError, UsageError
from slpi_ros.excitation.drives import DRIVES, excite
from slpi_ros.identification.findings import findings, require_usable
from slpi_ros.identification.fit import KINDS, identify
from slpi_ros.identification.progress import shown_on
from slpi_ros.identification.quality import assess
from slpi_ros.identification.record import FloatArray, Record
from slpi_ros.identification.refit import refit
from slpi_ros.identification.truth import held_out_truth
from slpi_ros.identification.uncertainty import curve_uncertainty, require_known_uncertainty
from slpi_ros.model import StageModel, check_time, held_message
from slpi_ros.model_file import load_model, save_model
from slpi_ros.reports.text import describe_change, describe_model
from slpi_ros.stream import Limits


class _Parser(argparse.ArgumentParser):
    """A parser that says what is wrong in one line."""

    def error(self, message: str) -> NoReturn:
        self.exit(2, f"{self.prog}: {message} (see {self.prog} --help)\n")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; return the exit code."""
    options = _parser().parse_args(arguments)
    for output in (sys.stdout, sys.stderr):
        # A terminal that cannot show a character gets its number.
        if isinstance(output, TextIOWrapper):
            output.reconfigure(errors="backslashreplace")
    warnings.showwarning = partial(_show_warning, options.command)
    try:
        with shown_on(sys.stderr):
            options.run(options)
    except SlpiError as error:
        print(f"slpi {options.command}: {_one_line(error)}", file=sys.stderr)
        return error.exit_code
    except (OSError, MemoryError) as error:
        print(f"slpi {options.command}: {_one_line(error) or 'not enough memory'}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        return 130
    return 0


def _show_warning(command: str, message: Warning | str, *_: object) -> None:
    print(f"slpi {command}: {' '.join(str(message).split())}", file=sys.stderr)


def _one_line(error: BaseException) -> str:
    return " ".join(str(error).split())


def _parser() -> argparse.ArgumentParser:
    parser = _Parser(prog="slpi", description="Hysteresis models of piezo stages: identify, simulate, compensate.")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND", parser_class=_Parser)

    command = commands.add_parser("import", help="turn a table of measured data into a bag")
    command.set_defaults(run=_import)
    command.add_argument("table", metavar="DATA.csv|DATA.mat")
    command.add_argument("-o", "--output", metavar="BAG", required=True, help="folder of the new bag")
    command.add_argument("--time", metavar="COLUMN", help="default: the column whose name starts with 'time'")
    command.add_argument("--voltage", metavar="COLUMN", nargs="+", default=(), help="one for all axes or one for each")
    command.add_argument("--displacement", metavar="COLUMN", nargs="+", default=(), help="one for each axis")
    command.add_argument("--displacement-unit", default="um", help="m, mm, um or nm, where column names do not say it")
    command.add_argument(
        "--axes", metavar="NAME", nargs="+", default=(), help="names of the axes; default: from the columns"
    )
    command.add_argument("--hardware-id", metavar="ID", default="", help="which stage it is")
    command.add_argument("--storage", choices=("mcap", "sqlite3"), default="mcap")

    command = commands.add_parser("identify", help="identify the model of a stage from a bag")
    command.set_defaults(run=_identify)
    command.add_argument("bags", metavar="BAG", nargs="+", help="rosbag2 folder, or a lone mcap or sqlite3 file")
    command.add_argument("-o", "--output", metavar="MODEL.json", required=True)
    command.add_argument("--kind", choices=KINDS, default="slpi")
    command.add_argument(
        "--loops-at-rest",
        action="store_true",
        help="slpi-published: operators start at rest, as published",
    )
    command.add_argument("--topic", default="stage_state")
    command.add_argument("--voltage-topic", metavar="TOPIC", help="where voltage and displacement are apart")
    command.add_argument("--displacement-topic", metavar="TOPIC")
    clocks = ("displacement", "voltage")
    command.add_argument("--clock", choices=clocks, default=clocks[0], help="whose stamps count")
    command.add_argument("--voltage-measured", action="store_true", help="voltage is a reading, no command that holds")
    command.add_argument("--axis", metavar="NAME", nargs="+", help="default: every axis of the bag")
    command.add_argument("--start", metavar="S", type=float, help="fit only from here on, seconds from the first stamp")
    command.add_argument("--stop", metavar="S", type=float, help="fit only up to here")
    command.add_argument("--report", metavar="DIR", help="also write a page with plots, of the first bag")
    command.add_argument("--uncertainty", action="store_true", help="also say how surely the curves are known")

    command = commands.add_parser("excite", help="make the voltages to record for an identification")
    command.set_defaults(run=_excite)
    command.add_argument("-o", "--output", metavar="DRIVE.csv", required=True, help="columns time_s, <axis>_V")
    command.add_argument("--axis", metavar="NAME", nargs="+", default=("x",), help="they move one after the other")
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

    command = commands.add_parser("refit", help="update a model with a new bag; what the bag does not visit stays")
    command.set_defaults(run=_refit)
    command.add_argument("model", metavar="MODEL.json")
    command.add_argument("bag", metavar="BAG")
    command.add_argument("-o", "--output", metavar="MODEL.json", required=True, help="may be the same file")
    command.add_argument("--topic", default="stage_state")

    command = commands.add_parser("simulate", help="voltage to displacement")
    command.set_defaults(run=_simulate)
    command.add_argument("model", metavar="MODEL.json")
    command.add_argument("table", metavar="VOLTAGE.csv", help="columns time_s, <axis>_V")
    command.add_argument("-o", "--output", metavar="DISPLACEMENT.csv", required=True)

    command = commands.add_parser("compensate", help="desired displacement to voltage")
    command.set_defaults(run=_compensate)
    command.add_argument("model", metavar="MODEL.json")
    command.add_argument("table", metavar="DESIRED.csv", help="columns time_s, <axis>_m")
    command.add_argument("-o", "--output", metavar="VOLTAGE.csv", required=True)
    command.add_argument("--voltage-min", metavar="V", type=float, default=-np.inf, help="default: what was identified")
    command.add_argument("--voltage-max", metavar="V", type=float, default=np.inf)

    command = commands.add_parser("experiments", help="compute the two papers' tables and figures anew")
    command.set_defaults(run=_experiments)
    command.add_argument("-o", "--output", metavar="DIR", required=True, help="folder of index.html")
    command.add_argument("--data", metavar="DIR", help="folder of measured records, to be compared too")

    command = commands.add_parser("show", help="say what a model holds")
    command.set_defaults(run=_show)
    command.add_argument("model", metavar="MODEL.json")
    return parser


def _import(options: argparse.Namespace) -> None:
    record = tables.import_table(
        options.table,
        time=options.time,
        voltage=options.voltage,
        displacement=options.displacement,
        displacement_unit=options.displacement_unit,
        axes=options.axes,
    )
    record = replace(record, hardware_id=options.hardware_id)
    bags.write_bag(options.output, record, storage=options.storage)
    print(f"{options.output}: {len(record)} samples of {', '.join(record.axes)}, {record.t[-1]:.6g} s")


def _identify(options: argparse.Namespace) -> None:
    target = Path(options.output)
    if target.is_dir() or not target.parent.is_dir():
        raise ModelError(f"{target}: cannot be written: no file can be there; choose another place")
    if options.uncertainty:
        require_known_uncertainty(options.kind)
    records = bags.read_bags(options.bags, _topics(options), axes=options.axis)
    for record in records:
        _judge(record, options)
    model = identify(records, options.kind, start=options.start, stop=options.stop, loops_at_rest=options.loops_at_rest)
    save_model(model, options.output)
    told = []
    part = {"start": options.start, "stop": options.stop}
    if options.report:
        # Plotting is slow to load, and most commands do without.
        from slpi_ros.reports.identification import write_report

        truth = {
            axis: held_out_truth(records, axis, options.kind, loops_at_rest=options.loops_at_rest, **part)
            for axis in model.axes
        }
        write_report(Path(options.report), records[0], model, truth=truth)
        told += [f"axis {axis}: {line}" for axis, held_out in truth.items() for line in held_out.lines()]
    if options.uncertainty:
        for axis in model.axes:
            told.append(f"axis {axis}: {curve_uncertainty(records, axis, options.kind, **part).line()}")
    print("\n".join([*told, *describe_model(model)]))


def _topics(options: argparse.Namespace) -> str | bags.SeparateTopics:
    """Return where the bag holds voltage and displacement."""
    voltage, displacement = options.voltage_topic, options.displacement_topic
    if bool(voltage) != bool(displacement):
        raise UsageError("--voltage-topic and --displacement-topic go together; give both, or --topic")
    if not voltage:
        return str(options.topic)
    return bags.SeparateTopics(voltage, displacement, clock=options.clock, held=not options.voltage_measured)


def _judge(record: Record, options: argparse.Namespace) -> None:
    """Print what the record is good for; stop where it is good for nothing."""
    for axis in record.axes:
        found = findings(assess(record, axis, start=options.start, stop=options.stop))
        print("\n".join(f"axis {axis}: {finding.level:4} {finding.text}" for finding in found))
        require_usable(found, f"{record.source}: axis '{axis}'")


def _excite(options: argparse.Namespace) -> None:
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
    tables.write_table(options.output, drive.t, drive.voltage, "V")
    print(f"{options.output}: {drive.t.size} voltages in {drive.t[-1]:.6g} s; {drive.why}")


def _refit(options: argparse.Namespace) -> None:
    model, changes = refit(load_model(options.model), bags.read_bag(options.bag, options.topic))
    save_model(model, options.output)
    print("\n".join(line for axis, change in changes.items() for line in describe_change(axis, change)))


def _simulate(options: argparse.Namespace) -> None:
    model = load_model(options.model)
    t, voltage = tables.read_table(options.table, "V")
    tables.write_table(options.output, t, model.simulate(t, _known(voltage, model, options.table)), "m")


def _compensate(options: argparse.Namespace) -> None:
    model = load_model(options.model)
    t, desired = tables.read_table(options.table, "m")
    check_time(t)
    limits = Limits(options.voltage_min, options.voltage_max)
    try:
        answers = model.command(t, _known(desired, model, options.table), limits)
    except SlpiError as error:
        raise type(error)(f"{options.table}, {error}") from None
    for axis, (_, held) in answers.items():
        if held.any():
            print(f"slpi compensate: axis '{axis}': {held_message(held)}", file=sys.stderr)
    tables.write_table(options.output, t, {axis: v for axis, (v, _) in answers.items()}, "V")


def _known(columns: dict[str, FloatArray], model: StageModel, table: str) -> dict[str, FloatArray]:
    """Return the columns of a table if the model holds all their axes."""
    for axis in columns:
        if axis not in model.axes:
            raise SlpiError(
                f"{table}: column of axis '{axis}', but the model holds {', '.join(model.axes)}; rename the column"
            )
    return columns


def _experiments(options: argparse.Namespace) -> None:
    from slpi_ros.experiments.page import write_experiments

    data = Path(options.data) if options.data else None
    if data and not data.is_dir():
        raise UsageError(f"{data}: no such folder; give the folder of the measured records, or leave --data out")
    print(f"{write_experiments(Path(options.output), data)}: open it in a browser")


def _show(options: argparse.Namespace) -> None:
    print("\n".join(describe_model(load_model(options.model))))


if __name__ == "__main__":
    sys.exit(main())
