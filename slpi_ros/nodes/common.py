"""Start, spin and stop a node: functions shared by all executables."""

import ctypes
import importlib
import os
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import numpy as np
import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from lifecycle_msgs.srv import ChangeState
from rclpy.clock import Clock, ClockType
from rclpy.exceptions import NameValidationException, ParameterException
from rclpy.executors import Executor, ExternalShutdownException, SingleThreadedExecutor
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.lifecycle import LifecycleNode
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy, qos_profile_sensor_data
from rclpy.serialization import deserialize_message
from rclpy.signals import SignalHandlerOptions
from rclpy.timer import Timer
from rclpy.utilities import ok, try_shutdown
from sensor_msgs.msg import JointState
from std_srvs.srv import Trigger
from trajectory_msgs.msg import JointTrajectory

from slpi_ros.errors import RecordError, SlpiError, UsageError, shown
from slpi_ros.io.messages import SECOND_NS, TrajectoryArrays, decode_trajectory
from slpi_ros.nodes import stop
from slpi_ros.nodes.parameter_texts import remedy
from slpi_ros.nodes.stop import Stop

COMMANDS = QoSProfile(depth=100, reliability=ReliabilityPolicy.RELIABLE)
# Late subscribers receive the last message.
LATCHED = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL)
# Sensor data: only the newest message is relevant.
MEASUREMENTS = qos_profile_sensor_data
DIAGNOSTICS = QoSProfile(depth=10, reliability=ReliabilityPolicy.RELIABLE)
# A node whose topics the middleware has found, but not its name: as the middleware calls it, and as it is called here.
UNKNOWN, UNNAMED = "_NODE_NAME_UNKNOWN_", "a node of unknown name"
# Freed memory that a process keeps: several times the size of a trajectory of a million points. Options of malloc.h.
KEPT_BYTES, _M_TRIM_THRESHOLD, _M_MMAP_MAX = 2**29, -1, -4


def nanoseconds(time: Any) -> int:
    """Return a time or a duration of a message in ns."""
    return int(time.sec * SECOND_NS + time.nanosec)


def read_state(data: bytes) -> Any:
    """Return a serialized JointState; None if it is not valid."""
    with suppress(RuntimeError):
        return deserialize_message(data, JointState)
    return None


def as_rclpy_reads(data: bytes) -> tuple[int, Sequence[str], Sequence[float]]:
    """Return stamp (ns), names and positions of a serialized JointState; no names if it is not valid."""
    message = read_state(data) or JointState()
    return nanoseconds(message.header.stamp), message.name, message.position


def read_trajectory(data: bytes, field: str = "positions") -> TrajectoryArrays:
    """Return a serialised JointTrajectory with one `field` of its points.

    One that cannot be read names no axis, and one whose points have different lengths has no columns.
    """
    if arrays := decode_trajectory(data, field):
        return arrays
    try:
        message = deserialize_message(data, JointTrajectory)
    except RuntimeError:
        return TrajectoryArrays(0, (), np.zeros(1, np.int64), np.zeros((1, 0)))
    times = [nanoseconds(point.time_from_start) for point in message.points]
    rows = [list(getattr(point, field)) for point in message.points]
    values = np.array(rows, float) if len(set(map(len, rows))) == 1 else np.zeros((len(rows), 0))
    start_ns = nanoseconds(message.header.stamp)
    return TrajectoryArrays(start_ns, tuple(message.joint_names), np.array(times, np.int64), values)


class DeferredService:
    """Trigger service with a deferred response that does not block the executor."""

    def __init__(self, node: Node, name: str, start: Callable[[], str]) -> None:
        self._start = start  # starts the action; returns the reason if that is not possible, else ""
        self._waiting: list[Any] = []
        self._service = node.create_service(Trigger, name, self._on_request)
        # The executor sends the returned response; the request header is available only here.
        self._send = self._service.send_response
        self._service.send_response = self._send_or_keep

    def answer(self, success: bool, message: str) -> None:
        """Respond to all pending requests."""
        waiting, self._waiting = self._waiting, []
        for header in waiting:
            self._send(Trigger.Response(success=success, message=message), header)

    def _on_request(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        response.message = self._start()
        return response

    def _send_or_keep(self, response: Trigger.Response, header: Any) -> None:
        if response.message:
            self._send(response, header)
        else:
            self._waiting.append(header)


def serve(node: Node, name: str, act: Callable[[], tuple[bool, str]]) -> None:
    """Offer a Trigger service that answers what `act` returns: whether it succeeded, and a text."""

    def answer(_: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        response.success, response.message = act()
        return response

    node.create_service(Trigger, name, answer)


def refuse_impossible_transitions(node: LifecycleNode) -> None:
    """Refuse requests for a lifecycle transition that the present state does not allow."""
    # Otherwise rclpy ends the process, for instance after two calls of ``ros2 lifecycle set NODE configure``.
    for service in node.services:
        if service.srv_type is ChangeState:
            service.callback = partial(_change_state, node, service.callback)


def _change_state(node: LifecycleNode, change: Any, request: Any, response: Any) -> Any:
    try:
        return change(request, response)
    except RuntimeError as error:
        wanted = request.transition.label or request.transition.id
        node.get_logger().warning(f"no transition '{wanted}' from the present state: {error}")
        response.success = False
        return response


def steady_timer(node: Node, period: float, callback: Callable[[], None]) -> Timer:
    """Create a timer with a `period` (s) of a clock that neither stops, as a simulated one may, nor is set back."""
    # The events executor of rclpy 9 gives a TimerInfo to a callback that could take an argument.
    return node.create_timer(period, lambda: callback(), clock=Clock(clock_type=ClockType.STEADY_TIME))


def queued(subscription: Any, most: int) -> Iterator[Any]:
    """Yield the messages that wait for a subscription, at most so many."""
    for _ in range(most):
        with subscription.handle:
            taken = subscription.handle.take_message(subscription.msg_type, subscription.raw)
        if taken is None:
            return
        yield taken[0]


def reliability_of(publishers: Sequence[Any]) -> ReliabilityPolicy:
    """Return the reliability that all publishers of a topic offer."""
    reliable = all(each.qos_profile.reliability == ReliabilityPolicy.RELIABLE for each in publishers)
    return ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT


def full_name(namespace: str, name: str) -> str:
    """Return the full name of a node; the middleware knows the topics of a process before its names."""
    return UNNAMED if name == UNKNOWN else f"{namespace.rstrip('/')}/{name}"


def message_class(topic: str, msgtype: str) -> Any:
    """Return the class of a message type; RecordError, which names the topic, if it is not installed."""
    package, kind, name = msgtype.split("/")
    try:
        return getattr(importlib.import_module(f"{package}.{kind}"), name)
    except (ImportError, AttributeError) as error:
        raise RecordError(
            f"{topic} is {msgtype}, which is not installed; source its workspace or omit the topic"
        ) from error


def publishers_beside(node: Node, topic: str) -> list[str]:
    """Return the full names of the other nodes that publish a topic, given with its full name."""
    names = sorted(full_name(each.node_namespace, each.node_name) for each in node.get_publishers_info_by_topic(topic))
    with suppress(ValueError):
        names.remove(node.get_fully_qualified_name())
    return names


def ask_for_priority(node: Node, priority: int) -> None:
    """Run all threads of this process under SCHED_FIFO, including DDS; log a warning if not permitted. 0: normally."""
    try:
        for thread in Path("/proc/self/task").iterdir() if priority else ():
            os.sched_setscheduler(int(thread.name), os.SCHED_FIFO, os.sched_param(priority))
    except (OSError, AttributeError) as error:
        node.get_logger().warning(f"no realtime_priority {priority}: {error}; using normal scheduling")


def keep_freed_memory() -> None:
    """Let glibc's malloc keep up to `KEPT_BYTES` of freed memory for later use; without effect on other systems."""
    # Otherwise each large message is received in new memory pages, and the system takes longer to provide them than the
    # message takes to be copied and decoded.
    with suppress(OSError, AttributeError):
        allocator = ctypes.CDLL(None)
        allocator.mallopt(_M_TRIM_THRESHOLD, KEPT_BYTES)
        allocator.mallopt(_M_MMAP_MAX, 0)


OK: bytes = DiagnosticStatus.OK
WARN: bytes = DiagnosticStatus.WARN
ERROR: bytes = DiagnosticStatus.ERROR


@dataclass(frozen=True)
class Health:
    """Diagnostic status of a node."""

    problems: tuple[tuple[bytes, str], ...]  # (level, text), in any order
    summary: str  # the message if there are no problems
    values: Mapping[str, object]  # counters and states, shown as text
    hardware_id: str = ""

    @property
    def level(self) -> bytes:
        """Highest level of the problems."""
        return max((level for level, _ in self.problems), default=OK)

    @property
    def message(self) -> str:
        """All problems, the worst first, or the summary."""
        worst_first = sorted(self.problems, key=lambda problem: problem[0], reverse=True)
        return "; ".join(text for _, text in worst_first) or self.summary

    def status(self, name: str) -> DiagnosticStatus:
        """Return the message of this health under a name."""
        return DiagnosticStatus(
            level=self.level,
            name=name,
            message=shown(self.message),
            hardware_id=shown(self.hardware_id),
            values=[KeyValue(key=shown(key), value=shown(value)) for key, value in self.values.items()],
        )


class Diagnostics:
    """Publish one status on ``/diagnostics``, named after the node and its role."""

    def __init__(self, node: Node, role: str) -> None:
        self._node = node
        self._name = f"{node.get_fully_qualified_name()}: {role}"
        self._publisher = node.create_publisher(DiagnosticArray, "/diagnostics", DIAGNOSTICS)
        self.level = OK

    def report(self, health: Health) -> None:
        """Publish the diagnostic status and store its severity, OK, WARN or ERROR."""
        self.level = health.level
        array = DiagnosticArray(status=[health.status(self._name)])
        array.header.stamp = self._node.get_clock().now().to_msg()
        self._publisher.publish(array)


@runtime_checkable
class HasDeadlines(Protocol):
    """A node that has to act at certain times, which change often."""

    # A timer that is reset often does not serve: if the events executor is late, each reset lets it call every timer
    # that is due once more, which moves the next calls of all of them by a period each.
    def seconds_to_deadline(self) -> float:
        """Return the time (s) until the next call of `meet_deadline`; infinite if there is no deadline."""

    def meet_deadline(self) -> None:
        """Do what is due, if anything; called after each callback of the node, and at the deadline."""


# A signal is noticed between two calls of spin_once: this bounds the wait on an idle graph.
SPIN_TIMEOUT = 0.1

START_ERRORS = (
    NameValidationException,
    ParameterException,
    rclpy_implementation.RCLError,
    rclpy_implementation.UnknownROSArgsError,
)


_stop = Stop()


def request_stop(failure: SlpiError | None = None) -> None:
    """Stop the node that ``run`` is spinning, which prints the message of a `failure` and returns its exit code."""
    # For use in callbacks: an exception raised out of one would make the events executor print a traceback.
    _stop.requested = True
    _stop.failure = _stop.failure or failure


def make_executor(kind: str) -> Executor:
    """Return a new executor of the `kind` "events" (needs much less processor time) or "default", if rclpy lacks it."""
    # Call only its ``spin_once``, with a timeout: its ``spin`` may miss SIGINT and SIGTERM.
    if kind not in ("events", "default"):
        raise UsageError(f"no executor '{kind}'; choose events or default")
    if kind == "events":
        with suppress(ImportError):
            from rclpy.experimental.events_executor import EventsExecutor

            return EventsExecutor()
    return SingleThreadedExecutor()


def run(make_node: Callable[[], Node], *, executor: str = "events") -> int:
    """Create a node, spin it until a signal or ``request_stop``, shut it down cleanly; return the exit code."""
    # The ROS context stays valid until the node's ``destroy_node`` has returned, so that the node may still publish in
    # that method. A node with an attribute `executor_kind` chooses its executor itself.
    global _stop
    _stop = stop.of_process or stop.listening()
    try:
        # A signal may have arrived during the imports.
        if not _stop.requested:
            _live(make_node, executor)
    except (KeyboardInterrupt, ExternalShutdownException):
        return 0
    except SlpiError as error:
        print(error, file=sys.stderr, flush=True)
        return error.exit_code
    finally:
        # rclpy 9 destroys each node that is left: one that could not be made, and lacks what was not reached.
        with suppress(AttributeError):
            try_shutdown()
    return 0


def _live(make_node: Callable[[], Node], kind: str) -> None:
    """Create, spin and destroy the node; raise the error that stopped it, or UsageError if ROS cannot start it."""
    try:
        rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
        node = make_node()
    except START_ERRORS as error:
        said = f"the node cannot start: {' '.join(str(error).split())}"
        raise UsageError("; ".join(filter(None, [said, remedy(sys.argv, str(error))]))) from error
    try:
        executor = make_executor(getattr(node, "executor_kind", kind))
        executor.add_node(node)
        timed = node if isinstance(node, HasDeadlines) else None
        try:
            while ok() and not _stop.requested:
                timeout = SPIN_TIMEOUT if timed is None else min(timed.seconds_to_deadline(), SPIN_TIMEOUT)
                # A subscription may be destroyed while one of its events waits to be taken.
                with suppress(rclpy_implementation.InvalidHandle):
                    executor.spin_once(timeout_sec=timeout)
                if timed is not None:
                    timed.meet_deadline()
        finally:
            executor.remove_node(node)
            executor.shutdown()
    finally:
        try:
            node.destroy_node()
        except SlpiError as error:
            # The first failure takes precedence.
            request_stop(error)
    if _stop.failure is not None:
        raise _stop.failure
