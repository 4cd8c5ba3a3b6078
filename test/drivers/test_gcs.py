"""The driver of GCS controllers against a simulated one, over TCP."""

import socket

import pytest

from slpi_ros.drivers.base import (
    AnswerError,
    Channel,
    DeviceError,
    LinkError,
    RefusedError,
    UnsuitableError,
)
from slpi_ros.drivers.registry import make_device
from slpi_ros.errors import UsageError
from slpi_ros.simulation.devices.base import (
    ERROR,
    FAULTS,
    HALF,
    LATE,
    LOST,
    NONSENSE,
    NOT_FINITE,
    SILENT,
    TWICE,
    WRONG_AXIS,
    Fault,
)
from slpi_ros.simulation.devices.gcs import GcsSimulator

ERRORS = {
    SILENT: LinkError,
    HALF: LinkError,
    LATE: LinkError,
    LOST: LinkError,
    WRONG_AXIS: AnswerError,
    TWICE: AnswerError,
    NONSENSE: AnswerError,
    NOT_FINITE: AnswerError,
    ERROR: RefusedError,
}


def device_at(simulator, *channels):
    given = channels or [Channel(axis) for axis in simulator.axes]
    return make_device("gcs", simulator.address, given)


def test_opening_only_asks():
    with GcsSimulator(["1", "2"], voltages=[37.5, -3.0]) as simulator:
        found = device_at(simulator).open()
        assert simulator.log == []
        assert all(line.split()[0].endswith("?") for line in simulator.received)
        asked = {line.split()[0] for line in simulator.received}
    assert asked == {
        "*IDN?", "HLP?", "SAI?", "SVO?", "ONL?", "VOL?", "SVA?", "VMI?", "VMA?", "TMN?", "TMX?", "POS?", "ERR?",
        "PUN?", "SPA?", "WGO?",
    }  # fmt: skip
    assert found.setpoints == found.reading.voltages == (37.5, -3.0)
    assert (found.lowest, found.highest, found.servo) == ((-20.0, -20.0), (120.0, 120.0), (False, False))
    assert "E-727" in found.identity


def test_what_a_controller_has_not_got_is_left_out():
    absent = ("SAI?", "SVO?", "ONL?", "VMI?", "VMA?", "TMN?", "TMX?", "VOL?")
    with GcsSimulator(voltages=[12.0], without=absent) as simulator:
        found = device_at(simulator).open()
        assert not {line.split()[0] for line in simulator.received} & set(absent)
    assert (found.setpoints, found.lowest, found.highest) == ((12.0,), (-float("inf"),), (float("inf"),))
    assert any("VOL?" in note for note in found.notes)


def test_a_cycle_writes_and_reads_in_units_of_the_stage():
    channels = [Channel("2", gain=10.0, scale=-1e-9, offset=1e-3), Channel("1")]
    with GcsSimulator(["1", "2"], without=["PUN?"]) as simulator:
        device = device_at(simulator, *channels)
        found = device.open()
        reading = device.write([80.0, 30.0])
        at = simulator.voltage("1"), simulator.voltage("2")
        told = simulator.stage.step(1e9, [at[0], at[1]])
    assert at == (30.0, 8.0)
    assert reading.voltages == (80.0, 30.0)
    assert found.highest == (1200.0, 120.0)
    assert reading.positions == pytest.approx([1e-3 - 1e-3 * told[1], told[0]], abs=1e-9)


@pytest.mark.parametrize(("unit", "scale"), [("MM", 1e-3), ("UM", 1e-6), ("NM", 1e-9)])
def test_the_unit_is_what_the_controller_tells(unit, scale):
    with GcsSimulator(unit=unit, voltages=[40.0]) as simulator:
        device = device_at(simulator)
        found = device.open()
        assert device.channels[0].scale == scale
        assert found.units == (unit,)
        assert found.travel == pytest.approx((25e-6,))
        # Of millimetres six decimals are a nanometre.
        assert found.reading.positions == pytest.approx(simulator.move(), abs=2e-9)


@pytest.mark.parametrize("given", [1e-6, -1e-6, 1e-9, 1.0])
def test_a_scale_of_another_unit_is_refused(given):
    with GcsSimulator(unit="MM") as simulator, pytest.raises(UnsuitableError, match="MM.*sensor_scale") as refused:
        device_at(simulator, Channel("1", scale=given)).open()
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize("given", [1e-6, -1e-6, 1.02e-6])
def test_a_sign_and_a_correction_are_no_other_unit(given):
    with GcsSimulator() as simulator:
        device = device_at(simulator, Channel("1", scale=given))
        device.open()
        assert device.channels[0].scale == given


def test_without_the_question_it_is_a_micrometre_or_what_is_given():
    with GcsSimulator(["1", "2"], without=["PUN?"]) as simulator:
        device = device_at(simulator, Channel("1"), Channel("2", scale=1e-3))
        found = device.open()
        assert "PUN?" not in {line.split()[0] for line in simulator.received}
    assert [channel.scale for channel in device.channels] == [1e-6, 1e-3]
    assert found.units == ("", "")


@pytest.mark.parametrize(("unit", "scale"), [("µm", 1e-6), ("um", 1e-6), ("Micron", 1e-6), ("M", 1.0)])
def test_units_by_their_other_names(unit, scale):
    device = make_device("gcs", "192.0.2.1", [Channel("1")])
    device.take_units([unit])
    assert device.channels[0].scale == scale


def test_a_unit_that_is_no_length_needs_a_scale():
    device = make_device("gcs", "192.0.2.1", [Channel("1"), Channel("2", scale=1e-7)])
    with pytest.raises(UnsuitableError, match="MRAD.*sensor_scale"):
        device.take_units(["MRAD", "MRAD"])
    device = make_device("gcs", "192.0.2.1", [Channel("2", scale=1e-7)])
    device.take_units(["MRAD"])
    assert device.channels[0].scale == 1e-7


@pytest.mark.parametrize("kind", FAULTS)
def test_a_fault_is_told_and_a_new_opening_goes_on(kind):
    with GcsSimulator(voltages=[20.0]) as simulator:
        device = device_at(simulator)
        device.open()
        simulator.fault = Fault(kind, seconds=0.25 if kind == LATE else 0.0)
        with pytest.raises(ERRORS[kind], match=f"^gcs {simulator.address}: "):
            # The second of two answers may come after the first has been read.
            for _ in range(2):
                device.read()
        before = list(simulator.log)
        for _ in range(20):
            try:
                found = device.open()
                break
            except LinkError:
                assert kind in (LATE, LOST)
        assert found.setpoints == (20.0,) and simulator.log == before == []
        assert device.write([21.0]).voltages == (21.0,)


@pytest.mark.parametrize("question", ["*IDN?", "HLP?", "SAI?", "SVO?", "VOL?", "SVA?", "VMA?", "POS?", "ERR?"])
@pytest.mark.parametrize("kind", [SILENT, HALF, NONSENSE])
def test_faults_at_opening(kind, question):
    with GcsSimulator(voltages=[20.0]) as simulator:
        simulator.fault = Fault(kind, question)
        device = device_at(simulator)
        # An identity may be any text.
        if (kind, question) != (NONSENSE, "*IDN?"):
            with pytest.raises(DeviceError):
                device.open()
        device.open()
        assert simulator.log == []


def test_an_error_code_names_command_and_meaning():
    with GcsSimulator() as simulator:
        device = device_at(simulator)
        device.open()
        with pytest.raises(RefusedError, match=r"302 \(voltage out of limits\).*SVA 1 130"):
            device.write([130.0])
        assert simulator.log == []


def test_an_old_error_is_not_taken_for_one_of_the_first_command():
    with GcsSimulator() as simulator:
        simulator._error = 10
        device = device_at(simulator)
        assert any("10" in note for note in device.open().notes)
        device.write([1.0])


@pytest.mark.parametrize("units", [0.5, 2.0])
def test_a_command_that_is_not_in_volts_is_refused(units):
    with GcsSimulator(voltages=[40.0], units_per_volt=units) as simulator:
        with pytest.raises(UnsuitableError, match=f"SVA\\? tells {40 * units:g}, VOL\\? 40 V"):
            device_at(simulator).open()
        assert simulator.log == []


@pytest.mark.parametrize(
    ("settings", "channel", "named"),
    [
        ({"without": ("SVA",)}, "1", "SVA"),
        ({"without": ("POS?",)}, "1", "POS"),
        ({"without": ("VOL?", "SVA?")}, "1", "VOL"),
        ({}, "3", "'3'.*1"),
    ],
)
def test_controllers_that_cannot_be_used(settings, channel, named):
    with GcsSimulator(**settings) as simulator, pytest.raises(UnsuitableError, match=named):
        device_at(simulator, Channel(channel)).open()


def test_an_axis_that_an_analog_input_moves_is_refused():
    with GcsSimulator() as simulator:
        simulator.online["1"] = False
        with pytest.raises(UnsuitableError, match="ONL"):
            device_at(simulator).open()


def test_a_servo_is_told_and_switched_off_without_a_motion():
    with GcsSimulator(voltages=[33.0], servo=True) as simulator:
        device = device_at(simulator)
        assert device.open().servo == (True,)
        assert "SVO 1 0" not in simulator.received
        found = device.release_servo()
        assert found.servo == (False,) and found.setpoints == (33.0,) and simulator.log == []
        assert any("33.000 to 33.000 V" in note for note in found.notes)


def test_nobody_listens():
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
    device = make_device("gcs", f"127.0.0.1:{port}", [Channel("1")])
    with pytest.raises(LinkError, match=str(port)):
        device.open()
    with pytest.raises(LinkError):
        device.read()
    device.close()


def test_somebody_else_listens():
    with socket.create_server(("127.0.0.1", 0)) as server:
        device = make_device("gcs", "{}:{}".format(*server.getsockname()), [Channel("1")])
        with pytest.raises(LinkError, match=r"\*IDN\?"):
            device.open()


@pytest.mark.parametrize("address", ["", ":50000", "host:", "host:port", "host:0", "host:70000"])
def test_addresses_that_are_none(address):
    with pytest.raises(UsageError, match="address"):
        make_device("gcs", address, [Channel("1")])


def test_the_port_is_that_of_the_manual():
    assert make_device("gcs", "192.0.2.1", [Channel("1")])._stream._port == 50_000


def test_unknown_devices():
    with pytest.raises(UsageError, match="gcs"):
        make_device("abacus", "host:1", [Channel("1")])
