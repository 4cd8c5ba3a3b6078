from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import dblquad

from slpi_ros.simulation.axis import SimulatedAxis
from slpi_ros.simulation.parameters import AxisParameters
from slpi_ros.simulation.preisach import ExponentialMaterial, PowerLawMaterial, RelayTriangle, material, measure_loop

POWER_LAW = AxisParameters(
    stroke=80e-6,
    hysteresis=0.11,
    nominal_voltage=120.0,
    threshold_min=-20.0,
    threshold_max=150.0,
    levels=340,
    exponent=1.15,
    noise_rms=0.0,
    quantisation=0.0,
)
COARSE = replace(POWER_LAW, levels=85)
voltages = st.floats(-20, 150)
histories = st.lists(voltages, max_size=8)
unhurried = settings(max_examples=40, deadline=None)


def everett(up, down, parameters=POWER_LAW):
    return float(PowerLawMaterial(parameters).everett(np.array(up), np.array(down)))


def driven(parameters, history):
    stage = SimulatedAxis(parameters)
    return stage, [stage.step(0.0, v) for v in history]


def branches(amplitude, count=501, parameters=POWER_LAW):
    """Return rise and fall of a loop from 0, each against rising voltage."""
    v = np.linspace(0, amplitude, count)
    _, y = driven(parameters, np.concatenate([v, v[::-1]]))
    return np.array(y[:count]), np.array(y[count:][::-1])


def test_the_exponent_chooses_the_material():
    assert isinstance(material(POWER_LAW), PowerLawMaterial)
    assert isinstance(material(AxisParameters()), ExponentialMaterial)


@pytest.mark.parametrize(("exponent", "width_exponent"), [(1.0, 1.0), (1.15, 1.0), (1.4, 3.0)])
@pytest.mark.parametrize(("up", "down"), [(100.0, 0.0), (100.0, 40.0), (20.0, 19.0)])
def test_the_everett_function_is_the_integral_of_the_density(exponent, width_exponent, up, down):
    parameters = replace(POWER_LAW, exponent=exponent, width_exponent=width_exponent)
    integral, _ = dblquad(
        lambda b, a: a ** (exponent - 2) * (b / a) ** width_exponent, down, up, lambda a: down, lambda a: a
    )
    assert everett(up, down, parameters) == pytest.approx(integral, rel=1e-6)


@given(st.floats(1, 150), st.floats(0, 1), st.floats(0.1, 10))
def test_it_is_homogeneous(up, share, factor):
    expected = factor**POWER_LAW.exponent * everett(up, share * up)
    assert everett(factor * up, factor * share * up) == pytest.approx(expected, rel=1e-9, abs=1e-9)


@given(voltages, voltages)
def test_below_the_origin_it_is_a_mirror_image_and_nothing_reaches_across(a, b):
    up, down = max(a, b), min(a, b)
    assert everett(up, down) == pytest.approx(everett(-down, -up), rel=1e-12)
    assert everett(up, down) == pytest.approx(everett(max(up, 0), max(down, 0)) + everett(min(up, 0), min(down, 0)))
    assert everett(down, up) == 0


@pytest.mark.parametrize(("up", "down"), [(120.0, 0.0), (120.0, 60.0), (1.0, 0.5), (20.0, 10.0), (150.0, -20.0)])
def test_the_grid_holds_all_of_it(up, down):
    relays = RelayTriangle(-20.0, 150.0, 340, PowerLawMaterial(POWER_LAW).density)
    top = relays.step(up)
    assert top - relays.step(down) == pytest.approx(everett(up, down), rel=1e-9)


def test_a_grid_that_misses_the_origin_holds_all_of_it_too():
    parameters = replace(POWER_LAW, origin=-3.3)
    relays = RelayTriangle(-20.0, 150.0, 340, PowerLawMaterial(parameters).density)
    assert relays.step(150.0) - relays.step(-20.0) == pytest.approx(everett(150.0, -20.0, parameters), rel=1e-9)


def test_its_simplest_fall_is_a_parabola_as_in_rayleighs_law():
    parameters = replace(POWER_LAW, exponent=1.0)
    x = np.linspace(0, 1, 11)
    fall = [everett(90.0, 90.0 * s, parameters) for s in x]
    np.testing.assert_allclose(fall, 90.0 * (1 - x) ** 2 / 2, atol=1e-12)


@pytest.mark.parametrize("amplitude", [20.0, 40.0, 80.0, 120.0, 150.0])
def test_loops_of_every_amplitude_look_alike(amplitude):
    stage = SimulatedAxis(POWER_LAW)
    figure = measure_loop(lambda v: stage.step(0.0, v), 0.0, amplitude)
    assert figure.hysteresis == pytest.approx(0.11, rel=1e-3)
    assert figure.stroke == pytest.approx(80e-6 * (amplitude / 120) ** 1.15, rel=1e-3)
    assert abs(figure.remanence) < 1e-12


@pytest.mark.parametrize("amplitude", [20.0, 120.0])
def test_the_rise_is_nearly_straight_and_the_fall_bulges(amplitude):
    rise, fall = (branch / 80e-6 / (amplitude / 120) ** 1.15 for branch in branches(amplitude))
    line = np.linspace(0, 1, rise.size)
    assert np.max(np.abs(rise - line)) < 0.055
    assert np.max(fall - line) > 0.06
    assert np.all(np.diff(fall, 2)[20:] < 1e-4)
    assert np.all(fall[1:-1] > rise[1:-1])


def test_small_loops_are_smooth():
    """At 20 V the slope changes little from one sample to the next: the relays' levels do not show."""
    for branch in branches(20.0, 401):
        slope = np.diff(branch)
        assert np.max(np.abs(np.diff(slope)[20:])) < 0.06 * slope.mean()


@pytest.mark.parametrize("amplitude", [20.0, 119.3])
def test_the_relay_grid_does_not_show(amplitude):
    """Twice as fine a grid differs by less than the sensor noise of such a stage."""
    coarse, fine = (branches(amplitude, 201, replace(POWER_LAW, levels=levels)) for levels in (340, 680))
    np.testing.assert_allclose(coarse, fine, atol=8e-9)


@given(histories, voltages, voltages)
@unhurried
def test_return_point_memory(history, a, b):
    turn, back = min(a, b), max(a, b)
    stage, y = driven(COARSE, [*history, 150.0, turn, back])
    again = [stage.step(0.0, v) for v in (turn, back)]
    assert again == pytest.approx(y[-2:], abs=1e-15)


@given(histories, histories, voltages, voltages)
@unhurried
def test_a_larger_loop_wipes_out_what_went_before(one, other, a, b):
    low, high = min(a, b), max(a, b)
    inside = [min(max(v, low), high) for v in one]
    path = np.linspace(low, high, 5)
    _, with_memory = driven(COARSE, [*other, -20.0, high, low, *inside, high, low, *path])
    _, without = driven(COARSE, [-20.0, high, low, *path])
    assert with_memory[-5:] == pytest.approx(without[-5:], abs=1e-15)


@given(histories, voltages)
@unhurried
def test_displacement_follows_the_direction_of_the_voltage(history, target):
    stage, _ = driven(replace(COARSE, stiffening=0.1), history)
    start = history[-1] if history else 0.0
    y = [stage.step(0.0, v) for v in np.linspace(start, target, 9)]
    assert np.all(np.diff(y) * np.sign(target - start) >= -1e-18)
