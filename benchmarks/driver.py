"""The cycle of the driver with simulated devices in a process of their own: cycles per second, lateness, processor.

Each cycle writes the voltages and reads positions and voltages of two axes (the NV200: one) over TCP, a pseudo terminal
or gRPC on this machine.
"""

import argparse
import math
import multiprocessing
import tempfile
import threading
import time

from slpi_ros.drivers.base import Channel
from slpi_ros.drivers.registry import make_device
from slpi_ros.model.limits import Limits
from slpi_ros.nodes.device_loop import DeviceLoop, LoopSettings
from slpi_ros.simulation.devices.registry import make_simulator

# Device of the driver, simulated device, its axes, V/V of the amplifier, and where it is served.
DEVICES = {
    "gcs": ("gcs", ("1", "2"), 1.0, "127.0.0.1:0"),
    "labjack": ("labjack", ("DAC0:AIN0", "DAC1:AIN1"), 20.0, "127.0.0.1:0"),
    "nidaqmx": ("nidaqmx", ("ao0:ai0", "ao1:ai1"), 10.0, "127.0.0.1:0"),
    "nv200": ("serial", ("1",), 1.0, "{folder}/nv200"),
}
# Device, cycles per second, time until an answer, s.
ROWS = (
    ("gcs", 1000.0, 0.0), ("gcs", 1000.0, 0.0003), ("gcs", 500.0, 0.001), ("labjack", 1000.0, 0.0),
    ("labjack", 250.0, 0.001), ("nidaqmx", 500.0, 0.0), ("nv200", 200.0, 0.001),
)  # fmt: skip


def serve(connection, name, delay, address):
    axes = DEVICES[name][1]
    with make_simulator(name, address, axes, 1, 0.0, 0.0, delay) as simulator:
        connection.send(simulator.address)
        connection.recv()


def measure(name, rate, delay, seconds, folder):
    kind, axes, gain, place = DEVICES[name]
    ours, theirs = multiprocessing.Pipe()
    serving = (theirs, name, delay, place.format(folder=folder))
    process = multiprocessing.get_context("spawn").Process(target=serve, args=serving)
    process.start()
    address = ours.recv()
    device = make_device(kind, f"{name}:{address}" if kind == "serial" else address, [Channel(a, gain) for a in axes])
    limits = (Limits(0.0, 90.0, 1000.0),) * len(axes)
    loop = DeviceLoop(device, LoopSettings(axes, limits, rate), lambda reading: None)
    thread = threading.Thread(target=loop.run)
    thread.start()
    while loop.counts.cycles < 100:
        time.sleep(0.01)
    loop.timing.restart()
    before, late, used, begun = loop.counts.cycles, loop.counts.late, time.process_time(), time.perf_counter()
    while (t := time.perf_counter() - begun) < seconds:
        loop.command([45.0 + 40.0 * math.sin(6.0 * t)] * len(axes))
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
    parser.add_argument("--device", choices=DEVICES, help="only this one")
    given = parser.parse_args()
    print("device   rate  answers after  cycles/s  left out  lateness p50   p99    max   processor (with commands)")
    with tempfile.TemporaryDirectory() as folder:
        for name, rate, delay in ROWS:
            if given.device not in (None, name):
                continue
            cycles, late, (p50, p99, most), used = measure(name, rate, delay, given.seconds, folder)
            print(
                f"{name:8} {rate:4.0f}  {delay * 1e3:10.1f} ms  {cycles:8.1f}  {late:8d}  {p50 * 1e3:9.2f} ms  "
                f"{p99 * 1e3:.2f} ms  {most * 1e3:.1f} ms  {used:.1%}",
                flush=True,
            )


if __name__ == "__main__":
    main()
