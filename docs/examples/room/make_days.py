"""Make two bags of a simulated stage in a room, monday and tuesday: stage_state, and what stands beside it.

The stage expands by 0.3 µm for each kelvin. Its thermometer is slow, and the humidity drifts, which does nothing.
"""

import argparse
from pathlib import Path

import numpy as np

from slpi_ros.excitation.drives import calibration_drive
from slpi_ros.io.bag_writer import BagWriter, typestore
from slpi_ros.io.messages import encode_joint_states
from slpi_ros.simulation.character import Character
from slpi_ros.simulation.room import Room, RoomSensor
from slpi_ros.simulation.stage import Stage

EXPANSION, NOISE, SEED = 3e-7, 8e-9, 3
RATE_HZ, DURATION_S, BEGIN_NS, DAY_S = 50.0, 1200.0, 1_760_000_000_000_000_000, 86_400.0
# Topic, message type, its field, and the sensor.
BESIDE = {
    "/room/temperature": ("Temperature", "temperature", RoomSensor(interval=2.0, lag=4.0, noise=0.02, seed=1)),
    "/room/humidity": ("RelativeHumidity", "relative_humidity", RoomSensor(interval=5.0, noise=0.001, seed=2)),
}


def reading(kind, field, stamp, value):
    """Return a message of sensor_msgs with one value."""
    types = typestore().types
    time = types["builtin_interfaces/msg/Time"](*divmod(stamp, 10**9))
    header = types["std_msgs/msg/Header"](stamp=time, frame_id="room")
    name = f"sensor_msgs/msg/{kind}"
    return typestore().serialize_cdr(types[name](header=header, variance=0.0, **{field: value}), name)


def main(folder):
    room = Room(SEED, swing=0.5)
    stage = Stage.of(["x"], [Character(temperature_offset=EXPANSION)], SEED, NOISE, room)
    for number, day in enumerate(("monday", "tuesday")):
        t, v = calibration_drive(0.0, 100.0, duration=DURATION_S, rate=RATE_HZ, seed=number)
        since = number * DAY_S + t
        y = np.array([stage.measure(stage.step(when, [volts])) for when, volts in zip(since, v, strict=True)])
        stamps = BEGIN_NS + np.round(since * 1e9).astype(np.int64)
        states = encode_joint_states(stamps, y, v[:, None], ("x",), "bench-1")
        messages = [(stamp, message, "/stage_state") for stamp, message in zip(stamps.tolist(), states, strict=True)]
        with BagWriter(folder / day, replace=True) as bag:
            for topic, (kind, field, sensor) in BESIDE.items():
                bag.add_topic(topic, f"sensor_msgs/msg/{kind}")
                at = sensor.times(since[0], since[-1])
                value = sensor.read(at, getattr(room, field.removeprefix("relative_"))(at))
                ns = (BEGIN_NS + np.round(at * 1e9).astype(np.int64)).tolist()
                pairs = zip(ns, value.tolist(), strict=True)
                messages += [(stamp, reading(kind, field, stamp, one), topic) for stamp, one in pairs]
            for stamp, message, topic in sorted(messages, key=lambda one: one[0]):
                bag.write(stamp, message, topic)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", nargs="?", default=".", type=Path, help="default: here")
    main(parser.parse_args().folder)
