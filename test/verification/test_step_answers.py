"""What a path shows of a loop, against loops of which it is known."""

import numpy as np
import pytest
from scipy.signal import lfilter

from slpi_ros.verification.step_answers import followed_up_to, step_answers

RATE, TAU, NOISE = 2000.0, 0.02, 1e-9


def stairs(sizes: list[float], seconds: float = 0.4) -> np.ndarray:
    """Return set points (m) that rise by each size and are held."""
    return np.repeat(np.concatenate([[0.0], np.cumsum(sizes)]), round(seconds * RATE))


def followed(desired: np.ndarray, tau: float = TAU) -> np.ndarray:
    """Return what follows with a time constant (s), exactly where set points are held."""
    kept = np.exp(-1.0 / RATE / tau)
    return np.asarray(lfilter([0.0, 1.0 - kept], [1.0, -kept], desired))


def test_each_size_settles_as_its_time_constant_says():
    desired = stairs([1e-6, 1e-6, -4e-6, 1e-6])
    t = np.arange(desired.size) / RATE
    rng = np.random.default_rng(0)
    error = followed(desired) - desired + NOISE * rng.normal(size=t.size)
    small, large = step_answers(t, desired, error, NOISE)
    assert (small.count, large.count) == (3, 1)
    assert (small.size, large.size) == pytest.approx((1e-6, 4e-6))
    for each in (small, large):
        assert each.settled == pytest.approx(TAU * np.log(100.0), abs=0.1 * TAU)
        assert each.quiet == pytest.approx(TAU * np.log(each.size / 3.0 / NOISE), abs=0.5 * TAU)
        assert each.overshoot < 5.0 * NOISE / each.size


def test_an_overshoot_is_that_of_the_loop_and_a_step_that_does_not_settle_is_said_so():
    damping, w = 0.3, 2.0 * np.pi * 20.0
    t = np.arange(round(0.5 * RATE)) / RATE
    wd = w * np.sqrt(1.0 - damping**2)
    answer = 1.0 - np.exp(-damping * w * t) * (np.cos(wd * t) + damping * w / wd * np.sin(wd * t))
    desired = np.concatenate([np.zeros(t.size), np.full(t.size, -2e-6)])
    y = np.concatenate([np.zeros(t.size), -2e-6 * answer])
    t = np.arange(desired.size) / RATE
    (found,) = step_answers(t, desired, y - desired, 0.0)
    assert found.overshoot == pytest.approx(np.exp(-np.pi * damping / np.sqrt(1.0 - damping**2)), rel=0.02)
    assert found.settled is not None and found.quiet is None


def test_a_path_without_held_set_points_has_no_steps():
    t = np.arange(4000) / RATE
    desired = 1e-6 * np.sin(2.0 * np.pi * 5.0 * t)
    assert step_answers(t, desired, 0.01 * desired, NOISE) == ()
    # A path that is sampled slowly is no path of steps.
    assert step_answers(t, desired[::10].repeat(10), 0.01 * desired, NOISE) == ()


@pytest.mark.parametrize("noise", [0.0, 2e-8])
def test_the_bandwidth_is_where_the_error_is_3_db_below_the_path(noise):
    rng = np.random.default_rng(1)
    desired = 1e-6 * followed(rng.normal(size=40_000), 1.0 / (2.0 * np.pi * 40.0))
    t = np.arange(desired.size) / RATE
    error = followed(desired, 1.0 / (2.0 * np.pi * 15.0)) - desired + noise * rng.normal(size=t.size)
    # |S| of 1 / (1 + s tau) is 1 / sqrt(2) at 1 / tau.
    assert followed_up_to(t, desired, error) == pytest.approx(15.0, rel=0.1)


def test_a_path_that_is_followed_wherever_it_moves_shows_no_bandwidth():
    t = np.arange(40_000) / RATE
    desired = 1e-6 * np.sin(2.0 * np.pi * 5.0 * t)
    assert followed_up_to(t, desired, 0.1 * desired) is None
    assert followed_up_to(t, np.zeros(t.size), np.zeros(t.size)) is None
    assert followed_up_to(t[:50], desired[:50], desired[:50]) is None
