"""``slpi compensate``: the voltage for a desired displacement."""

from argparse import ArgumentParser, Namespace
from typing import Any

from slpi_ros.cli import options as common
from slpi_ros.cli.command import Result, command_line
from slpi_ros.errors import SlpiError

HELP = "compute the voltage for a desired displacement"
EXAMPLE = "slpi compensate model.json desired.csv -o voltage.csv --slew-limit 1000"

# A first voltage that differs by more than this share of the range is told as a jump.
SMALLEST_JUMP = 1e-3


def add_options(command: ArgumentParser) -> None:
    """Add the options of the command."""
    from slpi_ros.model.axis_model import START_MEMORIES

    command.add_argument("model", metavar="MODEL.json", help="model of the stage")
    command.add_argument(
        "table", metavar="DESIRED.csv", help="columns time_s, <axis>_m, and <topic> of quantities that it follows"
    )
    common.add_output(command, "VOLTAGE.csv", "columns time_s, <axis>_V")
    common.add_inverse_limits(command, "rate limit; the voltage then begins where the stage is")
    command.add_argument(
        "--start-memory", choices=START_MEMORIES, default=START_MEMORIES[0],
        help="initial state of the stage: as at the end of the identified record (default), as at its start, "
        "or reset by a decaying oscillation",
    )  # fmt: skip


def run(options: Namespace) -> Result:
    """Run the command."""
    import numpy as np

    from slpi_ros.io.outputs import allow_table
    from slpi_ros.io.tables import read_table_with, table_header, write_table
    from slpi_ros.model.coverage import path_beyond
    from slpi_ros.model.document import load_model
    from slpi_ros.model.limits import MAX_DT
    from slpi_ros.model.stage_model import check_time, held_message
    from slpi_ros.reports.text import describe_start

    common.require_another_file(options.output, options.model, options.table)
    model = load_model(options.model)
    t, desired, surroundings = read_table_with(options.table, "m", model.quantities, model.axes)
    check_time(t)
    known = common.model_columns(desired, model, options.table)
    options.remarks += allow_table(options.output, table_header(known, "V"), overwrite=options.overwrite)
    limits = common.inverse_limits(options)
    common.require_usable(model, surroundings, options.table)
    options.remarks += common.quantities_beyond(model, t, surroundings)
    try:
        answers = model.command(t, known, limits, options.start_memory, surroundings)
    except SlpiError as error:
        raise type(error)(f"{options.table}, {error}") from None
    for axis, (_, held) in answers.items():
        told = [held_message(held)] if held.any() else []
        if beyond := path_beyond(model.axes[axis], t, known[axis]):
            told.append(f"{beyond}; 'slpi excite --for-path' makes the drive for a record that covers it")
        options.remarks += [f"axis '{axis}': {'; '.join(told)}"] if told else []
    write_table(options.output, t, {axis: v for axis, (v, _) in answers.items()}, "V")
    lines = [describe_start(model, answers, options.start_memory)]
    document: dict[str, Any] = {"table": options.output, "samples": t.size, "axes": {}}
    for axis, (v, held) in answers.items():
        start = model.axes[axis].initial(options.start_memory)
        jump, (low, high) = float(v[0] - start.voltage), model.axes[axis].voltage_range
        # The largest step between samples that the slew limit allows; a longer pause counts as MAX_DT.
        most = options.slew_limit * np.minimum(np.diff(t), MAX_DT)
        limited = int(np.count_nonzero(np.abs(np.diff(v)) >= most * (1.0 - 1e-9))) if options.slew_limit else 0
        if abs(jump) > SMALLEST_JUMP * (high - low):
            lines.append(
                f"axis {axis}: the first sample jumps by {jump:+.4g} V, to {known[axis][0] * 1e6:.4g} µm from "
                f"{start.displacement * 1e6:.6g} µm; begin the path there, or give --slew-limit"
            )
        if limited:
            lines.append(f"axis {axis}: {limited} of {v.size} samples are at the slew limit; the path is late there")
        document["axes"][axis] = {
            "first_jump_V": jump, "held": int(held.sum()), "slew_limited": limited,
            "voltage_range_V": [float(v.min()), float(v.max())],
        }  # fmt: skip
    return Result(lines, document, command_line("slpi", "simulate", options.model, options.output, "-o", "REACHED.csv"))
