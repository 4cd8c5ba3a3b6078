"""``slpi refit``: a model is updated with new bags."""

import shlex
from argparse import ArgumentParser, Namespace
from contextlib import nullcontext
from dataclasses import replace
from typing import TYPE_CHECKING

from slpi_ros.cli import options as common
from slpi_ros.cli.command import Result

if TYPE_CHECKING:
    from slpi_ros.identification.refit import AxisChange

HELP = "update a model with new bags, keeping regions that these do not visit"
EXAMPLE = "slpi refit model.json monday -o model.json"


def add_options(command: ArgumentParser) -> None:
    """Add the options of the command."""
    command.add_argument("model", metavar="MODEL.json", help="model to be corrected")
    command.add_argument("bags", metavar="BAG", nargs="+", help="in any order; the oldest record is used first")
    common.add_output(command, "MODEL.json", "may be the input model file")
    common.add_topic(command)
    common.add_accept_stage(command)
    common.add_axes(command, help="default: every axis that bag and model share")
    common.add_with(command, "those that the model follows")
    common.add_span(command)
    common.add_sensor(command)
    command.add_argument(
        "--report", metavar="DIR", help="also write a report with plots of the last bag; default: none"
    )


def run(options: Namespace) -> Result:
    """Run the command."""
    from slpi_ros.io.atomic_file import output_folder
    from slpi_ros.model.document import load_model, save_model
    from slpi_ros.reports.text import change_limits, describe_change, verdict
    from slpi_ros.workflows.refit import RefitRequest, refit

    common.allow_model_and_report(options)
    source = common.source_of(options)
    done = refit(RefitRequest(source, common.with_sensor(load_model(options.model), options)))
    model, last, lines = done.model, done.steps[-1], []
    for step in done.steps:
        of_record = f"{step.record.source}: " if len(done.steps) > 1 else ""
        lines += [of_record + line for axis, change in step.changes.items() for line in describe_change(axis, change)]
    with output_folder(options.report) if options.report else nullcontext() as folder:
        if folder:
            from slpi_ros.reports.identification import write_report

            drawn = {axis: model.axes[axis] for axis in last.changes}
            write_report(folder, last.record, replace(model, axes=drawn), start=source.start, stop=source.stop)
        save_model(model, options.output)
    records = [
        {"source": step.record.source, "axes": {axis: _numbers(change) for axis, change in step.changes.items()}}
        for step in done.steps
    ]
    return Result(
        lines,
        {"model": options.output, "records": records},
        f"slpi verify OTHER_BAG --model {shlex.quote(options.output)}",
        verdict(change_limits(last.changes, model), "at the repeatability of the stage"),
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
