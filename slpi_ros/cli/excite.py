"""``slpi excite``: excitation voltages for an identification."""

import math
from argparse import ArgumentParser, Namespace
from typing import TYPE_CHECKING

from slpi_ros.cli import options as common
from slpi_ros.cli.command import Result
from slpi_ros.errors import SlpiError, UsageError

if TYPE_CHECKING:
    from slpi_ros.arrays import FloatArray

HELP = "generate excitation voltages for an identification"
EXAMPLE = "slpi excite -o drive.csv --voltage-min 0 --voltage-max 100"

RATE = 200.0


def add_options(command: ArgumentParser) -> None:
    """Add the options of the command."""
    from slpi_ros.excitation.drives import DRIVES

    common.add_output(command, "DRIVE.csv", "columns time_s, <axis>_V")
    common.add_axes(command, help="axes to excite, one after the other; default: x, or those of the path")
    common.add_limits(command, "slew limit, of which the drive uses 80 %%")
    command.add_argument(
        "--duration", metavar="S", type=float, default=30.0, help="duration, before a path; default: 30 s"
    )
    command.add_argument(
        "--rate", metavar="HZ", type=float, help=f"sample rate; default: {RATE:g} Hz, or that of the path if higher"
    )
    command.add_argument("--seed", metavar="N", type=int, default=0, help="seed of the random sequence; default: 0")
    command.add_argument(
        "--for", dest="drive", metavar="EFFECT", choices=DRIVES, default=DRIVES[0],
        help=f"effect that the record must distinguish from others: {', '.join(DRIVES[1:])}; default: {DRIVES[0]}",
    )  # fmt: skip
    command.add_argument(
        "--for-response",
        action="store_true",
        help="small multisines about three biases, for the frequency response (slpi tune); default: no",
    )
    command.add_argument(
        "--for-path", metavar="PATH",
        help="desired path whose range, rates and turns the record must cover: a table, as for slpi compensate, or a "
        "bag with desired_trajectory or desired_displacement; default: none",
    )  # fmt: skip
    command.add_argument(
        "--model", metavar="MODEL.json",
        help="first model of the stage, for the voltages of the path; default: the path takes the whole voltage range",
    )  # fmt: skip


def run(options: Namespace) -> Result:
    """Run the command."""
    import numpy as np

    from slpi_ros.arrays.rates import fastest
    from slpi_ros.excitation.drives import DRIVES, SLEW_USED, excite
    from slpi_ros.excitation.path import with_path
    from slpi_ros.excitation.response import response_drive
    from slpi_ros.io.outputs import allow_table
    from slpi_ros.io.tables import table_header, write_table
    from slpi_ros.model.coverage import FASTER

    if options.model and not options.for_path:
        raise UsageError("--model is of use with --for-path only; give the path, or leave it out")
    if options.for_response and (options.for_path or options.drive != DRIVES[0]):
        raise UsageError("--for-response is a drive of its own; leave --for and --for-path out")
    if options.rate is not None and not 0.0 < options.rate < math.inf:
        raise UsageError(f"--rate {options.rate:g}: give a positive number of Hz")
    path, rate = _path_of(options) if options.for_path else ({}, RATE if options.rate is None else options.rate)
    axes = options.axis or list(path) or ["x"]
    common.require_axis_names(axes)
    options.remarks += allow_table(options.output, table_header(axes, "V"), overwrite=options.overwrite)
    slew = SLEW_USED * common.slew_of(options)
    drive = (
        response_drive(axes, options.voltage_min, options.voltage_max, slew, options.duration, rate, options.seed)
        if options.for_response
        else excite(
            axes,
            voltage_min=options.voltage_min,
            voltage_max=options.voltage_max,
            slew_limit=slew,
            duration=options.duration,
            rate=rate,
            seed=options.seed,
            drive=options.drive,
        )
    )
    if path:
        drive = with_path(drive, path)
    for axis, v in path.items():
        wanted = fastest(np.arange(v.size) / rate, v)
        if slew and wanted > FASTER * slew:
            options.remarks.append(
                f"axis '{axis}': the path needs up to {wanted:.3g} V/s, the drive keeps to {slew:.3g} V/s; give a "
                "first model (--model), a higher --slew-limit, or a slower path"
            )
        slack = 1e-6 * (options.voltage_max - options.voltage_min)
        if v.min() < options.voltage_min - slack or v.max() > options.voltage_max + slack:
            options.remarks.append(f"axis '{axis}': the path needs {v.min():.4g} to {v.max():.4g} V, beyond the limits")
    write_table(options.output, drive.t, drive.voltage, "V")
    return Result(
        [f"{options.output}: {drive.t.size} voltages in {drive.t[-1]:.6g} s; {drive.why}"],
        {"table": options.output, "samples": drive.t.size, "seconds": float(drive.t[-1]), "why": drive.why},
        "slpi import DATA.csv -o BAG, with DATA.csv the voltage and the displacement measured during this drive",
    )


def _path_of(options: Namespace) -> tuple[dict[str, "FloatArray"], float]:
    """Return the voltages (V) of the path by axis, (N,), and their sampling rate (Hz)."""
    import numpy as np

    from slpi_ros.calibration.drive_monitor import FARTHEST
    from slpi_ros.excitation.legs import DriveSpec
    from slpi_ros.io.desired import read_path
    from slpi_ros.model.document import load_model
    from slpi_ros.model.stage_model import check_time

    t, desired = read_path(options.for_path, options.axis or ())
    desired = {axis: desired[axis] for axis in options.axis or desired if axis in desired}
    steps = np.diff(check_time(t))
    if not desired or not steps.size or not t[-1] > 0.0:
        raise UsageError(f"{options.for_path}: no path of axis {', '.join(options.axis or ['x'])} over time; give one")
    farthest = max(float(np.abs(y).max()) for y in desired.values())
    if farthest > FARTHEST:
        raise UsageError(f"{options.for_path}: a displacement of {farthest:.4g} m; give metres")
    rate = max(RATE, 1.0 / float(np.median(steps[steps > 0.0]))) if options.rate is None else options.rate
    # Limits and number of samples are possible ones.
    spec = DriveSpec(options.voltage_min, options.voltage_max, float(t[-1]), rate)
    if options.model:
        model = load_model(options.model)
        try:
            answers = model.command(t, common.model_columns(desired, model, options.for_path))
        except SlpiError as error:
            raise type(error)(f"{options.for_path}, {error}") from None
        volts = {axis: v for axis, (v, _) in answers.items()}
    else:
        volts = {axis: spec.low + spec.span * (y - y.min()) / (float(np.ptp(y)) or 1.0) for axis, y in desired.items()}
    even = np.arange(int(spec.duration * rate) + 1) / rate
    return {axis: np.interp(even, t, v) for axis, v in volts.items()}, rate
