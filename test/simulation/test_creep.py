import numpy as np
import pytest
from scipy.special import exp1
from simulation.oracles import lagged

from slpi_ros.simulation.dynamics import Creep

GAIN, SHORTEST, LONGEST = 0.04, 1e-3, 100.0


def creep():
    return Creep(GAIN, SHORTEST, LONGEST)


def step_response(t):
    element = creep()
    element.step(0.0, 1.0)
    return np.array([element.step(duration, 1.0) for duration in np.diff(t, prepend=0.0)])


def peak(frequency, samples=400):
    element, t = creep(), np.linspace(0, 1 / frequency, samples + 1)
    triangle = 1 - np.abs(2 * t * frequency - 1)
    return max(element.step(*sample) for sample in zip(np.diff(t, prepend=0.0), triangle, strict=True))


def test_the_response_to_a_step_is_that_of_a_continuous_spectrum():
    """Evenly spread in log time, relaxations add up to exponential integrals; a few discrete ones come close."""
    t = np.geomspace(1e-4, 1e3, 200)
    spectrum = np.log(LONGEST / SHORTEST) - exp1(t / LONGEST) + exp1(t / SHORTEST)
    np.testing.assert_allclose(step_response(t), 1 + GAIN / np.log(10) * spectrum, atol=0.06 * GAIN)


def test_the_response_to_a_step_is_log_time():
    decades = step_response(np.array([0.01, 0.1, 1.0, 10.0]))
    np.testing.assert_allclose(np.diff(decades), GAIN, rtol=0.07)
    np.testing.assert_allclose(step_response(np.array([1e5])), 1 + 5 * GAIN, rtol=1e-12)


def test_there_is_no_creep_before_the_shortest_time_constant():
    assert step_response(np.array([SHORTEST / 1000]))[0] == pytest.approx(1, abs=1e-3 * GAIN)


def test_peaks_of_triangles_fall_as_a_power_of_the_frequency():
    frequencies = np.array([0.1, 0.5, 1, 2, 5, 10, 20])
    peaks = np.array([peak(f) for f in frequencies])
    exponent, log_scale = np.polyfit(np.log(frequencies), np.log(peaks), 1)
    assert exponent == pytest.approx(-GAIN / np.log(10), rel=0.2)
    np.testing.assert_allclose(peaks, np.exp(log_scale) * frequencies**exponent, rtol=0.003)


def test_the_elements_are_added_up():
    element, t = creep(), np.linspace(0, 2, 401)
    u = np.sin(3 * t)
    expected = u + sum(g * lagged(tau, t, u) for g, tau in zip(element.gains, element.time_constants, strict=True))
    y = [element.step(*sample) for sample in zip(np.diff(t, prepend=0.0), u, strict=True)]
    np.testing.assert_allclose(y, expected, atol=1e-9)
    assert element.gains.sum() == pytest.approx(5 * GAIN)
    assert np.all((element.time_constants > SHORTEST) & (element.time_constants < LONGEST))


def test_after_a_ramp():
    element, t = creep(), np.linspace(0, 0.5, 101)
    y = [element.step(*sample) for sample in zip(np.diff(t, prepend=0.0), 2 * t, strict=True)]
    assert element.after_ramp(0.5) == pytest.approx(y[-1], rel=1e-12)


def test_rest():
    element = creep()
    element.step(0.0, 1.0)
    element.step(10.0, 1.0)
    element.rest()
    assert element.step(10.0, 0.0) == 0
