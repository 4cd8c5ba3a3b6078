"""A monitor of the sensor taken as the drive is told, and not praised; nor is another unit."""

from dataclasses import replace

import numpy as np
import pytest
from identification.records import calibration, record_of

import slpi_ros
from slpi_ros.model.axis_model import ABOVE_NOISE, RESOLUTION
from slpi_ros.reports.text import AT_NOISE, NO_DRIVE, model_good, model_limits, verdict

SENSOR = 1.25e-6  # m/V


@pytest.mark.parametrize(
    ("scatter", "bend"), [(0.0, 0.0), (4e-3, 0.0), (4e-3, 0.01)], ids=["exact", "noisy", "bent by a tenth"]
)
def test_a_displacement_that_follows_the_voltage_without_hysteresis_is_told(scatter, bend):
    record = calibration(2)[0]
    y = record.displacement["x"]
    read = 0.3 + y / SENSOR
    monitor = read + bend * read**2 + scatter * np.random.default_rng(0).standard_normal(y.size)
    model = slpi_ros.identify(record_of(record.t, monitor, y))
    assert model_limits(model) == {"x": NO_DRIVE}


def test_a_stage_with_hysteresis_is_none():
    model = slpi_ros.identify(calibration(2)[0])
    assert NO_DRIVE not in model_limits(model).values()


def test_an_error_above_the_noise_is_not_told_as_noise():
    model = slpi_ros.identify(calibration(2)[0])
    axis = model.axes["x"]
    low, high = axis.displacement_range
    error = 0.5 * RESOLUTION * (high - low)
    for noise, good in ((error, True), (error / (2.0 * ABOVE_NOISE), False)):
        quality = replace(axis.quality, held_out_rms=error, floor_rms=noise)
        other = replace(model, axes={"x": replace(axis, quality=quality)})
        assert not model_limits(other)
        assert (model_good(other) == AT_NOISE) is good
        assert verdict(model_limits(other), model_good(other)).startswith("GOOD: ")


def test_a_stroke_that_no_piezo_has_is_not_good():
    record = calibration(2)[0]
    model = slpi_ros.identify(record_of(record.t, record.voltage["x"], 1e3 * record.displacement["x"]))
    assert "unit" in model_limits(model)["x"]
