"""Devices at a serial port against simulated ones at a pseudo terminal, and dialects in YAML."""

import math
import time

import pytest
from drivers.kinds import KINDS

from slpi_ros.drivers.base import Channel, LinkError, RefusedError, UnsuitableError
from slpi_ros.drivers.dialects import DIALECTS, Dialect, dialect_of
from slpi_ros.drivers.registry import make_device
from slpi_ros.drivers.stream import SerialStream
from slpi_ros.errors import UsageError
from slpi_ros.simulation.devices.serial import MdtSimulator, Nv200Simulator

OWN = r"""
write: "V{channel} {voltage}"
voltage: "V{channel}?"
position: "P{channel}?"
answer: "{query}={number}(?:mV)?"
terminator: "\n"
end: "\n"
decimals: 1
volts_per_unit: 0.001
"""


class Own(Nv200Simulator):
    """A device of nobody's: millivolts, nanometres, lines without flow control."""

    question, terminator = "P1?", b"\n"

    def reply(self, line):
        axis = self.axes[0]
        if line == "V1?":
            return f"V1?={1e3 * self.voltage(axis):.1f}mV\n".encode()
        if line == "P1?":
            return f"P1?={1e9 * self.measure()[axis]:.2f}\n".encode()
        self.output(axis, 1e-3 * float(line.removeprefix("V1 ")))
        return b""


@pytest.fixture
def place(tmp_path):
    return str(tmp_path / "tty")


def at(dialect, place, *channels):
    return make_device("serial", f"{dialect}:{place}", channels or [Channel("1")])


def test_opening_only_asks(place):
    with Nv200Simulator(voltages=[37.5], path=place) as simulator:
        found = at("nv200", place).open()
        assert simulator.received == ["desc", "modsrc", "cl", "meas", "set", "avmin", "avmax"]
    assert (found.lowest, found.highest) == ((-20.0,), (130.0,)) and "NV200" in found.identity
    with MdtSimulator(["x", "z"], voltages=[37.5, 1.0], path=place) as simulator:
        found = at("mdt69xb", place, Channel("x"), Channel("z")).open()
        assert all(line.endswith("?") for line in simulator.received)
    assert found.highest == (150.0, 150.0) and "MDT693B" in found.identity and "\r" not in found.identity
    assert all(map(math.isnan, found.reading.positions)) and any("sensor" in note for note in found.notes)


@pytest.mark.parametrize("echo", [True, False])
def test_an_echo_changes_nothing(place, echo):
    with MdtSimulator(path=place, echo=echo) as simulator:
        device = at("mdt69xb", place, Channel("x"))
        device.open()
        assert device.write([24.68]).voltages == (24.7,)
        assert simulator.voltage("x") == 24.68


def test_a_servo_is_told_and_switched_off_without_a_motion(place):
    with Nv200Simulator(voltages=[33.0], path=place, servo=True) as simulator:
        device = at("nv200", place)
        assert device.open().servo == (True,)
        found = device.release_servo()
        assert found.servo == (False,) and simulator.log == [] and found.setpoints == (33.0,)
        assert any("33.000 to 33.000" in note for note in found.notes)


def test_a_device_that_commands_do_not_set_is_refused(place):
    with Nv200Simulator(path=place, source=1), pytest.raises(UnsuitableError, match="modsrc"):
        at("nv200", place).open()


@pytest.mark.parametrize("late", [False, True])
def test_an_error_of_a_command_that_has_no_answer_is_told_with_the_next_one(place, monkeypatch, late):
    with Nv200Simulator(path=place) as simulator:
        device = at("nv200", place)
        device.open()
        if late:
            # The error is there before the next question is sent.
            send = SerialStream.send

            def send_and_wait(stream, data):
                send(stream, data)
                time.sleep(0.1)

            monkeypatch.setattr(SerialStream, "send", send_and_wait)
        with pytest.raises(RefusedError, match="error,10"):
            device.write([140.0])
        assert simulator.log == []


def test_a_dialect_of_ones_own(place, tmp_path):
    (tmp_path / "own.yaml").write_text(OWN)
    with Own(voltages=[20.0], path=place) as simulator:
        device = at(tmp_path / "own.yaml", place, Channel("1", scale=1e-9))
        found = device.open()
        assert found.setpoints == (20.0,) and math.isinf(found.highest[0])
        reading = device.write([21.2504])
        assert simulator.voltage("1") == pytest.approx(21.2504) and reading.voltages == pytest.approx((21.2504,))
        assert reading.positions == pytest.approx(simulator.move(), abs=1e-9)


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("[1", "read"),
        ("1", "mapping"),
        ("voltage: a", "write"),
        ("write: '{voltage}'", "voltage"),
        ("{write: set, voltage: v}", "write"),
        ("{write: '{voltage}', voltage: v, colour: red}", "colour"),
        ("{write: '{voltage}', voltage: v, decimals: many}", "decimals"),
        ("{write: '{voltage}', voltage: v, answer: '('}", "regular"),
        ("{write: '{voltage}', voltage: v, answer: ok}", "number"),
        ("{write: '{voltage}', voltage: ''}", "voltage"),
        ("{write: '{voltage}', voltage: v, volts_per_unit: 0}", "volts_per_unit"),
        ("{write: '{voltage}', voltage: v, baud: 0}", "baud"),
    ],
)
def test_dialects_that_are_none(tmp_path, text, named):
    path = tmp_path / "own.yaml"
    path.write_text(text)
    with pytest.raises(UsageError, match=named):
        dialect_of(str(path))


@pytest.mark.parametrize("address", ["", "/dev/ttyUSB0", "nv200:", "abacus:/dev/x", "nv200:/dev/x@fast", "no.yaml:/x"])
def test_addresses_that_are_none(address):
    with pytest.raises(UsageError):
        make_device("serial", address, [Channel("1")])


def test_no_port_and_a_port_that_is_taken(place):
    with pytest.raises(LinkError, match="no connection"):
        at("nv200", place).open()
    with Nv200Simulator(path=place):
        first = at("nv200", place)
        first.open()
        with pytest.raises(LinkError, match="no other program"):
            at("nv200", place).open()
        first.close()
        at("nv200", place).open()


def test_an_answer_is_compared_as_a_whole():
    dialect = DIALECTS["nv200"]
    assert dialect.number("meas", "meas,-1.25") == -1.25
    for text in ("meas,1.25x", "meas,", "meas,nan", "meas,1,2", "meas,1e999", "temp,1.25"):
        assert dialect.number("meas", text) is None
    assert Dialect("v={voltage}", "v?").number("v?", " 1e-3 ") == 1e-3


def test_pi_at_a_serial_port():
    kind = KINDS["gcs at a serial port"]
    with kind.simulate(voltages=[20.0]) as simulator:
        device = make_device("gcs", f"{simulator.address}@9600", kind.channels())
        assert device.open().setpoints == (20.0,) and device.write([21.0]).voltages == (21.0,)
