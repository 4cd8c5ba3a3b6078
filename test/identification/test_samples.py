"""Thinning a long record: fewer samples, the same memory."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from identification.records import calibration, rms

import slpi_ros
from slpi_ros.hysteresis.loops import separate
from slpi_ros.identification import linear
from slpi_ros.identification.samples import Samples

paths = st.lists(st.integers(0, 8), min_size=1, max_size=80).map(lambda values: np.array(values, dtype=np.float64))


@given(paths, st.integers(1, 40))
def test_thinned_samples_turn_where_all_do(v, most):
    samples = Samples(v, np.arange(v.size, dtype=np.float64), np.ones(v.size, dtype=bool))
    thin = samples.thinned(most)
    whole, part = separate(v), separate(thin.v)
    assert [(v[loop.vertex], loop.level, loop.closed) for loop in whole.loops] == [
        (thin.v[loop.vertex], loop.level, loop.closed) for loop in part.loops
    ]
    # The displacements are still those of their voltages.
    assert np.array_equal(v[thin.y.astype(int)], thin.v)


def test_thinned_is_as_long_as_asked():
    v = np.repeat(np.linspace(0.0, 100.0, 10_000), 1)
    samples = Samples(v, v, np.ones(v.size, dtype=bool))
    assert 900 <= samples.thinned(1000).v.size <= 1010
    assert samples.thinned(10_000) is samples


@pytest.mark.parametrize("kind", ["slpi", "pi"])
def test_a_thinned_fit_is_nearly_as_good(monkeypatch, kind):
    record, _ = calibration(seed=1)[:2]
    whole = slpi_ros.identify(record, kind).axes["x"]
    monkeypatch.setattr(linear, "SELECTION_SAMPLES", 600)
    monkeypatch.setattr(linear, "FIT_SAMPLES", 1500)
    part = slpi_ros.identify(record, kind).axes["x"]
    assert part.quality.samples < 0.6 * whole.quality.samples
    v, y = record.voltage["x"], record.displacement["x"]
    assert rms(part.simulate(record.t, v) - y) < 1.1 * rms(whole.simulate(record.t, v) - y)
