"""The compensator's parameters: what `ros2 param describe` shows."""

from slpi_ros.nodes.parameters import Declaration

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


def number(
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
    number(
        "time_jump", 1.0,
        "Seconds. A stamp older than the last one by at most this is late and rejected, by more: the clock was set "
        "back and time starts anew. Newer by more: a gap, counted.",
        JUMP,
    ),
    number("max_age", 0.0, "Seconds; a message stamped longer ago is rejected as stale. 0: none is.", TIMEOUT),
    number(
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
    number("ramp_rate", 50.0, "How fast to go to the safe voltage, V/s; slew_limit may be lower.", POSITIVE_RATE),
    # Memory
    Declaration(
        "reset_cycles", 10, "Cycles of the decaying oscillation of reset_memory, from full range to none.",
        between=CYCLES,
    ),
    number(
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
    number("measurement_timeout", 0.1, "Seconds; an older measurement does not act: the correction is held.", TIMEOUT),
    number(
        "drift_alarm", 3.0,
        "/diagnostics warns when measurements are off the model by this many times its held-out error, rms; 0: never.",
        FACTOR,
    ),
    # The node
    fixed("autostart", True, "Whether the node configures and activates itself."),
    fixed("executor", "events", "Executor that spins the node: events (fast) or default (in every rclpy)."),
    number("diagnostic_period", 1.0, "Seconds between two reports on /diagnostics.", PERIOD, read_only=True),
    Declaration(
        "realtime_priority", 0, "Priority under SCHED_FIFO, 1 to 99, where the system allows it; 0: as any process.",
        read_only=True, between=PRIORITY,
    ),
)  # fmt: skip
