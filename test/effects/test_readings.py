"""Filters of readings in use: the running line, against its differential equation, and the choice by a record."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.signal import lsim

from slpi_ros.effects.readings import ReadingsFilter, _filtered, best_filter, line_after
from slpi_ros.simulation.room import RoomSensor

T = np.arange(0.0, 1200.0, 0.5)


def warm(t):
    return 0.5 * np.sin(2 * np.pi * t / 500.0) + 0.3 * np.sin(2 * np.pi * t / 240.0 + 1.0)


def loaded(t):
    return np.where(np.mod(t, 70.0) < 31.0, 2.0, 0.0)


def read_by(sensor, quantity):
    at = sensor.times(0.0, 1200.0)
    return at, sensor.read(at, quantity(at))


def in_use(chosen, course, t):
    """Return what the filter gives at times `t`, step by step."""
    at, value = course
    held = value[np.maximum(np.searchsorted(at, t, side="right") - 1, 0)]
    level, slope, found = held[0], 0.0, []
    for dt, reading in zip(np.diff(t, prepend=t[0]).tolist(), held.tolist(), strict=True):
        if not chosen.time_constant:
            level = reading
        elif chosen.ahead:
            level, slope = line_after(dt, chosen.time_constant, reading, level, slope)
        else:
            level = reading + np.exp(-dt / chosen.time_constant) * (level - reading)
        found.append(level + chosen.ahead * slope)
    return np.array(found)


@given(st.floats(0.1, 50.0), st.integers(0, 99))
def test_a_running_line_is_its_differential_equation(time_constant, seed):
    # Of value v and slope s: v' = s - 2 (v - u) / T, s' = -(v - u) / T^2, with a reading u that is held.
    u, tau = np.random.default_rng(seed).standard_normal(40), time_constant
    system = ([[-2 / tau, 1.0], [-1 / tau**2, 0.0]], [[2 / tau], [1 / tau**2]], np.eye(2), np.zeros((2, 1)))
    fine = np.arange(40 * 20 + 1) * 0.05
    _, expected, _ = lsim(system, np.append(np.repeat(u, 20), u[-1]), fine, interp=False)
    level, slope, found = 0.0, 0.0, []
    for reading in u.tolist():
        level, slope = line_after(1.0, tau, reading, level, slope)
        found.append((level, slope))
    np.testing.assert_allclose(found, expected[20::20], rtol=0, atol=1e-9 * (1 + 1 / tau))


def test_a_running_line_lies_on_a_ramp():
    level, slope = 0.0, 0.0
    for k in range(4000):
        level, slope = line_after(0.1, 5.0, 0.3 * 0.1 * (k + 1), level, slope)
    # Within a step, during which the reading is taken as held.
    assert slope == pytest.approx(0.3, rel=1e-3) and level == pytest.approx(0.3 * 400.0, abs=0.3 * 0.1)


@pytest.mark.parametrize("interval", [0.5, 4.0])
@pytest.mark.parametrize(("quantity", "noise"), [(warm, 0.0), (warm, 0.02), (warm, 0.2), (loaded, 0.0), (loaded, 0.02)])
def test_the_chosen_filter_is_no_worse_than_the_readings(quantity, interval, noise):
    course = read_by(RoomSensor(interval, noise=noise, seed=4), quantity)
    chosen, true = best_filter(course), quantity(T)
    left, held = (np.std((in_use(one, course, T) - true)[200:]) for one in (chosen, ReadingsFilter()))
    assert left <= 1.02 * held
    if noise == 0.2 and quantity is warm:
        assert left < 0.7 * held


@pytest.mark.parametrize("lag", [0.0, 6.0])
def test_a_late_sensor_is_made_up_for(lag):
    course = read_by(RoomSensor(4.0, lag=lag, noise=0.01, seed=5), warm)
    chosen = best_filter(course, lag)
    assert chosen.ahead == pytest.approx(lag + 2.0, rel=0.05)
    left, held = (np.std((in_use(one, course, T) - warm(T))[200:]) for one in (chosen, ReadingsFilter()))
    assert left < 0.7 * held


def test_few_readings_are_held():
    assert best_filter((np.arange(5.0), np.arange(5.0))) == ReadingsFilter()
    assert best_filter((np.arange(50.0), np.full(50, 3.0))) == ReadingsFilter()
    assert best_filter((np.arange(50.0), np.arange(50.0)), 1e4) == ReadingsFilter()


def test_filter_and_transfer_function_agree():
    held = np.random.default_rng(1).standard_normal(300)
    for chosen in (ReadingsFilter(3.0), ReadingsFilter(3.0, 2.0)):
        level, slope, found = 0.0, 0.0, []
        for reading in held.tolist():
            if chosen.ahead:
                level, slope = line_after(0.5, chosen.time_constant, reading, level, slope)
            else:
                level = reading + np.exp(-0.5 / chosen.time_constant) * (level - reading)
            found.append(level + chosen.ahead * slope)
        np.testing.assert_allclose(_filtered(chosen, held, 0.5), found, rtol=0, atol=1e-12)
