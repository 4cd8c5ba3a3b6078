"""Moves and holds: within limits, within slew, in just the time given."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from slpi_ros.errors import UsageError
from slpi_ros.excitation.legs import DriveSpec, Path

shares = st.floats(0.0, 1.0)
legs = st.lists(st.tuples(shares, st.floats(0.0, 3.0), st.booleans()), min_size=1, max_size=12)


def path_of(start, moves):
    path = Path(start)
    for share, seconds, straight in moves:
        path.to(share, seconds, straight=straight)
    return path


@given(shares, legs, st.sampled_from([0.0, 1.0, 50.0, 3000.0]), st.floats(1.0, 3.0))
def test_all_is_kept_to(start, moves, slew, patience):
    path = path_of(start, moves)
    least = DriveSpec(-10.0, 50.0, 1.0, 100.0, slew)
    spec = DriveSpec(-10.0, 50.0, patience * path.fewest_steps(least).sum() / 100.0, 100.0, slew)
    v = path.voltages(spec)
    assert v.shape == (spec.steps + 1,)
    assert v.min() >= -10.0 and v.max() <= 50.0
    if slew:
        assert np.max(np.abs(np.diff(v))) * 100.0 <= slew * (1 + 1e-9)
    # Every turn is there, in order.
    found = 0
    for share in [start, *(share for share, _, _ in moves)]:
        near = np.flatnonzero(np.abs(v[found:] - (-10.0 + 60.0 * share)) < 1e-9)
        assert near.size
        found += int(near[0])
    assert v[-1] == pytest.approx(-10.0 + 60.0 * moves[-1][0], abs=1e-9)


@pytest.mark.parametrize(("duration", "turn"), [(4.0, 1.0), (8.0, 2.0), (2.0, 0.5)])
def test_time_left_over_or_missing_is_shared_out(duration, turn):
    v = path_of(0.0, [(1.0, 1.0, False), (0.0, 3.0, False)]).voltages(DriveSpec(0.0, 1.0, duration, 100.0))
    assert int(np.argmax(v)) == pytest.approx(turn * 100.0, abs=2)


def test_straight_and_rounded_moves():
    spec = DriveSpec(0.0, 100.0, 1.0, 100.0)
    straight, rounded = Path(), Path()
    straight.to(1.0, 1.0, straight=True)
    rounded.to(1.0, 1.0)
    np.testing.assert_allclose(straight.voltages(spec), np.arange(101.0), atol=1e-9)
    v = rounded.voltages(spec)
    np.testing.assert_allclose(v + v[::-1], 100.0, atol=1e-9)
    steps = np.diff(v)
    assert steps[0] < 0.1 and steps[-1] < 0.1 and steps.max() == pytest.approx(np.pi / 2, rel=1e-3)


def test_a_slew_limit_takes_as_long_as_it_must():
    for straight, factor in ((True, 1.0), (False, np.pi / 2)):
        assert DriveSpec(0.0, 100.0, 30.0, 100.0, 50.0).quickest(0.5, straight) == pytest.approx(factor)
    assert DriveSpec(0.0, 100.0, 30.0, 100.0).quickest(0.5) == 0.0


@pytest.mark.parametrize(
    ("spec", "says"),
    [
        ((100.0, 0.0, 30.0, 100.0), "100.0 V"),
        ((0.0, float("inf"), 30.0, 100.0), "inf V"),
        ((0.0, float("nan"), 30.0, 100.0), "nan V"),
        ((0.0, 100.0, 0.0, 100.0), "0.0 s"),
        ((0.0, 100.0, 30.0, float("nan")), "nan Hz"),
        ((0.0, 100.0, 30.0, 100.0, -1.0), "-1.0 V/s"),
        ((0.0, 100.0, 30.0, 100.0, float("nan")), "nan V/s"),
        ((0.0, 100.0, 1e6, 1e3), "10000000"),
    ],
)
def test_specifications_of_no_drive(spec, says):
    with pytest.raises(UsageError, match=says):
        DriveSpec(*spec)


def test_too_little_time_says_how_much_is_needed():
    path = path_of(0.0, [(1.0, 1.0, True), (0.0, 1.0, True)])
    with pytest.raises(UsageError, match=r"\b2\b.*\b4 s\b.*100 Hz.*50 V/s.*3\.5 s"):
        path.voltages(DriveSpec(0.0, 100.0, 3.5, 100.0, 50.0))
    assert path.voltages(DriveSpec(0.0, 100.0, 4.0, 100.0, 50.0)).max() == 100.0


@pytest.mark.parametrize(("low", "high"), [(0.0, 1e9), (-1e9, 0.0), (0.0, np.nextafter(1e4, np.inf))])
def test_no_stage_takes_such_voltages(low, high):
    with pytest.raises(UsageError, match="10000 V"):
        DriveSpec(low, high, 1.0, 100.0)
    assert DriveSpec(-1e4, 1e4, 1.0, 100.0).span == 2e4
