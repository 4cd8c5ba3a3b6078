"""``slpi verify``: a model on bags that it was not identified from."""

import math
import shlex
from argparse import ArgumentParser, Namespace
from contextlib import nullcontext

from slpi_ros.cli import options as common
from slpi_ros.cli.command import Result, command_line
from slpi_ros.errors import UsageError

HELP = "test a model on bags not used to identify it: passed, failed or unproved"
EXAMPLE = "slpi verify check --model model.json --tolerance 0.05"


def add_options(command: ArgumentParser) -> None:
    """Add the options of the command."""
    from slpi_ros.io.desired import DESIRED, TRAJECTORY
    from slpi_ros.model.axis_model import START_MEMORIES

    common.add_bags(command)
    command.add_argument("--model", metavar="MODEL.json", required=True, help="model of the same stage")
    command.add_argument(
        "--tolerance", metavar="UM", type=float,
        help="largest absolute rms error that passes, micrometres; default: three times the repeatability of the "
        "record, at least 0.02 %% of the stroke, for the error without its offset",
    )  # fmt: skip
    command.add_argument(
        "--without-offset", action="store_true",
        help="the tolerance holds for the error without its offset; default: for the absolute error",
    )  # fmt: skip
    command.add_argument(
        "--certificate", action="store_true",
        help="also write certificate.json and certificate.html into the folder of -o: stage, records with their "
        "SHA-256, method, range, errors, budget of uncertainty, conditions, versions, verdict; default: no",
    )  # fmt: skip
    common.add_output(command, "DIR", "folder of verification.json and report.html; default: none", required=False)
    command.add_argument(
        "--desired-topic", metavar="TOPIC",
        help="also evaluate the tracking error against this topic; default: those of "
        f"{DESIRED} and {TRAJECTORY} that a bag has",
    )  # fmt: skip
    command.add_argument(
        "--start-memory", choices=START_MEMORIES,
        help="initial state of the stage: as at the end of the identified record, as at its start, or after a reset; "
        "default: found from the record",
    )  # fmt: skip
    common.add_with(command, "those that the model follows")
    common.add_span(command, "what is judged")
    common.add_topics(command)
    common.add_accept_stage(command)
    common.add_axes(command, help="default: every axis that bags and model share")
    common.add_sensor(command)


def run(options: Namespace) -> Result:
    """Run the command."""
    from slpi_ros.io.atomic_file import output_folder
    from slpi_ros.io.schemas import format_document
    from slpi_ros.model.document import load_model
    from slpi_ros.reports import certificate as certificates
    from slpi_ros.reports import verification as report
    from slpi_ros.reports.text import verdict
    from slpi_ros.verification.verify import UNPROVED
    from slpi_ros.workflows.verify import VerifyRequest, verify

    source, tolerance = common.source_of(options), None
    if options.tolerance is not None:
        if not 0.0 < options.tolerance < math.inf:
            raise UsageError(f"--tolerance {options.tolerance:g}: give a positive number of micrometres")
        tolerance = 1e-6 * options.tolerance
    model = common.with_sensor(load_model(options.model), options)
    if options.certificate and options.output is None:
        raise UsageError("--certificate: give the folder that it is written into, -o DIR")
    names = (*report.FILES, *certificates.FILES) if options.certificate else report.FILES
    if options.output is not None:
        common.allow_folder(options, options.output, *names, inputs=[options.model])
    with nullcontext() if options.output is None else output_folder(options.output, *names) as folder:
        request = VerifyRequest(
            source, model, tolerance, options.desired_topic, options.without_offset, options.start_memory, options.model
        )
        done = verify(request)
        found = done.verification
        if folder:
            report.write_files(folder, found)
        if folder and options.certificate:
            bags = [record.source for record in done.records]
            certificates.write_files(folder, certificates.certificate(done, bags, model, options.model))
    if found.passed:
        next_command = f"slpi compensate {shlex.quote(options.model)} DESIRED.csv -o VOLTAGE.csv"
    elif found.verdict == UNPROVED and not any(done.independent):
        next_command = f"slpi verify OTHER_BAG --model {shlex.quote(options.model)}"
    elif any(record.foreign for axis in found.axes.values() for record in axis.records):
        # Another stage or other units, as is said: nothing that a diagnosis looks for.
        next_command = command_line("slpi", "doctor", *options.bags, "--model", options.model)
    else:
        next_command = common.diagnosis_of(options, options.model)
    return Result(
        report.describe_verification(found, details=False),
        format_document(found.to_document(), "verification"),
        next_command,
        verdict(report.verification_limits(found), report.verification_good(found)) + report.little_judged(found),
        report.describe_verification(found),
        found.passed,
    )
