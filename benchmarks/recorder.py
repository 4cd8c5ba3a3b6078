"""The recorder: its processor time beside that of another environment, and what it loses when it is killed.

Both recorders listen to the same publisher at the same time, so that other load of the machine affects them alike. Each
kill comes at a random moment; what is lost is the time from the newest message in the bag, which is read as it lies, to
the newest that was published.
"""

import argparse
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import rclpy
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.signals import SignalHandlerOptions
from sensor_msgs.msg import JointState

from slpi_ros.io.bag_reader import read_bag
from slpi_ros.io.messages import encode_joint_states

TICKS = os.sysconf("SC_CLK_TCK")
STORAGES = ("mcap", "sqlite3")


class Source:
    """Publisher of stage_state with two axes, stamped with the time of sending."""

    def __init__(self) -> None:
        self._node = rclpy.create_node("source")
        qos = QoSProfile(depth=1000, reliability=ReliabilityPolicy.RELIABLE)
        self._publisher = self._node.create_publisher(JointState, "stage_state", qos)
        self.last_ns = 0

    def wait_for(self, listeners: int) -> None:
        while self._publisher.get_subscription_count() != listeners:
            time.sleep(0.05)

    def publish(self, rate: float, seconds: float) -> int:
        """Publish at a rate (Hz); return the number of messages."""
        begun, sent = time.monotonic(), 0
        while (elapsed := time.monotonic() - begun) < seconds:
            while sent < elapsed * rate:
                self.last_ns = time.time_ns()
                row = np.full((1, 2), 1e-6)
                self._publisher.publish(*encode_joint_states(np.array([self.last_ns]), row, row, ("x", "y"), "bench"))
                sent += 1
            time.sleep(0.2 / rate)
        return sent


def recorder(python: str, output: Path, storage: str) -> subprocess.Popen[bytes]:
    """Start a recorder of the environment of `python`."""
    given = ["-p", f"output:={output}", "-p", f"storage:={storage}"]
    command = [python, "-m", "slpi_ros.nodes.start", "recorder", "--ros-args", "--log-level", "warn", *given]
    return subprocess.Popen(command, start_new_session=True)


def cpu_seconds(process: subprocess.Popen[bytes]) -> float:
    """Return the processor time of a process so far."""
    user, system = Path(f"/proc/{process.pid}/stat").read_text().rpartition(")")[2].split()[11:13]
    return (int(user) + int(system)) / TICKS


def cost(source: Source, pythons: Sequence[str], rate: float, seconds: float) -> None:
    """Print the processor time of the recorders of several environments for each message."""
    for storage in STORAGES:
        with tempfile.TemporaryDirectory() as folder:
            nodes = [recorder(each, Path(folder) / f"bag{i}", storage) for i, each in enumerate(pythons)]
            source.wait_for(len(nodes))
            source.publish(rate, 2.0)
            before = [cpu_seconds(node) for node in nodes]
            sent = source.publish(rate, seconds)
            used = [cpu_seconds(node) - start for node, start in zip(nodes, before, strict=True)]
            for node in nodes:
                node.send_signal(signal.SIGINT)
                node.wait()
            source.wait_for(0)
            # The first, of which the others are multiples, is this environment.
            told = ", ".join(f"{each / sent * 1e6:.1f} us a message" for each in used)
            print(f"{storage:8} {rate:g} Hz, {sent} messages: {told}; ratio {used[0] / used[-1]:.2f}", flush=True)


def losses(source: Source, rate: float, kills: int) -> None:
    """Print the time that is lost at most when the recorder is killed at a random moment."""
    for storage in STORAGES:
        lost = []
        for _ in range(kills):
            with tempfile.TemporaryDirectory() as folder:
                node = recorder(sys.executable, Path(folder) / "bag", storage)
                source.wait_for(1)
                source.publish(rate, 1.5 + random.random())
                node.kill()
                node.wait()
                lost.append((source.last_ns - read_bag(Path(folder) / "bag").time_ns[-1]) * 1e-9)
                source.wait_for(0)
        print(f"{storage:8} {rate:g} Hz, {kills} kills: median {np.median(lost):.2f} s, most {max(lost):.2f} s lost")


def main() -> None:
    """Print both tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--kills", type=int, default=10)
    parser.add_argument("--beside", default="", metavar="PYTHON", help="another environment")
    options = parser.parse_args()
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    source = Source()
    if options.seconds:
        cost(source, [sys.executable, *filter(None, [options.beside])], 2000.0, options.seconds)
    for rate in (500.0, 2000.0):
        if options.kills:
            losses(source, rate, options.kills)
    rclpy.try_shutdown()


if __name__ == "__main__":
    main()
