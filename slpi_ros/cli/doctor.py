"""``slpi doctor``: checks of bags, a model, a device and a running ROS graph."""

import math
import shlex
import statistics
import time
from argparse import ArgumentParser, Namespace
from collections.abc import Sequence
from typing import TYPE_CHECKING

from slpi_ros.cli import options as common
from slpi_ros.cli.command import Result, command_line
from slpi_ros.errors import SlpiError, UsageError
from slpi_ros.identification.progress import report_progress

if TYPE_CHECKING:
    from slpi_ros.arrays import FloatArray
    from slpi_ros.drivers.base import Device
    from slpi_ros.reports.doctor import Check

HELP = "check bags, a model, a device and a running ROS graph, and say what to do"
EXAMPLE = "slpi doctor calibration --model model.json"

COMMANDS_TOPIC = "voltage_command"
# Longest time to watch a running graph, seconds.
LONGEST_WATCH = 3600.0
# Readings of a device that are timed.
TIMED = 21


def add_options(command: ArgumentParser) -> None:
    """Add the options of the command."""
    command.add_argument("bags", metavar="BAG", nargs="*", help="records to be checked; default: none")
    command.add_argument("--model", metavar="MODEL.json", help="model to be checked; default: that on stage_model")
    command.add_argument("--voltage-min", metavar="V", type=float, help="lowest voltage allowed; default: not checked")
    command.add_argument("--voltage-max", metavar="V", type=float, help="highest voltage allowed; default: not checked")
    common.add_topic(command)
    command.add_argument(
        "--command-topic", metavar="TOPIC", default=COMMANDS_TOPIC,
        help=f"topic of the voltage commands; default: {COMMANDS_TOPIC}",
    )  # fmt: skip
    command.add_argument("--namespace", metavar="NAME", default="", help="namespace of the stage; default: none")
    command.add_argument(
        "--seconds", metavar="S", type=common.seconds, default=3.0, help="time to watch a running graph; default: 3 s"
    )
    command.add_argument(
        "--device",
        metavar="DEVICE:ADDRESS",
        help="device to be opened and read, as of the node driver, such as gcs:192.0.2.1; nothing is written to it; "
        "default: none",
    )
    command.add_argument(
        "--channels", metavar="NAME", nargs="+", default=[],
        help="the device's names of its axes; default: the first one of its kind",
    )  # fmt: skip
    command.add_argument("--no-ros", action="store_true", help="check the files only; default: also a running graph")


def run(options: Namespace) -> Result:
    """Run the command."""
    from importlib.util import find_spec

    from slpi_ros.io.bag_reader import read_bag
    from slpi_ros.model.document import load_model
    from slpi_ros.reports import doctor as report

    limits = None
    if (options.voltage_min is None) != (options.voltage_max is None):
        raise UsageError("--voltage-min and --voltage-max go together; give both or none")
    if options.voltage_min is not None:
        if not -math.inf < options.voltage_min < options.voltage_max < math.inf:
            raise UsageError(f"--voltage-min {options.voltage_min:g}: give a voltage below --voltage-max")
        limits = options.voltage_min, options.voltage_max
    if not 0.0 < options.seconds <= LONGEST_WATCH:
        raise UsageError(f"--seconds {options.seconds:g}: give a time of up to {LONGEST_WATCH:g} s")
    checks, model, files = [], None, [*options.bags, *filter(None, [options.model])]
    of_model = []
    if options.model:
        try:
            model = load_model(options.model)
            of_model = report.check_model(model, limits)
        except SlpiError as error:
            of_model = [report.Check(report.FAILED, str(error))]
    for bag in options.bags:
        report_progress(f"reading {bag}")
        try:
            checks += report.check_record(read_bag(bag, options.topic), model, limits)
        except SlpiError as error:
            checks.append(report.Check(report.FAILED, str(error)))
    checks += of_model
    table: list[str] = []
    if options.device:
        told, table = _read_device(options.device, options.channels)
        checks += told
    if options.device:
        checks.append(report.Check(report.NOTE, "ROS: not checked beside a device, which serves one program at a time"))
    elif options.no_ros or find_spec("rclpy") is None:
        why = "--no-ros" if options.no_ros else "no rclpy; source the setup file of ROS 2 to check a running graph"
        checks.append(
            report.Check(report.NOTE if files or options.no_ros else report.FAILED, f"ROS: not checked: {why}")
        )
    else:
        from slpi_ros.nodes.graph_probe import probe

        report_progress("watching the ROS graph")
        graph = probe(options.topic, options.command_topic, options.namespace, options.seconds)
        if graph.nodes or not files:
            checks += report.check_graph(graph, model)
        else:
            checks.append(report.Check(report.NOTE, "ROS: no node is running; only the files were checked"))
    verdict, lines, details = report.described(checks)
    if table:
        # All of it, as the YAML is to be copied.
        lines, details, verdict = [verdict, *table, *lines], [verdict, *table, *details], ""
    well = not any(check.level == report.FAILED for check in checks)
    if not well:
        failed = [check for check in report.worst_first(checks) if check.level == report.FAILED]
        next_command = next((check for check in failed if "; " in check.text), failed[0]).remedy
    elif options.device:
        next_command = "ros2 run slpi_ros driver --ros-args --params-file driver.yaml"
    elif options.bags and model is None:
        next_command = command_line("slpi", "identify", *options.bags, "-o", "model.json")
    elif options.bags:
        next_command = command_line("slpi", "verify", *options.bags, "--model", options.model)
    elif model is not None:
        next_command = f"slpi verify OTHER_BAG --model {shlex.quote(options.model)}"
    else:
        next_command = "slpi calibrate -o DIR --voltage-min V --voltage-max V"
    return Result(lines, report.doctor_document(checks), next_command, verdict, details, well)


def _read_device(device: str, channels: Sequence[str]) -> "tuple[list[Check], list[str]]":
    """Open a device and read it; return the checks, and the lines with its table and the YAML to start with."""
    from slpi_ros.drivers.base import Channel
    from slpi_ros.drivers.registry import FIRST_CHANNEL, make_device
    from slpi_ros.reports.device import SENSOR_SCALES, check_device, device_parameters, device_table
    from slpi_ros.reports.doctor import FAILED, Check

    kind, _, address = device.partition(":")
    dialect = address.partition(":")[0]
    names = list(channels) or [FIRST_CHANNEL.get(dialect) or FIRST_CHANNEL.get(kind, "1")]
    # Volts of the device, and metres as it tells its unit.
    opened = make_device(kind, address, [Channel(name, scale=SENSOR_SCALES.get(kind, math.nan)) for name in names])
    try:
        found = opened.open()
        cycle, positions = _cycle_of(opened)
        scales = [channel.scale for channel in opened.channels]
    except SlpiError as error:
        return [Check(FAILED, str(error))], []
    finally:
        opened.close()
    yaml = device_parameters(kind, address, found, names, cycle)
    checks = check_device(opened.name, found, names, positions)
    return checks, [*device_table(found, names, scales), "", "driver.yaml:", *yaml, ""]


def _cycle_of(device: "Device") -> "tuple[float, FloatArray]":
    """Return the time of one reading (s) of an open device, the median of several, and their positions (m, (N, n))."""
    import numpy as np

    times, positions = [], []
    for _ in range(TIMED):
        begun = time.perf_counter()
        positions.append(device.read().positions)
        times.append(time.perf_counter() - begun)
    return statistics.median(times), np.array(positions)
