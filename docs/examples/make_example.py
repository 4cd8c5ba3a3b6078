"""Make the example beside this file: the bag xy_stage of a simulated stage, and the model that slpi identifies from it.

The bag holds a calibration of both axes, then a spiral that is compensated with the model of that calibration.
"""

import argparse
import subprocess
import sys
from pathlib import Path

import numpy as np

import slpi_ros
from slpi_ros.excitation.drives import excite
from slpi_ros.io.bag_writer import BagWriter, typestore
from slpi_ros.io.messages import SECOND_NS, encode_joint_states, serialise
from slpi_ros.simulation.stage import Stage

AXES, HARDWARE_ID, SEED = ("x", "y"), "xy-stage", 7
RATE_HZ, CALIBRATION_S, SPIRAL_S, TURNS = 100.0, 40.0, 12.0, 6.0
BEGIN_NS, VOLTAGES = 1_760_000_000_000_000_000, "std_msgs/msg/Float64MultiArray"


def spiral(t, start, centre, radius):
    """Return a path (m) of both axes, shape (N, 2): from `start` to `centre`, then around it, wider and wider."""
    there = np.clip(t / 2.0, 0.0, 1.0)
    wide = np.clip((t - 2.0) / (SPIRAL_S - 4.0), 0.0, 1.0)
    angle = 2 * np.pi * TURNS * wide
    around = np.column_stack([np.cos(angle), np.sin(angle)]) * np.sin(0.5 * np.pi * wide)[:, None]
    return start + (centre - start) * (0.5 - 0.5 * np.cos(np.pi * there))[:, None] + radius * around


def main(folder):
    stage = Stage.random(AXES, seed=SEED, noise_rms=8e-9)

    def run(t, v):
        return np.array([stage.measure(stage.step(when, now)) for when, now in zip(t, v, strict=True)])

    drive = excite(AXES, voltage_min=0.0, voltage_max=100.0, slew_limit=500.0, duration=CALIBRATION_S, rate=RATE_HZ)
    t = drive.t
    v = np.column_stack([drive.voltage[axis] for axis in AXES])
    y = run(t, v)
    stamps = BEGIN_NS + np.round(t * 1e9).astype(np.int64)
    record = slpi_ros.Record(stamps, *({axis: part[:, k] for k, axis in enumerate(AXES)} for part in (v, y)))
    model = slpi_ros.identify(record)
    ranges = np.array([model.axes[axis].displacement_range for axis in AXES])
    since = np.arange(1, round(SPIRAL_S * RATE_HZ) + 1) / RATE_HZ
    desired = spiral(since, y[-20:].mean(axis=0), ranges.mean(axis=1), 0.4 * np.ptp(ranges, axis=1))
    later = t[-1] + since
    given = model.compensate(later, {axis: desired[:, k] for k, axis in enumerate(AXES)})
    v2 = np.column_stack([given[axis] for axis in AXES])
    y2 = run(later, v2)
    print(f"measured - desired: {np.std(1e9 * (y2 - desired)[200:], axis=0).round(1)} nm rms")

    stamps2 = BEGIN_NS + np.round(later * 1e9).astype(np.int64)
    states = encode_joint_states(np.append(stamps, stamps2), np.vstack([y, y2]), np.vstack([v, v2]), AXES, HARDWARE_ID)
    wanted = [
        serialise(*divmod(stamp, SECOND_NS), "", len(AXES), *AXES, tuple(where), (), ())
        for stamp, where in zip(stamps2.tolist(), desired.tolist(), strict=True)
    ]
    types = typestore().types
    layout = types["std_msgs/msg/MultiArrayLayout"](dim=[], data_offset=0)
    with BagWriter(folder / "xy_stage") as bag:
        bag.add_topic("/voltage_command", VOLTAGES)
        bag.add_topic("/desired_displacement")
        for k, (stamp, state) in enumerate(zip([*stamps.tolist(), *stamps2.tolist()], states, strict=True)):
            volts = (v[k] if k < len(v) else v2[k - len(v)]).astype(np.float64)
            if k >= len(v):
                bag.write(stamp, wanted[k - len(v)], "/desired_displacement")
            command = typestore().serialize_cdr(types[VOLTAGES](layout=layout, data=volts), VOLTAGES)
            bag.write(stamp, bytes(command), "/voltage_command")
            bag.write(stamp, state)
    command = [sys.executable, "-m", "slpi_ros.cli", "identify", "xy_stage", "-o", "xy_stage.json"]
    subprocess.run(command, cwd=folder, check=True, stdout=subprocess.DEVNULL)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("-o", "--output", type=Path, default=Path(__file__).parent)
    main(parser.parse_args().output)
