"""A client that sends desired displacements at a steady rate and times the answers, and the processes it talks to."""

import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import rclpy
from numpy.typing import NDArray
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray

import slpi_ros
from slpi_ros.excitation.drives import calibration_drive
from slpi_ros.model import StageModel
from slpi_ros.nodes.runner import make_executor
from slpi_ros.stage.drive import scan_path
from slpi_ros.stage.preisach import PreisachStage, StageParameters

FloatArray = NDArray[np.float64]

HERE = Path(__file__).resolve().parent
AXES = ("x", "y")
# Deep enough that nothing is lost on the client's side.
DEEP = QoSProfile(depth=20_000, reliability=ReliabilityPolicy.RELIABLE)
DISCOVERY_S, LAST_ANSWERS_S = 20.0, 5.0


def identified_stage() -> StageModel:
    """Return a model of two axes."""
    t, v = calibration_drive(0.0, 100.0, duration=30.0, rate=200.0, seed=1)
    y = PreisachStage(StageParameters.random(1), 1).run(t, v)[1]
    stamps = np.round(t * 1e9).astype(np.int64)
    return slpi_ros.identify(slpi_ros.Record(stamps, dict.fromkeys(AXES, v), dict.fromkeys(AXES, y)))


@contextmanager
def node(*command: str) -> Iterator[subprocess.Popen[bytes]]:
    """Run a node in a session of its own; end it at last."""
    process = subprocess.Popen([sys.executable, *command], start_new_session=True)
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
def compensator(model: StageModel, executor: str = "events", **parameters: object) -> Iterator[subprocess.Popen[bytes]]:
    """Run the compensator with a model of both axes."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "stage.json"
        slpi_ros.save_model(model, path)
        given = {"axes": list(AXES), "model_file": str(path), "executor": executor, **parameters}
        options = [part for name, value in given.items() for part in ("-p", f"{name}:={json.dumps(value)}")]
        with node("-m", "slpi_ros.nodes.compensator", "--ros-args", *options) as process:
            yield process


@contextmanager
def echo(executor: str = "events") -> Iterator[subprocess.Popen[bytes]]:
    """Run the bare echo node."""
    with node(str(HERE / "echo_node.py"), executor) as process:
        yield process


@dataclass(frozen=True)
class Trip:
    """What became of a stream of messages.

    Parameters
    ----------
    latency : ndarray, shape (answers,), seconds
    sent, answered : int
    cpu : float
        Share of a core that the node took.
    resident : ndarray, shape (k,), bytes
        Memory of the node, once a second.
    """

    latency: FloatArray
    sent: int
    answered: int
    cpu: float
    resident: NDArray[np.int64]

    @property
    def lost(self) -> int:
        """Messages without an answer."""
        return self.sent - self.answered

    def percentiles(self) -> tuple[float, float]:
        """Return p50 and p99 in microseconds."""
        p50, p99 = np.percentile(self.latency * 1e6, (50, 99))
        return float(p50), float(p99)


class Client:
    """Sends at a steady rate and receives in between, in one thread: its own delay is the same for every node."""

    def __init__(self) -> None:
        self._node = rclpy.create_node("round_trip_client")
        self._executor = make_executor("events")
        self._executor.add_node(self._node)
        self._publisher = self._node.create_publisher(JointState, "desired_displacement", DEEP)
        self._node.create_subscription(Float64MultiArray, "voltage_command", self._on_answer, DEEP)
        self._received: list[int] = []
        t, y = scan_path(2e-6, 18e-6, duration=20.0, rate=1000.0, seed=5)
        self._path = y.tolist()
        self._message = JointState(name=list(AXES))
        self._index = 0

    def close(self) -> None:
        """Leave the graph."""
        self._executor.shutdown()
        self._node.destroy_node()

    def run(self, process: subprocess.Popen[bytes], rate: float, seconds: float) -> Trip:
        """Send for a while to the node that `process` is."""
        self._wait_for_node()
        self._send_for(rate, 1.0)
        self._drain()
        self._received.clear()
        cpu, began = _cpu_seconds(process.pid), time.monotonic()
        sent, resident = self._send_for(rate, seconds, process.pid)
        self._drain(len(sent))
        took = time.monotonic() - began
        answered = min(len(self._received), len(sent))
        latency = (np.array(self._received[:answered]) - np.array(sent[:answered])) * 1e-9
        load = (_cpu_seconds(process.pid) - cpu) / took
        return Trip(latency, len(sent), answered, load, np.array(resident))

    def _on_answer(self, _: Float64MultiArray) -> None:
        self._received.append(time.perf_counter_ns())

    def _wait_for_node(self) -> None:
        deadline = time.monotonic() + DISCOVERY_S
        while not (self._publisher.get_subscription_count() and self._node.count_publishers("voltage_command")):
            if time.monotonic() > deadline:
                raise RuntimeError("the node did not show up")
            self._executor.spin_once(timeout_sec=0.1)
        time.sleep(0.5)

    def _send_for(self, rate: float, seconds: float, pid: int | None = None) -> tuple[list[int], list[int]]:
        period = round(1e9 / rate)
        sent: list[int] = []
        resident: list[int] = []
        start = time.perf_counter_ns()
        for k in range(round(seconds * rate)):
            due = start + k * period
            while (left := due - time.perf_counter_ns()) > 0:
                self._executor.spin_once(timeout_sec=left * 1e-9)
            self._send()
            sent.append(time.perf_counter_ns())
            if pid and k % round(rate) == 0:
                resident.append(_resident(pid))
            # Late for the next: still look for answers now and then.
            if k % 8 == 0:
                self._executor.spin_once(timeout_sec=0.0)
        return sent, resident

    def _send(self) -> None:
        self._index += 1
        y = self._path[self._index % len(self._path)]
        now = time.time_ns()
        stamp = self._message.header.stamp
        stamp.sec, stamp.nanosec = divmod(now, 1_000_000_000)
        self._message.position = (y, y)
        self._publisher.publish(self._message)

    def _drain(self, count: int | None = None) -> None:
        deadline = time.monotonic() + (LAST_ANSWERS_S if count else 1.0)
        while time.monotonic() < deadline and (count is None or len(self._received) < count):
            self._executor.spin_once(timeout_sec=0.05)


def _cpu_seconds(pid: int) -> float:
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def _resident(pid: int) -> int:
    return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
