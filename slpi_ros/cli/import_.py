"""``slpi import``: a table of measured data becomes a bag."""

import os
from argparse import ArgumentParser, Namespace
from dataclasses import fields, replace

from slpi_ros.cli import options as common
from slpi_ros.cli.command import Result, command_line

HELP = "turn a table of measured data into a bag"
EXAMPLE = "slpi import data.csv -o calibration"


def add_options(command: ArgumentParser) -> None:
    """Add the options of the command."""
    command.add_argument(
        "table", metavar="DATA",
        help="text (.csv, .txt, .lvm, ..), .mat, .npz, .xlsx or .tdms; names include the unit: x_nm, x (nm), x [nm] or "
        "x in nm",
    )  # fmt: skip
    common.add_output(command, "BAG", "folder of the new bag")
    command.add_argument(
        "--names", metavar="NAME", nargs="+", default=(),
        help="names of the columns of a text, of all or of those that are filled; default: those above the data",
    )  # fmt: skip
    time = command.add_mutually_exclusive_group()
    time.add_argument(
        "--time", metavar="COLUMN",
        help="seconds of any epoch, dates or times of day; default: the column whose name starts with 'time'",
    )  # fmt: skip
    time.add_argument(
        "--sample-period", metavar="S", type=float, help="seconds from row to row; default: the times of the rows"
    )
    command.add_argument(
        "--voltage", metavar="COLUMN", nargs="+", default=(),
        help="commanded or measured, at the times of the rows; one for all axes or one per axis; default: the columns "
        "in volts",
    )  # fmt: skip
    command.add_argument(
        "--displacement", metavar="COLUMN", nargs="+", default=(),
        help="one column per axis; default: the columns in units of length",
    )  # fmt: skip
    command.add_argument(
        "--desired", metavar="COLUMN", nargs="+", default=(),
        help="desired displacement of each axis that has one, on which 'slpi verify' judges the tracking; default: the "
        "columns with 'desired' or 'setpoint' in their names",
    )  # fmt: skip
    command.add_argument(
        "--displacement-unit", help="m, mm, um, nm or pm, for columns without a unit in the name; default: um"
    )
    command.add_argument(
        "--sensor-scale", metavar="M", type=float,
        help="metres for one unit of the columns of displacement, as of a monitor in volts; default: by their unit",
    )  # fmt: skip
    command.add_argument(
        "--amplifier-gain", metavar="V/V", type=float,
        help="volts at the stage for one unit of the columns of voltage, as of an amplifier's input; default: by their "
        "unit",
    )  # fmt: skip
    command.add_argument("--sheet", metavar="NAME", help="sheet of a workbook; default: the only one")
    command.add_argument("--group", metavar="NAME", help="group of a TDMS file; default: the only one")
    command.add_argument(
        "--axes", metavar="NAME", nargs="+", default=(), help="names of the axes; default: from the column names"
    )
    command.add_argument("--hardware-id", metavar="ID", default="", help="identifier of the stage; default: none")
    command.add_argument(
        "--storage", choices=("mcap", "sqlite3"), default="mcap", help="file format of the bag; default: mcap"
    )


def run(options: Namespace) -> Result:
    """Run the command."""
    import numpy as np

    from slpi_ros.compensator.plausible import implausible
    from slpi_ros.io.bag_writer import write_bag
    from slpi_ros.io.columns import ColumnOptions
    from slpi_ros.io.outputs import allow_bag
    from slpi_ros.io.tables import import_with_summary

    columns = ColumnOptions(**{each.name: getattr(options, each.name) for each in fields(ColumnOptions)})
    options.remarks += allow_bag(options.output, overwrite=options.overwrite)
    table = import_with_summary(options.table, columns)
    record = replace(table.record, hardware_id=options.hardware_id)
    for axis, y in record.displacement.items():
        for what, values, unit in (("voltage", record.voltage[axis], "V"), ("displacement", y, "m")):
            known = values[np.isfinite(values)]
            if known.size and known.min() == known.max():
                told = f"the {what} stays at {known[0]:.6g} {unit}: nothing can be identified from it"
                options.remarks.append(f"axis '{axis}': {told}; check the columns")
        if wrong := implausible(record.voltage[axis], y):
            wrong += ", which no piezo stage has; check the columns and their units"
            options.remarks.append(f"axis '{axis}': {wrong}")
    # What a link leads to is replaced, not the link.
    place = os.path.realpath(options.output) if options.overwrite else options.output
    write_bag(place, record, storage=options.storage, replace=options.overwrite, desired=table.desired)
    return Result(
        [f"{options.output}: {len(record)} samples of {', '.join(record.axes)}, {record.t[-1]:.6g} s", *table.summary],
        {
            "bag": options.output,
            "samples": len(record),
            "axes": list(record.axes),
            "desired": list(table.desired),
            "seconds": float(record.t[-1]),
        },
        command_line("slpi", "identify", options.output, "-o", "model.json"),
    )
