"""Monotone runs and reversals, with and without a dead band."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from slpi_ros.hysteresis.reversals import count_before, monotone_runs, reversals, without_small_reversals

STEPS = st.lists(st.sampled_from((-2.0, -1.0, 0.0, 0.0, 1.0, 3.0)), max_size=40)


@given(STEPS)
def test_runs_cover_the_signal_and_go_one_way(steps):
    x = np.cumsum([5.0, *steps])
    runs = monotone_runs(x)
    assert [start for start, _ in runs] == [0, *(stop for _, stop in runs[:-1])]
    assert np.all(x[: runs[0][1]] == 5.0)
    assert runs[-1][1] == x.size
    directions = []
    for start, stop in runs[1:]:
        assert stop > start
        moves = np.sign(np.diff(x[start - 1 : stop]))
        assert moves[0] != 0.0 and not {1.0, -1.0} <= set(moves.tolist())
        directions.append(moves.sum())
    # Neighbours go opposite ways, so there is no cut too many.
    assert (np.sign(directions[:-1]) == -np.sign(directions[1:])).all()


@given(STEPS)
def test_level_samples_stay_with_the_stretch_before_them(steps):
    x = np.cumsum([5.0, *steps])
    for start, _ in monotone_runs(x)[2:]:
        assert x[start] != x[start - 1]


def test_signals_without_a_move():
    assert monotone_runs(np.array([])) == []
    assert monotone_runs(np.array([3.0])) == [(0, 1)]
    assert monotone_runs(np.array([3.0, 3.0, 3.0])) == [(0, 3)]


@pytest.mark.parametrize(
    ("x", "runs"),
    [
        ([1, 2, 3], [(0, 1), (1, 3)]),
        ([1, 2, 3, 2, 1], [(0, 1), (1, 3), (3, 5)]),
        ([1, 3, 3, 3, 2, 2, 5], [(0, 1), (1, 4), (4, 6), (6, 7)]),
    ],
)
def test_cuts_come_after_the_extreme(x, runs):
    assert monotone_runs(np.array(x, dtype=float)) == runs


@given(st.lists(st.integers(-9, 9), max_size=30), st.integers(-10, 10), st.sampled_from((1, -1)))
def test_count_before(values, bound, direction):
    x = direction * np.sort(np.array(values, dtype=float))
    assert count_before(x, direction, bound) == np.count_nonzero(direction * (bound - x) > 0)
    assert count_before(x, direction, direction * np.inf) == x.size


@given(st.lists(st.integers(0, 12), min_size=1, max_size=60), st.sampled_from([0.0, 0.5, 1.0, 2.0, 5.0]))
def test_reversals_beyond_a_dead_band(values, dead_band):
    x = np.array(values, float)
    found = reversals(x, dead_band)
    assert np.all(np.diff(found) > 0)
    swing = np.diff(x[found])
    assert np.all(swing[1:] * swing[:-1] < 0)
    assert np.all(np.abs(swing) > dead_band)
    assert bool(swing.size) == (np.ptp(x) > dead_band)
    for outside in (x[: found[0] + 1], x[found[-1] :]):
        assert np.ptp(outside) <= dead_band or not swing.size
    for (start, stop), move in zip(pairwise(found), swing, strict=True):
        # Nothing within a run turns back by more than the dead band, or leaves what lies between its ends.
        along = x[start : stop + 1] * np.sign(move)
        assert np.max(np.maximum.accumulate(along) - along) <= dead_band
        assert along.min() == along[0] and along.max() == along[-1]


@given(st.lists(st.integers(0, 12), min_size=1, max_size=60), st.sampled_from([0.5, 1.0, 2.0, 5.0]))
def test_flattening_leaves_exactly_the_large_reversals(values, dead_band):
    x = np.array(values, float)
    flat = without_small_reversals(x, dead_band)
    assert np.abs(flat - x).max() <= dead_band
    large = reversals(x, dead_band)
    assert (flat[large] == x[large]).all()
    assert (flat[reversals(flat)[1:-1]] == x[large[1:-1]]).all()


def test_reversals_of_signals_that_are_short_or_still():
    assert reversals(np.array([])).size == 0
    assert reversals(np.array([3.0])).tolist() == reversals(np.full(4, 3.0)).tolist() == [0]
    assert reversals(np.array([0.0, 3.0, 3.0, 1.0, 2.0])).tolist() == [0, 2, 3, 4]
    assert reversals(np.array([0.0, 3.0, 3.0, 1.0, 2.0]), 1.0).tolist() == [0, 2, 3]
    assert reversals(np.array([0.0, 3.0, 2.5, 3.0, 1.0, 9.0]), 1.0).tolist() == [0, 1, 4, 5]
