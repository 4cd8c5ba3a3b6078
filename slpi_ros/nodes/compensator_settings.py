"""The settings that the compensator's parameters make."""

from dataclasses import dataclass
from math import inf

from slpi_ros.compensator.feedback import PidGains
from slpi_ros.compensator.loop import LoopSettings
from slpi_ros.compensator.validation import TimeRules
from slpi_ros.errors import UsageError
from slpi_ros.model.stream import Limits
from slpi_ros.nodes import compensator_parameters as ranges
from slpi_ros.nodes.parameters import Values, choice, number, numbers, whole

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
        desired_type = choice(values, "desired_type", ranges.DESIRED_TYPES)
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
            time=TimeRules(number(values, "time_jump", *ranges.JUMP), number(values, "max_age", *ranges.TIMEOUT)),
            safety=read_safety(values, axes),
            reset=ResetSettings(
                whole(values, "reset_cycles", *ranges.CYCLES),
                number(values, "reset_rate", *ranges.POSITIVE_RATE),
                choice(values, "reset_to", ranges.RESETS) == "safe",
            ),
            loops=read_loops(values, axes),
            drift_alarm=number(values, "drift_alarm", *ranges.FACTOR),
            desired_type=desired_type,
            autostart=values["autostart"],
            executor=choice(values, "executor", ranges.EXECUTORS),
            diagnostic_period=number(values, "diagnostic_period", *ranges.PERIOD),
            realtime_priority=whole(values, "realtime_priority", *ranges.PRIORITY),
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
    lower, upper = (numbers(values, name, axes, *ranges.VOLTAGE) for name in ("voltage_min", "voltage_max"))
    slew = numbers(values, "slew_limit", axes, *ranges.RATE)
    acceleration = numbers(values, "acceleration_limit", axes, *ranges.ACCELERATION)
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
        number(values, "command_timeout", *ranges.TIMEOUT),
        choice(values, "on_timeout", ranges.ENDS) == "safe",
        choice(values, "on_deactivate", ranges.ENDS) == "safe",
        tuple(numbers(values, "safe_voltage", axes, *ranges.VOLTAGE)),
        number(values, "ramp_rate", *ranges.POSITIVE_RATE),
    )


def read_loops(values: Values, axes: Axes) -> tuple[LoopSettings, ...]:
    """Return the feedback of each axis."""
    gains = [numbers(values, name, axes, *ranges.GAIN) for name in ("kp", "ki", "kd")]
    filters = numbers(values, "derivative_filter", axes, *ranges.FILTER)
    timeout = number(values, "measurement_timeout", *ranges.TIMEOUT)
    return tuple(
        LoopSettings(values["feedback"], PidGains(*each), timeout) for each in zip(*gains, filters, strict=True)
    )
