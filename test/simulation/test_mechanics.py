import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from simulation.oracles import integrated, ringing

from slpi_ros.simulation.dynamics import FlexureMode

FREQUENCY, DAMPING = 300.0, 0.04
OMEGA = 2 * np.pi * FREQUENCY
values = st.floats(-100, 100)


def followed(t, u, damping=DAMPING):
    mode = FlexureMode(FREQUENCY, damping)
    return np.array([mode.step(*sample) for sample in zip(np.diff(t, prepend=t[0]), u, strict=True)])


@pytest.mark.parametrize("damping", [0.01, 0.04, 0.7])
def test_it_solves_the_equation_on_even_samples(damping):
    t = np.arange(600) * 4e-4
    u = np.concatenate([[0.0], np.random.default_rng(1).normal(size=599)])
    np.testing.assert_allclose(followed(t, u, damping), ringing(FREQUENCY, damping, t, u), atol=1e-8)


def test_it_solves_the_equation_on_uneven_samples():
    rng = np.random.default_rng(2)
    t, u = np.concatenate([[0.0], np.cumsum(rng.uniform(1e-6, 5e-3, 12))]), rng.normal(size=13)
    u[0] = 0.0

    def motion(x, now):
        return np.array([x[1], OMEGA**2 * (now - x[0]) - 2 * DAMPING * OMEGA * x[1]])

    np.testing.assert_allclose(followed(t, u), integrated(motion, np.zeros(2), t, u)[:, 0], atol=1e-7)


def test_the_response_to_a_step():
    mode = FlexureMode(FREQUENCY, DAMPING)
    assert mode.step(0.0, 2.0) == 0
    t = np.linspace(0, 0.05, 501)
    x = np.array([mode.step(duration, 2.0) for duration in np.diff(t, prepend=0.0)])
    root = np.sqrt(1 - DAMPING**2)
    swing = np.cos(OMEGA * root * t) + DAMPING / root * np.sin(OMEGA * root * t)
    np.testing.assert_allclose(x, 2 * (1 - np.exp(-DAMPING * OMEGA * t) * swing), atol=1e-11)


def test_a_turn_of_the_input_makes_it_ring_by_the_change_of_speed_over_the_frequency():
    t = np.arange(4000) * 1e-5
    u = np.minimum(t, 2e-2 - t + 1e-2) * (t < 3e-2)
    turn = t > 1.5e-2
    quiet = u - 2 * DAMPING / OMEGA * np.sign(1.5e-2 - t)
    swing = (followed(t, u) - quiet)[turn & (t < 1.5e-2 + 1 / FREQUENCY)]
    assert np.abs(swing).max() == pytest.approx(2 / OMEGA, rel=0.2)


def test_the_static_gain_is_one():
    mode = FlexureMode(FREQUENCY, DAMPING)
    assert mode.step(1.0, 3.0) == pytest.approx(3.0, abs=1e-3)
    assert mode.step(1.0, 3.0) == pytest.approx(3.0, rel=1e-12)


@given(values, values, st.floats(1e-7, 1.0), st.floats(0.01, 0.99))
def test_a_sample_on_the_line_between_two_others_changes_nothing(first, last, duration, share):
    at_once, in_two = FlexureMode(FREQUENCY, DAMPING), FlexureMode(FREQUENCY, DAMPING)
    for mode in (at_once, in_two):
        mode.step(0.01, first)
    in_two.step(share * duration, first + share * (last - first))
    assert in_two.step((1 - share) * duration, last) == pytest.approx(at_once.step(duration, last), rel=1e-8, abs=1e-8)


def test_rest():
    mode = FlexureMode(FREQUENCY, DAMPING)
    mode.step(0.0, 1.0)
    mode.step(1e-3, 1.0)
    mode.rest()
    assert mode.step(1e-3, 0.0) == 0
