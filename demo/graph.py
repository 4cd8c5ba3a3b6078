"""The demo's side of the ROS graph: start nodes as processes, send samples in time, keep what comes back."""

import os
import signal
import subprocess
import threading
import time
from array import array
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from numpy.typing import NDArray
from rclpy.duration import Duration
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray
from std_srvs.srv import Trigger

FloatArray = NDArray[np.float64]
QOS = QoSProfile(depth=1000, reliability=ReliabilityPolicy.RELIABLE)
EXECUTABLES = (
    Path(__file__).resolve().parents[1] / os.environ.get("SLPI_INSTALL", "install") / "slpi_ros" / "lib" / "slpi_ros"
)


@contextmanager
def executable(
    name: str, *remaps: str, log: str = "warn", listen: bool = False, **parameters: str | float | bool
) -> Iterator[subprocess.Popen[bytes]]:
    """Run one of the package's nodes until the block ends; it gets the time to finish its work.

    With `listen` its log is at ``stderr`` of the process, to be read to the end.
    """
    command = [str(EXECUTABLES / name), "--ros-args", "--log-level", log]
    for remap in remaps:
        command += ["-r", remap]
    for key, value in parameters.items():
        command += ["-p", f"{key}:={value}"]
    process = subprocess.Popen(command, start_new_session=True, stderr=subprocess.PIPE if listen else None)
    try:
        yield process
    finally:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGINT)
        try:
            process.wait(timeout=20)
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()


class Operator(Node):
    """Publishes voltages or desired displacements at a steady rate and keeps the answers of the stage."""

    def __init__(self) -> None:
        super().__init__("operator")
        self.voltage = self.create_publisher(Float64MultiArray, "voltage_command", QOS)
        self.desired = self.create_publisher(JointState, "desired_displacement", QOS)
        self._answers: list[tuple[float, float]] = []  # V and m, since the last message
        self.late: list[int] = []  # messages of the last path
        self.state = JointState()
        self.create_subscription(JointState, "stage_state", self._keep, QOS)
        self._reports: list[dict[str, str]] = []
        self.create_subscription(DiagnosticArray, "/diagnostics", self._hear, QOS)

    def _keep(self, state: JointState) -> None:
        self.state = state
        self._answers.append((state.effort[0], state.position[0]))

    def _hear(self, message: DiagnosticArray) -> None:
        for status in message.status:
            values = {pair.key: pair.value for pair in status.values}
            self._reports += [values] if "held_at_limit" in values else []

    def await_compensator(self) -> None:
        """Wait until a compensator that has just been started has found nobody else, and takes commands."""
        self._reports.clear()
        self.wait_until(
            "the compensator to be ready",
            lambda: (
                any(values["state"] == "active" and not values["obstacle"] for values in list(self._reports))
                and self.count_subscribers("desired_displacement") >= 1
            ),
        )

    def held_at_limit(self) -> int:
        """Return how many displacements the compensator has held at a voltage limit so far."""
        before = len(self._reports)
        self.wait_until("a report of the compensator", lambda: len(self._reports) > before)
        return int(self._reports[-1]["held_at_limit"])

    def wait_until(self, what: str, condition: Callable[[], bool], timeout: float = 30.0, poll: float = 0.02) -> None:
        """Wait for the graph to be ready."""
        end = time.monotonic() + timeout
        while not condition():
            if time.monotonic() > end:
                raise SystemExit(f"demo: {what} did not happen within {timeout:g} s")
            time.sleep(poll)

    def call(self, name: str) -> None:
        """Call a service that needs nothing, such as that which resets the memory, and wait for its end."""
        client = self.create_client(Trigger, name)
        self.wait_until(f"the service {name}", client.service_is_ready)
        answer = client.call_async(Trigger.Request())
        self.wait_until(f"the answer of {name}", answer.done)
        if not answer.result().success:
            raise SystemExit(f"demo: {answer.result().message}")

    def reset(self) -> tuple[float, float]:
        """Let the compensator reset memory and zero; return what the stage reached from its first turn on, (m, m)."""
        self._answers.clear()
        self.call("/compensator/reset_memory")
        self.call("/compensator/set_zero")
        y = np.array(self._answers)[:, 1]
        return float(y[y.argmax() :].min()), float(y.max())

    def drive(self, voltages: Sequence[float], rate: float) -> FloatArray:
        """Apply voltages (V) one after the other; return voltage and measured displacement, shape (N, 2), V and m."""
        return self._send([Float64MultiArray(data=array("d", [v])) for v in voltages], self.voltage.publish, rate)

    def follow(self, displacements: Sequence[float], rate: float) -> FloatArray:
        """Wish for displacements (m) one after the other; return as `drive` does."""
        return self._send([JointState(name=["x"], position=[y]) for y in displacements], self.desired.publish, rate)

    def _send(self, messages: Sequence[Any], publish: Callable[[Any], None], rate: float) -> FloatArray:
        """Return the last answer to each message: while the compensator holds or slews there are several."""
        kept, self.late = [], []
        due, begin = time.monotonic(), self.get_clock().now() - Duration(seconds=time.monotonic())
        for k, message in enumerate(messages):
            time.sleep(max(0.0, due - time.monotonic()))
            if k:
                self.wait_until(f"the answer to sample {k - 1}", lambda: bool(self._answers), poll=1e-3)
                kept.append(self._answers[-1])
            # On a busy machine the path is followed more slowly, and its stamps say so.
            now = time.monotonic()
            if now > due + 1.0 / rate:
                due = now
                self.late.append(k)
            if isinstance(message, JointState):
                # The time at which it is meant: those at which messages are sent are less even.
                message.header.stamp = (begin + Duration(seconds=due)).to_msg()
            self._answers.clear()
            publish(message)
            due += 1.0 / rate
        self.wait_until("the last answer", lambda: bool(self._answers))
        return np.array([*kept, self._answers[-1]])


@contextmanager
def operator() -> Iterator[Operator]:
    """Run an operator whose callbacks are served in the background."""
    rclpy.init()
    node = Operator()
    executor = SingleThreadedExecutor()
    executor.add_node(node)

    def spin() -> None:
        try:
            while rclpy.ok():
                executor.spin_once(timeout_sec=0.2)
        except ExternalShutdownException:
            pass

    thread = threading.Thread(target=spin, daemon=True)
    thread.start()
    try:
        yield node
    finally:
        rclpy.try_shutdown()
        thread.join(timeout=5)
