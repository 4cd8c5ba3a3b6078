"""The cycle of the driver with a simulated controller in a process of its own: cycles per second, lateness, processor.

Each cycle writes the voltages and reads positions and voltages of two axes over TCP on this machine.
"""

import argparse
import math
import multiprocessing
import threading
import time

from slpi_ros.drivers.base import Channel
from slpi_ros.drivers.registry import make_device
from slpi_ros.model.limits import Limits
from slpi_ros.nodes.device_loop import DeviceLoop, LoopSettings
from slpi_ros.simulation.devices.gcs import GcsSimulator

AXES = ("1", "2")


def serve(connection, delay):
    with GcsSimulator(AXES, answer_delay=delay) as simulator:
        connection.send(simulator.address)
        connection.recv()


def measure(rate, delay, seconds):
    ours, theirs = multiprocessing.Pipe()
    process = multiprocessing.get_context("spawn").Process(target=serve, args=(theirs, delay))
    process.start()
    device = make_device("gcs", ours.recv(), [Channel(axis) for axis in AXES])
    limits = (Limits(0.0, 100.0, 1000.0),) * len(AXES)
    loop = DeviceLoop(device, LoopSettings(AXES, limits, rate), lambda reading: None)
    thread = threading.Thread(target=loop.run)
    thread.start()
    while loop.counts.cycles < 100:
        time.sleep(0.01)
    loop.timing.restart()
    before, late, used, begun = loop.counts.cycles, loop.counts.late, time.process_time(), time.perf_counter()
    while (t := time.perf_counter() - begun) < seconds:
        loop.command([50.0 + 40.0 * math.sin(6.0 * t)] * len(AXES))
        time.sleep(1.0 / rate)
    cycles, late, used = loop.counts.cycles - before, loop.counts.late - late, time.process_time() - used
    report = loop.timing.report()
    loop.end()
    thread.join()
    ours.send(None)
    process.join()
    return cycles / t, late, report.latency, used / t


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=5.0, help="of each row")
    given = parser.parse_args()
    print("rate  answers after  cycles/s  left out  lateness p50   p99    max   processor (with commands)")
    for rate, delay in ((1000.0, 0.0), (1000.0, 0.0003), (500.0, 0.001)):
        cycles, late, (p50, p99, most), used = measure(rate, delay, given.seconds)
        print(
            f"{rate:4.0f}  {delay * 1e3:10.1f} ms  {cycles:8.1f}  {late:8d}  {p50 * 1e3:9.2f} ms  {p99 * 1e3:.2f} ms  "
            f"{most * 1e3:.1f} ms  {used:.1%}"
        )


if __name__ == "__main__":
    main()
