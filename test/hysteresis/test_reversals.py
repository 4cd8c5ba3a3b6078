import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from slpi_ros.hysteresis.reversals import count_before, monotone_runs

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
