"""Start, spin and end one node: what every executable's ``main`` has in common."""

import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import rclpy
from rclpy.exceptions import NameValidationException, ParameterException
from rclpy.executors import Executor, ExternalShutdownException, SingleThreadedExecutor
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from rclpy.utilities import ok, try_shutdown

from slpi_ros.errors import SlpiError, UsageError

# A signal is noticed between two calls of spin_once: this bounds the wait on an idle graph.
SPIN_TIMEOUT = 0.1

# Ctrl-C often arrives twice (terminal and launcher), so only the third one may cut an orderly end short.
PATIENT_SIGNALS = 2

_START_ERRORS = (
    NameValidationException,
    ParameterException,
    rclpy_implementation.RCLError,
    rclpy_implementation.UnknownROSArgsError,
)


@dataclass
class _Stop:
    """Who asked the running node to end, and why."""

    requested: bool = False
    signals: int = 0
    failure: SlpiError | None = None

    def on_signal(self, *_: object) -> None:
        """Ask for an orderly end, of a node that is still being made too: it may hold messages already."""
        self.requested = True
        self.signals += 1
        if self.signals > PATIENT_SIGNALS:
            raise KeyboardInterrupt


_stop = _Stop()


def request_stop(failure: SlpiError | None = None) -> None:
    """End the node that ``run`` is spinning; for use in its callbacks.

    An exception that leaves a callback makes the events executor print a traceback; this does not.

    Parameters
    ----------
    failure : SlpiError, optional
        Why the node cannot go on: its message is printed and its exit code returned by ``run``.
    """
    _stop.requested = True
    _stop.failure = _stop.failure or failure


def make_executor(kind: str) -> Executor:
    """Return a new executor.

    Parameters
    ----------
    kind : {"events", "default"}
        The events executor is several times cheaper; where rclpy does not have it, it is the default one.

    Returns
    -------
    rclpy.executors.Executor
        To be driven by ``spin_once`` with a timeout only: its ``spin`` may miss signals.

    Raises
    ------
    UsageError
        If the kind is neither.
    """
    if kind not in ("events", "default"):
        raise UsageError(f"no executor '{kind}'; choose events or default")
    if kind == "events":
        try:
            from rclpy.experimental.events_executor import EventsExecutor
        except ImportError:
            return SingleThreadedExecutor()
        return EventsExecutor()
    return SingleThreadedExecutor()


def run(make_node: Callable[[], Node], *, executor: str = "events") -> int:
    """Create a node, spin it until a signal or ``request_stop``, and end it in order.

    The ROS context stays valid until the node's ``destroy_node`` has returned, so a node may still publish
    there.

    Parameters
    ----------
    make_node : callable
        Creates the node; a SlpiError raised in it ends the process with that error's line and exit code.
    executor : {"events", "default"}
        Which executor spins the node, unless the node's own `executor_kind` says so.

    Returns
    -------
    int
        Exit code of the process: 0 after a signal, a shutdown of ROS or a stop without failure.
    """
    global _stop
    _stop = _Stop()
    with _signals_to(_stop.on_signal):
        try:
            _live(make_node, executor)
        except (KeyboardInterrupt, ExternalShutdownException):
            return 0
        except SlpiError as error:
            print(error, file=sys.stderr, flush=True)
            return error.exit_code
        finally:
            try_shutdown()
    return 0


def _live(make_node: Callable[[], Node], kind: str) -> None:
    """Create, spin and destroy the node; raise what made it fail."""
    node = _start(make_node)
    try:
        executor = make_executor(getattr(node, "executor_kind", kind))
        executor.add_node(node)
        try:
            while ok() and not _stop.requested:
                executor.spin_once(timeout_sec=SPIN_TIMEOUT)
        finally:
            executor.remove_node(node)
            executor.shutdown()
    finally:
        try:
            node.destroy_node()
        except SlpiError as error:
            # what made the node stop comes first
            request_stop(error)
    if _stop.failure is not None:
        raise _stop.failure


def _start(make_node: Callable[[], Node]) -> Node:
    """Create the node; a command line or a parameter that ROS refuses becomes one line."""
    try:
        rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
        return make_node()
    except _START_ERRORS as error:
        raise UsageError(f"the node cannot start: {' '.join(str(error).split())}") from error


@contextmanager
def _signals_to(handler: Callable[..., None]) -> Iterator[None]:
    """Send SIGINT and SIGTERM to the handler."""
    # Python lets only the main thread do so; a node that a test runs in another thread goes without
    numbers = (signal.SIGINT, signal.SIGTERM) if threading.current_thread() is threading.main_thread() else ()
    previous = {number: signal.signal(number, handler) for number in numbers}
    try:
        yield
    finally:
        for number, old in previous.items():
            signal.signal(number, old)
