"""The joint fit of hysteresis and columns, against plain dense least squares."""

import numpy as np
import pytest

from slpi_ros.diagnosis.joint_fit import Joint, _thinned
from slpi_ros.diagnosis.prepare import Evidence, Part
from slpi_ros.identification.bases import SurfaceBasis

SMOOTHNESS = 0.1
METRES = 2e-7


def evidence(records=1, lead=(), hold=0.0):
    """Return what records of one stage say, and columns of two disturbances; each begins with a hold (s)."""
    parts, columns = [], []
    for seed in range(records):
        rng = np.random.default_rng(seed)
        t = np.arange(1500) / 100
        v = 50 + 45 * np.sin(2 * np.pi * 0.7 * np.maximum(t - hold, 0) + seed) * np.cos(
            2 * np.pi * 0.05 * np.maximum(t - hold, 0)
        )
        y = METRES * (v + 4 * np.sin(2 * np.pi * 0.7 * t + seed - 1)) + 1e-8 * rng.normal(size=t.size)
        all_of_it = np.ones(t.size, dtype=bool)
        parts.append(Part(f"record {seed}", t, v, y, all_of_it, all_of_it, all_of_it, lead, {}, 0.0))
        columns.append(1e-6 * np.column_stack([np.sin(11 * t), np.cos(17 * t)]))
    low, high = min(part.v.min() for part in parts), max(part.v.max() for part in parts)
    return Evidence(tuple(parts), SurfaceBasis(np.linspace(low, high, 11)), SMOOTHNESS), np.concatenate(columns)


def dense(joint, y, columns, kept):
    """Solve by stacking everything: samples kept, columns, and the square root of the penalty."""
    problem, rows = joint.problem, joint.evidence.rows
    design = np.column_stack([problem.design.predict(unit)[rows] for unit in np.eye(problem.design.local.shape[1])])
    design = np.column_stack([design, columns / problem.scale])
    penalty = np.zeros((design.shape[1],) * 2)
    own = problem.penalty(SMOOTHNESS, np.count_nonzero(kept))
    penalty[: own.shape[0], : own.shape[0]] = own
    matrix = design[kept].T @ design[kept] + penalty
    x = np.linalg.solve(matrix, design[kept].T @ (y[kept] / problem.scale))
    return design @ x * problem.scale, x


@pytest.mark.parametrize("records", [1, 2])
@pytest.mark.parametrize("lead", [(), (95.0, 5.0, 60.0)])
def test_fit_is_that_of_everything_stacked(lead, records):
    said, columns = evidence(records, lead)
    joint = Joint(said, said.v)
    x_fitted, gains = joint.columns(columns).fit(said.y)
    _, x = dense(joint, said.y, columns, np.ones(said.y.size, dtype=bool))
    np.testing.assert_allclose(gains, x[-2:], rtol=1e-5, atol=1e-9)
    np.testing.assert_allclose(x_fitted, x[:-2], rtol=0, atol=1e-6)


def test_score_is_that_of_fits_without_the_blocks():
    said, columns = evidence(2)
    y = said.y + columns @ [0.3, -0.2]
    joint = Joint(said, said.v)
    errors = np.full(y.size, np.nan)
    for fold in joint.held_out[0]:
        rows = np.concatenate([joint._groups[group] for group in fold.left])
        kept = np.ones(y.size, dtype=bool)
        kept[rows] = False
        predicted, _ = dense(joint, y, columns, kept)
        errors[rows] = (predicted - y)[rows]
    losses = [np.mean(errors[rows] ** 2) for rows in joint.blocks]
    np.testing.assert_allclose(joint.score([joint.columns(y, columns)]).losses, losses, rtol=1e-4)
    assert np.isfinite(errors).sum() > 0.8 * y.size


def test_a_record_left_out_has_nothing_but_its_constant():
    said, columns = evidence(2)
    y = said.y + columns @ [0.3, -0.2]
    joint = Joint(said, said.v)
    score = joint.score([joint.columns(y, columns)])
    for rows, loss in zip(said.slices, score.records, strict=True):
        kept = np.ones(y.size, dtype=bool)
        kept[rows] = False
        without = y - columns @ score.gains
        predicted, _ = dense(joint, without, columns[:, :0], kept)
        judged = np.zeros(y.size, dtype=bool)
        judged[rows] = joint.predictable[rows]
        assert np.count_nonzero(judged) >= 0.5 * np.count_nonzero(said.used[rows])
        assert np.var((predicted - without)[judged]) == pytest.approx(loss, rel=1e-3)


def test_a_hold_before_the_motion_does_not_decide_what_others_predict():
    said, _ = evidence(2, hold=9.0)
    joint = Joint(said, said.v)
    moving = np.concatenate([part.t > 9.0 for part in said.parts])
    assert joint.predictable[moving].mean() > 0.5


def test_one_record_cannot_be_left_out():
    said, columns = evidence()
    joint = Joint(said, said.v)
    assert not joint.score([joint.columns(said.y, columns)]).records.size


def test_gains_that_may_not_be_negative_are_not():
    said, columns = evidence()
    y = said.y + columns @ [0.3, -0.2]
    joint = Joint(said, said.v)
    free, bound = (joint.score([joint.columns(y), joint.columns(columns)], positive=count).gains for count in (0, 1))
    np.testing.assert_allclose(free, [0.3, -0.2], atol=0.03)
    assert bound[1] == pytest.approx(0.0, abs=1e-9)
    assert bound[0] == pytest.approx(0.3, abs=0.05)


def test_precision_is_what_many_noises_show():
    said, columns = evidence()
    joint, rng = Joint(said, said.v), np.random.default_rng(1)
    noise = 2e-8
    beside = joint.columns(columns)
    gains = np.array([beside.fit(said.y + noise * rng.normal(size=said.y.size))[1] for _ in range(300)])
    stated = noise * np.sqrt(np.diag(np.linalg.inv(beside.precision)))
    np.testing.assert_allclose(gains.std(axis=0), stated, rtol=0.15)


def test_thinned_rows_show_a_line_at_a_quarter_of_the_sampling_rate():
    t = _thinned(np.arange(40_000), 2) / 200.0
    assert t.size == 20_000 and np.all(np.diff(t) > 0.0)
    # Both parts of the line are seen, and one is not mistaken for the other.
    parts = np.column_stack([np.sin(2 * np.pi * 50.0 * t), np.cos(2 * np.pi * 50.0 * t)])
    assert np.linalg.cond(parts) < 1.1
