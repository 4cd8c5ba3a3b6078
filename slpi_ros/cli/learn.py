"""``slpi learn``: the next pass of a path that repeats."""

import math
from argparse import ArgumentParser, Namespace
from contextlib import nullcontext
from pathlib import Path

from slpi_ros.cli import options as common
from slpi_ros.cli.command import Result, command_line
from slpi_ros.errors import UsageError

HELP = "compute the next pass of a path that repeats, from the bags of its passes"
EXAMPLE = "slpi learn passes --model model.json --learned path.json -o next.csv"


def add_options(command: ArgumentParser) -> None:
    """Add the options of the command."""
    common.add_bags(command, ", with one pass or more of the path, in any order")
    command.add_argument(
        "--model", metavar="MODEL.json", required=True, help="model with which the path is compensated"
    )
    command.add_argument(
        "--desired", metavar="PATH.csv",
        help="desired path of one pass, columns time_s, <axis>_m; default: that of --learned, else what the first pass "
        "in the bags was asked for",
    )  # fmt: skip
    command.add_argument(
        "--period", metavar="S", type=common.seconds,
        help="the passes follow each other every S seconds; default: each trajectory in a bag is a pass",
    )  # fmt: skip
    command.add_argument(
        "--learned", metavar="FILE", help="what was learned before; read if it exists, and written; default: none"
    )
    command.add_argument(
        "--learn-limit", metavar="UM", type=float,
        help="most that is added to the desired path, micrometres; default: a quarter of the stroke",
    )  # fmt: skip
    command.add_argument("--report", metavar="DIR", help="also write a page with charts; default: none")
    common.add_output(command, "NEXT.csv", "the next pass: columns time_s, <axis>_m")
    common.add_topics(command)
    common.add_accept_stage(command)
    common.add_axes(command, help="default: those of --learned, else every axis that bags and model share")
    common.add_span(command, "the passes")


def run(options: Namespace) -> Result:
    """Run the command."""
    from slpi_ros.io.atomic_file import output_folder
    from slpi_ros.io.outputs import allow_document, allow_table
    from slpi_ros.io.tables import read_table, table_header, write_table
    from slpi_ros.learning.learner import read_learned
    from slpi_ros.model.document import load_model
    from slpi_ros.reports.learning import FILE, describe, write_files
    from slpi_ros.workflows.learn import LearnRequest, learn

    inputs = [options.model, *options.bags, *([options.desired] if options.desired else [])]
    if options.learned:
        common.require_another_file(options.learned, *inputs)
        options.remarks += allow_document(options.learned, "learned", overwrite=options.overwrite)
    common.require_another_file(options.output, *inputs, *([options.learned] if options.learned else []))
    if options.report:
        common.allow_folder(options, options.report, FILE, inputs=inputs)
    if options.learn_limit is not None and not 0.0 < options.learn_limit < math.inf:
        raise UsageError(f"--learn-limit {options.learn_limit:g}: give a positive number of micrometres")
    model = load_model(options.model)
    before = read_learned(options.learned) if options.learned and Path(options.learned).exists() else None
    desired = None
    if options.desired:
        t, columns = read_table(options.desired, "m", model.axes)
        desired = t, common.model_columns(columns, model, options.desired)
    limit = None if options.learn_limit is None else 1e-6 * options.learn_limit
    file = options.learned or ""
    done = learn(LearnRequest(common.source_of(options), model, desired, options.period, before, limit, file))
    learner = done.learner
    options.remarks += done.remarks
    options.remarks += allow_table(options.output, table_header(learner.axes, "m"), overwrite=options.overwrite)
    with output_folder(options.report, FILE) if options.report else nullcontext() as folder:
        if folder:
            write_files(folder, done)
        if options.learned:
            learner.save(options.learned)
        path = {name: axis.path for name, axis in learner.axes.items()}
        write_table(options.output, learner.t - learner.t[0], path, "m")
    lines = [describe(name, axis) for name, axis in learner.axes.items()]
    for name, axis in learner.axes.items():
        lines += [
            f"axis {name}, pass {one.number}: {one.reason}" for one in axis.passes[-len(done.passes) :] if one.reason
        ]
    document = {
        "next": options.output,
        "axes": {name: {"passes": [one.to_document() for one in axis.passes]} for name, axis in learner.axes.items()},
    }
    return Result(
        lines, document, command_line("slpi", "compensate", options.model, options.output, "-o", "VOLTAGE.csv")
    )
