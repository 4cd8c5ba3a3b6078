"""The compensator's parameters without a node: what they mean, together, and what makes no sense."""

import math
import re
from array import array
from pathlib import Path
from typing import Any

import pytest
import yaml

rclpy = pytest.importorskip("rclpy")

from slpi_ros.compensator.loop_filter import Notch  # noqa: E402
from slpi_ros.errors import UsageError  # noqa: E402
from slpi_ros.model.limits import Limits  # noqa: E402
from slpi_ros.nodes.compensator_parameters import DECLARATIONS, CompensatorSettings  # noqa: E402

CONFIG = Path(__file__).resolve().parents[2] / "config"
COMPENSATORS = sorted(path for path in CONFIG.glob("*.yaml") if path.stem not in ("exciter", "simulated_device"))
DEFAULTS = {entry.name: entry.default for entry in DECLARATIONS}


def settings(**values: Any) -> CompensatorSettings:
    return CompensatorSettings.of(DEFAULTS | values)


def test_defaults_limit_voltage_slew_and_correction_and_change_nothing_on_their_own():
    told = settings()
    # The voltage range in 0.1 s, and a fifth of it.
    assert told.limits == (Limits(0.0, 100.0, 1000.0),) and told.loops[0].correction_limit == 20.0
    assert settings(voltage_min=-20.0, voltage_max=130.0).limits == (Limits(-20.0, 130.0, 1500.0),)
    assert settings(slew_limit=0.0).limits == (Limits(0.0, 100.0),)
    assert told.starts == ("auto",) and told.reset_spans == ((0.0, 100.0),) and told.period == 1e-3
    assert not (told.safety.ramps_on_timeout or told.safety.ramps_on_deactivate or told.loops[0].enabled)
    assert told.safety.command_timeout == told.time.max_age == told.values["realtime_priority"] == 0


def test_one_value_stands_for_all_axes_and_integers_for_doubles():
    told = settings(
        axes=["x", "y"], voltage_min=[0, 0], voltage_max=[100, 80.5], slew_limit=2000, acceleration_limit=[0, 5],
        safe_voltage=1, kp=[1, 2], derivative_filter=0, command_timeout=1,
    )  # fmt: skip
    assert told.limits == (Limits(0.0, 100.0, 2000.0), Limits(0.0, 80.5, 2000.0, 5.0))
    assert told.safety.voltages == (1.0, 1.0)
    assert [loop.gains.proportional for loop in told.loops] == [1.0, 2.0]
    assert told.safety.command_timeout == 1.0


WRONG = [
    {"on_timeout": "explode"}, {"on_deactivate": ""}, {"reset_to": "home"}, {"reset_cycles": 0}, {"reset_cycles": 2.5},
    {"reset_cycles": True}, {"reset_rate": 0}, {"ramp_rate": -1.0}, {"realtime_priority": 100}, {"kp": [1.0, 2.0]},
    {"ki": -1.0}, {"kd": math.nan}, {"derivative_filter": math.inf}, {"acceleration_limit": -1.0}, {"time_jump": 0.0},
    {"start_voltage": "there"}, {"start_voltage": "1,2"}, {"start_voltage": "inf"}, {"start_voltage": "500"},
    {"output_rate": 0.0}, {"correction_limit": -1.0}, {"reset_min": 120.0}, {"reset_max": -1.0}, {"slew_limit": -1.0},
    {"learn": "always"}, {"learn_period": -1.0}, {"learn_limit": 0.0},
    {"max_age": -1.0}, {"drift_alarm": -3.0}, {"measurement_timeout": "long"}, {"start_memory": "yesterday"},
]  # fmt: skip


@pytest.mark.parametrize("values", WRONG, ids=str)
def test_a_value_that_makes_no_sense_is_named(values):
    (name,) = values
    with pytest.raises(UsageError) as caught:
        settings(**values)
    assert name in str(caught.value) and "\n" not in str(caught.value)


def test_each_axis_has_its_notches():
    told = settings(
        axes=["x", "y"], measurement_filter=[0, 1e-3],
        **{"notch_frequency.x": [120, 310.0], "notch_damping.x": [0.02], "notch_width.x": array("d", [0.7, 1.5])},
    ).loops  # fmt: skip
    assert told[0].gains.notches == (Notch(120.0, 0.02, 0.7), Notch(310.0, 0.02, 1.5)) and told[1].gains.notches == ()
    assert [loop.gains.measurement_filter for loop in told] == [0.0, 1e-3]
    # A number is a list of one, and [0.0] none.
    assert settings(**{"notch_frequency.x": 120.0}).loops[0].gains.notches == (Notch(120.0),)
    assert settings(**{"notch_frequency.x": [0.0, 90.0]}).loops[0].gains.notches == (Notch(90.0),)
    assert settings(**{"notch_frequency.x": None}).loops[0].gains.notches == ()


@pytest.mark.parametrize(
    "values",
    [
        {"notch_frequency.x": [500.0]}, {"notch_frequency.x": [-1.0]}, {"notch_frequency.x": "all"},
        {"notch_frequency.x": [math.inf]}, {"notch_frequency.x": [90.0], "output_rate": 100.0},
        {"notch_damping.x": [0.1, 0.2]}, {"notch_width.x": [0.0]}, {"measurement_filter": -1.0},
        {"notch_frequency.x": [90.0, 80.0, 70.0], "notch_width.x": [1.0, 1.0]},
    ], ids=str,
)  # fmt: skip
def test_a_notch_that_makes_no_sense_is_named_in_one_line(values):
    with pytest.raises(UsageError) as caught:
        settings(**values)
    assert next(iter(values)).split(".")[0].split("_")[0] in str(caught.value) and "\n" not in str(caught.value)


def test_learning_is_off_and_takes_what_yaml_makes_of_on_and_off():
    told = settings().values
    assert (told["learn"], told["learn_period"], told["learn_limit"]) == ("off", 0.0, None)
    assert [settings(learn=given).values["learn"] for given in (True, False, "hold")] == ["on", "off", "hold"]
    assert settings(axes=["x", "y"], learn_limit=[1e-7, 2e-7]).values["learn_limit"] == (1e-7, 2e-7)
    assert settings(learn="on", trajectory_output="block").values["learn"] == "on"


@pytest.mark.parametrize("use", [{"on_timeout": "safe"}, {"on_deactivate": "safe"}, {"reset_to": "safe"}])
def test_a_safe_voltage_must_be_within_the_limits_where_it_is_used(use):
    settings(safe_voltage=200.0)
    with pytest.raises(UsageError) as caught:
        settings(safe_voltage=200.0, **use)
    assert "safe_voltage" in str(caught.value) and "200" in str(caught.value)


def test_an_array_is_shown_as_it_was_given():
    # rclpy hands over arrays of its own.
    with pytest.raises(UsageError) as caught:
        settings(axes=["x", "y"], voltage_max=array("d", [80.0]))
    assert "voltage_max" in str(caught.value) and "[80.0]" in str(caught.value)


def parameters(path: Path, commented: bool = False) -> dict[str, Any]:
    """Return what a file sets, and what it would set without the # before parameters."""
    text = re.sub(r"^    #([\w.]+:)", r"    \1", path.read_text(), flags=re.M) if commented else path.read_text()
    return yaml.safe_load(text)["/**"]["ros__parameters"]


@pytest.mark.parametrize("path", COMPENSATORS, ids=lambda path: path.stem)
def test_config_files_hold_known_parameters(path):
    told = parameters(path)
    assert told.keys() <= DEFAULTS.keys()
    settings(**told)


def test_one_file_shows_every_parameter_and_its_default():
    path = CONFIG / "one_axis.yaml"
    told = parameters(path, commented=True).items()
    shown = {re.sub(r"\.x$", ".AXIS", name): str(value) for name, value in told}
    assert shown == {name: str(value) for name, value in (DEFAULTS | {"slew_limit": 1000.0}).items()}
    assert parameters(path).keys() == {"axes", "model_file", "voltage_min", "voltage_max", "slew_limit"}


def test_every_parameter_is_described():
    for entry in DECLARATIONS:
        described = entry.descriptor()
        assert described.description.endswith((".", ")."))
        assert described.read_only == entry.read_only
        # NaN, which stands for a default of its own, is in no range.
        ranged = entry.between and entry.number and not (isinstance(entry.default, float) and math.isnan(entry.default))
        assert bool(described.floating_point_range) == bool(ranged)
        assert bool(described.integer_range) == bool(entry.between and not entry.number)
