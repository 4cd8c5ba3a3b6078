"""Resampling between uneven stamps and a uniform grid."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from slpi_ros.effects.filters import Between, Uniform


@given(seed=st.integers(0, 2**32 - 1), samples=st.integers(1, 40), wanted=st.integers(1, 40))
def test_interpolation_that_is_prepared_is_that_of_numpy(seed, samples, wanted):
    rng = np.random.default_rng(seed)
    # Some stamps are equal; some times are those of samples, or outside of them.
    known = rng.uniform(-5.0, 5.0, samples)
    known = np.sort(np.where(rng.uniform(size=samples) < 0.2, np.roll(known, 1), known))
    at = np.where(rng.uniform(size=wanted) < 0.3, rng.choice(known, wanted), rng.uniform(-6.0, 6.0, wanted))
    signal = rng.normal(size=samples)
    np.testing.assert_array_equal(Between(known, at).of(signal), np.interp(at, known, signal))


def test_an_uneven_record_is_resampled_and_back():
    t = np.cumsum(np.random.default_rng(0).uniform(0.5, 1.5, 200))
    grid = Uniform.over(t)
    signal = np.sin(0.05 * t)
    np.testing.assert_array_equal(grid.on(signal), np.interp(grid.grid, t, signal))
    np.testing.assert_allclose(grid.off(grid.on(signal)), signal, atol=2e-3)
