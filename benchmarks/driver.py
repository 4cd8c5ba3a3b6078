"""The cycle of the driver with simulated devices in a process of their own: cycles per second, lateness, processor.

Each cycle writes the voltages and reads positions and voltages of two axes (the NV200: one) over TCP, a pseudo terminal
or gRPC on this machine. The simulated device has a real-time priority where the system permits one, as a real one is
not slowed by other programs here. The driver is measured as it is and with the node's `realtime_priority`; beside it,
with the controller that answers after 0.3 ms, the bare socket: one sending and one receiving, nothing is read of them.
"""

import argparse
import math
import multiprocessing
import os
import socket
import sys
import tempfile
import threading
import time
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

from slpi_ros.devices.loop import DeviceLoop
from slpi_ros.devices.writer import LoopSettings
from slpi_ros.drivers.base import Channel
from slpi_ros.drivers.registry import make_device
from slpi_ros.model.limits import Limits
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
# The row beside which the bare socket is measured.
BESIDE = ROWS[1]
# Of the simulated device, and of the driver where it has one: as in ROS 2 control.
DEVICE_PRIORITY, PRIORITY = 60, 50
CYCLE = b"SVA 1 45.000000 2 45.000000\nPOS? 1 2\nVOL? 1 2\nERR?\n"
ANSWERED_LINES = 5


@dataclass(frozen=True)
class Row:
    """What one way does."""

    cycles: float
    seconds: float
    used: float  # s of the processor
    lateness: tuple[float, float, float]  # s: median, 99th percentile, maximum
    left_out: str = ""

    def told(self, way, rate, delay):
        rates = f"{way:22} {rate:4.0f}  {delay * 1e3:10.1f} ms  {self.cycles / self.seconds:8.1f}  {self.left_out:>8}"
        p50, p99, most = (1e3 * each for each in self.lateness)
        return (
            f"{rates}  {p50:9.2f} ms  {p99:.2f} ms  {most:4.1f} ms  {self.used / self.seconds:6.1%}  "
            f"{1e6 * self.used / self.cycles:4.0f} us"
        )


@contextmanager
def priority(level):
    """Give all threads of this process a real-time priority, as the node does; PermissionError where none is given."""
    if level:
        schedule("self", os.SCHED_FIFO, level)
    try:
        yield
    finally:
        if level:
            schedule("self", os.SCHED_OTHER, 0)


def schedule(process, policy, level):
    """Schedule all threads of a process by its number."""
    for thread in Path(f"/proc/{process}/task").iterdir():
        with suppress(ProcessLookupError):
            os.sched_setscheduler(int(thread.name), policy, os.sched_param(level))


def serve(connection, name, delay, address):
    axes = DEVICES[name][1]
    with suppress(PermissionError):
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(DEVICE_PRIORITY))
    with make_simulator(name, address, axes, 1, 0.0, 0.0, delay) as simulator:
        connection.send(simulator.address)
        connection.recv()


@contextmanager
def served(name, delay, folder):
    """Serve a simulated device in a process of its own; yields its address."""
    ours, theirs = multiprocessing.Pipe()
    given = (theirs, name, delay, DEVICES[name][3].format(folder=folder))
    process = multiprocessing.get_context("spawn").Process(target=serve, args=given)
    process.start()
    try:
        yield ours.recv()
    finally:
        ours.send(None)
        process.join()


def others_time():
    """Return the time of the processor (s) used by the other threads of this process: the driver, not what commands."""
    return time.process_time() - time.thread_time()


def driven(name, address, rate, seconds):
    """Return the row of the driver, commanded once a cycle by another thread."""
    kind, axes, gain, _ = DEVICES[name]
    device = make_device(kind, f"{name}:{address}" if kind == "serial" else address, [Channel(a, gain) for a in axes])
    limits = (Limits(0.0, 90.0, 1000.0),) * len(axes)
    loop = DeviceLoop(device, LoopSettings(axes, limits, rate), lambda reading: None)
    thread = threading.Thread(target=loop.run)
    thread.start()
    while loop.counts.cycles < 100:
        time.sleep(0.01)
    loop.timing.restart()
    before, late, used, begun = loop.counts.cycles, loop.counts.late, others_time(), time.perf_counter()
    sent = 0
    while (t := time.perf_counter() - begun) < seconds:
        loop.command([45.0 + 40.0 * math.sin(6.0 * t)] * len(axes))
        # Steadily, as a compensator does: the cycles fall in step with the commands.
        sent = max(sent + 1, int(t * rate))
        time.sleep(max(begun + sent / rate - time.perf_counter(), 0.0))
    cycles, late, used = loop.counts.cycles - before, loop.counts.late - late, others_time() - used
    report = loop.timing.report()
    loop.end()
    thread.join()
    return Row(cycles, t, used, report.latency, str(late))


def bare(address, rate, seconds):
    """Return the row of a socket to the controller without a driver."""
    host, _, port = address.rpartition(":")
    with socket.create_connection((host, int(port))) as link:
        link.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        period, lateness = 1.0 / rate, []
        used, begun = time.process_time(), time.perf_counter()
        due = begun
        while (now := time.perf_counter()) - begun < seconds:
            if now < due:
                time.sleep(due - now)
            lateness.append(time.perf_counter() - due)
            link.sendall(CYCLE)
            answer = b""
            while answer.count(b"\n") < ANSWERED_LINES:
                answer += link.recv(65_536)
            due += period
            due += max((time.perf_counter() - due) // period, 0.0) * period
        elapsed, used = time.perf_counter() - begun, time.process_time() - used
    lateness.sort()
    shares = (lateness[min(int(share * len(lateness)), len(lateness) - 1)] for share in (0.5, 0.99, 1.0))
    return Row(len(lateness), elapsed, used, tuple(shares))


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=5.0, help="of each row")
    parser.add_argument("--device", choices=DEVICES, help="only this one")
    parser.add_argument("--pairs", type=int, default=1, help="how often each row is measured")
    given = parser.parse_args()
    load = ", ".join(f"{each:.1f}" for each in os.getloadavg())
    print(f"{os.cpu_count()} processors; load of the last 1, 5 and 15 minutes: {load}")
    print(f"{'way':22} rate  answers after  cycles/s  left out  lateness p50  p99      max      processor, a cycle")
    with tempfile.TemporaryDirectory() as folder:
        for row in ROWS:
            name, rate, delay = row
            if given.device not in (None, name):
                continue
            with served(name, delay, folder) as address:
                for _ in range(given.pairs):
                    measure(row, address, given.seconds)
    print(f"load at the end: {os.getloadavg()[0]:.1f}", file=sys.stderr)


def measure(row, address, seconds):
    name, rate, delay = row
    for level in (0, PRIORITY):
        way = ", real-time" if level else ""
        try:
            with priority(level):
                print(driven(name, address, rate, seconds).told(name + way, rate, delay), flush=True)
                if row == BESIDE:
                    print(bare(address, rate, seconds).told("socket" + way, rate, delay), flush=True)
        except PermissionError:
            print(f"{name + way}: not permitted")


if __name__ == "__main__":
    main()
