"""A monitor of the sensor taken as the drive is told, and not praised."""

import numpy as np
import pytest
from identification.records import calibration, record_of

import slpi_ros
from slpi_ros.reports.text import NO_DRIVE, model_limits


@pytest.mark.parametrize("scatter", [0.0, 4e-3])
def test_a_displacement_that_is_a_straight_line_of_the_voltage_is_told(scatter):
    record = calibration(2)[0]
    y = record.displacement["x"]
    monitor = 0.3 + y / 1.25e-6 + scatter * np.random.default_rng(0).standard_normal(y.size)
    model = slpi_ros.identify(record_of(record.t, monitor, y))
    assert model_limits(model) == {"x": NO_DRIVE}


def test_a_stage_with_hysteresis_is_none():
    assert NO_DRIVE not in model_limits(slpi_ros.identify(calibration(2)[0])).values()
