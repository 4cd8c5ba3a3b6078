"""The command line ``slpi``: it needs no running ROS graph.

Exit codes: 0 done, 1 the data do not allow it, 2 wrong usage; what is wrong is said in one line.
"""

import argparse
import sys
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from io import TextIOWrapper
from pathlib import Path

from slpi_ros.cli_options import TOPIC, parser
from slpi_ros.diagnosis.diagnose import diagnose
from slpi_ros.errors import ModelError, RecordError, SlpiError, UsageError
from slpi_ros.excitation.drives import excite
from slpi_ros.identification.cross_validation import held_out_truth
from slpi_ros.identification.findings import Finding, findings, require_usable
from slpi_ros.identification.fit import fit_of, identify
from slpi_ros.identification.progress import shown_on
from slpi_ros.identification.record_quality import assess
from slpi_ros.identification.refit import refit
from slpi_ros.identification.uncertainty import curve_uncertainty, require_known_uncertainty
from slpi_ros.io import bag_reader as bags
from slpi_ros.io import tables
from slpi_ros.io.atomic_file import make_folder
from slpi_ros.io.column_choice import Wishes
from slpi_ros.io.record import FloatArray, Record
from slpi_ros.model.document import load_model, save_model
from slpi_ros.model.stage_model import StageModel, check_time, held_message
from slpi_ros.model.stream import Limits
from slpi_ros.reports.text import describe_change, describe_model


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; return the exit code."""
    options = parser().parse_args(arguments)
    for output in (sys.stdout, sys.stderr):
        # A terminal that cannot show a character gets its number.
        if isinstance(output, TextIOWrapper):
            output.reconfigure(errors="backslashreplace")
    warnings.showwarning = partial(_show_warning, options.command)
    try:
        with shown_on(sys.stderr):
            COMMANDS[options.command](options)
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


def _import(options: argparse.Namespace) -> None:
    wishes = Wishes(
        time=options.time,
        voltage=tuple(options.voltage),
        displacement=tuple(options.displacement),
        displacement_unit=options.displacement_unit,
        axes=tuple(options.axes),
    )
    record, told = tables.import_told(options.table, wishes)
    record = replace(record, hardware_id=options.hardware_id)
    bags.write_bag(options.output, record, storage=options.storage)
    print(f"{options.output}: {len(record)} samples of {', '.join(record.axes)}, {record.t[-1]:.6g} s")
    print("\n".join(told))


def _identify(options: argparse.Namespace) -> None:
    topics = _topics(options)
    fit_of(options.kind, loops_at_rest=options.loops_at_rest)
    _require_another_file(options.output, *options.bags)
    target = Path(options.output)
    if target.is_dir() or not target.parent.is_dir():
        raise ModelError(f"{target}: cannot be written: no file can be there; choose another place")
    if options.uncertainty:
        require_known_uncertainty(options.kind)
    if options.report:
        make_folder(options.report)
    records = bags.read_bags(options.bags, topics, axes=options.axis)
    found = [_judged(record, options) for record in records]
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
        write_report(Path(options.report), records[0], model, truth=truth, found=found[0], **part)
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
    if voltage and options.topic is not None:
        raise UsageError("--topic does not go with --voltage-topic and --displacement-topic; give it, or both of them")
    if voltage:
        held = not options.voltage_measured
        return bags.SeparateTopics(voltage, displacement, clock=options.clock or "displacement", held=held)
    if options.clock or options.voltage_measured:
        raise UsageError("--clock and --voltage-measured are for --voltage-topic and --displacement-topic; give both")
    return TOPIC if options.topic is None else str(options.topic)


def _judged(record: Record, options: argparse.Namespace) -> dict[str, list[Finding]]:
    """Print and return what the record is good for, by axis; stop where it is good for nothing."""
    judged = {}
    for axis in record.axes:
        judged[axis] = found = findings(assess(record, axis, start=options.start, stop=options.stop))
        print("\n".join(f"axis {axis}: {finding.level:4} {finding.text}" for finding in found))
        require_usable(found, f"{record.source}: axis '{axis}'")
    return judged


def _diagnose(options: argparse.Namespace) -> None:
    # Plotting is slow to load, and most commands do without.
    from slpi_ros.reports.diagnosis_files import PAGE, describe_diagnosis, make_room, write_files

    topics = _topics(options)
    model = load_model(options.model)
    folder = Path(options.output)
    make_room(folder)
    record = _with_other_axes(options, topics)
    try:
        axes = options.axis or [axis for axis in model.axes if axis in record.axes]
        for axis in axes:
            record.require_axis(axis)
            model.axis(axis)
            require_usable(findings(assess(record, axis)), f"{record.source}: axis '{axis}'")
        diagnosis = diagnose(record, model, axes=axes, start=options.start, stop=options.stop)
    except UsageError as error:
        # That bag and model do not go together shows only once both have been read.
        raise ModelError(str(error)) from None
    write_files(folder, diagnosis)
    print("\n".join(describe_diagnosis(diagnosis)))
    print(f"{folder / PAGE}: open it in a browser")


def _with_other_axes(options: argparse.Namespace, topics: str | bags.SeparateTopics) -> Record:
    """Return all axes of the bag: each may show on the others. Where that cannot be, only those asked for."""
    if options.axis and isinstance(topics, bags.SeparateTopics):
        # There the axes may have no names but those given.
        return bags.read_bag(options.bag, topics, axes=options.axis)
    try:
        return bags.read_bag(options.bag, topics)
    except RecordError:
        if not options.axis:
            raise
        return bags.read_bag(options.bag, topics, axes=options.axis)


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
    _require_another_file(options.output, options.bag)
    model, changes = refit(load_model(options.model), bags.read_bag(options.bag, options.topic))
    save_model(model, options.output)
    print("\n".join(line for axis, change in changes.items() for line in describe_change(axis, change)))


def _simulate(options: argparse.Namespace) -> None:
    _require_another_file(options.output, options.model, options.table)
    model = load_model(options.model)
    t, voltage = tables.read_table(options.table, "V")
    known = _known(voltage, model, options.table)
    tables.write_table(options.output, t, model.simulate(t, known), "m")
    for axis, v in known.items():
        low, high = model.axes[axis].voltage_range
        outside = int(((v < low) | (v > high)).sum())
        if outside:
            print(
                f"slpi simulate: axis '{axis}': {outside} of {v.size} voltages lie outside the identified "
                f"{low:.4g} to {high:.4g} V; there the model is a guess",
                file=sys.stderr,
            )


def _compensate(options: argparse.Namespace) -> None:
    _require_another_file(options.output, options.model, options.table)
    model = load_model(options.model)
    t, desired = tables.read_table(options.table, "m")
    check_time(t)
    known = _known(desired, model, options.table)
    limits = Limits(options.voltage_min, options.voltage_max)
    try:
        answers = model.command(t, known, limits)
    except SlpiError as error:
        raise type(error)(f"{options.table}, {error}") from None
    for axis, (_, held) in answers.items():
        if held.any():
            print(f"slpi compensate: axis '{axis}': {held_message(held)}", file=sys.stderr)
    tables.write_table(options.output, t, {axis: v for axis, (v, _) in answers.items()}, "V")


def _require_another_file(output: str, *inputs: str) -> None:
    """Refuse to write over what is read."""
    for path in map(Path, inputs):
        if path.exists() and Path(output).exists() and path.samefile(output):
            raise UsageError(f"{output}: is also read from; give another file to write (-o)")


def _known(columns: dict[str, FloatArray], model: StageModel, table: str) -> dict[str, FloatArray]:
    """Return the columns of a table if the model holds all their axes."""
    for axis in columns:
        if axis not in model.axes:
            raise SlpiError(
                f"{table}: column of axis '{axis}', but the model holds {', '.join(model.axes)}; rename the column"
            )
    return columns


def _experiments(options: argparse.Namespace) -> None:
    from slpi_ros.papers.page import write_experiments

    data = Path(options.data) if options.data else None
    if data and not data.is_dir():
        raise UsageError(f"{data}: no such folder; give the folder of the measured records, or leave --data out")
    print(f"{write_experiments(Path(options.output), data)}: open it in a browser")


def _show(options: argparse.Namespace) -> None:
    print("\n".join(describe_model(load_model(options.model))))


COMMANDS: Mapping[str, Callable[[argparse.Namespace], None]] = {
    "import": _import,
    "identify": _identify,
    "diagnose": _diagnose,
    "excite": _excite,
    "refit": _refit,
    "simulate": _simulate,
    "compensate": _compensate,
    "experiments": _experiments,
    "show": _show,
}


if __name__ == "__main__":
    sys.exit(main())
