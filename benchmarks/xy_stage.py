"""A simulated XY stage driven through the compensator over DDS: the MPI paper's five segments, and a scan in open loop.

Both nodes run in separate processes. Time is simulated, and each sample is sent after the stage has answered the
previous one, so that the results do not depend on the load of the machine.
"""

import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
import rclpy
from builtin_interfaces.msg import Time
from numpy.typing import NDArray
from paths import scan_path
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile
from rclpy.signals import SignalHandlerOptions
from rosgraph_msgs.msg import Clock
from round_trip import AXES, compensator, node
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray

import slpi_ros
from slpi_ros.excitation.drives import calibration_drive
from slpi_ros.model.axis_model import Start
from slpi_ros.model.stage_model import StageModel
from slpi_ros.nodes.common import make_executor
from slpi_ros.papers.compound import RATE, RECORD, RECORD_SAMPLES, WARM_UP, path, tune
from slpi_ros.papers.mpi_study import COMPOUND_MEAN, TABLE_6, triangle_record, triangles
from slpi_ros.simulation.stage import Stage, p11_stage

FloatArray = NDArray[np.float64]

DEPTH = QoSProfile(depth=100)
SECOND_NS = 1_000_000_000
FIRST_ANSWER_S = 5.0
# Scan of the quasi-static stage: seed, duration (s) and sample rate (Hz).
SEED, SCAN_S, SCAN_RATE = 3, 30.0, 200.0


class XyStage:
    """Client that drives the simulator and the compensator sample by sample, in simulated time."""

    def __init__(self) -> None:
        self._node = rclpy.create_node("xy_bench")
        self._executor = make_executor("events")
        self._executor.add_node(self._node)
        self._clock = self._node.create_publisher(Clock, "/clock", DEPTH)
        self._voltages = self._node.create_publisher(Float64MultiArray, "/bench/voltage_command", DEPTH)
        self._wishes = self._node.create_publisher(JointState, "/bench/desired_displacement", DEPTH)
        self._states: list[list[float]] = []
        self._node.create_subscription(JointState, "/bench/stage_state", self._on_state, DEPTH)
        self._now_ns = 0

    def close(self) -> None:
        """Shut down the executor and the node of the client."""
        self._executor.shutdown()
        self._node.destroy_node()

    def warm_up(self, amplitude: float) -> list[float]:
        """Drive the stage without compensator through cycles at 1 Hz that end at 0 V; return the last readings (m)."""
        for v in (*triangles(amplitude, 1.0, WARM_UP, RECORD_SAMPLES)[1].tolist(), 0.0):
            state = self._ask(self._voltages, Float64MultiArray(data=[v] * len(AXES)), RECORD_SAMPLES)
        return state

    def follow(self, desired: FloatArray, rate: float) -> FloatArray:
        """Return the readings for desired displacements, both of shape (N, axes), metres."""
        states, message = [], JointState(name=list(AXES))
        for row in desired.tolist():
            message.position = row
            states.append(self._ask(self._wishes, message, rate))
        return np.array(states)

    def _ask(self, publisher: Publisher, message: Float64MultiArray | JointState, rate: float) -> list[float]:
        """Advance the simulated clock, send a message, and return the readings that the stage publishes in response."""
        self._states.clear()
        while not self._states:
            self._now_ns += round(SECOND_NS / rate)
            now = Time(sec=self._now_ns // SECOND_NS, nanosec=self._now_ns % SECOND_NS)
            self._clock.publish(Clock(clock=now))
            if isinstance(message, JointState):
                message.header.stamp = now
            publisher.publish(message)
            # Until discovery is complete, the first message may have to be sent again.
            self._spin_for(FIRST_ANSWER_S)
        return self._states[0]

    def _on_state(self, state: JointState) -> None:
        self._states.append(list(state.position))

    def _spin_for(self, seconds: float) -> None:
        deadline = time.monotonic() + seconds
        while not self._states and time.monotonic() < deadline:
            self._executor.spin_once(timeout_sec=seconds)


@contextmanager
def simulator(**parameters: object) -> Iterator[XyStage]:
    """Run the simulated stage on the simulated clock."""
    given = {"axes": list(AXES), "use_sim_time": True, **parameters}
    options = [part for name, value in given.items() for part in ("-p", f"{name}:={value}".replace("'", '"'))]
    with node("bench", "-m", "slpi_ros.nodes.start", "stage_simulator", "--ros-args", *options):
        stage = XyStage()
        try:
            yield stage
        finally:
            stage.close()


def segments(models: Mapping[str, slpi_ros.AxisModel], feedback: bool) -> str:
    """Follow the five segments on the stage with creep and resonance; return the errors as text."""
    top = max(RECORD)
    stages = p11_stage().axes
    gains = [tune(stages[axis].parameters, models[axis].displacement_range[1] / top) for axis in AXES]
    told = {"kp": [each.proportional for each in gains], "ki": [each.integral for each in gains]}
    limits = {"voltage_min": -20.0, "voltage_max": 150.0}
    with simulator(preset="p11", **limits) as stage:
        zero = stage.warm_up(top)
        warm = {a: replace(models[a], start=Start(0.0, z, (0.0,)), end=None) for a, z in zip(AXES, zero, strict=True)}
        loop = {"feedback": feedback, "measurement_timeout": 10.0, **told}
        remap = ["measured_displacement:=stage_state"]
        with compensator("bench", StageModel(warm), remap=remap, **limits, **loop):
            desired = path([(peak * 1e-6, frequency) for peak, frequency in TABLE_6], 3)[:, None] + np.array(zero)
            return described(stage.follow(desired, RATE) - desired)


def scan() -> str:
    """Scan a stage that has hysteresis only, without feedback; return the errors as text."""
    t, v = calibration_drive(0.0, 100.0, duration=120.0, rate=200.0, seed=SEED)
    drawn = Stage.random(AXES, SEED).axes
    stamps = np.round(t * 1e9).astype(np.int64)
    readings = {axis: drawn[axis].run(t, v)[1] for axis in AXES}
    model = slpi_ros.identify(slpi_ros.Record(stamps, dict.fromkeys(AXES, v), readings))
    strokes = np.array([drawn[axis].parameters.stroke for axis in AXES])
    columns = [
        scan_path(0.1 * stroke, 0.9 * stroke, duration=SCAN_S, rate=SCAN_RATE, seed=i)[1]
        for i, stroke in enumerate(strokes)
    ]
    with simulator(seed=SEED, noise_rms=0.0) as stage, compensator("bench", model):
        desired = np.column_stack(columns)
        errors = stage.follow(desired, SCAN_RATE) - desired
        shares = 100.0 * np.abs(errors) / strokes
        return f"{described(errors)}; mean {shares.mean(axis=0)} %, max {shares.max(axis=0)} % of stroke"


def described(errors: FloatArray) -> str:
    """Return mean and maximum of errors, shape (N, axes), metres, as text."""
    apart = np.abs(errors) * 1e6
    means = ", ".join(f"{axis} {mean:.4f} um" for axis, mean in zip(AXES, apart.mean(axis=0), strict=True))
    return f"{len(errors)} samples, mean error {means}; max {apart.max():.3f} um"


def main() -> None:
    """Print the results."""
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    np.set_printoptions(precision=3)
    models = {}
    for axis, stage in p11_stage().axes.items():
        models[axis] = slpi_ros.identify(triangle_record(stage, axis, RECORD, 1.0, RECORD_SAMPLES), start=1.0).axis(
            axis
        )
    print(f"five segments of 60 to 100 um, 1 to 3 Hz, 3 cycles each; the paper's mean error: {COMPOUND_MEAN} um")
    for feedback in (True, False):
        print(f"feedback {'on' if feedback else 'off'}: {segments(models, feedback)}", flush=True)
    print(f"hysteresis only, feedback off: {scan()}")
    rclpy.try_shutdown()


if __name__ == "__main__":
    main()
