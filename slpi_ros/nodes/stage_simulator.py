"""Node ``stage_simulator``: a simulated stage that publishes displacements for voltage commands."""

import math
import sys
from array import array
from collections.abc import Sequence

from rcl_interfaces.msg import ParameterDescriptor
from rclpy.node import Node
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray

from slpi_ros.errors import UsageError
from slpi_ros.nodes.common import COMMANDS, run
from slpi_ros.simulation.stage import Stage, p11_stage

LOG_PERIOD = 5.0
RATE_MAX = 10e3
# Seconds; creep has decayed after this time.
DAY = 86_400.0
_READ_ONLY = ParameterDescriptor(read_only=True)
# Dynamic typing, so that ROS accepts 100 for 100.0.
_NUMBER = ParameterDescriptor(read_only=True, dynamic_typing=True)


class StageSimulator(Node):
    """Simulate a stage with the topics of a real one.

    Subscribes ``voltage_command`` (std_msgs/Float64MultiArray, volts in the order of the axes) and publishes
    ``stage_state`` (sensor_msgs/JointState: ``position`` in metres as measured, ``effort`` in volts as
    applied).
    Parameters, all read-only: ``axes``, ``seed``, ``preset``, ``noise_rms`` (m), ``rate`` (Hz), ``voltage_min`` and
    ``voltage_max`` (V; commands beyond them are clipped, as the amplifier saturates), ``hardware_id`` (by default
    ``simulated-`` with the preset, or the seed without a preset), ``initial_history`` (V; voltages applied to all axes
    one day before the start, followed by 0 V, to reproduce the state of an earlier run), and
    ``answer_commands``: publish one state for each accepted command, or, if false, `rate` states per second.

    Without preset the stage has random hysteresis for the given seed and no other effects. Preset "p11" is the stage of
    the MPI paper with creep and resonance, axes x and y, and its own sensor noise, drawn from the seed; it uses the
    node's clock, which may be a simulated one.

    Attributes
    ----------
    ignored : int
        Number of commands ignored because of a wrong length or a value that is not finite.

    Raises
    ------
    UsageError
        If a parameter is not valid.
    """

    def __init__(self) -> None:
        super().__init__("stage_simulator")
        self.ignored = 0
        axes = self._axes()
        self._stage, self._latest = self._make_stage(axes), -math.inf
        self._low, self._high = self._limits()
        history = self._initial_history()
        self._state = JointState(name=axes)
        self._state.header.frame_id = self.declare_parameter("hardware_id", self._hardware_id(), _READ_ONLY).value
        self._answers = bool(self.declare_parameter("answer_commands", True, _READ_ONLY).value)
        rate = self._rate()
        now = self.get_clock().now().nanoseconds * 1e-9
        for v in (*history, self._clip(0.0)):
            self._stage.step(now - DAY, [v] * len(axes))
        self._apply([self._clip(0.0)] * len(axes))
        self._publisher = self.create_publisher(JointState, "stage_state", COMMANDS)
        if not self._answers:
            self.create_timer(1.0 / rate, self._publish)
        self.create_subscription(Float64MultiArray, "voltage_command", self._on_command, COMMANDS)

    def _on_command(self, command: Float64MultiArray) -> None:
        voltages = command.data
        if len(voltages) != len(self._state.name) or not all(map(math.isfinite, voltages)):
            self.ignored += 1
            self.get_logger().warning(
                f"commands ignored so far: {self.ignored}; the last one was {list(voltages)}; "
                f"send one finite voltage for each of the axes {', '.join(self._state.name)}",
                throttle_duration_sec=LOG_PERIOD,
            )
            return
        self._apply([self._clip(v) for v in voltages])
        if self._answers:
            self._publish()

    def _apply(self, voltages: Sequence[float]) -> None:
        # The time of the stage never decreases, even if the clock is set back.
        self._latest = max(self._latest, self.get_clock().now().nanoseconds * 1e-9)
        self._displacement = self._stage.step(self._latest, voltages)
        self._state.effort = array("d", voltages)

    def _publish(self) -> None:
        self._state.header.stamp = self.get_clock().now().to_msg()
        self._state.position = array("d", self._stage.measure(self._displacement))
        self._publisher.publish(self._state)

    def _clip(self, voltage: float) -> float:
        return min(max(voltage, self._low), self._high)

    def _axes(self) -> list[str]:
        axes = list(self.declare_parameter("axes", ["x"], _READ_ONLY).value)
        if not axes or not all(axes):
            raise UsageError(f"stage_simulator: axes is {axes}; name at least one axis, none of them empty")
        return axes

    def _make_stage(self, axes: list[str]) -> Stage:
        preset = self.declare_parameter("preset", "", _READ_ONLY).value
        seed, noise = self._seed(), self._number("noise_rms", 8e-9)
        if not preset:
            return Stage.random(axes, seed, noise)
        if preset != "p11":
            raise UsageError(f"stage_simulator: no preset '{preset}'; choose p11, or none")
        stage = p11_stage(seed)
        if axes != list(stage.axes):
            raise UsageError(
                f"stage_simulator: axes are {', '.join(axes)}, preset p11 has {', '.join(stage.axes)}; use these"
            )
        return stage

    def _hardware_id(self) -> str:
        """Return an id for the simulated stage; the seed of a preset only affects noise and is not included."""
        return f"simulated-{self.get_parameter('preset').value or self.get_parameter('seed').value}"

    def _initial_history(self) -> list[float]:
        # Default: a stage that has always been at 0 V.
        given = self.declare_parameter("initial_history", [0.0], _NUMBER).value
        history = list(given) if isinstance(given, Sequence | array) and not isinstance(given, str) else [math.nan]
        if not all(self._low <= v <= self._high for v in history):
            raise UsageError(
                f"stage_simulator: initial_history is {given!r}; give voltages within {self._low} to {self._high} V"
            )
        return history

    def _seed(self) -> int:
        seed = int(self.declare_parameter("seed", 0, _READ_ONLY).value)
        if seed < 0:
            raise UsageError(f"stage_simulator: seed is {seed}; give 0 or more")
        return seed

    def _rate(self) -> float:
        rate = self._number("rate", 200.0)
        if not 0 < rate <= RATE_MAX:
            raise UsageError(f"stage_simulator: rate is {rate} Hz; give more than 0, at most {RATE_MAX:.0f}")
        return rate

    def _limits(self) -> tuple[float, float]:
        low, high = self._number("voltage_min", 0.0), self._number("voltage_max", 100.0)
        lowest, highest = self._stage.voltage_range
        if not lowest <= low < high <= highest:
            raise UsageError(
                f"stage_simulator: voltage_min is {low} V and voltage_max {high} V; "
                f"give the lower one first, both within {lowest} to {highest} V"
            )
        return low, high

    def _number(self, name: str, default: float) -> float:
        value = self.declare_parameter(name, default, _NUMBER).value
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise UsageError(f"stage_simulator: {name} is {value!r}; give a number")
        return float(value)


def main() -> int:
    """Run the node until it is stopped.

    Returns
    -------
    int
        Exit code of the process.
    """
    return run(StageSimulator, executor="events")


if __name__ == "__main__":
    sys.exit(main())
