"""What a path or a record does beyond the record of a model."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from slpi_ros.arrays.rates import fastest
from slpi_ros.excitation.drives import calibration_drive
from slpi_ros.hysteresis.prandtl_ishlinskii import PrandtlIshlinskii
from slpi_ros.identification.fit import identify
from slpi_ros.io.record import Record
from slpi_ros.model.axis_model import AxisModel, FitQuality, Start
from slpi_ros.model.coverage import FASTER, fastest_displacement, path_beyond, record_beyond

# 20 µm over 100 V, recorded at up to 200 V/s or 40 µm/s.
SHAPE = PrandtlIshlinskii(np.array([0.0]), np.array([2e-7]))
QUALITY = FitQuality(1e-9, 2e-9, 3e-9, 1e-9, 100, 0.5, "test", fastest=200.0)
AXIS = AxisModel("pi", SHAPE, Start(0.0, 0.0), (0.0, 100.0), (0.0, 20e-6), QUALITY)


def ramp(rate: float, high: float, low: float = 0.0, samples: int = 2001) -> tuple[np.ndarray, np.ndarray]:
    """Return times and a triangle between two levels at a rate."""
    seconds = 2 * (high - low) / rate
    t = np.linspace(0.0, seconds, samples)
    return t, low + (high - low) * (1.0 - np.abs(2.0 * t / seconds - 1.0))


@given(st.floats(1e-3, 1e6), st.floats(1e-6, 1e3))
def test_the_rate_of_a_triangle_is_that_of_its_sides(rate, high):
    assert fastest(*ramp(rate, high)) == pytest.approx(rate, rel=1e-6)


def test_a_single_jump_and_a_late_stamp_do_not_count():
    t, v = ramp(10.0, 100.0)
    jumped = np.concatenate([[-5.0], v])
    assert fastest(np.concatenate([[t[0] - 1e-3], t]), jumped) == pytest.approx(10.0, rel=0.01)
    late = t.copy()
    late[500:503] = t[503] - 1e-9
    assert fastest(late, v) == pytest.approx(10.0, rel=0.01)
    assert fastest(np.empty(0), np.empty(0)) == fastest(np.arange(9.0), np.ones(9)) == 0.0


@given(st.floats(0.01, 100.0))
def test_a_path_is_faster_beyond_the_ratio(times):
    t, y = ramp(times * 40e-6, 20e-6)
    told = path_beyond(AXIS, t, y)
    assert ("µm/s" in told) == (times > FASTER) or abs(times - FASTER) < 1e-3
    t, v = ramp(times * 200.0, 100.0)
    assert ("V/s" in record_beyond(AXIS, t, v)) == (times > FASTER) or abs(times - FASTER) < 1e-3


def test_both_figures_are_told():
    told = path_beyond(AXIS, *ramp(230e-6, 20e-6))
    assert "230 µm/s" in told and "40 µm/s" in told and ";" not in told
    told = path_beyond(AXIS, *ramp(10e-6, 25e-6))
    assert "0 to 25 µm" in told and "0 to 20 µm" in told and "µm/s" not in told


def test_an_older_document_tells_of_the_range_only():
    old = replace(AXIS, quality=replace(QUALITY, fastest=None))
    assert fastest_displacement(old) is None and path_beyond(old, *ramp(1.0, 20e-6)) == ""
    assert path_beyond(old, *ramp(1.0, 30e-6)) and record_beyond(old, *ramp(1e9, 100.0)) == ""


def test_where_nothing_is_desired_nothing_is_told():
    t, y = ramp(10e-6, 20e-6)
    gaps = np.where(t < t[-1] / 3, np.nan, y)
    assert path_beyond(AXIS, t, gaps) == path_beyond(AXIS, t, np.full(t.size, np.nan)) == ""


def test_a_model_is_not_beyond_its_own_record():
    t, v = calibration_drive(0.0, 100.0, duration=20.0, rate=100.0)
    y = 2e-7 * np.interp(t - 0.01, t, v) + 1e-8 * np.random.default_rng(1).normal(size=t.size)
    stamps = np.rint(t * 1e9).astype(np.int64)
    axis = identify(Record(stamps, {"x": v}, {"x": y}), kind="pi").axes["x"]
    assert axis.quality.fastest == pytest.approx(fastest(t, v), rel=0.02)
    assert record_beyond(axis, t, v) == path_beyond(axis, t, 2e-7 * v) == ""
    assert record_beyond(axis, t / 3, v)
