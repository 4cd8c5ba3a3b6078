"""The joint fit of hysteresis and columns, against plain dense least squares."""

import numpy as np
import pytest

from slpi_ros.diagnosis.effect_parameters import EachRecord, free, moved, steps
from slpi_ros.diagnosis.held_out import UNDETERMINED
from slpi_ros.diagnosis.joint_fit import Equations, JointFit, _thinned
from slpi_ros.diagnosis.prepare import Evidence, Part
from slpi_ros.effects.gain_drift import GainDrift
from slpi_ros.effects.lag import Lag
from slpi_ros.identification.bases import SurfaceBasis
from slpi_ros.identification.least_squares import FOLDS

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
    joint = Equations(said, said.v)
    x_fitted, gains = joint.columns(columns).fit(said.y)
    _, x = dense(joint, said.y, columns, np.ones(said.y.size, dtype=bool))
    np.testing.assert_allclose(gains, x[-2:], rtol=1e-5, atol=1e-9)
    np.testing.assert_allclose(x_fitted, x[:-2], rtol=0, atol=1e-6)


def losses(joint, y, columns):
    """Return what a fit of columns leaves of `y` on data left out."""
    count = columns.shape[1]
    return joint.held_out(joint.sampled(np.column_stack([y, columns]))).loss([0], range(1, 1 + count))


def test_errors_of_blocks_left_out_are_those_of_fits_without_them():
    said, columns = evidence()
    y = said.y + columns @ [0.3, -0.2]
    joint = Equations(said, said.v)
    errors = np.full(y.size, np.nan)
    for rows in joint._groups[1:]:
        kept = np.ones(y.size, dtype=bool)
        kept[rows] = False
        predicted, _ = dense(joint, y, columns, kept)
        errors[rows] = (y - predicted)[rows]
    judged = np.isfinite(errors)
    loss = losses(joint, y, columns)
    np.testing.assert_allclose(loss.errors, errors[judged], atol=1e-4 * loss.rms)
    assert np.count_nonzero(judged) > 0.8 * y.size and loss.records == pytest.approx([np.nanmean(errors**2)], rel=1e-4)


def test_tangents_are_those_of_each_parameter_alone():
    said, _ = evidence(3)
    knots = ((7.0, 15.0), (5.0, 9.0, 15.0), (7.0, 15.0))
    drift = EachRecord(tuple(GainDrift(times, (0.001, -0.002, 0.003)[: len(times)], 0.0) for times in knots))
    fit = JointFit(said, [Lag(0.02), drift])
    alone = []
    for effect in fit.effects:
        values = free(effect)
        for k, step in enumerate(steps(effect, said.t, said.v)):
            other = moved(effect, values + step * (np.arange(values.size) == k))
            others = [other if one is effect else one for one in fit.effects]
            alone.append((fit._whole(others) - fit.predicted) / step)
    assert len(alone) == fit.tangents.shape[1] > 7
    np.testing.assert_allclose(fit.tangents, np.column_stack(alone), rtol=0, atol=1e-15)


@pytest.mark.parametrize("own", [False, True])
def test_errors_of_a_record_left_out_are_those_of_a_hysteresis_fitted_to_the_others(own):
    said, columns = evidence(2)
    y = said.y + columns @ [0.3, -0.2]
    if own:
        # A column of the first record alone, fitted there, a block left out.
        columns = np.column_stack([columns, np.where(np.arange(y.size) < 1500, columns[:, 0] ** 2 * 1e6, 0.0)])
        y = y + 0.4 * columns[:, 2]
    joint = Equations(said, said.v)
    errors, groups = np.full(y.size, np.nan), iter(joint._groups)
    for record, rows in enumerate(said.slices):
        kept = np.ones(y.size, dtype=bool)
        kept[rows] = False
        left, rough = zip(
            *(without_hysteresis(joint, each, kept) for each in np.column_stack([y, columns]).T), strict=True
        )
        left, rough = np.column_stack(left), np.column_stack(rough)
        # What the others hardly determine follows from the record itself, with little weight, where they predict it.
        some = np.sqrt(UNDETERMINED)
        known = np.flatnonzero(~kept & joint.predictable)
        everything = np.vstack([left[kept], rough, some * left[known]])
        constant = np.concatenate([np.zeros(np.count_nonzero(kept) + rough.shape[0]), np.full(known.size, some)])
        gains = np.linalg.lstsq(np.column_stack([everything[:, 1:], constant]), everything[:, 0])[0][:-1]
        alone = [2] if own and record == 0 else []
        shared = [k for k in range(columns.shape[1]) if k not in alone]
        rest = left[:, 0] - left[:, 1:][:, shared] @ gains[shared]
        beside = np.column_stack([left[:, 1:][:, alone], np.ones(y.size)])
        next(groups)
        for _ in range(FOLDS):
            fold = np.intersect1d(next(groups), known)
            fitted = np.setdiff1d(known, fold)
            errors[fold] = rest[fold] - beside[fold] @ np.linalg.lstsq(beside[fitted], rest[fitted])[0]
    loss = losses(joint, y, columns)
    np.testing.assert_allclose(loss.errors, errors[np.isfinite(errors)], atol=1e-3 * loss.rms)
    assert loss.errors.size >= 0.5 * y.size and np.isfinite(loss.records).all()


def without_hysteresis(joint, signal, kept):
    """Return what the hysteresis, fitted to the samples kept, leaves of a signal, and its weighted roughness, m."""
    predicted, x = dense(joint, signal, np.empty((signal.size, 0)), kept)
    values, vectors = np.linalg.eigh(joint.problem.penalty(SMOOTHNESS, np.count_nonzero(kept)))
    rough = np.sqrt(np.maximum(values, 0.0))[:, None] * vectors.T @ -x * joint.problem.scale
    return signal - predicted, rough


def test_a_hold_before_the_motion_does_not_decide_what_others_predict():
    said, _ = evidence(2, hold=9.0)
    joint = Equations(said, said.v)
    moving = np.concatenate([part.t > 9.0 for part in said.parts])
    assert joint.predictable[moving].mean() > 0.5


def test_gains_that_may_not_be_negative_are_not():
    said, columns = evidence()
    y = said.y + columns @ [0.3, -0.2]
    joint = Equations(said, said.v)
    held_out = joint.held_out(joint.sampled(np.column_stack([y, columns])))
    free, bound = (held_out.gains([0], [1, 2], positive) for positive in ((), (2,)))
    np.testing.assert_allclose(free, [0.3, -0.2], atol=0.03)
    assert bound[1] == 0.0 and bound[0] == pytest.approx(0.3, abs=0.05)
    assert held_out.loss([0], [1, 2], (2,)).rms == pytest.approx(held_out.loss([0], [1]).rms, rel=1e-9)
    assert held_out.loss([0], [1, 2]).rms < held_out.loss([0], [1]).rms


def test_precision_is_what_many_noises_show():
    said, columns = evidence()
    joint, rng = Equations(said, said.v), np.random.default_rng(1)
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
