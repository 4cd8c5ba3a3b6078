from dataclasses import replace

import numpy as np
import pytest
from simulation.oracles import lagged, ringing

from benchmarks.hidden.physics import (
    Amplifier,
    BoucWen,
    Flexure,
    Hum,
    Interferometer,
    Physics,
    RateLaw,
    SlowDomains,
    Temperature,
    Viscosity,
    own_motion,
    sensed,
)
from slpi_ros.simulation.axis import SimulatedAxis
from slpi_ros.simulation.parameters import AxisParameters
from slpi_ros.simulation.preisach import PreisachHysteresis

STAGE = AxisParameters(levels=140, stiffening=0.02, offset=1e-7)
T = np.arange(1500) / 2000
V = 50 - 45 * np.cos(40 * T) - 5 * np.cos(173 * T)


def hysteresis(v):
    return SimulatedAxis(STAGE).run(np.zeros(v.size), v)[0]


def motion(**physics):
    return own_motion(STAGE, Physics(**physics), T, V)


def test_without_anything_it_is_the_stage():
    np.testing.assert_allclose(motion(), hysteresis(V), atol=1e-18)
    np.testing.assert_array_equal(own_motion(BoucWen(), Physics(), T, V), BoucWen().run(V))


def test_the_relays_see_what_the_amplifier_gives():
    found = motion(amplifier=Amplifier(lag=3e-3, upper=80.0))
    expected = hysteresis(np.minimum(V[0] + lagged(3e-3, T, V - V[0]), 80.0))
    np.testing.assert_allclose(found, expected, atol=1e-12)


def test_creep_adds_what_linear_filters_make_of_the_motion():
    found = motion(creep=SlowDomains((0.05, 0.3), (0.02, 0.01)))
    h = hysteresis(V) - STAGE.offset
    expected = h + 0.02 * lagged(0.05, T, h) + 0.01 * lagged(0.3, T, h)
    np.testing.assert_allclose(found - STAGE.offset, expected, atol=1e-12)


def test_the_flexure_rings_after_a_step_at_its_own_frequency_and_decays():
    v = np.where(T < 0.1, 0.0, 40.0)
    found = own_motion(STAGE, Physics(flexure=Flexure(100.0, 0.03)), T, v) - STAGE.offset
    h = hysteresis(v) - STAGE.offset
    np.testing.assert_allclose(found, ringing(100.0, 0.03, T, h), atol=1e-12)
    free = (found - h[-1])[T > 0.11]
    turns = np.flatnonzero(np.diff(np.sign(free))).size / 2 / (T[-1] - 0.11)
    assert turns == pytest.approx(100.0, rel=0.02)


@pytest.mark.parametrize("form", ["coercivity", "friction"])
def test_loops_widen_with_the_rate(form):
    strength = 2.0 if form == "coercivity" else 2e-7
    viscous = Physics(viscosity=Viscosity(RateLaw(strength), form))
    v = np.concatenate([np.linspace(0, 100, 500), np.linspace(100, 0, 500)] * 2)

    def width(seconds):
        t = np.linspace(0, seconds, v.size)
        y = own_motion(STAGE, viscous, t, v)
        return np.interp(50, v[1499:999:-1][::-1], y[1000:1500]) - np.interp(50, v[1999:1499:-1], y[1999:1499:-1])

    slow, fast = abs(width(2000.0)), abs(width(4.0))
    still = hysteresis(v)
    alone = abs(np.interp(50, v[1000:1500], still[1000:1500]) - np.interp(50, v[1999:1499:-1], still[1999:1499:-1]))
    assert slow == pytest.approx(alone, rel=0.05) and fast > 1.05 * slow


def test_relays_and_reversible_part_may_see_different_voltages():
    straight = replace(STAGE, stiffening=0.0)

    def respond(v, relay_voltage):
        stage = PreisachHysteresis(straight)
        return np.array([stage.step(*both) for both in zip(v, relay_voltage, strict=True)])

    np.testing.assert_allclose(respond(V, V), SimulatedAxis(straight).run(T, V)[0] - STAGE.offset, atol=1e-18)
    alone = respond(np.zeros_like(V), V[::-1]) + respond(V, np.zeros_like(V))
    np.testing.assert_allclose(respond(V, V[::-1]), alone, atol=1e-15)


def test_what_the_sensor_shows():
    own = {"x": hysteresis(V), "y": 2e-6 + 1e-6 * np.sin(9 * T)}
    temperature, hum, sensor = Temperature(3e-7), Hum(50.0, 1e-8), Interferometer(316e-9, 8e-9, 0.3)
    physics = Physics(coupling={"y": -0.02}, temperature=temperature, interferometer=sensor, hum=hum)
    moved = own["x"] - 0.02 * 1e-6 * np.sin(9 * T) + 3e-7 * T / T[-1]
    expected = moved + 8e-9 * np.sin(2 * np.pi * moved / 316e-9 + 0.3) + 1e-8 * np.sin(100 * np.pi * T)
    np.testing.assert_allclose(sensed(physics, T, own, "x"), expected, atol=1e-15)
    np.testing.assert_array_equal(sensed(Physics(), T, own, "y"), own["y"])
