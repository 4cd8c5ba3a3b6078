"""Errors by region, and the drift of the zero, as the uncertainty of a model needs them."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from slpi_ros.identification.error_statistics import beside, by_region, drift_of
from slpi_ros.model.uncertainty import REGIONS

T = np.arange(20_000) / 500.0


def test_each_region_has_its_error():
    y = np.concatenate([np.full(100, 0.5e-6), np.full(100, 9.5e-6), np.full(5, 5e-6)])
    error = np.concatenate([np.tile([1e-9, -1e-9], 50), np.tile([3e-9, -3e-9], 50), np.zeros(5)])
    found = by_region(y, error, (0.0, 10e-6))
    assert found[0] == pytest.approx(1e-9) and found[-1] == pytest.approx(3e-9)
    assert found[1:-1] == (None,) * (REGIONS - 2)


def test_the_drift_of_a_random_walk():
    """Within the spread of so few differences, and never much too small in the mean."""
    found = []
    for seed in range(20):
        rng = np.random.default_rng(seed)
        walk = np.cumsum(rng.standard_normal(T.size)) * 5e-9 / np.sqrt(500.0)
        found.append(drift_of([(T, walk + 8e-9 * rng.standard_normal(T.size))]))
    assert 5e-9 < np.median(found) < 12e-9
    assert min(found) > 1.5e-9


@given(st.integers(0, 10_000))
def test_noise_is_no_drift(seed):
    noise = 8e-9 * np.random.default_rng(seed).standard_normal(T.size)
    # As far as so many readings can tell.
    assert 0.0 < drift_of([(T, noise)]) < 8e-9 / np.sqrt(T.size / 16) * 2.0


def test_a_straight_drift_counts_as_far_as_it_was_seen():
    drift = drift_of([(T, 1e-9 * T)])
    assert drift * np.sqrt(T[-1]) > 1e-9 * T[-1]


def test_errors_that_belong_to_a_place_are_no_drift():
    """Small loops first, and large ones later, where the model is always wrong by the same."""
    y = 5e-6 + (1e-6 + 4e-6 * T / T[-1]) * np.sin(2.0 * np.pi * T)
    error = 20e-9 * np.sin(y / 1e-6)
    left = beside(y, error, float(y.min()), float(y.max()))
    assert drift_of([(T, left)]) <= drift_of([(T, error)])
    assert left.mean() == pytest.approx(error.mean())


def test_short_records_tell_nothing():
    assert drift_of([]) == drift_of([(np.zeros(1), np.zeros(1))]) == 0.0
