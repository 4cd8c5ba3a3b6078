"""A model in words."""

from dataclasses import replace

import numpy as np
import pytest

from slpi_ros.effects.hum import Hum, Line
from slpi_ros.effects.lag import Lag
from slpi_ros.hysteresis.prandtl_ishlinskii import PrandtlIshlinskii
from slpi_ros.model.axis_model import AxisModel, FitQuality, Start
from slpi_ros.model.stage_model import StageModel
from slpi_ros.reports.text import describe_axis, model_limits, unexplained

SHAPE = PrandtlIshlinskii(np.array([0.0, 0.2]), np.array([4e-7, 4e-7]))


@pytest.mark.parametrize(("noise", "error", "limited"), [(1e-9, 1e-9, False), (2e-8, 2e-8, True), (1e-9, 1e-8, True)])
def test_a_model_is_limited_by_its_error_or_by_a_noisy_sensor(noise, error, limited):
    quality = FitQuality(error, 2e-9, error, noise, 3, 0.1, "test")
    axis = AxisModel("pi", SHAPE, Start(0.0, 0.0), (0.0, 1.0), (0.0, 1e-6), quality)
    assert set(model_limits(StageModel({"x": axis}))) == ({"x"} if limited else set())


@pytest.mark.parametrize(
    ("weights", "noise", "error", "stroke", "diagnosed"),
    [
        ((4e-7, 4e-7), 1e-9, 1e-8, 1e-6, True),
        ((4e-7, 4e-7), 2e-8, 2e-8, 1e-6, False),  # the sensor
        ((8e-7, 0.0), 1e-9, 1e-9, 1e-6, False),  # a monitor
        ((4e-3, 4e-3), 1e-5, 1e-4, 1e-2, False),  # another unit
    ],
)
def test_a_diagnosis_is_advised_for_an_error_of_unknown_cause_alone(weights, noise, error, stroke, diagnosed):
    quality = FitQuality(error, 2e-9, error, noise, 3, 0.1, "test")
    shape = PrandtlIshlinskii(np.array([0.0, 0.2]), np.array(weights))
    axis = AxisModel("pi", shape, Start(0.0, 0.0), (0.0, 1.0), (0.0, stroke), quality)
    (limit,) = model_limits(StageModel({"x": axis})).values()
    assert unexplained(limit) == diagnosed


def test_effects_are_told_one_by_one():
    quality = FitQuality(1e-9, 2e-9, 3e-9, 0.0, 3, 0.1, "test")
    axis = AxisModel("pi", SHAPE, Start(0.0, 0.0), (0.0, 1.0), (0.0, 1e-6), quality)
    assert describe_axis(axis)[-1] == "effects: none"
    lag, hum = Lag(0.015), Hum((Line(50.0, 20e-9, 0.0),))
    *_, before, one, other = describe_axis(replace(axis, effects=(hum, lag)))
    assert before.startswith("from 3 samples")
    assert one == f"lag: {lag.describe()}" and "15" in one and other == f"hum: {hum.describe()}" and "20 nm" in other
