"""Node ``calibrator``: drives an unknown stage and carries out what `slpi_ros.calibration.run` decides."""

import math
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from std_msgs.msg import String

from slpi_ros.arrays import FloatArray
from slpi_ros.calibration.closed_loop import ClosedLoop
from slpi_ros.calibration.drive_monitor import FARTHEST
from slpi_ros.calibration.run import Progress
from slpi_ros.calibration.settings import CalibrationSettings
from slpi_ros.errors import RecordError, SlpiError, UsageError, length
from slpi_ros.io.atomic_file import make_folder
from slpi_ros.io.bag_writer import BagWriter
from slpi_ros.io.desired import read_path
from slpi_ros.io.messages import JointStateEncoder
from slpi_ros.io.stage_name import same_stage
from slpi_ros.io.unfinished_bags import set_aside, unused
from slpi_ros.model.limits import volts
from slpi_ros.nodes import parameters as declare
from slpi_ros.nodes.calibration_job import PATH, STATE, CalibrationJob, CalibrationOutcome, Wanted, stage_of_kept
from slpi_ros.nodes.common import LATCHED, WARN, Diagnostics, Health, request_stop, serve, steady_timer
from slpi_ros.nodes.guarded_drive import DELIVERY, GuardedDrive
from slpi_ros.nodes.parameters import Declaration, Parameters, Values, limits_of, validated
from slpi_ros.reports.calibration import PAGE

DECLARATIONS = declare.read_only(
    declare.AXES,
    *declare.voltage_limits(", of which drives use 80 %"),
    declare.ACCELERATION_LIMIT,
    declare.MEAN_RATE_LIMIT,
    declare.each_axis(
        "rest_voltage", math.nan, "Voltage before and after every drive, volts; NaN: 0 V, or the limit next to it.",
        declare.VOLTAGE,
    ),
    declare.scalar("rate", 200.0, "Samples per second, hertz.", (10.0, 10_000.0)),
    declare.scalar("budget", 240.0, "Time for all drives, seconds for each axis.", (1.0, 86_400.0)),
    declare.scalar(
        "target", 0.0, "Largest mean error on a path not in the records, micrometres; 0: times_repeatability.",
        (0.0, 1e6),
    ),
    declare.scalar(
        "times_repeatability", 3.0, "Target in multiples of the repeatability, if target is 0.", (0.1, 1e6)
    ),
    declare.path(
        "desired_path",
        "Table (time_s, AXIS_m) or bag with the path that the records must cover, and on which models are verified; at "
        "its rate, range and turns. Empty: random paths. Give a rate at which the path can be sampled.",
    ),
    declare.path("output", "Folder for bags, model, diagnosis and page; required."),
    Declaration("resume", False, "Whether to go on with the complete bags that output holds already."),
    Declaration(
        "accept_units", False,
        "Whether to go on where the stroke or the noise is none of a piezo stage, as of displacements in a wrong unit.",
    ),
    Declaration(
        "tune", False,
        "Whether to tune feedback at rate too, and show it on the stage by steps and a raster: gains.yaml in output.",
    ),
    Declaration("seed", 0, "Seed of the random parts of the drives.", between=(0, 2**31 - 1)),
    declare.STATE_TIMEOUT,
    declare.ACCEPT_STAGE,
    declare.scalar(
        "patience", 30.0,
        "Seconds to wait for stage_state, for a subscriber of voltage_command and for its other publishers to end.",
        (0.1, 3600.0),
    ),
    Declaration("autostart", True, "Whether to start at once; if false, ~/start starts."),
)  # fmt: skip

# Longest step of a drive (in periods of the rate) that follows a late sample.
MOST_PERIODS = 2.0
# Time for the last readings of a drive, or of a return to rest, to arrive; period of the held voltage between drives,
# of the diagnostics and of messages while it waits; longest wait for a state at rest; seconds.
TAIL, HOLD_PERIOD, REPORT_PERIOD, LOG_PERIOD, LATEST = 0.3, 0.1, 1.0, 5.0, 2.0
# A path may lose this share of its range when it is sampled.
MOST_LOST = 0.05
RESUME = "what was recorded is kept, go on with resume:=true"


class Interrupted(SlpiError):
    """The calibration was ended before its end: by a request, a signal or a fault."""


class _Job:
    """A drive on its way, and its bag in a folder: what is commanded at its present time, and the readings of it.

    `fail` is called with the reason if the bag cannot be written.
    """

    def __init__(
        self, wanted: Wanted, output: Path, axes: Sequence[str], fail: Callable[[SlpiError], None],
        loop: ClosedLoop | None,
    ) -> None:  # fmt: skip
        self.wanted, self._bag, self._fail = wanted, BagWriter(output / wanted.name, topic=f"/{STATE}"), fail
        self._encoder, self.loop = JointStateEncoder(axes, ""), loop
        if wanted.desired.size:
            self._bag.add_topic(PATH)
        self._at, self._tail = 0.0, TAIL  # time in the drive, and for the last readings to arrive; seconds

    def goals(self) -> list[float]:
        """Return the voltages (V) of the drive at its present time."""
        voltages = self._present(self.wanted.voltage)
        return (
            self.loop.goals(voltages, self._present(self.wanted.desired), time.monotonic_ns())
            if self.loop
            else voltages
        )

    def _present(self, columns: FloatArray) -> list[float]:
        return [float(np.interp(self._at, self.wanted.t, column)) for column in columns.T]

    def advance(self, dt: float) -> None:
        """Go on by a time (s)."""
        if self._at >= self.wanted.t[-1]:
            self._tail -= dt
        self._at += dt

    @property
    def done(self) -> bool:
        """Whether the drive and its last readings are over."""
        return self._tail <= 0.0

    def keep_desired(self, stamp: int, voltages: Sequence[float]) -> None:
        """Record the desired displacements at the present time, if there are any, with the voltages (V) sent then."""
        if self.wanted.desired.size:
            self.write(stamp, self._encoder.encode(stamp, self._present(self.wanted.desired), voltages), PATH)

    def write(self, stamp: int, message: bytes, topic: str) -> None:
        """Record a message."""
        try:
            self._bag.write(stamp, message, topic)
        except RecordError as error:
            self._fail(RecordError(f"{error}; its unfinished files are in {self._bag.partial}"))

    def close(self, *, interrupted: bool) -> None:
        """Complete the bag, and set it aside if the drive was interrupted; it fails if it is empty."""
        path = self._bag.path
        try:
            if not self._bag.message_count:
                self._bag.discard()
                raise RecordError(f"calibrator: no {STATE} during {self.wanted.name}")
            self._bag.close()
            if interrupted:
                path.rename(unused(path.with_name(f"interrupted_{path.name}")))
        except (OSError, RecordError) as error:
            self._fail(RecordError(str(error)))


def settings_of(values: Values) -> CalibrationSettings:
    """Return the settings of a calibration from the validated parameters of the node; UsageError if one is missing."""
    if not values["output"]:
        raise UsageError("calibrator: no output; name the folder with --ros-args -p output:=FOLDER")
    limits, axes = limits_of(values), tuple(values["axes"])
    return CalibrationSettings(
        axes,
        limits,
        rest=values["rest_voltage"] or tuple(each.clip(0.0) for each in limits),
        budget=values["budget"] * len(axes),
        target=values["target"] * 1e-6,
        path=_path_of(values["desired_path"], axes, values["rate"]) if values["desired_path"] else {},
        **{
            name: values[name]
            for name in ("rate", "times_repeatability", "accept_stage", "accept_units", "seed", "tune")
        },
    )


def _path_of(source: str, axes: tuple[str, ...], rate: float) -> dict[str, FloatArray]:
    """Return the desired displacements (m) of a path by axis, (N,), at a rate (Hz); UsageError if they are none."""
    t, columns = read_path(source, axes)
    if not t[-1] > 0.0:
        raise UsageError(f"desired_path: {source} lasts no time; give a path over time")
    even, path = np.arange(int(t[-1] * rate) + 1) / rate, {}
    for axis, y in columns.items():
        if axis not in axes:
            raise UsageError(f"desired_path: {source} holds axis '{axis}', the stage has {', '.join(axes)}; rename it")
        if (farthest := float(np.abs(y).max())) > FARTHEST:
            raise UsageError(f"desired_path: {source}: axis '{axis}' goes to {farthest:.4g} m; give metres")
        path[axis] = np.interp(even, t, y)
        lost = float(np.abs(np.interp(t, even, path[axis]) - y).max())
        if lost > MOST_LOST * float(np.ptp(y)):
            raise UsageError(
                f"desired_path: {source}: axis '{axis}' loses {length(lost)} at {rate:g} samples per second; "
                "raise the parameter rate, or give a smooth path"
            )
    return path


class Calibrator(Node):
    """Calibrate a stage by itself, and end with exit code 0 if the target is met, else 1.

    Subscribes to ``stage_state``; publishes ``voltage_command``, the model with its causes on ``stage_model``, and
    progress on ``/diagnostics``. Services ``~/start``, ``~/pause`` (holds the voltage until ``~/start``) and ``~/stop``
    (std_srvs/Trigger); parameters in `DECLARATIONS`. The folder ``output`` holds all bags, ``model.json``,
    ``report.html`` and the last diagnosis.

    Nothing is moved while stage_state is missing or another node publishes voltages. If stage_state reports what the
    voltages cannot have caused (`slpi_ros.calibration.drive_monitor`), another publisher appears or a bag cannot be
    written, the voltages return to rest within the limits. An interrupted drive is kept as ``interrupted_NAME``,
    that of a killed node is read as ``killed_NAME`` once the calibration was resumed.
    """

    def __init__(self) -> None:
        super().__init__("calibrator")
        values = validated(DECLARATIONS, Parameters(self, DECLARATIONS, dict[str, Any]).settings)
        self._settings = settings = settings_of(values)
        self._output, self._patience = Path(values["output"]).absolute(), values["patience"]
        _prepare(self._output, resume=values["resume"])
        self._kept_stage = stage_of_kept(self._output)
        self._guard = GuardedDrive(self, values, on_state=self._on_state)
        self._job: _Job | None = None
        self._worker: CalibrationJob | None = None
        self._failure: SlpiError | None = None
        self._outcome: CalibrationOutcome | None = None
        self._progress: Progress | None = None
        self._returning = self._paused = False
        self._begun = self._stepped = self._moved = time.monotonic()
        simulated = self.get_parameter("use_sim_time").value
        self._drive_clock = self.get_clock() if simulated else Clock(clock_type=ClockType.STEADY_TIME)
        self._step_ns = 0
        self._models = self.create_publisher(String, "stage_model", LATCHED)
        self._diagnostics = Diagnostics(self, "calibrator")
        for name, answer in (("start", self._on_start), ("pause", self._on_pause), ("stop", self._on_stop)):
            serve(self, f"~/{name}", answer)
        self._waiting = values["autostart"]
        period = 1.0 / settings.rate
        # A simulated clock drives a simulated stage; the watch goes on if it stops.
        self.create_timer(period, self._step, clock=self._drive_clock)
        steady_timer(self, period, self._watch)
        steady_timer(self, REPORT_PERIOD, self._report)

    def destroy_node(self) -> None:
        """Return to rest, keep what was recorded, then destroy the node; Interrupted if a signal ended the run."""
        ended = self._outcome is not None or self._failure is not None
        if self._worker is not None:
            self._worker.end()
        if self.context.ok() and self._guard.started:
            self._returning = True
            self._guard.return_to(self._settings.rest)
        left = f", at {volts(*self._guard.voltages)} V" if self._guard.started else "; nothing was moved"
        self._fail(Interrupted(f"calibrator: ended by a signal{left}"))
        self._end_job()
        super().destroy_node()
        if not ended and self._failure is not None:
            raise self._failure

    # The calibration, in its own process

    def _listen_to_worker(self) -> None:
        """Take what the worker says: progress, a drive that it wants, or the outcome."""
        worker = self._worker
        if worker is None or self._outcome is not None:
            return
        said = worker.outcome()
        if isinstance(said, Progress):
            self._progress = said
            if said.missing:
                told = "; ".join(finding.text for finding in said.missing)
                self.get_logger().warning(f"step {said.step}: {said.doing}: {told}")
                return
            error = "" if said.error is None else f", mean error {said.error * 1e6:.4f} µm"
            self.get_logger().info(f"step {said.step}: {said.doing}; {said.seconds_left:.0f} s of drives left{error}")
        elif isinstance(said, Wanted):
            settings, voltages = self._settings, self._guard.voltages
            of = settings.limits, settings.rate, voltages, settings.axes
            loop = ClosedLoop(said.loops, *of) if said.loops else None
            self._job = _Job(said, self._output, settings.axes, self._fail, loop)
            self._stepped = time.monotonic()
            self._guard.begin()
        else:
            self._outcome = said

    # Drives

    def _step(self) -> None:
        """Advance the drive by the time since the last step, at most `MOST_PERIODS` periods."""
        now = self._drive_clock.now().nanoseconds
        elapsed, self._step_ns = (now - self._step_ns) * 1e-9, now
        job = self._job
        if elapsed > 0.0:
            self._stepped = time.monotonic()
        if self._returning or job is None or elapsed <= 0.0:
            return
        if not self._paused:
            job.advance(min(elapsed, MOST_PERIODS / self._settings.rate))
        self._guard.move(job.goals())
        if self._paused:
            return
        job.keep_desired(self.get_clock().now().nanoseconds, self._guard.voltages)
        if job.done:
            self._end_job()

    @property
    def _drive_time(self) -> float:
        """Time of the stage, seconds."""
        return float(self._drive_clock.now().nanoseconds) * 1e-9

    def _end_job(self) -> None:
        """Complete the bag of the job, and tell the calibration."""
        job, self._job = self._job, None
        if job is None:
            return
        self._guard.end()
        job.close(interrupted=self._failure is not None)
        if self._failure is None and self._worker is not None:
            self._worker.recorded(job.loop.off if job.loop else "", self._drive_time)

    # What is watched

    def _watch(self) -> None:
        """Check the stage once a period, and step the return to rest, on a clock that does not stop."""
        now, rest = time.monotonic(), self._settings.rest
        self._guard.listen()
        fault = self._guard.fault() if self._job is not None or self._waiting else None
        if self._returning:
            if not self._guard.return_step(rest):
                self._moved = now
            # States of the return still arrive for a while, on a busy machine for longer.
            self._returning = not self._guard.settled(rest, self._moved, TAIL, LATEST)
        elif self._failure is not None:
            self._end_job()
            request_stop(self._failure)
        elif self._outcome is not None:
            self._finish(self._outcome)
        elif self._waiting:
            self._start_when_ready(now)
        elif self._job is None:
            self._listen_to_worker()
        elif now - self._stepped > self._patience:
            self._fail(RecordError(f"calibrator: time stands still for {self._patience:g} s; check /clock"))
        elif fault is not None:
            self._fail(fault)
        self._guard.hold(HOLD_PERIOD)

    def _start_when_ready(self, now: float) -> None:
        """Start once the stage reports and somebody takes the voltages; fail if that lasts too long."""
        # A publisher that was killed is known for some seconds more.
        lacking = self._guard.lacking()
        found = None if lacking else self._guard.found()
        overdue = self._guard.overdue()
        if found is not None:
            self._waiting = False
            try:
                self._require_stage()
                self._guard.start(found)
            except RecordError as error:
                self._fail(error)
                return
            self._returning, self._moved = True, now
            self._worker = CalibrationJob(self._settings, self._output, self._drive_time)
        elif overdue:
            self._fail(overdue)
        elif now - self._begun > self._patience:
            self._fail(self._guard.not_alone() or RecordError(f"calibrator: for {self._patience:g} s {lacking}"))
        elif now - self._begun > HOLD_PERIOD:
            self.get_logger().info(
                f"waiting, {self._patience:g} s at most: {lacking}", throttle_duration_sec=LOG_PERIOD
            )

    def _require_stage(self) -> None:
        """Raise RecordError if the kept bags are of another stage."""
        kept, present = self._kept_stage, self._guard.hardware_id
        if not same_stage(kept, present, self._settings.accept_stage):
            raise RecordError(
                f"calibrator: the bags in {self._output} are of stage '{kept}', stage_state of '{present}'; choose "
                "another output, or set accept_stage"
            )

    def _on_state(self, data: bytes, clock_ns: int, displacements: Sequence[float]) -> None:
        """Record a state if a drive is on its way."""
        if self._job is not None and not self._returning:
            self._job.write(clock_ns, data, f"/{STATE}")
            if self._job.loop and displacements:
                self._job.loop.measure(displacements, time.monotonic_ns())

    # Ends

    def _fail(self, failure: SlpiError) -> None:
        """Give up the calibration for the first reason, and return to rest."""
        if self._failure is None and self._outcome is None:
            driving = self._guard.started
            self._failure = type(failure)(f"{failure}; {RESUME}") if driving else failure
            self._returning, self._moved, self._waiting = driving, time.monotonic(), False
            if self._worker is not None:
                self._worker.end()
                self._worker = None

    def _finish(self, outcome: CalibrationOutcome) -> None:
        """Publish the model, print the last line and end with the exit code of the outcome."""
        if outcome.error:
            failure = UsageError(outcome.error) if outcome.exit_code == UsageError.exit_code else None
            request_stop(failure or SlpiError(f"{outcome.error}; {RESUME}"))
            return
        self._models.publish(String(data=outcome.document))
        self._models.wait_for_all_acked(DELIVERY)
        self.get_logger().info(f"{outcome.why}; {self._output / PAGE}")
        request_stop(None if outcome.met else SlpiError(f"calibrator: {outcome.why}; {self._output / PAGE}"))

    def _report(self) -> None:
        progress, hardware_id = self._progress, self._guard.hardware_id
        if self._failure is not None:
            self._diagnostics.report(Health(((WARN, str(self._failure)),), "", {}, hardware_id))
            return
        doing = "waiting for the stage" if self._waiting or self._worker is not None else "waiting for ~/start"
        values: Mapping[str, object] = {"state": "waiting"}
        if progress:
            doing = progress.doing
            values = {
                "state": "paused" if self._paused else "computing" if self._job is None else "driving",
                "step": progress.step,
                "seconds_left": f"{progress.seconds_left:.1f}",
                "mean_error_um": "" if progress.error is None else f"{progress.error * 1e6:.5f}",
            }
        self._diagnostics.report(Health((), doing, values, hardware_id))

    # Services

    def _on_start(self) -> tuple[bool, str]:
        begun, paused, self._paused = self._waiting or self._worker is not None, self._paused, False
        if begun and not paused:
            return False, "already started"
        if not begun:
            self._waiting, self._begun = True, time.monotonic()
        return self._failure is None and self._outcome is None, "goes on" if begun else "started"

    def _on_pause(self) -> tuple[bool, str]:
        self._paused = True
        return True, "the voltages are held until ~/start"

    def _on_stop(self) -> tuple[bool, str]:
        self._fail(Interrupted("calibrator: stopped by ~/stop"))
        return True, "returning to rest"


def _prepare(output: Path, *, resume: bool) -> None:
    """Make the folder; move unfinished bags aside if the calibration is resumed, else require that it is empty."""
    make_folder(output)
    try:
        if not resume and any(output.iterdir()):
            raise UsageError(f"{output}: not empty; choose another folder, or go on with resume:=true")
        set_aside(output, "killed_")
    except OSError as error:
        raise RecordError(f"{output}: {error.strerror}; choose another folder") from None
