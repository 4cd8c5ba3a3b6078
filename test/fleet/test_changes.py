"""Steps and drifts of a series."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from slpi_ros.fleet.changes import DRIFT, STEP, find_changes

DAY_NS = 86_400 * 10**9


def series(count, seed, scatter=1.0):
    """Return dates, noise and standard deviations of a series; the noise is `scatter` times as large as told."""
    rng = np.random.default_rng(seed)
    dates = np.sort(rng.choice(10 * count, count, replace=False)) * DAY_NS
    return dates, rng.normal(0.0, 3e-4 * scatter, count), np.full(count, 3e-4)


@pytest.mark.parametrize("count", [3, 5, 10, 40])
def test_noise_is_no_change(count):
    found = [find_changes(*series(count, seed, scatter)) for seed in range(100) for scatter in (1.0, 2.0)]
    assert sum(map(bool, found)) <= 4


@given(st.integers(0, 10_000), st.integers(4, 40), st.sampled_from([-0.01, 0.01]), st.data())
def test_a_step_is_dated(seed, count, size, data):
    at = data.draw(st.integers(1, count - 1))
    dates, noise, deviations = series(count, seed)
    found = find_changes(dates, noise + size * (np.arange(count) >= at), deviations)
    near = [one for one in found if abs(int(np.searchsorted(dates, one.date_ns)) - at) <= 1]
    assert near and all(one.chance <= 1e-3 for one in found)


@given(st.integers(0, 10_000), st.integers(6, 40))
def test_a_drift_has_its_size(seed, count):
    dates, noise, deviations = series(count, seed)
    found = find_changes(dates, noise + 0.03 * (dates - dates[0]) / (dates[-1] - dates[0]), deviations)
    drifts = [one for one in found if one.kind == DRIFT]
    assert len(drifts) == 1 and abs(sum(one.size for one in found) - 0.03) < 0.006


def test_two_steps_that_cancel():
    dates, noise, deviations = series(20, 3)
    at = np.arange(20)
    found = find_changes(dates, noise + 0.02 * ((at >= 8) & (at < 13)), deviations)
    assert [(one.kind, int(np.searchsorted(dates, one.date_ns))) for one in found] == [(STEP, 8), (STEP, 13)]
    assert [one.before_ns for one in found] == [int(dates[7]), int(dates[12])]


def test_few_values():
    assert find_changes(*(part[:2] for part in series(5, 0))) == []
