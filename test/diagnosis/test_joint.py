"""The joint fit of hysteresis and columns, against plain dense least squares."""

import numpy as np
import pytest

from slpi_ros.diagnosis.joint_fit import Joint
from slpi_ros.identification.bases import SurfaceBasis
from slpi_ros.identification.least_squares import Problem
from slpi_ros.identification.samples import Samples

SMOOTHNESS = 0.1
METRES = 2e-7


def record(seed=0, lead=()):
    rng = np.random.default_rng(seed)
    t = np.arange(1500) / 100
    v = 50 + 45 * np.sin(2 * np.pi * 0.7 * t) * np.cos(2 * np.pi * 0.05 * t)
    y = METRES * (v + 4 * np.sin(2 * np.pi * 0.7 * t - 1)) + 1e-8 * rng.normal(size=t.size)
    columns = 1e-6 * np.column_stack([np.sin(11 * t), np.cos(17 * t)])
    samples = Samples(v, y, np.ones(t.size, dtype=bool)).after(lead)
    return Problem.pose([samples], SurfaceBasis(np.linspace(v.min(), v.max(), 11))), y, columns


def dense(problem, lead, y, columns, kept):
    """Solve by stacking everything: samples kept, columns, and the square root of the penalty."""
    design = np.column_stack([problem.design.predict(unit)[lead:] for unit in np.eye(problem.design.local.shape[1])])
    design = np.column_stack([design, columns / problem.scale])
    penalty = np.zeros((design.shape[1],) * 2)
    own = problem.penalty(SMOOTHNESS, np.count_nonzero(kept))
    penalty[: own.shape[0], : own.shape[0]] = own
    matrix = design[kept].T @ design[kept] + penalty
    x = np.linalg.solve(matrix, design[kept].T @ (y[kept] / problem.scale))
    return design @ x * problem.scale, x


@pytest.mark.parametrize("lead", [(), (95.0, 5.0, 60.0)])
def test_fit_is_that_of_everything_stacked(lead):
    problem, y, columns = record(lead=lead)
    fit = Joint(problem, SMOOTHNESS, len(lead)).fit(y, columns)
    _, x = dense(problem, len(lead), y, columns, np.ones(y.size, dtype=bool))
    np.testing.assert_allclose(fit.gains, x[-2:], rtol=1e-5, atol=1e-9)
    np.testing.assert_allclose(fit.x, x[:-2], rtol=0, atol=1e-6)


def test_score_is_that_of_fits_without_the_blocks():
    problem, y, columns = record()
    y = y + columns @ [0.3, -0.2]
    joint = Joint(problem, SMOOTHNESS)
    errors = np.full(y.size, np.nan)
    for rows in joint._rows[1:]:
        kept = np.ones(y.size, dtype=bool)
        kept[rows] = False
        predicted, _ = dense(problem, 0, y, columns, kept)
        errors[rows] = (predicted - y)[rows]
    losses = [np.mean(errors[rows] ** 2) for rows in joint.blocks]
    np.testing.assert_allclose(joint.score(y, columns).losses, losses, rtol=1e-4)
    assert np.isfinite(errors).sum() > 0.8 * y.size


def test_gains_that_may_not_be_negative_are_not():
    problem, y, columns = record()
    y = y + columns @ [0.3, -0.2]
    free, bound = (Joint(problem, SMOOTHNESS).score(y, columns, positive=count).gains for count in (0, 1))
    np.testing.assert_allclose(free, [0.3, -0.2], atol=0.03)
    assert bound[1] == pytest.approx(0.0, abs=1e-9)
    assert bound[0] == pytest.approx(0.3, abs=0.05)


def test_precision_is_what_many_noises_show():
    problem, y, columns = record()
    joint, rng = Joint(problem, SMOOTHNESS), np.random.default_rng(1)
    noise = 2e-8
    gains = np.array([joint.fit(y + noise * rng.normal(size=y.size), columns).gains for _ in range(300)])
    stated = noise * np.sqrt(np.diag(np.linalg.inv(joint.fit(y, columns).precision)))
    np.testing.assert_allclose(gains.std(axis=0), stated, rtol=0.15)
