"""Diagnostics of the compensator on ``/diagnostics``."""

import time
from collections.abc import Iterator

from rclpy.node import Node

from slpi_ros.compensator.axis import Axis
from slpi_ros.compensator.controller import Controller, OperatingMode
from slpi_ros.compensator.feedback import Drift
from slpi_ros.compensator.persistence import KNOWN, RESETTING, RESTORED
from slpi_ros.compensator.statistics import Timing, TimingReport
from slpi_ros.model.stage_model import StageModel, seconds_since
from slpi_ros.nodes.common import ERROR, WARN, Diagnostics, Health
from slpi_ros.nodes.compensator_parameters import CompensatorSettings
from slpi_ros.nodes.path_learning import OFF, PathLearning

Problem = tuple[bool, bytes, str]
# Residuals are a constant if their mean is more than the first share of their rms, and have none below the second.
CONSTANT, NO_CONSTANT = 0.9, 0.3
# A sample of a trajectory that comes so much later than it should is told, seconds.
LATE = 0.01


class Reporter:
    """Collect and publish the diagnostics of the compensator."""

    def __init__(self, node: Node, controller: Controller) -> None:
        self.finalized = False  # the node has been shut down
        self.timing, self.lateness = Timing(), Timing()  # latency of messages; deadline error of trajectory points
        self.last_rejection = self.model_error = self.model_id = ""  # reasons; fingerprint
        self.models_refused = 0
        self.lost = self.worked_off = self.largest_backlog = 0  # messages: by the middleware, of a backlog
        self.others: list[str] = []  # nodes that also publish the voltages
        self.surroundings: dict[str, str] = {}  # what is wrong with a quantity that the stage follows
        self.age: float | None = None  # s, of the last answered command by its stamp
        self._controller = controller
        self._diagnostics = Diagnostics(node, "compensator")
        self.start_window()

    @property
    def level(self) -> bytes:
        """Diagnostic level of the last report."""
        return self._diagnostics.level

    def report(self, settings: CompensatorSettings, learning: PathLearning) -> None:
        """Publish the diagnostics."""
        model = self._controller.model
        values = self._counters() | self._timing_values() | self._model_values(model)
        if learning.mode != OFF:
            values |= _learning_values(learning)
        if model:
            for axis in self._controller.axes:
                values |= _axis_values(axis, model.created)
                values[f"{axis.name}.start_voltage"] = self._controller.ownership.notes.get(axis.name, "")
            now_ns = time.monotonic_ns()
            for key, one in self._controller.surroundings.items():
                age = one.age_ns(now_ns)
                values[f"{key}.value"] = f"{one.value:.6g}" if age is not None else ""
                values[f"{key}.age_s"] = f"{age * 1e-9:.3f}" if age is not None else ""
        problems = tuple((level, text) for wrong, level, text in self._problems(settings) if wrong)
        for name, progress in learning.progress.items():
            if progress.held:
                problems = (*problems, (WARN, f"axis '{name}': learning is {progress.limited_by}"))
        hardware_id = settings.values["hardware_id"] or (model.hardware_id if model else "")
        self._diagnostics.report(Health(problems, self._summary(), values, hardware_id))

    def start_window(self) -> None:
        """Start a new reporting period."""
        self._window, self._window_start = self._controller.counts.copy(), time.perf_counter()
        self._lost_before = self.lost
        trajectory = self._controller.trajectory
        self._skipped_before, self._crowded_before = trajectory.skipped, trajectory.crowded
        self._beyond_before = {axis.name for axis in self._controller.axes if axis.path.beyond}
        self.timing.restart()
        self.lateness.restart()

    @property
    def _state(self) -> str:
        """Lifecycle state."""
        mode = self._controller.mode
        if self.finalized:
            return "finalized"
        return mode.value if mode in (OperatingMode.UNCONFIGURED, OperatingMode.INACTIVE) else "active"

    def _summary(self) -> str:
        controller = self._controller
        if not controller.active or self.finalized:
            return self._state
        activity = controller.activity(time.monotonic_ns())
        if controller.mode is OperatingMode.RESETTING:
            return activity
        if controller.model and controller.ownership.obstacle:
            return f"not moving: {controller.ownership.obstacle[1]}"
        axes = controller.axes
        doubts = [f" (axis '{axis.name}': {axis.confidence.doubt})" for axis in axes if axis.confidence.doubt]
        return f"{activity}; memory {self._memory()}{''.join(doubts)}"

    def _memory(self) -> str:
        return ", ".join(dict.fromkeys(axis.confidence.state for axis in self._controller.axes))

    def _silence(self) -> str:
        """Return the watchdog message; "" while commands arrive."""
        controller, watchdog = self._controller, self._controller.watchdog
        if not watchdog.expired or controller.mode not in (OperatingMode.STREAMING, OperatingMode.RAMPING):
            return ""
        reaction = "are held"
        if watchdog.safe_voltages:
            reaction = "go to the safe ones" if controller.mode is OperatingMode.RAMPING else "are the safe ones"
        yet = "" if watchdog.commanded else " yet"
        return f"no command{yet} for {watchdog.silence(time.monotonic_ns()):.3g} s; voltages {reaction}"

    def late(self) -> str:
        """Return what a trajectory lost since the last periodic report, and why; "" if nothing."""
        trajectory, report = self._controller.trajectory, self.lateness.report()
        skipped, crowded = trajectory.skipped - self._skipped_before, trajectory.crowded - self._crowded_before
        points = "1 point" if skipped == 1 else f"{skipped} points"
        said = f"{points} of a trajectory skipped, as the next one was already due"
        if 2 * crowded > skipped:
            period = f"{trajectory.period * 1e3:.3g} ms"
            return f"{said}: they are closer together than the output period of {period}; send points {period} apart"
        latest = report.latency[2] if report else 0.0
        if not skipped and latest < LATE:
            return ""
        late = f"trajectory up to {latest * 1e3:.3g} ms late"
        return (
            f"{f'{said}, ' if skipped else ''}{late}: the computer was busy; the path has an error there, end other "
            "programs, lower output_rate, or set realtime_priority"
        )

    def _counters(self) -> dict[str, object]:
        counts = self._controller.counts
        return {
            "state": self._state,
            "received": counts.received,
            "accepted": counts.accepted,
            "rejected": counts.rejected,
            **{f"rejected.{cause}": count for cause, count in counts.by_cause.items()},
            "measurements_rejected": counts.measurements_rejected,
            **{f"measurements_rejected.{cause}": count for cause, count in counts.measured_by_cause.items()},
            "last_rejection": self.last_rejection,
            "held_at_limit": counts.held_at_limit,
            "excursions": counts.excursions,
            "slew_limited": counts.slew_limited,
            "trajectories": counts.trajectories,
            "messages_lost": self.lost,
            "worked_off": self.worked_off,
            "largest_backlog": self.largest_backlog,
            "age_of_answered_ms": f"{self.age * 1e3:.3f}" if self.age is not None else "",
            "trajectories_rejected": counts.trajectories_rejected,
            "points_remaining": self._controller.trajectory.remaining,
            "points_skipped": self._controller.trajectory.skipped,
            "points_held_at_limit": counts.points_held,
            "points_slew_limited": counts.points_slewing,
            "gaps": counts.gaps,
            "time_jumps": counts.time_jumps,
            "memory": self._memory(),
        }

    def _timing_values(self) -> dict[str, object]:
        elapsed = max(time.perf_counter() - self._window_start, 1e-3)
        timing = self.timing.report()
        p50, p99, longest = _microseconds(timing)
        late_p50, late_p99, latest = _microseconds(self.lateness.report())
        return {
            "rate_hz": f"{(self._controller.counts.received - self._window.received) / elapsed:.1f}",
            "jitter_ms": f"{timing.jitter * 1e3:.3f}" if timing else "",
            "latency_p50_us": p50,
            "latency_p99_us": p99,
            "latency_max_us": longest,
            "deadline_error_p50_us": late_p50,
            "deadline_error_p99_us": late_p99,
            "deadline_error_max_us": latest,
        }

    def _model_values(self, model: StageModel | None) -> dict[str, object]:
        kinds = [model.axis(axis.name).kind for axis in self._controller.axes] if model else []
        return {
            "model.id": self.model_id[:12] if model else "",
            "model.created": model.created if model else "",
            "model.age_h": _hours_since(model.created) if model else "",
            "model.hardware_id": model.hardware_id if model else "",
            "model.kind": ", ".join(kinds),
            "models_refused": self.models_refused,
            "last_model_error": self.model_error,
        }

    def _problems(self, settings: CompensatorSettings) -> Iterator[Problem]:
        """Yield every possible problem, with whether it is present or was counted since the last periodic report."""
        counts, window = self._controller.counts, self._window
        ready, active = self._controller.model is not None, self._controller.active
        yield self.model_error != "", WARN if ready else ERROR, f"model refused: {self.model_error}"
        yield active and not ready, WARN, "waiting for a model"
        rejected = counts.rejected - window.rejected
        yield rejected > 0, WARN, f"{rejected} messages rejected, the last: {self.last_rejection}"
        refused = counts.trajectories_rejected - window.trajectories_rejected
        yield refused > 0, WARN, f"{refused} trajectories rejected, the last: {self.last_rejection}"
        unused = counts.measurements_rejected - window.measurements_rejected
        yield unused > 0, WARN, f"{unused} measurements rejected, the last: {self.last_rejection}"
        held = counts.held_at_limit - window.held_at_limit
        yield held > 0, WARN, f"{held} times held at a voltage limit"
        jumps = counts.time_jumps - window.time_jumps
        yield jumps > 0, WARN, f"the clock of the stamps was set back {jumps} times"
        points = counts.points_held - window.points_held
        yield points > 0, WARN, f"{points} points of a trajectory held at a voltage limit"
        late = self.late()
        yield late != "", WARN, late
        lost = self.lost - self._lost_before
        yield lost > 0, WARN, f"{lost} messages lost by the middleware; send fewer, or make its queue deeper"
        ownership = self._controller.ownership
        if ready and active:
            obstacle = ownership.obstacle
            yield obstacle is not None, WARN if ownership.armed else ERROR, obstacle[1] if obstacle else ""
            for name, note in ownership.notes.items():
                yield note != "" and obstacle is None and not ownership.started, WARN, f"axis '{name}': {note}"
        others = ", ".join(self.others)
        yield others != "", WARN, f"{others} also publishes voltage_command; stop it, or the voltage jumps between both"
        for said in self.surroundings.values():
            yield True, WARN, said
        yield self._controller.too_fast != "", WARN, f"trajectory {self._controller.too_fast}"
        silence = self._silence()
        yield silence != "", WARN, silence
        if ready:
            for axis in self._controller.axes:
                beyond = axis.path.beyond
                yield beyond != "" and axis.name not in self._beyond_before, WARN, f"axis '{axis.name}': {beyond}"
                yield from _axis_problems(axis, settings.values["drift_alarm"], counts.accepted > window.accepted)


def _microseconds(report: TimingReport | None) -> tuple[str, str, str]:
    """Format median, 99th percentile and maximum in microseconds."""
    p50, p99, longest = (f"{each * 1e6:.0f}" for each in report.latency) if report else ("", "", "")
    return p50, p99, longest


def _axis_values(axis: Axis, created: str) -> dict[str, object]:
    drift, quality = axis.drift, axis.model.quality if axis.model else None
    values = {
        "voltage_V": f"{axis.voltage:.4f}",
        "memory": axis.confidence.state,
        "memory_doubt": axis.confidence.doubt,
        "beyond_record": axis.path.beyond,
        "covered": f"{quality.covered:.3f}" if quality else "",
        "held_out_rms_nm": f"{quality.held_out_rms * 1e9:.2f}" if quality else "",
        "feedback": axis.feedback_state,
        "correction_V": f"{axis.correction:.4f}",
        "reported_V": "" if axis.amplifier.latest is None else f"{axis.amplifier.latest:.4f}",
        "report_gain": f"{axis.amplifier.calibration.gain:.5g}",
        "report_offset_V": f"{axis.amplifier.calibration.offset:.4g}",
        "feedback_fault": axis.fault.kind if axis.fault else "",
        "residual_rms_nm": f"{drift.rms * 1e9:.2f}" if drift else "",
        "residual_mean_nm": f"{drift.mean * 1e9:.2f}" if drift else "",
        "zero_from": axis.zero.source,
        "zero_age_h": _hours_since(axis.zero.at or created),
        "zero_moved_nm": f"{axis.zero.offset * 1e9:.2f}",
    }
    return {f"{axis.name}.{key}": value for key, value in values.items()}


def _axis_problems(axis: Axis, factor: float, moving: bool) -> Iterator[Problem]:
    yield moving and axis.feedback_state == "holding", WARN, f"axis '{axis.name}': feedback holds, measurement too old"
    if axis.fault:
        fault = f"feedback is off, the sensor is {axis.fault.kind}: {axis.fault.reason}; set feedback to true again"
        yield True, ERROR, f"axis '{axis.name}': {fault}"
    yield axis.amplifier.silent, WARN, f"axis '{axis.name}': stage_state no longer reports its voltage (effort)"
    saturated = f"axis '{axis.name}': the feedback is at correction_limit, {axis.correction:.4g} V"
    yield moving and axis.feedback_state == "saturated", WARN, saturated
    yield axis.confidence.contradicted, WARN, f"axis '{axis.name}': {axis.confidence.doubt}"
    drift, quality = axis.drift, axis.model.quality if axis.model else None
    # Before the end of a reset the model has another memory than the stage.
    if drift and quality and axis.confidence.state != RESETTING:
        usual = max(quality.held_out_rms, quality.floor_rms)
        text = (
            f"axis '{axis.name}' is off its model by {drift.rms * 1e9:.1f} nm rms, mean {drift.mean * 1e9:.1f} nm, in "
            f"{drift.samples} measurements; held-out error {usual * 1e9:.1f} nm: {remedy(axis, drift)}"
        )
        yield 0.0 < factor * usual < drift.rms, WARN, text


def _learning_values(learning: PathLearning) -> dict[str, object]:
    values: dict[str, object] = {"learn": learning.mode, "learn_dropped": learning.dropped}
    for name, one in learning.progress.items():
        values |= {
            f"{name}.learn_pass": one.passes,
            f"{name}.learn_error_nm": f"{one.error * 1e9:.2f}",
            f"{name}.learn_first_nm": f"{one.first * 1e9:.2f}",
            f"{name}.learn_best_nm": f"{one.best * 1e9:.2f}",
            f"{name}.learn_limited_by": one.limited_by,
            f"{name}.learn_reason": one.reason,
        }
    return values


def remedy(axis: Axis, drift: Drift) -> str:
    """Return what to do about residuals: what has been done already is not advised again."""
    if axis.confidence.state not in (KNOWN, RESTORED):
        # What an assumed memory adds is no vibration.
        rest = NO_CONSTANT * drift.rms > abs(drift.mean)
        other = "; if that does not help, record it: slpi verify tells vibration and interference"
        return f"reset the memory (~/reset_memory){other if rest else ''}"
    if abs(drift.mean) > CONSTANT * drift.rms:
        return f"the zero, from the {axis.zero.source}, has moved; call ~/set_zero, or switch the feedback on"
    return "the stage has changed; record it and run slpi diagnose, or identify again"


def _hours_since(created: str) -> str:
    """Return the hours since an ISO 8601 time; "" if it is not valid."""
    age = seconds_since(created, time.time())
    return "" if age is None else f"{age / 3600:.2f}"
