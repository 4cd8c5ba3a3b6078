"""Faults of simulated devices over the real protocol: what moves, how long a call waits, when /diagnostics tells it.

Each fault strikes at rest, in motion, four times in a row, and at the first question of the next opening. Largest step:
in the device's own log, as a share of what the slew limit allows in two cycles. Longest call: of the thread of the
device, of one cycle and of one opening, which asks many questions. Told after: from the fault to the state of the
thread, and to the reason on /diagnostics of the node `driver` as a process (only where ROS 2 is sourced).
"""

import argparse
import os
import subprocess
import sys
import tempfile
import threading
import time
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field

import numpy as np
from driver import DEVICES, PRIORITY, priority

from slpi_ros.devices.link import State
from slpi_ros.devices.loop import DeviceLoop
from slpi_ros.devices.writer import LoopSettings
from slpi_ros.drivers.base import Channel, Device
from slpi_ros.drivers.registry import make_device
from slpi_ros.model.limits import Limits
from slpi_ros.simulation.devices.base import FAULTS, Fault
from slpi_ros.simulation.devices.registry import make_simulator

RATE, SLEW = 200.0, 400.0
ALLOWED = 2.0 * SLEW / RATE
LOW, HIGH = 0.0, 90.0
MOMENTS = ("at rest", "in motion", "four times", "when opened again")
# Longest wait for anything, s.
PATIENCE = 20.0
# How far a voltage that the device tells may be from the one that was written, V at the stage.
ROUNDING = 1e-3


class Timed(Device):
    """A device whose calls are timed."""

    def __init__(self, device):
        super().__init__("", "", device.channels)
        self.device, self.name = device, device.name
        self.longest = {"cycle": 0.0, "opening": 0.0}

    @contextmanager
    def _timed(self, what):
        begun = time.perf_counter()
        try:
            yield
        finally:
            self.longest[what] = max(self.longest[what], time.perf_counter() - begun)

    def open(self):
        with self._timed("opening"):
            return self.device.open()

    def release_servo(self):
        return self.device.release_servo()

    def exchange(self, voltages):
        with self._timed("cycle"):
            return self.device.exchange(voltages)

    def close(self):
        self.device.close()


@dataclass
class Table:
    """What was seen with one device."""

    faults: int = 0
    step: float = 0.0  # V
    moved: int = 0  # outputs that changed between the loss and ~/arm
    told: list[float] = field(default_factory=list)  # s, to the state of the thread
    published: list[float] = field(default_factory=list)  # s, to the reason on /diagnostics
    longest: dict[str, float] = field(default_factory=dict)


def until(done, what):
    deadline = time.monotonic() + PATIENCE
    while not (found := done()):
        if time.monotonic() > deadline:
            raise AssertionError(f"in vain: {what}")
        time.sleep(1e-3)
    return found


def simulator(name, folder):
    _, axes, gain, place = DEVICES[name]
    return make_simulator(name, place.format(folder=folder), axes, 1, 0.0, 20.0 / gain, 0.0)


def address_of(name, simulated):
    place = f"Dev1@{simulated.address}" if name == "nidaqmx" and "@" not in simulated.address else simulated.address
    return f"{name}:{place}" if DEVICES[name][0] == "serial" else place


def struck(simulated, fault):
    """Return when the fault has struck (s of the steady clock)."""
    until(lambda: simulated.fault is not fault, f"{fault} strikes")
    return time.monotonic()


def largest_step(name, simulated):
    gain = DEVICES[name][2]
    paths = [[20.0, *(gain * each.voltage for each in simulated.log if each.axis == axis)] for axis in simulated.axes]
    return max(float(np.abs(np.diff(path)).max(initial=0.0)) for path in paths)


def thread_faults(name, folder, table):
    """Let every fault strike the thread of the driver at every moment."""
    kind, axes, gain, _ = DEVICES[name]
    with simulator(name, folder) as simulated:
        device = Timed(make_device(kind, address_of(name, simulated), [Channel(axis, gain) for axis in axes]))
        loop = DeviceLoop(device, LoopSettings(axes, (Limits(LOW, HIGH, SLEW),) * len(axes), RATE), lambda _: None)
        thread = threading.Thread(target=loop.run)
        thread.start()
        try:
            for fault in FAULTS:
                for moment in MOMENTS:
                    strike(loop, simulated, Fault(fault, times=4 if moment == "four times" else 1), moment, table)
        finally:
            loop.end()
            thread.join()
        table.step, table.longest = largest_step(name, simulated), device.longest


def strike(loop, simulated, fault, moment, table):
    until(lambda: loop.status.state is State.ARMED, "armed")
    reach(loop, 30.0)
    if moment == "in motion":
        loop.command([80.0] * len(simulated.axes))
        time.sleep(5.0 / RATE)
    losses = loop.counts.losses
    if moment == "when opened again":
        simulated.fault = Fault("silent")
        until(lambda: loop.counts.losses > losses, "the loss before")
        simulated.fault = fault
        struck(simulated, fault)
    else:
        simulated.fault = fault
        at = struck(simulated, fault)
        until(lambda: loop.counts.losses > losses and loop.status.reason, "the loss")
        table.told.append(time.monotonic() - at)
    table.faults += 1
    written = len(simulated.log)
    until(lambda: loop.status.state is State.HELD, "held")
    time.sleep(10.0 / RATE)
    table.moved += len(simulated.log) - written
    loop.request("arm")


def reach(loop, voltage):
    def there():
        loop.command([voltage] * len(loop.latest.voltages))
        return np.abs(np.subtract(loop.latest.voltages, voltage)).max() <= ROUNDING

    until(there, f"{voltage} V")


def node_faults(name, folder, table):
    """Let every fault strike the node at rest and in motion, and wait for the reason on /diagnostics."""
    import rclpy
    from diagnostic_msgs.msg import DiagnosticArray
    from std_msgs.msg import Float64MultiArray

    kind, axes, gain, _ = DEVICES[name]
    told = []  # number of losses, reason, when it came

    def note(message):
        for status in message.status:
            values = {each.key: each.value for each in status.values}
            if "links_lost" in values:
                told.append((int(values["links_lost"]), values["reason"], status.message, time.monotonic()))

    node = rclpy.create_node("device_faults")
    node.create_subscription(DiagnosticArray, "/diagnostics", note, 10)
    commands = node.create_publisher(Float64MultiArray, "voltage_command", 10)

    def spin(done, what):
        deadline = time.monotonic() + PATIENCE
        while not done():
            rclpy.spin_once(node, timeout_sec=0.01)
            assert time.monotonic() < deadline, f"in vain: {what}"

    with simulator(name, folder) as simulated:
        given = {
            "device": kind, "address": address_of(name, simulated), "axes": list(axes), "channels": list(axes),
            "voltage_min": LOW, "voltage_max": HIGH, "slew_limit": SLEW, "rate": RATE, "amplifier_gain": gain,
            "rearm": True, "realtime_priority": PRIORITY,
        }  # fmt: skip
        words = [word for key, value in given.items() for word in ("-p", f"{key}:={value}")]
        command = [sys.executable, "-m", "slpi_ros.nodes.start", "driver", "--ros-args", *words]
        process = subprocess.Popen(command, stderr=subprocess.DEVNULL)
        try:
            spin(lambda: told and commands.get_subscription_count(), "the node")
            for number, (fault, moving) in enumerate(
                ((each, moving) for each in FAULTS for moving in (False, True)), 1
            ):
                for _ in range(10):
                    commands.publish(Float64MultiArray(data=[80.0 if moving and number % 4 else 30.0] * len(axes)))
                    rclpy.spin_once(node, timeout_sec=0.02)
                before = told[-1][0]
                given_fault = Fault(fault)
                simulated.fault = given_fault
                spin(lambda: simulated.fault is not given_fault, fault)  # noqa: B023
                at = time.monotonic()
                spin(lambda: told[-1][0] > before, f"{fault} on /diagnostics")  # noqa: B023
                reason, message, came = next(each[1:] for each in told if each[0] > before)
                assert kind in reason + message
                table.published.append(came - at)
                spin(lambda: not told[-1][1], "armed again")
            table.step = max(table.step, largest_step(name, simulated))
        finally:
            process.terminate()
            process.wait()
            node.destroy_node()


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--device", choices=DEVICES, help="only this one")
    given = parser.parse_args()
    with suppress(ImportError):
        import rclpy

        rclpy.init()
    print(f"{os.cpu_count()} processors; load {os.getloadavg()[0]:.1f}")
    print("device   faults  largest step  moved by itself  longest cycle  opening  told after: thread  /diagnostics")
    for name in DEVICES:
        if given.device not in (None, name):
            continue
        table = Table()
        with tempfile.TemporaryDirectory() as folder:
            with privileged():
                thread_faults(name, folder, table)
            if "rclpy" in sys.modules:
                node_faults(name, folder, table)
        published = f"{max(table.published):.2f} s of {len(table.published)}" if table.published else "-"
        longest = table.longest
        print(
            f"{name:8} {table.faults:6d}  {table.step / ALLOWED:12.3f}  {table.moved:15d}  "
            f"{longest['cycle']:11.3f} s  {longest['opening']:5.2f} s  {max(table.told):16.2f} s  {published}",
            flush=True,
        )


@contextmanager
def privileged():
    """Give this process a real-time priority where the system permits one, so that no other program is measured."""
    try:
        with priority(PRIORITY):
            yield
    except PermissionError:
        yield


if __name__ == "__main__":
    main()
