"""The floor of a record: what repeats, rests and neighbours tell of its noise."""

import numpy as np
import pytest
from identification.records import stage

from slpi_ros.errors import RecordError
from slpi_ros.excitation.drives import DRIVES, calibration_drive, excite
from slpi_ros.identification.repeatability import repeatability_of, robust_rms

NOISE = 8e-9


def sine(seed, seconds=20.0, frequency=1.03):
    t = np.arange(0.0, seconds, 0.005)
    v = 50.0 - 50.0 * np.cos(2 * np.pi * frequency * t)
    return t, v, stage(seed).run(t, v)[1]


@pytest.mark.parametrize("seed", range(4))
def test_white_noise_is_seen_in_repeats_holds_and_neighbours(seed):
    records = {"repeats": sine(seed)}
    for name, duration in (("holds", 60.0), ("high frequencies", 20.0)):
        t, v = calibration_drive(0.0, 100.0, duration=duration, rate=200.0, seed=seed)
        records[name] = t, v, stage(seed).run(t, v)[1]
    for name, record in records.items():
        floor = repeatability_of(*record)
        assert floor.source.startswith(name)
        assert floor.rms == pytest.approx(NOISE, rel=0.1), name


@pytest.mark.parametrize("drive", DRIVES[1:])
def test_every_drive_shows_the_floor(drive):
    made = excite(("x", "y"), voltage_min=0.0, voltage_max=100.0, duration=40.0, rate=500.0, drive=drive)
    v = made.voltage["x"]
    assert repeatability_of(made.t, v, stage(1).run(made.t, v)[1]).rms == pytest.approx(NOISE, rel=0.1)


def test_outliers_and_lost_readings_do_not_count():
    t, v, y = sine(1)
    rng = np.random.default_rng(0)
    spoiled = y.copy()
    hit = rng.random(y.size) < 0.05
    spoiled[hit] += rng.normal(0.0, 10 * NOISE, np.count_nonzero(hit))
    spoiled[rng.random(y.size) < 0.02] = np.nan
    assert repeatability_of(t, v, spoiled).rms == pytest.approx(NOISE, rel=0.1)


def test_noise_of_the_voltage_and_an_uneven_clock_do_not_count():
    t, v, y = sine(1)
    rng = np.random.default_rng(0)
    assert repeatability_of(t, v + rng.normal(0.0, 0.05, v.size), y).rms == pytest.approx(NOISE, rel=0.1)
    uneven = t + rng.uniform(-0.001, 0.001, t.size)
    v = 50.0 - 50.0 * np.cos(2 * np.pi * 1.03 * uneven)
    assert repeatability_of(uneven, v, stage(1).run(uneven, v)[1]).rms == pytest.approx(NOISE, rel=0.1)


def test_what_lasts_from_sample_to_sample_is_seen_in_repeats_only():
    t, v, y = sine(1)
    # Random, but the same for 10 samples: neighbours hardly differ.
    slow = np.repeat(np.random.default_rng(2).normal(0.0, 50e-9, t.size // 10), 10)
    assert repeatability_of(t, v, y + slow).rms == pytest.approx(np.hypot(50e-9, NOISE), rel=0.15)


def test_drift_does_not_count():
    t, v, y = sine(1)
    assert repeatability_of(t, v, y + 2e-8 * t).rms == pytest.approx(NOISE, rel=0.1)


def test_of_a_residual_only_what_is_left_counts():
    t, v, y = sine(1)
    hum = 3e-8 * np.sin(2 * np.pi * 17.3 * t)
    assert repeatability_of(t, v, y + hum).rms > 2 * NOISE
    noise = np.random.default_rng(3).normal(0.0, NOISE, t.size)
    assert repeatability_of(t, v, y + hum, noise).rms == pytest.approx(NOISE, rel=0.1)


def test_other_histories_are_no_repeats():
    # The same ramp, once after a rise to the top, once after one to the middle: the stage does not come back alike.
    corners = np.array([0.0, 100.0, 20.0, 60.0, 20.0, 90.0, 20.0, 80.0, 10.0, 70.0])
    v = np.interp(np.arange(0, 9, 0.01), np.arange(10), corners)
    t = 0.01 * np.arange(v.size)
    assert not repeatability_of(t, v, stage(1).run(t, v)[1]).source.startswith("repeats")


def test_coarse_digits_are_a_floor():
    t, v = calibration_drive(0.0, 100.0, duration=20.0, rate=200.0, seed=1)
    y = np.round(stage(1, noise=0.0).run(t, v)[1] / 2e-7) * 2e-7
    floor = repeatability_of(t, v, y)
    assert floor.rms == pytest.approx(2e-7 / np.sqrt(12), rel=0.3)


def test_robust_rms_of_a_gaussian_is_its_rms():
    x = np.random.default_rng(0).normal(0.0, 3.0, 100_000)
    assert robust_rms(x) == pytest.approx(3.0, rel=0.01)
    x[::50] = 1e6
    assert robust_rms(x) == pytest.approx(3.0, rel=0.02)
    assert robust_rms(np.array([0.0, 0.0, 0.0, 1.0])) == 0.5


@pytest.mark.parametrize("v", [np.zeros(300), np.linspace(0.0, 1.0, 300)])
def test_a_voltage_that_rests_or_never_turns(v):
    y = np.random.default_rng(0).normal(0.0, NOISE, v.size)
    assert repeatability_of(0.01 * np.arange(v.size), v, y).rms == pytest.approx(NOISE, rel=0.15)


def test_too_few_samples_are_told():
    with pytest.raises(RecordError, match="4 samples have no repeatability"):
        repeatability_of(np.arange(6.0), np.arange(6.0), np.array([1.0, 2.0, 3.0, np.nan, 5.0, np.inf]))


def test_no_floor_lies_below_the_digits_and_none_is_none():
    t = np.arange(0.0, 20.0, 0.005)
    # Each move is made several times, on the same readings.
    v = 50.0 - 50.0 * np.cos(2 * np.pi * t) * np.where(t % 5.0 < 4.0, 1.0, 0.7)
    exact = stage(1, noise=0.0).run(t, v)[1]
    floor = repeatability_of(t, v, np.round(exact, 8))
    assert floor.rms == pytest.approx(1e-8 / np.sqrt(12.0), rel=0.1) and floor.source.startswith("digits: 10 nm")
    assert repeatability_of(t, v, 2e-7 * v).rms == 0.0
