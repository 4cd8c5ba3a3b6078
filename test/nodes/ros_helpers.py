"""What tests of nodes share: node processes that always end, and a place on the ROS graph to watch them from."""

import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from forked import Forked
from lifecycle_msgs.srv import GetState
from rcl_interfaces.srv import DescribeParameters, GetParameters, SetParametersAtomically
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

from slpi_ros.hysteresis.loop_family import LoopFamily
from slpi_ros.model.axis_model import AxisModel, FitQuality, Start
from slpi_ros.model.stage_model import StageModel

RELIABLE = QoSProfile(depth=5000, reliability=ReliabilityPolicy.RELIABLE)
LATCHED = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL)
# Only what hangs takes as long.
PATIENCE_S = 60.0
# Services that change nothing, and after how long one of them is asked again.
QUESTIONS = (DescribeParameters, GetParameters, GetState)
REPEAT_S = 5.0


class NodeProcess:
    """One node as a process in a session of its own; `fresh`: not forked, but started as from a shell."""

    def __init__(self, name: str, parameters: Mapping[str, object], arguments: Sequence[str], fresh: bool = False):
        given = [part for key, value in parameters.items() for part in ("-p", f"{key}:={yaml_of(value)}")]
        words = ["--ros-args", *given, *arguments]
        self._stderr = tempfile.NamedTemporaryFile("w+")  # noqa: SIM115
        self.process: Forked | subprocess.Popen[bytes]
        if fresh:
            command = [sys.executable, "-m", "slpi_ros.nodes.start", name, *words]
            self.process = subprocess.Popen(
                command, stdout=subprocess.DEVNULL, stderr=self._stderr, start_new_session=True
            )
        else:
            self.process = Forked(f"slpi_ros.nodes.start:{name}", words, errors=self._stderr.name)

    @property
    def stderr(self) -> str:
        """All that the process has said so far."""
        self._stderr.seek(0)
        return self._stderr.read()

    def wait(self) -> int:
        """Return the exit code."""
        return self.process.wait(PATIENCE_S)

    def stop(self, number: int = signal.SIGTERM) -> int:
        """Signal the process as a terminal would, and return the exit code."""
        os.killpg(self.process.pid, number)
        return self.wait()

    def kill(self) -> None:
        """End the whole group, whatever is left of it."""
        if self.process.poll() is None:
            os.killpg(self.process.pid, signal.SIGKILL)
            self.process.wait()
        self._stderr.close()


def yaml_of(value: object) -> str:
    """Write a parameter's value so that YAML reads it back as it is: JSON does, but for NaN."""
    return ".nan" if value != value else json.dumps(value)


@contextmanager
def started(
    name: str, parameters: Mapping[str, object] | None = None, *arguments: str, fresh: bool = False
) -> Iterator[NodeProcess]:
    """Start the node `name` of the package; kill it at the end."""
    node = NodeProcess(name, parameters or {}, arguments, fresh)
    try:
        yield node
    finally:
        node.kill()


class Graph:
    """A node that publishes, subscribes, calls services and waits."""

    def __init__(self, context: Context) -> None:
        self.tested: NodeProcess | None = None
        self.node = rclpy.create_node(f"test_{time.monotonic_ns()}", context=context)
        self._executor = SingleThreadedExecutor(context=context)
        self._executor.add_node(self.node)
        self._statuses: list[Any] = []
        self._read = 0

    def close(self) -> None:
        self._executor.shutdown()
        self.node.destroy_node()

    def spin_until(self, done: Callable[[], Any], what: str) -> Any:
        """Return what `done` returned once it is true, while the process under test lives."""
        deadline = time.monotonic() + PATIENCE_S
        while not (found := done()):
            said = self.tested.stderr if self.tested else ""
            assert time.monotonic() < deadline, f"waited in vain for {what}; the node said: {said}"
            assert not self.tested or self.tested.process.poll() is None, f"the node died: {said}"
            self._executor.spin_once(timeout_sec=0.02)
        return found

    def spin_for(self, seconds: float) -> None:
        """Serve callbacks for some time."""
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            self._executor.spin_once(timeout_sec=0.02)

    def record(self, kind: Any, topic: str, qos: QoSProfile = RELIABLE) -> list[Any]:
        """Return a list that the topic's messages go to."""
        messages: list[Any] = []
        self.node.create_subscription(kind, topic, messages.append, qos)
        return messages

    def watch_diagnostics(self) -> None:
        """Subscribe last: once a status comes, its node knows of all topics subscribed before."""
        self.node.create_subscription(
            DiagnosticArray, "/diagnostics", lambda array: self._statuses.extend(array.status), RELIABLE
        )

    def statuses(self, name: str) -> list[Any]:
        """Return all statuses of that name so far."""
        return [status for status in self._statuses if status.name == name]

    def wait_for_status(self, name: str, wanted: Callable[[Any], Any], what: str) -> Any:
        """Return the first status of that name, since the one last waited for, that is wanted."""

        def find() -> Any:
            for i in range(self._read, len(self._statuses)):
                if self._statuses[i].name == name and wanted(self._statuses[i]):
                    self._read = i
                    return self._statuses[i]
            return None

        return self.spin_until(find, what)

    def publisher(self, kind: Any, topic: str, qos: QoSProfile = RELIABLE) -> Any:
        """Return a publisher that somebody listens to."""
        publisher = self.node.create_publisher(kind, topic, qos)
        self.spin_until(publisher.get_subscription_count, f"a subscriber of {topic}")
        return publisher

    def call(self, kind: Any, name: str, request: Any) -> Any:
        """Return the answer of a service; a question that changes nothing is repeated.

        Fast DDS drops the answer to a client whose reader the service has not discovered within 100 ms
        (ros2/rmw_fastrtps, issue 842).
        """
        client = self.node.create_client(kind, name)
        repeated = REPEAT_S if kind in QUESTIONS else PATIENCE_S
        asked: list[tuple[float, Any]] = []

        def answered() -> Any:
            if not asked or time.monotonic() - asked[-1][0] > repeated:
                asked.append((time.monotonic(), client.call_async(request)))
            return next((future for _, future in asked if future.done()), None)

        try:
            self.spin_until(client.service_is_ready, f"the service {name}")
            return self.spin_until(answered, f"an answer of {name}").result()
        finally:
            self.node.destroy_client(client)

    def set_parameters(self, node: str, **values: object) -> str:
        """Set parameters of a node, all or none; return why they were refused, or nothing."""
        parameters: Any = [Parameter(name, value=value).to_parameter_msg() for name, value in values.items()]
        request = SetParametersAtomically.Request(parameters=parameters)
        result = self.call(SetParametersAtomically, f"{node}/set_parameters_atomically", request).result
        assert result.successful != bool(result.reason)
        return result.reason


@contextmanager
def on_graph() -> Iterator[Graph]:
    """Take part in the graph of this test run."""
    context = Context()
    rclpy.init(context=context)
    graph = Graph(context)
    try:
        yield graph
    finally:
        graph.close()
        rclpy.shutdown(context=context)


def values_of(status: Any) -> dict[str, str]:
    """Return the key-values of a diagnostic status."""
    return {pair.key: pair.value for pair in status.values}


def axis_model(stroke: float = 10e-6, bias: float = 0.4, voltage: float = 100.0) -> AxisModel:
    """Return a loop family whose loops widen with the voltage level, from 0 V to `voltage`."""
    grid = np.linspace(0.0, voltage, 13)
    upper, lower = grid[:, None] / voltage, grid[None, :] / voltage
    width = upper - lower
    surface = stroke * (0.8 * width + 0.2 * width**2 * (1.0 + bias * (upper + lower) / 2)) / (1.0 + 0.1 * bias)
    surface[upper < lower] = 0.0
    family = LoopFamily(grid, surface, surface[:, 0] * 1.03, stroke / voltage)
    top = float(family.rise[-1])
    quality = FitQuality(8e-9, 3e-8, 8.1e-9, 8e-9, 1000, 0.9, "made by hand")
    return AxisModel("slpi", family, Start(0.0, 0.0), (0.0, voltage), (0.0, top), quality)


def stage_model(axes: Sequence[str] = ("x",), **shape: float) -> StageModel:
    """Return a stage with axes that differ."""
    models = {axis: axis_model(bias=0.4 - 0.2 * i, **shape) for i, axis in enumerate(axes)}
    return StageModel(models, "stage under test", "2026-01-02T03:04:05+00:00")


def voltage_path(samples: int, seed: int, top: float = 100.0) -> np.ndarray:
    """Return voltages, shape (N,), that turn often, on all levels, in steps small and large."""
    rng = np.random.default_rng(seed)
    turns = np.concatenate([[0.0, top, 0.1 * top], rng.uniform(0.02 * top, 0.98 * top, samples // 25)])
    return np.interp(np.linspace(0.0, turns.size - 1.0, samples), np.arange(turns.size), turns)
