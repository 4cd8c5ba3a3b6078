import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from simulation.oracles import integrated, lagged

from slpi_ros.simulation.dynamics import Relaxation

TIME_CONSTANTS = np.array([1e-3, 0.05, 7.0])
values = st.floats(-100, 100)


def followed(t, u, time_constants=TIME_CONSTANTS):
    chain = Relaxation(time_constants)
    return np.array([chain.step(*sample) for sample in zip(np.diff(t, prepend=t[0]), u, strict=True)])


def test_it_solves_the_equation_on_even_samples():
    t = np.linspace(0, 3, 601)
    u = np.concatenate([[0.0], np.random.default_rng(1).normal(size=600)])
    for element, time_constant in zip(followed(t, u).T, TIME_CONSTANTS, strict=True):
        np.testing.assert_allclose(element, lagged(time_constant, t, u), atol=1e-9)


def test_it_solves_the_equation_on_uneven_samples():
    rng = np.random.default_rng(2)
    t, u = np.concatenate([[0.0], np.cumsum(rng.uniform(1e-4, 0.2, 12))]), rng.normal(size=13)
    expected = integrated(lambda z, now: (now - z) / TIME_CONSTANTS, np.zeros(3), t, u)
    np.testing.assert_allclose(followed(t, u), expected, atol=1e-8)


@given(values, values, st.floats(1e-6, 10), st.floats(0.01, 0.99))
def test_a_sample_on_the_line_between_two_others_changes_nothing(first, last, duration, share):
    at_once, in_two = Relaxation(TIME_CONSTANTS), Relaxation(TIME_CONSTANTS)
    for chain in (at_once, in_two):
        chain.step(0.01, first)
    in_two.step(share * duration, first + share * (last - first))
    np.testing.assert_allclose(
        in_two.step((1 - share) * duration, last), at_once.step(duration, last), rtol=1e-9, atol=1e-9
    )


@given(st.lists(st.tuples(st.floats(0, 1), values), min_size=1, max_size=20))
def test_it_never_leaves_the_range_of_its_input(steps):
    chain = Relaxation(TIME_CONSTANTS)
    low, high = min(0.0, *(u for _, u in steps)), max(0.0, *(u for _, u in steps))
    for step in steps:
        assert np.all((chain.step(*step) >= low - 1e-12) & (chain.step(0.0, step[1]) <= high + 1e-12))


def test_a_jump_takes_no_time_and_is_then_followed():
    chain = Relaxation(TIME_CONSTANTS)
    np.testing.assert_array_equal(chain.step(0.0, 1.0), 0.0)
    np.testing.assert_allclose(chain.step(0.05, 1.0), 1 - np.exp(-0.05 / TIME_CONSTANTS), rtol=1e-12)


def test_rest():
    chain = Relaxation(TIME_CONSTANTS)
    chain.step(0.0, 5.0)
    chain.step(1.0, 5.0)
    chain.rest()
    assert not chain.step(1.0, 0.0).any()
    assert chain.step(1.0, 2.0)[2] == pytest.approx(lagged(7.0, np.array([0.0, 1.0]), np.array([0.0, 2.0]))[1])
