"""What a compensator tells of itself: on ``/diagnostics``, and each problem once in the log."""

import math
import time
from collections.abc import Callable, Collection, Iterable, Iterator
from typing import NamedTuple

from rclpy.node import Node

from slpi_ros.compensator.axis import Axis
from slpi_ros.compensator.controller import Controller, OperatingMode
from slpi_ros.compensator.feedback import Drift
from slpi_ros.compensator.motion import Kind
from slpi_ros.compensator.persistence import KNOWN, RESETTING, RESTORED
from slpi_ros.compensator.statistics import COUNTED, Counts, Timing
from slpi_ros.compensator.validation import RejectedError
from slpi_ros.model.stage_model import StageModel, seconds_since
from slpi_ros.nodes.common import ERROR, WARN, Diagnostics, Health
from slpi_ros.nodes.company import Company
from slpi_ros.nodes.compensator_parameters import CompensatorSettings
from slpi_ros.nodes.path_learning import OFF, PathLearning

# Residuals are a constant if their mean is more than the first share of their rms, and have none below the second.
CONSTANT, NO_CONSTANT = 0.9, 0.3
# A sample of a trajectory that comes so much later than it should is told, seconds.
LATE = 0.01
# Shortest time between two log messages of what is counted, seconds; other problems are logged each time they appear.
LOG_PERIOD = 5.0
# What of the feedback a rule finds faulty, and what to do.
FAULTS = {
    "sensor": ("the sensor", "repair the sensor, then set feedback to true again"),
    "oscillation": ("the loop", "set lower gains (docs, feedback gains), or feedback to true again"),
    "loop": ("the loop", "set these gains"),
}
COUNTED_KINDS = ("messages", "trajectories", "measurements", "held", "late")


class Problem(NamedTuple):
    """A problem. The log holds one line of each `kind` when it appears; of none if that is ""."""

    kind: str
    level: bytes
    text: str


class Log:
    """Log each problem when it appears, and each remark once."""

    def __init__(self, node: Node) -> None:
        self._logger = node.get_logger()
        self._logged: dict[str, float] = {}  # time (s) of the last message, by kind
        self._present: Collection[str] = ()  # kinds of problems in the last report
        self._remarks: dict[str, str] = {}  # the last one, by kind

    def remark(self, kind: str, text: str) -> None:
        """Log a remark, unless the last one of its kind was the same; "": there is none any more."""
        if text and text != self._remarks.get(kind):
            self._logger.warning(text)
        self._remarks[kind] = text

    def tell(self, problems: Iterable[Problem]) -> None:
        """Log the problems that the last report did not hold."""
        now, present = time.monotonic(), {each.kind: each for each in problems if each.kind}
        for kind, (_, level, text) in present.items():
            since = now - self._logged.get(kind, -math.inf)
            if kind not in self._present and (since >= LOG_PERIOD or kind.partition(" ")[0] not in COUNTED_KINDS):
                # Not in one line: a call of the logger keeps its severity.
                if level == ERROR:
                    self._logger.error(text)
                else:
                    self._logger.warning(text)
                self._logged[kind] = now
        self._present = present.keys()


class Reporter:
    """Publish the diagnostics of the compensator, and log each problem when it appears."""

    def __init__(
        self,
        node: Node,
        controller: Controller,
        learning: PathLearning,
        company: Company,
        settings: Callable[[], CompensatorSettings],
    ) -> None:
        self.finalized = False  # the node has been shut down
        self.timing, self.lateness = Timing(), Timing()  # latency of messages; deadline error of trajectory points
        self.last_rejection = "", ""  # cause and reason
        self.model_error = self.model_id = ""  # reason; fingerprint
        self.quantities: dict[str, str] = {}  # what is wrong with a quantity that the stage follows
        self.age: float | None = None  # s, of the last answered command by its stamp; None: wanted
        self._out_of_reach = ""
        self.measured = 0  # messages with measured displacements
        self._disturbed = -math.inf  # the number of them when the computer was busy last
        self._controller, self._learning, self._company, self._settings = controller, learning, company, settings
        self.log, self._diagnostics = Log(node), Diagnostics(node, "compensator")
        self.start_window()

    @property
    def settings(self) -> CompensatorSettings:
        """Settings of the node in use."""
        return self._settings()

    def report(self) -> None:
        """Publish the diagnostics, and log what is new."""
        model, settings = self._controller.model, self.settings
        values = self._counters() | self._timing_values() | self._model_values(model)
        if self._learning.mode != OFF:
            values |= _learning_values(self._learning)
        if model:
            for axis in self._controller.axes:
                values |= _axis_values(axis, model.created)
                if axis.name in self._controller.trajectory.moving:
                    values[f"{axis.name}.motion"] = Kind.TRAJECTORY.value
                values[f"{axis.name}.start_voltage"] = self._controller.ownership.notes.get(axis.name, "")
            now_ns = time.monotonic_ns()
            for key, quantity in self._controller.surroundings.items():
                age = quantity.age_ns(now_ns)
                values[f"{key}.value"] = f"{quantity.value:.6g}" if age is not None else ""
                values[f"{key}.age_s"] = f"{age * 1e-9:.3f}" if age is not None else ""
        problems = list(self._problems(settings))
        self.log.tell(problems)
        hardware_id = settings.values["hardware_id"] or (model.hardware_id if model else "")
        told = tuple((each.level, each.text) for each in problems)
        self._diagnostics.report(Health(told, self._summary(), values, hardware_id))
        self.age = None

    def report_warning(self) -> None:
        """Publish the diagnostics now, unless the last report was one of a problem."""
        if self._diagnostics.level < WARN:
            self.report()

    def reject(self, error: RejectedError) -> None:
        """Report the rejection of a message, which the controller has counted already."""
        self.last_rejection = error.cause, str(error)
        self.report_warning()

    def start_window(self) -> None:
        """Start a new reporting period."""
        self._before, self._begun = self._counts().copy(), time.perf_counter()
        self._beyond_before = {axis.name for axis in self._controller.axes if axis.path.beyond}
        self.timing.restart()
        self.lateness.restart()

    def _counts(self) -> Counts:
        counts, trajectory = self._controller.counts, self._controller.trajectory
        counts["points_skipped"], counts["points_crowded"] = trajectory.skipped, trajectory.crowded
        return counts

    def _since(self, name: str) -> int:
        """Return what was counted since the last periodic report."""
        return self._counts()[name] - self._before[name]

    def note_out_of_reach(self) -> None:
        """Keep which displacements cannot be reached now, and what to do."""
        out, within = [], True
        for axis in self._controller.axes:
            if axis.held and axis.model and (desired := axis.tracking.desired) is not None:
                low, high = axis.model.displacement_range
                within &= low <= desired <= high
                out.append(f"axis {axis.name} at {desired * 1e6:.5g} of {low * 1e6:.5g} to {high * 1e6:.5g} µm")
        remedy = "send displacements within the identified range"
        if within:
            remedy = (
                "that is within the range: send a slower path, one further from its ends, or widen voltage_min and "
                "voltage_max if they are narrower than the model"
            )
        self._out_of_reach = f"desired displacement out of reach: {', '.join(out)}; {remedy}"

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

    def _late(self) -> tuple[str, bool]:
        """Return what a trajectory lost since the last periodic report, "" if nothing; whether by a busy computer."""
        trajectory, report = self._controller.trajectory, self.lateness.report()
        skipped, crowded = self._since("points_skipped"), self._since("points_crowded")
        points = "1 point" if skipped == 1 else f"{skipped} points"
        said = f"{points} of a trajectory skipped, as the next one was already due"
        if 2 * crowded > skipped:
            period = f"{trajectory.period * 1e3:.3g} ms"
            return (
                f"{said}: they are closer together than the output period of {period}; send points {period} apart",
                False,
            )
        latest = report.latency[2] if report else 0.0
        if not skipped and latest < LATE:
            return "", False
        late = f"trajectory up to {latest * 1e3:.3g} ms late"
        return (
            f"{f'{said}, ' if skipped else ''}{late}: the computer was busy; the path has an error there, end other "
            "programs, lower output_rate, or set realtime_priority"
        ), True

    def _counters(self) -> dict[str, object]:
        counts, stopped = self._counts(), self._controller.stopped
        return {
            "state": self._state,
            **{name: counts[name] for name in COUNTED},
            "last_rejection": self.last_rejection[1],
            "age_of_answered_ms": f"{self.age * 1e3:.3f}" if self.age is not None else "",
            "points_remaining": self._controller.trajectory.remaining,
            "stopped": stopped.value if stopped else "",
            "obstacle": self._controller.ownership.obstacle[0] if self._controller.ownership.obstacle else "",
            "memory": self._memory(),
        }

    def _timing_values(self) -> dict[str, object]:
        elapsed = max(time.perf_counter() - self._begun, 1e-3)
        values: dict[str, object] = {"rate_hz": f"{self._since('received') / elapsed:.1f}", "jitter_ms": ""}
        for name, timing in (("latency", self.timing), ("deadline_error", self.lateness)):
            report = timing.report()
            if name == "latency" and report:
                values["jitter_ms"] = f"{report.jitter * 1e3:.3f}"
            for place, part in enumerate(("p50", "p99", "max")):
                values[f"{name}_{part}_us"] = f"{report.latency[place] * 1e6:.0f}" if report else ""
        return values

    def _model_values(self, model: StageModel | None) -> dict[str, object]:
        kinds = [model.axis(axis.name).kind for axis in self._controller.axes] if model else []
        return {
            "model.id": self.model_id[:12] if model else "",
            "model.created": model.created if model else "",
            "model.age_h": _hours_since(model.created) if model else "",
            "model.hardware_id": model.hardware_id if model else "",
            "model.kind": ", ".join(kinds),
            "last_model_error": self.model_error,
        }

    def _problems(self, settings: CompensatorSettings) -> Iterator[Problem]:
        """Yield all problems: those that are present, and what was counted since the last periodic report."""
        controller, since = self._controller, self._since
        ready, active, (cause, reason) = controller.model is not None, controller.active, self.last_rejection
        if self.model_error:
            yield Problem("model", WARN if ready else ERROR, f"model refused: {self.model_error}")
        if active and not ready:
            yield Problem("", WARN, "waiting for a model")
        for what in ("messages", "trajectories", "measurements"):
            if count := since("rejected" if what == "messages" else f"{what}_rejected"):
                yield Problem(f"{what} {cause}", WARN, f"{count} {what} rejected, the last: {reason}")
        if held := since("held_at_limit"):
            yield Problem("held", WARN, f"{held} times held at a voltage limit: {self._out_of_reach}")
        if jumps := since("time_jumps"):
            yield Problem("", WARN, f"the clock of the stamps was set back {jumps} times")
        if points := since("points_held_at_limit"):
            said = f"{points} points of a trajectory held at a voltage limit: {self._out_of_reach}"
            yield Problem("held", WARN, said)
        late, busy = self._late()
        if late:
            yield Problem("late", WARN, late)
        self._disturbed = self.measured if busy else self._disturbed
        if lost := since("messages_lost"):
            yield Problem("", WARN, f"{lost} messages lost by the middleware; send fewer, or make its queue deeper")
        if ready and active:
            yield from self._ownership_problems()
        if others := ", ".join(self._company.newcomers):
            said = f"{others} also publishes voltage_command; stop it, or the voltage jumps between both"
            yield Problem("others", WARN, said)
        for key, said in self.quantities.items():
            yield Problem(key, WARN, said)
        if too_fast := controller.trajectory.too_fast:
            yield Problem("too fast", WARN, f"trajectory {too_fast}; send it more slowly, or raise slew_limit")
        if silence := self._silence():
            yield Problem("", WARN, silence)
        for axis in controller.axes if ready else ():
            beyond, moving = axis.path.beyond, since("accepted") > 0
            if beyond and axis.name not in self._beyond_before:
                advice = "errors may be larger than stated, record at that rate (slpi excite --for-path)"
                yield Problem(f"{axis.name} beyond", WARN, f"axis '{axis.name}': {beyond}; {advice}")
            alarm, since_busy = settings.values["drift_alarm"], self.measured - self._disturbed
            for kind, level, text in _axis_problems(axis, alarm, moving, since_busy):
                yield Problem(f"{axis.name} {kind}" if kind else "", level, f"axis '{axis.name}'{text}")
        for name, progress in self._learning.progress.items():
            if progress.held:
                text = f"axis '{name}': learning is {progress.limited_by}; call ~/forget"
                yield Problem(f"{name} learning", WARN, text)

    def _known(self) -> bool:
        """Return whether what keeps the compensator from its first voltage is known, so that it does not end soon."""
        ownership, now_ns = self._controller.ownership, time.monotonic_ns()
        listening = ownership.listening
        found_out = listening is not None and listening.looks(now_ns) and listening.check(now_ns) is not None
        return found_out or bool(ownership.identity.standing)

    def _ownership_problems(self) -> Iterator[Problem]:
        ownership = self._controller.ownership
        if ownership.obstacle:
            level, kind = (WARN, "not started" if self._known() else "") if ownership.armed else (ERROR, "not armed")
            yield Problem(kind, level, ownership.obstacle[1])
        elif not ownership.started:
            for name, note in ownership.notes.items():
                if note:
                    yield Problem("", WARN, f"axis '{name}': {note}")


def _axis_values(axis: Axis, created: str) -> dict[str, object]:
    drift, quality = axis.loop.drift, axis.model.quality if axis.model else None
    values = {
        "motion": axis.motion.kind.value,
        "voltage_V": f"{axis.voltage:.4f}",
        "memory": axis.confidence.state,
        "memory_doubt": axis.confidence.doubt,
        "beyond_record": axis.path.beyond,
        "covered": f"{quality.covered:.3f}" if quality else "",
        "held_out_rms_nm": f"{quality.held_out_rms * 1e9:.2f}" if quality else "",
        "feedback": axis.loop.state,
        "correction_V": f"{axis.loop.correction:.4f}",
        "reported_V": "" if axis.amplifier.latest is None else f"{axis.amplifier.latest:.4f}",
        "report_gain": f"{axis.amplifier.calibration.gain:.5g}",
        "report_offset_V": f"{axis.amplifier.calibration.offset:.4g}",
        "feedback_fault": axis.loop.fault.kind if axis.loop.fault else "",
        "residual_rms_nm": f"{drift.rms * 1e9:.2f}" if drift else "",
        "residual_mean_nm": f"{drift.mean * 1e9:.2f}" if drift else "",
        "zero_from": axis.zero.source,
        "zero_age_h": _hours_since(axis.zero.at or created),
        "zero_moved_nm": f"{axis.zero.offset * 1e9:.2f}",
    }
    return {f"{axis.name}.{key}": value for key, value in values.items()}


def _axis_problems(axis: Axis, factor: float, moving: bool, since_busy: float) -> Iterator[Problem]:
    """Yield the problems of an axis, `since_busy` measurements after the computer was; texts go on behind its name."""
    loop, drift, quality = axis.loop, axis.loop.drift, axis.model.quality if axis.model else None
    if moving and loop.state == "holding":
        yield Problem("", WARN, ": feedback holds, measurement too old")
    if loop.fault:
        subject, remedy_of = FAULTS[loop.fault.rule]
        fault = f"{subject} is {loop.fault.kind}: {loop.fault.reason}; the model goes on alone; {remedy_of}"
        yield Problem(loop.fault.rule, ERROR, f": feedback is off, {fault}")
    limits = axis.output.limits
    if axis.output.fastest < limits.slew and limits.mean_rate < math.inf:
        slowed = f"{axis.output.fastest:.4g} V/s at most, so that the mean stays within mean_rate_limit"
        yield Problem("mean rate", WARN, f": {slowed} {limits.mean_rate:g} V/s; send slower paths")
    if axis.amplifier.silent:
        yield Problem("", WARN, ": stage_state no longer reports its voltage (effort)")
    if moving and loop.state == "saturated":
        yield Problem("", WARN, f": the feedback is at correction_limit, {loop.correction:.4g} V")
    if axis.confidence.contradicted:
        yield Problem("", WARN, f": {axis.confidence.doubt}")
    # Before the end of a reset the model has another memory than the stage.
    if drift and quality and axis.confidence.state != RESETTING:
        usual = max(quality.held_out_rms, quality.floor_rms)
        if 0.0 < factor * usual < drift.rms:
            text = (
                f" is off its model by {drift.rms * 1e9:.1f} nm rms, mean {drift.mean * 1e9:.1f} nm, in "
                f"{drift.samples} measurements; held-out error {usual * 1e9:.1f} nm: {remedy(axis, drift, since_busy)}"
            )
            yield Problem("", WARN, text)


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


def remedy(axis: Axis, drift: Drift, since_busy: float = math.inf) -> str:
    """Return what to do about residuals, `since_busy` measurements after the computer was: nothing that is done."""
    if since_busy < drift.samples:
        return "the computer was busy meanwhile, and readings came late: look again when it is not"
    if axis.confidence.state not in (KNOWN, RESTORED):
        # What an assumed memory adds is no vibration.
        rest = NO_CONSTANT * drift.rms > abs(drift.mean)
        other = "; if that does not help, record it: slpi verify shows vibration and interference"
        return f"reset the memory (~/reset_memory){other if rest else ''}"
    if abs(drift.mean) > CONSTANT * drift.rms:
        return f"the zero, from the {axis.zero.source}, has moved; call ~/set_zero, or switch the feedback on"
    return "the stage has changed; record it and run slpi diagnose, or identify again"


def _hours_since(created: str) -> str:
    """Return the hours since an ISO 8601 time; "" if it is not valid."""
    age = seconds_since(created, time.time())
    return "" if age is None else f"{age / 3600:.2f}"
