"""Node ``compensator``: desired displacements in, voltages out."""

import sys
import time
from collections.abc import Sequence
from typing import Any

from rclpy.clock import Clock, ClockType
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64, Float64MultiArray, String

from slpi_ros.errors import ModelError, SlpiError
from slpi_ros.model import StageModel
from slpi_ros.model_file import format_model, load_model, parse_model
from slpi_ros.nodes.compensation import Compensation, RejectedError
from slpi_ros.nodes.compensator_settings import DECLARATIONS, CompensatorSettings
from slpi_ros.nodes.diagnostics import ERROR, WARN, Diagnostics, Health
from slpi_ros.nodes.lifecycle import refuse_impossible_transitions
from slpi_ros.nodes.parameters import Parameters
from slpi_ros.nodes.qos import COMMANDS, LATCHED
from slpi_ros.nodes.runner import run

SECOND_NS = 1_000_000_000
LOG_PERIOD = 5.0
# Nothing has driven the stage to a known state: its memory is taken to be where the model starts.
MEMORY_STATE = "assumed"


class Compensator(LifecycleNode):
    """A lifecycle node that answers every desired message with the voltages of all its axes.

    Subscribes ``desired_displacement`` and ``stage_model``, publishes ``voltage_command`` and ``/diagnostics``;
    types, units and quality of service are in ``msg_schemas/README.md``, parameters in `compensator_settings`.

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
        settings = self._settings
        self._compensation = Compensation(settings.axes, settings.limits)
        self._parameter_set.follow(
            lambda new: self._compensation.use_limits(new.limits),
            check=lambda new: self._compensation.check_limits(new.limits),
        )
        self._state = "unconfigured"
        self._failure: SlpiError | None = None
        self._starting = settings.autostart
        self._command = Float64MultiArray()
        self._start_reporting(settings.diagnostic_period)
        if settings.autostart:
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

    # Lifecycle

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Load the model file, if there is one, and take part in the topics."""
        settings = self._settings
        try:
            if settings.model_file:
                self._use_model(load_model(settings.model_file), settings.model_file)
        except SlpiError as error:
            self._failure = error
            self._refuse(error)
            return TransitionCallbackReturn.FAILURE
        self._publisher = self.create_lifecycle_publisher(Float64MultiArray, "voltage_command", COMMANDS)
        on_desired: dict[str, tuple[Any, Any]] = {
            "JointState": (JointState, self._on_joint_state),
            "Float64": (Float64, self._on_value),
            "Float64MultiArray": (Float64MultiArray, self._on_values),
        }
        kind, callback = on_desired[settings.desired_type]
        self._desired = self.create_subscription(kind, "desired_displacement", callback, COMMANDS)
        self._models = self.create_subscription(String, "stage_model", self._on_model, LATCHED)
        self._enter("inactive")
        return super().on_configure(state)

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Answer from now on, starting at the present voltages."""
        self._compensation.active = True
        self._last_accepted = time.monotonic()
        self._enter("active")
        return super().on_activate(state)

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Hold the present voltages."""
        self._compensation.active = False
        self._enter("inactive")
        return super().on_deactivate(state)

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Forget the model and leave the topics."""
        result = super().on_cleanup(state)
        self._compensation.forget_model()
        self._leave_topics()
        self._enter("unconfigured")
        return result

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Hold the present voltages for good."""
        result = super().on_shutdown(state)
        self._compensation.active = False
        if self._state != "unconfigured":
            self._leave_topics()
        self._enter("finalized")
        return result

    def _leave_topics(self) -> None:
        self.destroy_subscription(self._desired)
        self.destroy_subscription(self._models)
        self.destroy_lifecycle_publisher(self._publisher)

    def _enter(self, state: str) -> None:
        self._state = state
        self._report()

    # Desired displacements

    def _on_joint_state(self, message: JointState) -> None:
        stamp = message.header.stamp
        self._answer(stamp.sec * SECOND_NS + stamp.nanosec, message.name, message.position)

    def _on_values(self, message: Float64MultiArray) -> None:
        self._answer(0, self._compensation.axes, message.data)

    def _on_value(self, message: Float64) -> None:
        self._answer(0, self._compensation.axes, (message.data,))

    def _answer(self, stamp_ns: int, names: Sequence[str], displacements: Sequence[float]) -> None:
        """Publish the voltages for one message, or count why not; a message without a stamp counts from its arrival."""
        try:
            missed = self._compensation.move(stamp_ns or self.get_clock().now().nanoseconds, names, displacements)
        except RejectedError as error:
            self._last_rejection = str(error)
            self.get_logger().warning(f"rejected: {error}", throttle_duration_sec=LOG_PERIOD)
            self._report_at_least(WARN)
            return
        # Of an array, not of a list: the message copies it ten times faster.
        self._command.data = self._compensation.voltages
        self._publisher.publish(self._command)
        self._last_accepted = time.monotonic()
        if missed:
            self._report_at_least(WARN)

    # Models

    def _on_model(self, message: String) -> None:
        try:
            self._use_model(parse_model(message.data, self._models.topic_name), self._models.topic_name)
        except SlpiError as error:
            self._refuse(error)

    def _refuse(self, error: SlpiError) -> None:
        """Say that a model was refused; the one before works on."""
        self._models_refused += 1
        self._model_error = str(error)
        # Where the refusal ends the process, its message is printed anyway.
        if not self._starting:
            self.get_logger().error(f"model refused: {error}")
        self._report()

    def _use_model(self, model: StageModel, source: str) -> None:
        """Take a model over, unless it is the one in use: a latched document may come more than once."""
        former = self._compensation.model
        if former is None or format_model(model) != format_model(former):
            try:
                self._compensation.use_model(model)
            except SlpiError as error:
                raise ModelError(f"{source}: {error}") from None
            self.get_logger().info(f"using the model of {source}, identified {model.created or 'at an unknown time'}")
        self._model_error = ""
        self._report()

    # Health

    def _start_reporting(self, period: float) -> None:
        self._models_refused = 0
        self._model_error = ""
        self._last_rejection = ""
        self._last_accepted = time.monotonic()
        self._start_window()
        self._diagnostics = Diagnostics(self, "compensator")
        # A simulated clock may stand still.
        self.create_timer(period, self._on_period, clock=Clock(clock_type=ClockType.STEADY_TIME))

    def _start_window(self) -> None:
        self._window, self._window_start = self._compensation.counts.copy(), time.monotonic()

    def _on_period(self) -> None:
        self._report()
        self._start_window()

    def _report_at_least(self, level: bytes) -> None:
        """Report now if the last report was better than this."""
        if self._diagnostics.level < level:
            self._report()

    def _report(self) -> None:
        counts, model = self._compensation.counts, self._compensation.model
        elapsed = max(time.monotonic() - self._window_start, 1e-3)
        values = {
            "state": self._state,
            "received": counts.received,
            "accepted": counts.accepted,
            "rejected": counts.rejected,
            **{f"rejected.{cause}": count for cause, count in counts.by_cause.items()},
            "last_rejection": self._last_rejection,
            "held_at_limit": counts.held_at_limit,
            "rate_hz": f"{(counts.received - self._window.received) / elapsed:.1f}",
            "memory": MEMORY_STATE,
            "model.created": model.created if model else "",
            "model.hardware_id": model.hardware_id if model else "",
            "model.kind": ", ".join(model.axis(axis).kind for axis in self._settings.axes) if model else "",
            "models_refused": self._models_refused,
            "last_model_error": self._model_error,
        }
        hardware_id = self._settings.hardware_id or (model.hardware_id if model else "")
        summary = "compensating" if self._state == "active" else self._state
        self._diagnostics.report(Health(tuple(self._problems()), summary, values, hardware_id))

    def _problems(self) -> list[tuple[bytes, str]]:
        """Say what is wrong, or was since the last periodic report."""
        counts, window = self._compensation.counts, self._window
        ready, active = self._compensation.model is not None, self._state == "active"
        rejected, held = counts.rejected - window.rejected, counts.held_at_limit - window.held_at_limit
        silent, timeout = time.monotonic() - self._last_accepted, self._settings.command_timeout
        found = [
            (self._model_error != "", WARN if ready else ERROR, f"model refused: {self._model_error}"),
            (active and not ready, WARN, "waiting for a model"),
            (rejected > 0, WARN, f"{rejected} messages rejected, the last: {self._last_rejection}"),
            (held > 0, WARN, f"{held} times held at a voltage limit"),
            (active and 0 < timeout < silent, WARN, f"no command for {silent:.3g} s; voltages are held"),
        ]
        return [(level, text) for wrong, level, text in found if wrong]


def main() -> int:
    """Run the node; return the exit code of the process."""
    return run(Compensator)


if __name__ == "__main__":
    sys.exit(main())
