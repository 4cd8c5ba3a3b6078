"""``slpi export``: the causal inverse of a model as C source, or as an FMU."""

from argparse import ArgumentParser, Namespace

from slpi_ros.cli import options as common
from slpi_ros.cli.command import Result

HELP = "write the causal inverse of a model as C source or as an FMU"
EXAMPLE = "slpi export model.json -o controller --slew-limit 1000"


def add_options(command: ArgumentParser) -> None:
    """Add the options of the command."""
    from slpi_ros.export.targets import TARGETS

    command.add_argument("model", metavar="MODEL.json", help="model of the stage")
    common.add_output(command, "DIR", "folder for the files")
    common.add_axes(command, help="axes of the export; default: all")
    command.add_argument(
        "--target", choices=tuple(TARGETS), default="c", help="C11 source (default), or units for simulators (FMI)"
    )
    command.add_argument(
        "--gains", metavar="GAINS.yaml", help="also export the feedback with the gains of slpi tune; default: none"
    )
    common.add_inverse_limits(command, "rate limit")


def run(options: Namespace) -> Result:
    """Run the command."""
    from slpi_ros.export.stage import ExportedStage
    from slpi_ros.export.targets import TARGETS
    from slpi_ros.model.document import load_model

    limits = common.inverse_limits(options)
    model = load_model(options.model)
    stage, target = ExportedStage.of(model, limits, options.axis), TARGETS[options.target]
    if options.gains is not None:
        from slpi_ros.compensator.gains_file import TunedGains

        stage = stage.with_feedback(TunedGains.read(options.gains))
    options.remarks += target.allow(options.output, overwrite=options.overwrite)
    names = target.write(options.output, stage)
    options.remarks += target.remarks(stage)
    lines = [line for axis in stage.axes for line in axis.describe]
    document = {
        "folder": options.output,
        "files": names,
        "axes": {
            axis.name: {
                "effects": axis.inverted, "left_out": axis.left_out,
                "voltage_range_V": [axis.allowed.lower, axis.allowed.upper],
            } for axis in stage.axes
        },
    }  # fmt: skip
    return Result(lines, document, target.next(options.output), f"wrote {', '.join(names)}")
