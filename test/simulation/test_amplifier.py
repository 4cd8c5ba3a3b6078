import numpy as np
import pytest
from simulation.oracles import lagged

from benchmarks.hidden.physics import Amplifier
from slpi_ros.errors import UsageError

T = np.arange(2000) / 1000.0
V = 50 - 45 * np.cos(7 * T) + 3 * np.sin(41 * T)


def test_without_anything_the_command_gets_through():
    np.testing.assert_array_equal(Amplifier().run(T, V), V)
    assert not Amplifier().clips and Amplifier(upper=3.0).clips and Amplifier(lower=3.0).clips


@pytest.mark.parametrize("steps", [3, -3])
def test_a_delay_moves_the_samples(steps):
    late = Amplifier(delay=steps / 1000).run(T, V)
    if steps > 0:
        np.testing.assert_allclose(late[steps:], V[:-steps], atol=1e-9)
        assert np.all(late[:steps] == pytest.approx(V[0]))
    else:
        np.testing.assert_allclose(late[:steps], V[-steps:], atol=1e-9)


def test_a_lag_is_that_of_a_linear_filter_from_rest_at_the_first_command():
    found = Amplifier(lag=8e-3).run(T, V)
    np.testing.assert_allclose(found, V[0] + lagged(8e-3, T, V - V[0]), atol=1e-9)


def test_a_lag_over_uneven_samples_is_the_same_motion():
    keep = np.sort(np.random.default_rng(1).choice(T.size, 900, replace=False))
    ramp = 4.0 * T
    found = Amplifier(lag=8e-3).run(T[keep], ramp[keep])
    since = T[keep] - T[keep][0]
    np.testing.assert_allclose(found, ramp[keep] - 4.0 * 8e-3 * -np.expm1(-since / 8e-3), atol=1e-12)


def test_limits_are_sharp_or_soft():
    hard = Amplifier(lower=20.0, upper=80.0).run(T, V)
    np.testing.assert_array_equal(hard, np.clip(V, 20.0, 80.0))
    soft = Amplifier(lower=20.0, upper=80.0, softness=0.3).run(T, V)
    lost = hard - soft
    assert np.max(np.abs(lost)) == pytest.approx(0.3 * np.log(2), rel=0.05)
    assert np.all(soft <= 80.0) and np.all(soft >= 20.0)
    assert np.max(np.abs(lost[(V > 25) & (V < 75)])) < 1e-6


def test_the_clip_comes_after_the_lag():
    found = Amplifier(lag=8e-3, upper=60.0).run(T, V)
    np.testing.assert_array_equal(found, np.minimum(Amplifier(lag=8e-3).run(T, V), 60.0))


@pytest.mark.parametrize(
    "wrong", [{"lower": 5.0, "upper": 5.0}, {"lag": -1.0}, {"softness": -0.1}, {"delay": float("nan")}]
)
def test_what_is_no_amplifier(wrong):
    with pytest.raises(UsageError):
        Amplifier(**wrong)
