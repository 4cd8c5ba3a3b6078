"""Parameters of the compensator, and the settings they make."""

from dataclasses import dataclass
from math import inf

from slpi_ros.errors import UsageError
from slpi_ros.nodes.parameters import Declaration, Values, choice, number, numbers
from slpi_ros.stream import Limits

DESIRED_TYPES = ("JointState", "Float64", "Float64MultiArray")
EXECUTORS = ("events", "default")

VOLTAGE = (-10_000.0, 10_000.0)
SLEW = (0.0, 1e9)
TIMEOUT = (0.0, 86_400.0)
PERIOD = (0.05, 3600.0)

DECLARATIONS = (
    Declaration(
        "axes", ["x"], "Names of the axes; voltage_command holds their voltages in this order.", read_only=True
    ),
    Declaration(
        "model_file", "",
        "Model document to start with; empty: wait for one on stage_model. A change counts when configured next.",
    ),
    Declaration(
        "voltage_min", 0.0,
        "Lowest voltage ever given, volts; one value, or one for each axis.", between=VOLTAGE, number=True,
    ),
    Declaration(
        "voltage_max", 100.0,
        "Highest voltage ever given, volts; one value, or one for each axis.", between=VOLTAGE, number=True,
    ),
    Declaration(
        "slew_limit", 0.0,
        "Fastest change of a voltage, volts per second; one value, or one for each axis. 0: as fast as asked.",
        between=SLEW, number=True,
    ),
    Declaration(
        "command_timeout", 0.0,
        "Seconds without an accepted command until the next report on /diagnostics warns; voltages are held. 0: never.",
        between=TIMEOUT, number=True,
    ),
    Declaration(
        "desired_type", "JointState",
        "Type of desired_displacement, metres: JointState (axes by name), Float64 (for one axis) or Float64MultiArray "
        "(in the order of axes).",
        read_only=True,
    ),
    Declaration("autostart", True, "Whether the node configures and activates itself.", read_only=True),
    Declaration(
        "executor", "events", "Executor that spins the node: events (fast) or default (in every rclpy).", read_only=True
    ),
    Declaration("hardware_id", "", "The stage, as /diagnostics names it; empty: as the model does.", read_only=True),
    Declaration(
        "diagnostic_period", 1.0,
        "Seconds between two reports on /diagnostics.", read_only=True, between=PERIOD, number=True,
    ),
)  # fmt: skip


@dataclass(frozen=True)
class CompensatorSettings:
    """What the compensator is told by its parameters.

    Parameters
    ----------
    axes : tuple of str
    model_file : str
    limits : tuple of Limits
        One for each axis.
    command_timeout : float, seconds
        0: none.
    desired_type : str
    autostart : bool
    executor : str
    hardware_id : str
    diagnostic_period : float, seconds
    """

    axes: tuple[str, ...]
    model_file: str
    limits: tuple[Limits, ...]
    command_timeout: float
    desired_type: str
    autostart: bool
    executor: str
    hardware_id: str
    diagnostic_period: float

    @classmethod
    def of(cls, values: Values) -> "CompensatorSettings":
        """Make the settings of all parameters by name.

        Raises
        ------
        UsageError
            If a value, or what they say together, makes no sense.
        """
        axes = read_axes(values["axes"])
        desired_type = choice(values, "desired_type", DESIRED_TYPES)
        if desired_type == "Float64" and len(axes) > 1:
            raise UsageError(
                f"desired_type Float64 holds one value, but axes are {', '.join(axes)}; "
                "use Float64MultiArray or JointState"
            )
        return cls(
            axes=axes,
            model_file=values["model_file"],
            limits=read_limits(values, axes),
            command_timeout=number(values, "command_timeout", *TIMEOUT),
            desired_type=desired_type,
            autostart=values["autostart"],
            executor=choice(values, "executor", EXECUTORS),
            hardware_id=values["hardware_id"],
            diagnostic_period=number(values, "diagnostic_period", *PERIOD),
        )


def read_axes(given: list[str]) -> tuple[str, ...]:
    """Return the names of the axes; UsageError unless there are some, each with a name of its own."""
    if not given or not all(given) or len(set(given)) != len(given):
        raise UsageError(f"parameter axes is {list(given)!r}; name at least one axis, and each once")
    return tuple(given)


def read_limits(values: Values, axes: tuple[str, ...]) -> tuple[Limits, ...]:
    """Return the limits of each axis; UsageError where they leave no voltage."""
    lower, upper = (numbers(values, name, axes, *VOLTAGE) for name in ("voltage_min", "voltage_max"))
    slew = numbers(values, "slew_limit", axes, *SLEW)
    for name, low, high in zip(axes, lower, upper, strict=True):
        if not low < high:
            raise UsageError(
                f"axis '{name}': voltage_min {low:g} V is not below voltage_max {high:g} V; "
                "leave some voltage between them"
            )
    return tuple(Limits(low, high, fastest or inf) for low, high, fastest in zip(lower, upper, slew, strict=True))
