"""``slpi calibrate``: how to let a stage calibrate itself."""

from argparse import ArgumentParser, Namespace
from pathlib import Path

from slpi_ros.cli import options as common
from slpi_ros.cli.command import Result, command_line

HELP = "print how to let a stage calibrate itself"
EXAMPLE = "slpi calibrate -o my_stage --voltage-min 0 --voltage-max 100"


def add_options(command: ArgumentParser) -> None:
    """Add the options of the command."""
    command.add_argument("-o", "--output", metavar="DIR", required=True, help="folder of bags, model and page")
    common.add_axes(command, default=("x",), help="default: x")
    common.add_limits(command, "slew limit")


def run(options: Namespace) -> Result:
    """Run the command."""
    from slpi_ros.excitation.legs import DriveSpec

    common.require_axis_names(options.axis)
    slew = common.slew_of(options)
    DriveSpec(options.voltage_min, options.voltage_max, duration=1.0, rate=1.0, slew_limit=slew)
    given = {
        "axes": "['" + "', '".join(options.axis) + "']",
        "voltage_min": options.voltage_min,
        "voltage_max": options.voltage_max,
        "slew_limit": slew,
        "output": Path(options.output).absolute(),
    }
    command = "ros2 run slpi_ros calibrator --ros-args " + " ".join(
        f'-p "{key}:={value}"' for key, value in given.items()
    )
    return Result(
        ["Where ROS 2 and the driver of the stage run, with nobody else publishing voltage_command:", command],
        {"command": command},
        command_line("slpi", "show", Path(options.output) / "model.json"),
    )
