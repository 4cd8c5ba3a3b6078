"""Desired displacements against the rate of the record."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from slpi_ros.compensator.path_watch import PathWatch
from slpi_ros.hysteresis.prandtl_ishlinskii import PrandtlIshlinskii
from slpi_ros.model.axis_model import AxisModel, FitQuality, Start
from slpi_ros.model.coverage import FASTER

# 20 µm over 100 V, recorded at up to 200 V/s or 40 µm/s.
QUALITY = FitQuality(1e-9, 2e-9, 3e-9, 1e-9, 100, 0.5, "test", fastest=200.0)
SHAPE = PrandtlIshlinskii(np.array([0.0]), np.array([2e-7]))
AXIS = AxisModel("pi", SHAPE, Start(0.0, 0.0), (0.0, 100.0), (0.0, 20e-6), QUALITY)


def told(y: np.ndarray, dt: float = 0.01, model: AxisModel = AXIS) -> str:
    watch = PathWatch(model)
    for each in y.tolist():
        watch.sample(dt, each)
    return watch.beyond


@given(st.floats(0.1, 10.0))
def test_a_stream_is_faster_beyond_the_ratio(times):
    said = told(np.arange(40) * times * 40e-6 * 0.01)
    assert (said != "") == (times > FASTER) or abs(times - FASTER) < 1e-6
    assert not said or (f"{times * 40.0:.3g} µm/s" in said and "40 µm/s" in said)


@pytest.mark.parametrize("samples", [4, 6, 10, 40])
def test_a_sine_is_faster_however_often_it_is_sampled(samples):
    phase = 2 * np.pi * (np.arange(200) + 0.3) / samples
    # Three times the rate on average.
    size = 3.0 * 40e-6 * 0.01 * samples / 4.0
    assert told(10e-6 + size * np.sin(phase))
    assert not told(10e-6 + 0.3 * size * np.sin(phase))


def test_single_steps_are_not():
    assert not told(np.repeat([0.0, 5e-6, 2e-6, 15e-6], 20))


def test_an_older_model_has_no_rate():
    old = replace(AXIS, quality=replace(QUALITY, fastest=None))
    assert told(np.arange(40) * 1e-6) and not told(np.arange(40) * 1e-6, model=old)
