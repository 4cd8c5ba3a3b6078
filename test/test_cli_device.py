"""``slpi doctor --device``: what is there, what will bite, and the YAML to start with; nothing is written."""

import json
import math

import pytest
import yaml
from drivers.kinds import KINDS
from forked import completed

from slpi_ros.drivers.base import Channel
from slpi_ros.drivers.registry import make_device
from slpi_ros.reports.device import RATES, SENSOR_SCALES, device_parameters
from slpi_ros.simulation.devices.gcs import GcsSimulator
from slpi_ros.simulation.devices.labjack import LabjackSimulator


def doctor(*arguments):
    return completed("slpi_ros.cli:main", ["doctor", *map(str, arguments)])


@pytest.mark.parametrize(
    "name", ["gcs", *(pytest.param(name, marks=pytest.mark.long) for name in ("labjack", "nidaqmx", "nv200", "mdt"))]
)
def test_a_device_is_read_and_a_yaml_is_printed(name):
    kind = KINDS[name]
    with kind.simulate(voltages=[20.0]) as simulator:
        done = doctor("--device", f"{kind.device}:{kind.address.format(simulator.address)}")
        assert simulator.log == []
        assert not [line for line in simulator.received if line.startswith(("write", "SVA ", "set,", "SVO "))]
    assert done.returncode == 0, done.stdout + done.stderr
    text = done.stdout[done.stdout.index("driver:\n") :]
    values = yaml.safe_load(text[: text.index("\n\n")])["driver"]["ros__parameters"]
    assert values["device"] == kind.device and values["channels"] == [kind.axes[0]]
    # A PI controller tells its unit.
    told = math.nan if kind.device == "gcs" else SENSOR_SCALES.get(kind.device, 1e-6)
    assert values["rate"] in RATES and values["sensor_scale"] == pytest.approx(told, nan_ok=True)
    (low,), (high,) = values["voltage_min"], values["voltage_max"]
    at = 20.0 / kind.gain
    assert low <= at <= high and high - low <= 10.0
    # An amplifier of 20 V/V behind it moves the stage by no more than a tenth of its range.
    assert (high - low) * kind.gain <= (10.0 if kind.gain == 1.0 else 20.0)
    assert f"{at:.4f} V" in done.stdout


@pytest.mark.parametrize(("cycle", "rate"), [(0.0004, 1000.0), (0.0006, 500.0), (0.02, 20.0), (1.0, 20.0)])
def test_the_rate_leaves_time_for_the_writing_and_a_y_is_a_name(cycle, rate):
    with GcsSimulator(["1", "2"]) as simulator:
        device = make_device("gcs", simulator.address, [Channel("1"), Channel("2")])
        lines = device_parameters("gcs", simulator.address, device.open(), ["1", "2"], cycle)
        device.close()
    values = yaml.safe_load("\n".join(lines))["driver"]["ros__parameters"]
    assert values["rate"] == rate and values["axes"] == ["x", "y"]


def test_what_is_dangerous_fails():
    with GcsSimulator(["1", "2"], servo=True) as simulator:
        done = doctor("--device", f"gcs:{simulator.address}", "--channels", "1", "2")
    assert done.returncode == 1 and "servo" in done.stdout and "FAILED: 2" in done.stdout
    with LabjackSimulator(watchdog={61_600: 1, 61_620: 1}) as simulator:
        done = doctor("--device", f"labjack:{simulator.address}", "--json")
        assert simulator.log == []
    assert done.returncode == 1 and "WATCHDOG_RESET_ENABLE" in json.loads(done.stdout)["checks"][0]["text"]


@pytest.mark.parametrize(
    ("simulated", "code", "told"),
    [({"unit": "MM"}, 0, "MM"), ({"unit": "MM", "without": ["PUN?"]}, 1, "25 nm"), ({"unit": "NM"}, 0, "NM")],
)
def test_the_unit_of_a_controller(simulated, code, told):
    with GcsSimulator(**simulated) as simulator:
        done = doctor("--device", f"gcs:{simulator.address}")
    assert done.returncode == code and told in done.stdout


@pytest.mark.parametrize("device", ["abacus:1", "gcs:host:port", "serial:/dev/x", "gcs"])
def test_what_is_no_device(device):
    done = doctor("--device", device)
    assert done.returncode == 2 and len(done.stderr.splitlines()) == 1


def test_nobody_answers():
    done = doctor("--device", "gcs:127.0.0.1:1")
    assert done.returncode == 1 and "no connection" in done.stdout
