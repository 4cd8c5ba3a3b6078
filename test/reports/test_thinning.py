"""Thinned signals look like the whole."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from slpi_ros.reports.chart import thin_cloud, thin_line


@given(st.integers(0, 4000), st.integers(20, 300), st.integers(1, 3), st.floats(0.0, 0.5), st.integers(0, 2**32 - 1))
def test_lines_keep_extremes_and_ends(size, most, count, missing, seed):
    rng = np.random.default_rng(seed)
    signals = [np.where(rng.random(size) < missing, np.nan, rng.standard_normal(size)) for _ in range(count)]
    kept = thin_line(*signals, most=most)
    assert np.all(np.diff(kept) > 0) and kept.size <= max(most, 2 + 2 * count)
    assert size <= most or kept.size >= min(most, size) / (4 * count)
    if size:
        assert kept[0] == 0 and kept[-1] == size - 1
    for signal in signals:
        if np.isfinite(signal).any():
            assert np.nanmax(signal[kept]) == np.nanmax(signal)
            assert np.nanmin(signal[kept]) == np.nanmin(signal)


def test_a_spike_between_kept_samples_stays():
    for at in (1, 12_345, 99_998):
        y = np.sin(np.arange(100_000) / 500.0)
        y[at] = 7.0
        assert at in thin_line(y)


@given(st.integers(0, 3000), st.integers(20, 300), st.integers(0, 2**32 - 1))
def test_clouds_keep_extremes_of_finite_samples(size, most, seed):
    rng = np.random.default_rng(seed)
    x, y = rng.random(size), np.where(rng.random(size) < 0.2, np.nan, rng.standard_normal(size))
    kept = thin_cloud(x, y, most)
    assert np.isfinite(y[kept]).all() and np.all(np.diff(kept) > 0) and kept.size <= most
    if np.isfinite(y).any():
        assert y[kept].max() == np.nanmax(y) and y[kept].min() == np.nanmin(y)


def test_a_long_hole_stays_one():
    y = np.sin(np.arange(100_000) / 777.0)
    y[40_430:40_560] = np.nan
    y[::2001] = np.nan
    # As long as a stretch of 101 samples, but none of them is missing as a whole.
    kept = thin_line(y, most=2_000)
    holes = kept[np.isnan(y[kept])]
    assert np.any((holes >= 40_430) & (holes < 40_560))
    # One reading that is missing is less than a stretch, and interrupts nothing.
    assert np.all((holes >= 40_430) & (holes < 40_560) | (holes == 0))
