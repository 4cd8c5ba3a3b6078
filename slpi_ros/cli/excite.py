"""``slpi excite``: excitation voltages for an identification."""

from argparse import ArgumentParser, Namespace

from slpi_ros.cli import options as common
from slpi_ros.cli.command import Command, Result


def _add_options(command: ArgumentParser) -> None:
    from slpi_ros.excitation.drives import DRIVES

    common.add_output(command, "DRIVE.csv", "columns time_s, <axis>_V")
    common.add_axes(command, default=("x",), help="axes to excite, one after the other; default: x")
    common.add_limits(command, "slew limit, of which the drive uses 80 %%")
    command.add_argument("--duration", metavar="S", type=float, default=30.0, help="duration; default: 30 s")
    command.add_argument("--rate", metavar="HZ", type=float, default=200.0, help="sample rate; default: 200 Hz")
    command.add_argument("--seed", metavar="N", type=int, default=0, help="seed of the random sequence; default: 0")
    command.add_argument(
        "--for", dest="drive", metavar="EFFECT", choices=DRIVES, default=DRIVES[0],
        help=f"effect that the record must distinguish from others: {', '.join(DRIVES[1:])}; default: {DRIVES[0]}",
    )  # fmt: skip


def _run(options: Namespace) -> Result:
    from slpi_ros.excitation.drives import SLEW_USED, excite
    from slpi_ros.io.outputs import allow_table
    from slpi_ros.io.tables import table_header, write_table

    common.require_axis_names(options.axis)
    options.remarks += allow_table(options.output, table_header(options.axis, "V"), overwrite=options.overwrite)
    drive = excite(
        options.axis,
        voltage_min=options.voltage_min,
        voltage_max=options.voltage_max,
        slew_limit=SLEW_USED * common.slew_of(options),
        duration=options.duration,
        rate=options.rate,
        seed=options.seed,
        drive=options.drive,
    )
    write_table(options.output, drive.t, drive.voltage, "V")
    return Result(
        [f"{options.output}: {drive.t.size} voltages in {drive.t[-1]:.6g} s; {drive.why}"],
        {"table": options.output, "samples": drive.t.size, "seconds": float(drive.t[-1]), "why": drive.why},
        "slpi import DATA.csv -o BAG, with DATA.csv the voltage and the displacement measured during this drive",
    )


COMMAND = Command(
    "generate excitation voltages for an identification",
    "slpi excite -o drive.csv --voltage-min 0 --voltage-max 100",
    _add_options,
    _run,
)
