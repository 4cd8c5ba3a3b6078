"""Uncertainty of the curves: as large as the spread of fits to other noise, larger where less was seen."""

from dataclasses import replace

import numpy as np
import pytest
from identification.records import calibration, rms, stage

from slpi_ros.errors import UsageError
from slpi_ros.identification.uncertainty import curve_uncertainty

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def recorded():
    return calibration(seed=1, duration=30.0)[0]


@pytest.fixture(scope="module")
def found(recorded):
    return curve_uncertainty(recorded, "x")


def test_it_is_as_large_as_the_error(recorded, found):
    true = stage(1, noise=0.0)
    true.run(recorded.t, recorded.voltage["x"])
    path = np.concatenate([found.v, found.v[::-1], found.v])
    y = true.run(recorded.t[-1] + 1.0 + np.arange(path.size), path)[0]
    n = found.v.size
    rising, falling = y[2 * n :] - y[2 * n], y[n : 2 * n][::-1] - y[2 * n]
    for curve, std, truth in ((found.rising, found.rising_std, rising), (found.falling, found.falling_std, falling)):
        assert 0.3 < rms(curve - truth) / rms(std) < 3.0


@pytest.mark.long
def test_it_is_as_large_as_the_spread_of_fits_to_other_noise(recorded, found):
    v = recorded.voltage["x"]
    true = stage(1, noise=0.0).run(recorded.t, v)[0]
    curves = []
    for seed in range(6):
        y = true + np.random.default_rng(seed).normal(0.0, 8e-9, v.size)
        curves.append(curve_uncertainty(replace(recorded, displacement={"x": y}), "x", resamples=2).rising)
    assert 0.4 < rms(found.rising_std) / rms(np.std(curves, axis=0, ddof=1)) < 2.5


def test_noise_and_its_place_show(recorded, found):
    v, y = recorded.voltage["x"], recorded.displacement["x"].copy()
    high = v > 70.0
    y[high] += np.random.default_rng(0).normal(0.0, 60e-9, np.count_nonzero(high))
    worse = curve_uncertainty(replace(recorded, displacement={"x": y}), "x")
    assert worse.rms > 1.5 * found.rms
    ratio = worse.rising_std[1:] / found.rising_std[1:]
    assert ratio[worse.v[1:] > 75.0].mean() > 1.5 * ratio[worse.v[1:] < 40.0].mean()


def test_it_says_so_and_is_deterministic(recorded, found):
    again = curve_uncertainty(recorded, "x")
    np.testing.assert_array_equal(again.rising_std, found.rising_std)
    assert f"{found.rms * 1e9:.2g} nm rms" in found.line()
    assert found.rising[0] == 0.0 and found.rising[-1] == pytest.approx(found.falling[-1])


def test_several_records_and_the_classical_model(recorded, found):
    longer = curve_uncertainty([recorded, calibration(seed=1, duration=25.0)[0]], "x")
    assert longer.rms < 1.1 * found.rms
    # It is wrong by far more than the noise, and so are its curves.
    assert curve_uncertainty(recorded, "x", "pi").rms > 10 * found.rms


def test_other_kinds_are_refused(recorded):
    with pytest.raises(UsageError, match="uncertainty of kind 'smpi'"):
        curve_uncertainty(recorded, "x", "smpi")
