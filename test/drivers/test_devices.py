"""What holds for every device, each over its own protocol; judged by the log of the simulated one."""

import math
import time
from contextlib import suppress

import pytest
from drivers.kinds import KINDS

from slpi_ros.drivers.base import DeviceError, LinkError
from slpi_ros.simulation.devices.base import FAULTS, LATE, LOST, Fault

# Of each driver and each link one; the others are long.
SHORT = ("gcs", "labjack", "nidaqmx", "nv200")
LATER = 0.6  # s: more than the drivers wait, on a busy machine too


@pytest.fixture(
    params=[name if name in SHORT else pytest.param(name, marks=pytest.mark.long) for name in KINDS],
)
def kind(request):
    return KINDS[request.param]


def test_opening_changes_no_output_and_tells_where_it_is(kind):
    count = len(kind.axes)
    begin = [37.5, 12.5][:count]
    with kind.simulate(count, begin) as simulator:
        device = kind.make(simulator)
        found = device.open()
        device.close()
        device.open()
        device.read()
        device.close()
        assert simulator.log == []
    assert found.setpoints == pytest.approx(begin, abs=kind.rounding)
    assert found.reading.voltages == pytest.approx(begin, abs=kind.rounding)
    assert found.identity and found.servo == (False,) * count
    assert all(low <= 0.0 and high >= 50.0 for low, high in zip(found.lowest, found.highest, strict=True))


def test_a_cycle_writes_and_reads_each_axis(kind):
    goal = [30.0, 8.0][: len(kind.axes)]
    with kind.simulate(len(kind.axes)) as simulator:
        device = kind.make(simulator)
        device.open()
        before = time.monotonic_ns()
        reading = device.write(goal)
        after = time.monotonic_ns()
        told = simulator.move()
        device.close()
        assert kind.volts(simulator) == pytest.approx(goal, abs=kind.rounding)
    assert before <= reading.read_ns <= after
    assert reading.voltages == pytest.approx(goal, abs=kind.rounding)
    assert reading.positions == pytest.approx(told if kind.sensor else [math.nan] * len(goal), abs=2e-9, nan_ok=True)


@pytest.mark.parametrize("fault", FAULTS)
def test_a_fault_is_told_in_time_and_a_new_opening_goes_on(kind, fault):
    with kind.simulate(voltages=[20.0]) as simulator:
        device = kind.make(simulator)
        device.open()
        simulator.fault = Fault(fault, seconds=0.25 if fault == LATE else 0.0)
        with pytest.raises(DeviceError, match=f"^{device.name}: "):
            # The second of two answers may come after the first has been read.
            for _ in range(2):
                device.read()
        device.close()
        for _ in range(200):
            try:
                found = device.open()
                break
            except DeviceError:
                # At a serial port a late answer meets the next opening.
                assert fault in (LATE, LOST)
        assert simulator.log == [] and found.setpoints == pytest.approx([20.0], abs=kind.rounding)
        assert device.write([21.0]).voltages == pytest.approx([21.0], abs=kind.rounding)
        device.close()


def test_a_late_answer_is_not_taken_for_the_next_one(kind):
    count = len(kind.axes)
    with kind.simulate(count, [20.0, 10.0][:count]) as simulator:
        device = kind.make(simulator)
        device.open()
        for goal in (30.0, 40.0):
            simulator.fault = Fault(LATE, seconds=LATER)
            with pytest.raises(DeviceError):
                device.read()
            for axis, volts in zip(simulator.axes, (goal, goal + 5.0), strict=False):
                simulator.set_by_hand(axis, volts / kind.gain)
            # What came late may meet the next opening, too.
            for _ in range(200):
                with suppress(DeviceError):
                    device.open()
                    break
            for _ in range(5):
                reading = device.read()
                assert reading.voltages == pytest.approx(kind.volts(simulator), abs=kind.rounding)
                if kind.sensor:
                    assert reading.positions == pytest.approx(simulator.move(), abs=1e-7)
        device.close()


def test_a_write_whose_answer_is_late_is_carried_out_once(kind):
    with kind.simulate(voltages=[20.0]) as simulator:
        device = kind.make(simulator)
        device.open()
        simulator.fault = Fault(LATE, kind.write if kind.write_answered else "", seconds=LATER)
        with pytest.raises(DeviceError):
            device.write([21.0])
        # A second one would undo this.
        while simulator.voltage(simulator.axes[0]) == pytest.approx(20.0 / kind.gain, abs=kind.rounding):
            time.sleep(0.01)
        simulator.set_by_hand(simulator.axes[0], 30.0 / kind.gain)
        for _ in range(200):
            with suppress(DeviceError):
                found = device.open()
                break
        device.close()
        assert found.setpoints == pytest.approx([30.0], abs=kind.rounding)
        assert [kind.gain * each.voltage for each in simulator.log] == pytest.approx([21.0, 30.0], abs=kind.rounding)
        assert len([each for each in simulator.received if each.startswith(kind.write)]) == 1


def test_beyond_its_own_range_it_refuses(kind):
    with kind.simulate(voltages=[20.0]) as simulator:
        device = kind.make(simulator)
        beyond = device.open().highest[0] + 10.0
        with pytest.raises(DeviceError):
            device.write([beyond])
        device.close()
        assert simulator.log == []


def test_not_open(kind):
    with kind.simulate() as simulator:
        device = kind.make(simulator)
        with pytest.raises(LinkError):
            device.read()
        device.close()
