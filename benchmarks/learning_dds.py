"""A raster of 5 Hz that comes again, over DDS: the error that the compensator tells of each pass, also over a kill -9.

Nodes are those of the package: ``stage_simulator`` as it comes (8 nm of sensor noise), ``compensator`` with ``learn``.
The model is identified from a calibration record of the same stage. Each pass is a trajectory of its own. After half of
the passes the compensator is killed and started again. The error is the measured one, noise included: rms without the
mean and the drift of the pass. Voltages and readings are timed by this computer: a sample that is late by `d` is wrong
by `d` times the speed of the path.
"""

import argparse
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

# Before rclpy is loaded: the bench keeps to this machine, and to a domain of its own.
os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
os.environ.setdefault("ROS_DOMAIN_ID", str(60 + os.getpid() % 40))

import numpy as np
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from numpy.typing import NDArray
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import QoSProfile
from trajectory_msgs.msg import JointTrajectory

import slpi_ros
from slpi_ros.excitation.drives import calibration_drive
from slpi_ros.io.messages import encode_trajectory
from slpi_ros.io.record import Record
from slpi_ros.simulation.stage import Stage

FloatArray = NDArray[np.float64]
SEED, NOISE, HERTZ, RATE = 0, 8e-9, 5.0, 1000.0
PAUSE_S, PATIENCE_S, MOST_TRIES = 0.4, 60.0, 20


def identified() -> slpi_ros.StageModel:
    """Return the model of the simulated stage, from a record of its own."""
    t, v = calibration_drive(0.0, 100.0, duration=20.0, rate=500.0, seed=1)[:2]
    stage = Stage.random(["x"], SEED, NOISE)
    y = np.array([stage.measure(stage.step(at, [volt]))[0] for at, volt in zip(t, v, strict=True)])
    return slpi_ros.identify(Record(np.round(1e9 * np.asarray(t)).astype(np.int64), {"x": v}, {"x": y}))


def raster(model: slpi_ros.StageModel, share: float) -> FloatArray:
    """Return one pass (m, (N + 1,)) over a share of the stroke, turns rounded, which ends where it begins."""
    low, high = model.axes["x"].displacement_range
    n = round(RATE / HERTZ)
    spectrum = np.fft.rfft(1 - 2 * np.abs(2 * np.arange(n) / n - 1))
    turned = np.fft.irfft(spectrum * np.exp(-((0.08 * np.arange(spectrum.size)) ** 2)), n)
    return 0.5 * (low + high) + 0.5 * share * (high - low) * np.append(turned, turned[0])


@contextmanager
def node(name: str, *remapped: str, **parameters: object) -> Iterator["subprocess.Popen[bytes]"]:
    """Run a node until the block ends."""
    words = [part for key, value in parameters.items() for part in ("-p", f"{key}:={value}")]
    words += [part for each in remapped for part in ("-r", each)]
    command = [sys.executable, "-m", "slpi_ros.nodes.start", name, "--ros-args", "--log-level", "error", *words]
    process = subprocess.Popen(command, start_new_session=True)
    try:
        yield process
    finally:
        if process.poll() is None:
            process.send_signal(signal.SIGINT)
        process.wait(20.0)


class Sender:
    """Sends a path, and hears what the compensator tells of its passes."""

    def __init__(self, path: FloatArray) -> None:
        self._node = rclpy.create_node("learning_bench")
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(self._node)
        self._publisher = self._node.create_publisher(JointTrajectory, "desired_trajectory", QoSProfile(depth=10))
        self._node.create_subscription(DiagnosticArray, "/diagnostics", self._hear, QoSProfile(depth=100))
        times = np.round(np.arange(path.size) * 1e9 / RATE).astype(np.int64)
        self._message = encode_trajectory(0, ["x"], times, path[:, None], np.zeros((path.size, 0)))
        self._told: dict[str, str] = {}
        self.dropped = 0

    def _hear(self, array: DiagnosticArray) -> None:
        for status in array.status:
            values = {pair.key: pair.value for pair in status.values}
            if status.name == "/compensator: compensator":
                self._told = values

    def _spin(self, seconds: float) -> None:
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            self._executor.spin_once(timeout_sec=0.02)

    def begin(self) -> None:
        """Wait for the compensator."""
        self._told, end = {}, time.monotonic() + PATIENCE_S
        while self._told.get("state") != "active" or not self._publisher.get_subscription_count():
            if time.monotonic() > end:
                raise SystemExit("the compensator did not come")
            self._spin(0.1)
        self._spin(1.0)

    def follow(self) -> dict[str, str]:
        """Send the path until a pass of it was told; return what was told."""
        before = self._told.get("x.learn_pass", "")
        for _ in range(MOST_TRIES):
            self._publisher.publish(self._message)
            self._spin(1.0 / HERTZ + PAUSE_S)
            if self._told.get("x.learn_pass", "") != before:
                return self._told
            self.dropped += 1
        return self._told


def main() -> int:
    """Print the error of each pass; return 1 if the last ones are above 1.5 times the noise."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--passes", type=int, default=20)
    parser.add_argument("--share", type=float, default=0.3, help="of the stroke that the raster covers")
    options = parser.parse_args()
    rclpy.init()
    model = identified()
    path, errors = raster(model, options.share), []
    with tempfile.TemporaryDirectory() as folder, node("stage_simulator", seed=SEED, noise_rms=NOISE):
        file, memory = Path(folder) / "model.json", Path(folder) / "memory.json"
        slpi_ros.save_model(model, file)
        given = {
            "model_file": file, "memory_file": memory, "learn": "on", "output_rate": RATE, "slew_limit": 1e4,
            "start_voltage": "auto", "start_memory": "start", "diagnostic_period": 0.1, "voltage_max": 100.0,
        }  # fmt: skip
        sender, half = Sender(path), options.passes // 2
        for part in (range(half), range(half, options.passes)):
            with node("compensator", "measured_displacement:=stage_state", **given) as compensator:
                sender.begin()
                for number in part:
                    told = sender.follow()
                    errors.append(float(told.get("x.learn_error_nm", "nan")))
                    said = f"{told.get('x.learn_limited_by', '')}; {told.get('x.learn_reason', '')}"
                    print(
                        f"sent {number + 1:>3}: pass {told.get('x.learn_pass', '-'):>3} {errors[-1]:>8.1f} nm  {said}"
                    )
                if part.start == 0:
                    compensator.send_signal(signal.SIGKILL)
                    print("kill -9")
    span = 1e6 * float(np.ptp(path))
    said = f"raster of {HERTZ:g} Hz over {span:.1f} um, noise {1e9 * NOISE:g} nm: last {errors[-1]:.1f} nm, least"
    print(f"{said} {np.nanmin(errors):.1f} nm; {sender.dropped} passes sent again (load {os.getloadavg()[0]:.1f})")
    rclpy.try_shutdown()
    return int(not np.nanmin(errors) <= 1.5e9 * NOISE)


if __name__ == "__main__":
    sys.exit(main())
