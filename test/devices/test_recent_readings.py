"""A sensor that is slower than the cycle of the driver."""

import numpy as np
import pytest

from slpi_ros.devices.recent_readings import RecentReadings
from slpi_ros.drivers.base import Reading


def heard(rows, noise=8e-9, cycles=4000):
    rng = np.random.default_rng(1)
    v = 50.0 - 50.0 * np.cos(2.0 * np.pi * np.arange(cycles) / 1000.0)
    y = 2e-7 * v + rng.normal(0.0, noise, cycles)
    shown = y[np.arange(cycles) // rows * rows]
    recent = RecentReadings()
    for k in range(cycles):
        recent.note(Reading(k * 10**6, (float(v[k]), float(v[k])), (float(shown[k]), float(y[k]))))
    return recent


@pytest.mark.parametrize("rows", [1, 2, 4, 10])
def test_the_cycles_of_each_channel(rows):
    recent = heard(rows)
    assert recent.rows() == pytest.approx([rows, 1.0], rel=0.05)


def test_it_is_kept_while_the_stage_rests():
    recent = heard(4)
    assert recent.rows()[0] == pytest.approx(4.0, rel=0.05)
    for k in range(5_000):
        recent.note(Reading(k, (0.0, 0.0), (1e-6, 1e-6)))
    assert recent.rows()[0] == pytest.approx(4.0, rel=0.05)
    assert RecentReadings().rows() == []
