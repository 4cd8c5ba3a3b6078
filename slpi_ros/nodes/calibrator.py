"""Node ``calibrator``: calibrates a stage by itself, from an unknown stage to a verified model with causes.

The decisions are those of `slpi_ros.calibration.run.calibrate`, which computes in a thread of its own. This node drives
the stage and watches over it: every voltage passes the rate limiter of its axis, and whatever goes wrong during a drive
ends in a ramp back to rest.
"""

import math
import os
import sys
import threading
import time
from array import array
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from rclpy.clock import Clock, ClockType
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray, String
from std_srvs.srv import Trigger

from slpi_ros.calibration.run import Outcome, Progress, Recording, Request, aligned, calibrate
from slpi_ros.calibration.settings import CalibrationSettings
from slpi_ros.errors import RecordError, SlpiError, UsageError
from slpi_ros.excitation.calibration import MEAN_SPEED
from slpi_ros.identification.progress import listening
from slpi_ros.io.atomic_file import make_folder
from slpi_ros.io.bag_files import partial_path
from slpi_ros.io.bag_reader import read_bag
from slpi_ros.io.bag_writer import BagWriter
from slpi_ros.io.messages import SECOND_NS, encode_joint_states
from slpi_ros.model.document import format_model
from slpi_ros.model.limits import Limits, RateLimiter
from slpi_ros.nodes.common import COMMANDS, LATCHED, WARN, Diagnostics, Health, request_stop, run
from slpi_ros.nodes.help import help_asked
from slpi_ros.nodes.parameters import Declaration, Parameters, Values, numbers, validated
from slpi_ros.reports.calibration import PAGE, write_files

VOLTAGE = (-10_000.0, 10_000.0)
# Topics of a bag. The second one, only in bags of a verification, holds the desired displacement, NaN before and after
# the path, and the commanded voltage.
STATE, PATH = "stage_state", "verification_path"
DECLARATIONS = (
    Declaration("axes", ["x"], "Names of the axes, in the order of voltage_command.", read_only=True),
    Declaration(
        "voltage_min", math.nan, "Lower voltage limit, volts; required. One value, or one for each axis.",
        read_only=True, number=True,
    ),
    Declaration(
        "voltage_max", math.nan, "Upper voltage limit, volts; required. One value, or one for each axis.",
        read_only=True, number=True,
    ),
    Declaration(
        "slew_limit", 0.0, "Maximum rate of a voltage, V/s; 0: no limit. One value, or one for each axis.",
        read_only=True, between=(0.0, 1e9), number=True, each_axis=True,
    ),
    Declaration(
        "acceleration_limit", 0.0,
        "Maximum change of the rate of a voltage, V/s^2; 0: no limit. One value, or one for each axis.",
        read_only=True, between=(0.0, 1e12), number=True, each_axis=True,
    ),
    Declaration(
        "rest_voltage", math.nan,
        "Voltage before and after every drive, volts; NaN: 0 V, or the limit next to it. One value, or one for each "
        "axis.",
        read_only=True, number=True,
    ),
    Declaration("rate", 200.0, "Samples per second, hertz.", read_only=True, between=(10.0, 10_000.0), number=True),
    Declaration(
        "budget", 240.0, "Time for all drives, seconds for each axis.",
        read_only=True, between=(1.0, 86_400.0), number=True,
    ),
    Declaration(
        "target", 0.0, "Largest mean error on a path not in the records, micrometres; 0: times_the_floor.",
        read_only=True, between=(0.0, 1e6), number=True,
    ),
    Declaration(
        "times_the_floor", 3.0, "Target in multiples of the repeatability floor, if target is 0.",
        read_only=True, between=(0.1, 1e6), number=True,
    ),
    Declaration("output", "", "Folder for bags, model, diagnosis and page; required.", read_only=True),
    Declaration(
        "resume", False, "Whether to go on with the complete bags that output holds already.", read_only=True
    ),
    Declaration("seed", 0, "Seed of the random parts of the drives.", read_only=True, between=(0, 2**31 - 1)),
    Declaration(
        "state_timeout", 0.5, "Seconds without a valid stage_state after which a drive is given up.",
        read_only=True, between=(1e-3, 60.0), number=True,
    ),
    Declaration(
        "patience", 30.0,
        "Seconds to wait for stage_state, for a subscriber of voltage_command and for its other publishers to end.",
        read_only=True, between=(0.1, 3600.0), number=True,
    ),
    Declaration("autostart", True, "Whether to start at once; if false, ~/start starts.", read_only=True),
)  # fmt: skip

# Longest step of a drive (in periods of the rate) that follows a late sample.
MOST_PERIODS = 2.0
# Time for the last readings of a drive, or of a return to rest, to arrive; period of the held voltage between drives,
# and of the diagnostics; time for the delivery of the last message; longest wait for a state at rest; seconds.
TAIL, HOLD_PERIOD, REPORT_PERIOD, DELIVERY, LATEST = 0.3, 0.1, 1.0, Duration(seconds=1.0), 2.0
# A reported voltage may be outside the limits by this share of the range. A displacement beyond FARTHEST (m) is no
# reading. The time of stage_state may jump by JUMP (s). A sensor is frozen if FROZEN readings in a row are equal while
# the voltage moves over FROZEN_MOVE of its range.
READ_BACK, FARTHEST, JUMP, FROZEN, FROZEN_MOVE = 0.02, 0.1, 1.0, 20, 0.05
RESUME = "what was recorded is kept, go on with resume:=true"
# A voltage is at its goal within this share of the range.
ARRIVED = 1e-6


class Interrupted(SlpiError):
    """The calibration was ended before its end: by a request, a signal or a fault."""


@dataclass
class _Job:
    """A drive on its way: its place in drive time, its bag, and what ended it."""

    request: Request
    bag: BagWriter
    at: float = 0.0
    tail: float = TAIL
    failure: SlpiError | None = None
    finished: threading.Event = field(default_factory=threading.Event)

    def goals(self) -> list[float]:
        """Return the voltages (V) of the drive at its present time."""
        drive = self.request.drive
        return [float(np.interp(self.at, drive.t, v)) for v in drive.voltage.values()]

    def desired(self) -> list[float]:
        """Return the desired displacements (m) at the present time, NaN if there are none."""
        return [float(np.interp(self.at, self.request.drive.t, y)) for y in self.request.desired.values()]


def settings_of(values: Values) -> CalibrationSettings:
    """Return the settings of a calibration from the parameters of the node.

    Raises
    ------
    UsageError
        If a value is not valid.
    """
    checked, axes = validated(DECLARATIONS, values), tuple(values["axes"])
    if not checked["output"]:
        raise UsageError("calibrator: no output; name the folder with --ros-args -p output:=FOLDER")
    lows, highs = (numbers(values, name, axes, *VOLTAGE) for name in ("voltage_min", "voltage_max"))
    limits = tuple(
        Limits(low, high, slew or math.inf, acceleration or math.inf)
        for low, high, slew, acceleration in zip(
            lows, highs, checked["slew_limit"], checked["acceleration_limit"], strict=True
        )
    )
    rest = values["rest_voltage"]
    given = numbers(values, "rest_voltage", axes, *VOLTAGE) if rest == rest else [each.clip(0.0) for each in limits]
    return CalibrationSettings(
        axes=axes,
        limits=limits,
        rest=tuple(given),
        rate=checked["rate"],
        budget=checked["budget"] * len(axes),
        target=checked["target"] * 1e-6,
        floors=checked["times_the_floor"],
        seed=checked["seed"],
    )


class Calibrator(Node):
    """Calibrate a stage by itself, and end with exit code 0 if the target is met, else 1.

    Subscribes to ``stage_state``; publishes ``voltage_command``, the model with its causes on ``stage_model``, and
    progress on ``/diagnostics``. Services ``~/start``, ``~/pause`` (holds the voltage until ``~/start``) and ``~/stop``
    (std_srvs/Trigger); parameters in `DECLARATIONS`. The folder ``output`` holds all bags, ``model.json``,
    ``report.html`` and the last diagnosis.

    Nothing is moved while stage_state is missing or another node publishes voltages. If stage_state becomes stale, a
    reading is absurd, time jumps, another publisher appears or a bag cannot be written, the voltages return to rest
    within the limits. An interrupted drive is kept as ``interrupted_NAME``.

    Raises
    ------
    UsageError
        If a parameter is not valid.
    RecordError
        If the folder cannot be used.
    """

    def __init__(self) -> None:
        super().__init__("calibrator")
        self._parameter_set = Parameters(self, DECLARATIONS, lambda values: dict(values))
        values = self._parameter_set.settings
        self._settings = settings = settings_of(values)
        self._output = Path(values["output"]).absolute()
        _prepare(self._output, resume=values["resume"])
        self._timeout, self._patience = float(values["state_timeout"]), float(values["patience"])
        self._limiters = [RateLimiter(limits) for limits in settings.limits]
        self._voltages: list[float] | None = None
        # Voltages in the last state that arrived.
        self._reported: Sequence[float] = settings.rest
        self._goals: list[float] = []
        self._job: _Job | None = None
        self._failure: SlpiError | None = None
        self._outcome: Outcome | SlpiError | None = None
        self._progress: Progress | None = None
        self._hardware_id = ""
        # Whether the node has begun to command voltages.
        self._driving = self._returning = self._paused = False
        self._begun = self._heard = self._held = self._guarded = self._stepped = self._moved = time.monotonic()
        self._stamp_ns = self._arrival_ns = self._count = 0
        self._still: dict[str, tuple[float, int, float, float]] = {}
        self._steady = Clock(clock_type=ClockType.STEADY_TIME)
        simulated = self.get_parameter("use_sim_time").value
        self._drive_clock = self.get_clock() if simulated else self._steady
        self._step_ns = self._guard_ns = 0
        self._publisher = self.create_publisher(Float64MultiArray, "voltage_command", COMMANDS)
        self._models = self.create_publisher(String, "stage_model", LATCHED)
        self._diagnostics = Diagnostics(self, "calibrator")
        self._subscription = None
        for name, answer in (("start", self._on_start), ("pause", self._on_pause), ("stop", self._on_stop)):
            self.create_service(Trigger, f"~/{name}", answer)
        self._thread = threading.Thread(target=self._calibrate, daemon=True)
        self._waiting = bool(values["autostart"])
        period = 1.0 / settings.rate
        self.create_timer(period, self._step, clock=self._drive_clock)
        self.create_timer(period, self._guard, clock=self._steady)
        self.create_timer(REPORT_PERIOD, self._report, clock=self._steady)

    @property
    def computing(self) -> bool:
        """Whether the thread of the calibration is alive."""
        return self._thread.is_alive()

    def destroy_node(self) -> None:
        """Return to rest, keep what was recorded, then destroy the node.

        Raises
        ------
        Interrupted
            If the calibration was ended by a signal.
        """
        ended = self._outcome is not None or self._failure is not None
        if self.context.ok() and self._driving:
            self._returning = True
            while not self._at_rest():
                self._return_step()
                time.sleep(1.0 / self._settings.rate)
            self._publisher.wait_for_all_acked(DELIVERY)
        self._fail(Interrupted("calibrator: ended by a signal"))
        self._end_job()
        super().destroy_node()
        if not ended and self._failure is not None:
            raise self._failure

    # The calibration, in its own thread

    def _calibrate(self) -> None:
        def listen(_: str) -> None:
            if self._failure is not None:
                raise self._failure

        try:
            with listening(listen):
                outcome = calibrate(self._settings, self._record, self._on_progress)
                write_files(self._output, outcome)
            self._outcome = outcome
        except SlpiError as error:
            self._outcome = error
        except Exception as error:
            # A defect must not leave the node waiting for ever.
            self._outcome = SlpiError(f"calibrator: {type(error).__name__}: {error}; {RESUME}")

    def _on_progress(self, progress: Progress) -> None:
        self._progress = progress
        error = "" if progress.error is None else f", mean error so far {progress.error * 1e6:.4f} µm"
        self.get_logger().info(
            f"step {progress.step}: {progress.doing}; {progress.seconds_left:.0f} s of drives left{error}"
        )

    def _record(self, request: Request) -> Recording:
        """Drive the stage and return what it did, or read it if the bag is complete."""
        bag = self._output / request.name
        if not bag.exists():
            job = _Job(request, BagWriter(bag, topic=f"/{STATE}"))
            if request.desired:
                job.bag.add_topic(PATH)
            self._heard = self._stepped = time.monotonic()
            self._job = job
            job.finished.wait()
            if job.failure is not None:
                raise job.failure
        record = replace(read_bag(bag, STATE), source=request.name)
        if not request.desired:
            return Recording(record, {})
        sent = read_bag(bag, PATH)
        return aligned(record, sent.time_ns, sent.voltage, sent.displacement)

    # Drives

    def _step(self) -> None:
        """Advance the drive by the time since the last step, at most `MOST_PERIODS` periods."""
        now = self._drive_clock.now().nanoseconds
        elapsed, self._step_ns = (now - self._step_ns) * 1e-9, now
        job, voltages = self._job, self._voltages
        if elapsed > 0.0:
            self._stepped = time.monotonic()
        if self._returning or job is None or voltages is None or elapsed <= 0.0:
            return
        dt = min(elapsed, MOST_PERIODS / self._settings.rate)
        if not self._paused:
            job.at += dt
            self._goals = job.goals()
        self._move(self._goals, dt)
        if job.request.desired and not self._paused:
            self._keep_desired(job)
        if job.at >= job.request.drive.t[-1] and not self._paused:
            job.tail -= dt
            if job.tail <= 0.0:
                self._end_job()

    def _move(self, goals: Sequence[float], dt: float) -> None:
        """Move all axes towards their goals (V) within the limits, and publish the voltages."""
        assert self._voltages is not None
        self._voltages = [
            limiter.step(v, goal, dt) for limiter, v, goal in zip(self._limiters, self._voltages, goals, strict=True)
        ]
        self._publisher.publish(Float64MultiArray(data=array("d", self._voltages)))
        self._held = time.monotonic()

    def _keep_desired(self, job: _Job) -> None:
        """Record desired displacement and command, stamped as they are sent."""
        assert self._voltages is not None
        stamp = self.get_clock().now().nanoseconds
        message = encode_joint_states(
            np.array([stamp]), np.array([job.desired()]), np.array([self._voltages]), self._settings.axes
        )[0]
        self._write(job, stamp, message, PATH)

    def _write(self, job: _Job, stamp: int, message: bytes, topic: str) -> None:
        try:
            job.bag.write(stamp, message, topic)
        except RecordError as error:
            self._fail(RecordError(f"{error}; its unfinished files are in {job.bag.partial}"))

    def _end_job(self) -> None:
        """Complete the bag of the job and return to the calibration."""
        job, self._job = self._job, None
        if job is None:
            return
        job.failure = self._failure
        try:
            if job.bag.message_count:
                job.bag.close()
                if job.failure is not None:
                    job.bag.path.rename(_free(job.bag.path.with_name(f"interrupted_{job.bag.path.name}")))
            else:
                job.bag.discard()
                job.failure = job.failure or RecordError(f"calibrator: no {STATE} during {job.request.name}")
        except (RecordError, OSError) as error:
            job.failure = job.failure or RecordError(f"{error}; {RESUME}")
        job.finished.set()

    # What is watched

    def _guard(self) -> None:
        """Check the stage once a period, and step the return to rest, on a clock that does not stop."""
        now = time.monotonic()
        late = now - self._guarded - 1.0 / self._settings.rate
        if late > 1.0 / self._settings.rate:
            # States that came while this process was held up have not been read yet.
            self._heard += late
        self._guarded = now
        if self._subscription is None:
            self._listen()
        if self._returning:
            self._return_step()
            if not self._at_rest():
                self._moved = now
            # States of the return still arrive for a while, on a busy machine for longer.
            self._returning = now - self._moved < (TAIL if self._reports_rest() else LATEST)
        elif self._outcome is not None:
            self._finish()
        elif self._failure is not None:
            self._end_job()
            request_stop(self._failure)
        elif self._job is not None:
            if now - self._heard > self._timeout:
                self._fail(RecordError(f"calibrator: no valid {STATE} for {now - self._heard:.2g} s; check the driver"))
            if now - self._stepped > self._patience:
                self._fail(RecordError(f"calibrator: time stands still for {self._patience:g} s; check /clock"))
            self._require_alone()
        elif self._waiting:
            self._start_when_ready(now)
        if self._driving and now - self._held > HOLD_PERIOD:
            # A stage that answers commands goes on reporting.
            self._move(self._goals, 0.0)

    def _listen(self) -> None:
        """Subscribe to the states with the reliability that their publishers offer."""
        publishers = self.get_publishers_info_by_topic(self.resolve_topic_name(STATE))
        if publishers:
            reliable = all(each.qos_profile.reliability == ReliabilityPolicy.RELIABLE for each in publishers)
            reliability = ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT
            qos = QoSProfile(depth=1000, reliability=reliability)
            self._subscription = self.create_subscription(JointState, STATE, self._on_state, qos, raw=True)

    def _start_when_ready(self, now: float) -> None:
        """Start once the stage reports and somebody takes the voltages; fail if that lasts too long."""
        # A publisher that was killed is known for some seconds more.
        others = self._others()
        reports = self._count and now - self._heard <= self._timeout
        if reports and not others and self._publisher.get_subscription_count():
            self._waiting = False
            self._driving = self._returning = True
            self._thread.start()
        elif now - self._begun > self._patience and others:
            self._require_alone()
        elif now - self._begun > self._patience:
            lacking = (
                f"no subscriber of {self._publisher.topic_name}"
                if reports
                else f"no valid {STATE} with axes {', '.join(self._settings.axes)}"
            )
            self._fail(RecordError(f"calibrator: {lacking} for {self._patience:g} s; start the driver of the stage"))

    def _others(self) -> int:
        """Return the number of other publishers of voltages."""
        return self.count_publishers(self._publisher.topic_name) - 1

    def _require_alone(self) -> None:
        others = self._others()
        if others > 0:
            self._fail(
                RecordError(
                    f"calibrator: {others} other publisher of {self._publisher.topic_name}; stop it, as the "
                    "voltage would jump between the commands of both"
                )
            )

    def _on_state(self, data: bytes) -> None:
        """Check a state; record it if a drive is on its way."""
        try:
            state = deserialize_message(data, JointState)
        except RuntimeError:
            return
        axes, stamp = self._settings.axes, state.header.stamp
        volts, metres = (dict(zip(state.name, values, strict=False)) for values in (state.effort, state.position))
        v, y = ([values.get(axis, math.nan) for axis in axes] for values in (volts, metres))
        stamp_ns = stamp.sec * SECOND_NS + stamp.nanosec
        if all(map(math.isfinite, v)) and all(abs(each) < FARTHEST for each in y):
            self._accept(v, y, stamp_ns, state.header.frame_id)
        if self._job is not None and not self._returning:
            self._write(self._job, self.get_clock().now().nanoseconds, data, f"/{STATE}")

    def _accept(self, v: Sequence[float], y: Sequence[float], stamp_ns: int, hardware_id: str) -> None:
        """Take note of a valid state: voltages `v` (V), displacements `y` (m)."""
        arrival_ns = self._drive_clock.now().nanoseconds
        ahead, waited = (stamp_ns - self._stamp_ns) * 1e-9, (arrival_ns - self._arrival_ns) * 1e-9
        # After a pause of the stage its stamps are as far ahead as the time that passed.
        if self._job is not None and self._count and not -JUMP < ahead < JUMP + waited:
            self._fail(RecordError(f"calibrator: the stamps of {STATE} jump by {ahead:.3g} s; set the clock, repeat"))
        self._stamp_ns, self._heard, self._count = stamp_ns, time.monotonic(), self._count + 1
        self._arrival_ns = arrival_ns
        self._hardware_id, self._reported = hardware_id, v
        for axis, voltage, limits in zip(self._settings.axes, v, self._settings.limits, strict=True):
            slack = READ_BACK * (limits.upper - limits.lower)
            if not limits.lower - slack <= voltage <= limits.upper + slack:
                self._fail(
                    RecordError(
                        f"calibrator: axis '{axis}' is at {voltage:g} V, outside {limits.lower:g} to "
                        f"{limits.upper:g} V; move it inside first"
                    )
                )
                return
        if self._voltages is None:
            self._voltages = [limits.clip(each) for limits, each in zip(self._settings.limits, v, strict=True)]
            self._goals = list(self._voltages)
        self._watch_for_frozen(v, y)

    def _watch_for_frozen(self, v: Sequence[float], y: Sequence[float]) -> None:
        for axis, voltage, reading, limits in zip(self._settings.axes, v, y, self._settings.limits, strict=True):
            last, count, low, high = self._still.get(axis, (math.nan, 0, voltage, voltage))
            if reading != last:
                self._still[axis] = reading, 0, voltage, voltage
                continue
            low, high, count = min(low, voltage), max(high, voltage), count + 1
            self._still[axis] = reading, count, low, high
            if self._job is not None and count >= FROZEN and high - low > FROZEN_MOVE * (limits.upper - limits.lower):
                self._fail(
                    RecordError(
                        f"calibrator: axis '{axis}' reads {reading:g} m for {count} states while the voltage moves by "
                        f"{high - low:.3g} V; check the sensor"
                    )
                )

    # Ends

    def _fail(self, failure: SlpiError) -> None:
        """Give up the calibration for the first reason, and return to rest."""
        if self._failure is None and self._outcome is None:
            self._failure = type(failure)(f"{failure}; {RESUME}") if self._driving else failure
            self._returning = self._driving

    def _at_rest(self) -> bool:
        return self._voltages is None or all(
            abs(v - rest) <= ARRIVED * (limits.upper - limits.lower)
            for v, rest, limits in zip(self._voltages, self._settings.rest, self._settings.limits, strict=True)
        )

    def _reports_rest(self) -> bool:
        """Return whether the last state that arrived is one at rest."""
        return all(
            abs(v - rest) <= READ_BACK * (limits.upper - limits.lower)
            for v, rest, limits in zip(self._reported, self._settings.rest, self._settings.limits, strict=True)
        )

    def _return_step(self) -> None:
        """Move towards rest by the time since the last step."""
        now = time.monotonic_ns()
        dt = min((now - self._guard_ns) * 1e-9, MOST_PERIODS / self._settings.rate)
        self._guard_ns = now
        for limiter, limits in zip(self._limiters, self._settings.limits, strict=True):
            # Without a slew limit the voltage would jump.
            limiter.limits = replace(limits, slew=min(limits.slew, MEAN_SPEED * (limits.upper - limits.lower)))
        self._move(self._settings.rest, dt)
        if self._at_rest():
            self._voltages = self._goals = list(self._settings.rest)
            for limiter, limits in zip(self._limiters, self._settings.limits, strict=True):
                limiter.limits = limits
                limiter.rest()

    def _finish(self) -> None:
        """Publish the model, print the last line and end with the exit code of the outcome."""
        outcome = self._outcome
        if isinstance(outcome, Outcome):
            self._models.publish(String(data=format_model(outcome.model)))
            self._models.wait_for_all_acked(DELIVERY)
            self.get_logger().info(f"{outcome.why}; {self._output / PAGE}")
            request_stop(None if outcome.met else SlpiError(f"calibrator: {outcome.why}; {self._output / PAGE}"))
        else:
            request_stop(outcome)

    def _report(self) -> None:
        progress = self._progress
        if self._failure is not None:
            self._diagnostics.report(Health(((WARN, str(self._failure)),), "", {}, self._hardware_id))
            return
        doing = "waiting for ~/start" if progress is None and not self._waiting else "waiting for the stage"
        state = "paused" if self._paused else "computing" if self._job is None else "driving"
        values: Mapping[str, object] = {"state": state if progress else "waiting"}
        if progress:
            doing = progress.doing
            values = {
                **values,
                "step": progress.step,
                "seconds_left": f"{progress.seconds_left:.1f}",
                "mean_error_um": "" if progress.error is None else f"{progress.error * 1e6:.5f}",
            }
        self._diagnostics.report(Health((), doing, values, self._hardware_id))

    # Services

    def _on_start(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        response.success = self._failure is None and self._outcome is None
        if self._paused:
            self._paused, response.message = False, "goes on"
        elif self._waiting or self._thread.is_alive():
            response.success, response.message = False, "already started"
        else:
            self._waiting, self._begun, response.message = True, time.monotonic(), "started"
        return response

    def _on_pause(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        self._paused, response.success, response.message = True, True, "the voltages are held until ~/start"
        return response

    def _on_stop(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        self._fail(Interrupted("calibrator: stopped by ~/stop"))
        response.success, response.message = True, "returning to rest"
        return response


def _prepare(output: Path, *, resume: bool) -> None:
    """Make the folder; move unfinished bags aside if the calibration is resumed, else require that it is empty."""
    make_folder(output)
    try:
        held = sorted(output.iterdir())
        if held and not resume:
            raise UsageError(f"{output}: not empty; choose another folder, or go on with resume:=true")
        for path in held:
            if path.is_dir() and path == partial_path(path.with_name(path.name[1:].removesuffix(".partial"))):
                path.rename(_free(path.with_name(f"killed_{path.name[1:].removesuffix('.partial')}")))
    except OSError as error:
        raise RecordError(f"{output}: {error.strerror}; choose another folder") from None


def _free(path: Path) -> Path:
    """Return the path, with a number behind it if it exists."""
    number, free = 1, path
    while free.exists():
        number, free = number + 1, path.with_name(f"{path.name}_{number}")
    return free


def main() -> int:
    """Run the node; return the exit code of the process: 0 target met, 1 not met or interrupted, 2 wrong usage."""
    if help_asked("calibrator", Calibrator, DECLARATIONS):
        return 0
    nodes: list[Calibrator] = []

    def make() -> Calibrator:
        nodes.append(Calibrator())
        return nodes[-1]

    code = run(make)
    if nodes and nodes[0].computing:
        # A computation cannot be interrupted between two of its reports; nothing of it is needed any more.
        with suppress(OSError):
            sys.stdout.flush()
            sys.stderr.flush()
        os._exit(code)
    return code


if __name__ == "__main__":
    sys.exit(main())
