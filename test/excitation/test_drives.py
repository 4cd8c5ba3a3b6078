"""Drives of whole stages: which axis moves when, from where, and within what."""

import numpy as np
import pytest
from excitation.loops import fastest
from hypothesis import given, settings
from hypothesis import strategies as st

from slpi_ros.errors import UsageError
from slpi_ros.excitation.drives import DRIVES, excite
from slpi_ros.io import tables

LIMITS = {"voltage_min": 0.0, "voltage_max": 100.0}


@settings(max_examples=40)
@given(
    st.sampled_from(DRIVES),
    st.floats(-100.0, 50.0),
    st.floats(1.0, 200.0),
    st.floats(0.0, 1.0),
    st.sampled_from([0.0, 2.5, 10.0]),
    st.integers(0, 2**31 - 1),
)
def test_limits_slew_and_duration_are_kept(drive, low, span, share, slew, seed):
    start, slew_limit = low + share * span, slew * span
    axes = ("x", "y")
    given = {"voltage_min": low, "voltage_max": low + span, "start": start, "slew_limit": slew_limit}
    made = excite(axes, **given, duration=60.0, rate=100.0, seed=seed, drive=drive)
    assert made.axes == axes and made.rate == 100.0
    np.testing.assert_allclose(np.diff(made.t), 0.01)
    assert made.t[0] == 0.0 and made.t[-1] == 60.0
    for v in made.voltage.values():
        assert v.min() >= low and v.max() <= low + span
        assert v.min() == pytest.approx(low, abs=1e-9 * span) and v.max() == pytest.approx(low + span, abs=1e-9 * span)
        assert v[[0, -1]] == pytest.approx(start, abs=1e-9 * span)
        assert not slew or fastest(made.t, v) <= slew_limit * (1 + 1e-6)
    again = excite(axes, **given, duration=60.0, rate=100.0, seed=seed, drive=drive)
    assert all(np.array_equal(made.voltage[axis], again.voltage[axis]) for axis in axes)


def test_axes_take_turns_with_drives_of_their_own():
    made = excite(
        ("x", "y"), voltage_min=(0.0, -10.0), voltage_max=(100.0, 50.0), slew_limit=(0.0, 300.0), duration=60.0
    )
    x, y = made.voltage["x"], made.voltage["y"]
    half = x.size // 2
    assert np.all(x[half:] == 0.0) and np.all(y[: half + 1] == -10.0)
    assert (x.min(), x.max(), y.min(), y.max()) == (0.0, 100.0, -10.0, 50.0)
    assert fastest(made.t, y) <= 300.0 * (1 + 1e-9)
    assert np.max(np.abs(x[:half] / 100.0 - (y[half:-1] + 10.0) / 60.0)) > 0.1
    np.testing.assert_array_equal(x[: half + 1], excite(**LIMITS, duration=30.0).voltage["x"])


def test_a_drive_from_the_middle_goes_to_the_low_end_first_and_back_last():
    v = excite(**LIMITS, start=40.0, slew_limit=100.0).voltage["x"]
    assert v[0] == v[-1] == 40.0
    bottom, top = int(np.argmin(v)), int(np.argmax(v))
    assert 0 < bottom < top
    assert np.all(np.diff(v[: bottom + 1]) <= 0.0) and v[-1000:].min() == 0.0


def test_a_drive_is_a_command_table(tmp_path):
    made = excite(("x", "y"), **LIMITS, duration=40.0, drive="cross_coupling")
    tables.write_table(tmp_path / "drive.csv", made.t, made.voltage, "V")
    t, voltage = tables.read_table(tmp_path / "drive.csv", "V")
    np.testing.assert_allclose(t, made.t, atol=1e-9)
    assert list(voltage) == ["x", "y"]
    np.testing.assert_array_equal(voltage["y"], made.voltage["y"])


@pytest.mark.parametrize("drive", DRIVES)
def test_every_drive_says_what_it_is_good_for(drive):
    axes = ("x", "y") if drive == "cross_coupling" else ("x",)
    assert excite(axes, **LIMITS, drive=drive).why.endswith(".")


@pytest.mark.parametrize(
    ("given", "says"),
    [
        ({"axes": ()}, r"\[\]"),
        ({"axes": ("x", "x")}, r"\['x', 'x'\]"),
        ({"axes": ("x", "")}, r"\['x', ''\]"),
        ({"drive": "friction"}, "'friction'.*calibration"),
        ({"axes": ("x", "y"), "voltage_max": (1.0, 2.0, 3.0)}, r"\b3\b.*voltage_max.*\b2\b"),
        ({"start": 120.0}, "120 V.*0.*100 V"),
        ({"start": float("nan")}, "nan V"),
        ({"start": 90.0, "slew_limit": 5.0}, "90 V.*0 V.*30 s"),
        ({"axes": tuple("abcdefgh"), "slew_limit": 100.0}, "3.75 s"),
        ({"axes": tuple("abcdefgh"), "duration": 0.01}, "0.0 s|0.00125 s"),
    ],
)
def test_drives_that_cannot_be_made(given, says):
    with pytest.raises(UsageError, match=says):
        excite(**(LIMITS | given))
