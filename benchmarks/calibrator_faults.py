"""Calibrations over DDS that meet a fault at a random moment: is the stage safe, and what was recorded kept."""

import argparse
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

# Before rclpy is loaded: the benchmark keeps to this machine, and to a domain of its own.
os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
os.environ.setdefault("ROS_DOMAIN_ID", str(60 + os.getpid() % 40))

import rclpy  # noqa: E402
from faulty_stage import FAULTS, QOS, FaultyStage  # noqa: E402
from rclpy.executors import SingleThreadedExecutor  # noqa: E402
from std_msgs.msg import Float64MultiArray  # noqa: E402

LOW, HIGH, SLEW, RATE, REST = -10.0, 90.0, 300.0, 100.0, 5.0
# Latest time of a fault after the first command; longest time to the end of the node; seconds.
LATEST, PATIENCE = 12.0, 60.0
KINDS = (*FAULTS, "second publisher", "signal", "killed and resumed", "disk full")


def start(folder: Path, resume: bool = False) -> subprocess.Popen[str]:
    """Start the calibrator."""
    values = {
        "voltage_min": LOW, "voltage_max": HIGH, "slew_limit": SLEW, "rate": RATE, "rest_voltage": REST,
        "output": folder, "resume": str(resume).lower(),
    }  # fmt: skip
    given = [part for name, value in values.items() for part in ("-p", f"{name}:={value}")]
    command = [sys.executable, "-m", "slpi_ros.nodes.start", "calibrator", "--ros-args", *given]
    return subprocess.Popen(command, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True)


def one(kind: str, rng: np.random.Generator, folder: Path) -> tuple[list[str], str]:
    """Return what went wrong in one calibration with a fault, and its last line."""
    node = rclpy.create_node("faults")
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    stage, output = FaultyStage(node), folder / "out"
    process = start(output)

    def spin(until: Callable[[], bool], seconds: float) -> bool:
        end = time.monotonic() + seconds
        while not until() and time.monotonic() < end:
            executor.spin_once(timeout_sec=0.02)
        return until()

    try:
        spin(lambda: bool(stage.commands), PATIENCE)
        after = float(rng.uniform(0.5, LATEST))
        spin(lambda: process.poll() is not None, after)
        if kind in FAULTS:
            stage.fault = kind
        elif kind == "second publisher":
            node.create_publisher(Float64MultiArray, "voltage_command", QOS)
        elif kind == "signal":
            process.send_signal(signal.SIGTERM)
        elif kind == "disk full":
            # A limit on the size of files written from now on acts as a full disk.
            subprocess.run(["prlimit", f"--pid={process.pid}", "--fsize=65536"], check=True)
        else:
            process.kill()
            process.communicate()
            count = len(stage.commands)
            process = start(output, resume=True)
            spin(lambda: len(stage.commands) > count or process.poll() is not None, PATIENCE)
            spin(lambda: process.poll() is not None, after)
            process.send_signal(signal.SIGTERM)
        ended = spin(lambda: process.poll() is not None, PATIENCE)
        if not ended:
            process.kill()
        said = process.communicate()[1].strip().splitlines()
        spin(lambda: False, 0.2)
    finally:
        executor.shutdown()
        node.destroy_node()
    wrong = stage.harm(LOW, HIGH, SLEW, RATE, REST)
    if not ended or process.returncode != 1:
        wrong.append(f"exit code {process.returncode}")
    if any("Traceback" in line for line in said):
        wrong.append("a traceback")
    if any("step 2:" in line for line in said) and not (output / "01_check").is_dir():
        wrong.append("a record lost")
    return wrong, said[-1] if said else ""


def faults(count: int) -> None:
    """Print a table of calibrations with a fault."""
    rclpy.init()
    good = 0
    for number in range(count):
        kind = KINDS[number % len(KINDS)]
        with tempfile.TemporaryDirectory() as folder:
            wrong, last = one(kind, np.random.default_rng([number, 30]), Path(folder))
        good += not wrong
        print(f"{kind:20} {'; '.join(wrong) or 'safe':24} {last}", flush=True)
    print(f"\n{good} of {count} faults: within limits and slew limit, at rest at the end, what was recorded is kept")
    rclpy.shutdown()


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--faults", type=int, default=30, help="calibrations with a fault")
    faults(parser.parse_args().faults)
