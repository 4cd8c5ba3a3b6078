from dataclasses import FrozenInstanceError, replace

import numpy as np
import pytest

from slpi_ros.errors import UsageError
from slpi_ros.simulation.axis import SimulatedAxis
from slpi_ros.simulation.parameters import AxisParameters
from slpi_ros.simulation.preisach import measure_loop
from slpi_ros.simulation.surroundings import Sensor

SEEDS = range(12)
QUIET = AxisParameters(noise_rms=0.0, quantisation=0.0)


def loop(stage, high=100.0):
    return measure_loop(lambda v: stage.step(0.0, v), 0.0, high)


def triangle_wave(count=2001, low=0.0, high=100.0):
    return np.linspace(0, 10, count), np.interp(np.linspace(0, 4, count), range(5), [low, high] * 2 + [low])


def test_the_stage_has_the_stroke_and_hysteresis_asked_for():
    figure = loop(SimulatedAxis(QUIET))
    assert figure.stroke == pytest.approx(22e-6)
    assert figure.hysteresis == pytest.approx(0.14)


@pytest.mark.parametrize("seed", SEEDS)
def test_random_stages_are_plausible(seed):
    figure = loop(SimulatedAxis(AxisParameters.random(seed)))
    assert 20e-6 <= figure.stroke <= 25e-6
    assert 0.12 <= figure.hysteresis <= 0.17
    assert 0.03 < figure.remanence / figure.stroke < 0.20


@pytest.mark.parametrize("seed", SEEDS)
def test_rising_curves_bend_up_and_falling_curves_bend_down(seed):
    """The look of a piezo loop: the slope grows along every branch, and the two branches enclose an area."""
    stage = SimulatedAxis(replace(AxisParameters.random(seed), curvature=0.0))
    _, v = triangle_wave(2001)
    y, _ = stage.run(np.zeros(v.size), v)
    rising, falling = y[1000:1501], y[1500:2001]
    for branch in (rising, -falling):
        slope = np.diff(branch)
        assert slope[-50:].mean() > 1.1 * slope[:50].mean()
    assert np.all(falling[::-1][1:-1] > rising[1:-1])


def test_a_stage_rests_at_its_offset_and_keeps_a_remanence():
    stage = SimulatedAxis(replace(QUIET, offset=1e-7))
    assert stage.step(0.0, 0.0) == pytest.approx(1e-7, abs=1e-15)
    stage.step(1.0, 100.0)
    assert stage.step(2.0, 0.0) > 1e-6
    stage.rest()
    assert stage.step(3.0, 0.0) == pytest.approx(1e-7, abs=1e-15)


def test_the_density_differs_with_bias():
    """Minor loops of one width at two places of the range are not alike."""
    stage = SimulatedAxis(replace(QUIET, curvature=0.0))
    widths = []
    for low in (10.0, 70.0):
        stage.rest()
        figure = measure_loop(lambda v: stage.step(0.0, v), low, low + 20.0)
        widths.append(figure.falling_middle - figure.rising_middle)
    assert abs(widths[1] / widths[0] - 1) > 0.1


@pytest.mark.parametrize("seed", SEEDS)
def test_displacement_follows_the_direction_of_the_voltage(seed):
    stage = SimulatedAxis(AxisParameters.random(seed))
    v = np.interp(np.arange(3000), np.arange(0, 3000, 100), np.random.default_rng(seed).uniform(-20, 120, 30))
    y, _ = stage.run(np.arange(3000) / 200, v)
    assert np.all(np.diff(y) * np.diff(v) >= -1e-20)


def test_the_relay_grid_does_not_show():
    """Twice as fine a grid differs by less than the sensor noise."""
    t, v = triangle_wave(4001, 0.0, 97.3)
    coarse, fine = (SimulatedAxis(replace(QUIET, levels=levels)).run(t, v)[0] for levels in (280, 560))
    assert np.max(np.abs(coarse - fine)) < 4e-9
    steps = np.diff(coarse[:1001])
    assert steps.max() < 2 * steps.min()


def test_time_makes_no_difference():
    _, v = triangle_wave()
    fast, slow = (SimulatedAxis(QUIET).run(np.linspace(0, end, v.size), v)[0] for end in (1.0, 1000.0))
    np.testing.assert_array_equal(fast, slow)


def test_one_seed_is_one_stage_and_one_noise():
    t, v = triangle_wave()
    one, same, other = (SimulatedAxis(AxisParameters.random(seed), seed).run(t, v)[1] for seed in (3, 3, 4))
    np.testing.assert_array_equal(one, same)
    assert np.max(np.abs(one - other)) > 1e-7


def test_sample_by_sample_equals_a_run_and_a_run_continues():
    t, v = triangle_wave(501)
    one, two, three = (SimulatedAxis(seed=5) for _ in range(3))
    y, m = one.run(t, v)
    stepped = [(y_true := two.step(*sample), two.measure(y_true)) for sample in zip(t, v, strict=True)]
    np.testing.assert_array_equal(np.array(stepped).T, [y, m])
    parts = [three.run(t[part], v[part]) for part in (slice(0, 200), slice(200, None))]
    np.testing.assert_array_equal(np.concatenate(parts, axis=1), [y, m])


def test_noise():
    errors = Sensor(noise_rms=8e-9, quantisation=0.0, seed=1).read(np.zeros(40_000))
    assert errors.std() == pytest.approx(8e-9, rel=0.02)
    assert abs(errors.mean()) < 2e-10


def test_quantisation():
    readings = Sensor(noise_rms=8e-9, quantisation=1e-9, seed=1).read(np.linspace(0, 1e-7, 1000)) / 1e-9
    np.testing.assert_allclose(readings, np.round(readings), atol=1e-9)
    y = np.linspace(0, 1e-7, 1000)
    np.testing.assert_array_equal(Sensor(noise_rms=0.0, quantisation=0.0, seed=1).read(y), y)


@pytest.mark.parametrize(
    "change",
    [
        {"stroke": 0.0},
        {"stroke": float("nan")},
        {"hysteresis": -0.1},
        {"threshold_min": 5.0},
        {"nominal_voltage": 0.0},
        {"threshold_max": 90.0},
        {"levels": 1},
        {"width_scale": 0.0},
        {"width_growth": 1.0},
        {"curvature": -0.5},
        {"noise_rms": -1e-9},
        {"quantisation": -1e-9},
        {"exponent": 0.9},
        {"exponent": 1.6},
        {"exponent": float("nan")},
        {"origin": 1.0},
        {"origin": -21.0},
        {"width_exponent": 0.5},
        {"width_exponent": 11.0},
    ],
)
def test_parameters_that_are_no_stage(change):
    with pytest.raises(UsageError, match=next(iter(change))):
        replace(QUIET, **change)


def test_parameters_are_frozen():
    with pytest.raises(FrozenInstanceError):
        QUIET.stroke = 1.0


def test_more_hysteresis_than_the_relays_can_give():
    with pytest.raises(UsageError, match=r"\b0\.5\b"):
        SimulatedAxis(replace(QUIET, hysteresis=0.5))


def test_a_run_needs_one_time_for_each_voltage():
    with pytest.raises(UsageError):
        SimulatedAxis(QUIET).run(np.zeros(3), np.zeros(4))


def test_stiffening_makes_loops_between_the_same_voltages_differ():
    """Without it they are congruent, as in every Preisach model; a real stage is not so kind."""
    v = np.concatenate(
        [np.linspace(0, 100, 300), np.linspace(100, 40, 200), np.linspace(40, 60, 100), np.linspace(60, 40, 100)]
    )
    v = np.concatenate([v, np.linspace(40, 0, 100), np.linspace(0, 60, 100), np.linspace(60, 40, 100)])
    heights = []
    for stiffening in (0.0, 0.05):
        stage = SimulatedAxis(replace(QUIET, stiffening=stiffening))
        y, _ = stage.run(np.zeros(v.size), v)
        heights.append((y[599] - y[699], y[899] - y[999]))
    assert heights[0][0] == pytest.approx(heights[0][1], rel=1e-9)
    assert abs(heights[1][0] - heights[1][1]) > 1e-3 * heights[1][0]
