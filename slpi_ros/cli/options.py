"""Options that several commands share, and what follows from them."""

import math
import os
from argparse import Action, ArgumentError, ArgumentParser, ArgumentTypeError, Namespace
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from slpi_ros.cli.command import command_line
from slpi_ros.errors import SlpiError, UsageError

# Each command imports its modules when it runs: the numerical and plotting modules load slowly.
if TYPE_CHECKING:
    from slpi_ros.arrays import FloatArray
    from slpi_ros.io.alignment import SeparateTopics
    from slpi_ros.model.limits import Limits
    from slpi_ros.model.stage_model import StageModel
    from slpi_ros.workflows.records import Source


# Default topic with voltage and displacement.
TOPIC = "stage_state"


def add_bags(command: ArgumentParser, text: str = "") -> None:
    """Add the bags that are read; `text` continues their description."""
    command.add_argument(
        "bags", metavar="BAG", nargs="+", help=f"rosbag2 folder, or a single mcap or sqlite3 file{text}"
    )


def add_accept_stage(command: ArgumentParser) -> None:
    """Add ``--accept-stage``."""
    command.add_argument(
        "--accept-stage", metavar="NAME",
        help="accept the stage of this name as that of the model and the other records; default: refuse other stages",
    )  # fmt: skip


def add_output(command: ArgumentParser, metavar: str, text: str, *, required: bool = True) -> None:
    """Add ``-o`` and ``--overwrite``."""
    command.add_argument("-o", "--output", metavar=metavar, required=required, help=text)
    command.add_argument(
        "--overwrite", action="store_true", help="replace outputs that slpi did not write; default: refuse to"
    )


def add_axes(command: ArgumentParser, **options: Any) -> None:
    """Add ``--axis``."""
    command.add_argument("--axis", metavar="NAME", nargs="+", action=_UniqueNames, **options)


class _UniqueNames(Action):
    """Store a list of names and reject duplicates."""

    def __call__(
        self,
        parser: ArgumentParser,
        namespace: Namespace,
        values: str | Sequence[Any] | None,
        option_string: str | None = None,
    ) -> None:
        names = list(values or ())
        for name in names:
            if names.count(name) > 1:
                raise ArgumentError(self, f"'{name}' is given more than once; name each once")
        setattr(namespace, self.dest, names)


def add_span(command: ArgumentParser, of: str = "the fit") -> None:
    """Add ``--start`` and ``--stop`` `of` the part in use."""
    command.add_argument(
        "--start", metavar="S", type=seconds, help=f"start of {of}, s from the first stamp; default: 0"
    )
    command.add_argument(
        "--stop", metavar="S", type=seconds, help=f"end of {of}, s from the first stamp; default: the last"
    )


def seconds(text: str) -> float:
    """Return a finite number of seconds."""
    try:
        given = float(text)
    except ValueError:
        given = math.nan
    if not math.isfinite(given):
        raise ArgumentTypeError(f"{text!r} is no time; give a finite number of seconds, or leave the option out")
    return given


def add_sensor(command: ArgumentParser, default: str = "that of the model") -> None:
    """Add what may be known of the sensor."""
    command.add_argument(
        "--sensor-delay", metavar="S", type=_sensor_seconds,
        help=f"known delay of the sensor, s, taken out of its readings; default: {default}",
    )  # fmt: skip
    command.add_argument(
        "--sensor-lag", metavar="S", type=_sensor_seconds,
        help=f"known time constant of the sensor's low-pass filter, s, taken out of its readings; default: {default}",
    )  # fmt: skip


def _sensor_seconds(text: str) -> float:
    """Return a delay or lag of a sensor, seconds."""
    from slpi_ros.model.sensor import LONGEST

    given = seconds(text)
    if not 0.0 <= given <= LONGEST:
        raise ArgumentTypeError(f"{text} s; give seconds from 0 to {LONGEST:g}, such as 0.002 for 2 ms")
    return given


def add_limits(command: ArgumentParser, slew: str) -> None:
    """Add the limits of a drive; `slew` describes the slew limit."""
    command.add_argument("--voltage-min", metavar="V", type=float, required=True, help="lowest voltage")
    command.add_argument("--voltage-max", metavar="V", type=float, required=True, help="highest voltage")
    text = f"{slew}; default: the voltage range in 0.1 s; 0: no limit"
    command.add_argument("--slew-limit", "--slew", dest="slew_limit", metavar="V/S", type=float, help=text)


def add_inverse_limits(command: ArgumentParser, slew: str) -> None:
    """Add the limits of an inverse; `slew` describes the slew limit."""
    command.add_argument("--voltage-min", metavar="V", type=float, default=-math.inf, help="default: identified range")
    command.add_argument("--voltage-max", metavar="V", type=float, default=math.inf, help="default: identified range")
    text = f"{slew}; 0 (default): no limit"
    command.add_argument("--slew-limit", "--slew", dest="slew_limit", metavar="V/S", type=float, default=0.0, help=text)


def inverse_limits(options: Namespace) -> "Limits":
    """Return the limits that the options give; UsageError for an impossible slew limit."""
    from slpi_ros.model.limits import Limits

    if not options.slew_limit >= 0.0:
        raise UsageError(f"--slew-limit {options.slew_limit:g}: give a positive number of V/s, or 0 for no limit")
    return Limits(options.voltage_min, options.voltage_max, options.slew_limit or math.inf)


def slew_of(options: Namespace) -> float:
    """Return the slew limit (V/s) that the options select."""
    from slpi_ros.excitation.drives import slew_limits

    given = None if options.slew_limit is None else (options.slew_limit,)
    return slew_limits(given, (options.voltage_min,), (options.voltage_max,))[0]


def add_topic(command: ArgumentParser) -> None:
    """Add ``--topic``."""
    command.add_argument("--topic", default=TOPIC, help=f"topic with voltage and displacement; default: {TOPIC}")


def add_topics(command: ArgumentParser) -> None:
    """Add the options for one topic, or two."""
    command.add_argument("--topic", help=f"topic with voltage and displacement; default: {TOPIC}")
    command.add_argument(
        "--voltage-topic", metavar="TOPIC", help="for bags with separate topics: the voltage; default: none"
    )
    command.add_argument(
        "--displacement-topic", metavar="TOPIC", help="for separate topics: the displacement; default: none"
    )
    clocks = ("displacement", "voltage")
    command.add_argument("--clock", choices=clocks, help=f"for separate topics: sample times; default: {clocks[0]}")
    command.add_argument(
        "--voltage-measured", action="store_true",
        help="for separate topics: the voltage is measured, and interpolated between its messages; default: it is "
        "commanded, and held until the next one",
    )  # fmt: skip


def add_with(command: ArgumentParser, default: str) -> None:
    """Add ``--with``."""
    command.add_argument(
        "--with", dest="quantities", metavar="TOPIC[:FIELD]", nargs="+", action=_UniqueNames,
        help=f"recorded quantities that the stage may follow, such as a temperature or load; default: {default}",
    )  # fmt: skip


def quantities_beyond(model: "StageModel", t: "FloatArray", surroundings: "Mapping[str, FloatArray]") -> list[str]:
    """Return remarks on the quantities that a model follows and a table lacks, or has beyond what was recorded."""
    from slpi_ros.model.coverage import surroundings_beyond

    courses = {key: (t, values) for key, values in surroundings.items()}
    told = [surroundings_beyond(axis.surrounded(courses), t) for axis in model.axes.values()]
    return [one for one in dict.fromkeys(told) if one]


def require_usable(model: "StageModel", surroundings: "Mapping[str, FloatArray]", table: str) -> None:
    """Raise UsageError for values of a quantity that the compensator would not use: another unit, a broken sensor."""
    import numpy as np

    from slpi_ros.compensator.surroundings import Surrounding

    for axis in model.axes.values():
        for one in axis.followed:
            values, (low, high) = surroundings.get(one.key), Surrounding(one).accepted
            if values is not None and low < high and not (np.min(values) >= low and np.max(values) <= high):
                raise UsageError(
                    f"{table}: {one.key} goes from {np.min(values):.5g} to {np.max(values):.5g}, far outside of what "
                    f"was recorded ({low:.5g} to {high:.5g} are taken); is its unit that of the record?"
                )


def source_of(options: Namespace) -> "Source":
    """Return bags, topics, axes and part of the records that the options select."""
    topic = _topics_of(options) if "voltage_topic" in options else options.topic
    from slpi_ros.workflows.records import Source

    start, stop = getattr(options, "start", None), getattr(options, "stop", None)
    from slpi_ros.io.stage_name import acceptance

    accepted = getattr(options, "accept_stage", None) or ""
    if accepted:
        options.remarks.append(acceptance(accepted, "--accept-stage"))
    quantities = getattr(options, "quantities", None)
    return Source(options.bags, topic, options.axis, start, stop, surroundings=quantities, accept_stage=accepted)


def _topics_of(options: Namespace) -> "str | SeparateTopics":
    """Return the topic or topics of voltage and displacement that the options select."""
    from slpi_ros.io.alignment import SeparateTopics

    voltage, displacement = options.voltage_topic, options.displacement_topic
    if bool(voltage) != bool(displacement):
        raise UsageError("--voltage-topic and --displacement-topic go together; give both, or --topic")
    if voltage and options.topic is not None:
        raise UsageError("--topic excludes --voltage-topic and --displacement-topic; give either the one or the two")
    if voltage:
        held = not options.voltage_measured
        return SeparateTopics(voltage, displacement, clock=options.clock or "displacement", held=held)
    if options.clock or options.voltage_measured:
        raise UsageError(
            "--clock and --voltage-measured are for --voltage-topic and --displacement-topic: give both topics; where "
            "one message holds both signals, as in imported tables, leave these options out, whatever the voltage is"
        )
    return TOPIC if options.topic is None else str(options.topic)


def with_sensor(model: "StageModel", options: Namespace) -> "StageModel":
    """Return the model with the delay and lag of the sensor that the options give; remark where these are others."""
    axes = [axis for axis in options.axis or model.axes if axis in model.axes]
    known = model.with_sensor(delay=options.sensor_delay, lag=options.sensor_lag, axes=axes)
    told = [
        f"axis '{axis}': {one.sensor.describe()} given, {model.axes[axis].sensor.describe()} in the model"
        for axis, one in known.axes.items()
        if one.sensor != model.axes[axis].sensor
    ]
    if told:
        options.remarks.append(f"the given timing of the sensor is used: {'; '.join(told)}")
    return known


def same_record(options: Namespace) -> list[str]:
    """Return the options that select topics, axes and a part of a record, as they were given."""
    words = []
    names = ["topic", "voltage_topic", "displacement_topic", "clock", "start", "stop"]
    # The model of `slpi identify` keeps what is known of the sensor.
    names += [] if options.command == "identify" else ["sensor_delay", "sensor_lag"]
    for name in names:
        value = getattr(options, name, None)
        if value is not None and (name, value) != ("topic", TOPIC):
            words.append(f"--{name.replace('_', '-')}={value}")
    if getattr(options, "voltage_measured", False):
        words.append("--voltage-measured")
    if getattr(options, "quantities", None):
        words += ["--with", *options.quantities]
    if options.axis:
        words += ["--axis", *options.axis]
    return words


def diagnosis_of(options: Namespace, model: str) -> str:
    """Return the command that diagnoses a model on the same records."""
    words = ["--model", model, "-o", "diagnosis", *same_record(options)]
    return command_line("slpi", "diagnose", *options.bags, *words)


def require_axis_names(axes: Sequence[str]) -> None:
    """Raise UsageError for something that is no name of a new axis."""
    from slpi_ros.io.record import is_axis_name

    for axis in axes:
        if "," in axis or not axis.strip() or not is_axis_name(axis):
            raise UsageError(f"--axis {axis!r}: no name of an axis; for two axes write --axis x y")


def require_another_file(output: str, *inputs: str) -> None:
    """Raise UsageError if the output file is one of the inputs, or lies in the folder of an input bag."""
    for path in map(Path, inputs):
        # Of a link that leads to itself, `Path.resolve` makes an error of its own.
        real, written = Path(os.path.realpath(path)), Path(os.path.realpath(output))
        same = path.samefile(output) if path.exists() and Path(output).exists() else real == written
        if same or (path.is_dir() and real in written.parents):
            raise UsageError(f"{output}: is also read from; give another output (-o)")


def allow_model_and_report(options: Namespace) -> None:
    """Check that ``-o`` and ``--report`` may be written."""
    from slpi_ros.io.outputs import allow_document

    require_another_file(options.output, *options.bags)
    options.remarks += allow_document(options.output, "model", overwrite=options.overwrite)
    if options.report:
        allow_folder(options, options.report, "report.html")


def allow_folder(options: Namespace, folder: str, *names: str, inputs: Sequence[str] = ()) -> None:
    """Check that these files may be written into a folder, and that none of them is a bag or one of the inputs."""
    from slpi_ros.io.outputs import allow_folder

    for name in names:
        require_another_file(str(Path(folder) / name), *options.bags, *inputs)
    options.remarks += allow_folder(folder, *names, overwrite=options.overwrite)


def model_columns(columns: "dict[str, FloatArray]", model: "StageModel", table: str) -> "dict[str, FloatArray]":
    """Return the columns of a table; SlpiError if the model lacks one of their axes."""
    for axis in columns:
        if axis not in model.axes:
            raise SlpiError(
                f"{table}: column of axis '{axis}', but the model has axes {', '.join(model.axes)}; rename the column"
            )
    return columns
