"""``slpi diagnose``: the causes of the errors of a model."""

import shlex
from argparse import ArgumentParser, Namespace
from pathlib import Path

from slpi_ros.cli import options as common
from slpi_ros.cli.command import MOST_LINES, Result, finding_lines

HELP = "find the causes of a model's errors on bags and extend the model"
EXAMPLE = "slpi diagnose calibration check --model model.json -o diagnosis"

# Largest number of warnings on the records without -v.
MOST_WARNINGS = 3


def add_options(command: ArgumentParser) -> None:
    """Add the options of the command."""
    common.add_bags(command, "; several records allow cross-validation of each cause")
    command.add_argument("--model", metavar="MODEL.json", required=True, help="of the same stage")
    common.add_output(command, "DIR", "folder of diagnosis.json, extended_model.json and report.html")
    common.add_topics(command)
    common.add_accept_stage(command)
    common.add_axes(command, help="default: every axis that bag and model share")
    common.add_with(
        command, "every temperature, humidity, pressure, force, number and other stage of the bag, each by itself"
    )
    common.add_span(command)
    command.add_argument(
        "--session",
        action="store_true",
        help="the bags are of one session: between them nothing has moved the stage, which still creeps from the one "
        "to the next (default: each record by itself)",
    )
    common.add_sensor(command)


def run(options: Namespace) -> Result:
    """Run the command."""
    from slpi_ros.io.atomic_file import output_folder
    from slpi_ros.io.bag_reader import require_different
    from slpi_ros.io.schemas import format_document
    from slpi_ros.model.document import load_model
    from slpi_ros.reports import diagnosis as report
    from slpi_ros.reports.text import verdict
    from slpi_ros.workflows.diagnose import DiagnoseRequest, diagnose

    source = common.source_of(options)
    require_different(options.bags)
    model = common.with_sensor(load_model(options.model), options)
    # The model is not checked: an extended model may be extended again.
    common.allow_folder(options, options.output, *report.FILES)
    with output_folder(options.output, *report.FILES) as folder:
        done = diagnose(DiagnoseRequest(source, model, options.model, options.session))
        diagnosis = done.diagnosis
        report.write_files(folder, diagnosis)
    limits = report.diagnosis_limits(diagnosis)
    found_any = any(found.effects for found in diagnosis.axes.values())
    page = f"{folder / report.PAGE}: open it in a browser"
    warned = [line for found in done.findings for line in finding_lines(found, all_levels=False)]
    described = report.describe_diagnosis(diagnosis)
    first = warned[:MOST_WARNINGS]
    lines = [*described[: MOST_LINES - 2 - len(first)], *first, page]
    if found_any or not limits:
        tested = Path(options.output) / "extended_model.json" if found_any else options.model
        next_command = f"slpi verify OTHER_BAG --model {shlex.quote(str(tested))}"
    else:
        experiments = (found.next_experiment for found in diagnosis.axes.values())
        next_command = next(filter(None, experiments), f"slpi show {shlex.quote(options.model)}")
    return Result(
        lines,
        format_document(diagnosis.to_document(), "diagnosis"),
        next_command,
        verdict(limits, report.diagnosis_good(diagnosis)),
        [*warned, *described, page],
    )
