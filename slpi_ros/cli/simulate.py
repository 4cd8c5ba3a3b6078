"""``slpi simulate``: the displacement for a voltage."""

from argparse import ArgumentParser, Namespace

from slpi_ros.cli import options as common
from slpi_ros.cli.command import Result, command_line

HELP = "compute the displacement for a voltage"
EXAMPLE = "slpi simulate model.json voltage.csv -o displacement.csv"


def add_options(command: ArgumentParser) -> None:
    """Add the options of the command."""
    command.add_argument("model", metavar="MODEL.json", help="model of the stage")
    command.add_argument(
        "table",
        metavar="VOLTAGE.csv",
        help="columns time_s, <axis>_V, and <topic> of quantities that the stage follows",
    )
    common.add_output(command, "DISPLACEMENT.csv", "columns time_s, <axis>_m")


def run(options: Namespace) -> Result:
    """Run the command."""
    from slpi_ros.io.outputs import allow_table
    from slpi_ros.io.tables import read_table_with, table_header, write_table
    from slpi_ros.model.document import load_model

    common.require_another_file(options.output, options.model, options.table)
    model = load_model(options.model)
    t, voltage, surroundings = read_table_with(options.table, "V", model.quantities, model.axes)
    known = common.model_columns(voltage, model, options.table)
    options.remarks += allow_table(options.output, table_header(known, "m"), overwrite=options.overwrite)
    options.remarks += common.quantities_beyond(model, t, surroundings)
    reached = model.simulate(t, known, surroundings)
    write_table(options.output, t, reached, "m")
    for axis, v in known.items():
        low, high = model.axes[axis].voltage_range
        outside = int(((v < low) | (v > high)).sum())
        if outside:
            options.remarks.append(
                f"axis '{axis}': {outside} of {v.size} voltages lie outside the identified {low:.4g} to {high:.4g} V; "
                "there the model extrapolates"
            )
    ranges = {axis: (float(y.min()), float(y.max())) for axis, y in reached.items()}
    return Result(
        [f"axis {axis}: {low * 1e6:.4g} to {high * 1e6:.4g} µm" for axis, (low, high) in ranges.items()],
        {"table": options.output, "samples": t.size, "displacement_range_m": {a: list(r) for a, r in ranges.items()}},
        command_line("slpi", "compensate", options.model, options.output, "-o", "VOLTAGE.csv"),
    )
