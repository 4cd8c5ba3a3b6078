"""The driver of National Instruments against a simulated gRPC server: what is its own."""

import pytest
from drivers.kinds import KINDS

from slpi_ros.drivers.base import LinkError
from slpi_ros.drivers.registry import make_device
from slpi_ros.simulation.devices.nidaqmx import NidaqmxSimulator


def device_at(simulator):
    kind = KINDS["nidaqmx"]
    address = simulator.address if "@" in simulator.address else f"Dev1@{simulator.address}"
    return make_device("nidaqmx", address, kind.channels(1))


def test_a_driver_whose_tasks_another_one_has_cleared_does_not_clear_those_of_the_other():
    """Else both would move the stage by turns."""
    with NidaqmxSimulator(["ao0:ai0"], voltages=[2.0]) as simulator:
        first, second = device_at(simulator), device_at(simulator)
        first.open()
        first.write([21.0])
        assert second.open().setpoints == pytest.approx((21.0,))
        second.close()
        with pytest.raises(LinkError, match="another program has taken the device over"):
            first.write([80.0])
        second.open()
        second.write([22.0])
        for _ in range(3):
            with pytest.raises(LinkError, match="another program has taken the device over"):
                first.open()
        assert second.write([23.0]).voltages == pytest.approx((23.0,))
        second.close()
        assert first.open().setpoints == pytest.approx((23.0,))
        first.close()
        assert [each.voltage for each in simulator.log] == pytest.approx([2.1, 2.2, 2.3])


def test_a_new_driver_takes_over_what_a_killed_one_has_left():
    with NidaqmxSimulator(["ao0:ai0"], voltages=[2.0]) as simulator:
        killed, again = device_at(simulator), device_at(simulator)
        killed.open()
        killed.write([21.0])
        killed._link.close()
        assert again.open().setpoints == pytest.approx((21.0,))
        again.close()
