import numpy as np
import pytest

from slpi_ros.errors import UsageError
from slpi_ros.stage.drive import calibration_drive, scan_path

CASES = [(30.0, 100.0, None), (60.0, 200.0, 1), (80.0, 100.0, 7), (10.0, 200.0, None)]


def visited_cells(v, cells=10):
    """Share of the (alpha, beta) triangle's cells in which a branch from a turning point has been."""
    share = (v - v.min()) / (v.max() - v.min())
    turning = np.flatnonzero(np.diff(np.sign(np.diff(share)))) + 1
    seen = np.zeros((cells, cells), dtype=bool)
    origin = share[0]
    for begin, end in zip([0, *turning], [*turning, len(v) - 1], strict=True):
        branch = share[begin : end + 1]
        alpha, beta = np.maximum(branch, origin), np.minimum(branch, origin)
        index = np.minimum((np.array([alpha, beta]) * cells).astype(int), cells - 1)
        seen[tuple(index)] = True
        origin = share[end]
    triangle = np.tril_indices(cells)
    return seen[triangle].mean()


@pytest.mark.parametrize(("duration", "rate", "seed"), CASES)
def test_the_drive_stays_within_limits_and_comes_home(duration, rate, seed):
    t, v = calibration_drive(-5.0, 95.0, duration=duration, rate=rate, seed=seed)
    assert t.shape == v.shape == (round(duration * rate) + 1,)
    assert t[0] == 0 and t[-1] == pytest.approx(duration)
    assert v[0] == v[-1] == v.min() == -5.0
    assert v.max() == 95.0


@pytest.mark.parametrize(("duration", "rate", "seed"), CASES[:3])
def test_the_slew_rate_is_bounded(duration, rate, seed):
    t, v = calibration_drive(0.0, 100.0, duration=duration, rate=rate, seed=seed)
    assert np.max(np.abs(np.diff(v) / np.diff(t))) < 130.0


def test_the_drive_begins_with_a_major_loop():
    t, v = calibration_drive(0.0, 100.0, duration=60.0, rate=200.0, seed=1)
    first_top = int(np.argmax(v == 100.0))
    assert np.all(np.diff(v[: first_top + 1]) >= 0)
    assert np.any(v[first_top : first_top + 600] == 0.0)


@pytest.mark.parametrize("seed", [None, 0, 1, 2, 3])
def test_the_drive_covers_the_preisach_plane(seed):
    assert visited_cells(calibration_drive(0.0, 100.0, duration=60.0, rate=200.0, seed=seed)[1]) >= 0.9
    assert visited_cells(calibration_drive(0.0, 100.0, duration=30.0, rate=100.0, seed=seed)[1]) >= 0.9


def test_a_major_loop_alone_does_not_cover_the_plane():
    assert visited_cells(50 - 50 * np.cos(np.linspace(0, 8 * np.pi, 4001))) < 0.5


def test_drives_are_reproducible():
    one, same, other = (calibration_drive(0, 100, duration=30, rate=100, seed=seed)[1] for seed in (1, 1, 2))
    np.testing.assert_array_equal(one, same)
    assert np.max(np.abs(one - other)) > 1.0


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


def test_waveforms_that_cannot_be_made():
    with pytest.raises(UsageError, match="lower one"):
        calibration_drive(100.0, 0.0, duration=30.0, rate=100.0)
    with pytest.raises(UsageError, match="lower one"):
        scan_path(0.0, float("nan"))
    with pytest.raises(UsageError, match="more than 0"):
        calibration_drive(0.0, 100.0, duration=0.0, rate=100.0)
    with pytest.raises(UsageError, match="too few"):
        calibration_drive(0.0, 100.0, duration=30.0, rate=2.0)
    with pytest.raises(UsageError, match="too short"):
        scan_path(0.0, 1.0, duration=2.0)
