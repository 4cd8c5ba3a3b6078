"""Parameters of the compensator: one table for their declaration, validation and documentation in the README."""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from math import nan
from typing import Any

from slpi_ros.compensator.feedback import LoopSettings, PidGains
from slpi_ros.compensator.loop_filter import Notch, notches_of
from slpi_ros.compensator.motion import Safety
from slpi_ros.compensator.ownership import STARTS
from slpi_ros.compensator.validation import TimestampRules
from slpi_ros.errors import UsageError
from slpi_ros.model.axis_model import START_MEMORIES
from slpi_ros.model.limits import Limits
from slpi_ros.nodes import parameters as declare
from slpi_ros.nodes.parameters import Declaration, Values, limits_of, validated

POSITIVE_RATE = (1e-3, 1e9)
TIMEOUT = (0.0, 86_400.0)
GAIN = (0.0, 1e15)
HOLD_OR_SAFE = ("hold", "safe")
# Default correction limit: this share of the voltage range.
DEFAULT_CORRECTION = 0.2

DECLARATIONS = (
    declare.AXES,
    declare.path(
        "model_file",
        "Model document to load; empty: wait for stage_model. A change takes effect at the next configure; one that "
        "cannot be read is refused.",
    ),
    declare.text(
        "hardware_id", "",
        "Hardware id of the stage: model and stage_state must agree with it. Empty: they must agree with each other.",
        read_only=True,
    ),
    declare.ACCEPT_STAGE,
    declare.text(
        "model_sha256", "",
        "SHA-256 of the only model document that is accepted, 64 hexadecimal digits: `sha256sum MODEL.json`. "
        "Empty: any.",
        read_only=True,
    ),
    # Limits
    *declare.voltage_limits(low=0.0, high=100.0),
    declare.ACCELERATION_LIMIT,
    declare.MEAN_RATE_LIMIT,
    declare.scalar(
        "output_rate", 1000.0,
        "Voltages per second while a trajectory, a ramp, a hold or what the limits held back is output, hertz. In one "
        "step a voltage changes by at most two periods of the slew limit.",
        (1.0, 20_000.0),
    ),
    # Start
    declare.text(
        "start_voltage", "auto",
        "Where the first voltage starts from: auto (as stage_state reports in effort; without a publisher of it as "
        "saved, else as the record of the model ended), measured (as reported, and nothing before), saved (as saved or "
        "recorded), or a number, volts. One value, or one for each axis, separated by commas.",
        read_only=True,
    ),
    Declaration(
        "rearm", False,
        "Whether the node goes on by itself when somebody else has moved the stage and the reported voltages are "
        "steady; if false, ~/arm does that.",
    ),
    # Trajectories
    declare.text(
        "trajectory_output", "stream",
        "stream: a trajectory is output sample by sample. block: as voltages in one message on voltage_trajectory, for "
        "a driver that plays it by the device's clock.",
        "stream", "block", read_only=True,
    ),
    # Commands
    declare.text(
        "desired_type", "JointState",
        "Type of desired_displacement, metres: JointState (axes by name), Float64 (for one axis) or Float64MultiArray "
        "(in the order of axes).",
        "JointState", "Float64", "Float64MultiArray", read_only=True,
    ),
    declare.scalar(
        "time_jump", 1.0,
        "Seconds. A stamp older than the last one by at most this is rejected as late; by more, the clock was set back "
        "and time restarts. Newer by more is counted as a gap.",
        (1e-3, 86_400.0),
    ),
    declare.scalar("max_age", 0.0, "Seconds; a message stamped longer ago is rejected as stale. 0: no check.", TIMEOUT),
    declare.scalar(
        "command_timeout", 0.0,
        "Watchdog, seconds without an accepted command until on_timeout applies and /diagnostics warns. 0: disabled.",
        TIMEOUT,
    ),
    # Safe voltages
    declare.text(
        "on_timeout", "hold", "At command_timeout: hold the voltage, or ramp to safe_voltage (hold or safe).",
        *HOLD_OR_SAFE,
    ),
    declare.text(
        "on_deactivate", "hold",
        "At deactivation or shutdown: hold the voltage, or first ramp to safe_voltage (hold or safe).",
        *HOLD_OR_SAFE,
    ),
    declare.each_axis("safe_voltage", 0.0, "Safe voltage, volts.", declare.VOLTAGE),
    declare.scalar(
        "ramp_rate", 50.0, "Rate of the ramp to safe_voltage, V/s, at most 80 % of slew_limit.", POSITIVE_RATE,
    ),
    Declaration(
        "surroundings", [""],
        "Topics, topic:field, of the recorded quantities that the stage follows (temperature, load); empty: as the "
        "model names them. Others than the model's are taken in its order.",
    ),
    # Memory
    declare.text(
        "start_memory", "end",
        "Initial state: that at the end of the model's record, at the start of the record, or after a reset (end, "
        "start or wiped). A memory_file takes precedence.",
        *START_MEMORIES,
    ),
    Declaration(
        "reset_on_start", False, "Whether to reset the memory after activation, before commands are accepted.",
    ),
    Declaration(
        "reset_cycles", 10, "Cycles of the decaying oscillation of reset_memory, from full range to none.",
        between=(1, 1000),
    ),
    declare.scalar(
        "reset_rate", 200.0, "Voltage rate of reset_memory, V/s, at most 80 % of slew_limit.", POSITIVE_RATE
    ),
    declare.each_axis("reset_min", nan, "Lowest voltage of reset_memory, volts; NaN: voltage_min.", declare.VOLTAGE),
    declare.each_axis("reset_max", nan, "Highest voltage of reset_memory, volts; NaN: voltage_max.", declare.VOLTAGE),
    declare.text(
        "reset_to", "present", "Final voltage of reset_memory: present (before the reset) or safe (safe_voltage).",
        "present", "safe",
    ),
    declare.path("memory_file", "File that stores the memory for the next start; empty: none.", read_only=True),
    # Feedback
    Declaration("feedback", False, "Whether PID feedback of measured_displacement corrects the voltage."),
    declare.each_axis("kp", 0.0, "Proportional gain of the feedback, V/m.", GAIN),
    declare.each_axis("ki", 0.0, "Integral gain of the feedback, V/(m s).", GAIN),
    declare.each_axis("kd", 0.0, "Derivative gain of the feedback, V s/m, on the measured displacement.", GAIN),
    declare.each_axis(
        "derivative_filter", 0.0, "Time constant of the derivative low-pass, seconds; 0: none.", (0.0, 1e3)
    ),
    declare.each_axis(
        "measurement_filter", 0.0,
        "Time constant of a first-order low-pass of what the feedback takes of the readings, seconds; 0: none.",
        (0.0, 1e3),
    ),
    declare.list_of_each_axis(
        "notch_frequency", 0.0,
        "Frequencies of the notches of the feedback of an axis, one for each mode, hertz, below half of output_rate; "
        "[0.0]: none.",
        (0.0, 1e4),
    ),
    declare.list_of_each_axis(
        "notch_damping", 0.0,
        "Damping of the numerator of these notches, that of the mode or more. One value, or one for each notch.",
        (0.0, 10.0),
    ),
    declare.list_of_each_axis(
        "notch_width", 1.0, "Damping of the denominator of these notches: the width. One value, or one for each notch.",
        (1e-3, 10.0),
    ),
    Declaration(
        "force_gains", False,
        "Whether gains are taken with which the loop of the model is unstable or barely stable (modulus margin below "
        "0.3); else feedback stays off with them.",
    ),
    declare.each_axis(
        "correction_limit", nan,
        "Largest voltage that the feedback adds or subtracts, volts; NaN: a fifth of the voltage range.",
        (0.0, 20_000.0),
    ),
    declare.scalar(
        "feedback_fault_time", 0.5,
        "Seconds for which a sensor is silent, stuck, inverted or noisy before the feedback is switched off; 0: never.",
        TIMEOUT,
    ),
    declare.scalar(
        "measurement_timeout", 0.1, "Seconds; feedback holds, and ignores measurements with older stamps.", TIMEOUT,
    ),
    declare.scalar(
        "drift_alarm", 3.0,
        "/diagnostics warns if the rms of measured - model exceeds this many times the held-out error; 0: never.",
        (0.0, 1e6),
    ),
    # Learning
    declare.text(
        "learn", "off",
        "Whether a desired_trajectory that comes again is corrected by what its passes measured: off, on, or hold "
        "(what was learned is used, and no more is learned). Kept in files beside memory_file.",
        "off", "on", "hold",
    ),
    declare.scalar(
        "learn_period", 0.0,
        "Period of the axes that repeat within a trajectory, seconds: each period is a pass (the fast axis of a "
        "raster, while the slow one moves on). 0: a trajectory is one pass.",
        TIMEOUT,
    ),
    declare.each_axis(
        "learn_limit", nan,
        "Most that learning adds to a desired displacement, metres; NaN: a quarter of the stroke.", (1e-12, 1.0),
    ),
    # The node
    Declaration("autostart", True, "Whether the node configures and activates itself.", read_only=True),
    declare.text(
        "executor", "events", "Executor of the node: events (fast) or default (available in every rclpy).",
        "events", "default", read_only=True,
    ),
    declare.DIAGNOSTIC_PERIOD,
    declare.REALTIME_PRIORITY,
)  # fmt: skip


@dataclass(frozen=True)
class CompensatorSettings:
    """Validated settings of the compensator; tuples hold one value for each axis."""

    values: Mapping[str, Any]  # all parameters by name; a tuple where axes may differ
    limits: tuple[Limits, ...]
    starts: tuple[str | float, ...]
    reset_spans: tuple[tuple[float, float], ...]  # lowest and highest voltage (V) of the reset
    period: float  # s, of the output
    time: TimestampRules
    safety: Safety
    loops: tuple[LoopSettings, ...]

    @classmethod
    def of(cls, given: Values) -> "CompensatorSettings":
        """Return the settings from a mapping of parameter names to values."""
        axes, values = given["axes"], validated(DECLARATIONS, given)
        if values["desired_type"] == "Float64" and len(axes) > 1:
            raise UsageError(
                f"desired_type Float64 holds one value, but axes are {', '.join(axes)}; "
                "use Float64MultiArray or JointState"
            )
        if not re.fullmatch("([0-9a-f]{64})?", values["model_sha256"]):
            raise UsageError(
                f"model_sha256 {values['model_sha256']!r} is not 64 hexadecimal digits in lower case; give the output "
                "of sha256sum, or nothing"
            )
        numbers = (values[name] for name in ("kp", "ki", "kd", "derivative_filter", "measurement_filter"))
        gains = zip(*numbers, _notches(values), strict=True)
        timeout = values["measurement_timeout"]
        limits = limits_of(values)
        ranges = [each.upper - each.lower for each in limits]
        corrections = values["correction_limit"] or [DEFAULT_CORRECTION * width for width in ranges]
        settings = cls(
            values,
            limits,
            _starts(values),
            _reset_spans(values, limits),
            1.0 / values["output_rate"],
            TimestampRules(values["time_jump"], values["max_age"]),
            Safety(
                values["command_timeout"],
                values["on_timeout"] == "safe",
                values["on_deactivate"] == "safe",
                values["safe_voltage"],
                values["ramp_rate"],
            ),
            tuple(
                LoopSettings(values["feedback"], PidGains(*each), timeout, most, values["force_gains"])
                for each, most in zip(gains, corrections, strict=True)
            ),
        )
        settings._require_safe_voltages()
        return settings

    def _require_safe_voltages(self) -> None:
        safety = self.safety
        if not (safety.ramps_on_timeout or safety.ramps_on_deactivate or self.values["reset_to"] == "safe"):
            return
        for name, limits, voltage in zip(self.values["axes"], self.limits, safety.voltages, strict=True):
            if not limits.lower <= voltage <= limits.upper:
                raise UsageError(
                    f"axis '{name}': safe_voltage {voltage:g} V is outside voltage_min..voltage_max, "
                    f"{limits.lower:g}..{limits.upper:g} V; choose one inside"
                )


def _notches(values: Mapping[str, Any]) -> list[tuple[Notch, ...]]:
    """Return the notches of each axis; UsageError for numbers of another count, or above half of output_rate."""
    lists = (values[f"notch_{name}.AXIS"] for name in ("frequency", "damping", "width"))
    each = zip(values["axes"], *lists, strict=True)
    return [notches_of(axis, f, d, w, values["output_rate"]) for axis, f, d, w in each]


def _starts(values: Mapping[str, Any]) -> tuple[str | float, ...]:
    """Return the start voltage of each axis; UsageError if it is neither a word of `STARTS` nor a voltage in limits."""
    given, axes = values["start_voltage"], values["axes"]
    words = [each.strip() for each in given.split(",")]
    words *= len(axes) if len(words) == 1 else 1
    starts = [_start(word) for word in words]
    limits = zip(values["voltage_min"], values["voltage_max"], strict=True)
    within = [isinstance(each, str) or low <= each <= high for each, (low, high) in zip(starts, limits, strict=False)]
    if len(starts) != len(axes) or not all(within):
        raise UsageError(
            f"parameter start_voltage is {given!r}; give {', '.join(STARTS)} or a voltage within the limits, or one of "
            f"these for each of the axes {', '.join(axes)}, separated by commas"
        )
    return tuple(starts)


def _start(word: str) -> str | float:
    """Return a word of `STARTS`, or the voltage (V) that it names; NaN if it is neither."""
    if word in STARTS:
        return word
    try:
        return float(word)
    except ValueError:
        return nan


def _reset_spans(values: Mapping[str, Any], limits: tuple[Limits, ...]) -> tuple[tuple[float, float], ...]:
    """Return the voltages of the reset of each axis; UsageError if they are not within the limits in this order."""
    lows = values["reset_min"] or [each.lower for each in limits]
    highs = values["reset_max"] or [each.upper for each in limits]
    for name, each, low, high in zip(values["axes"], limits, lows, highs, strict=True):
        if not each.lower <= low < high <= each.upper:
            raise UsageError(
                f"axis '{name}': reset_min {low:g} V, reset_max {high:g} V; give the lower one first, both within "
                f"voltage_min..voltage_max, {each.lower:g}..{each.upper:g} V"
            )
    return tuple(zip(lows, highs, strict=True))
