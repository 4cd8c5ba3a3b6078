"""``slpi show``: the contents of a model."""

import shlex
from argparse import ArgumentParser, Namespace

from slpi_ros.cli.command import Result

HELP = "print the contents of a model"
EXAMPLE = "slpi show model.json"


def add_options(command: ArgumentParser) -> None:
    """Add the options of the command."""
    command.add_argument("model", metavar="MODEL.json", help="model to be shown")


def run(options: Namespace) -> Result:
    """Run the command."""
    from slpi_ros.model.document import format_model, load_model
    from slpi_ros.reports.text import describe_model, model_good, model_limits, unexplained, verdict
    from slpi_ros.reports.uncertainty import describe_uncertainty

    model = load_model(options.model)
    limits, own = model_limits(model), shlex.quote(options.model)

    def uncertain(*, details: bool) -> list[str]:
        axes = model.axes.items()
        return [f"axis {name}: {line}" for name, axis in axes for line in describe_uncertainty(axis, details=details)]

    if any(map(unexplained, limits.values())):
        next_command = f"slpi diagnose BAG... --model {own} -o diagnosis"
    else:
        next_command = "slpi doctor BAG..." if limits else f"slpi verify OTHER_BAG --model {own}"
    return Result(
        [*describe_model(model, details=False), *uncertain(details=False)],
        format_model(model),
        next_command,
        verdict(limits, model_good(model)),
        [*describe_model(model), *uncertain(details=True)],
    )
