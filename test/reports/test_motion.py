"""What the drive does at each sample, on drives where it is known."""

import numpy as np
import pytest

from slpi_ros.reports.views import Motion


def triangle(noise=0.0):
    t = np.arange(0.0, 8.0, 0.01)
    return t, 50.0 * (1.0 - np.abs(1.0 - np.mod(t, 2.0))) + noise * np.random.default_rng(0).standard_normal(t.size)


@pytest.mark.parametrize("noise", [0.0, 0.02])
def test_speed_and_time_since_the_turn_of_a_triangle(noise):
    t, v = triangle(noise)
    motion = Motion.of(t, v)
    since = np.mod(t + 1e-9, 1.0)
    inside = (since > 0.1) & (since < 0.9) & (t < 7.0)
    assert np.allclose(np.abs(motion.speed[inside]), 50.0, atol=1e-6 + 150.0 * noise)
    assert np.array_equal(np.sign(motion.speed[inside]), np.where(np.mod(t[inside], 2.0) < 1.0, 1.0, -1.0))
    assert np.allclose(motion.since_turn[inside], since[inside], atol=0.0101)
    assert motion.runs.size == 9


def test_a_hold_counts_from_its_beginning():
    t = np.arange(0.0, 6.0, 0.01)
    v = np.interp(t, [0.0, 1.0, 3.0, 4.0, 6.0], [0.0, 40.0, 40.0, 90.0, 90.0])
    motion = Motion.of(t, v)
    for begins, ends in ((1.0, 3.0), (4.0, 6.0)):
        resting = (t > begins + 0.1) & (t < ends - 0.1)
        assert np.allclose(motion.since_turn[resting], t[resting] - begins, atol=0.02)


def test_branches_begin_where_return_point_memory_says():
    """Up to 80, an inner loop 30 to 60, and beyond the 80 where it closes: again the branch from 0."""
    corners = [0.0, 80.0, 30.0, 60.0, 10.0, 95.0]
    t = np.linspace(0.0, 5.0, 5001)
    v = np.interp(t, np.arange(6.0), corners)
    motion = Motion.of(t, v)
    expected = np.select(
        [t < 1.0, t < 2.0, t < 3.0, (t < 4.0) & (v > 30.0), t < 4.0, v < 80.0], [0.0, 80.0, 30.0, 60.0, 80.0, 10.0], 0.0
    )
    clear = np.min(np.abs(t[:, None] - np.arange(6.0)), axis=1) > 0.005
    clear &= (np.abs(v - 30.0) > 0.2) & (np.abs(v - 80.0) > 0.2)
    assert np.allclose(motion.branch_from[clear], expected[clear])


@pytest.mark.parametrize("size", [0, 1, 3, 200])
def test_what_stays_does_nothing(size):
    motion = Motion.of(np.arange(size) * 0.1, np.full(size, 4.0))
    assert motion.speed.shape == motion.since_turn.shape == motion.branch_from.shape == (size,)
    assert not motion.speed.any() and np.all(motion.branch_from == 4.0)
