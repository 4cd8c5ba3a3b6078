"""The SMPI model: peaks as given, cycles cut alike both ways, each the paper's recursion, scaled."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from strategies import fractions

from slpi_ros.errors import ModelError, UsageError
from slpi_ros.hysteresis.multi_slope import AmplitudeScaled, MultiSlope, cycles, thresholds_for
from slpi_ros.hysteresis.turning_points import Memory

ORIGIN = -10.0
BASE = MultiSlope(ORIGIN, 120.0, thresholds_for(120.0), 1e-7 * np.array([5, 0, 1, 2, 0, 0, 1, 0.5, 0, 0, 0, 0.2, 0]))
STROKE = BASE.stroke(ORIGIN + 120.0, ORIGIN)
# MPI paper, Table 1: `a` over amplitude is no straight line; here it ends at the base model's own peak.
AMPLITUDES = np.array([20.0, 40.0, 60.0, 80.0, 100.0, 120.0])
PEAKS = np.array([12.306, 27.235, 43.448, 59.669, 75.08, 89.189]) / 89.189 * STROKE
MODEL = AmplitudeScaled(BASE, AMPLITUDES, PEAKS)


def triangle(amplitude, samples=100):
    """One cycle from the origin, which is its last sample but not its first."""
    up = np.linspace(0.0, amplitude, samples + 1)[1:]
    return ORIGIN + np.concatenate([up, up[-2::-1], [0.0]])


def scaled_recursion(amplitude, v):
    """Eq. 2 on one cycle, thresholds and V_p by the paper's rule for this amplitude."""
    r, f, y = BASE.thresholds * amplitude / 120.0, np.zeros(13), []
    for u in v - ORIGIN:
        f = np.maximum(u - r, np.minimum(np.minimum(1.2 * u, 0.8 * u + 0.2 * amplitude + 0.6 * r), f))
        y.append(BASE.weights @ f)
    return np.array(y)


@pytest.mark.parametrize("amplitude", [3.0, 20.0, 47.0, 80.0, 120.0, 150.0])
def test_the_peak_of_a_cycle_is_that_of_its_amplitude(amplitude):
    y = MODEL.along(ORIGIN, 1e-6).forward_array(triangle(amplitude))
    assert y.max() - 1e-6 == pytest.approx(MODEL.peak(amplitude), rel=1e-12)
    assert y[-1] == pytest.approx(1e-6, abs=1e-12 * STROKE)


def test_peaks_between_and_beyond_the_knots_lie_on_the_line():
    assert MODEL.peak(0.0) == 0.0
    assert MODEL.peak(10.0) == pytest.approx(PEAKS[0] / 2)
    assert MODEL.peak(50.0) == pytest.approx((PEAKS[1] + PEAKS[2]) / 2)
    assert MODEL.peak(130.0) == pytest.approx(PEAKS[-1] + (PEAKS[-1] - PEAKS[-2]) / 2)


@pytest.mark.parametrize("amplitude", [20.0, 50.0, 80.0, 120.0])
def test_a_cycle_is_the_paper_s_sum_of_operators_scaled(amplitude):
    v = np.concatenate([triangle(amplitude)[:150], ORIGIN + np.linspace(0.5, 0.9, 20) * amplitude, [ORIGIN]])
    expected = scaled_recursion(amplitude, v)
    expected *= MODEL.peak(amplitude) / expected.max()
    y = MODEL.along(ORIGIN, 0.0).forward_array(v)
    np.testing.assert_allclose(y, expected, rtol=0, atol=1e-12 * STROKE)


@given(fractions(0.1, 10.0), st.lists(fractions(0, 120), min_size=1, max_size=30))
def test_eq_2_is_homogeneous(factor, u):
    """Ten times the voltages, thresholds and V_p: ten times the answer."""
    larger = MultiSlope(ORIGIN, factor * BASE.amplitude, factor * BASE.thresholds, BASE.weights)
    one = Memory(BASE, ORIGIN).forward_array(ORIGIN + np.array(u))
    other = Memory(larger, ORIGIN).forward_array(ORIGIN + factor * np.array(u))
    np.testing.assert_allclose(other, factor * one, rtol=0, atol=1e-10 * factor * STROKE)


def test_at_the_base_amplitude_it_is_the_mpi_model():
    v = np.concatenate([triangle(120.0), triangle(120.0)])
    expected = Memory(BASE, ORIGIN).forward_array(v)
    np.testing.assert_allclose(MODEL.along(ORIGIN, 0.0).forward_array(v), expected, rtol=0, atol=1e-12 * STROKE)


def test_each_cycle_of_two_amplitudes_has_its_own():
    first, second = triangle(80.0), triangle(40.0, 33)
    together = MODEL.along(ORIGIN, 0.0).forward_array(np.concatenate([[ORIGIN], first, second, first]))
    alone = [MODEL.along(ORIGIN, 0.0).forward_array(v) for v in (first, second, first)]
    np.testing.assert_allclose(together, np.concatenate([[0.0], *alone]), rtol=0, atol=1e-11 * STROKE)
    assert max(alone[0]) == pytest.approx(PEAKS[3]) and max(alone[1]) == pytest.approx(PEAKS[1])


def test_cycles_end_at_the_first_lowest_sample_of_each_return():
    x = np.array([0, 0, 5, 9, 3, 1, 0.5, 0.5, 0.8, 4, 2, 7, 0, 1])
    assert cycles(x, 1.0) == [(0, 6), (6, 12), (12, 13)]
    assert cycles(np.array([3.0, 5.0, 0.5, 2.0]), 1.0) == [(0, 2), (2, 3)]
    assert cycles(np.array([3.0, 5.0, 2.0]), 1.0) == [(0, 2)]
    assert cycles(np.array([3.0]), 1.0) == []


@st.composite
def paths_of_cycles(draw):
    """Draw cycles of several amplitudes, with inner loops; each ends clearly within the band at the low end."""
    v = [ORIGIN]
    for amplitude in draw(st.lists(fractions(4.0, 140.0), min_size=1, max_size=5)):
        inner = draw(st.lists(fractions(0.1, 1.0), max_size=4))
        end = draw(st.sampled_from((0.0, 0.0, 0.1, 0.4)))
        for goal in [max(3.0, share * amplitude) for share in inner] + [amplitude, end]:
            v.extend(np.linspace(v[-1], ORIGIN + goal, draw(st.sampled_from((1, 3, 50))) + 1)[1:].tolist())
    return np.array(v)


@given(paths_of_cycles(), st.sampled_from((0.0, 3e-6)))
def test_forward_of_inverse_is_the_identity(v, y_start):
    path = MODEL.along(ORIGIN, y_start)
    y = path.forward_array(v)
    np.testing.assert_allclose(path.forward_array(path.inverse_array(y)), y, rtol=0, atol=1e-9 * STROKE)


@given(paths_of_cycles())
def test_displacement_is_continuous_and_never_falls_where_voltage_rises(v):
    y = MODEL.along(ORIGIN, 0.0).forward_array(v)
    steps, moved = np.diff(v), np.diff(y)
    assert (moved * np.sign(steps) >= -1e-11 * STROKE).all()
    steepest = 1.2 * BASE.weights.sum() * 1.2
    assert (np.abs(moved) <= steepest * np.abs(steps) + 1e-11 * STROKE).all()


def test_desired_cycles_of_known_peaks_get_their_amplitudes():
    """Back to the start only nearly, as a sampled triangle is."""
    t = np.arange(0, 3, 1 / 700)
    rise = 1 - np.abs(1 - 2 * (t % 1))
    y = 2e-6 + rise * np.array([PEAKS[2], PEAKS[3], PEAKS[5]])[np.minimum(t.astype(int), 2)]
    v = MODEL.along(ORIGIN, 2e-6).inverse_array(y)
    for cycle, amplitude in enumerate((60.0, 80.0, 120.0)):
        assert v[t.astype(int) == cycle].max() - ORIGIN == pytest.approx(amplitude, rel=5e-3)
    again = MODEL.along(ORIGIN, 2e-6).forward_array(v)
    np.testing.assert_allclose(again, y, rtol=0, atol=1e-9 * STROKE)


def test_voltage_limits_hold_and_what_is_within_reach_is_met():
    path = MODEL.along(ORIGIN, 0.0)
    y = path.forward_array(np.concatenate([triangle(60.0), triangle(110.0), triangle(40.0)]))
    v = path.inverse_array(y, ORIGIN, ORIGIN + 90.0)
    assert v.min() >= ORIGIN and v.max() == ORIGIN + 90.0
    got, free = path.forward_array(v), v < ORIGIN + 90.0
    np.testing.assert_allclose(got[free], y[free], rtol=0, atol=1e-9 * STROKE)
    assert (got[~free] < y[~free] + 1e-9 * STROKE).all() and (~free).sum() > 10


def test_limits_hold_to_the_last_bit():
    y = MODEL.along(ORIGIN, 0.0).forward_array(np.concatenate([triangle(120.0, 9), triangle(40.0, 9)]))
    for lower, upper in ORIGIN + np.random.default_rng(0).uniform([0, 60], [1, 110], (100, 2)):
        v = MODEL.along(ORIGIN + 1.0, 0.0).inverse_array(y, lower, upper)
        assert v.min() >= lower and v.max() == upper


def test_a_cycle_starts_where_a_limit_held_the_one_before_it():
    path = MODEL.along(ORIGIN + 1.0, 0.0)
    y = path.forward_array(np.concatenate([triangle(60.0), triangle(110.0)]))
    v = path.inverse_array(y, ORIGIN + 1.0, ORIGIN + 120.0)
    got, free = path.forward_array(v), v > ORIGIN + 1.0
    assert not free[199] and got[199] > y[199] + 1e-3 * STROKE
    np.testing.assert_allclose(got[free], y[free], rtol=0, atol=1e-9 * STROKE)


def test_a_path_that_starts_away_from_the_low_end():
    path = MODEL.along(ORIGIN + 30.0, 5e-6)
    v = ORIGIN + np.interp(np.arange(301), [0, 60, 120, 180, 240, 300], [30, 100, 12, 60, 0, 50])
    y = path.forward_array(v)
    assert y[0] == 5e-6
    np.testing.assert_allclose(path.forward_array(path.inverse_array(y)), y, rtol=0, atol=1e-9 * STROKE)


def test_a_path_that_hardly_moves_is_no_error():
    path = MODEL.along(ORIGIN, 0.0)
    v = ORIGIN + np.array([0.0, 0.0, 0.5, 0.2, 0.9, 0.0])
    y = path.forward_array(v)
    assert y[0] == 0.0 and (y[2:5] > 0).all()
    np.testing.assert_allclose(path.forward_array(path.inverse_array(y)), y, rtol=0, atol=1e-12 * STROKE)
    assert path.forward_array(np.array([])).size == path.inverse_array(np.array([])).size == 0


@pytest.mark.parametrize("method", ["forward_array", "inverse_array"])
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_what_is_not_finite_is_told(method, value):
    with pytest.raises(UsageError, match=r"\b1\b"):
        getattr(MODEL.along(ORIGIN, 0.0), method)(np.array([0.0, value, 0.0]))


@pytest.mark.parametrize(
    ("voltages", "displacements"),
    [
        ([], []),
        ([1.0, 2.0], [1.0]),
        ([[1.0]], [[1.0]]),
        ([0.0, 1.0], [1.0, 2.0]),
        ([1.0, 1.0], [1.0, 2.0]),
        ([1.0, 2.0], [2.0, 1.0]),
        ([1.0, 2.0], [0.0, 1.0]),
        ([1.0, np.nan], [1.0, 2.0]),
        ([1.0, 2.0], [1.0, np.inf]),
    ],
)
def test_peaks_that_make_no_model(voltages, displacements):
    with pytest.raises(ModelError):
        AmplitudeScaled(BASE, np.array(voltages), np.array(displacements))


def test_a_base_that_never_moves_is_no_model():
    base = MultiSlope(0.0, 120.0, np.array([1000.0]), np.array([1e-7]))
    with pytest.raises(ModelError):
        AmplitudeScaled(base, np.array([120.0]), np.array([1e-5]))
