"""Time of an identification, compared with the time that rosbags needs to read the same bag message by message."""

import argparse
import multiprocessing
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

from accuracy import calibrated
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore

import slpi_ros
from slpi_ros.io.bag_writer import write_bag

# Number of samples, and duration of the excitation (s).
USUAL = ((12_000, 60.0), (120_000, 120.0), (1_000_000, 100.0))
LONG_SECONDS = 1000.0


def read_by_message(path: Path) -> int:
    """Deserialise every message with rosbags; return the number of messages."""
    with AnyReader([path], default_typestore=get_typestore(Stores.ROS2_JAZZY)) as reader:
        return sum(1 for c, _, raw in reader.messages() if reader.deserialize(raw, c.msgtype) is not None)


def seconds(work: Callable[[], object]) -> float:
    """Return the duration of a call, seconds."""
    began = time.perf_counter()
    work()
    return time.perf_counter() - began


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--samples", type=int, metavar="N", help="slpi identify of one record of that length only")
    options, _ = parser.parse_known_args()
    with tempfile.TemporaryDirectory() as folder:
        if options.samples:
            _long(Path(folder) / "bag", options.samples)
            return
        print("   samples   rosbags, by message   read_bag   identify slpi        pi   (seconds)")
        for samples, duration in USUAL:
            record, _, _ = calibrated(0, duration, samples / duration)
            path = Path(folder) / f"bag_{len(record)}"
            write_bag(path, record)
            times = [
                seconds(lambda path=path: read_by_message(path)),
                seconds(lambda path=path: slpi_ros.read_bag(path)),
                *(seconds(lambda record=record, kind=kind: slpi_ros.identify(record, kind)) for kind in ("slpi", "pi")),
            ]
            print(f"{len(record):10,} {times[0]:21.2f} {times[1]:10.2f} {times[2]:15.2f} {times[3]:9.2f}")


def _write(path: Path, samples: int) -> None:
    write_bag(path, calibrated(0, LONG_SECONDS, samples / LONG_SECONDS)[0])


def _long(path: Path, samples: int) -> None:
    """Print time and peak memory of `slpi identify` for a long record, for each kind in a separate process."""
    # Written in another process: the peak memory of a child process includes the memory of its parent at the start.
    maker = multiprocessing.get_context("spawn").Process(target=_write, args=(path, samples))
    maker.start()
    maker.join()
    print(f"{samples:,} samples     seconds   peak memory, GB")
    for kind in ("slpi", "pi"):
        command = [sys.executable, "-m", "slpi_ros.cli", "identify", str(path), "--kind", kind]
        began = time.perf_counter()
        with subprocess.Popen([*command, "-o", str(path.parent / "model.json")], stdout=subprocess.DEVNULL) as process:
            _, status, usage = os.wait4(process.pid, 0)
            process.returncode = os.waitstatus_to_exitcode(status)
        took = time.perf_counter() - began
        print(f"slpi identify --kind {kind:<6} {took:9.1f} {usage.ru_maxrss / 1e6:17.2f}", flush=True)
        if process.returncode:
            sys.exit(f"it failed with exit code {process.returncode}")


if __name__ == "__main__":
    main()
