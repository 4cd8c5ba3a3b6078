"""The closed loop with 10, 100 and 1,000 desired displacements a second: its crossover, measured on real processes.

A simulated stage stands still at a desired displacement that its model misses. When feedback is switched on, an
integral gain takes the error away exponentially, at the crossover of the loop. The stage starts anew for each rate, so
that it moves along the same branch.
"""

import argparse
import os
import random
import sys
import tempfile
import threading
import time
from pathlib import Path

sys.path.append(str(Path(__file__).resolve().parents[1] / "test"))

import numpy as np
from nodes.ros_helpers import RELIABLE, on_graph, stage_model, started
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray

from slpi_ros.model.document import save_model

RATES = (10.0, 100.0, 1000.0)
# Where the stage is sent (m), and the integral gain (V/(m s)): about 20 rad/s for 0.1 um/V.
DESIRED, INTEGRAL = 5e-6, 2e8
SETTLING, SECONDS = 2.0, 1.0
# The part of the decay that is fitted, of the error at the begin.
PART = (0.8, 0.1)


def crossover(rate: float, model_file: str) -> tuple[float, float]:
    """Return crossover (rad/s) and error at the begin (m) with `rate` desired displacements a second."""
    stage = {"rate": 1000.0, "answer_commands": False, "noise_rms": 1e-9, "seed": 7}
    loop = {
        "model_file": model_file, "ki": INTEGRAL, "correction_limit": 100.0, "feedback_fault_time": 0.0,
        "slew_limit": 0.0, "start_voltage": "saved", "drift_alarm": 0.0, "accept_stage": "simulated-7",
    }  # fmt: skip
    remapped = ("--ros-args", "-r", "measured_displacement:=stage_state")
    with (
        on_graph() as graph,
        started("stage_simulator", stage) as simulator,
        started("compensator", loop, *remapped) as compensator,
    ):
        graph.tested = compensator
        desired = graph.publisher(JointState, "/desired_displacement", RELIABLE)
        states: list[tuple[float, float]] = []
        graph.node.create_subscription(
            JointState, "/stage_state", lambda state: states.append((time.monotonic(), state.position[0])), 1000
        )
        voltages: list[Float64MultiArray] = []
        graph.node.create_subscription(Float64MultiArray, "/voltage_command", voltages.append, 1000)
        ends = threading.Event()

        def send() -> None:
            begun, count = time.monotonic(), 0
            while not ends.wait(max(begun + count / rate - time.monotonic(), 0.0)):
                message = JointState(name=["x"], position=[DESIRED])
                message.header.stamp = graph.node.get_clock().now().to_msg()
                desired.publish(message)
                count += 1

        sender = threading.Thread(target=send)
        sender.start()
        try:
            # The compensator looks first who else is there.
            while not voltages:
                graph.spin_for(0.1)
            graph.spin_for(SETTLING)
            assert simulator.process.poll() is None
            before = len(states)
            assert graph.set_parameters("/compensator", feedback=True) == ""
            graph.spin_for(SECONDS)
        finally:
            ends.set()
            sender.join()
    t, y = np.array(states[max(before - 200, 0) :]).T
    error = np.abs(y - DESIRED)
    first = float(np.median(error[:100]))
    # From where the error has begun to fall, until it is near the noise.
    inner = np.flatnonzero((error < PART[0] * first) & (error > PART[1] * first))
    inner = inner[inner < inner[0] + int(np.argmax(error[inner[0] :] < PART[1] * first))]
    return -float(np.polyfit(t[inner], np.log(error[inner]), 1)[0]), first


def main(repeats: int) -> None:
    """Print the table."""
    os.environ.setdefault("ROS_DOMAIN_ID", str(random.Random(os.getpid()).randrange(1, 100)))
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "model.json"
        save_model(stage_model(), path)
        print("desired/s  crossover rad/s (median, least, most)  error before nm", flush=True)
        for rate in RATES:
            found = [crossover(rate, str(path)) for _ in range(repeats)]
            values = sorted(value for value, _ in found)
            print(
                f"{rate:9.0f}  {np.median(values):7.2f} {values[0]:7.2f} {values[-1]:7.2f}  {found[0][1] * 1e9:20.0f}",
                flush=True,
            )


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeats", type=int, default=3)
    main(parser.parse_args().repeats)
