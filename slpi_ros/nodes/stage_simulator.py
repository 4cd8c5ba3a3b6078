"""Node ``stage_simulator``: a simulated stage that publishes displacements for voltage commands."""

import hashlib
import math
import time
from array import array
from collections.abc import Callable, Sequence
from dataclasses import fields
from functools import partial

import numpy as np
from builtin_interfaces.msg import Time as Stamp
from rclpy.node import Node
from rclpy.time import Time
from rosgraph_msgs.msg import Clock as ClockMsg
from sensor_msgs.msg import JointState, Temperature
from std_msgs.msg import Float64, Float64MultiArray

from slpi_ros.arrays import FloatArray
from slpi_ros.errors import UsageError
from slpi_ros.model.limits import Limits
from slpi_ros.nodes import parameters as declare
from slpi_ros.nodes.common import COMMANDS, steady_timer
from slpi_ros.nodes.parameters import Declaration, Parameters, Values, validated
from slpi_ros.simulation.character import Character
from slpi_ros.simulation.room import Room
from slpi_ros.simulation.stage import Stage, p11_stage

LOG_PERIOD = 5.0
# Time without a command after which states are published again, seconds: a sensor that is silent is one that failed.
QUIET = 0.3
# Seconds; creep has decayed after this time.
DAY = 86_400.0
# Noise of the sensors in the room, kelvin and newton; readings of the load for each of the temperature.
NOISE_OF_TEMPERATURE, NOISE_OF_LOAD, LOADS = 0.01, 0.01, 10
GIVEN, DRAWN, HIDDEN = "given", "drawn", "hidden"
DECLARATIONS = declare.read_only(
    declare.AXES,
    declare.text(
        "hardware_id", "",
        "Identifier of the stage in stage_state; empty: simulated-PRESET, or simulated-SEED without a preset, and what "
        "identifies the character, if any.",
    ),
    declare.text("preset", "", "p11: the stage of the MPI paper; empty: a random one."),
    declare.SEED,
    declare.scalar("noise_rms", 8e-9, "Sensor noise without a preset, metres rms.", (0.0, 1.0)),
    declare.scalar("voltage_min", 0.0, "Lower limit of the amplifier, volts.", declare.VOLTAGE),
    declare.scalar("voltage_max", 100.0, "Upper limit of the amplifier, volts.", declare.VOLTAGE),
    Declaration(
        "initial_state", [0.0],
        "Voltages applied to all axes one day before the start, followed by 0 V, to reproduce an earlier state.",
        number=True,
    ),
    declare.scalar(
        "warm_up", 0.0, "Time for which the stage has been switched on at the start: its drifts are so old; seconds.",
        (0.0, 1e7),
    ),
    Declaration(
        "answer_commands", True, "Whether to publish one state for each command; else `rate` states per second."
    ),
    declare.scalar(
        "rate", 200.0, "States per second without answer_commands, and while no commands come, hertz.", (1e-3, 1e4)
    ),
    declare.scalar(
        "speed", 1.0,
        "Stage seconds per second, at most. Other than 1: the node publishes /clock, each time 1/`rate` further, for "
        "nodes with use_sim_time.",
        (0.01, 1000.0),
    ),
    declare.text(
        "character", GIVEN,
        "given: the effects named below. drawn: one or two effects per axis, drawn from the seed and logged. hidden: "
        "the same, but not told.",
        GIVEN, DRAWN, HIDDEN,
    ),
    declare.scalar(
        "room_swing", 0.0,
        "Rms of the temperature of the room about 21 °C, kelvin; more than 0: it is published, as is the load.",
        (0.0, 50.0),
    ),
    declare.scalar("room_load", 2.0, "Largest load of the stage, newton; it comes and goes.", (0.0, 1e4)),
    declare.scalar(
        "room_rate", 2.0, "Readings of the temperature per second, hertz; of the load ten times as many.", (1e-3, 100.0)
    ),
    *(
        declare.each_axis(
            figure.name, getattr(Character(), figure.name), figure.metadata["meaning"], figure.metadata["between"]
        )
        for figure in fields(Character)
    ),
)  # fmt: skip


class StageSimulator(Node):
    """Simulate a stage with the topics of a real one.

    Subscribes to ``voltage_command`` (std_msgs/Float64MultiArray, volts in the order of the axes) and publishes
    ``stage_state`` (sensor_msgs/JointState: measured displacement in metres in ``position``, applied voltage in volts
    in ``effort``) from its start on: once for each command; at the parameter ``rate`` before the first command and
    after 0.3 s without a command, and at once when nobody publishes commands any more.
    Commands beyond the voltage limits are clipped, as the amplifier saturates. Parameters in `DECLARATIONS`.

    Without a preset the stage has random hysteresis, drawn from the seed, and the effects of its character. Preset
    "p11" is the stage of the MPI paper with axes x and y, creep, resonance and its own sensor noise; the seed affects
    its noise only. The dynamics run on the clock of the node, or with ``speed`` on the clock that the node publishes.
    """

    def __init__(self) -> None:
        super().__init__("stage_simulator")
        self.ignored = 0  # commands, because of a wrong length or a value that is not finite
        values = Parameters(self, DECLARATIONS, partial(validated, DECLARATIONS)).settings
        axes, preset, seed = list(values["axes"]), values["preset"], values["seed"]
        self._stage, identity = _make_stage(values)
        self._limits = _limits(self._stage, values["voltage_min"], values["voltage_max"])
        history, rest = _history(values["initial_state"], self._limits), self._limits.clip(0.0)
        self._state = JointState(name=axes)
        self._state.header.frame_id = values["hardware_id"] or f"simulated-{preset or seed}{identity}"
        for axis, one in self._stage.axes.items():
            if values["character"] == DRAWN:
                self.get_logger().info(f"axis {axis}: {one.character}")
        self._speed, self._period_ns = values["speed"], int(1e9 / values["rate"])
        self._latest_ns, self._ticked_ns = self.get_clock().now().nanoseconds, time.monotonic_ns()
        self._published_ns = self._latest_ns
        begun = self._now_ns() * 1e-9
        for v in (*history, rest):
            self._stage.step(begun - DAY, [v] * len(axes))
        self._stage.begin_drift(begun - values["warm_up"])
        self._apply([rest] * len(axes))
        self._publisher = self.create_publisher(JointState, "stage_state", COMMANDS)
        self._answers, self._commanded_at = values["answer_commands"], -math.inf
        if self._speed != 1.0:
            self._clock_publisher = self.create_publisher(ClockMsg, "/clock", COMMANDS)
        steady_timer(self, 1.0 / (values["rate"] * self._speed), self._on_timer)
        self._commands = self.create_subscription(Float64MultiArray, "voltage_command", self._on_command, COMMANDS)
        self.get_logger().info(
            f"stage '{self._state.header.frame_id}', axes {', '.join(axes)}, {self._limits.lower:g} to "
            f"{self._limits.upper:g} V: takes {self._commands.topic_name}, publishes {self._publisher.topic_name}"
        )
        self._publish()
        if values["room_swing"]:
            RoomSensors(self, values, self._now_ns)

    def _now_ns(self) -> int:
        """Return the time of the stage (ns), which never decreases, even if the clock of the node is set back.

        A clock that the node publishes goes on by a period with each message, and no further between them: on a busy
        computer the stage slows down instead of losing samples.
        """
        if self._speed == 1.0:
            now = self.get_clock().now().nanoseconds
        else:
            ahead = int(self._speed * (time.monotonic_ns() - self._ticked_ns))
            now = self._published_ns + min(ahead, self._period_ns)
        self._latest_ns = max(self._latest_ns, now)
        return self._latest_ns

    def _on_timer(self) -> None:
        if self._speed != 1.0:
            self._published_ns, self._ticked_ns = self._published_ns + self._period_ns, time.monotonic_ns()
            self._clock_publisher.publish(ClockMsg(clock=_stamp(self._published_ns)))
        quiet = time.monotonic() > self._commanded_at + QUIET or not self.count_publishers(self._commands.topic_name)
        if quiet or not self._answers:
            self._apply(self._state.effort)
            self._publish()

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
        self._commanded_at = time.monotonic()
        self._apply([self._limits.clip(v) for v in voltages])
        if self._answers:
            self._publish()

    def _apply(self, voltages: Sequence[float]) -> None:
        self._displacement = self._stage.step(self._now_ns() * 1e-9, voltages)
        self._state.effort = array("d", voltages)

    def _publish(self) -> None:
        self._state.header.stamp = _stamp(self._latest_ns)
        self._state.position = array("d", self._stage.measure(self._displacement))
        self._publisher.publish(self._state)


class RoomSensors:
    """Publish what sensors in the room of the stage read: its temperature, and the load."""

    def __init__(self, node: Node, values: Values, now_ns: Callable[[], int]) -> None:
        self._room, self._now_ns = _room(values), now_ns
        self._random = np.random.default_rng([values["seed"], 3])
        self._temperature = node.create_publisher(Temperature, "room/temperature", COMMANDS)
        self._load = node.create_publisher(Float64, "load", COMMANDS)
        period = 1.0 / (values["room_rate"] * values["speed"])
        steady_timer(node, period, self._on_temperature)
        steady_timer(node, period / LOADS, self._on_load)

    def _on_temperature(self) -> None:
        now_ns = self._now_ns()
        value = self._read(self._room.temperature, now_ns, NOISE_OF_TEMPERATURE)
        message = Temperature(temperature=value, variance=NOISE_OF_TEMPERATURE**2)
        message.header.stamp = _stamp(now_ns)
        self._temperature.publish(message)

    def _on_load(self) -> None:
        self._load.publish(Float64(data=self._read(self._room.load, self._now_ns(), NOISE_OF_LOAD)))

    def _read(self, quantity: Callable[[FloatArray], FloatArray], now_ns: int, noise_rms: float) -> float:
        return float(quantity(np.array([now_ns * 1e-9]))[0]) + noise_rms * float(self._random.standard_normal())


def _stamp(nanoseconds: int) -> Stamp:
    return Time(nanoseconds=nanoseconds).to_msg()


def _history(given: object, limits: Limits) -> list[float]:
    history = list(given) if isinstance(given, Sequence | array) and not isinstance(given, str) else [math.nan]
    if not all(limits.lower <= v <= limits.upper for v in history):
        raise UsageError(
            f"stage_simulator: initial_state is {given!r}; give voltages within {limits.lower} to {limits.upper} V"
        )
    return history


def _make_stage(values: Values) -> tuple[Stage, str]:
    """Return the stage, and what its hardware id says of its character."""
    axes, preset, seed, noise = list(values["axes"]), values["preset"], values["seed"], values["noise_rms"]
    names = [figure.name for figure in fields(Character)]
    given = [Character(**{name: values[name][place] for name in names}) for place in range(len(axes))]
    own = values["character"] != GIVEN or any(one.effects or one.has_surroundings for one in given)
    if preset:
        if preset != "p11":
            raise UsageError(f"stage_simulator: no preset '{preset}'; choose p11, or none")
        if own:
            raise UsageError("stage_simulator: preset p11 has a character of its own; give no effects with it")
        stage = p11_stage(seed)
        if axes != list(stage.axes):
            raise UsageError(
                f"stage_simulator: axes are {', '.join(axes)}, preset p11 has {', '.join(stage.axes)}; use these"
            )
        return stage, ""
    if not own:
        return Stage.random(axes, seed, noise), ""
    if values["character"] == GIVEN:
        digest = hashlib.sha256(repr(given).encode()).hexdigest()[:8]
        return Stage.of(axes, given, seed, noise, _room(values)), f"-{digest}"
    drawn = Stage.hidden(axes, seed, noise, rate=values["rate"], voltage_max=values["voltage_max"])
    return drawn, f"-{values['character']}"


def _room(values: Values) -> Room:
    return Room(values["seed"], values["room_swing"], values["room_load"])


def _limits(stage: Stage, low: float, high: float) -> Limits:
    lowest, highest = stage.voltage_range
    if not lowest <= low < high <= highest:
        raise UsageError(
            f"stage_simulator: voltage_min is {low} V and voltage_max {high} V; "
            f"give the lower one first, both within {lowest} to {highest} V"
        )
    return Limits(low, high)
