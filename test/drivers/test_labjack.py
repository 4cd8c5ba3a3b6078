"""The driver of LabJacks against a simulated one on pymodbus's own server, which pymodbus's client asks, too."""

import socket
import struct
import threading

import pytest
from pymodbus.client import ModbusTcpClient

from slpi_ros.drivers.base import Channel, LinkError, UnsuitableError
from slpi_ros.drivers.registry import make_device
from slpi_ros.errors import UsageError
from slpi_ros.simulation.devices.labjack import LabjackSimulator


def device_at(simulator, *names):
    return make_device("labjack", simulator.address, [Channel(name, gain=20.0) for name in names or simulator.axes])


def numbers(answer):
    return struct.unpack(
        f">{len(answer.registers) // 2}f", struct.pack(f">{len(answer.registers)}H", *answer.registers)
    )


def test_the_simulator_speaks_to_the_library_of_others():
    with LabjackSimulator(["DAC1:AIN2"], voltages=[1.5]) as simulator:
        host, port = simulator.address.split(":")
        client = ModbusTcpClient(host, port=int(port), timeout=0.2, retries=0)
        assert client.connect()
        assert numbers(client.read_holding_registers(60_000, count=2, device_id=1)) == (7.0,)
        assert numbers(client.read_holding_registers(1000, count=4, device_id=1)) == (0.0, 1.5)
        assert not client.write_registers(
            1002, list(struct.unpack(">2H", struct.pack(">f", 2.5))), device_id=1
        ).isError()
        (position,) = numbers(client.read_holding_registers(4, count=2, device_id=1))
        assert position == pytest.approx(1e5 * simulator.move()[0], abs=1e-4)
        # Beyond the range, half a value, what is only written, what is not there.
        assert client.write_registers(1002, list(struct.unpack(">2H", struct.pack(">f", 5.5))), device_id=1).isError()
        assert client.write_registers(1002, [0], device_id=1).isError()
        assert client.read_holding_registers(30_000, count=2, device_id=1).isError()
        assert client.read_holding_registers(61_600, count=52, device_id=1).isError()
        client.close()
        assert [each.voltage for each in simulator.log] == [2.5]


def test_opening_only_reads():
    with LabjackSimulator(["DAC0:AIN0", "DAC1:AIN1"], voltages=[1.0, 2.0], product=8) as simulator:
        found = device_at(simulator).open()
        assert all(line.startswith("read ") for line in simulator.received)
    assert "T8" in found.identity and "470012345" in found.identity
    assert (found.lowest, found.highest) == ((0.0, 0.0), (200.0, 200.0))
    assert any("DAC0, DAC1" in note for note in found.notes)


def test_neighbours_are_asked_at_once():
    with LabjackSimulator(["DAC0:AIN0", "DAC1:AIN1"]) as simulator:
        device = device_at(simulator)
        device.open()
        simulator.received.clear()
        device.write([20.0, 40.0])
        assert simulator.received == ["write DAC 1000 4", "read AIN 0 4", "read DAC 1000 4"]


def test_the_voltage_of_a_tick_dac_is_the_measured_one():
    with LabjackSimulator(["TDAC2:AIN0:AIN3"], voltages=[-2.0]) as simulator:
        found = device_at(simulator).open()
        assert found.setpoints == (-40.0,) and (found.lowest, found.highest) == ((-200.0,), (200.0,))
        assert not found.notes
        assert not any("TDAC" in line for line in simulator.received)


@pytest.mark.parametrize(
    ("register", "named"), [(61_602, "ADVANCED"), (61_620, "RESET"), (61_640, "DAC0"), (61_650, "DAC1")]
)
def test_a_watchdog_that_moves_an_output_is_refused(register, named):
    with LabjackSimulator(watchdog={61_600: 1, 61_604: 10, register: 1}) as simulator:
        with pytest.raises(UnsuitableError, match=f"10 s.*{named}"):
            device_at(simulator).open()
        assert simulator.log == []


@pytest.mark.parametrize(("watchdog", "told"), [({61_640: 1}, False), ({61_600: 1, 61_604: 10}, True)])
def test_a_watchdog_that_moves_none_is_no_reason(watchdog, told):
    with LabjackSimulator(watchdog=watchdog) as simulator:
        assert any("watchdog" in note for note in device_at(simulator).open().notes) == told


def test_another_product():
    with LabjackSimulator() as simulator:
        simulator._product = 4
        with pytest.raises(UnsuitableError, match="product 4"):
            device_at(simulator).open()


@pytest.mark.parametrize("name", ["", "1", "DAC2:AIN0", "DAC0", "TDAC0:AIN0", "DAC0:AIN0:AIN1:AIN2", "AIN0:DAC0"])
def test_channels_that_are_none(name):
    with pytest.raises(UsageError, match="channel"):
        make_device("labjack", "192.0.2.1", [Channel(name)])


def test_nobody_listens_and_somebody_else_does():
    with socket.create_server(("127.0.0.1", 0)) as server:
        device = make_device("labjack", "{}:{}".format(*server.getsockname()), [Channel("DAC0:AIN0")])
        with pytest.raises(LinkError, match="PRODUCT_ID"):
            device.open()
        device.close()
    with pytest.raises(LinkError, match="no connection"):
        device.open()


def test_a_connection_that_is_reset_is_a_lost_link():
    with socket.create_server(("127.0.0.1", 0)) as server:

        def reset():
            link, _ = server.accept()
            link.recv(1)
            # Closed at once, with bytes that nobody has read.
            link.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
            link.close()

        thread = threading.Thread(target=reset)
        thread.start()
        device = make_device("labjack", "{}:{}".format(*server.getsockname()), [Channel("DAC0:AIN0")])
        with pytest.raises(LinkError, match="lost|no whole answer"):
            device.open()
        thread.join()
        device.close()
