"""The drive that covers a path."""

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from slpi_ros.excitation.drives import excite
from slpi_ros.excitation.path import with_path
from slpi_ros.hysteresis.reversals import reversals
from slpi_ros.model.coverage import fastest

RATE = 100.0


@st.composite
def voltage_paths(draw: st.DrawFn) -> np.ndarray:
    """Draw a path through some levels, V, each reached in some samples."""
    levels = draw(st.lists(st.floats(0.0, 100.0), min_size=2, max_size=12))
    steps = draw(st.lists(st.integers(1, 40), min_size=len(levels) - 1, max_size=len(levels) - 1))
    return np.interp(np.arange(sum(steps) + 1), np.cumsum([0, *steps]), levels)


def covered(v: np.ndarray, drive: np.ndarray) -> bool:
    """Return whether the drive holds the path sample by sample."""
    windows = np.lib.stride_tricks.sliding_window_view(drive, v.size)
    return bool((np.abs(windows - v).max(axis=1) < 1e-9).any())


@given(voltage_paths(), st.sampled_from([0.0, 0.5]), st.integers(0, 5))
def test_range_rates_and_turns_of_a_path_are_in_its_drive(v, rest, seed):
    base = excite(voltage_min=0.0, voltage_max=100.0, start=100.0 * rest, duration=10.0, rate=RATE, seed=seed)
    drive = with_path(base, {"x": v})
    whole = drive.voltage["x"]
    own = whole[base.t.size :]
    assert covered(v, own)
    assert own.min() <= v.min() and own.max() >= v.max()
    assert whole[0] == whole[-1] == 100.0 * rest and np.allclose(np.diff(drive.t), 1 / RATE)
    assume(np.ptp(v) > 1.0)
    # The way of the path is a part of the drive, and so are its turns, at the rate of the path and at a slower one.
    assert np.max(np.abs(np.diff(own))) >= np.max(np.abs(np.diff(v)))
    turns = v[reversals(v, 0.5)]
    found = own[reversals(own, 0.5)]
    assert all(np.abs(found - turn).min() < 0.5 for turn in turns[1:-1])


@given(voltage_paths(), st.floats(20.0, 500.0))
def test_the_limits_hold_for_the_path_too(v, slew):
    base = excite(voltage_min=20.0, voltage_max=80.0, slew_limit=slew, duration=60.0, rate=RATE)
    voltage = with_path(base, {"x": v}).voltage["x"]
    assert voltage.min() >= 20.0 and voltage.max() <= 80.0
    assert np.abs(np.diff(voltage)).max() * (RATE / slew) <= 1.0 + 1e-9


def test_the_rate_of_a_fast_path_is_in_its_drive():
    t = np.arange(500) / RATE
    v = 50.0 + 20.0 * np.sin(2 * np.pi * 12.0 * t)
    base = excite(voltage_min=0.0, voltage_max=100.0, duration=20.0, rate=RATE)
    drive = with_path(base, {"x": v})
    beyond = np.abs(np.diff(drive.voltage["x"])) * RATE > 0.9 * fastest(t, v)
    assert np.count_nonzero(beyond) >= 200 and np.abs(np.diff(base.voltage["x"])).max() * RATE < fastest(t, v)


def test_axes_move_one_after_the_other():
    base = excite(("x", "y"), voltage_min=0.0, voltage_max=100.0, duration=40.0, rate=RATE)
    v = 50.0 + 10.0 * np.sin(np.arange(300) / 10.0)
    drive = with_path(base, {"x": v, "y": v + 1.0})
    x, y = (np.abs(np.diff(drive.voltage[axis])) > 0.0 for axis in ("x", "y"))
    assert not (x & y).any() and covered(v, drive.voltage["x"]) and covered(v + 1.0, drive.voltage["y"])
    alone = with_path(base, {"y": v})
    assert (alone.voltage["x"][base.t.size :] == base.voltage["x"][-1]).all() and alone.axes == ("x", "y")
    assert drive.specs["x"].duration == pytest.approx(drive.t[-1])
