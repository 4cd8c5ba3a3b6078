"""Node ``compensator``: an adapter that decodes messages, calls the `Controller`, and publishes what it returns."""

import math
import time
from collections.abc import Sequence
from typing import Any

from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.event_handler import SubscriptionEventCallbacks, UnsupportedEventTypeError
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rclpy.qos import QoSProfile
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64, Float64MultiArray, String
from trajectory_msgs.msg import JointTrajectory

from slpi_ros.compensator.amplifier import REARM_NS, Calibration
from slpi_ros.compensator.controller import Controller, OperatingMode, StopReason
from slpi_ros.compensator.listening import all_found
from slpi_ros.compensator.ownership import AUTO
from slpi_ros.compensator.validation import RejectedError
from slpi_ros.errors import SlpiError
from slpi_ros.io.messages import SECOND_NS, JointStates
from slpi_ros.model.document import load_model
from slpi_ros.model.limits import volts
from slpi_ros.nodes.common import (
    COMMANDS,
    LATCHED,
    MEASUREMENTS,
    as_rclpy_reads,
    ask_for_priority,
    keep_freed_memory,
    queued,
    read_state,
    refuse_impossible_transitions,
    serve,
    steady_timer,
)
from slpi_ros.nodes.company import Company
from slpi_ros.nodes.compensator_diagnostics import Reporter
from slpi_ros.nodes.compensator_memory import Memory
from slpi_ros.nodes.compensator_models import Models
from slpi_ros.nodes.compensator_output import OVERRIDABLE, Output
from slpi_ros.nodes.compensator_parameters import DECLARATIONS, CompensatorSettings
from slpi_ros.nodes.compensator_paths import Paths
from slpi_ros.nodes.parameters import Parameters
from slpi_ros.nodes.path_learning import OFF, PathLearning
from slpi_ros.nodes.surroundings import SurroundingsTopics

# Period of what is watched, of `tracking_error` and of `displacement_uncertainty`, seconds.
WATCH_PERIOD = 0.05
# Polling period of a simulated clock, seconds.
SIMULATED_PERIOD = 1e-3
# A measurement whose stamp is older than this, or further in the future, does not count at the start.
OLDEST_NS, EARLIEST_NS = SECOND_NS // 5, SECOND_NS // 20
# While voltages are output, reports of the amplifiers are looked at once in this time.
REPORT_NS = SECOND_NS // 200
# Time between two looks for topics of quantities and their age.
LOOK_NS = SECOND_NS // 2
# Polling period while publishers of stage_state are discovered, seconds.
DISCOVERY_POLL = 0.005
# Shortest time between two log messages about measurements that come too late, seconds.
LATE_LOG_PERIOD = 60.0
# Desired messages that are answered at once if they wait.
BACKLOG = 200


class Compensator(LifecycleNode):
    """Lifecycle node that publishes the voltages of all axes for every message with desired displacements.

    Subscribes to ``desired_displacement``, ``desired_trajectory``, ``measured_displacement``, ``stage_state``,
    ``stage_model``, ``voltage_trajectory_state``, ``recorded_trajectory`` and the topics of the quantities that the
    stage follows, publishes ``voltage_command``, ``voltage_trajectory``, ``tracking_error``,
    ``displacement_uncertainty`` and ``/diagnostics``, provides the services ``~/reset_memory``, ``~/set_zero``,
    ``~/forget`` and ``~/arm``.
    Message types, units and QoS are documented in ``msg_schemas/README.md``, parameters in `compensator_parameters`.
    """

    def __init__(self) -> None:
        keep_freed_memory()
        super().__init__("compensator")
        # From now on the middleware finds others.
        self._begun_ns = time.monotonic_ns()
        refuse_impossible_transitions(self)
        self._parameter_set = Parameters(self, DECLARATIONS, CompensatorSettings.of)
        settings = self._settings
        values = settings.values
        self._controller = controller = Controller(
            values["axes"], settings.limits, values["hardware_id"], settings.time, settings.loops, settings.period,
            settings.starts, values["accept_stage"],
        )  # fmt: skip
        self._parameter_set.follow(self._use_settings, check=self._check_settings)
        learned_files = f"{values['memory_file']}.learned" if values["memory_file"] else ""
        self._learning = PathLearning(controller, learned_files, lambda count: self._paths.on_forgotten(count))
        self._use_learning(settings)
        self._company = Company(self, controller, self._begun_ns)
        self._reporter = Reporter(self, controller, self._learning, self._company, lambda: self._settings)
        self._memory = Memory(self, controller, values["memory_file"], self._reporter)
        self._paths = Paths(self, controller, self._learning, self._memory, self._reporter)
        self._models = Models(self, controller, self._memory, self._learning, self._reporter)
        self._surroundings = SurroundingsTopics(self, controller)
        self._desired, self._measured = JointStates(), JointStates()
        self._output: Output
        self._inputs: list[Any] = []  # subscriptions of the configured state, the desired displacements first
        serve(self, "~/arm", self._on_arm)
        self._state_subscription = self.create_subscription(
            JointState, "stage_state", self._on_state, MEASUREMENTS, raw=True
        )
        self._mode = controller.mode  # as told last
        self._reported_ns = self._looked_ns = 0
        # A simulated clock may stop while the amplifier moves in real time.
        steady_timer(self, values["diagnostic_period"], self._on_period)
        steady_timer(self, WATCH_PERIOD, self._watch)
        ask_for_priority(self, values["realtime_priority"])
        if values["autostart"]:
            # A model that is refused ends the process.
            self._models.load(values["model_file"])
            self.trigger_configure()
            self.trigger_activate()

    @property
    def executor_kind(self) -> str:
        """Executor for this node, "events" or "default"."""
        return str(self._settings.values["executor"])

    @property
    def _settings(self) -> CompensatorSettings:
        return self._parameter_set.settings

    def _check_settings(self, new: CompensatorSettings) -> None:
        file = new.values["model_file"]
        if file and file != self._settings.values["model_file"]:
            load_model(file)
        for axis, limits in zip(self._controller.axes, new.limits, strict=True):
            axis.check_limits(limits)
        for axis, loop in zip(self._controller.axes, new.loops, strict=True):
            axis.check_loop(loop, new.period)

    def _use_settings(self, new: CompensatorSettings) -> None:
        controller = self._controller
        controller.use_limits(new.limits, time.monotonic_ns(), new.period)
        if controller.mode is OperatingMode.BLOCK and controller.block and controller.block.beyond_limits:
            # What the device has not played yet was checked with other limits; from where it stops the voltage goes
            # inside.
            self.get_logger().warning("the block that the device plays is beyond the new limits: it is stopped")
            self._output.stop_block()
        for axis, loop in zip(controller.axes, new.loops, strict=True):
            axis.retune(loop)
        controller.messages.use(new.time)
        self._use_learning(new)

    def _use_learning(self, settings: CompensatorSettings) -> None:
        values, limits = settings.values, settings.values["learn_limit"]
        most = dict(zip(values["axes"], limits, strict=True)) if limits else None
        self._learning.use(values["learn"], most, values["learn_period"])

    # Lifecycle

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Load the model file, if any, and create publishers and subscriptions."""
        try:
            if self._controller.model is None:
                self._models.load(self._settings.values["model_file"])
        except SlpiError as error:
            self._models.refuse(error)
            return TransitionCallbackReturn.FAILURE
        self._company.listen()
        if AUTO in self._settings.starts:
            # Until this node may know whether stage_state has a publisher: commands are not taken before that.
            while not (self._is_reported or all_found(time.monotonic_ns(), self._begun_ns)) and self.context.ok():
                time.sleep(DISCOVERY_POLL)
        self._paths.output = self._output = Output(self, self._controller, self._memory, self._reporter, self._company)
        on_desired: dict[str, tuple[Any, Any]] = {
            "JointState": (JointState, self._on_joint_state),
            "Float64": (Float64, lambda message: self._answer(0, self._controller.names, (message.data,))),
            "Float64MultiArray": (
                Float64MultiArray, lambda message: self._answer(0, self._controller.names, message.data)
            ),
        }  # fmt: skip
        kind, callback = on_desired[self._settings.values["desired_type"]]
        self._inputs = [
            self._subscribe(kind, "desired_displacement", callback, COMMANDS, raw=kind is JointState),
            self._subscribe(JointTrajectory, "desired_trajectory", self._paths.on_trajectory, COMMANDS, raw=True),
            self._subscribe(JointState, "measured_displacement", self._on_measured, MEASUREMENTS, raw=True),
            self._subscribe(String, "stage_model", self._models.on_message, LATCHED),
            self._subscribe(DiagnosticStatus, "voltage_trajectory_state", self._paths.on_block_state, LATCHED),
            self._subscribe(JointTrajectory, "recorded_trajectory", self._paths.on_recorded, COMMANDS, raw=True),
        ]
        self._controller.configure()
        self._reporter.report()
        return super().on_configure(state)

    def _subscribe(self, kind: Any, topic: str, callback: Any, qos: QoSProfile, raw: bool = False) -> Any:
        options: dict[str, Any] = {"qos_overriding_options": OVERRIDABLE, "raw": raw}
        try:
            lost = SubscriptionEventCallbacks(message_lost=self._on_lost)
            return self.create_subscription(kind, topic, callback, qos, event_callbacks=lost, **options)
        except UnsupportedEventTypeError:
            return self.create_subscription(kind, topic, callback, qos, **options)

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Start processing messages, from the present voltages."""
        self._memory.save(complete=False)
        self._controller.activate(time.monotonic_ns())
        self._locate()
        result = super().on_activate(state)
        self._memory.begin()
        self._reporter.report()
        return result

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Stop processing messages; hold the present voltages, or ramp to the safe voltages first if configured."""
        self._end_activity()
        self._company.listen()
        self._reporter.report()
        return super().on_deactivate(state)

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Discard the model and destroy publishers and subscriptions."""
        result = super().on_cleanup(state)
        self._controller.cleanup()
        self._leave_topics()
        self._reporter.report()
        return result

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Deactivate as `on_deactivate` does, destroy publishers and subscriptions, and finalize."""
        self._end_activity()
        result = super().on_shutdown(state)
        if self._controller.mode is not OperatingMode.UNCONFIGURED:
            self._leave_topics()
        self._reporter.finalized = True
        self._reporter.report()
        return result

    def destroy_node(self) -> None:
        """Deactivate as `on_deactivate` does, then destroy the node."""
        self._models.stop_reading()
        self._end_activity()
        self._learning.close()
        super().destroy_node()

    def _end_activity(self) -> None:
        controller, safety, now_ns = self._controller, self._settings.safety, time.monotonic_ns()
        if not controller.active:
            return
        before = controller.mode
        if before is OperatingMode.BLOCK:
            self._output.stop_block()
        if before is OperatingMode.BLOCK or not (safety.ramps_on_deactivate and controller.ownership.owned):
            controller.stop(StopReason.DEACTIVATED, now_ns)
        if safety.ramps_on_deactivate and controller.ownership.owned:
            controller.ramp(safety.voltages, safety.rate, now_ns)
        self._note_mode()
        while controller.ramping and controller.ownership.owned and self.context.ok():
            time.sleep(self._settings.period)
            now_ns = time.monotonic_ns()
            if controller.advance(now_ns, now_ns):
                self._output.publish()
        self._output.wait()
        controller.deactivate(time.monotonic_ns())
        self._memory.poll()
        self._memory.save(complete=True)

    def _leave_topics(self) -> None:
        for subscription in self._inputs:
            self.destroy_subscription(subscription)
        self._output.destroy()
        self._company.close()

    # Desired and measured displacements

    def _on_joint_state(self, data: bytes) -> None:
        self._answer(*(self._desired.read(data) or as_rclpy_reads(data)))

    def _answer(self, stamp_ns: int, names: Sequence[str], displacements: Sequence[float]) -> None:
        """Publish the voltages for one message, or report its rejection."""
        controller, reporter, now_ns = self._controller, self._reporter, time.monotonic_ns()
        # Reading the clock takes as long as compensating an axis.
        arrival_ns = 0 if stamp_ns and not controller.messages.needs_arrival else self.get_clock().now().nanoseconds
        try:
            held = controller.update(stamp_ns, names, displacements, now_ns, arrival_ns)
        except RejectedError as error:
            self._reporter.reject(error)
            return
        self._output.publish()
        if stamp_ns and reporter.age is None:
            # Of one command for each report.
            reporter.age = (self.get_clock().now().nanoseconds - stamp_ns) * 1e-9
        reporter.timing.note(now_ns, time.monotonic_ns())
        if held:
            self._report_held()

    def _on_measured(self, data: bytes) -> None:
        stamp_ns, names, displacements = self._measured.read(data) or as_rclpy_reads(data)
        age_ns = self.get_clock().now().nanoseconds - stamp_ns if stamp_ns else 0
        fresh = -EARLIEST_NS <= age_ns <= OLDEST_NS
        self._reporter.measured += 1
        if self._learning.passes.on and fresh:
            self._learning.passes.read(names, displacements, self._paths.clocks()[1] - age_ns)
        try:
            self._controller.measure(names, displacements, time.monotonic_ns(), fresh, age_ns * 1e-9)
        except RejectedError as error:
            self._reporter.reject(error)

    def _remark_late(self) -> None:
        """Log of which axes the measurements come too late to be used."""
        late = [axis for axis in self._controller.axes if axis.loop.sensor.stale]
        if late:
            said = ", ".join(f"axis '{axis.name}' {axis.loop.sensor.stale:.2g} s" for axis in late)
            self.get_logger().warning(
                f"measured_displacement is older than measurement_timeout and not used: {said}; check delays and "
                "clocks, or set measurement_timeout",
                throttle_duration_sec=LATE_LOG_PERIOD,
            )

    def _report_held(self) -> None:
        self._reporter.note_out_of_reach()
        self._reporter.report_warning()

    def _on_lost(self, event: Any) -> None:
        self._controller.counts["messages_lost"] += event.total_count_change
        self._reporter.report_warning()

    def _work_off(self) -> None:
        """Answer the desired messages that wait: after a stall the executor takes one for each that comes, no more."""
        subscription, counts, count = self._inputs[0], self._controller.counts, 0
        for message in queued(subscription, BACKLOG):
            subscription.callback(message)
            count += 1
        counts["worked_off"] += count
        counts["largest_backlog"] = max(counts["largest_backlog"], count)

    # The amplifier

    @property
    def _is_reported(self) -> bool:
        """Whether stage_state has a publisher."""
        return bool(self.count_publishers(self._state_subscription.topic_name))

    def _on_state(self, data: bytes) -> None:
        """Take the voltages that the amplifiers report."""
        controller, now_ns = self._controller, time.monotonic_ns()
        # Of several publishers each has axes of its own: none of them hides another one.
        soon = now_ns - self._reported_ns < REPORT_NS and not self._company.several_report
        if controller.ownership.started and soon:
            return
        self._reported_ns = now_ns
        if (state := read_state(data)) is None:
            return
        self._company.heard(now_ns)
        if controller.report(state.name, state.effort, now_ns, state.header.frame_id):
            self._reporter.report()

    def _locate(self) -> None:
        """Find the voltages at the start, until one has been output."""
        ownership = self._controller.ownership
        if not ownership.started:
            ownership.reporting = self._is_reported
            self._controller.locate(time.monotonic_ns())
            self._remark_start()
        # A first message may have found the voltages before this.
        self._memory.poll()

    def _remark_start(self) -> None:
        """Log what is not certain about voltages and memory where the output begins."""
        ownership = self._controller.ownership
        for axis in self._controller.axes:
            if not ownership.obstacle and (note := ownership.notes.get(axis.name)):
                self._reporter.log.remark(f"{axis.name} start", f"axis '{axis.name}': {note}")
            doubt = axis.confidence.doubt
            self._reporter.log.remark(f"{axis.name} doubt", f"axis '{axis.name}': {doubt}" if doubt else "")

    def _on_arm(self) -> tuple[bool, str]:
        """Go on from where somebody else has moved the stage."""
        controller, was_armed = self._controller, self._controller.ownership.armed
        why = controller.arm(time.monotonic_ns())
        at = volts(*controller.voltages)
        said = why or (f"already armed, at {at} V" if was_armed else f"armed at {at} V")
        if not was_armed:
            self.get_logger().info(f"~/arm: {said}")
            self._remark_start()
            self._reporter.report()
        return not why, said

    # Motion without messages

    def seconds_to_deadline(self) -> float:
        """Return the time (s) until the next call of `meet_deadline`; infinite if no motion is pending."""
        # Without pending motion there is no deadline, whatever the time is.
        if self._controller.next_due_ns(0, 0) is None:
            return math.inf
        now_ns, clock_ns = self._paths.clocks()
        due_ns = self._controller.next_due_ns(now_ns, clock_ns)
        seconds = max((due_ns or 0) - now_ns, 0) * 1e-9
        return min(seconds, SIMULATED_PERIOD) if self._paths.simulated else seconds

    def meet_deadline(self) -> None:
        """Execute what is due of the motion without messages, if anything."""
        controller, reporter = self._controller, self._reporter
        if controller.next_due_ns(0, 0) is None:
            self._note_mode()
            return
        now_ns, clock_ns = self._paths.clocks()
        before = controller.mode
        self._paths.check_clock(now_ns)
        # One point per call, so that callbacks run even if points are due faster than they can be processed.
        deadline_ns, counts = controller.trajectory.next_deadline_ns, controller.counts
        held = counts["points_held_at_limit"], counts["excursions"]
        if controller.advance(now_ns, clock_ns):
            self._output.publish()
            if self._learning.passes.on:
                self._learning.passes.output(controller.axes, clock_ns)
            if before is OperatingMode.TRAJECTORY and deadline_ns is not None and deadline_ns <= clock_ns:
                reporter.lateness.note(deadline_ns, clock_ns)
            if (counts["points_held_at_limit"], counts["excursions"]) != held:
                self._report_held()
        self._note_mode()

    def _note_mode(self, news: bool = False) -> None:
        """Tell that the mode has changed, or other `news`; a reset that has ended, in whatever way, is answered."""
        mode, before = self._controller.mode, self._mode
        self._mode = mode
        if before is OperatingMode.RESETTING and mode is not before:
            self._memory.answer_reset()
        if news or mode is not before:
            self._reporter.report()

    def _on_period(self) -> None:
        self._reporter.report()
        self._reporter.start_window()
        if self._controller.active:
            self._memory.save(complete=False)

    def _watch(self) -> None:
        controller, reporter, values = self._controller, self._reporter, self._settings.values
        if self._learning.mode != OFF or self._learning.waiting:
            self._learning.poll(self._paths.clocks()[1])
        while self._learning.remarks:
            self.get_logger().warning(self._learning.remarks.popleft())
        if not controller.active:
            return
        self._work_off()
        now_ns = time.monotonic_ns()
        self._company.look(now_ns)
        self._output.repeat(now_ns)
        before = reporter.quantities.keys(), controller.trajectory.too_fast
        if now_ns - self._looked_ns >= LOOK_NS:
            self._looked_ns = now_ns
            self._surroundings.update([topic for topic in values["surroundings"] if topic])
            reporter.quantities = controller.surroundings.problems(self._surroundings.refused, now_ns)
            if all(axis.model for axis in controller.axes):
                reporter.log.remark("stage", controller.ownership.stage.doubt)
        self._locate()
        self._remark_late()
        reporter.log.remark("refused path", controller.trajectory.refused)
        for axis in controller.axes:
            found = axis.amplifier.calibration
            if found != Calibration():
                said = f"reports {found.gain:.4g} times the output {found.offset:+.4g} V (effort)"
                said = f"axis '{axis.name}': stage_state {said}: a matter of calibration, it is not followed"
                reporter.log.remark(f"{axis.name} calibration", said)
        news = controller.watch(self._settings.safety, values["feedback_fault_time"], now_ns)
        for finding in news:
            if finding.rule == "block":
                self.get_logger().error(f"block given up: {finding.reason}")
        if values["rearm"] and not controller.ownership.armed and not controller.arm(now_ns, REARM_NS):
            self.get_logger().warning(f"rearmed at {volts(*controller.voltages)} V")
        self._note_mode(bool(news) or (reporter.quantities.keys(), controller.trajectory.too_fast) != before)
        self._output.publish_tracking_errors()
        self._output.publish_uncertainty()
