"""A trajectory of a million points on two axes: time until the compensator accepts it, and deadline errors of points.

Points are 1 ms apart, and the path of each axis reverses every 25 points.
"""

import argparse
import os
import struct
import time
from collections.abc import Callable

import numpy as np
import rclpy
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray
from numpy.typing import NDArray
from rclpy.qos import QoSProfile
from rclpy.serialization import serialize_message
from rclpy.signals import SignalHandlerOptions
from round_trip import AXES, compensator, identified_stage
from std_msgs.msg import Header
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from slpi_ros.model.stage_model import StageModel
from slpi_ros.nodes.common import make_executor

FloatArray = NDArray[np.float64]

POINTS, REVERSALS, PERIOD_NS, SECOND_NS = 1_000_000, 40_000, 1_000_000, 1_000_000_000
# Layout of a serialised point: two positions with their count, three empty arrays, a time.
POINT = np.dtype([("count", "=u4"), ("positions", "=f8", 2), ("empty", "=u4", 3), ("time", "=u4", 2)])
STATUS = "/bench/compensator: compensator"
PATIENCE_S, HOUR_S = 60.0, 3600.0
# Long enough to receive the diagnostics of the second in which a trajectory arrived.
REPORTED_S = 2.5
LATENESS = [f"deadline_error_{which}_us" for which in ("p50", "p99", "max")]


def paths(model: StageModel) -> FloatArray:
    """Return a path for each axis, shape (POINTS, axes), metres, with reversals at random levels."""
    columns = []
    for seed, axis in enumerate(AXES):
        low, high = model.axis(axis).displacement_range
        turns = np.random.default_rng(seed).uniform(0.95 * low + 0.05 * high, 0.05 * low + 0.95 * high, REVERSALS)
        columns.append(np.interp(np.linspace(0, REVERSALS - 1, POINTS), np.arange(REVERSALS), turns))
    return np.column_stack(columns)


def serialized(positions: FloatArray, start: float = 0.0) -> bytes:
    """Return a serialised JointTrajectory; with a million point objects, building it would take a minute.

    It starts at once, or at the time `start` (s) of the system clock.
    """
    first = JointTrajectoryPoint(positions=positions[0].tolist())
    header = Header(stamp=Time(sec=int(start)))
    message = bytearray(serialize_message(JointTrajectory(header=header, joint_names=AXES, points=[first])))
    # All points after the first one, which may be aligned differently, have the same layout.
    first_at = message.index(positions[0].tobytes())
    rest = np.zeros(POINTS - 1, POINT)
    rest["count"], rest["positions"] = len(AXES), positions[1:]
    rest["time"] = np.column_stack(np.divmod(PERIOD_NS * np.arange(1, POINTS), SECOND_NS))
    head = message[: first_at + POINT.itemsize - POINT.fields["positions"][1]]
    struct.pack_into("=I", head, head.index(struct.pack("=2I", 1, len(AXES))), POINTS)
    return bytes(head) + rest.tobytes()


class Bench:
    """Client that sends trajectories to a compensator and receives its diagnostics."""

    def __init__(self) -> None:
        self._node = rclpy.create_node("trajectory_bench")
        self._executor = make_executor("events")
        self._executor.add_node(self._node)
        self._publisher = self._node.create_publisher(JointTrajectory, "/bench/desired_trajectory", QoSProfile(depth=1))
        self._node.create_subscription(DiagnosticArray, "/diagnostics", self._on_report, QoSProfile(depth=100))
        self.reports: list[dict[str, str]] = []
        self._sent, self._reported = 0, ""
        self._spin_until(lambda: self.reports and self._publisher.get_subscription_count(), "the compensator")

    def send(self, trajectory: bytes) -> float:
        """Send a trajectory; return the time (s) until the diagnostics report it."""
        began, self._sent = time.monotonic(), self._sent + 1
        self._publisher.publish(trajectory)
        self._spin_until(lambda: self._reported == str(self._sent), "the trajectory")
        return time.monotonic() - began

    def watch(self, seconds: float) -> list[dict[str, str]]:
        """Return the diagnostics received during some seconds."""
        self.reports.clear()
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            self._executor.spin_once(timeout_sec=0.1)
        return list(self.reports)

    def _on_report(self, array: DiagnosticArray) -> None:
        for status in array.status:
            if status.name == STATUS:
                self.reports.append({pair.key: pair.value for pair in status.values})
                self._reported = self.reports[-1]["trajectories"]

    def _spin_until(self, done: Callable[[], object], what: str) -> None:
        deadline = time.monotonic() + PATIENCE_S
        while not done():
            if time.monotonic() > deadline:
                raise RuntimeError(f"waited in vain for {what}")
            self._executor.spin_once(timeout_sec=0.1)


def main(seconds: float = 30.0, tries: int = 3) -> None:
    """Print the results."""
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    model = identified_stage()
    positions, stop = paths(model), serialize_message(JointTrajectory())
    message = serialized(positions)
    print(f"{POINTS} points, {len(AXES)} axes, {REVERSALS} reversals each, {len(message) / 2**20:.0f} MiB")
    with compensator("bench", model):
        bench = Bench()
        accepted, held_up = [], []
        for _ in range(tries):
            accepted.append(bench.send(message))
            reports = bench.watch(seconds if len(accepted) == tries else 1.0)
            # The next trajectory starts in an hour: points of the first one continue, delayed by its validation.
            bench.send(serialized(positions, time.time() + HOUR_S))
            held_up.append(max(float(report[LATENESS[-1]] or 0.0) for report in bench.watch(REPORTED_S)))
            bench.send(stop)
    took, late_by = (", ".join(f"{each:.2f}" for each in column) for column in (accepted, np.array(held_up) * 1e-6))
    print(f"sent, checked and reported after {took} s (load of the machine {os.getloadavg()[0]:.2f})")
    print(f"points of a trajectory late by {late_by} s while the next one is taken and checked")
    followed = int(reports[0]["points_remaining"]) - int(reports[-1]["points_remaining"])
    skipped = int(reports[-1]["points_skipped"]) - int(reports[0]["points_skipped"])
    late = np.array([[float(report[key]) for key in LATENESS] for report in reports[1:] if report[LATENESS[0]]])
    p50, p99, latest = np.median(late[:, 0]), np.median(late[:, 1]), late[:, 2].max()
    print(f"deadline error of {followed} points: p50 {p50:.0f}, p99 {p99:.0f}, max {latest:.0f} us; {skipped} skipped")
    print("(percentiles: medians of those of each second; skipped: due together with the next one, which is given)")
    rclpy.try_shutdown()


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=30.0)
    main(parser.parse_args().seconds)
