"""Node ``compensator``: an adapter that decodes messages, calls the `Controller`, and publishes what it returns."""

import math
import time
from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from datetime import UTC, datetime
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticStatus
from numpy.typing import ArrayLike
from rclpy.clock import Clock, ClockType
from rclpy.duration import Duration
from rclpy.event_handler import SubscriptionEventCallbacks, UnsupportedEventTypeError
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rclpy.qos import QoSProfile
from rclpy.qos_overriding_options import QoSOverridingOptions
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64, Float64MultiArray, String
from std_srvs.srv import Trigger
from trajectory_msgs.msg import JointTrajectory

from slpi_ros.compensator.axis import Axis
from slpi_ros.compensator.controller import Controller, OperatingMode
from slpi_ros.compensator.ownership import AUTO
from slpi_ros.compensator.persistence import INTERRUPTED, KNOWN, RESTORED, MemoryFile, model_id
from slpi_ros.compensator.validation import STALE, RejectedError
from slpi_ros.errors import ModelError, SlpiError, shown
from slpi_ros.io.cdr import multiarray_header
from slpi_ros.io.messages import SECOND_NS, JointStates, decode_trajectory, encode_trajectory
from slpi_ros.model.document import load_model
from slpi_ros.model.limits import volts
from slpi_ros.model.stage_model import StageModel
from slpi_ros.nodes.common import (
    COMMANDS,
    DIAGNOSTICS,
    LATCHED,
    MEASUREMENTS,
    WARN,
    DeferredService,
    as_rclpy_reads,
    ask_for_priority,
    keep_freed_memory,
    publishers_beside,
    refuse_impossible_transitions,
)
from slpi_ros.nodes.compensator_diagnostics import Reporter
from slpi_ros.nodes.compensator_parameters import DECLARATIONS, CompensatorSettings
from slpi_ros.nodes.compensator_remarks import LOG_PERIOD, Remarks
from slpi_ros.nodes.jobs import Read, Reading
from slpi_ros.nodes.parameters import Parameters
from slpi_ros.nodes.path_learning import OFF, PathLearning
from slpi_ros.nodes.surroundings import SurroundingsTopics

# Minimum time between two log messages about files, seconds.
FILE_LOG_PERIOD = 60.0
# Period of the watchdog check, of `tracking_error` and of `displacement_uncertainty`, seconds.
WATCH_PERIOD = 0.05
# Polling period of a simulated clock, seconds.
SIMULATED_PERIOD = 1e-3
# History, depth and reliability, by parameters qos_overrides./TOPIC.{publisher,subscription}.POLICY.
OVERRIDABLE = QoSOverridingOptions.with_default_policies()
# A measurement whose stamp is older than this, or further in the future, does not count at the start.
OLDEST_NS, EARLIEST_NS = SECOND_NS // 5, SECOND_NS // 20
# While voltages are output, reports of the amplifiers are looked at once in this time.
REPORT_NS = SECOND_NS // 200
# Time between two looks for topics of quantities and their age.
SURROUNDINGS_NS = SECOND_NS // 2
# Time from the start of the node within which publishers of stage_state are discovered; polling period, seconds.
# The middleware repeats what a busy machine has missed of its discovery after 3 s.
DISCOVERY_NS, DISCOVERY_POLL = 7 * SECOND_NS // 2, 0.005
# Desired messages that are answered at once if they wait.
BACKLOG = 200
# Time to wait at shutdown for the delivery of the last voltages.
PATIENCE = Duration(seconds=1.0)


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
        refuse_impossible_transitions(self)
        self._parameter_set = Parameters(self, DECLARATIONS, CompensatorSettings.of)
        told = self._settings
        values = told.values
        self._controller = Controller(
            values["axes"], told.limits, values["hardware_id"], told.time, told.loops, told.period, told.starts
        )
        self._parameter_set.follow(self._use_settings, check=self._check_settings)
        learned_files = f"{values['memory_file']}.learned" if values["memory_file"] else ""
        self._learning = PathLearning(self._controller, learned_files, self._on_forgotten)
        self._use_learning(told)
        self._desired, self._measured = JointStates(), JointStates()
        self._voltage_header = multiarray_header(len(values["axes"]))
        self._failure: SlpiError | None = None
        self._assumption = ""
        self._memory_file = MemoryFile(values["memory_file"])
        self._memory_waits = False
        self._keeps_memory = values["memory_file"] != ""
        self._reporter = Reporter(self, self._controller)
        self._remarks = Remarks(self, self._controller, lambda: self._report_at_least(WARN))
        self._reset_service = DeferredService(self, "~/reset_memory", self._on_reset)
        self._forget_service = DeferredService(self, "~/forget", self._on_forget)
        self._learning_held: set[str] = set()
        self.create_service(Trigger, "~/arm", self._on_arm)
        self.create_service(Trigger, "~/set_zero", self._on_set_zero)
        self._uncertainty_unknown = ""
        # The age of one command for each report: reading the clock takes as long as compensating an axis.
        self._measures_age = True
        self._state_topic = self.resolve_topic_name("stage_state")
        self._state_subscription = self.create_subscription(
            JointState, "stage_state", self._on_state, MEASUREMENTS, raw=True
        )
        self._surroundings = SurroundingsTopics(self, self._controller, self._on_quantity)
        self._surroundings_told: dict[str, str] = {}
        self._surroundings_ns = 0
        self._begun_ns, self._reported_ns = time.monotonic_ns(), 0
        self._model_topic = self.resolve_topic_name("stage_model")
        self._model_reader = ThreadPoolExecutor(1, "stage_model")
        self._reading: Reading | None = None
        # The steady clock, as a simulated one may stop while the amplifier moves in real time.
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._on_simulated = False
        self.create_timer(values["diagnostic_period"], self._on_period, clock=steady)
        self.create_timer(WATCH_PERIOD, self._watch, clock=steady)
        if values["realtime_priority"]:
            ask_for_priority(self, values["realtime_priority"])
        self._starting = values["autostart"]
        if self._starting:
            self.trigger_configure()
            if self._failure:
                raise self._failure
            self.trigger_activate()
            self._starting = False

    @property
    def executor_kind(self) -> str:
        """Executor for this node, "events" or "default"."""
        return str(self._settings.values["executor"])

    @property
    def _settings(self) -> CompensatorSettings:
        return self._parameter_set.settings

    def _check_settings(self, new: CompensatorSettings) -> None:
        self._controller.check_limits(new.limits)

    def _use_settings(self, new: CompensatorSettings) -> None:
        self._controller.use_limits(new.limits, time.monotonic_ns(), new.period)
        self._controller.use_loops(new.loops)
        self._controller.use_time(new.time)
        self._use_learning(new)

    def _use_learning(self, settings: CompensatorSettings) -> None:
        values, limits = settings.values, settings.values["learn_limit"]
        most = dict(zip(values["axes"], limits, strict=True)) if limits else None
        self._learning.use(values["learn"], most, values["learn_period"])

    # Lifecycle

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Load the model file, if any, and create publisher and subscriptions."""
        path = self._settings.values["model_file"]
        try:
            if path:
                model = load_model(path)
                self._use_model(model, model_id(model), path)
        except SlpiError as error:
            self._failure = error
            # During autostart the error ends the process and is printed there.
            self._refuse_model(error, logged=not self._starting)
            return TransitionCallbackReturn.FAILURE
        if AUTO in self._settings.starts:
            self._wait_for_discovery()
        self._publisher = self.create_lifecycle_publisher(
            Float64MultiArray, "voltage_command", COMMANDS, qos_overriding_options=OVERRIDABLE
        )
        self._error_publisher = self.create_lifecycle_publisher(JointState, "tracking_error", DIAGNOSTICS)
        self._uncertainty_publisher = self.create_lifecycle_publisher(
            JointState, "displacement_uncertainty", DIAGNOSTICS
        )
        self._block_publisher = self.create_lifecycle_publisher(JointTrajectory, "voltage_trajectory", COMMANDS)
        on_desired: dict[str, tuple[Any, Any]] = {
            "JointState": (JointState, self._on_joint_state),
            "Float64": (Float64, self._on_value),
            "Float64MultiArray": (Float64MultiArray, self._on_values),
        }
        kind, callback = on_desired[self._settings.values["desired_type"]]
        self._subscriptions_of_state = [
            self._subscribe(kind, "desired_displacement", callback, COMMANDS, raw=kind is JointState),
            self._subscribe(JointTrajectory, "desired_trajectory", self._on_trajectory, COMMANDS, raw=True),
            self._subscribe(JointState, "measured_displacement", self._on_measured, MEASUREMENTS, raw=True),
            self._subscribe(String, "stage_model", self._on_model, LATCHED),
            self._subscribe(DiagnosticStatus, "voltage_trajectory_state", self._on_block_state, LATCHED),
            self._subscribe(JointTrajectory, "recorded_trajectory", self._on_recorded, COMMANDS, raw=True),
        ]
        self._controller.configure()
        self._report()
        return super().on_configure(state)

    def _subscribe(self, kind: Any, topic: str, callback: Any, qos: QoSProfile, raw: bool = False) -> Any:
        options: dict[str, Any] = {"qos_overriding_options": OVERRIDABLE, "raw": raw}
        try:
            lost = SubscriptionEventCallbacks(message_lost=self._on_lost)
            return self.create_subscription(kind, topic, callback, qos, event_callbacks=lost, **options)
        except UnsupportedEventTypeError:
            return self.create_subscription(kind, topic, callback, qos, **options)

    def _on_lost(self, event: Any) -> None:
        self._reporter.lost += event.total_count_change
        self._report_at_least(WARN)

    def _work_off(self) -> None:
        """Answer the desired messages that wait: after a stall the executor takes one for each that comes, no more."""
        subscription = self._subscriptions_of_state[0]
        count = 0
        while count < BACKLOG:
            with subscription.handle:
                taken = subscription.handle.take_message(subscription.msg_type, subscription.raw)
            if taken is None:
                break
            subscription.callback(taken[0])
            count += 1
        self._reporter.worked_off += count
        self._reporter.largest_backlog = max(self._reporter.largest_backlog, count)

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Start processing messages, from the present voltages."""
        self._save_memory(complete=False)
        self._controller.activate(time.monotonic_ns())
        self._locate()
        result = super().on_activate(state)
        self._begin_memory()
        self._report()
        return result

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Stop processing messages; hold the present voltages, or ramp to the safe voltages first if configured."""
        self._end_activity()
        self._report()
        return super().on_deactivate(state)

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Discard the model and destroy publisher and subscriptions."""
        result = super().on_cleanup(state)
        self._controller.cleanup()
        self._leave_topics()
        self._report()
        return result

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Deactivate as `on_deactivate` does, destroy publisher and subscriptions, and finalize."""
        self._end_activity()
        result = super().on_shutdown(state)
        if self._controller.mode is not OperatingMode.UNCONFIGURED:
            self._leave_topics()
        self._reporter.finalized = True
        self._report()
        return result

    def destroy_node(self) -> None:
        """Deactivate as `on_deactivate` does, then destroy the node."""
        self._stop_reading()
        self._end_activity()
        self._learning.close()
        super().destroy_node()

    def _end_activity(self) -> None:
        controller, safety, now_ns = self._controller, self._settings.safety, time.monotonic_ns()
        if not controller.active:
            return
        before = controller.mode
        if before is OperatingMode.BLOCK:
            self._stop_block()
            controller.hold(now_ns)
        if safety.ramps_on_deactivate and controller.ownership.owned:
            controller.ramp(safety.voltages, safety.rate, now_ns)
        else:
            controller.hold(now_ns)
        if before is OperatingMode.RESETTING:
            self._answer_reset()
        while controller.ramping and controller.ownership.owned and self.context.ok():
            time.sleep(self._settings.period)
            now_ns = time.monotonic_ns()
            if controller.advance(now_ns, now_ns):
                self._publish()
        # Voltages that have not been delivered are lost when the process ends.
        self._publisher.wait_for_all_acked(PATIENCE)
        controller.deactivate(time.monotonic_ns())
        self._save_memory(complete=True)

    def _leave_topics(self) -> None:
        for subscription in self._subscriptions_of_state:
            self.destroy_subscription(subscription)
        for publisher in (
            self._publisher, self._error_publisher, self._uncertainty_publisher, self._block_publisher
        ):  # fmt: skip
            self.destroy_lifecycle_publisher(publisher)

    # Desired and measured displacements

    def _on_joint_state(self, data: bytes) -> None:
        self._answer(*(self._desired.read(data) or as_rclpy_reads(data)))

    def _on_values(self, message: Float64MultiArray) -> None:
        self._answer(0, self._controller.names, message.data)

    def _on_value(self, message: Float64) -> None:
        self._answer(0, self._controller.names, (message.data,))

    def _answer(self, stamp_ns: int, names: Sequence[str], displacements: Sequence[float]) -> None:
        """Publish the voltages for one message, or report its rejection."""
        controller, now_ns = self._controller, time.monotonic_ns()
        # Reading the clock takes as long as compensating an axis.
        arrival_ns = 0 if stamp_ns and not controller.needs_arrival else self.get_clock().now().nanoseconds
        try:
            held = controller.update(stamp_ns, names, displacements, now_ns, arrival_ns)
        except RejectedError as error:
            self._reject("", error)
            return
        self._publish()
        if stamp_ns and self._measures_age:
            self._measures_age = False
            self._reporter.age = (self.get_clock().now().nanoseconds - stamp_ns) * 1e-9
        self._reporter.timing.note(now_ns, time.monotonic_ns())
        if held:
            self._remarks.tell_held()

    def _on_measured(self, data: bytes) -> None:
        stamp_ns, names, displacements = self._measured.read(data) or as_rclpy_reads(data)
        age_ns = self.get_clock().now().nanoseconds - stamp_ns if stamp_ns else 0
        fresh = -EARLIEST_NS <= age_ns <= OLDEST_NS
        if self._learning.passes.on and fresh:
            self._learning.passes.read(names, displacements, self._clocks()[1] - age_ns)
        try:
            self._controller.measure(names, displacements, time.monotonic_ns(), fresh)
        except RejectedError as error:
            self._reject("measurement ", error)

    def _on_state(self, data: bytes) -> None:
        """Take the voltages that the amplifiers report."""
        controller, now_ns = self._controller, time.monotonic_ns()
        if controller.ownership.started and now_ns - self._reported_ns < REPORT_NS:
            return
        self._reported_ns, before = now_ns, controller.mode
        try:
            state = deserialize_message(data, JointState)
        except RuntimeError:
            return
        if controller.report(state.name, state.effort, now_ns) and controller.ownership.obstacle:
            self.get_logger().error(f"nothing more is published: {controller.ownership.obstacle[1]}")
            if before is OperatingMode.RESETTING:
                self._answer_reset()
            self._report()

    def _on_quantity(self, key: str, value: float) -> None:
        self._controller.surround(key, value, time.monotonic_ns())

    def _watch_surroundings(self, now_ns: int) -> None:
        """Look for the topics of quantities, and log once what is wrong with one."""
        if now_ns - self._surroundings_ns < SURROUNDINGS_NS:
            return
        self._surroundings_ns = now_ns
        wanted = [topic for topic in self._settings.values["surroundings"] if topic]
        self._surroundings.update(wanted)
        told = {}
        for key, one in self._controller.surroundings.items():
            problem = self._surroundings.refused.get(key) or one.problem(now_ns)
            if problem:
                told[key] = problem
                if key not in self._surroundings_told:
                    self.get_logger().warning(problem)
        news = told.keys() != self._surroundings_told.keys()
        self._surroundings_told = self._reporter.surroundings = told
        if news:
            self._report()

    def _on_arm(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        """Go on from where somebody else has moved the stage."""
        controller = self._controller
        was_armed = controller.ownership.armed
        why = controller.arm(time.monotonic_ns())
        at = volts(*controller.voltages)
        response.success = not why
        response.message = why or (f"already armed, at {at} V" if was_armed else f"armed at {at} V")
        if not was_armed:
            self.get_logger().info(f"~/arm: {response.message}")
            self._remarks.tell_doubts()
            self._report()
        return response

    def _on_set_zero(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        """Let the zeros of the models agree with the sensors; nothing moves."""
        try:
            moved = self._controller.set_zero(time.monotonic_ns())
        except SlpiError as error:
            response.success, response.message = False, f"not set: {error}"
            return response
        said = [
            f"axis '{name}': the zero moves by {offset * 1e6:+.4f} µm"
            if offset is not None
            else f"axis '{name}': not set, no measured_displacement in the last 0.2 s; remap it to that of the sensor"
            for name, offset in moved.items()
        ]
        unsure = [axis.name for axis in self._controller.axes if axis.confidence.state not in (KNOWN, RESTORED)]
        if unsure:
            said.append(f"the memory of axis {', '.join(unsure)} is assumed: reset it, then set the zero again")
        response.success, response.message = None not in moved.values(), "; ".join(said)
        self.get_logger().info(f"~/set_zero: {response.message}")
        self._save_memory(complete=False)
        self._report()
        return response

    def _wait_for_discovery(self) -> None:
        """Wait until this node may know whether stage_state has a publisher: commands are not taken before that."""
        while not self._reports_expected and time.monotonic_ns() - self._begun_ns < DISCOVERY_NS and self.context.ok():
            time.sleep(DISCOVERY_POLL)

    @property
    def _reports_expected(self) -> bool:
        return bool(self.count_publishers(self._state_topic))

    def _locate(self) -> None:
        """Find the voltages at the start, until one has been output."""
        ownership = self._controller.ownership
        if not ownership.started:
            ownership.reporting = self._reports_expected
            self._controller.locate(time.monotonic_ns())
            self._remarks.tell_doubts()
        # A first message may have found the voltages before this.
        if self._memory_waits and not ownership.obstacle:
            self._begin_memory()
            self._report()

    def _on_trajectory(self, data: bytes) -> None:
        controller = self._controller
        stamp_ns, names, times, positions = _read_trajectory(data)
        now_ns, clock_ns = self._clocks()
        start_ns = stamp_ns + clock_ns - self.get_clock().now().nanoseconds if stamp_ns else 0
        if controller.mode is OperatingMode.BLOCK and not len(times):  # type: ignore[arg-type]
            self._stop_block()
            return
        if self._settings.values["trajectory_output"] == "block" and len(times):  # type: ignore[arg-type]
            self._send_block(names, times, positions, start_ns > clock_ns)
            return
        path, (names, times, positions) = self._learning.corrected(names, times, positions)
        try:
            controller.follow(names, times, positions, start_ns, now_ns, clock_ns)
        except RejectedError as error:
            self._reject("trajectory ", error)
            return
        self._learning.begin(path, start_ns, clock_ns)
        self._on_simulated = self._simulated
        self.get_logger().info(f"trajectory: {controller.trajectory.remaining} points to come")
        self._remarks.tell_too_fast(anew=True)
        self._report()

    def _send_block(self, names: Sequence[str], times: ArrayLike, positions: ArrayLike, later: bool) -> None:
        """Publish a trajectory as one block of voltages."""
        path, (names, times, positions) = self._learning.corrected(names, times, positions, as_block=True)
        try:
            if later:
                raise RejectedError(STALE, "a block begins as soon as the device has it; stamp the trajectory 0")
            stamp_ns = self.get_clock().now().nanoseconds
            block = self._controller.follow_block(names, times, positions, time.monotonic_ns(), stamp_ns)
        except RejectedError as error:
            self._reject("trajectory ", error)
            return
        self._learning.begin_block(path, block)
        none = np.zeros((len(block.voltages), 0))
        self._block_publisher.publish(encode_trajectory(stamp_ns, block.names, block.times_ns, none, block.voltages))
        self.get_logger().info(
            f"block: {len(block.voltages)} samples of {block.period:g} s, the path begins after {block.lead_in}"
        )
        self._remarks.tell_too_fast(anew=True)
        self._report()

    def _stop_block(self) -> None:
        """Ask the driver to hold where it is; it tells at which sample."""
        self._block_publisher.publish(JointTrajectory())

    def _on_block_state(self, status: DiagnosticStatus) -> None:
        values = {each.key: each.value for each in status.values}
        seconds, _, rest = values.get("stamp", "").partition(".")
        if not (seconds.isdecimal() and rest.isdecimal() and values.get("sample", "").isdecimal()):
            return
        stamp_ns, reason = int(seconds) * SECOND_NS + int(rest), values.get("reason", "")
        if self._controller.told(stamp_ns, status.message, int(values["sample"]), reason, time.monotonic_ns()):
            block = self._controller.block
            assert block
            said = f"block {shown(block.state)} at sample {block.sample}{': ' if reason else ''}{shown(reason)}"
            if block.state == "ended":
                self.get_logger().info(said)
            else:
                self.get_logger().warning(said)
            self._save_memory(complete=False)
            self._report()

    def _on_recorded(self, data: bytes) -> None:
        """Take what a device has recorded of a block."""
        if self._learning.mode == OFF:
            return
        read, applied = decode_trajectory(data), decode_trajectory(data, "effort")
        if read and applied:
            self._learning.passes.recorded(
                read.start_ns, read.names, read.time_from_start_ns, read.values, applied.values
            )

    def _tell_late(self) -> None:
        """Log that points of a trajectory were skipped, or late."""
        if late := self._reporter.late():
            self.get_logger().warning(late, throttle_duration_sec=LOG_PERIOD)

    def _reject(self, what: str, error: RejectedError) -> None:
        """Log and report the rejection of a message, which the controller has counted already."""
        self._reporter.last_rejection = str(error)
        self.get_logger().warning(f"{what}rejected: {error}", throttle_duration_sec=LOG_PERIOD)
        self._report_at_least(WARN)

    def _publish(self) -> None:
        # Published as bytes: creating a message object takes longer than compensating an axis.
        voltages = self._controller.voltages.tobytes()
        # Stored first: of a voltage that somebody has received, the next start knows, even after a SIGKILL in between.
        if self._keeps_memory:
            try:
                self._memory_file.note(voltages)
            except ModelError as error:
                self.get_logger().error(str(error), throttle_duration_sec=FILE_LOG_PERIOD)
        self._publisher.publish(self._voltage_header + voltages)

    # Motion without messages

    def _clocks(self) -> tuple[int, int]:
        """Return the times on the monotonic clock and on the trajectory clock, nanoseconds."""
        now_ns = time.monotonic_ns()
        return now_ns, self.get_clock().now().nanoseconds if self._simulated else now_ns

    @property
    def _simulated(self) -> bool:
        return bool(self.get_clock().ros_time_is_active)

    def seconds_to_deadline(self) -> float:
        """Return the time (s) until the next call of `meet_deadline`; infinite if no motion is pending."""
        # Without pending motion there is no deadline, whatever the time is.
        if self._controller.next_due_ns(0, 0) is None:
            return math.inf
        now_ns, clock_ns = self._clocks()
        due_ns = self._controller.next_due_ns(now_ns, clock_ns)
        seconds = max((due_ns or 0) - now_ns, 0) * 1e-9
        return min(seconds, SIMULATED_PERIOD) if self._simulated else seconds

    def meet_deadline(self) -> None:
        """Execute what is due of the motion without messages, if anything."""
        controller, before = self._controller, self._controller.mode
        if controller.next_due_ns(0, 0) is None:
            return
        now_ns, clock_ns = self._clocks()
        if before is OperatingMode.TRAJECTORY and self._on_simulated != self._simulated:
            controller.cancel(now_ns)
            self.get_logger().error("use_sim_time was changed: trajectory canceled, as its times are no longer valid")
        # One point per call, so that callbacks run even if points are due faster than they can be processed.
        deadline_ns = controller.trajectory.next_deadline_ns
        held = controller.counts.points_held
        if controller.advance(now_ns, clock_ns):
            self._publish()
            if self._learning.passes.on:
                self._learning.passes.output(controller.axes, clock_ns)
            if before is OperatingMode.TRAJECTORY and deadline_ns is not None and deadline_ns <= clock_ns:
                self._reporter.lateness.note(deadline_ns, clock_ns)
            if controller.counts.points_held > held or self._remarks.has_excursion:
                self._remarks.tell_held()
            if controller.too_fast:
                self._remarks.tell_too_fast()
        if controller.mode is not before:
            if before is OperatingMode.RESETTING:
                self._answer_reset()
            if before is OperatingMode.TRAJECTORY:
                self._tell_late()
            self._report()

    def _other_publishers(self) -> list[str]:
        """Return the other nodes that publish the voltages."""
        if self._controller.mode is OperatingMode.UNCONFIGURED:
            return []
        return publishers_beside(self, self._publisher.topic_name)

    def _on_period(self) -> None:
        self._reporter.others = self._other_publishers()
        self._report()
        self._tell_late()
        self._reporter.start_window()
        if self._controller.active:
            self._save_memory(complete=False)

    def _watch(self) -> None:
        controller, values, now_ns = self._controller, self._settings.values, time.monotonic_ns()
        self._watch_learning()
        if not controller.active:
            return
        self._work_off()
        self._watch_surroundings(now_ns)
        self._locate()
        self._remarks.tell_notes()
        self._remarks.tell_calibrations()
        self._remarks.tell_beyond()
        if why := controller.watch_block(now_ns):
            self.get_logger().error(f"block given up: {why}")
            self._report()
        if controller.watch(self._settings.safety, now_ns):
            self._report()
        for axis, fault in controller.watch_sensors(values["feedback_fault_time"], now_ns):
            self.get_logger().error(
                f"axis '{axis.name}': feedback is off, the sensor is {fault.kind}: {fault.reason}; the model goes on "
                "alone; repair the sensor, then set feedback to true again"
            )
            self._report()
        if values["rearm"] and controller.rearm(now_ns):
            self.get_logger().warning(f"rearmed at {volts(*controller.voltages)} V")
            self._report()
        self._publish_tracking_errors()
        self._publish_uncertainty(now_ns)

    def _publish_uncertainty(self, now_ns: int) -> None:
        """Publish where the axes are and how uncertain that is, if anybody listens; else it is not computed."""
        wanted = self._uncertainty_publisher.get_subscription_count() > 0
        controller, now = self._controller, datetime.now(UTC)
        why = controller.watch_uncertainty(wanted, now, now_ns)
        if why != self._uncertainty_unknown:
            self._uncertainty_unknown = why
            if why:
                self.get_logger().warning(f"displacement_uncertainty is not published: {why}")
        known = [(axis, spread) for axis in controller.axes if (spread := axis.uncertainty) is not None]
        if not wanted or why or not known:
            return
        message = JointState(name=[axis.name for axis, _ in known])
        message.position.extend(axis.expected for axis, _ in known)
        message.effort.extend(spread for _, spread in known)
        message.header.stamp = self.get_clock().now().to_msg()
        self._uncertainty_publisher.publish(message)

    def _watch_learning(self) -> None:
        """Take what was learned, and log once what keeps it from going on."""
        learning = self._learning
        if learning.mode == OFF and not learning.waiting:
            return
        learning.poll(self._clocks()[1])
        while learning.remarks:
            self.get_logger().warning(learning.remarks.popleft())
        held = {name for name, one in learning.progress.items() if one.held}
        for name in held - self._learning_held:
            self.get_logger().warning(f"axis '{name}': learning is {learning.progress[name].limited_by}; call ~/forget")
        self._learning_held = held

    def _on_forget(self) -> str:
        """Forget what was learned; answered when the files are removed."""
        self._learning.forget()
        return ""

    def _on_forgotten(self, count: int) -> None:
        self._forget_service.answer(True, f"forgotten: {count} {'path' if count == 1 else 'paths'}")
        self._report()

    def _publish_tracking_errors(self) -> None:
        """Publish the tracking errors of all axes if any axis was measured since the last call."""
        axes = self._controller.axes
        if not any(axis.tracking.fresh for axis in axes):
            return
        message = JointState()
        for axis in axes:
            report = axis.tracking.report()
            message.name += [axis.name, f"{axis.name}.mean", f"{axis.name}.rms", f"{axis.name}.maximum"]
            message.position.extend([report.latest, report.mean, report.rms, report.maximum])
        message.header.stamp = self.get_clock().now().to_msg()
        self._error_publisher.publish(message)

    def _report(self) -> None:
        self._measures_age = True
        self._reporter.report(self._settings, self._learning)

    def _report_at_least(self, level: bytes) -> None:
        """Publish the diagnostics now if the level of the last report was lower than `level`."""
        if self._reporter.level < level:
            self._report()

    # Models

    def _on_model(self, message: String) -> None:
        """Load the model of a message in the background; the previous model is used until then."""
        # Validating a document takes as long as processing many commands, so it runs in another thread. The validation
        # is canceled when a newer document arrives.
        self._stop_reading()
        try:
            self._reading = Reading(message.data, self._model_topic)
        except SlpiError as error:
            self._refuse_model(error)
            return
        self._model_reader.submit(self._reading.read).add_done_callback(self._on_model_read)

    def _stop_reading(self) -> None:
        if self._reading:
            self._reading.cancel()
            self._reading = None

    def _on_model_read(self, coming: Future[Read | None]) -> None:
        """Schedule `_take_model` in the thread of the executor."""
        if self.executor:
            self.executor.create_task(self._take_model, coming)

    def _take_model(self, coming: Future[Read | None]) -> None:
        if self._controller.mode is OperatingMode.UNCONFIGURED:
            return
        try:
            read = coming.result()
            if read:
                self._use_model(*read, self._model_topic)
        except SlpiError as error:
            self._refuse_model(error)

    def _refuse_model(self, error: SlpiError, logged: bool = True) -> None:
        if logged:
            self.get_logger().error(f"model refused: {error}")
        self._reporter.models_refused += 1
        self._reporter.model_error = str(error)
        self._report()

    def _use_model(self, model: StageModel, fingerprint: str, source: str) -> None:
        """Replace the model unless it is already in use: a latched document may arrive repeatedly."""
        controller, settings, reporter = self._controller, self._settings, self._reporter
        wanted = settings.values["model_sha256"]
        if wanted and fingerprint != wanted:
            raise ModelError(f"{source}: SHA-256 {fingerprint}, not {wanted} of model_sha256; give that model")
        if controller.model is None or fingerprint != reporter.model_id:
            try:
                saved, last = None, None
                if not controller.driven:
                    saved = self._memory_file.find(model, controller.names)
            except SlpiError as error:
                self.get_logger().warning(str(error))
                last = self._memory_file.last_voltages
            try:
                controller.use_model(model, saved, settings.values["start_memory"], last)
            except SlpiError as error:
                raise ModelError(f"{source}: {error}") from None
            self.get_logger().info(
                shown(f"using the model of {source}, identified {model.created or 'at an unknown time'}")
            )
            reporter.model_id = fingerprint
            self._learning.use_model(controller.identified)
            if controller.active:
                self._save_memory(complete=False)
                self._begin_memory()
        reporter.model_error = ""
        self._report()

    # The memory

    def _begin_memory(self) -> None:
        """Warn once about an assumed memory, or start a reset if `reset_on_start`; only when active with a model."""
        controller = self._controller
        unsure = [axis for axis in controller.axes if axis.confidence.state not in (KNOWN, RESTORED)]
        if controller.model is None or controller.mode is not OperatingMode.STREAMING or not unsure:
            return
        # As soon as the voltages are known.
        self._memory_waits = controller.ownership.obstacle is not None
        if self._memory_waits:
            return
        if self._settings.values["reset_on_start"]:
            self._start_reset()
            return
        said = "; ".join(f"axis '{axis.name}' {self._assumed(axis)}" for axis in unsure)
        if said != self._assumption:
            self._assumption = said
            self.get_logger().warning(
                f"the memory is assumed: {said}; call {self.get_fully_qualified_name()}/reset_memory (~/reset_memory) "
                "to reset it, or set reset_on_start"
            )

    def _assumed(self, axis: Axis) -> str:
        """Return a text that describes the assumed memory of an axis."""
        if axis.confidence.doubt or not axis.start_memory:
            return axis.confidence.doubt or "as before activation"
        where = {"end": "at the end of the record", "start": "at the start of the record", "wiped": "as after a reset"}
        text = (
            f"starts {where[axis.start_memory]}, at {volts(axis.stream.voltage)} V (start_memory {axis.start_memory})"
        )
        if axis.start_memory == "end" and axis.model and axis.model.end is None:
            text += "; the model holds no end, its start is used"
        return text

    def _start_reset(self) -> None:
        values, controller = self._settings.values, self._controller
        finals = values["safe_voltage"] if values["reset_to"] == "safe" else list(controller.voltages)
        spans = self._settings.reset_spans
        over = ", ".join(
            f"axis '{name}' {limits.lower:g} to {limits.upper:g} V"
            for name, limits in zip(controller.names, controller.reset_limits(spans), strict=True)
        )
        self.get_logger().warning(f"reset_memory moves the stage over its range: {over}; keep tip and sample apart")
        controller.reset_memory(values["reset_cycles"], values["reset_rate"], finals, time.monotonic_ns(), spans)
        self._report()

    def _on_reset(self) -> str:
        """Start a reset unless one is running; return the reason if this is not possible, else ""."""
        controller = self._controller
        if not controller.active or controller.model is None:
            return "not reset: a model is required, and the node must be active"
        if controller.mode is OperatingMode.TRAJECTORY:
            return f"not reset: {controller.activity(time.monotonic_ns())}; wait, or cancel it with an empty one"
        if controller.mode is not OperatingMode.RESETTING:
            try:
                self._start_reset()
            except RejectedError as error:
                return f"not reset: {error}"
        return ""

    def _answer_reset(self) -> None:
        """Send the response of the service ``~/reset_memory`` with the result of the reset."""
        axes, voltages = self._controller.axes, volts(*self._controller.voltages)
        doubts = [f"axis '{axis.name}': {axis.confidence.doubt}" for axis in axes if axis.confidence.state != KNOWN]
        if any(axis.confidence.doubt == INTERRUPTED for axis in axes):
            said = "interrupted; the memory is assumed"
        elif doubts:
            said = f"memory assumed; voltages {voltages} V; {'; '.join(doubts)}"
        else:
            said = f"memory known; voltages {voltages} V"
        if doubts:
            self.get_logger().warning(f"~/reset_memory: {said}")
        else:
            self.get_logger().info(f"~/reset_memory: {said}")
        self._reset_service.answer(not doubts, said)

    def _save_memory(self, complete: bool) -> None:
        """Save the memory, or log the error; `complete` means that no further voltage is output afterwards."""
        controller = self._controller
        if not self._keeps_memory or controller.model is None:
            return
        now_ns = time.monotonic_ns()
        axes = {axis.name: axis.saved(now_ns) for axis in controller.axes}
        try:
            self._memory_file.save(controller.identified, axes, complete)
        except SlpiError as error:
            self.get_logger().error(str(error), throttle_duration_sec=FILE_LOG_PERIOD)


def _read_trajectory(data: bytes) -> tuple[int, Sequence[str], ArrayLike, ArrayLike]:
    """Return stamp (ns), names, times (ns) and positions of a serialized JointTrajectory."""
    # An unreadable message gives no names; positions of different lengths are returned as such. Both are then rejected.
    if arrays := decode_trajectory(data):
        return arrays.start_ns, arrays.names, arrays.time_from_start_ns, arrays.values
    try:
        message = deserialize_message(data, JointTrajectory)
    except RuntimeError:
        return 0, (), [0], [[]]
    stamp, points = message.header.stamp, message.points
    times = [point.time_from_start.sec * SECOND_NS + point.time_from_start.nanosec for point in points]
    positions = [point.positions.tolist() for point in points]
    return stamp.sec * SECOND_NS + stamp.nanosec, message.joint_names, times, positions
