"""Node ``exciter``: excites a stage for identification."""

import math
import sys
import time
from array import array
from collections.abc import Sequence
from dataclasses import dataclass

from builtin_interfaces.msg import Duration as DurationMsg
from rclpy.clock import Clock, ClockType
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray
from std_srvs.srv import Trigger
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from slpi_ros.errors import RecordError, SlpiError, UsageError
from slpi_ros.excitation.drives import DRIVES, Drive, Playback, excite
from slpi_ros.io.messages import SECOND_NS
from slpi_ros.nodes.common import COMMANDS, LATCHED, request_stop, run
from slpi_ros.nodes.help import help_asked
from slpi_ros.nodes.parameters import Declaration, Parameters, Values, numbers, validated

# A reported voltage outside the limits by at most this fraction of the range counts as at the limit.
READ_BACK = 0.01

VOLTAGE = (-10_000.0, 10_000.0)
LIVE = "live"

DECLARATIONS = (
    Declaration("axes", ["x"], "Names of the axes, in the order of voltage_command.", read_only=True),
    Declaration(
        "voltage_min", math.nan, "Lower voltage limit, volts; required. One value, or one for each axis.",
        number=True,
    ),
    Declaration(
        "voltage_max", math.nan, "Upper voltage limit, volts; required. One value, or one for each axis.",
        number=True,
    ),
    Declaration(
        "slew_limit", 0.0, "Maximum rate of a voltage, V/s; 0: no limit. One value, or one for each axis.",
        between=(0.0, 1e9), number=True, each_axis=True,
    ),
    Declaration(
        "start_voltage", math.nan,
        "Voltage before and after the excitation, volts; NaN: as reported by stage_state, or voltage_min without a "
        "report. One value, or one for each axis.",
        number=True,
    ),
    Declaration("duration", 30.0, "Total excitation time of all axes, seconds.", between=(0.1, 86_400.0), number=True),
    Declaration("rate", 200.0, "Sample rate, hertz.", between=(1.0, 10_000.0), number=True),
    Declaration(
        "settle", 3.0, "Seconds to wait for further subscribers after the first one.",
        between=(0.0, 3600.0), number=True,
    ),
    Declaration("drive", DRIVES[0], f"Excitation drive: {', '.join(DRIVES)}.", choices=DRIVES),
    Declaration("seed", 0, "Seed of the random parts of the excitation drive.", between=(0, 2**31 - 1)),
    Declaration("repeat", False, "Whether to repeat the excitation until stopped."),
    Declaration(
        "output", LIVE,
        "live: samples on voltage_command at the sample rate. trajectory: all samples in one message on "
        "voltage_trajectory, for a device with its own timing.",
        read_only=True, choices=(LIVE, "trajectory"),
    ),
    Declaration(
        "autostart", True, "Whether to start at once and exit at the end; if false, ~/start starts.", read_only=True
    ),
)  # fmt: skip


@dataclass(frozen=True)
class ExciterSettings:
    """Validated settings of the exciter.

    Parameters
    ----------
    values : mapping of str to object
        All parameters by name.
    limits : (list of float, list of float), volts
        Lowest and highest voltage of each axis.
    start : list of float or None, volts
        Voltage of each axis before and after the excitation; None: as reported by ``stage_state``.
    """

    values: Values
    limits: tuple[list[float], list[float]]
    start: list[float] | None

    @classmethod
    def of(cls, given: Values) -> "ExciterSettings":
        """Return the settings from a mapping of parameter names to values.

        Raises
        ------
        UsageError
            If a value is not valid, or the values do not allow an excitation.
        """
        values, axes = validated(DECLARATIONS, given), given["axes"]
        low, high = (numbers(given, name, axes, *VOLTAGE) for name in ("voltage_min", "voltage_max"))
        start = given["start_voltage"]
        start = None if start != start else numbers(given, "start_voltage", axes, *VOLTAGE)
        if values["repeat"] and values["output"] != LIVE:
            raise UsageError(f"parameters repeat and output '{values['output']}' do not go together; set one of them")
        settings = cls(values, (low, high), start)
        settings.drawn(None)
        return settings

    def drawn(self, heard: Sequence[float] | None) -> Drive:
        """Return the excitation, starting at the reported voltages `heard` (V, one per axis; None if unknown).

        Raises
        ------
        UsageError
            If the settings do not allow an excitation.
        SlpiError
            If a reported voltage is outside the limits.
        """
        start = self._within_limits(heard) if self.start is None and heard else self.start
        low, high = self.limits
        given = {name: self.values[name] for name in ("axes", "slew_limit", "duration", "rate", "seed", "drive")}
        return excite(voltage_min=low, voltage_max=high, start=start, **given)

    def _within_limits(self, heard: Sequence[float]) -> list[float]:
        for axis, v, low, high in zip(self.values["axes"], heard, *self.limits, strict=True):
            slack = READ_BACK * (high - low)
            if not low - slack <= v <= high + slack:
                raise SlpiError(
                    f"exciter: axis '{axis}' is at {v:g} V, outside {low:g} to {high:g} V; move it inside first"
                )
        return [min(max(v, low), high) for v, low, high in zip(heard, *self.limits, strict=True)]


POLL_PERIOD = 0.1
LOG_PERIOD = 5.0
# Time to wait at shutdown for the delivery of the last voltage.
PATIENCE = Duration(seconds=1.0)
# Time to wait at the end for stage_state to report the last voltage, and what a report within READ_BACK must then last
# for a slow stage to have come all the way, seconds.
REPORT_PATIENCE, REPORT_LASTS = 3.0, 0.2
# A warning is logged if the excitation takes longer than planned by this factor.
SLUGGISH = 1.02


class Exciter(Node):
    """Excite a stage within its limits, and return it to its initial voltage when the excitation ends or is stopped.

    Publishes ``voltage_command`` with one sample per period of a monotonic clock: after a stall of the process the
    excitation continues with the next sample, without a voltage step. With the parameter ``output`` "trajectory" all
    samples are published in one message on ``voltage_trajectory``, volts in ``effort``, no positions. Subscribes to
    ``stage_state`` for the initial voltages. The node waits for a subscriber before it starts, and at the end for
    ``stage_state`` to report the last voltage: a record that ends earlier would not hold the memory at its end.
    It drives only while no other node publishes the topic of its voltages: beside one it does not start, and if one
    appears later it returns to the initial voltages; in both cases it ends with exit code 1 (without ``autostart`` it
    stays). Services ``~/start`` and ``~/stop`` (std_srvs/Trigger); parameters in `DECLARATIONS`.

    Raises
    ------
    UsageError
        If the parameters are not valid.
    """

    def __init__(self) -> None:
        super().__init__("exciter")
        self._parameter_set = Parameters(self, DECLARATIONS, ExciterSettings.of)
        self._parameter_set.follow(lambda settings: None)
        self._playback: Playback | None = None
        self._timer = None
        self._heard: list[float] | None = None
        self._live = self._values["output"] == LIVE
        if self._live:
            self._publisher = self.create_publisher(Float64MultiArray, "voltage_command", COMMANDS)
        else:
            self._publisher = self.create_publisher(JointTrajectory, "voltage_trajectory", LATCHED)
        self.create_subscription(JointState, "stage_state", self._on_state, qos_profile_sensor_data)
        self.create_service(Trigger, "~/start", self._on_start)
        self.create_service(Trigger, "~/stop", self._on_stop)
        # A simulated clock may stop.
        self._steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._polls_left = self._listeners = 0
        self._waiting = self.create_timer(POLL_PERIOD, self._poll_subscribers, clock=self._steady, autostart=False)
        self._refusal: SlpiError | None = None
        self._watching = self.create_timer(POLL_PERIOD, self._watch_for_others, clock=self._steady, autostart=False)
        self._last: list[float] = []
        self._away = 0.0
        self._leaving = self.create_timer(POLL_PERIOD, self._poll_report, clock=self._steady, autostart=False)
        if self._values["autostart"]:
            self._wait()

    def destroy_node(self) -> None:
        """Return the axes to their initial voltage, then destroy the node."""
        if self.context.ok():
            if self._playback:
                self._return(self._playback)
                while not self._playback.done:
                    self._publish_sample(self._playback.next())
                    time.sleep(1.0 / self._playback.drive.rate)
            self._publisher.wait_for_all_acked(PATIENCE)
        super().destroy_node()

    @property
    def _values(self) -> Values:
        return self._parameter_set.settings.values

    # Before the excitation

    def _on_start(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        if self._playback or self._polls_left:
            response.message = "already started; call ~/stop first"
        else:
            self._wait()
            response.success = True
            response.message = f"drive '{self._values['drive']}' of {self._values['duration']:g} s"
        return response

    def _wait(self) -> None:
        self._listeners = 0
        self._polls_left = 1
        self._waiting.reset()

    def _poll_subscribers(self) -> None:
        """Start once the number of subscribers has not changed for the time `settle`, so that none misses samples."""
        listeners = self._publisher.get_subscription_count()
        if not listeners:
            self.get_logger().info(
                f"waiting for a subscriber of {self._publisher.topic_name}", throttle_duration_sec=LOG_PERIOD
            )
        elif listeners != self._listeners:
            self._polls_left = 1 + round(self._values["settle"] / POLL_PERIOD)
        else:
            self._polls_left -= 1
        self._listeners = listeners
        if not self._polls_left:
            self._waiting.cancel()
            self._begin()

    def _on_state(self, state: JointState) -> None:
        at = dict(zip(state.name, state.effort, strict=False))
        heard = [at.get(axis, math.nan) for axis in self._values["axes"]]
        if all(map(math.isfinite, heard)):
            self._heard = heard

    # Excitation

    def _begin(self) -> None:
        values = self._values
        try:
            self._require_alone()
            drive = self._parameter_set.settings.drawn(self._heard)
        except SlpiError as error:
            self._give_up(error)
            return
        self._refusal = None
        self._watching.reset()
        self._playback, self._begun = Playback(drive, repeat=values["repeat"]), time.monotonic()
        self._timer = self.create_timer(1.0 / drive.rate, self._step, clock=self._steady)
        self._publish_trajectory(self._playback)
        self.get_logger().info(f"exciting {', '.join(drive.axes)} for {values['duration']:g} s. {drive.why}")

    def _require_alone(self) -> None:
        """Raise RecordError if another node publishes the topic of the voltages."""
        others = self.count_publishers(self._publisher.topic_name) - 1
        if others > 0:
            raise RecordError(
                f"exciter: {others} other publisher of {self._publisher.topic_name}; stop it, as the voltage would "
                "jump between the commands of both"
            )

    def _watch_for_others(self) -> None:
        """Start the return to the initial voltages if another publisher of voltages has appeared."""
        if self._playback and not self._playback.stopping:
            try:
                self._require_alone()
            except RecordError as error:
                self._refusal = error
                self._return(self._playback)

    def _give_up(self, error: SlpiError) -> None:
        """Report the error; end with its exit code if the node has started by itself."""
        if self._values["autostart"]:
            request_stop(error)
        else:
            self.get_logger().error(str(error))

    def _step(self) -> None:
        if self._playback:
            self._publish_sample(self._playback.next())
            if self._playback.done:
                self._end(self._playback)

    def _publish_sample(self, voltages: list[float]) -> None:
        if self._live:
            self._publisher.publish(Float64MultiArray(data=array("d", voltages)))

    def _publish_trajectory(self, playback: Playback) -> None:
        if not self._live:
            self._publisher.publish(trajectory_of(playback))

    def _end(self, playback: Playback) -> None:
        self.destroy_timer(self._timer)
        self._watching.cancel()
        self._playback = None
        took, planned = time.monotonic() - self._begun, playback.drive.t[-1]
        rest = ", ".join(f"{axis} at {v[0]:g} V" for axis, v in playback.drive.voltage.items())
        self.get_logger().info(f"{'stopped' if playback.stopping else 'done'} after {took:.1f} s; {rest}")
        if self._refusal is not None:
            self._give_up(self._refusal)
        elif not playback.stopping:
            if took > SLUGGISH * planned:
                self.get_logger().warning(
                    f"the excitation took {took:.1f} s instead of {planned:.1f} s; use a lower rate on this machine"
                )
            if self._values["autostart"]:
                self._last = [float(v[-1]) for v in playback.drive.voltage.values()]
                self._begun = self._away = time.monotonic()
                self._leaving.reset()

    def _poll_report(self) -> None:
        """Stop once ``stage_state``, if it was ever received, has reported the last voltages for some time."""
        now = time.monotonic()
        spans = [high - low for low, high in zip(*self._parameter_set.settings.limits, strict=True)]
        heard = self._heard or self._last
        if any(abs(v - last) > READ_BACK * span for v, last, span in zip(heard, self._last, spans, strict=True)):
            self._away = now
        if self._heard is None or now - self._away >= REPORT_LASTS:
            request_stop()
        elif now - self._begun > REPORT_PATIENCE:
            self.get_logger().warning(
                f"stage_state reports {', '.join(f'{v:.6g}' for v in heard)} V, {REPORT_PATIENCE:g} s after the end at "
                f"{', '.join(f'{v:.6g}' for v in self._last)} V; a record that ends now does not hold the end"
            )
            request_stop()

    # Stop

    def _on_stop(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        response.success = True
        self._waiting.cancel()
        self._polls_left = 0
        response.message = f"back in {self._return(self._playback):.1f} s" if self._playback else "at rest"
        return response

    def _return(self, playback: Playback) -> float:
        """Start the return to the initial voltages; return its duration, seconds."""
        if playback.stop():
            self._publish_trajectory(playback)
        return playback.seconds_left


def trajectory_of(playback: Playback) -> JointTrajectory:
    """Return the remaining samples as a trajectory that starts now: volts in ``effort``, no positions."""
    rate = playback.drive.rate
    points = [
        JointTrajectoryPoint(effort=array("d", voltages), time_from_start=_duration(number / rate))
        for number, voltages in enumerate(playback.samples_left.tolist(), 1)
    ]
    return JointTrajectory(joint_names=list(playback.drive.axes), points=points)


def _duration(seconds: float) -> DurationMsg:
    whole_seconds, nanoseconds = divmod(round(seconds * SECOND_NS), SECOND_NS)
    return DurationMsg(sec=whole_seconds, nanosec=nanoseconds)


def main() -> int:
    """Run the node; return the exit code of the process: 0 when the excitation is complete or was stopped."""
    if help_asked("exciter", Exciter, DECLARATIONS):
        return 0
    return run(Exciter)


if __name__ == "__main__":
    sys.exit(main())
