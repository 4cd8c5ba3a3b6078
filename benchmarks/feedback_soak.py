"""A compensator at 1 kHz on two axes for a long time, with feedback, new models and trajectories.

The measured displacement is computed here, from the voltages that come back, on a stage that drifts and is not quite
the model. Wrong is a voltage outside of its limits, a message without an answer, a point of a trajectory that is not
executed, a count that does not match, and a memory that grows.
"""

import random
import struct
import tempfile
import time
from collections import Counter
from collections.abc import Sequence
from math import pi, sin
from pathlib import Path

import numpy as np
import rclpy
from builtin_interfaces.msg import Duration
from diagnostic_msgs.msg import DiagnosticArray
from nodes.ros_helpers import LATCHED, RELIABLE, started, values_of
from rclpy.serialization import serialize_message
from rclpy.signals import SignalHandlerOptions
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray, String
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from benchmarks.node_lives import AXES, HIGH, LOW, MS, START_NS, require_limits, shape, stage
from slpi_ros.hysteresis.turning_points import Memory
from slpi_ros.model.document import format_model, save_model
from slpi_ros.nodes.common import make_executor

# Messages on their way: fewer than the queues of the node hold, so that a busy machine loses none. How many have come
# the node reports every 50 ms: feedback publishes voltages between the answers, too.
AHEAD, REPORT_S = 80, 0.05
# Samples from one trajectory and from one model to the next, points of a trajectory, and samples at one displacement
# before it, so that both axes are at rest; 1 ms each.
TRAJECTORY_EVERY, MODEL_EVERY, POINTS, REST = 20_000, 7_000, 1_000, 300
# Growth of the node's memory that counts as a leak, KiB, and the share of the run before it is measured.
LEAK, WARM = 4096, 0.25
PATIENCE_S = 30.0


class Soak:
    """One long run: its node, what was sent and what came back."""

    def __init__(self, pid: int, seed: int) -> None:
        self.pid, self.rng = pid, random.Random(seed)
        self.counts: Counter[str] = Counter()
        self.top = 0.9 * stage().axes["x"].displacement_range[1]
        self.now = START_NS
        # Voltages during a trajectory; None while there is none.
        self._points: list[Sequence[float]] | None = None
        self.resident: list[int] = []
        self.report: dict[str, str] = {}
        self._stages = [Memory(shape(0.99)) for _ in AXES]
        self._node = rclpy.create_node("soak_client")
        self._executor = make_executor("events")
        self._executor.add_node(self._node)
        create = self._node.create_publisher
        self._desired = create(JointState, "/soak/desired_displacement", RELIABLE)
        self._measured = create(JointState, "/soak/measured_displacement", RELIABLE)
        self._trajectories = create(JointTrajectory, "/soak/desired_trajectory", RELIABLE)
        self._models = create(String, "/soak/stage_model", LATCHED)
        self._node.create_subscription(
            Float64MultiArray, "/soak/voltage_command", self._on_voltages, RELIABLE, raw=True
        )
        self._node.create_subscription(DiagnosticArray, "/diagnostics", self._on_report, RELIABLE)
        marks = (1.2345, 5.4321)
        self._message = bytearray(serialize_message(JointState(name=AXES, position=marks)))
        self._positions_at = self._message.index(struct.pack("=2d", *marks))

    def close(self) -> None:
        """Shut down the client."""
        self._executor.shutdown()
        self._node.destroy_node()

    def wrong(self, what: str) -> None:
        """Count and print what is wrong."""
        self.counts["wrong"] += 1
        if self.counts["wrong"] <= 20:
            print(f"wrong: soak at {(self.now - START_NS) * 1e-9:.3f} s: {what}", flush=True)

    def until(self, done: object, what: str) -> None:
        """Serve callbacks until `done`."""
        deadline = time.monotonic() + PATIENCE_S
        while not done():  # type: ignore[operator]
            if time.monotonic() > deadline:
                self.wrong(f"waited in vain for {what}; the last report: {self.report}")
                return
            self._executor.spin_once(timeout_sec=0.02)

    def connect(self) -> None:
        """Wait until nothing that is sent can be lost."""
        self.until(lambda: self.report.get("state") == "active", "the node")
        publishers = (self._desired, self._measured, self._trajectories, self._models)
        self.until(lambda: all(each.get_subscription_count() for each in publishers), "its subscriptions")

    def run(self, minutes: float) -> None:
        """Send a sample a millisecond for some minutes of stamps."""
        t = np.arange(10_000) / 1000.0
        waves = np.sin(2 * pi * t) * (0.7 + 0.3 * np.sin(0.2 * pi * t))
        path = ((0.5 + 0.45 * waves) * self.top).tolist()
        due = time.monotonic()
        for k in range(round(minutes * 60_000)):
            if k % TRAJECTORY_EVERY == TRAJECTORY_EVERY // 2:
                self._follow(path[k % len(path)])
                due = time.monotonic()
            if k % MODEL_EVERY == MODEL_EVERY // 2:
                text = format_model(stage(self.rng.uniform(0.98, 1.02), f"model {k}"))
                self._models.publish(String(data=text))
                self.counts["models"] += 1
            if k % 1000 == 0:
                pages = int(Path(f"/proc/{self.pid}/statm").read_text().split()[1])
                self.resident.append(pages * 4)
            if k % 300_000 == 299_999:
                print(f"soak: {k + 1} samples, {self.counts['wrong']} wrong", flush=True)
            self._send(path[k % len(path)])
            due += 1e-3
            while (left := due - time.monotonic()) > 0.0:
                self._executor.spin_once(timeout_sec=left)
            if k % 8 == 0:
                self._executor.spin_once(timeout_sec=0.0)
            # After a time without the processor, samples follow as fast as they are answered.
            due = max(due, time.monotonic() - 1.0)
        self.until(lambda: not self._pending(), "the last answers")

    def _pending(self) -> int:
        """Return how many samples have not come yet."""
        return self.counts["samples"] - int(self.report.get("received", 0))

    def _send(self, y: float) -> None:
        if self._pending() >= AHEAD:
            self.until(lambda: self._pending() < AHEAD, "answers")
        self.now += MS
        self._desired.publish(self._filled(self.now, y, 0.8 * y))
        self.counts["samples"] += 1

    def _filled(self, stamp_ns: int, *positions: float) -> bytes:
        struct.pack_into("=iI", self._message, 4, *divmod(stamp_ns, 1_000_000_000))
        struct.pack_into("=2d", self._message, self._positions_at, *positions)
        return bytes(self._message)

    def _follow(self, y: float) -> None:
        """Come to rest at a displacement (m), and follow a trajectory of a second from there and back."""
        for _ in range(REST):
            self._send(y)
        self.until(lambda: not self._pending(), "answers before a trajectory")
        message = JointTrajectory(joint_names=AXES)
        for k in range(POINTS):
            part = y + 0.05 * self.top * (1.0 - np.cos(2 * pi * k / POINTS)) * (1.0 if y < 0.5 * self.top else -1.0)
            moment = Duration(sec=(k + 1) // 1000, nanosec=(k + 1) % 1000 * MS)
            message.points.append(JointTrajectoryPoint(positions=[part, 0.8 * part], time_from_start=moment))
        skipped = int(self.report.get("points_skipped", 0))
        self.counts["trajectories"] += 1
        done = str(self.counts["trajectories"])
        self._points = []
        self._trajectories.publish(message)

        def over() -> bool:
            report = self.report
            if report.get("trajectories") != done or report.get("points_remaining") != "0":
                return False
            return len(self._points or ()) + int(report["points_skipped"]) - skipped >= POINTS

        self.until(over, "the points of a trajectory, executed or counted as skipped")
        points, self._points = self._points, None
        self.counts["points"] += len(points)
        self.counts["points skipped"] += POINTS - len(points)
        for voltages in points:
            self.now += MS
            self._judge(voltages)
        for _ in range(REST):
            self._send(y)

    def _on_voltages(self, data: bytes) -> None:
        voltages = struct.unpack("=2d", data[-16:])
        if self._points is not None:
            self._points.append(voltages)
        else:
            self.counts["voltages"] += 1
            self._judge(voltages)
        drift = 20e-9 * sin(self.now * 1e-9 / 60.0)
        position = [
            memory.forward(v) + drift + self.rng.gauss(0.0, 3e-9)
            for memory, v in zip(self._stages, voltages, strict=True)
        ]
        self._measured.publish(self._filled(self.now, *position))

    def _judge(self, voltages: Sequence[float]) -> None:
        try:
            require_limits(voltages)
        except AssertionError as error:
            self.wrong(str(error))

    def _on_report(self, array: DiagnosticArray) -> None:
        for status in array.status:
            if status.name.startswith("/soak/compensator"):
                self.report = values_of(status)


def soak(minutes: float, seed: int) -> list[tuple[str, Counter[str]]]:
    """Run for some minutes; return what was tried and what was wrong."""
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    with tempfile.TemporaryDirectory() as folder:
        path, memory = Path(folder) / "model.json", Path(folder) / "memory.json"
        save_model(stage(), path)
        given = {
            "axes": AXES, "model_file": str(path), "memory_file": str(memory), "voltage_min": LOW, "voltage_max": HIGH,
            "slew_limit": 0.0, "feedback": True, "ki": 2e8, "kp": 1e6, "diagnostic_period": REPORT_S,
        }  # fmt: skip
        with started("compensator", given, "-r", "__ns:=/soak") as node:
            one = Soak(node.process.pid, seed)
            one.connect()
            began = time.monotonic()
            one.run(minutes)
            took = time.monotonic() - began
            # The memory of the last second, and the counters after it.
            one.report = {}
            one.until(lambda: one.report.get("accepted") == str(one.counts["samples"]), "the last count of the node")
            if (one.report.get("received"), one.report.get("rejected")) != (str(one.counts["samples"]), "0"):
                one.wrong(f"{one.counts['samples']} samples sent, counted: {one.report}")
            if int(one.report.get("models_refused", -1)) or int(one.report.get("trajectories_rejected", -1)):
                one.wrong(f"refused: {one.report}")
            code = node.stop()
            if code or "Traceback" in node.stderr:
                one.wrong(f"exit code {code}: {node.stderr[-500:]}")
            grown = one.resident[-1] - one.resident[int(WARM * len(one.resident))]
            if grown > LEAK:
                one.wrong(f"the memory of the node has grown by {grown} KiB")
            one.close()
    rclpy.try_shutdown()
    print(
        f"soak: {one.counts['voltages'] / took:.0f} voltages/s for {took / 60:.1f} min, memory {grown:+d} KiB",
        flush=True,
    )
    rows = [("soak at 1 kHz, samples", Counter(tried=one.counts["samples"], wrong=one.counts["wrong"]))]
    rows += [
        (f"  {name}", Counter(tried=one.counts[name]))
        for name in ("models", "trajectories", "points", "points skipped")
    ]
    return rows
