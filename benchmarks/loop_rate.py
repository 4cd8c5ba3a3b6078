"""The closed loop with 10, 100 and 1,000 desired displacements a second: its crossover, measured on real processes.

A simulated stage stands still at a desired displacement that its model misses. When feedback is switched on, an
integral gain takes the error away exponentially, at the crossover of the loop. The stage starts anew for each rate, so
that it moves along the same branch. Times are the stamps of the stage: this process is too busy to tell when a reading
was made.
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
import rclpy
from builtin_interfaces.msg import Time
from nodes.ros_helpers import RELIABLE, on_graph, stage_model, started
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray

from slpi_ros.model.document import save_model

RATES = (10.0, 100.0, 1000.0)
# Where the stage is sent (m), and the integral gain (V/(m s)): about 20 rad/s for 0.1 um/V.
DESIRED, INTEGRAL = 5e-6, 2e8
SETTLING, SECONDS = 2.0, 1.0
# States that wait to be read, at most.
KEPT = 5000
# The part of the decay that is fitted, of the error at the begin.
PART = (0.8, 0.1)


def seconds(stamp: Time) -> float:
    """Return the time (s) of a stamp, since a day began."""
    return stamp.sec % 86400 + stamp.nanosec * 1e-9


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
        # Read at the end: an executor would take a core for the states.
        reader = rclpy.create_node("reader", context=graph.node.context)
        states = reader.create_subscription(JointState, "/stage_state", lambda state: None, KEPT)
        voltages: list[Float64MultiArray] = []
        listening = graph.node.create_subscription(Float64MultiArray, "/voltage_command", voltages.append, 1)
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
            graph.node.destroy_subscription(listening)
            time.sleep(SETTLING)
            assert simulator.process.poll() is None
            begun = seconds(graph.node.get_clock().now().to_msg())
            assert graph.set_parameters("/compensator", feedback=True) == ""
            time.sleep(SECONDS)
        finally:
            ends.set()
            sender.join()
        with states.handle:
            taken = iter(lambda: states.handle.take_message(JointState, False), None)
            t, y = np.array([(seconds(state.header.stamp), state.position[0]) for state, _ in taken]).T
        reader.destroy_node()
    error = np.abs(y - DESIRED)
    first = float(np.median(error[(t < begun) & (t > begun - 0.2)]))
    # From where the error has begun to fall, until it is near the noise.
    inner = np.flatnonzero((t > begun) & (error < PART[0] * first) & (error > PART[1] * first))
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
    parser.add_argument("--repeats", type=int, default=5)
    main(parser.parse_args().repeats)
