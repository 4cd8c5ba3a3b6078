"""``slpi tune``: gains of the closed loop from a model."""

from argparse import ArgumentParser, Namespace
from contextlib import nullcontext

from slpi_ros.cli import options as common
from slpi_ros.cli.command import Result, command_line

HELP = "gains and notches of the feedback from a model"
EXAMPLE = "slpi tune model.json -o gains.yaml --rate 2000"

RATE, MARGIN = 1000.0, 0.5


def add_options(command: ArgumentParser) -> None:
    """Add the options of the command."""
    command.add_argument("model", metavar="MODEL.json", help="model of the stage")
    command.add_argument(
        "bags", metavar="BAG", nargs="?", help="record of a drive by slpi excite --for-response; default: none"
    )
    common.add_output(command, "GAINS.yaml", "parameters of the compensator to write")
    common.add_topic(command)
    common.add_accept_stage(command)
    common.add_axes(command, help="axes to tune; the others get no feedback; default: all")
    command.add_argument(
        "--rate", metavar="HZ", type=float, default=RATE,
        help=f"corrections per second (output_rate), and at least as many readings; default: {RATE:g}",
    )  # fmt: skip
    command.add_argument(
        "--margin", type=float, default=MARGIN,
        help=f"modulus margin, min |1 + L|, that is kept with each mode off by 10 %%; default: {MARGIN:g}",
    )  # fmt: skip
    command.add_argument("--report", metavar="DIR", help="also write a page with the loop's plots; default: none")


def run(options: Namespace) -> Result:
    """Run the command."""
    from slpi_ros.compensator.feedback import PidGains
    from slpi_ros.compensator.gains_file import TunedGains
    from slpi_ros.io.atomic_file import output_folder
    from slpi_ros.io.outputs import allow_gains
    from slpi_ros.model.document import load_model
    from slpi_ros.reports.tuning import FILES, describe, describe_measured, tuning_document, write_files
    from slpi_ros.workflows.tune import TuneRequest, tune

    options.bags = [options.bags] if options.bags else []
    common.require_another_file(options.output, options.model, *options.bags)
    model = load_model(options.model)
    options.remarks += allow_gains(options.output, overwrite=options.overwrite)
    if options.report:
        common.allow_folder(options, options.report, *FILES, inputs=[options.model, options.output])
    source = common.source_of(options) if options.bags else None
    done = tune(TuneRequest(model, options.rate, options.margin, options.axis or (), source))
    found = done.designs
    with output_folder(options.report, *FILES) if options.report else nullcontext() as folder:
        gains = {name: found[name].gains if name in found else PidGains(0.0) for name in model.axes}
        stage = f" for stage {model.hardware_id}" if model.hardware_id else ""
        TunedGains(options.rate, gains).write(options.output, f"slpi tune{stage}")
        if folder:
            write_files(folder, model, found, done.responses)
    lines = [
        f"axis {name}: {line}"
        for name, one in found.items()
        for line in (*describe(model.axes[name], one), *describe_measured(one, done.responses.get(name)))
    ]
    axes = {name: tuning_document(model.axes[name], one) for name, one in found.items()}
    node = ("ros2", "run", "slpi_ros", "compensator", "--ros-args", "--params-file", "STAGE.yaml")
    return Result(
        [f"{options.output}: for a loop of {options.rate:g} Hz", *lines],
        {"gains": options.output, "axes": axes},
        command_line(*node, "--params-file", options.output, "-p", "feedback:=true"),
    )
