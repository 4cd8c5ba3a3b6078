"""Every fault of every device, at rest, in motion and when it is opened again; judged by the device's own log."""

import time

import numpy as np
import pytest
from drivers.kinds import KINDS

from slpi_ros.devices.link import State
from slpi_ros.devices.loop import DeviceLoop
from slpi_ros.devices.writer import LoopSettings
from slpi_ros.drivers import labjack, nidaqmx, stream
from slpi_ros.drivers.base import DeviceError
from slpi_ros.model.limits import Limits
from slpi_ros.simulation.devices.base import FAULTS, LATE, LOST, SILENT, Fault

pytestmark = pytest.mark.long
RATE, SLEW = 200.0, 400.0
# Of the limiter at most two periods count at once.
STEP = 2.0 * SLEW / RATE
# The simulated device is in this process, and on a busy machine it may be late: more patience than usual, seconds.
PATIENCE = 0.5
PERIOD_NS = round(1e9 / RATE)


class Life:
    """A driver and its device; cycles are those of the test, so that no busy machine changes what is judged."""

    def __init__(self, kind, simulator, rearm=False):
        self.kind, self.simulator, self.now_ns = kind, simulator, 10**12
        self.begin = kind.volts(simulator)
        limits = (Limits(0.0, 100.0, SLEW),) * len(simulator.axes)
        axes = tuple(f"a{number}" for number in range(len(simulator.axes)))
        self.loop = DeviceLoop(
            kind.make(simulator), LoopSettings(axes, limits, RATE, rearm=rearm), lambda _: None, lambda: self.now_ns
        )

    def turn(self, times=1):
        for _ in range(times):
            self.now_ns += PERIOD_NS
            self.loop.turn()

    def until(self, done, most=4000):
        for _ in range(most):
            if done():
                return
            self.turn()
            if self.loop.status.state is State.LOST:
                # The device's time goes on by itself.
                time.sleep(1e-3)
        raise AssertionError(f"in vain; {self.loop.status}")

    def reach(self, voltage):
        goal = [voltage] * len(self.simulator.axes)

        def there():
            assert self.loop.command(goal) == ""
            told = self.loop.latest.voltages if self.loop.latest else ()
            return len(told) and np.abs(np.subtract(told, goal)).max() <= max(self.kind.rounding, 1e-4)

        self.until(there)

    @property
    def largest_step(self):
        steps = []
        for place, axis in enumerate(self.simulator.axes):
            own = [each.voltage for each in self.simulator.log if each.axis == axis]
            path = np.array([self.begin[place], *(self.kind.gain * v for v in own)])
            steps.append(float(np.abs(np.diff(path)).max(initial=0.0)))
        return max(steps)


@pytest.fixture(params=KINDS)
def kind(request):
    return KINDS[request.param]


@pytest.fixture(autouse=True)
def _patience(monkeypatch):
    for module in (stream, labjack, nidaqmx):
        monkeypatch.setattr(module, "TIMEOUT", PATIENCE)


def spoiled(fault, times=1):
    return Fault(fault, seconds=1.3 * PATIENCE if fault in (LATE, LOST) else 0.0, times=times)


@pytest.mark.parametrize("moment", ["at rest", "in motion", "again and again"])
@pytest.mark.parametrize("fault", FAULTS)
def test_a_fault(kind, fault, moment):
    with kind.simulate(voltages=[20.0]) as simulator:
        life = Life(kind, simulator)
        life.turn()
        life.reach(30.0)
        if moment == "in motion":
            life.loop.command([80.0])
            life.turn(3)
        simulator.fault = spoiled(fault, 4 if moment == "again and again" else 1)
        life.until(lambda: life.loop.status.state is State.LOST)
        assert life.loop.status.reason.startswith(life.loop._device.name) and life.loop.counts.losses == 1
        written = len(simulator.log)
        life.until(lambda: life.loop.status.state is State.HELD)
        assert simulator.fault is None or moment == "again and again"
        simulator.fault = None
        life.turn(10)
        # Nothing moved by itself, and nothing moves before it is armed.
        assert len(simulator.log) == written and life.loop.command([80.0])
        life.loop.request("arm")
        life.until(lambda: life.loop.status.state is State.ARMED)
        life.reach(40.0)
        assert life.largest_step <= STEP + 2.0 * kind.rounding


@pytest.mark.parametrize("fault", [SILENT, LOST, LATE])
def test_with_rearm_it_goes_on_by_itself_without_a_jump(kind, fault):
    with kind.simulate(voltages=[20.0]) as simulator:
        life = Life(kind, simulator, rearm=True)
        life.turn()
        life.reach(60.0)
        simulator.fault = spoiled(fault)
        life.until(lambda: life.loop.counts.losses == 1)
        life.until(lambda: life.loop.status.state is State.ARMED)
        life.reach(10.0)
        assert life.largest_step <= STEP + 2.0 * kind.rounding


def test_killed_in_motion_and_started_again(kind):
    with kind.simulate(voltages=[20.0]) as simulator:
        life = Life(kind, simulator)
        life.turn()
        life.loop.command([80.0])
        life.turn(10)
        there = kind.volts(simulator)
        # The system closes what a process that was killed had open; on a server it leaves its tasks.
        device = life.loop._device
        if link := getattr(device, "_link", None):
            link.close()
        else:
            device.close()
        again = Life(kind, simulator)
        again.begin = life.begin
        for _ in range(50):
            try:
                again.turn()
                break
            except DeviceError:
                time.sleep(0.05)
        again.turn(10)
        assert kind.volts(simulator) == there
        again.reach(10.0)
        assert again.largest_step <= STEP + 2.0 * kind.rounding
        again.loop._device.close()
