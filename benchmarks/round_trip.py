"""Nodes in separate processes, and a client that sends them desired displacements and measures their latency."""

import json
import os
import struct
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import numpy as np
import rclpy
from numpy.typing import NDArray
from paths import scan_path
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.serialization import serialize_message
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray

import slpi_ros
from slpi_ros.excitation.drives import calibration_drive
from slpi_ros.model.stage_model import StageModel
from slpi_ros.nodes.common import make_executor
from slpi_ros.simulation.axis import SimulatedAxis
from slpi_ros.simulation.parameters import AxisParameters

FloatArray = NDArray[np.float64]

HERE = Path(__file__).resolve().parent
AXES = ("x", "y")
# Deep enough that the client loses no message.
DEEP = QoSProfile(depth=20_000, reliability=ReliabilityPolicy.RELIABLE)
DISCOVERY_S, LAST_ANSWERS_S = 20.0, 5.0


def identified_stage() -> StageModel:
    """Return a model of two axes."""
    t, v = calibration_drive(0.0, 100.0, duration=30.0, rate=200.0, seed=1)
    y = SimulatedAxis(AxisParameters.random(1), 1).run(t, v)[1]
    stamps = np.round(t * 1e9).astype(np.int64)
    return slpi_ros.identify(slpi_ros.Record(stamps, dict.fromkeys(AXES, v), dict.fromkeys(AXES, y)))


@contextmanager
def node(namespace: str, *command: str, python: str = sys.executable) -> Iterator[subprocess.Popen[bytes]]:
    """Run a node with a Python in a separate session; terminate it at the end of the ``with`` block."""
    options = [] if "--ros-args" in command else ["--ros-args"]
    remapping = ["-r", f"__ns:=/{namespace}"]
    process = subprocess.Popen([python, *command, *options, *remapping], start_new_session=True)
    try:
        yield process
    finally:
        process.terminate()
        try:
            process.wait(10)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


@contextmanager
def compensator(
    namespace: str,
    model: StageModel,
    executor: str = "events",
    python: str = sys.executable,
    **parameters: object,
) -> Iterator[subprocess.Popen[bytes]]:
    """Run the compensator with a model of both axes."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "stage.json"
        slpi_ros.save_model(model, path)
        given = {"axes": list(AXES), "model_file": str(path), "executor": executor, **parameters}
        options = [part for name, value in given.items() for part in ("-p", f"{name}:={json.dumps(value)}")]
        with node(
            namespace, "-m", "slpi_ros.nodes.start", "compensator", "--ros-args", *options, python=python
        ) as process:
            yield process


@contextmanager
def echo(
    namespace: str, kind: str = "echo", executor: str = "events", python: str = sys.executable
) -> Iterator[subprocess.Popen[bytes]]:
    """Run an echo node."""
    with node(namespace, str(HERE / "echo_node.py"), kind, executor, python=python) as process:
        yield process


@dataclass
class Trip:
    """Result of a measurement: messages sent to one node, and its answers.

    Parameters
    ----------
    latency : list of ndarray, seconds
        Latencies of the answers, one array for each block of messages.
    sent, answered : int
        Number of messages sent and answered.
    busy, took : float, seconds
        Processor time of the node, and total time.
    resident : list of int, bytes
        Resident memory of the node, sampled once a second.
    """

    latency: list[FloatArray] = field(default_factory=list)
    sent: int = 0
    answered: int = 0
    busy: float = 0.0
    took: float = 0.0
    resident: list[int] = field(default_factory=list)

    @property
    def lost(self) -> int:
        """Number of messages without an answer."""
        return self.sent - self.answered

    @property
    def cpu(self) -> float:
        """Fraction of one processor core that the node used."""
        return self.busy / self.took

    def percentiles(self) -> tuple[float, float]:
        """Return median and 99th percentile of the latency, microseconds."""
        p50, p99 = np.percentile(np.concatenate(self.latency or [[np.nan]]) * 1e6, (50, 99))
        return float(p50), float(p99)


class Client:
    """Client that sends at a constant rate and receives in the same thread: its delay is the same for all nodes.

    Messages are sent and received in serialised form, so that the client takes little processor time from the nodes.
    """

    def __init__(self, namespaces: Sequence[str]) -> None:
        self._node = rclpy.create_node("round_trip_client")
        self._executor = make_executor("events")
        self._executor.add_node(self._node)
        self._publishers = {}
        # The times of the answers of each node: one node may still answer while another one is asked.
        self._answers: dict[str, list[int]] = {}
        for namespace in namespaces:
            topic = f"/{namespace}/desired_displacement"
            self._publishers[namespace] = self._node.create_publisher(JointState, topic, DEEP)
            answers = f"/{namespace}/voltage_command"
            own: list[int] = []
            self._answers[namespace] = own
            receive = partial(_note_time, own)
            self._node.create_subscription(Float64MultiArray, answers, receive, DEEP, raw=True)
        t, y = scan_path(2e-6, 18e-6, duration=20.0, rate=1000.0, seed=5)
        self._path = y.tolist()
        marks = (1.2345, 5.4321)
        self._message = bytearray(serialize_message(JointState(name=list(AXES), position=marks)))
        self._positions_at = self._message.index(struct.pack("=2d", *marks))
        self._index = 0

    def close(self) -> None:
        """Shut down the executor and the node of the client."""
        self._executor.shutdown()
        self._node.destroy_node()

    def wait_for_nodes(self) -> None:
        """Wait until all nodes are discovered, then send messages to each of them for one second as a warm-up."""
        deadline = time.monotonic() + DISCOVERY_S
        for namespace, publisher in self._publishers.items():
            answers = f"/{namespace}/voltage_command"
            while not (publisher.get_subscription_count() and self._node.count_publishers(answers)):
                if time.monotonic() > deadline:
                    raise RuntimeError(f"the node {namespace} did not show up")
                self._executor.spin_once(timeout_sec=0.1)
        time.sleep(0.5)
        for namespace, answers_of in self._answers.items():
            answers_of.clear()
            self._drain(answers_of, len(self._send_for(namespace, 1000.0, 1.0, [])))

    def run(self, namespace: str, process: subprocess.Popen[bytes], rate: float, seconds: float, trip: Trip) -> None:
        """Send messages for some `seconds` at `rate` (Hz) to a node running in `process`; add the results to `trip`."""
        received = self._answers[namespace]
        received.clear()
        busy, began = _cpu_seconds(process.pid), time.monotonic()
        sent = self._send_for(namespace, rate, seconds, trip.resident, process.pid)
        self._drain(received, len(sent))
        trip.took += time.monotonic() - began
        trip.busy += _cpu_seconds(process.pid) - busy
        trip.sent += len(sent)
        trip.answered += len(received)
        # Answers do not identify the message that they answer: after a loss they cannot be matched.
        if len(received) == len(sent):
            trip.latency.append((np.array(received) - np.array(sent)) * 1e-9)

    def _send_for(
        self, namespace: str, rate: float, seconds: float, resident: list[int], pid: int | None = None
    ) -> list[int]:
        publisher, period = self._publishers[namespace], round(1e9 / rate)
        sent: list[int] = []
        start = time.perf_counter_ns()
        for k in range(round(seconds * rate)):
            due = start + k * period
            while (left := due - time.perf_counter_ns()) > 0:
                self._executor.spin_once(timeout_sec=left * 1e-9)
            publisher.publish(self._next_message())
            sent.append(time.perf_counter_ns())
            if pid and k % round(rate) == 0:
                resident.append(_resident(pid))
            # When sending is late, the loop above does not spin: still receive answers from time to time.
            if k % 8 == 0:
                self._executor.spin_once(timeout_sec=0.0)
        return sent

    def _next_message(self) -> bytes:
        self._index += 1
        y = self._path[self._index % len(self._path)]
        struct.pack_into("=iI", self._message, 4, *divmod(time.time_ns(), 1_000_000_000))
        struct.pack_into("=2d", self._message, self._positions_at, y, y)
        return bytes(self._message)

    def _drain(self, received: list[int], count: int) -> None:
        deadline = time.monotonic() + LAST_ANSWERS_S
        while time.monotonic() < deadline and len(received) < count:
            self._executor.spin_once(timeout_sec=0.05)


def _note_time(received: list[int], _: bytes) -> None:
    received.append(time.perf_counter_ns())


def _cpu_seconds(pid: int) -> float:
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def _resident(pid: int) -> int:
    return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
