"""Digits and noise of readings, whatever they are readings of."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from identification.records import calibration

from slpi_ros.identification import bad_readings as readings
from slpi_ros.identification import signal_statistics
from slpi_ros.identification.bad_readings import mixed_readings
from slpi_ros.identification.record_quality import assess
from slpi_ros.io.tables import import_table


@given(st.floats(1e-12, 1e3), st.floats(-5, 5), st.integers(3, 12), st.integers(0, 2**32 - 1))
def test_digits_are_found(step, offset, bits, seed):
    rng = np.random.default_rng(seed)
    x = step * (offset + rng.integers(0, 2**bits, 3000))
    assert signal_statistics.digit(x) == pytest.approx(step, rel=1e-6)
    assert signal_statistics.digit(x + 1e-4 * step * rng.integers(-1, 2, x.size)) == pytest.approx(step, rel=1e-3)


@given(st.sampled_from(["normal", "uniform", "exponential"]), st.integers(50, 5000), st.integers(0, 2**32 - 1))
def test_continuous_readings_have_no_digits(kind, count, seed):
    assert signal_statistics.digit(getattr(np.random.default_rng(seed), kind)(size=count)) == 0.0


@given(st.sampled_from(["line", "sine", "steps", "rest"]), st.floats(1e-9, 1e3), st.integers(0, 2**32 - 1))
def test_noise_of_any_signal(kind, rms, seed):
    t = np.linspace(0.0, 10.0, 4000)
    signal = {"line": t, "sine": np.sin(5 * t), "steps": np.floor(t), "rest": 0 * t}[kind]
    x = 1e3 * rms * signal + rms * np.random.default_rng(seed).standard_normal(t.size)
    assert signal_statistics.noise(x, t) == pytest.approx(rms, rel=0.1)
    # Outliers do not count.
    x[::25] += 1e4 * rms
    assert signal_statistics.noise(x, t) == pytest.approx(rms, rel=0.3)


def test_noise_at_an_uneven_rate():
    rng = np.random.default_rng(0)
    t = np.cumsum(rng.exponential(size=4000))
    x = t + 0.01 * rng.standard_normal(t.size)
    assert signal_statistics.noise(x) > 0.1
    assert signal_statistics.noise(x, t) == pytest.approx(0.01, rel=0.1)


@given(st.lists(st.integers(0, 2), min_size=1, max_size=40), st.integers(0, 2**32 - 1))
def test_repeats(values, seed):
    x = np.array(values, float)
    other = np.random.default_rng(seed).normal(size=x.size)
    repeats = readings.Repeats.within(x)
    expected, start = [], 0
    for stop in range(1, x.size + 1):
        if stop == x.size or x[stop] != x[start]:
            if stop - start > 1:
                expected.append((start, stop - start, np.ptp(other[start:stop])))
            start = stop
    assert repeats.first.tolist() == [first for first, _, _ in expected]
    assert repeats.length.tolist() == [length for _, length, _ in expected]
    np.testing.assert_array_equal(repeats.spans(other), [span for _, _, span in expected])
    assert repeats.readings == sum(length - 1 for _, length, _ in expected)


@pytest.mark.parametrize("side", [-1, 1])
def test_readings_mixed_with_the_one_beside_them_are_found(side):
    random = np.random.default_rng(5)
    v = 50.0 + 50.0 * np.abs(np.arange(6000) % 100 / 50.0 - 1.0)
    y = 0.2e-6 * v + 10e-9 * random.standard_normal(v.size)
    bad = np.flatnonzero(random.random(v.size) < 0.1)
    share = random.uniform(0.0, 1.0, bad.size)
    beside = np.clip(bad + side, 0, v.size - 1)
    mixed = y.copy()
    mixed[bad] += share * (y[beside] - y[bad])
    found = mixed_readings(mixed, v).readings
    # Near turns, and where hardly anything is mixed in, they are not to be told.
    assert 0.6 * bad.size < found.size < 1.1 * bad.size
    assert np.isin(found, bad).mean() > 0.97


def test_clean_and_noisy_readings_are_not_mixed():
    for seed in range(4):
        record, _ = calibration(seed=seed)
        for every in (1, 4, 8):
            v, y = record.voltage["x"][::every], record.displacement["x"][::every]
            assert not mixed_readings(y, v).side
            outliers = y + 1e-7 * (np.random.default_rng(seed).random(y.size) < 0.05)
            assert not mixed_readings(outliers, v).side


def test_share_of_mixed_readings_of_a_measured_record(measured_data):
    record = import_table(measured_data / "afm_cycles.csv")
    quality = assess(record, "x").displacement
    assert quality.mixed / len(record) == pytest.approx(0.11, abs=0.02)
    assert quality.mixed_size == pytest.approx(0.39e-6, rel=0.1)
