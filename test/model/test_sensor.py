"""What is known of the sensor is taken out of its readings, and put into what it will say."""

from dataclasses import replace

import numpy as np
import pytest
from effects.cases import numbers, sensors
from hypothesis import given
from hypothesis import strategies as st
from model.test_model_effects import SPAN, T, X, path
from scipy.signal import lsim

from slpi_ros.effects.hum import Hum, Line
from slpi_ros.effects.sensor_periodic import SensorPeriodic
from slpi_ros.effects.thermal_drift import ThermalDrift
from slpi_ros.errors import SlpiError
from slpi_ros.io.record import Record
from slpi_ros.model.document import format_model, parse_model
from slpi_ros.model.sensor import IDEAL, LONGEST, Sensed, Sensor, StreamingSensor
from slpi_ros.model.stage_model import StageModel

PERIODIC = SensorPeriodic(3e-7, 5e-9, 1.0)
DT = 1e-3


def smooth(seed):
    """Return a path of up to 3 Hz, resting at both ends."""
    fade = np.clip(np.minimum(T, T[-1] - T) / 0.5, 0, 1)
    return 6e-6 + 4e-6 * fade**3 * (10 - 15 * fade + 6 * fade**2) * np.sin(
        2 * np.pi * np.random.default_rng(seed).uniform(0.5, 3) * T
    )


@given(sensors(), st.lists(st.floats(-1e-4, 1e-4), min_size=1, max_size=50))
def test_the_displacement_is_found_from_the_reading_of_any_periodic_sensor(effect, places):
    places = np.array(places)
    axis = replace(X, effects=(ThermalDrift((0.0, 1.0), (0.0, 1e-7)), effect, Hum((Line(50.0, 1e-8, 0.0),))))
    t = np.arange(float(places.size))
    accuracy = 1e-9 * effect.period + 1e-18
    np.testing.assert_allclose(axis.correct(t, axis.measure(t, places)), places, rtol=0, atol=accuracy)
    np.testing.assert_allclose(axis.measure(t, axis.correct(t, places)), places, rtol=0, atol=accuracy)
    streaming = axis.streaming_sensor()
    for x in places.tolist():
        assert streaming.correct(streaming.measure(x)) == pytest.approx(x, abs=accuracy)
        assert streaming.measure(x) == pytest.approx(axis.measure(np.zeros(1), np.array([x]))[0], abs=accuracy)


@given(
    numbers(0, 0.1),
    st.just(0.0) | numbers(1e-4, 0.05),
    st.integers(0, 1000),
    st.integers(0, 10**6),
    st.sampled_from((0, 0.3)),
)
def test_delay_and_lag_are_taken_out_of_a_smooth_motion(delay, lag, seed, noise, jitter):
    """To a thousandth of the motion, at uneven stamps too; what the sensor has not told yet is not known."""
    rng = np.random.default_rng(noise)
    t = np.sort(T + jitter * rng.uniform(-0.5, 0.5, T.size) * DT)
    axis = replace(X, sensor=Sensor(delay, lag))
    x = np.interp(t, T, smooth(seed))
    back = axis.correct(t, axis.measure(t, x))
    known = np.isfinite(back)
    np.testing.assert_allclose(back[known], x[known], rtol=0, atol=1e-3 * SPAN)
    assert known[t <= t[-1] - delay - DT].mean() > 0.99
    assert not known[t > t[-1] - delay + 2 * DT].any()


def test_the_order_is_periodic_error_lag_delay():
    axis = replace(X, effects=(PERIODIC,), sensor=Sensor(0.02, 0.01))
    x = smooth(3)
    early = x + 5e-9 * np.sin(2 * np.pi * x / 3e-7 + 1.0)
    _, lagged, _ = lsim(([1.0], [0.01, 1.0]), early - early[0], T)
    expected = np.interp(T - 0.02, T, lagged + early[0])
    np.testing.assert_allclose(axis.measure(T, x), expected, rtol=0, atol=1e-12)
    v = X.compensate(T, path())[0]
    np.testing.assert_array_equal(axis.simulate(T, v), axis.measure(T, X.simulate(T, v)))


def test_without_anything_known_readings_stay_as_they_are():
    y = np.array([1e-6, np.nan, 3e-6])
    assert X.correct(np.arange(3.0), y) is y
    record = Record(np.arange(3), {"x": y}, {"x": y})
    assert StageModel({"x": X}).correct(record) is record


def test_noise_stays_what_it_is():
    """A delay of a share of an interval does not smooth the readings, by which noise and outliers are told."""
    noise = np.random.default_rng(0).normal(0.0, 8e-9, T.size)
    for delay in (0.0023, 0.0025, 0.002):
        left = Sensor(delay).undo(T, noise)
        assert 0.97 * 8e-9 < np.nanstd(left) < 1.15 * 8e-9


def test_one_bad_reading_spoils_no_other_and_a_missing_one_stays_missing():
    x = smooth(1)
    y = Sensor(0.0, 0.01).apply(T, x)
    y[2000], y[3000] = y[2000] + 1e-6, np.nan
    back = Sensor(0.0, 0.01).undo(T, y)
    assert back[2000] - x[2000] == pytest.approx(1e-6, rel=0.05)
    assert np.flatnonzero(np.isnan(back)).tolist() == [3000]
    others = np.delete(np.arange(T.size), [2000, 3000])
    np.testing.assert_allclose(back[others], x[others], rtol=0, atol=1e-3 * SPAN)


def test_few_readings():
    for size in range(6):
        t = np.arange(size) * DT
        assert Sensor(0.001, 0.01).undo(t, np.full(size, 2e-6)).shape == (size,)
        assert np.isfinite(Sensor(0.0, 0.01).undo(np.zeros(size), np.full(size, 2e-6))).all()


def test_a_record_is_corrected_for_the_axes_of_the_model():
    model = StageModel({"x": replace(X, effects=(PERIODIC,), sensor=Sensor(0.002)), "y": X})
    x = smooth(0)
    y = model.axes["x"].measure(T, x)
    record = Record(np.round(T * 1e9).astype(np.int64), dict.fromkeys("xyz", T), dict.fromkeys("xyz", y))
    right = model.correct(record)
    np.testing.assert_allclose(right.displacement["x"][:-5], x[:-5], rtol=0, atol=1e-10)
    assert right.displacement["y"] is y and right.displacement["z"] is y
    back = replace(record, time_ns=record.time_ns[::-1])
    assert model.correct(back) is back


# Sample by sample


@given(
    numbers(0, 0.02),
    st.just(0.0) | numbers(1e-4, 0.05),
    st.booleans(),
    st.lists(numbers(2e-6, 1e-5), min_size=30, max_size=60),
)
def test_a_setpoint_is_told_as_the_sensor_tells_a_stage_that_is_there(delay, lag, periodic, places):
    """Against the equations in small steps: the stage stays at each place for 1 ms."""
    sensor = StreamingSensor(Sensor(delay, lag), (PERIODIC,) if periodic else ())
    told, step_ns, parts = Sensed(sensor, places[0]), 1_000_000, 20
    fine = np.repeat(places, parts)
    early = fine + 5e-9 * np.sin(2 * np.pi * fine / 3e-7 + 1.0) if periodic else fine
    lagged, z = np.empty_like(early), early[0]
    kept = np.exp(-1e-3 / parts / lag) if lag else 0.0
    for k, y in enumerate(early.tolist()):
        lagged[k] = z = y + (z - y) * kept
    for k, place in enumerate(places):
        told.hold(place, k * step_ns)
        now_ns = k * step_ns + step_ns // 2
        at = told.at(now_ns)
        sensed_ns = now_ns - int(delay * 1e9)
        assert (at is None) == (sensed_ns < 0)
        if at is not None:
            # Between two of the small steps.
            exact = sensed_ns / (step_ns / parts) - 1.0
            near = lagged[[max(int(np.floor(exact)), 0), min(int(np.floor(exact)) + 1, lagged.size - 1)]]
            low, high = sorted(sensor.correct(float(y)) for y in near)
            assert low - 1e-14 <= at <= high + 1e-14


def test_samples_that_are_sensed_are_forgotten():
    told = Sensed(StreamingSensor(Sensor(0.01, 0.01), ()), 0.0)
    for k in range(1000):
        told.hold(1e-6 * k, k * 1_000_000)
    assert len(told._samples) <= 12
    told.restart(5e-6)
    assert told.at(2_000_000_000) is None
    told.hold(5e-6, 2_000_000_000)
    assert told.at(2_005_000_000) is None
    assert told.at(2_020_000_000) == pytest.approx(5e-6, abs=1e-18)


def test_what_is_to_come_is_replaced_by_what_comes_before_it():
    told = Sensed(StreamingSensor(Sensor(0.0, 0.0), ()), 0.0)
    for k in range(5):
        told.hold(1e-6 * k, 1000 * k, 10_000)
    assert [told.at(each) for each in (9_999, 10_000, 12_500)] == [None, 0.0, 2e-6]
    told.hold(4e-6, 12_600)  # the last one anew: it is on its way
    assert told.at(13_500) == 3e-6
    told.hold(9e-6, 13_600)
    assert [told.at(each) for each in (13_600, 20_000)] == [9e-6, 9e-6]


# Documents


@given(numbers(0, LONGEST), numbers(0, LONGEST))
def test_the_document_keeps_the_sensor(delay, lag):
    model = StageModel({"x": X, "y": X}).with_sensor(delay=delay, lag=lag, axes=["x"])
    again = parse_model(format_model(model), "here")
    assert again.axes["x"].sensor == Sensor(delay, lag)
    assert again.axes["y"].sensor == IDEAL
    assert again.with_sensor(lag=0.0).axes["x"].sensor == Sensor(delay, 0.0)


def test_a_document_without_a_sensor_has_none():
    text = format_model(StageModel({"x": X}))
    assert "sensor" not in text
    assert parse_model(text, "here").axes["x"].sensor == IDEAL


@pytest.mark.parametrize("value", [-1e-9, 1.1, float("nan"), float("inf")])
def test_times_that_make_no_sense(value):
    for values in ({"delay": value}, {"lag": value}):
        with pytest.raises(SlpiError, match="^[^\n]+$"):
            Sensor(**values)
        with pytest.raises(SlpiError, match="^[^\n]+$"):
            StageModel({"x": X}).with_sensor(**values)
    text = format_model(StageModel({"x": replace(X, sensor=Sensor(0.5))}))
    with pytest.raises(SlpiError, match="^here: [^\n]+$"):
        parse_model(text.replace('"delay": 0.5', f'"delay": {value}'), "here")
