import numpy as np
import pytest

from benchmarks.paths import scan_path
from slpi_ros.errors import UsageError


@pytest.mark.parametrize("seed", range(8))
@pytest.mark.parametrize(("duration", "rate"), [(30.0, 200.0), (4.0, 100.0), (12.0, 1000.0)])
def test_a_scan_path_stays_within_its_limits(duration, rate, seed):
    t, y = scan_path(2e-6, 20e-6, duration=duration, rate=rate, seed=seed)
    assert t.shape == y.shape == (round(duration * rate) + 1,)
    assert y[0] == pytest.approx(2e-6, abs=1e-15)
    assert y.min() >= 2e-6 and y.max() <= 20e-6


@pytest.mark.parametrize("seed", range(8))
def test_a_scan_path_is_smooth_and_uses_its_range(seed):
    t, y = scan_path(0.0, 1.0, seed=seed)
    speed = np.diff(y) / np.diff(t)
    assert np.max(np.abs(speed)) < 3.0
    assert np.max(np.abs(np.diff(speed))) < 0.3
    assert np.ptp(y) > 0.9
    assert np.count_nonzero(np.diff(np.sign(speed[np.abs(speed) > 1e-9]))) > 20


def test_scan_paths_are_reproducible():
    one, same, other = (scan_path(0.0, 1.0, seed=seed)[1] for seed in (1, 1, 2))
    np.testing.assert_array_equal(one, same)
    assert np.max(np.abs(one - other)) > 0.1


@pytest.mark.parametrize(
    ("limits", "timing"),
    [
        ((1.0, 0.0), {}),
        ((0.0, float("nan")), {}),
        ((0.0, 1.0), {"duration": -30.0}),
        ((0.0, 1.0), {"rate": 0.0}),
        ((0.0, 1.0), {"duration": 2.0}),
    ],
)
def test_paths_that_cannot_be_drawn(limits, timing):
    with pytest.raises(UsageError):
        scan_path(*limits, **timing)
