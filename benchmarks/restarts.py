"""Time from the start of a compensator's process to its first answer, by how the life before it ended.

A process that publishes set points at 50 Hz, and the state of the stage at 100 Hz, is there all the time. Each life is
ended while it follows a trajectory, and the next one is started at once. How long it takes is a matter of the
middleware (docs/troubleshooting.md), and of listening whether somebody else commands the stage. With `--beside` each
life is followed by one of another environment, in a namespace of its own.
"""

import argparse
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import rclpy
from builtin_interfaces.msg import Duration
from node_lives import stage
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from slpi_ros.model.document import save_model

PROFILE = Path(__file__).resolve().parents[1] / "config" / "fastdds.xml"
# Seconds: longest wait for an answer, and the time after which Fast DDS has forgotten a process that was killed.
PATIENCE, FORGOTTEN = 60.0, 22.0
# Answers before this time (s) are the last ones of the life before.
NOT_YET = 0.2
# How a life ends, the depth of the sender's queue, and whether the nodes have the profile.
CASES = {
    "SIGTERM, depth 100": (signal.SIGTERM, 100, False),
    "SIGKILL, depth 100": (signal.SIGKILL, 100, False),
    "SIGKILL, depth 5000": (signal.SIGKILL, 5000, False),
    "SIGKILL, depth 5000, config/fastdds.xml": (signal.SIGKILL, 5000, True),
}


class Sender:
    """The other end: set points at 50 Hz, a stage that does what it is commanded, and the times of the answers."""

    def __init__(self, depth: int, namespace: str) -> None:
        reliable = QoSProfile(depth=depth, reliability=ReliabilityPolicy.RELIABLE)
        self.node = rclpy.create_node("sender", namespace=namespace)
        self.answers: list[float] = []
        self._state = JointState(name=["x", "y"], position=[0.0, 0.0], effort=[0.0, 0.0])
        self._state.header.frame_id = "stage"
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(self.node)
        self.node.create_subscription(Float64MultiArray, "voltage_command", self._on_answer, reliable)
        self._points = self.node.create_publisher(JointState, "desired_displacement", reliable)
        self._paths = self.node.create_publisher(JointTrajectory, "desired_trajectory", reliable)
        self._states = self.node.create_publisher(JointState, "stage_state", reliable)
        self.node.create_timer(0.02, self._send)
        self.node.create_timer(0.01, self._report)

    def _on_answer(self, answer: Float64MultiArray) -> None:
        self.answers.append(time.monotonic())
        self._state.effort = answer.data

    def _report(self) -> None:
        self._state.header.stamp = self.node.get_clock().now().to_msg()
        self._states.publish(self._state)

    def _send(self) -> None:
        self._points.publish(JointState(name=["x", "y"], position=[3e-6, 2e-6]))

    def send_path(self) -> None:
        """Send a trajectory of ten seconds."""
        points = [
            JointTrajectoryPoint(
                positions=[float(y)], time_from_start=Duration(sec=k // 100, nanosec=10_000_000 * (k % 100))
            )
            for k, y in enumerate(np.linspace(1e-6, 5e-6, 1000))
        ]
        self._paths.publish(JointTrajectory(joint_names=["x"], points=points))

    def serve(self) -> None:
        """Serve what is due."""
        self._executor.spin_once(timeout_sec=0.002)

    def close(self) -> None:
        self._executor.shutdown()
        self.node.destroy_node()


def spin(senders: Sequence[Sender], seconds: float, until: Callable[[], bool] = lambda: False) -> None:
    """Serve callbacks for some time, or until something is true."""
    end = time.monotonic() + seconds
    while time.monotonic() < end and not until():
        for sender in senders:
            sender.serve()


def first_answers(case: str, lives: int, folder: Path, pythons: Sequence[str]) -> list[list[float]]:
    """Return the time (s) to the first answer of each life, for each environment."""
    number, depth, profile = CASES[case]
    environment = os.environ | ({"FASTRTPS_DEFAULT_PROFILES_FILE": str(PROFILE)} if profile else {})
    senders = [Sender(depth, f"/environment{each}") for each in range(len(pythons))]
    found: list[list[float]] = [[] for _ in pythons]
    for _ in range(lives):
        for each, (python, sender) in enumerate(zip(pythons, senders, strict=True)):
            memory = folder / f"memory{each}.json"
            given = {"axes": "['x','y']", "model_file": folder / "model.json", "memory_file": memory}
            words = [word for name, value in given.items() for word in ("-p", f"{name}:={value}")]
            words += ["-r", f"__ns:=/environment{each}"]
            command = [python, "-m", "slpi_ros.nodes.start", "compensator", "--ros-args", *words]
            count, begun = len(sender.answers), time.monotonic()
            node = subprocess.Popen(command, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
            try:
                later = lambda: len(sender.answers) > count and sender.answers[-1] > begun + NOT_YET  # noqa: E731, B023
                spin(senders, PATIENCE, later)
                found[each].append(next((at for at in sender.answers[count:] if at > begun + NOT_YET), np.inf) - begun)
                spin(senders, random.uniform(0.2, 0.8))
                sender.send_path()
                spin(senders, random.uniform(0.6, 2.0))
            finally:
                node.send_signal(number)
                node.wait()
    for sender in senders:
        sender.close()
    return found


def main(lives: int = 20, beside: str = "") -> None:
    """Print a line for each case and environment, and how much later than the other one this environment answers."""
    rclpy.init()
    print(f"load of the machine before: {os.getloadavg()[0]:.2f}; time to the first answer, s")
    print(f"{'end of the life before':<40} {'lives':>6} {'median':>7} {'longest':>8} {'later':>6}")
    pythons = [sys.executable, *filter(None, [beside])]
    with tempfile.TemporaryDirectory() as folder:
        save_model(stage(), Path(folder, "model.json"))
        for case in CASES:
            for each, found in enumerate(times := first_answers(case, lives, Path(folder), pythons)):
                name, later = ("beside", "") if each else (case, f"{np.median(found) - np.median(times[-1]):6.1f}")
                print(f"{name:<40} {len(found):6d} {np.median(found):7.1f} {max(found):8.1f} {later}", flush=True)
            # Those that were killed are forgotten before the next case.
            time.sleep(FORGOTTEN)
    rclpy.try_shutdown()


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--lives", type=int, default=20)
    parser.add_argument("--beside", default="", metavar="PYTHON", help="another environment")
    options = parser.parse_args()
    main(options.lives, options.beside)
