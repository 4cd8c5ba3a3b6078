"""Node ``stage_simulator``: a simulated stage that publishes displacements for voltage commands."""

import math
import sys
from array import array
from collections.abc import Sequence
from functools import partial

from rcl_interfaces.msg import ParameterDescriptor
from rclpy.node import Node
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray

from slpi_ros.errors import UsageError
from slpi_ros.nodes.common import COMMANDS, run
from slpi_ros.nodes.parameters import Declaration, Parameters, validated
from slpi_ros.simulation.stage import Stage, p11_stage

LOG_PERIOD = 5.0
# Seconds; creep has decayed after this time.
DAY = 86_400.0
VOLTAGE = (-10_000.0, 10_000.0)
DECLARATIONS = (
    Declaration("axes", ["x"], "Names of the axes, in the order of voltage_command.", read_only=True),
    Declaration("preset", "", "p11: the stage of the MPI paper; empty: a random one.", read_only=True),
    Declaration("seed", 0, "Seed of the random stage and of the noise.", read_only=True, between=(0, 2**53)),
    Declaration(
        "noise_rms", 8e-9, "Sensor noise without a preset, metres rms.", read_only=True, between=(0.0, 1.0), number=True
    ),
    Declaration(
        "voltage_min", 0.0, "Lower limit of the amplifier, volts.", read_only=True, between=VOLTAGE, number=True
    ),
    Declaration(
        "voltage_max", 100.0, "Upper limit of the amplifier, volts.", read_only=True, between=VOLTAGE, number=True
    ),
    Declaration(
        "initial_history", [0.0],
        "Voltages applied to all axes one day before the start, followed by 0 V, to reproduce an earlier state.",
        read_only=True, number=True,
    ),
    Declaration(
        "answer_commands", True, "Whether to publish one state for each command; else `rate` states per second.",
        read_only=True,
    ),
    Declaration(
        "rate", 200.0, "States per second without answer_commands, hertz.",
        read_only=True, between=(1e-3, 1e4), number=True,
    ),
)  # fmt: skip


class StageSimulator(Node):
    """Simulate a stage with the topics of a real one.

    Subscribes to ``voltage_command`` (std_msgs/Float64MultiArray, volts in the order of the axes) and publishes
    ``stage_state`` (sensor_msgs/JointState: measured displacement in metres in ``position``, applied voltage in volts
    in ``effort``). Commands beyond the voltage limits are clipped, as the amplifier saturates. Parameters are those in
    `DECLARATIONS`, and ``hardware_id``, by default ``simulated-PRESET``, or ``simulated-SEED`` without a preset: with a
    preset, the seed affects the noise only.

    Without a preset the stage has random hysteresis, drawn from the seed, and no other effects. Preset "p11" is the
    stage of the MPI paper with axes x and y, creep, resonance and its own sensor noise. Its dynamics run on the clock
    of the node, which may be a simulated one.

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
        values = Parameters(self, DECLARATIONS, partial(validated, DECLARATIONS)).settings
        axes, preset, seed = list(values["axes"]), values["preset"], values["seed"]
        self._stage, self._latest = _make_stage(axes, preset, seed, values["noise_rms"]), -math.inf
        self._low, self._high = _limits(self._stage, values["voltage_min"], values["voltage_max"])
        history = self._initial_history(values["initial_history"])
        self._state = JointState(name=axes)
        identified = self.declare_parameter(
            "hardware_id", f"simulated-{preset or seed}", ParameterDescriptor(read_only=True)
        )
        self._state.header.frame_id = identified.value
        self._answers = values["answer_commands"]
        now = self.get_clock().now().nanoseconds * 1e-9
        for v in (*history, self._clip(0.0)):
            self._stage.step(now - DAY, [v] * len(axes))
        self._apply([self._clip(0.0)] * len(axes))
        self._publisher = self.create_publisher(JointState, "stage_state", COMMANDS)
        if not self._answers:
            self.create_timer(1.0 / values["rate"], self._publish)
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

    def _initial_history(self, given: object) -> list[float]:
        history = list(given) if isinstance(given, Sequence | array) and not isinstance(given, str) else [math.nan]
        if not all(self._low <= v <= self._high for v in history):
            raise UsageError(
                f"stage_simulator: initial_history is {given!r}; give voltages within {self._low} to {self._high} V"
            )
        return history


def _make_stage(axes: list[str], preset: str, seed: int, noise_rms: float) -> Stage:
    if not preset:
        return Stage.random(axes, seed, noise_rms)
    if preset != "p11":
        raise UsageError(f"stage_simulator: no preset '{preset}'; choose p11, or none")
    stage = p11_stage(seed)
    if axes != list(stage.axes):
        raise UsageError(
            f"stage_simulator: axes are {', '.join(axes)}, preset p11 has {', '.join(stage.axes)}; use these"
        )
    return stage


def _limits(stage: Stage, low: float, high: float) -> tuple[float, float]:
    lowest, highest = stage.voltage_range
    if not lowest <= low < high <= highest:
        raise UsageError(
            f"stage_simulator: voltage_min is {low} V and voltage_max {high} V; "
            f"give the lower one first, both within {lowest} to {highest} V"
        )
    return low, high


def main() -> int:
    """Run the node; return the exit code of the process."""
    return run(StageSimulator)


if __name__ == "__main__":
    sys.exit(main())
