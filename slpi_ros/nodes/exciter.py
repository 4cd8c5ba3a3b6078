"""Node ``exciter``: excites a stage for identification."""

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.node import Node
from trajectory_msgs.msg import JointTrajectory

from slpi_ros.arrays import FloatArray
from slpi_ros.calibration.block_drive import REPORT_LASTS, REPORT_PATIENCE, BlockDrive
from slpi_ros.compensator.amplifier import TOLERATED_SHARE
from slpi_ros.devices.block import block_state
from slpi_ros.errors import RecordError, SlpiError, UsageError
from slpi_ros.excitation.drives import DRIVES, SLEW_USED, Drive, Playback, excite
from slpi_ros.io.messages import SECOND_NS, encode_trajectory
from slpi_ros.model.limits import Limits, volts
from slpi_ros.model.mean_rate import WINDOW, highest_mean_rate, slower_by
from slpi_ros.nodes import parameters as declare
from slpi_ros.nodes.common import COMMANDS, LATCHED, make_executor, request_stop, serve, steady_timer
from slpi_ros.nodes.guarded_drive import GuardedDrive
from slpi_ros.nodes.parameters import Declaration, Parameters, Values, limits_of, validated

LIVE = "live"
# What a drive takes when it begins: what moves the stage is limited by it.
BEGUN_WITH = ("voltage_min", "voltage_max", "slew_limit", "mean_rate_limit", "rate")
# Where a driver tells what becomes of a block.
BLOCK_STATE = "voltage_trajectory_state"

DECLARATIONS = (
    declare.AXES,
    *declare.voltage_limits(", of which the drive uses 80 %"),
    declare.MEAN_RATE_LIMIT,
    declare.each_axis(
        "rest_voltage", math.nan,
        "Voltage before and after the excitation, volts; NaN: as reported by stage_state. Without a publisher of "
        "stage_state the amplifier is taken to be there.",
        declare.VOLTAGE,
    ),
    declare.STATE_TIMEOUT,
    declare.scalar("duration", 30.0, "Total excitation time of all axes, seconds.", (0.1, 86_400.0)),
    declare.scalar("rate", 200.0, "Sample rate, hertz.", (1.0, 10_000.0)),
    declare.scalar("settle", 3.0, "Seconds to wait for further subscribers after the first one.", (0.0, 3600.0)),
    declare.text("drive", DRIVES[0], f"Excitation drive: {', '.join(DRIVES)}.", *DRIVES),
    Declaration("seed", 0, "Seed of the random parts of the excitation drive.", between=(0, 2**31 - 1)),
    Declaration("repeat", False, "Whether to repeat the excitation until stopped."),
    declare.text(
        "output", LIVE,
        "live: samples on voltage_command at the sample rate. trajectory: all samples in one message on "
        "voltage_trajectory, for a device with its own timing.",
        LIVE, "trajectory", read_only=True,
    ),
    Declaration(
        "autostart", True, "Whether to start at once and exit at the end; if false, ~/start starts.", read_only=True
    ),
)  # fmt: skip


@dataclass(frozen=True)
class ExciterSettings:
    """Validated settings of the exciter."""

    values: Values  # all parameters by name
    limits: tuple[Limits, ...]

    @classmethod
    def of(cls, given: Values) -> "ExciterSettings":
        """Return the settings from a mapping of parameter names to values."""
        values = validated(DECLARATIONS, given)
        if values["repeat"] and values["output"] != LIVE:
            raise UsageError(f"parameters repeat and output '{values['output']}' do not go together; set one of them")
        settings = cls(values, limits_of(values))
        settings.drawn(values["voltage_min"])
        return settings

    def drawn(self, found: Sequence[float]) -> Drive:
        """Return the excitation, from and to rest_voltage, or the voltages (V) at which the amplifier was found."""
        rest = self.values["rest_voltage"] or [limits.clip(v) for limits, v in zip(self.limits, found, strict=True)]
        same = ("axes", "voltage_min", "voltage_max", "duration", "rate", "seed", "drive")
        slew_limit = [SLEW_USED * each.slew if each.slew < math.inf else 0.0 for each in self.limits]
        drive = excite(slew_limit=slew_limit, start=rest, **{name: self.values[name] for name in same})
        self._require_mean_rate(drive)
        return drive

    def require_as_begun(self, begun: "ExciterSettings") -> None:
        """Raise UsageError if limits or rate differ from those with which a drive has begun."""
        if changed := [name for name in BEGUN_WITH if self.values[name] != begun.values[name]]:
            raise UsageError(
                f"parameter {', '.join(changed)}: a drive waits or is on its way, and keeps the limits and the rate "
                "that it began with; call ~/stop first"
            )

    def _require_mean_rate(self, drive: Drive) -> None:
        """Raise UsageError if the mean rate of an axis exceeds its limit."""
        again = 1 + math.ceil(WINDOW / drive.t[-1]) if self.values["repeat"] else 1
        t = np.concatenate([drive.t + number * drive.t[-1] for number in range(again)])
        for (axis, once), limits in zip(drive.voltage.items(), self.limits, strict=True):
            v = np.tile(once, again)
            if (slower := slower_by(t, v, limits.mean_rate)) > 1.0:
                raise UsageError(
                    f"axis '{axis}': the drive has a mean rate of {highest_mean_rate(t, v):.4g} V/s "
                    f"over {WINDOW:g} s, mean_rate_limit is {limits.mean_rate:g} V/s; make it {slower:.3g} times "
                    f"slower: slew_limit {limits.slew / slower:.4g} and duration {self.values['duration'] * slower:.4g}"
                )


# Period of the watch and of messages while it waits, seconds.
WATCH_PERIOD, LOG_PERIOD = 0.02, 5.0
# A warning is logged if the excitation takes longer than planned by this factor.
SLUGGISH = 1.02


class Exciter(Node):
    """Excite a stage within its limits, and return it to its rest voltage when the excitation ends or is stopped.

    Publishes ``voltage_command`` with one sample per period of a monotonic clock: after a stall of the process the
    excitation continues with the next sample, without a voltage step. With the parameter ``output`` "trajectory" all
    samples are published in one message on ``voltage_trajectory``, volts in ``effort``, no positions, and
    ``voltage_trajectory_state`` tells what becomes of it (`slpi_ros.calibration.block_drive`). The node waits
    for a subscriber, and for ``stage_state`` to report where the amplifier is (or the parameter ``rest_voltage``), and
    says so while it waits. At the end it waits for ``stage_state`` to report the last voltage: a record that ends
    earlier would not hold the memory at its end.

    It drives only while no other node publishes the topic of its voltages, and while ``stage_state`` reports what the
    voltages can have caused (`slpi_ros.calibration.drive_monitor`). Else it returns to rest at the slew limit and ends
    with exit code 1 (without ``autostart`` it stays), as it does where a trajectory was not played, or it is not known
    to have stopped and returned. The reports are not held against a trajectory: the device plays it by itself.
    Services ``~/start`` and ``~/stop`` (std_srvs/Trigger); parameters in `DECLARATIONS`.
    """

    def __init__(self) -> None:
        super().__init__("exciter")
        self._parameter_set = Parameters(self, DECLARATIONS, ExciterSettings.of)
        values = self._values
        self._playback: Playback | None = None
        self._block: BlockDrive | None = None  # of the playback, unless it is live
        self._timer = None
        self._live = values["output"] == LIVE
        publisher = None if self._live else self.create_publisher(JointTrajectory, "voltage_trajectory", COMMANDS)
        self._guard = GuardedDrive(self, values, self._on_state, publisher)
        if not self._live:
            self.create_subscription(DiagnosticStatus, BLOCK_STATE, self._on_block_state, LATCHED)
        self._stamp_ns = 0  # of the last block
        serve(self, "~/start", self._on_start)
        serve(self, "~/stop", self._on_stop)
        self._listeners, self._same_since = 0, 0.0  # number of subscribers, and since when it is the same
        self._refusal: SlpiError | None = None
        self._rest: list[float] = []
        self._waiting = self._returning = self._arriving = self._leaving = self._ending = False
        self._begun = 0.0  # of waiting, of the excitation, of its end
        self._parameter_set.follow(lambda settings: None, self._require_as_begun)
        steady_timer(self, WATCH_PERIOD, self._watch)
        if values["autostart"]:
            self._wait()

    def destroy_node(self) -> None:
        """Return the axes to rest, then destroy the node."""
        if self.context.ok():
            if self._block is not None:
                self._end_block(self._block)
            elif self._playback:
                self._guard.return_to(self._rest)
            self._guard.deliver()
        super().destroy_node()

    def _end_block(self, block: BlockDrive) -> None:
        """Stop the block and wait for the way back to rest, which the driver and the stage tell."""
        self._ending = True
        block.stop()
        executor = make_executor("default")
        executor.add_node(self)
        while self._block is not None:
            executor.spin_once(timeout_sec=WATCH_PERIOD)
        executor.remove_node(self)
        executor.shutdown()

    @property
    def _values(self) -> Values:
        return self._parameter_set.settings.values

    def _require_as_begun(self, settings: ExciterSettings) -> None:
        if self._waiting or self._playback is not None:
            settings.require_as_begun(self._parameter_set.settings)

    # Before the excitation

    def _on_start(self) -> tuple[bool, str]:
        if self._playback or self._waiting:
            return False, "already started; call ~/stop first"
        self._wait()
        return True, f"drive '{self._values['drive']}' of {self._values['duration']:g} s"

    def _wait(self) -> None:
        self._guard.prepare(self._values)
        self._waiting, self._listeners, self._begun = True, 0, time.monotonic()

    def _start_when_ready(self) -> None:
        """Start once the number of subscribers has not changed for the time `settle`, so that none misses samples."""
        now, listeners = time.monotonic(), self._guard.publisher.get_subscription_count()
        if listeners != self._listeners:
            self._listeners, self._same_since = listeners, now
        if error := self._guard.overdue():
            self._waiting = False
            self._give_up(error)
        elif lacking := self._lacking():
            self.get_logger().info(f"waiting: {lacking}", throttle_duration_sec=LOG_PERIOD)
        elif listeners and now - self._same_since >= self._values["settle"]:
            self._waiting = False
            self._begin()

    def _lacking(self) -> str:
        """Return what is missing before the drive may start, and what to do; "" if nothing is."""
        lacking = self._guard.lacking()
        if not lacking or self._guard.heard or not self._guard.publisher.get_subscription_count():
            return lacking
        if self._guard.stranger() or not self._guard.looks:
            return lacking
        if self._values["rest_voltage"]:
            return ""
        return f"{lacking}; or give rest_voltage, if nothing reports where the amplifier is"

    # Excitation

    def _begin(self) -> None:
        settings, heard = self._parameter_set.settings, self._guard.heard
        found = self._guard.found() or settings.values["rest_voltage"]
        assert found
        try:
            self._guard.start(found)
            drive = settings.drawn(found)
            self._rest = [float(v[0]) for v in drive.voltage.values()]
            if not self._live and not self._guard.at(self._rest, TOLERATED_SHARE):
                raise RecordError(
                    f"exciter: the amplifier is at {', '.join(f'{v:g}' for v in found)} V, not at rest_voltage; a "
                    "trajectory would begin with a jump: move it there first"
                )
        except SlpiError as error:
            self._give_up(error)
            return
        if not heard:
            self.get_logger().warning(
                "nobody publishes stage_state: the amplifier is taken to be at rest_voltage, and nothing watches the "
                "sensor"
            )
        self._refusal, self._returning, self._arriving = None, False, self._live
        self._playback, self._begun = Playback(drive, repeat=self._values["repeat"]), time.monotonic()
        if self._live:
            if heard:
                self._guard.begin()
            self._timer = steady_timer(self, 1.0 / drive.rate, self._step)
        else:
            self._begin_block(self._playback)
        self.get_logger().info(f"exciting {', '.join(drive.axes)} for {self._values['duration']:g} s. {drive.why}")

    def _watch(self) -> None:
        """Wait for the stage; return to rest if it does not follow, or another publisher of voltages has appeared."""
        self._guard.listen()
        fault = self._guard.fault()
        if self._leaving:
            self._leave_when_reported()
        elif self._waiting:
            self._start_when_ready()
        elif fault is not None and self._playback and not self._stopped:
            self._refusal = fault
            self.get_logger().error(f"{fault}; returning to rest")
            self._return()
        if self._block is not None and self._playback is not None:
            self._block.look(time.monotonic_ns())
            if self._block.over:
                self._end(self._playback)

    @property
    def _stopped(self) -> bool:
        """Whether the return to rest has begun."""
        return self._returning or (self._block is not None and self._block.stopped)

    def _give_up(self, error: SlpiError) -> None:
        """Report the error; end with its exit code if the node has started by itself, or ends anyway."""
        if self._values["autostart"] or self._ending:
            request_stop(error)
        else:
            self.get_logger().error(str(error))

    def _step(self) -> None:
        playback = self._playback
        if playback is None:
            return
        # To rest_voltage, from where the amplifier is.
        self._arriving = self._arriving and not self._guard.at(self._rest)
        if self._returning:
            ended = self._guard.return_step(self._rest)
        elif self._arriving:
            self._guard.return_step(self._rest)
            self._begun, ended = time.monotonic(), False
        else:
            sample = playback.next()
            self._guard.move(sample)
            ended = playback.done and self._guard.at(sample)
        if ended:
            self._end(playback)

    def _end(self, playback: Playback) -> None:
        if self._timer is not None:
            self.destroy_timer(self._timer)
        self._guard.end()
        stopped, block = self._stopped, self._block
        self._playback = self._block = None
        took, planned = time.monotonic() - self._begun, playback.drive.t[-1]
        if block is not None and block.failure:
            self._refusal = self._failed(block)
        else:
            rest = ", ".join(f"{axis} at {v:g} V" for axis, v in zip(playback.drive.axes, self._rest, strict=True))
            sure = "" if block is None or block.told else ", which no driver has confirmed"
            self.get_logger().info(f"{'stopped' if stopped else 'done'} after {took:.1f} s{sure}; {rest}")
        if self._refusal is not None:
            self._give_up(self._refusal)
        elif not stopped:
            if self._live and took > SLUGGISH * planned:
                self.get_logger().warning(
                    f"the excitation took {took:.1f} s instead of {planned:.1f} s; use a lower rate on this machine"
                )
            if self._values["autostart"]:
                self._leaving, self._begun = True, time.monotonic()

    def _leave_when_reported(self) -> None:
        """Stop once ``stage_state``, if it was ever received, has reported the last voltages for some time."""
        reported = self._guard.reported
        if reported is None or self._guard.settled(self._rest, self._begun, REPORT_LASTS, REPORT_PATIENCE):
            if reported is not None and not self._guard.reports(self._rest):
                self.get_logger().warning(
                    f"stage_state reports {volts(*reported)} V, {REPORT_PATIENCE:g} s after the "
                    f"end at {volts(*self._rest)} V; a record that ends now does not hold the end"
                )
            request_stop()

    # A drive as one block

    def _begin_block(self, playback: Playback) -> None:
        """Send the drive to the driver."""
        topic = self.resolve_topic_name(BLOCK_STATE)
        if not (expected := self.count_publishers(topic) > 0):
            self.get_logger().warning(f"nobody publishes {topic}: whether the trajectory is played is not confirmed")
        limits, send = self._parameter_set.settings.limits, partial(self._send, playback.drive)
        self._block = BlockDrive(playback, limits, send, time.monotonic_ns(), expected=expected)

    def _send(self, drive: Drive, voltages: FloatArray) -> int:
        """Publish voltages (V), shape (N, axes), of a drive as a block, none to stop it; return its stamp (ns)."""
        # A simulated clock may stand still.
        self._stamp_ns = max(self.get_clock().now().nanoseconds, self._stamp_ns + 1)
        self._guard.publisher.publish(trajectory_of(self._stamp_ns, drive.axes, voltages, drive.rate))
        return self._stamp_ns

    def _on_block_state(self, status: DiagnosticStatus) -> None:
        state = block_state(status.message, {each.key: each.value for each in status.values})
        if state is not None and self._block is not None:
            self._block.hear(state)

    def _on_state(self, _data: bytes, _clock_ns: int, displacements: Sequence[float]) -> None:
        if displacements and self._block is not None and self._guard.reported is not None:
            self._block.report(self._guard.reported)

    def _failed(self, block: BlockDrive) -> RecordError:
        """Return why a block was not played, stopped or brought back, and where the stage is."""
        reported = self._guard.reported
        there = f"stage_state reports {volts(*reported)} V" if reported else "nothing reports where the stage is"
        before = f"{self._refusal}; besides, " if self._refusal is not None else f"{self.get_name()}: "
        return RecordError(f"{before}{block.failure}; {there}, rest_voltage is {volts(*self._rest)} V")

    # Stop

    def _on_stop(self) -> tuple[bool, str]:
        self._waiting = False
        return True, self._return() if self._playback else "at rest"

    def _return(self) -> str:
        """Start the return to rest; return what happens now."""
        if self._block is not None:
            self._block.stop()
            return "the driver is asked to stop the trajectory; the way back begins where it holds"
        self._returning = True
        return f"back in {self._guard.return_seconds(self._rest):.1f} s"


def trajectory_of(stamp_ns: int, axes: Sequence[str], voltages: FloatArray, rate: float) -> bytes:
    """Return voltages (V), shape (N, axes), at a rate (Hz) as a serialised trajectory made at a time (ns).

    Volts are in ``effort``, there are no positions, and the first sample is one period after the start.
    """
    times_ns = np.round(np.arange(1, len(voltages) + 1) * (SECOND_NS / rate)).astype(np.int64)
    return encode_trajectory(stamp_ns, axes, times_ns, np.empty((len(voltages), 0)), voltages)
