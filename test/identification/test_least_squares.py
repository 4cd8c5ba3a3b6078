"""The choice of the smoothness by cross-validation, and held-out errors, against fits without any saving."""

from dataclasses import replace

import numpy as np
import pytest
import scipy.sparse as sp
from identification.records import record_of

from slpi_ros.excitation.drives import calibration_drive
from slpi_ros.identification import least_squares
from slpi_ros.identification.fit import identify
from slpi_ros.identification.least_squares import Problem
from slpi_ros.identification.linear_kinds import SMOOTHNESS, surfaces
from slpi_ros.identification.samples import select_samples
from slpi_ros.model.document import format_model
from slpi_ros.simulation.axis import SimulatedAxis
from slpi_ros.simulation.parameters import AxisParameters


def recorded(seed, lag=0.0, bad=0.0):
    rng = np.random.default_rng(seed)
    t, v = calibration_drive(0.0, 100.0, duration=15.0, rate=100.0, seed=seed)
    late = np.interp(t - lag, t, v)
    y = SimulatedAxis(AxisParameters.random(seed), seed).run(t, late)[1]
    return record_of(t, v, y + np.where(rng.random(t.size) < bad, rng.normal(0.0, 1e-6, t.size), 0.0))


def posed(record, grid):
    samples = select_samples(record, "x", None, None)
    return Problem.pose([samples], surfaces([samples])[grid]).reweighted()


def held_out(problem, smoothness):
    """Weighted rms error (m) of fits to all folds but one, without constraints."""
    total = 0.0
    for fold in problem.folds:
        weights = problem.weights.copy()
        weights[fold.chosen] = 0.0
        matrix, vector = problem.design.normal_equations(problem.y, weights)
        x = np.linalg.solve(matrix + problem.penalty(smoothness, np.count_nonzero(weights)), vector)
        off = (problem.design.predict(x) - problem.y)[fold.chosen]
        total += problem.weights[fold.chosen] @ off**2
    chosen = np.concatenate([fold.chosen for fold in problem.folds])
    return np.sqrt(total / problem.weights[chosen].sum()) * problem.scale


@pytest.mark.parametrize(("seed", "lag"), [(0, 0.0), (1, 0.02), (2, 0.2)])
def test_the_best_smoothness_is_that_of_all_scores(seed, lag):
    problem = posed(recorded(seed, lag), 0)
    scores = np.array([held_out(problem, each) for each in SMOOTHNESS])
    np.testing.assert_allclose([problem.score(each) for each in SMOOTHNESS], scores, rtol=1e-8)
    best = int(np.argmin(scores))
    for near in SMOOTHNESS:
        found, score = problem.best_smoothness(SMOOTHNESS, near)
        assert (found, score) == (SMOOTHNESS[best], pytest.approx(scores[best], rel=1e-8))
    for below in scores * 0.9999:
        found, score = problem.best_smoothness(SMOOTHNESS, 0.1, below)
        assert (score < below) == (scores[best] < below)
        # No score below the bound is missed.
        for each, own in zip(SMOOTHNESS, scores, strict=True):
            assert (problem.score(each, below) < below) == (own < below)


def test_held_out_errors_are_those_of_fits_to_the_other_samples():
    problem = posed(recorded(3, 0.1, 0.03), 0)
    whole = problem.solve(0.1)
    assert np.any(whole.multipliers > 0.0), "a lag turns the slope after a reversal"
    errors = problem.held_out_errors(0.1, whole)
    for fold in problem.folds:
        weights = problem.weights.copy()
        weights[fold.chosen] = 0.0
        x = replace(problem, weights=weights).solve(0.1).x
        expected = (problem.design.predict(x) - problem.y)[fold.chosen] * problem.scale
        np.testing.assert_allclose(errors[fold.chosen], expected, atol=1e-6 * problem.scale)


def test_sparse_factors_give_the_same_fits(monkeypatch):
    record = recorded(5, 0.05)
    dense, others = posed(record, 2), posed(record, 2)
    monkeypatch.setattr(least_squares, "SPARSE_FROM", 100)
    sparse = posed(record, 2)
    np.testing.assert_allclose(sparse.residual(), others.residual(), atol=1e-9)
    assert all(isinstance(fold.matrix, sp.csc_array) for fold in sparse.folds)
    whole = dense.solve(0.3)
    errors = (problem.held_out_errors(0.3, whole) for problem in (sparse, dense))
    np.testing.assert_allclose(*errors, atol=1e-9 * dense.scale)
    monkeypatch.undo()
    np.testing.assert_allclose(sparse.score(0.3), others.score(0.3), rtol=1e-9)


def test_an_identification_that_is_repeated_gives_the_same_document():
    record = recorded(4, 0.05, 0.03)
    one, other = (format_model(replace(identify(replace(record)), created="")) for _ in range(2))
    assert one == other
