"""The mean rate of a voltage: kept by the rate limiter whatever is wanted, and told of a path before it begins."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from slpi_ros.model.limits import Limits, RateLimiter
from slpi_ros.model.mean_rate import WINDOW, highest_mean_rate, slower_by

PERIOD = 0.01


def limited(goals, mean_rate, slew=1e4, period=PERIOD, checked=False):
    limiter = RateLimiter(Limits(0.0, 100.0, slew, np.inf, mean_rate), period, 0.0)
    limiter.checked = checked
    return np.array([limiter.step(float(goal), int(k * period * 1e9)) for k, goal in enumerate(goals)])


@settings(deadline=None)
@given(st.floats(1.0, 300.0), st.integers(0, 2**32 - 1), st.sampled_from([PERIOD, 0.05, 0.5]), st.booleans())
def test_the_mean_holds_over_any_ten_seconds(mean_rate, seed, period, checked):
    rng = np.random.default_rng(seed)
    goals = np.repeat(rng.uniform(0.0, 100.0, 200), rng.integers(1, 30, 200))
    v = limited(goals, mean_rate, period=period, checked=checked)
    assert highest_mean_rate(np.arange(v.size) * period, v) <= mean_rate * (1 + 1e-9)


def test_constant_motion_ends_at_the_limit_and_not_far_below():
    t = np.arange(0.0, 60.0, PERIOD)
    v = limited(50.0 + 50.0 * np.sign(np.sin(2 * np.pi * t)), 40.0)
    assert 0.9 * 40.0 <= highest_mean_rate(t[t > 30.0], v[t > 30.0]) <= 40.0 * (1 + 1e-9)


def test_short_moves_are_as_fast_as_without_the_limit():
    goals = np.repeat([0.0, 100.0], 200)
    assert limited(goals, 50.0, slew=200.0) == pytest.approx(limited(goals, np.inf, slew=200.0))


@pytest.mark.parametrize("seconds", [2.0, 25.0])
@pytest.mark.parametrize("frequency", [0.5, 3.0])
def test_the_factor_makes_a_path_just_slow_enough(seconds, frequency):
    t = np.arange(0.0, seconds, 0.001)
    v = 50.0 - 50.0 * np.cos(2 * np.pi * frequency * t)
    limit = 0.4 * highest_mean_rate(t, v)
    factor = slower_by(t, v, limit)
    # Half of the mean is left only where the path lasts longer than the window.
    assert factor >= 1.0 / 0.4 - 0.1
    assert highest_mean_rate(t * factor, v) <= limit
    assert highest_mean_rate(t * factor / 1.05, v) > 0.95 * limit
    assert slower_by(t * factor, v, limit) == 1.0


def test_a_path_within_the_limit_is_not_held_back():
    t = np.arange(0.0, 40.0, PERIOD)
    v = 50.0 - 50.0 * np.cos(2 * np.pi * 0.25 * t)
    limit = 1.03 * highest_mean_rate(t, v)
    assert slower_by(t, v, limit) == 1.0
    assert limited(v, limit, checked=True) == pytest.approx(v)


def test_what_one_sine_draws():
    # Of a sine of frequency f and amplitude Vpp: 2 f Vpp.
    t = np.arange(0.0, 30.0, 0.0005)
    v = 30.0 * np.sin(2 * np.pi * 10.0 * t)
    assert highest_mean_rate(t, v) == pytest.approx(2 * 10.0 * 60.0, rel=1e-3)
    assert WINDOW == 10.0
