"""A stage on the ROS graph that obeys until it is told to fail, and keeps all commands that it was given."""

import math
import time
from typing import Any

import numpy as np
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray

QOS = QoSProfile(depth=1000, reliability=ReliabilityPolicy.RELIABLE)
# "silent": no states. The others falsify reading, voltage or stamp.
FAULTS = ("silent", "nan", "absurd", "frozen", "flipped", "moved", "wild", "effort 0", "clock")
# Without a command for this time it reports by itself, as a driver does, seconds. Voltage before the first command.
QUIET, AT_FIRST = 0.05, 20.0


class FaultyStage:
    """One axis without hysteresis; answers each command.

    Parameters
    ----------
    node : rclpy.node.Node
        Node that publishes and subscribes.
    frame_id : str
        Name of the stage.

    Attributes
    ----------
    fault : str
        One of `FAULTS`, or "" while all is well.
    commands, times : list of float
        Voltages (V) and their arrival (s, monotonic).
    """

    def __init__(self, node: Any, frame_id: str = "") -> None:
        self.fault, self._frame_id = "", frame_id
        self.commands: list[float] = []
        self.times: list[float] = []
        self._node, self._rng = node, np.random.default_rng(0)
        self._publisher = node.create_publisher(JointState, "stage_state", QOS)
        self._subscription = node.create_subscription(Float64MultiArray, "voltage_command", self._on_command, QOS)
        self._timer = node.create_timer(0.02, self._report)

    def _report(self) -> None:
        if not self.times or time.monotonic() - self.times[-1] > QUIET:
            self._answer(self.commands[-1] if self.commands else AT_FIRST)

    def _on_command(self, command: Float64MultiArray) -> None:
        (v,) = command.data
        self.commands.append(v)
        self.times.append(time.monotonic())
        self._answer(v)

    def _answer(self, v: float) -> None:
        if self.fault == "silent":
            return
        y = 0.2e-6 * v + self._rng.normal(0.0, 5e-9)
        y = {"nan": math.nan, "absurd": 3.0, "frozen": 1e-6, "flipped": -y, "moved": y + 1e-3}.get(self.fault, y)
        reported = {"wild": 500.0, "effort 0": 0.0}.get(self.fault, v)
        state = JointState(name=["x"], position=[y], effort=[reported])
        state.header.frame_id = self._frame_id
        state.header.stamp = self._node.get_clock().now().to_msg()
        state.header.stamp.sec += 3600 if self.fault == "clock" else 0
        self._publisher.publish(state)

    def harm(self, low: float, high: float, slew: float, rate: float, rest: float) -> list[str]:
        """Return what the commands did wrong: beyond the limits, too fast, or not at rest at the end.

        Parameters
        ----------
        low, high : float, volts
        slew : float, V/s
            Limit; from one command to the next the voltage may move as far as in two periods.
        rate : float, hertz
        rest : float, volts
        """
        v, t = np.array(self.commands), np.array(self.times)
        found = []
        if v.min() < low or v.max() > high:
            found.append(f"{v.min():.4g} to {v.max():.4g} V")
        if np.abs(np.diff(v)).max(initial=0.0) > 2 * slew / rate * (1 + 1e-9):
            found.append(f"a step of {np.abs(np.diff(v)).max():.3g} V")
        window = int(0.3 * rate)
        if v.size > window:
            fastest = np.abs(v[window:] - v[:-window]) / np.maximum(t[window:] - t[:-window], 0.2)
            if fastest.max() > slew:
                found.append(f"{fastest.max():.4g} V/s")
        if abs(v[-1] - rest) > 1e-3:
            found.append(f"left at {v[-1]:.4g} V")
        return found
