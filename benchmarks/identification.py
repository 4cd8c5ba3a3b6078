"""Time and memory of an identification, and the time that rosbags needs to read the same bag message by message."""

import argparse
import multiprocessing
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
from accuracy import calibrated
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore

import slpi_ros
from slpi_ros.io.bag_reader import decode_signals
from slpi_ros.io.bag_storage import BLOCK, MessageBlock
from slpi_ros.io.bag_writer import write_bag
from slpi_ros.io.messages import JOINT_STATE, SECOND_NS

# Number of samples, and duration of the excitation (s).
USUAL = ((12_000, 60.0), (120_000, 120.0), (1_000_000, 100.0))
LONG_SECONDS = 1000.0
# Lengths of the records of the simulated reader.
LONG = (10_000_000, 100_000_000)
# Rate of the simulated reader of a long bag, samples per second, and samples of the record that it repeats.
READER_RATE, REPEATED = 10_000, 100_000


def read_by_message(path: Path) -> int:
    """Deserialise every message with rosbags; return the number of messages."""
    with AnyReader([path], default_typestore=get_typestore(Stores.ROS2_JAZZY)) as reader:
        return sum(1 for c, _, raw in reader.messages() if reader.deserialize(raw, c.msgtype) is not None)


def seconds(work: Callable[[], object]) -> float:
    """Return the duration of a call, seconds."""
    began = time.perf_counter()
    work()
    return time.perf_counter() - began


def main() -> dict[str, float]:
    """Print the tables; return times and memory relative to references."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--samples", type=int, metavar="N", help="slpi identify of one record of that length only")
    parser.add_argument("--reader", type=int, metavar="N", help="simulated reader of a bag of that length only")
    options, _ = parser.parse_known_args()
    if options.reader:
        _simulated_reader(options.reader)
        return {}
    ratios = {}
    with tempfile.TemporaryDirectory() as folder:
        if options.samples:
            _long(Path(folder) / "bag", options.samples)
            return {}
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
            names = ("read_bag", "identify slpi", "identify pi")
            pairs = zip(names, times[1:], strict=True)
            ratios |= {f"{name} / rosbags by message, {samples} samples": each / times[0] for name, each in pairs}
    for samples in LONG:
        command = [sys.executable, __file__, "--reader", str(samples)]
        took, peak = _measured(command)
        print(f"identify, reader of {samples:,} samples simulated: {took:.0f} s, peak memory {peak:.2f} GB", flush=True)
        ratios[f"peak memory, GB, {samples} samples"] = peak
    return ratios


def _simulated_reader(samples: int) -> None:
    """Decode and identify a record of that length whose messages are made as they are read: one record, repeated."""
    record, _, _ = calibrated(0, REPEATED / READER_RATE * 10, READER_RATE / 10)
    v, y = record.voltage["x"][:REPEATED], record.displacement["x"][:REPEATED]
    with tempfile.TemporaryDirectory() as folder:
        # One message as a pattern for all.
        path = Path(folder) / "bag"
        write_bag(path, slpi_ros.Record(np.array([SECOND_NS]), {"x": np.array([1.25])}, {"x": np.array([3.5])}))
        with AnyReader([path], default_typestore=get_typestore(Stores.ROS2_JAZZY)) as reader:
            pattern = np.frombuffer(next(raw for _, _, raw in reader.messages()), np.uint8)
    places = {name: pattern.tobytes().index(np.float64(value).tobytes()) for name, value in (("v", 1.25), ("y", 3.5))}

    def blocks() -> Iterator[MessageBlock]:
        for start in range(0, samples, BLOCK):
            at = np.arange(start, min(start + BLOCK, samples))
            messages = np.tile(pattern, (at.size, 1))
            for name, signal in (("v", v), ("y", y)):
                messages[:, places[name] : places[name] + 8] = signal[at % v.size].view(np.uint8).reshape(-1, 8)
            stamps = SECOND_NS + at * (SECOND_NS // READER_RATE)
            seconds_and_rest = np.column_stack(np.divmod(stamps, SECOND_NS)).astype("<u4")
            messages[:, 4:12] = seconds_and_rest.view(np.uint8).reshape(-1, 8)
            yield MessageBlock(stamps, messages)

    signals = decode_signals(blocks(), JOINT_STATE, samples)
    long = slpi_ros.Record(signals.stamp, signals.fields["effort"], signals.fields["position"])
    del signals
    model = slpi_ros.identify(long)
    print(f"{len(long)} samples, {model.axes['x'].quality}")


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
        took, peak = _measured([*command, "-o", str(path.parent / "model.json")])
        print(f"slpi identify --kind {kind:<6} {took:9.1f} {peak:17.2f}", flush=True)


def _measured(command: list[str]) -> tuple[float, float]:
    """Run a command; return its duration (s) and its peak memory (GB)."""
    began = time.perf_counter()
    with subprocess.Popen(command, stdout=subprocess.DEVNULL) as process:
        _, status, usage = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        sys.exit(f"{command} failed with exit code {process.returncode}")
    return time.perf_counter() - began, usage.ru_maxrss / 1e6


if __name__ == "__main__":
    main()
