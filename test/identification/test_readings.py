"""Digits and noise of readings, whatever they are readings of."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from slpi_ros.identification import signal_statistics as readings


@given(st.floats(1e-12, 1e3), st.floats(-5, 5), st.integers(3, 12), st.integers(0, 2**32 - 1))
def test_digits_are_found(step, offset, bits, seed):
    rng = np.random.default_rng(seed)
    x = step * (offset + rng.integers(0, 2**bits, 3000))
    assert readings.digit(x) == pytest.approx(step, rel=1e-6)
    assert readings.digit(x + 1e-4 * step * rng.integers(-1, 2, x.size)) == pytest.approx(step, rel=1e-3)


@given(st.sampled_from(["normal", "uniform", "exponential"]), st.integers(50, 5000), st.integers(0, 2**32 - 1))
def test_continuous_readings_have_no_digits(kind, count, seed):
    assert readings.digit(getattr(np.random.default_rng(seed), kind)(size=count)) == 0.0


@given(st.sampled_from(["line", "sine", "steps", "rest"]), st.floats(1e-9, 1e3), st.integers(0, 2**32 - 1))
def test_noise_of_any_signal(kind, rms, seed):
    t = np.linspace(0.0, 10.0, 4000)
    signal = {"line": t, "sine": np.sin(5 * t), "steps": np.floor(t), "rest": 0 * t}[kind]
    x = 1e3 * rms * signal + rms * np.random.default_rng(seed).standard_normal(t.size)
    assert readings.noise(x, t) == pytest.approx(rms, rel=0.1)
    # Outliers do not count.
    x[::25] += 1e4 * rms
    assert readings.noise(x, t) == pytest.approx(rms, rel=0.3)


def test_noise_at_an_uneven_rate():
    rng = np.random.default_rng(0)
    t = np.cumsum(rng.exponential(size=4000))
    x = t + 0.01 * rng.standard_normal(t.size)
    assert readings.noise(x) > 0.1
    assert readings.noise(x, t) == pytest.approx(0.01, rel=0.1)


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
