"""Time of an identification beside the time rosbags needs to read the same bag message by message."""

import tempfile
import time
from pathlib import Path

from accuracy import calibrated
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore

import slpi_ros
from slpi_ros.bags import write_bag


def read_by_message(path: Path) -> int:
    """Deserialise every message as a rosbags user would; return how many."""
    with AnyReader([path], default_typestore=get_typestore(Stores.ROS2_JAZZY)) as reader:
        return sum(1 for c, _, raw in reader.messages() if reader.deserialize(raw, c.msgtype) is not None)


def main() -> None:
    """Print the table."""
    print("   samples   rosbags, by message   read_bag   identify slpi        pi   (seconds)")
    with tempfile.TemporaryDirectory() as folder:
        for duration, rate in ((60.0, 200.0), (120.0, 1000.0), (100.0, 10_000.0)):
            record, _, _ = calibrated(0, duration, rate)
            path = Path(folder) / f"bag_{len(record)}"
            write_bag(path, record)
            times = []
            for work in (
                lambda path=path: read_by_message(path),
                lambda path=path: slpi_ros.read_bag(path),
                lambda record=record: slpi_ros.identify(record, "slpi"),
                lambda record=record: slpi_ros.identify(record, "pi"),
            ):
                began = time.perf_counter()
                work()
                times.append(time.perf_counter() - began)
            print(f"{len(record):10,} {times[0]:21.2f} {times[1]:10.2f} {times[2]:15.2f} {times[3]:9.2f}")


if __name__ == "__main__":
    main()
