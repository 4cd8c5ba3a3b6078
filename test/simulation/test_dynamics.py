import numpy as np
import pytest
from simulation.oracles import lagged, ringing

from slpi_ros.errors import UsageError
from slpi_ros.simulation.axis import SimulatedAxis
from slpi_ros.simulation.character import Character
from slpi_ros.simulation.dynamics import Creep
from slpi_ros.simulation.parameters import AxisParameters

STATIC = AxisParameters(levels=140, noise_rms=0.0, quantisation=0.0, offset=1e-7, stiffening=0.02)
LAG = {"lag": 2e-3}
CREEP = {"creep": 0.03, "creep_shortest": 1e-3, "creep_longest": 10.0}
RESONANCE = {"resonance": 200.0, "damping": 0.05}
ALL = LAG | CREEP | RESONANCE


def excitation(count=1200, rate=4000.0):
    t = np.arange(count) / rate
    return t, 50 - 45 * np.cos(40 * t) - 5 * np.cos(173 * t)


def axis(**effects):
    return SimulatedAxis(STATIC, character=Character(**effects))


def moved(effects, t, v):
    """Displacement beyond the offset, without sensor errors."""
    return axis(**effects).run(t, v)[0] - STATIC.offset


def crept(t, h):
    creep = Creep(0.03, 1e-3, 10.0)
    return h + sum(g * lagged(tau, t, h) for g, tau in zip(creep.gains, creep.time_constants, strict=True))


def test_the_relays_see_the_lagged_voltage():
    t, v = excitation()
    expected = moved({}, t, lagged(2e-3, t, v))
    np.testing.assert_allclose(moved(LAG, t, v), expected, atol=1e-15)
    assert np.max(np.abs(expected - moved({}, t, v))) > 1e-6


def test_creep_follows_the_hysteresis():
    t, v = excitation()
    expected = crept(t, moved({}, t, v))
    np.testing.assert_allclose(moved(CREEP, t, v), expected, atol=1e-15)


def test_the_flexure_carries_it_all():
    t, v = excitation()
    expected = ringing(200.0, 0.05, t, crept(t, moved({}, t, lagged(2e-3, t, v))))
    np.testing.assert_allclose(moved(ALL, t, v), expected, atol=1e-14)


def test_sample_by_sample_equals_a_run_and_a_run_continues():
    t, v = excitation(300)
    whole, _ = axis(**ALL).run(t, v)
    stepped, parts = axis(**ALL), axis(**ALL)
    np.testing.assert_array_equal([stepped.step(*sample) for sample in zip(t, v, strict=True)], whole)
    halves = [parts.run(t[part], v[part])[0] for part in (slice(0, 100), slice(100, None))]
    np.testing.assert_array_equal(np.concatenate(halves), whole)


def test_the_clock_may_start_anywhere():
    """Stamps of a real clock are coarser, nothing else."""
    t, v = excitation(300)
    np.testing.assert_allclose(moved(ALL, t + 1024.0, v), moved(ALL, t, v), atol=1e-15)


def test_more_samples_of_the_same_voltage_make_little_difference():
    t, v = excitation(301)
    fine = np.linspace(t[0], t[-1], 3001)
    one, other = moved(ALL, t, v), moved(ALL, fine, np.interp(fine, t, v))[::10]
    assert np.max(np.abs(one - other)) < 2e-8


@pytest.mark.parametrize("change", [LAG, CREEP, RESONANCE])
def test_equal_stamps_let_no_time_pass(change):
    stage = axis(**change)
    stage.step(0.0, 0.0)
    before = stage.step(0.01, 40.0)
    assert stage.step(0.01, 40.0) == before
    hysteresis_only = axis()
    at_once = [hysteresis_only.step(0.0, v) for v in (40.0, 80.0)]
    expected = at_once[1] - at_once[0] if change is CREEP else 0.0
    assert stage.step(0.01, 80.0) - before == pytest.approx(expected, abs=1e-15)


@pytest.mark.parametrize("instant", [5e-324, 1e-300, 1e-20, 1e-13, 1e-12, 1e-11])
def test_stamps_that_hardly_differ_are_like_equal_ones(instant):
    ends = []
    for first in (0.0, instant):
        stage = axis(**ALL)
        stage.step(0.0, 0.0)
        stage.step(first, 80.0)
        ends.append([stage.step(t, 80.0) for t in (1e-3, 2e-3, 5e-3)])
    np.testing.assert_allclose(*ends, atol=1e-12)


def test_rest_forgets_past_and_time():
    t, v = excitation(200)
    stage = axis(**ALL)
    first, _ = stage.run(t, v)
    stage.rest()
    np.testing.assert_array_equal(stage.run(t, v)[0], first)
    assert first[0] != 0


@pytest.mark.parametrize("change", [LAG, CREEP, RESONANCE])
@pytest.mark.parametrize("t", [0.99, float("nan"), float("inf")])
def test_time_never_goes_back(change, t):
    stage, undisturbed = (axis(**change) for _ in range(2))
    for one in (stage, undisturbed):
        one.step(0.0, 0.0)
        one.step(1.0, 50.0)
    with pytest.raises(UsageError):
        stage.step(t, 70.0)
    assert stage.step(1.1, 60.0) == undisturbed.step(1.1, 60.0)


def test_the_first_time_must_be_a_time():
    with pytest.raises(UsageError):
        axis(**ALL).step(float("nan"), 0.0)


@pytest.mark.parametrize("voltage", [120.1, -20.1, float("nan")])
def test_a_voltage_out_of_range_is_refused_and_changes_nothing(voltage):
    stage, undisturbed = axis(**ALL), axis(**ALL)
    for one in (stage, undisturbed):
        one.step(0.0, 10.0)
        one.step(1e-3, 50.0)
    with pytest.raises(UsageError):
        stage.step(2e-3, voltage)
    assert stage.step(2e-3, 60.0) == undisturbed.step(2e-3, 60.0)


@pytest.mark.parametrize("voltage", [120.0, -20.0])
def test_the_ends_of_the_range_can_be_held(voltage):
    stage = axis(**ALL)
    y = [stage.step(k * 1e-3, voltage) for k in range(200)]
    assert np.all(np.isfinite(y))
