"""The compensator's parameters: what `ros2 param describe` shows."""

from dataclasses import dataclass
from math import inf

from slpi_ros.compensator.feedback import LoopSettings, PidGains
from slpi_ros.compensator.validation import TimeRules
from slpi_ros.errors import UsageError
from slpi_ros.model.limits import Limits
from slpi_ros.nodes.parameters import Declaration, Values, choice, number, numbers, whole

DESIRED_TYPES = ("JointState", "Float64", "Float64MultiArray")
EXECUTORS = ("events", "default")
ENDS = ("hold", "safe")
RESETS = ("present", "safe")

VOLTAGE = (-10_000.0, 10_000.0)
RATE = (0.0, 1e9)
POSITIVE_RATE = (1e-3, 1e9)
ACCELERATION = (0.0, 1e12)
TIMEOUT = (0.0, 86_400.0)
PERIOD = (0.05, 3600.0)
JUMP = (1e-3, 86_400.0)
GAIN = (0.0, 1e15)
FILTER = (0.0, 1e3)
FACTOR = (0.0, 1e6)
CYCLES = (1, 1000)
PRIORITY = (0, 99)

EACH = "one value, or one for each axis"


def each_axis(name: str, default: float, description: str, between: tuple[float, float]) -> Declaration:
    """Declare a number that each axis may have its own of."""
    return Declaration(name, default, f"{description} {EACH.capitalize()}.", between=between, number=True)


def scalar(
    name: str, default: float, description: str, between: tuple[float, float], read_only: bool = False
) -> Declaration:
    """Declare a number."""
    return Declaration(name, default, description, read_only, between, number=True)


def fixed(name: str, default: object, description: str) -> Declaration:
    """Declare what only the start of the node may set."""
    return Declaration(name, default, description, read_only=True)


DECLARATIONS = (
    fixed("axes", ["x"], "Names of the axes; voltage_command holds their voltages in this order."),
    Declaration(
        "model_file", "",
        "Model document to start with; empty: wait for one on stage_model. A change counts when configured next.",
    ),
    fixed("hardware_id", "", "The stage; models of another one are refused. Empty: any model, named as it says."),
    # Limits
    each_axis("voltage_min", 0.0, "Lowest voltage ever given, volts.", VOLTAGE),
    each_axis("voltage_max", 100.0, "Highest voltage ever given, volts.", VOLTAGE),
    each_axis("slew_limit", 0.0, "Fastest change of a voltage, V/s; 0: as fast as asked.", RATE),
    each_axis(
        "acceleration_limit", 0.0, "Fastest change of the slew, V/s^2; 0: none. The voltage then stops gently.",
        ACCELERATION,
    ),
    # Commands
    fixed(
        "desired_type", "JointState",
        "Type of desired_displacement, metres: JointState (axes by name), Float64 (for one axis) or Float64MultiArray "
        "(in the order of axes).",
    ),
    scalar(
        "time_jump", 1.0,
        "Seconds. A stamp older than the last one by at most this is late and rejected, by more: the clock was set "
        "back and time starts anew. Newer by more: a gap, counted.",
        JUMP,
    ),
    scalar("max_age", 0.0, "Seconds; a message stamped longer ago is rejected as stale. 0: none is.", TIMEOUT),
    scalar(
        "command_timeout", 0.0,
        "Seconds without an accepted command until on_timeout happens and /diagnostics warns. 0: never.",
        TIMEOUT,
    ),
    # Safe ends
    Declaration("on_timeout", "hold", "When commands stop: hold the voltage, or go to the safe one (hold or safe)."),
    Declaration(
        "on_deactivate", "hold",
        "When deactivated or shut down: hold the voltage, or first go to the safe one (hold or safe).",
    ),
    each_axis("safe_voltage", 0.0, "The safe voltage, volts.", VOLTAGE),
    scalar("ramp_rate", 50.0, "How fast to go to the safe voltage, V/s; slew_limit may be lower.", POSITIVE_RATE),
    # Memory
    Declaration(
        "reset_cycles", 10, "Cycles of the decaying oscillation of reset_memory, from full range to none.",
        between=CYCLES,
    ),
    scalar(
        "reset_rate", 200.0, "How fast reset_memory drives, V/s; slew_limit may be lower.", POSITIVE_RATE
    ),
    Declaration("reset_to", "present", "Where reset_memory ends: present (where it began) or safe (the safe voltage)."),
    fixed("memory_file", "", "File that keeps the memory over a restart; empty: none."),
    # Feedback
    Declaration("feedback", False, "Whether measured_displacement corrects the voltage."),
    each_axis("kp", 0.0, "Proportional gain of the feedback, V/m.", GAIN),
    each_axis("ki", 0.0, "Integral gain of the feedback, V/(m s).", GAIN),
    each_axis("kd", 0.0, "Derivative gain of the feedback, V s/m, on the measured displacement.", GAIN),
    each_axis("derivative_filter", 0.0, "Time constant of the low-pass on the derivative, seconds; 0: none.", FILTER),
    scalar("measurement_timeout", 0.1, "Seconds; an older measurement does not act: the correction is held.", TIMEOUT),
    scalar(
        "drift_alarm", 3.0,
        "/diagnostics warns when measurements are off the model by this many times its held-out error, rms; 0: never.",
        FACTOR,
    ),
    # The node
    fixed("autostart", True, "Whether the node configures and activates itself."),
    fixed("executor", "events", "Executor that spins the node: events (fast) or default (in every rclpy)."),
    scalar("diagnostic_period", 1.0, "Seconds between two reports on /diagnostics.", PERIOD, read_only=True),
    Declaration(
        "realtime_priority", 0, "Priority under SCHED_FIFO, 1 to 99, where the system allows it; 0: as any process.",
        read_only=True, between=PRIORITY,
    ),
)  # fmt: skip

Axes = tuple[str, ...]


@dataclass(frozen=True)
class Safety:
    """What happens when commands end.

    Parameters
    ----------
    command_timeout : float, seconds
        0: none.
    ramps_on_timeout, ramps_on_deactivate : bool
        Whether to go to the safe voltages then; if not, voltages are held.
    voltages : tuple of float, volts
        The safe ones, one for each axis.
    rate : float, V/s
        How fast to go there.
    """

    command_timeout: float
    ramps_on_timeout: bool
    ramps_on_deactivate: bool
    voltages: tuple[float, ...]
    rate: float


@dataclass(frozen=True)
class ResetSettings:
    """How the memory is reset.

    Parameters
    ----------
    cycles : int
    rate : float, V/s
    to_safe : bool
        Whether it ends at the safe voltages, not at the present ones.
    """

    cycles: int
    rate: float
    to_safe: bool


@dataclass(frozen=True)
class CompensatorSettings:
    """What the compensator is told by its parameters.

    Parameters
    ----------
    axes : tuple of str
    model_file, hardware_id, memory_file : str
    limits : tuple of Limits
        One for each axis.
    time : TimeRules
    safety : Safety
    reset : ResetSettings
    loops : tuple of LoopSettings
        One for each axis.
    drift_alarm : float
        Warn when measurements are off by so many times the held-out error; 0: never.
    desired_type : str
    autostart : bool
    executor : str
    diagnostic_period : float, seconds
    realtime_priority : int
        0: none.
    """

    axes: Axes
    model_file: str
    hardware_id: str
    memory_file: str
    limits: tuple[Limits, ...]
    time: TimeRules
    safety: Safety
    reset: ResetSettings
    loops: tuple[LoopSettings, ...]
    drift_alarm: float
    desired_type: str
    autostart: bool
    executor: str
    diagnostic_period: float
    realtime_priority: int

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
        settings = cls(
            axes=axes,
            model_file=values["model_file"],
            hardware_id=values["hardware_id"],
            memory_file=values["memory_file"],
            limits=read_limits(values, axes),
            time=TimeRules(number(values, "time_jump", *JUMP), number(values, "max_age", *TIMEOUT)),
            safety=read_safety(values, axes),
            reset=ResetSettings(
                whole(values, "reset_cycles", *CYCLES),
                number(values, "reset_rate", *POSITIVE_RATE),
                choice(values, "reset_to", RESETS) == "safe",
            ),
            loops=read_loops(values, axes),
            drift_alarm=number(values, "drift_alarm", *FACTOR),
            desired_type=desired_type,
            autostart=values["autostart"],
            executor=choice(values, "executor", EXECUTORS),
            diagnostic_period=number(values, "diagnostic_period", *PERIOD),
            realtime_priority=whole(values, "realtime_priority", *PRIORITY),
        )
        settings._require_safe_voltages()
        return settings

    def _require_safe_voltages(self) -> None:
        safety = self.safety
        if not (safety.ramps_on_timeout or safety.ramps_on_deactivate or self.reset.to_safe):
            return
        for name, limits, voltage in zip(self.axes, self.limits, safety.voltages, strict=True):
            if not limits.lower <= voltage <= limits.upper:
                raise UsageError(
                    f"axis '{name}': safe_voltage {voltage:g} V is outside voltage_min..voltage_max, "
                    f"{limits.lower:g}..{limits.upper:g} V; choose one inside"
                )


def read_axes(given: list[str]) -> Axes:
    """Return the names of the axes; UsageError unless there are some, each with a name of its own."""
    if not given or not all(given) or len(set(given)) != len(given):
        raise UsageError(f"parameter axes is {list(given)!r}; name at least one axis, and each once")
    return tuple(given)


def read_limits(values: Values, axes: Axes) -> tuple[Limits, ...]:
    """Return the limits of each axis; UsageError where they leave no voltage."""
    lower, upper = (numbers(values, name, axes, *VOLTAGE) for name in ("voltage_min", "voltage_max"))
    slew = numbers(values, "slew_limit", axes, *RATE)
    acceleration = numbers(values, "acceleration_limit", axes, *ACCELERATION)
    for name, low, high in zip(axes, lower, upper, strict=True):
        if not low < high:
            raise UsageError(
                f"axis '{name}': voltage_min {low:g} V is not below voltage_max {high:g} V; "
                "leave some voltage between them"
            )
    each = zip(lower, upper, slew, acceleration, strict=True)
    return tuple(Limits(low, high, fastest or inf, sharpest or inf) for low, high, fastest, sharpest in each)


def read_safety(values: Values, axes: Axes) -> Safety:
    """Return what happens when commands end."""
    return Safety(
        number(values, "command_timeout", *TIMEOUT),
        choice(values, "on_timeout", ENDS) == "safe",
        choice(values, "on_deactivate", ENDS) == "safe",
        tuple(numbers(values, "safe_voltage", axes, *VOLTAGE)),
        number(values, "ramp_rate", *POSITIVE_RATE),
    )


def read_loops(values: Values, axes: Axes) -> tuple[LoopSettings, ...]:
    """Return the feedback of each axis."""
    gains = [numbers(values, name, axes, *GAIN) for name in ("kp", "ki", "kd")]
    filters = numbers(values, "derivative_filter", axes, *FILTER)
    timeout = number(values, "measurement_timeout", *TIMEOUT)
    return tuple(
        LoopSettings(values["feedback"], PidGains(*each), timeout) for each in zip(*gains, filters, strict=True)
    )
