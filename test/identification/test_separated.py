"""Identification of the published SLPI model: loops recovered, loops that close, what the paper's rules say."""

import warnings
from itertools import pairwise

import numpy as np
import pytest
from identification.records import record_of, rms

from slpi_ros.errors import IdentificationError, UsageError
from slpi_ros.hysteresis.prandtl_ishlinskii import PrandtlIshlinskii, play
from slpi_ros.hysteresis.slpi_published import SeparatedLoops, SingleLoop, at_vertex, separate
from slpi_ros.identification.fit import identify
from slpi_ros.identification.published_kinds import default_thresholds, plays_from_vertex
from slpi_ros.model.document import format_model, parse_model
from slpi_ros.papers.slpi_exhibits import least_iterations
from slpi_ros.simulation.axis import SimulatedAxis
from slpi_ros.simulation.parameters import AxisParameters


def ramps(*turns):
    return np.concatenate([[turns[0]], *(np.arange(a, b, np.sign(b - a))[1:] for a, b in pairwise(turns))])


PATH = ramps(0.0, 80, 12, 68, 20, 100, -1)
TIME = 0.1 * np.arange(PATH.size)
THRESHOLDS = np.arange(0.0, 50.0, 5.0)


def loop(level, direction, vertex, span, slope, run_in):
    weights = slope * np.array([1.0, 0.2, 0.1, 0.05, 0.1, 0.02, 0.0, 0.03, 0.01, 0.02])
    return SingleLoop(
        level, direction, vertex, span, (0.0, 0.0), PrandtlIshlinskii(THRESHOLDS, weights), run_in
    )  # fmt: skip


def stage_record(parameters=None):
    stage = SimulatedAxis(parameters or AxisParameters(stroke=24e-6), 0)
    t = 0.1 * np.arange(PATH.size)
    return record_of(t, PATH, stage.run(t, PATH)[0])


@pytest.mark.parametrize("run_in", [None, 0.0, 5.0, 20.0, 45.0])
@pytest.mark.parametrize("seed", range(3))
def test_play_operators_move_as_those_of_the_model(seed, run_in):
    drive = np.append(0.0, np.repeat(np.abs(np.cumsum(np.random.default_rng(seed).normal(0.0, 8.0, 60))), 2))
    moved = plays_from_vertex(drive, THRESHOLDS, run_in)
    expected = [at_vertex(play(r), run_in).forward_array(drive) for r in THRESHOLDS]
    np.testing.assert_allclose(moved, np.column_stack(expected), atol=1e-12)


def test_recovers_the_weights_of_every_loop():
    outer = loop(0, 1, (0.0, 0.0), (100.0, 1.0), 1e-7, 10.0)
    flat = SeparatedLoops((outer,)).along(0.0, 0.0).forward_array(ramps(0.0, 100, -1))
    first = loop(1, -1, (80.0, float(flat[80])), (68.0, 1e-6), 1.3e-7, 0.0)
    second = loop(2, -1, (68.0, 0.0), (48.0, 1e-6), 1.6e-7, 0.0)
    with warnings.catch_warnings():
        # Made with spans that are not those of the path.
        warnings.simplefilter("ignore")
        y = SeparatedLoops((outer, first, second)).along(0.0, 0.0).forward_array(PATH)
    model = identify(record_of(0.1 * np.arange(PATH.size), PATH, y), "slpi-published")
    found = model.axes["x"].hysteresis.loops
    assert [(f.level, f.direction, f.run_in) for f in found] == [(0, 1, 10.0), (1, -1, 0.0), (2, -1, 0.0)]
    for expected, got in zip((outer, first, second), found, strict=True):
        np.testing.assert_allclose(got.model.thresholds, THRESHOLDS)
        # Operators that the loop does not move are not seen.
        moved = got.span[0] - 1 > 2 * THRESHOLDS
        np.testing.assert_allclose(got.model.weights[moved], expected.model.weights[moved], atol=2e-3 * 1e-7)
    np.testing.assert_allclose(model.axes["x"].simulate(TIME, PATH), y, atol=1e-6 * np.ptp(y))


def test_loops_close_and_describe_the_record_better_than_at_rest():
    record = stage_record()
    y = record.displacement["x"]
    error = {}
    for at_rest in (True, False):
        axis = identify(record, "slpi-published", loops_at_rest=at_rest).axes["x"]
        error[at_rest] = rms(axis.simulate(TIME, PATH) - y)
        assert axis.quality.rms == pytest.approx(error[at_rest])
        gaps = [
            abs(single.memory().forward_array(np.array([0.0, single.span[0], 0.0]))[-1])
            for single in axis.hysteresis.loops
            if single.level
        ]
        assert max(gaps) < 1e-9 * np.ptp(y) if not at_rest else min(gaps) > 1e-3 * np.ptp(y)
    assert error[False] < error[True]
    assert error[False] < 0.7 * rms(identify(record, "pi").axes["x"].simulate(TIME, PATH) - y)


def test_document_gives_the_same_model_back():
    model = identify(stage_record(), "slpi-published")
    again = parse_model(format_model(model), "test")
    np.testing.assert_array_equal(again.axes["x"].simulate(TIME, PATH), model.axes["x"].simulate(TIME, PATH))
    desired = model.axes["x"].simulate(TIME, PATH)
    np.testing.assert_array_equal(
        again.axes["x"].compensate(TIME, desired)[0], model.axes["x"].compensate(TIME, desired)[0]
    )


def test_compensates_a_path_with_the_same_loops():
    record = stage_record()
    y = record.displacement["x"]
    model = identify(record, "slpi-published")
    # Straight between the turning points that were measured.
    turns = [0, *(np.flatnonzero(np.diff(np.sign(np.diff(PATH)))) + 1).tolist(), PATH.size - 1]
    desired = np.interp(np.arange(PATH.size), turns, y[turns])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        v = model.axes["x"].hysteresis.along(0.0, float(y[0])).inverse_array(desired)
    reached = SimulatedAxis(AxisParameters(stroke=24e-6), 0).run(record.t, np.clip(v, -20, 120))[0]
    assert np.mean(np.abs(reached - desired)) < 0.01 * np.ptp(y)


def test_cannot_follow_an_unknown_path():
    model = identify(stage_record(), "slpi-published")
    with pytest.raises(UsageError, match="slpi-published"):
        model.stream("x")


def test_default_thresholds_are_the_papers():
    np.testing.assert_array_equal(default_thresholds(100.0), np.arange(0, 50, 5))
    np.testing.assert_array_equal(default_thresholds(110.0), np.arange(0, 50, 5))
    np.testing.assert_allclose(default_thresholds(3.6), 3.6 * np.arange(0, 0.5, 0.05))


def test_least_iterations_is_equation_9():
    assert least_iterations(100, 100) == int(np.ceil(10 * np.sqrt(5)))
    assert least_iterations(25, 100) == int(np.ceil(10 * np.sqrt(2)))


def test_record_without_an_outer_loop_says_so():
    v = np.concatenate([[0.0, 50.0, 20.0], np.tile(ramps(21.0, 40, 20), 5)])
    with pytest.raises(IdentificationError, match="outer loop has 3 usable samples"):
        identify(record_of(0.1 * np.arange(v.size), v, 1e-7 * v), "slpi-published")


def test_at_rest_is_a_matter_of_published_loops():
    with pytest.raises(UsageError, match="slpi-published"):
        identify(stage_record(), "pi", loops_at_rest=True)


def test_separates_as_many_loops_as_it_identifies():
    model = identify(stage_record(), "slpi-published")
    assert len(model.axes["x"].hysteresis.loops) == len(separate(PATH).loops)
    assert model.axes["x"].quality.covered == 1.0


def test_noise_of_the_measured_voltage_makes_no_loops():
    record = stage_record()
    noisy = PATH + np.random.default_rng(0).normal(0.0, 0.05, PATH.size)
    axis = identify(record_of(record.t, noisy, record.displacement["x"]), "slpi-published").axes["x"]
    assert len(axis.hysteresis.loops) == len(separate(PATH).loops)
    clean = identify(record, "slpi-published").axes["x"]
    assert rms(axis.simulate(TIME, noisy) - record.displacement["x"]) < 1.2 * clean.quality.rms + 3 * 0.05 * 0.25e-6
    assert clean.hysteresis.dead_band < 1e-9
