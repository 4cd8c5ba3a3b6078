"""Node ``driver``: a real amplifier and sensor on the topics of a stage."""

import math
import threading
import time
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from functools import partial

import numpy as np
from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.duration import Duration
from rclpy.node import Node
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray
from trajectory_msgs.msg import JointTrajectory

from slpi_ros.devices.block import BlockPhase, BlockPlayer, BlockState
from slpi_ros.devices.link import State
from slpi_ros.devices.loop import DeviceLoop
from slpi_ros.devices.writer import LoopSettings
from slpi_ros.drivers.base import USUAL_SCALE, Channel, Found, Reading
from slpi_ros.drivers.registry import MODULES, make_device
from slpi_ros.errors import RecordError, SlpiError, UsageError, shown
from slpi_ros.io.messages import SECOND_NS, JointStateEncoder, encode_trajectory
from slpi_ros.io.stage_name import device_name, stage_name
from slpi_ros.model.limits import volts
from slpi_ros.nodes import parameters as declare
from slpi_ros.nodes.common import (
    COMMANDS,
    ERROR,
    LATCHED,
    WARN,
    DeferredService,
    Diagnostics,
    Health,
    ask_for_priority,
    read_trajectory,
    request_stop,
    steady_timer,
)
from slpi_ros.nodes.other_driver import OtherDriver
from slpi_ros.nodes.parameters import Declaration, Parameters, Values, limits_of, validated

HOLD, REST = "hold", "rest"
# Period of diagnostics, and of looks at what the thread of the device has done, seconds.
REPORT_PERIOD, LOOK_PERIOD, LOG_PERIOD = 0.5, 0.05, 5.0
# Time for the delivery of what became of a block.
DELIVERY = Duration(seconds=1.0)
# Share of the cycles that may be left out without a warning.
LATE_SHARE = 0.02
# What to do about displacements that are none.
WRONG_UNIT = "; check the unit of the device's position, and sensor_scale"
# Characters of a device's own identity in messages.
LONGEST_IDENTITY = 100

DECLARATIONS = declare.read_only(
    declare.text("device", "", f"Kind of the device: {', '.join(MODULES)}; required.", *MODULES),
    declare.text(
        "address", "", "Where the device is: host or host:port, a serial port, or DIALECT:PORT of a serial device."
    ),
    declare.AXES,
    Declaration("channels", ["1"], "The device's name of each axis, in the order of axes."),
    *declare.voltage_limits(),
    declare.scalar("rate", 1000.0, "Cycles per second: one writing and one reading, hertz.", (1.0, 10_000.0)),
    declare.each_axis(
        "amplifier_gain", 1.0, "Voltage at the stage for one volt of the device, V/V: of an amplifier behind it.",
        (1e-6, 1e6),
    ),
    declare.each_axis(
        "sensor_scale", math.nan,
        "Displacement for one unit of the device's position, metres; negative where they count against each other. "
        f"NaN: of the unit that the device reports, {USUAL_SCALE:g} where it reports none.",
        (-1.0, 1.0),
    ),
    declare.each_axis("sensor_offset", 0.0, "Added to the displacement, metres.", (-1.0, 1.0)),
    Declaration(
        "take_over_servo", False,
        "Whether to switch off a servo that is on at the device, which may move the stage a little.",
    ),
    Declaration("rearm", False, "Whether to go on by itself after a lost link; if false, nothing moves until ~/arm."),
    declare.text(
        "at_exit", HOLD, "hold: the output stays as it is at the end. rest: it goes to rest_voltage at the slew limit.",
        HOLD, REST,
    ),
    declare.scalar(
        "voltage_timeout", 5.0,
        "Seconds without a voltage_command, from the last one that was carried out on, after which the output is held "
        "and this is reported; 0: never.",
        (0.0, 86_400.0),
    ),
    declare.text(
        "at_silence", HOLD,
        "After voltage_timeout: hold: the output stays where it is. rest: it goes to rest_voltage at the slew limit, "
        "and nothing moves until ~/arm, or with rearm the next command.",
        HOLD, REST,
    ),
    declare.each_axis(
        "rest_voltage", 0.0, "Voltage to go to at the end (at_exit) and at silence, volts.", declare.VOLTAGE
    ),
    declare.text(
        "hardware_id", "",
        "Identifier of the stage in stage_state; empty: model and serial number of the device, if it reports them.",
    ),
    declare.REALTIME_PRIORITY,
)  # fmt: skip


@dataclass(frozen=True)
class DriverSettings:
    """Validated settings of the driver."""

    values: Values  # all parameters by name
    channels: tuple[Channel, ...]
    loop: LoopSettings

    @classmethod
    def of(cls, given: Values) -> "DriverSettings":
        """Return the settings from a mapping of parameter names to values."""
        values, axes, names = validated(DECLARATIONS, given), given["axes"], list(given["channels"] or ())
        if len(names) != len(axes) or len(set(names)) != len(names):
            raise UsageError(
                f"parameter channels is {names!r}; give the device's name of each of the axes {', '.join(axes)}, each "
                "once"
            )
        scales = values["sensor_scale"] or (math.nan,) * len(axes)
        if 0.0 in scales:
            raise UsageError("parameter sensor_scale is 0; give metres for one unit of the device's position")
        limits = limits_of(values)
        at_rest = tuple(values["rest_voltage"])
        rest, silent = (at_rest if values[name] == REST else None for name in ("at_exit", "at_silence"))
        if (rest or silent) and any(each.clip(v) != v for each, v in zip(limits, at_rest, strict=True)):
            raise UsageError(
                f"parameter rest_voltage is {volts(*at_rest)} V; give it within voltage_min and voltage_max"
            )
        columns = values["amplifier_gain"], scales, values["sensor_offset"]
        loop = LoopSettings(
            tuple(axes), limits, values["rate"], values["take_over_servo"], values["rearm"], rest,
            values["voltage_timeout"], silent,
        )  # fmt: skip
        return cls(values, tuple(map(Channel, names, *columns)), loop)


class Driver(Node):
    """Connect a real amplifier and sensor with the topics of a stage.

    Subscribes to ``voltage_command`` (std_msgs/Float64MultiArray, volts in the order of the axes) and publishes
    ``stage_state`` (sensor_msgs/JointState), stamped when the position was read: the displacement in metres in
    ``position``, the voltage that the device says it has in ``effort``. Opening the device changes no output; the first
    voltage starts from the one that is there, and every voltage keeps the limits of this node. A configuration beyond
    the device's own range is refused. The device is served by a thread of its own.

    When the link is lost nothing is published; ``/diagnostics`` tells the device and since when. It is opened again
    until that succeeds; then it is read, and moved only after ``~/arm`` (std_srvs/Trigger), or with ``rearm``.
    ``~/stop`` holds the output until ``~/arm``. After ``voltage_timeout`` without a command the output is held, or goes
    to rest. Before anything it listens: it ends where another node reports this stage.

    A block on ``voltage_trajectory`` (trajectory_msgs/JointTrajectory, volts in ``effort``) is checked as a whole, then
    played by the device's clock, or streamed where the device cannot; ``voltage_trajectory_state`` tells how far it is,
    ``recorded_trajectory`` what was recorded. Parameters in `DECLARATIONS`.
    """

    def __init__(self) -> None:
        super().__init__("driver")
        settings = Parameters(self, DECLARATIONS, DriverSettings.of).settings
        values = settings.values
        self._values = values
        device = make_device(values["device"], values["address"], settings.channels)
        self._device_name = device.name
        self._limits = dict(zip(values["axes"], settings.loop.limits, strict=True))
        self._frame: str = values["hardware_id"]
        self._encoder: JointStateEncoder | None = None
        self._publisher = self.create_publisher(JointState, "stage_state", COMMANDS)
        self._diagnostics = Diagnostics(self, "driver")
        self._loop = DeviceLoop(device, settings.loop, self._publish, on_found=self._on_found)
        self._failure: SlpiError | None = None
        self._status = self._loop.status
        self._reported_at, self._reported = time.monotonic(), replace(self._loop.counts)
        self._deferred = {
            name: DeferredService(self, f"~/{name}", partial(self._ask, name)) for name in ("arm", "stop")
        }
        self._commands = self.create_subscription(Float64MultiArray, "voltage_command", self._on_command, COMMANDS)
        self.create_subscription(JointTrajectory, "voltage_trajectory", self._on_trajectory, COMMANDS, raw=True)
        self._block_publisher = self.create_publisher(DiagnosticStatus, "voltage_trajectory_state", LATCHED)
        self._told: BlockState | None = None
        self._recording_publisher = self.create_publisher(JointTrajectory, "recorded_trajectory", COMMANDS)
        self._other, self._listening = OtherDriver(self, "stage_state", values["axes"]), True
        steady_timer(self, LOOK_PERIOD, self._look)
        self._thread = threading.Thread(target=self._run, name=device.name, daemon=True)
        ask_for_priority(self, values["realtime_priority"])

    def destroy_node(self) -> None:
        """Let the thread of the device end, after the ramp to rest if there is one; then destroy the node."""
        self._loop.end()
        while self._thread.is_alive():
            # A join without timeout would not be interrupted by a signal.
            self._thread.join(LOOK_PERIOD)
        if self._loop.blocks.states and self.context.ok():
            # That a block was stopped where it was: whoever sent it would wait for that.
            self._tell_blocks()
            self._block_publisher.wait_for_all_acked(DELIVERY)
        super().destroy_node()

    # The thread of the device

    def _run(self) -> None:
        try:
            self._loop.run()
        except SlpiError as error:
            heard = self._other.refusal(self._frame) if self._loop.found is None else None
            self._failure = RecordError(f"{heard}; besides, {error}") if heard else error

    def _on_found(self, found: Found) -> None:
        """Name the stage; RecordError if it is reported by another node already."""
        if self._encoder is None:
            self._frame = self._values["hardware_id"] or shown(device_name(found.identity), LONGEST_IDENTITY)
            if refusal := self._other.refusal(self._frame):
                raise refusal

    def _publish(self, reading: Reading) -> None:
        if self._encoder is None:
            self._encoder = JointStateEncoder(self._values["axes"], self._frame)
        age_ns = time.monotonic_ns() - reading.read_ns
        stamp_ns = self.get_clock().now().nanoseconds - age_ns
        # As bytes: a message object takes several times longer.
        self._publisher.publish(self._encoder.encode(stamp_ns, reading.positions, reading.voltages))

    # Callbacks

    def _on_command(self, command: Float64MultiArray) -> None:
        if reason := self._loop.command(command.data):
            self.get_logger().warning(
                f"commands rejected so far: {self._loop.counts.rejected}; the last one: {reason}",
                throttle_duration_sec=LOG_PERIOD,
            )

    def _on_trajectory(self, data: bytes) -> None:
        self._loop.blocks.submit(read_trajectory(data, "effort"))

    def _tell_blocks(self) -> None:
        """Tell what has become of blocks."""
        while self._loop.blocks.states:
            self._tell_block(self._loop.blocks.states.popleft())

    def _tell_block(self, state: BlockState) -> None:
        seconds, rest = divmod(state.stamp_ns, SECOND_NS)
        values = {"stamp": f"{seconds}.{rest:09d}", "sample": str(state.sample), "reason": state.reason}
        problem = ((WARN, state.phase.value),) if state.phase in (BlockPhase.REFUSED, BlockPhase.STOPPED) else ()
        health = Health(problem, state.phase.value, values, self._frame)
        self._block_publisher.publish(health.status(f"{self.get_fully_qualified_name()}: block"))
        # That it is being loaded or played is told again and again.
        again = state.phase is BlockPhase.PLAYING or (state.phase is BlockPhase.ACCEPTED and state == self._told)
        self._told = state
        if not again:
            reason = f": {state.reason}" if state.reason else ""
            self.get_logger().info(f"block {state.phase.value} at sample {state.sample}{reason}")

    def _publish_recording(self, block: BlockPlayer) -> None:
        recording = block.recording
        assert recording is not None
        age_ns = time.monotonic_ns() - block.begun_ns
        stamp_ns = self.get_clock().now().nanoseconds - age_ns
        times_ns = np.round(recording.times * SECOND_NS).astype(np.int64)
        self._recording_publisher.publish(
            encode_trajectory(stamp_ns, self._values["axes"], times_ns, recording.positions, recording.voltages)
        )

    def _ask(self, what: str) -> str:
        self._loop.request(what)
        return ""

    def _look(self) -> None:
        """Pass on what the thread of the device has done; let it begin once nobody else is heard."""
        if self._listening:
            self._begin()
            return
        if self._failure is not None:
            request_stop(self._failure)
            return
        while self._loop.answers:
            what, success, text = self._loop.answers.popleft()
            self._deferred[what].answer(success, text)
        self._tell_blocks()
        while self._loop.blocks.recorded:
            self._publish_recording(self._loop.blocks.recorded.popleft())
        status, now = self._loop.status, time.monotonic()
        changed = status.state is not self._status.state
        if changed:
            self._tell()
        self._status = status
        if changed or now - self._reported_at >= REPORT_PERIOD:
            self._report(now)

    def _begin(self) -> None:
        """Let the thread of the device begin, unless another node is heard that reports this stage."""
        if not self._other.done:
            return
        self._listening = False
        # Without a name of its own only the device can tell whether it is another stage.
        named = self._frame or not all(map(stage_name, self._other.frames))
        if named and (refusal := self._other.refusal(self._frame)):
            request_stop(refusal)
        else:
            self._thread.start()

    def _tell(self) -> None:
        """Log a new state."""
        status, found = self._loop.status, self._loop.found
        if status.state is State.ARMED and found is not None:
            self.get_logger().info(
                f"{self._device_name}: {shown(found.identity, LONGEST_IDENTITY)}, at {volts(*found.setpoints)} V: "
                f"takes {self._commands.topic_name}, publishes {self._publisher.topic_name}"
            )
            for note in found.notes:
                self.get_logger().info(f"{self._device_name}: {note}")
        elif status.state is State.LOST:
            self.get_logger().error(f"{status.reason}; trying again")
        else:
            self.get_logger().warning(status.reason)

    def _report(self, now: float) -> None:
        loop, status, found, reading = self._loop, self._loop.status, self._loop.found, self._loop.latest
        elapsed, self._reported_at = now - self._reported_at, now
        before, self._reported = self._reported, replace(loop.counts)
        cycles, late = self._reported.cycles - before.cycles, self._reported.late - before.late
        since = datetime.fromtimestamp(status.since, UTC).isoformat(timespec="seconds") if status.since else ""
        problems = []
        if status.state is State.LOST:
            problems.append((ERROR, f"no link since {since}: {status.reason}"))
        elif status.state is State.HELD:
            problems.append((WARN, f"held since {since}: {status.reason}"))
        for each in loop.monitor.standing:
            remedy = f": held at {volts(*loop.written)} V" if each.rule == "commands" else WRONG_UNIT
            problems.append((WARN, f"{each}{remedy}"))
        for axis in loop.limited:
            limits = self._limits[axis]
            problems.append(
                (WARN, f"commands of axis '{axis}' are beyond {limits.lower:g} to {limits.upper:g} V and held there")
            )
        if status.state is not State.LOST and late > LATE_SHARE * (cycles + late):
            problems.append(
                (WARN, f"{late} of {cycles + late} cycles left out, as the device or this computer took longer than "
                       f"{1e3 / self._values['rate']:.3g} ms; set rate to {cycles / elapsed:.0f} or less, or set "
                       "realtime_priority")
            )  # fmt: skip
        for axis, rows in zip(self._limits, loop.recent.rows(), strict=False):
            if rows > 1.0:
                rate = f"{cycles / elapsed / rows:.3g} readings a second, each for {rows:.3g} cycles"
                problems.append((WARN, f"the sensor of axis '{axis}' is slower than the cycle: {rate}"))
        timing = loop.timing.report()
        values: dict[str, object] = {
            "state": status.state.value,
            "since": since,
            "reason": status.reason,
            "device": self._device_name,
            "identity": shown(found.identity, LONGEST_IDENTITY) if found else "",
            "cycles_per_second": f"{cycles / elapsed:.1f}",
            "cycles_left_out": loop.counts.late,
            "lateness_p99_ms": f"{timing.latency[1] * 1e3:.3f}" if timing else "",
            "commands_rejected": loop.counts.rejected,
            "links_lost": loop.counts.losses,
        }
        if reading is not None:
            values |= {
                f"{axis}.voltage": f"{v:.4f}" for axis, v in zip(self._values["axes"], reading.voltages, strict=True)
            }
        loop.timing.restart()
        summary = f"{self._device_name}: {status.state.value}"
        self._diagnostics.report(Health(tuple(problems), summary, values, self._frame))
