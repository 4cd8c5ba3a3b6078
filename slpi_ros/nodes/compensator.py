"""Node ``compensator``: desired displacements in, voltages out."""

import sys
from collections.abc import Sequence
from time import monotonic_ns
from typing import Any

from rclpy.clock import Clock, ClockType
from rclpy.duration import Duration
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rclpy.qos import QoSProfile
from rclpy.qos_overriding_options import QoSOverridingOptions
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64, Float64MultiArray, String
from trajectory_msgs.msg import JointTrajectory

from slpi_ros.compensator.controller import Compensation
from slpi_ros.compensator.validation import RejectedError
from slpi_ros.errors import SlpiError
from slpi_ros.io.cdr import multiarray_header
from slpi_ros.io.messages import JointStates
from slpi_ros.nodes.common import (
    COMMANDS,
    LATCHED,
    MEASUREMENTS,
    WARN,
    as_rclpy_reads,
    ask_for_priority,
    refuse_impossible_transitions,
    run,
)
from slpi_ros.nodes.compensator_diagnostics import Reporter
from slpi_ros.nodes.compensator_driver import Driver
from slpi_ros.nodes.compensator_memory import MemoryKeeper
from slpi_ros.nodes.compensator_models import Models
from slpi_ros.nodes.compensator_parameters import DECLARATIONS, CompensatorSettings
from slpi_ros.nodes.compensator_reset import MemoryReset
from slpi_ros.nodes.compensator_silence import Silence
from slpi_ros.nodes.compensator_trajectory import TrajectoryFollower
from slpi_ros.nodes.parameters import Parameters

LOG_PERIOD = 5.0
# How often the node looks whether commands have stopped, seconds.
WATCH_PERIOD = 0.05
# History, depth and reliability, by parameters qos_overrides./TOPIC.{publisher,subscription}.POLICY.
OVERRIDABLE = QoSOverridingOptions.with_default_policies()
# How long an end waits until the last voltages have arrived.
PATIENCE = Duration(seconds=1.0)


class Compensator(LifecycleNode):
    """A lifecycle node that answers every desired message with the voltages of all its axes.

    Subscribes ``desired_displacement``, ``desired_trajectory``, ``measured_displacement`` and ``stage_model``,
    publishes ``voltage_command`` and ``/diagnostics``, serves ``~/reset_memory``; types, units and quality of service
    are in ``msg_schemas/README.md``, parameters in `compensator_parameters`.

    Raises
    ------
    UsageError
        If the parameters make no sense.
    ModelError
        If ``model_file`` holds no model for these axes and limits.
    """

    def __init__(self) -> None:
        super().__init__("compensator")
        refuse_impossible_transitions(self)
        self._parameter_set = Parameters(self, DECLARATIONS, CompensatorSettings.of)
        told = self._settings
        self._compensation = Compensation(told.axes, told.limits, told.hardware_id, told.time, told.loops)
        self._parameter_set.follow(self._use_settings, check=lambda new: self._compensation.check_limits(new.limits))
        self._desired, self._measured = JointStates(), JointStates()
        self._before_voltages = multiarray_header(len(told.axes))
        self._failure: SlpiError | None = None
        self._excursions = 0
        self._notes_voltages = told.memory_file != ""
        self._keeper = MemoryKeeper(self, self._compensation, told.memory_file)
        self._driver = Driver(self, self._compensation, self._publish, lambda: self._silence.given_ns)
        self._silence = Silence(self._compensation, self._driver, lambda: self._settings)
        self._reporter = Reporter(self, self._compensation, lambda: self._settings, self._silence)
        self._follower = TrajectoryFollower(self, self._compensation, self._publish_point, self._driver)
        self._reporter.lateness = self._follower.lateness
        self._reset = MemoryReset(
            self, self._compensation, self._driver, self._reporter, self._silence, lambda: self._settings
        )
        self._models = Models(self, self._compensation, self._keeper, self._reporter, lambda: self._settings)
        # A simulated clock may stand still.
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self.create_timer(told.diagnostic_period, self._on_period, clock=steady)
        self.create_timer(WATCH_PERIOD, self._watch, clock=steady)
        if told.realtime_priority:
            ask_for_priority(self, told.realtime_priority)
        self._starting = told.autostart
        if told.autostart:
            self.trigger_configure()
            if self._failure:
                raise self._failure
            self.trigger_activate()
            self._starting = False

    @property
    def executor_kind(self) -> str:
        """Which executor is to spin this node."""
        return self._settings.executor

    @property
    def _settings(self) -> CompensatorSettings:
        return self._parameter_set.settings

    def _use_settings(self, new: CompensatorSettings) -> None:
        self._compensation.use_limits(new.limits)
        self._compensation.use_loops(new.loops)
        self._compensation.use_time(new.time)

    # Lifecycle

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Load the model file, if there is one, and take part in the topics."""
        settings = self._settings
        try:
            if settings.model_file:
                self._models.load(settings.model_file)
        except SlpiError as error:
            self._failure = error
            # Where the refusal ends the process, its message is printed anyway.
            if not self._starting:
                self.get_logger().error(f"model refused: {error}")
            self._reporter.model_refused(str(error))
            return TransitionCallbackReturn.FAILURE
        self._publisher = self.create_lifecycle_publisher(
            Float64MultiArray, "voltage_command", COMMANDS, qos_overriding_options=OVERRIDABLE
        )
        on_desired: dict[str, tuple[Any, Any]] = {
            "JointState": (JointState, self._on_joint_state),
            "Float64": (Float64, self._on_value),
            "Float64MultiArray": (Float64MultiArray, self._on_values),
        }
        kind, callback = on_desired[settings.desired_type]
        self._subscriptions_of_state = [
            self._subscribe(kind, "desired_displacement", callback, COMMANDS, raw=kind is JointState),
            self._subscribe(JointTrajectory, "desired_trajectory", self._on_trajectory, COMMANDS, raw=True),
            self._subscribe(JointState, "measured_displacement", self._on_measured, MEASUREMENTS, raw=True),
            self._subscribe(String, "stage_model", self._models.on_message, LATCHED),
        ]
        self._reporter.enter("inactive")
        return super().on_configure(state)

    def _subscribe(self, kind: Any, topic: str, callback: Any, qos: QoSProfile, raw: bool = False) -> Any:
        return self.create_subscription(kind, topic, callback, qos, qos_overriding_options=OVERRIDABLE, raw=raw)

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Answer from now on, starting at the present voltages."""
        self._keeper.save(complete=False)
        self._compensation.activate(True)
        self._silence.begin()
        self._reporter.enter("active")
        return super().on_activate(state)

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Hold the present voltages, or go to the safe ones first."""
        self._end_activity()
        self._reporter.enter("inactive")
        return super().on_deactivate(state)

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Forget the model and leave the topics."""
        result = super().on_cleanup(state)
        self._compensation.forget_model()
        self._leave_topics()
        self._reporter.enter("unconfigured")
        return result

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Hold the present voltages for good, or go to the safe ones first."""
        self._end_activity()
        result = super().on_shutdown(state)
        if self._reporter.state != "unconfigured":
            self._leave_topics()
        self._reporter.enter("finalized")
        return result

    def destroy_node(self) -> None:
        """End the activity in order, and the node."""
        self._models.end()
        self._end_activity()
        super().destroy_node()

    def _end_activity(self) -> None:
        if not self._compensation.active:
            return
        self._driver.stop()
        self._follower.stop()
        safety = self._settings.safety
        if safety.ramps_on_deactivate and self._compensation.model:
            self._driver.ramp_now(safety.voltages, safety.rate)
        else:
            self._driver.stop_now()
        # The process may end next, and with it what has not arrived.
        self._publisher.wait_for_all_acked(PATIENCE)
        self._compensation.activate(False)
        self._keeper.save(complete=True)

    def _leave_topics(self) -> None:
        for subscription in self._subscriptions_of_state:
            self.destroy_subscription(subscription)
        self.destroy_lifecycle_publisher(self._publisher)

    # Desired and measured displacements

    def _on_joint_state(self, data: bytes) -> None:
        self._answer(*(self._desired.read(data) or as_rclpy_reads(data)))

    def _on_values(self, message: Float64MultiArray) -> None:
        self._answer(0, self._compensation.names, message.data)

    def _on_value(self, message: Float64) -> None:
        self._answer(0, self._compensation.names, (message.data,))

    def _on_measured(self, data: bytes) -> None:
        _, names, displacements = self._measured.read(data) or as_rclpy_reads(data)
        try:
            self._compensation.measure(names, displacements)
        except RejectedError as error:
            self._reporter.last_rejection = str(error)
            self.get_logger().warning(f"measurement rejected: {error}", throttle_duration_sec=LOG_PERIOD)
            self._reporter.report_at_least(WARN)

    def _answer(self, stamp_ns: int, names: Sequence[str], displacements: Sequence[float]) -> None:
        """Publish the voltages for one message, or count why not."""
        arrived = monotonic_ns()
        # Asking for the time takes as long as compensating an axis.
        now_ns = 0 if stamp_ns and not self._compensation.needs_arrival else self.get_clock().now().nanoseconds
        try:
            held = self._compensation.move(stamp_ns, names, displacements, now_ns)
        except RejectedError as error:
            self._reporter.last_rejection = str(error)
            self.get_logger().warning(f"rejected: {error}", throttle_duration_sec=LOG_PERIOD)
            self._reporter.report_at_least(WARN)
            return
        self._publish()
        answered = monotonic_ns()
        self._reporter.timing.note(arrived, answered)
        self._silence.given_ns = answered
        if held:
            self._on_held()

    def _on_trajectory(self, data: bytes) -> None:
        counts, following = self._compensation.counts, self._compensation.following
        counts.trajectories += 1
        try:
            self._follower.take(data)
        except SlpiError as error:
            counts.trajectories_rejected += 1
            self._reporter.last_rejection = str(error)
            self.get_logger().warning(f"trajectory rejected: {error}", throttle_duration_sec=LOG_PERIOD)
        else:
            self._silence.after_trajectory()
            self.get_logger().info(
                f"trajectory: {following.remaining} points to come; of the new ones {following.points_held} wait at a "
                f"voltage limit, {following.points_slewing} are slowed down by the slew limit"
            )
        self._reporter.report()

    def _publish_point(self) -> None:
        self._publish()
        self._silence.given_ns = monotonic_ns()
        if not self._compensation.following.on:
            self._reporter.report()

    def _publish(self) -> None:
        # As bytes: to make a message of them takes longer than to compensate an axis.
        voltages = self._compensation.voltages.tobytes()
        self._publisher.publish(self._before_voltages + voltages)
        if self._notes_voltages:
            self._keeper.note(voltages)

    def _on_held(self) -> None:
        """Warn, once for each excursion."""
        self._reporter.report_at_least(WARN)
        if self._compensation.counts.excursions > self._excursions:
            self._excursions = self._compensation.counts.excursions
            out = [axis.name for axis in self._compensation.axes if axis.held]
            self.get_logger().warning(
                f"desired displacement out of reach, held at a voltage limit: axis {', '.join(out)}; "
                "send displacements within the identified range"
            )

    # What happens without messages

    def _on_period(self) -> None:
        self._reporter.on_period()
        if self._compensation.active:
            self._keeper.save(complete=False)

    def _watch(self) -> None:
        if self._silence.watch():
            self._reporter.report()


def main() -> int:
    """Run the node; return the exit code of the process."""
    return run(Compensator)


if __name__ == "__main__":
    sys.exit(main())
