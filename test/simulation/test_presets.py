from dataclasses import replace

import numpy as np
import pytest

from slpi_ros.simulation.axis import SimulatedAxis
from slpi_ros.simulation.preisach import measure_loop
from slpi_ros.simulation.stage import flexure_axis, p11_stage

# Second paper, Table 1: amplitude (V), a (µm), b.
TABLE_1 = [
    (20, 12.306, -0.017),
    (40, 27.235, -0.018),
    (60, 43.448, -0.017),
    (80, 59.669, -0.014),
    (100, 75.08, -0.013),
    (120, 89.189, -0.012),
]
FREQUENCIES = np.array([0.1, 0.5, 1, 2, 5, 10, 20])
SAMPLES = 1000


def axis(name="x", **changes):
    """Return an axis of the P11, as changed, with a perfect sensor."""
    given = p11_stage().axes[name]
    quiet = replace(given.parameters, noise_rms=0.0, quantisation=0.0)
    return SimulatedAxis(quiet, character=replace(given.character, **changes))


def triangles(stage, amplitude, frequency, periods=1):
    """Return displacements of triangles from rest, SAMPLES for each period."""
    stage.rest()
    phase = np.arange(periods * SAMPLES + 1) / SAMPLES
    return stage.run(phase / frequency, amplitude * (1 - np.abs(2 * (phase % 1) - 1)))[0]


def second_loop(stage, amplitude, frequency):
    """Return rise and fall of the second period against rising voltage, as shares of its stroke."""
    y = triangles(stage, amplitude, frequency, 2)[SAMPLES:]
    share = (y - y[0]) / np.ptp(y)
    return share[: SAMPLES // 2 + 1], share[SAMPLES // 2 :][::-1]


@pytest.mark.parametrize(("amplitude", "a", "b"), TABLE_1)
def test_peaks_of_the_p11_are_those_of_table_1(amplitude, a, b):
    stage = axis()
    peaks = np.array([triangles(stage, amplitude, f).max() for f in FREQUENCIES])
    exponent, log_scale = np.polyfit(np.log(FREQUENCIES), np.log(peaks), 1)
    assert np.exp(log_scale) * 1e6 == pytest.approx(a, rel=0.03)
    assert exponent == pytest.approx(b, abs=0.004)
    np.testing.assert_allclose(peaks, np.exp(log_scale) * FREQUENCIES**exponent, rtol=0.005)


@pytest.mark.parametrize("amplitude", [20, 60, 120])
def test_the_p11_rises_straight_and_falls_in_a_bulge(amplitude):
    rise, fall = second_loop(axis(), amplitude, 0.1)
    line = np.linspace(0, 1, rise.size)
    assert 0.12 < fall[rise.size // 2] - rise[rise.size // 2] < 0.15
    assert np.std(rise - line) < 0.02
    assert np.max(fall - line) > max(0.07, 1.3 * np.max(line - rise))


def test_the_p11_widens_its_loop_with_frequency_but_not_much():
    stage = axis()
    widths = [np.mean(np.subtract(*second_loop(stage, 120, f)[::-1])) for f in (0.1, 1, 10)]
    assert widths[0] < widths[1] < widths[2] < widths[0] + 0.015


def test_the_p11_rings_at_high_frequencies_only():
    stage, stiff = axis(), axis(resonance=0.0)
    swings = [np.max(np.abs(triangles(stage, 120, f, 2) - triangles(stiff, 120, f, 2))) for f in (1, 10, 20)]
    assert swings[0] < 0.15e-6
    assert swings[1] > 0.8e-6
    assert swings[2] > 1.6e-6


def test_the_p11_can_move_by_100_micrometres_and_takes_its_whole_voltage_range():
    stage = p11_stage()
    assert stage.voltage_range == (-20.0, 150.0)
    for name in ("x", "y"):
        assert triangles(stage.axes[name], 150, 1).max() > 105e-6
    assert triangles(axis(), -20, 1).min() < -10e-6


def test_the_axes_of_the_p11_differ_by_a_few_per_cent():
    x, y = (triangles(axis(name), 120, 1) for name in ("x", "y"))
    assert 0.01 < abs(y.max() / x.max() - 1) < 0.06
    assert np.max(np.abs(y / y.max() - x / x.max())) > 1e-3


def test_the_flexure_stage_has_the_stroke_and_hysteresis_it_says():
    stage = flexure_axis()
    figure = measure_loop(lambda v: stage.step(0.0, v), 0.0, 100.0)
    assert figure.stroke == pytest.approx(24e-6)
    assert figure.hysteresis == pytest.approx(0.14, rel=0.03)
    assert figure.remanence / figure.stroke == pytest.approx(0.08, abs=0.01)
    assert not stage.character.depends_on_time


def test_inner_loops_of_the_flexure_stage_incline_with_bias():
    stage = flexure_axis()
    figures = []
    for low in (5.0, 40.0, 75.0):
        stage.rest()
        figures.append(measure_loop(lambda v: stage.step(0.0, v), low, low + 20.0))
    slopes = [figure.stroke / 20.0 for figure in figures]
    widths = [figure.hysteresis for figure in figures]
    assert slopes[0] < slopes[1] < slopes[2] and slopes[2] > 1.15 * slopes[0]
    assert widths[0] < widths[1] < widths[2]


@pytest.mark.parametrize(
    ("preset", "noise"),
    [(flexure_axis, 5e-9), (lambda seed: p11_stage(seed).axes["x"], 10e-9)],
    ids=["flexure", "p11"],
)
def test_a_seed_is_a_noise_and_the_stage_is_the_same(preset, noise):
    t, v = np.arange(4000) * 1e-3, np.linspace(0, 100, 4000)
    (true, one), (_, same), (other_true, other) = (preset(seed).run(t, v) for seed in (3, 3, 4))
    np.testing.assert_array_equal(one, same)
    np.testing.assert_array_equal(true, other_true)
    assert np.std(one - true) == pytest.approx(noise, rel=0.05)
    assert np.any(one != other)


def test_the_axes_of_the_p11_do_not_share_their_noise():
    noises = [np.diff(stage.run(np.zeros(50), np.zeros(50))[1]) for stage in p11_stage(0).axes.values()]
    assert np.any(noises[0] != noises[1])
