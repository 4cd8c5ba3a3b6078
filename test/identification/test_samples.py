"""Which samples of a record count, and how a long one is thinned."""

import warnings
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from identification.records import calibration, rms

import slpi_ros
from slpi_ros.errors import IdentificationError, RecordError, UsageError
from slpi_ros.hysteresis.slpi_published import separate
from slpi_ros.identification import linear_kinds as linear
from slpi_ros.identification.free_run import InitialStateWarning
from slpi_ros.identification.samples import Samples, select_samples

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


def test_a_sensor_that_hangs_says_nothing():
    record, _ = calibration(seed=1)
    y = record.displacement["x"].copy()
    # In the middle of a move, for 0.4 s.
    y[2000:2080] = y[1999]
    hanging = replace(record, displacement={"x": y})
    y = y.copy()
    y[2000:2080] = np.nan
    silent = replace(record, displacement={"x": y})
    assert np.count_nonzero(select_samples(hanging, "x", None, None).fitted) == y.size - 80
    error = slpi_ros.identify(hanging).axes["x"].quality.held_out_rms
    assert error == pytest.approx(slpi_ros.identify(silent).axes["x"].quality.held_out_rms, rel=0.02)


def test_coarse_digits_and_rests_are_no_sensor_that_hangs():
    record, true = calibration(seed=1)
    for y in (np.round(record.displacement["x"], 7), true):
        fitted = select_samples(replace(record, displacement={"x": y}), "x", None, None).fitted
        assert fitted.all()


@pytest.mark.parametrize(("start", "stop"), [(20.0, 10.0), (5.0, 5.0), (np.nan, None), (None, np.nan)])
def test_a_part_out_of_order_is_wrong_usage(start, stop):
    with pytest.raises(UsageError, match="is not before stop"):
        select_samples(calibration(seed=1)[0], "x", start, stop)


def test_a_part_beyond_the_record_is_told_its_length():
    with pytest.raises(RecordError, match="0 usable samples of 4001 between start and stop, of 20 s in all"):
        select_samples(calibration(seed=1)[0], "x", 30.0, None)


@pytest.mark.parametrize("seed", [0, *(pytest.param(k, marks=pytest.mark.long) for k in range(1, 4))])
def test_what_has_nothing_to_do_with_the_voltage_has_no_wrong_sign(seed):
    record, _ = calibration(seed=1)
    noise = 1e-6 * np.random.default_rng(seed).standard_normal(len(record))
    with pytest.raises(IdentificationError, match="does not explain the displacement"):
        slpi_ros.identify(replace(record, displacement={"x": noise}))
    with pytest.raises(RecordError, match="change the sign"):
        slpi_ros.identify(replace(record, displacement={"x": -record.displacement["x"]}))


def test_a_beginning_that_disagrees_is_told():
    record, _ = calibration(seed=1)
    first = np.arange(len(record)) < np.flatnonzero(select_samples(record, "x", None, None).after_reset)[0]
    # Another axis moves as long as this one has not gone over its range, and couples into it.
    disturbed = record.displacement["x"] + np.where(first, 4e-7 * np.sin(9.0 * record.t), 0.0)
    with pytest.warns(InitialStateWarning, match="slpi diagnose"):
        slpi_ros.identify(replace(record, displacement={"x": disturbed}))
    with warnings.catch_warnings():
        warnings.simplefilter("error", InitialStateWarning)
        slpi_ros.identify(record)
