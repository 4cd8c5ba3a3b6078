"""``slpi identify``: a model of a stage from its bags."""

import shlex
from argparse import ArgumentParser, Namespace
from contextlib import nullcontext

from slpi_ros.cli import options as common
from slpi_ros.cli.command import Result, command_line, finding_lines, say

HELP = "identify the model of a stage from a bag"
EXAMPLE = "slpi identify calibration -o model.json --report report"


def add_options(command: ArgumentParser) -> None:
    """Add the options of the command."""
    from slpi_ros.identification.fit import KINDS

    common.add_bags(command)
    common.add_output(command, "MODEL.json", "model document to write")
    command.add_argument("--kind", choices=KINDS, default="slpi", help="kind of model; default: slpi")
    command.add_argument(
        "--loops-at-rest",
        action="store_true",
        help="slpi-published: operators start at rest, as published; default: no",
    )
    common.add_topics(command)
    common.add_accept_stage(command)
    common.add_axes(command, help="default: every axis of the bag")
    common.add_with(command, "none")
    common.add_span(command)
    common.add_sensor(command, "0")
    command.add_argument(
        "--report", metavar="DIR", help="also write a report with plots of the first bag; default: none"
    )
    command.add_argument(
        "--uncertainty", action="store_true", help="also print the uncertainty of the curves; default: no"
    )


def run(options: Namespace) -> Result:
    """Run the command."""
    from slpi_ros.io.atomic_file import output_folder
    from slpi_ros.model.document import format_model, save_model
    from slpi_ros.model.sensor import Sensor
    from slpi_ros.reports.text import describe_model, model_good, model_limits, unexplained, verdict
    from slpi_ros.workflows.identify import IdentifyRequest, identify
    from slpi_ros.workflows.records import UnusableRecordError

    source = common.source_of(options)
    sensor = Sensor(options.sensor_delay or 0.0, options.sensor_lag or 0.0)
    request = IdentifyRequest(source, options.kind, options.loops_at_rest, sensor)
    request.require_possible()
    common.allow_model_and_report(options)
    request.require_possible(uncertainty=options.uncertainty)
    lines = []
    with output_folder(options.report) if options.report else nullcontext() as folder:
        try:
            done = identify(request)
        except UnusableRecordError as error:
            if not options.json:
                say(*finding_lines(error.findings))
            raise
        model, found = done.model, done.findings
        save_model(model, options.output)
        if folder:
            from slpi_ros.reports.identification import write_report

            truth = done.held_out()
            write_report(folder, done.records[0], model, held_out=truth, found=found[0], **source.span)
            lines += [f"axis {axis}: {line}" for axis, held_out in truth.items() for line in held_out.lines()]
    if options.uncertainty:
        lines += [f"axis {axis}: {one.line()}" for axis, one in done.uncertainty().items()]
    limits = model_limits(model)
    options.remarks += [f"{one}; `slpi diagnose` looks for other causes" for one in done.unmoved]
    warned = [line for one in found for line in finding_lines(one, all_levels=False)]
    told = [line for one in found for line in finding_lines(one)]
    if any(map(unexplained, limits.values())):
        next_command = common.diagnosis_of(options, options.output)
    elif limits:
        next_command = command_line("slpi", "doctor", *options.bags)
    else:
        next_command = f"slpi verify OTHER_BAG --model {shlex.quote(options.output)}"
    return Result(
        [*warned, *describe_model(model, details=False), *lines],
        format_model(model),
        next_command,
        verdict(limits, model_good(model)),
        [*told, *lines, *describe_model(model)],
    )
