"""A sensor slower than its record: recognised from the data, at its rate, and only its fresh readings are used."""

from dataclasses import replace

import numpy as np
import pytest
from refusals import holds

import slpi_ros
from slpi_ros.effects.creep import Creep
from slpi_ros.hysteresis.prandtl_ishlinskii import PrandtlIshlinskii
from slpi_ros.hysteresis.turning_points import Memory
from slpi_ros.identification.held_readings import held_readings, without_held
from slpi_ros.identification.refit import refit
from slpi_ros.io.record import Record
from slpi_ros.model.sensor import Sensor
from slpi_ros.workflows.records import Source, assess_record

RADII = np.linspace(0.0, 40.0, 12)
STAGE = PrandtlIshlinskii(RADII, np.concatenate([[1e-7], 6e-8 * np.exp(-RADII[1:] / 15.0)]))


def drive(rng, rate, seconds, speed=120.0):
    """Return times (s) and voltages (V): over the whole range, then turns anywhere."""
    t = np.arange(int(rate * seconds)) / rate
    turns = np.concatenate([[0.0, 100.0, 0.0], rng.uniform(0.0, 100.0, 400)])
    return t, np.interp(t, np.concatenate([[0.0], np.cumsum(np.abs(np.diff(turns)) / speed)]), turns)


def readings(rng, v, noise, digits):
    y = (
        Memory(STAGE, 0.0).forward_array(v) + rng.normal(0.0, noise, v.size)
        if noise
        else Memory(STAGE, 0.0).forward_array(v)
    )
    return np.round(y / digits) * digits if digits else y


def held(rng, y, rows, jitter):
    """Return readings that are repeated for some rows, on average, and which of them are new."""
    least, most = (max(1, rows - rows // 2), rows + rows // 2) if jitter else (rows, rows)
    starts = np.cumsum(np.concatenate([[0], rng.integers(least, most + 1, y.size)]))
    starts = starts[starts < y.size]
    new = np.zeros(y.size, dtype=bool)
    new[starts] = True
    return y[starts[np.searchsorted(starts, np.arange(y.size), side="right") - 1]], new


def record(t, v, y):
    return Record(np.rint(t * 1e9).astype(np.int64), {"x": v}, {"x": y}, "a record")


@pytest.mark.parametrize("jitter", [False, True])
@pytest.mark.parametrize("digits", [0.0, 1e-9, 1e-8])
@pytest.mark.parametrize(("rate", "seconds"), [(1000, 15.0), pytest.param(10_000, 3.0, marks=pytest.mark.long)])
def test_held_readings_are_found_with_their_rate(rate, seconds, digits, jitter):
    rng = np.random.default_rng(3)
    t, v = drive(rng, rate, seconds)
    y = readings(rng, v, 8e-9, digits)
    # Within two rows a slow stage moves by less than a digit: then only readings that last as long each are told.
    for rows in (3, 5, 10, 20) if jitter and rate * digits >= 1e-4 else (2, 3, 5, 10, 20):
        shown, new = held(rng, y, rows, jitter)
        found = held_readings(shown, v)
        assert found.rows == pytest.approx(t.size / np.count_nonzero(new), rel=0.15), rows
        # What is used is what the sensor said then, within what digits hide.
        assert not np.any(found.fresh & ~new & (np.diff(shown, prepend=np.nan) != 0.0))
        assert np.count_nonzero(found.fresh) == pytest.approx(np.count_nonzero(new), rel=0.35)


@pytest.mark.parametrize(("noise", "digits"), [(8e-9, 1e-9), (1e-9, 1e-8)])
@pytest.mark.parametrize("rates", [(5, 50), (50, 1, 5), (5, 20, 100, 10, 5)])
def test_a_sensor_that_changes_its_rate_is_judged_at_each_of_them(rates, noise, digits):
    rng = np.random.default_rng(7)
    t, v = drive(rng, 5000, 24.0)
    y = readings(rng, v, noise, digits)
    parts = [held(rng, *each, jitter=False) for each in zip(np.array_split(y, len(rates)), rates, strict=True)]
    y, new = (np.concatenate(each) for each in zip(*parts, strict=True))
    found = held_readings(y, v)
    assert np.count_nonzero(found.fresh & ~new) < 0.01 * np.count_nonzero(new)
    # Of a sensor as fast as its rows digits may hide readings that are equal.
    if 1 not in rates:
        assert np.count_nonzero(found.fresh) == pytest.approx(np.count_nonzero(new), rel=0.02)
        assert found.rows == pytest.approx(t.size / np.count_nonzero(new), rel=0.02)


def test_a_stage_that_slows_down_is_no_slower_sensor():
    rng = np.random.default_rng(8)
    v = np.concatenate([drive(rng, 5000, 12.0, speed)[1] for speed in (120.0, 10.0)])
    y, _ = held(rng, readings(rng, v, 1e-9, 1e-8), 5, jitter=False)
    assert held_readings(y, v).rows == pytest.approx(5.0, rel=0.01)


@pytest.mark.parametrize("rows", [2, 5, 10, 50])
def test_held_readings_of_a_long_record_are_found(rows):
    rng = np.random.default_rng(9)
    # All that are compared have one age if they are every k-th row.
    t, v = drive(rng, 5000, 42.0)
    y, _ = held(rng, readings(rng, v, 8e-9, 1e-9), rows, jitter=False)
    assert held_readings(y, v).rows == pytest.approx(rows, rel=0.01)


@pytest.mark.parametrize("noise", [0.0, 1e-10, 1e-9, 8e-9, 3e-8])
@pytest.mark.parametrize("digits", [0.0, 1e-9, 1e-8, 1e-7])
def test_fresh_readings_are_never_left_out(noise, digits):
    rng = np.random.default_rng(4)
    for rate, speed in ((200, 120.0), (1000, 20.0), (10_000, 5.0)):
        t, v = drive(rng, rate, 20_000 / rate, speed)
        y = readings(rng, v, noise, digits)
        assert held_readings(y, v).fresh.all()
        # A measured voltage, a stage at rest, and one that follows steps.
        assert held_readings(y, v + rng.normal(0.0, 0.02, v.size)).fresh.all()
        steps = v[:: rate // 10].repeat(rate // 10)[: v.size]
        stepped = readings(rng, steps, noise, digits)
        assert held_readings(stepped, steps).fresh.all()
        assert held_readings(stepped, steps + rng.normal(0.0, 0.02, v.size)).fresh.all()


@pytest.mark.parametrize(
    ("rows", "digits", "jitter"),
    [(2, 1e-9, False), pytest.param(10, 0.0, True, marks=pytest.mark.long), (20, 1e-8, False)],
)
def test_a_model_is_as_good_as_that_of_the_fresh_readings(rows, digits, jitter):
    rng = np.random.default_rng(5)
    t, v = drive(rng, 1000, 12.0)
    y, new = held(rng, readings(rng, v, 8e-9, digits), rows, jitter)
    t2, v2 = drive(rng, 1000, 5.0)
    clean, noise = readings(rng, v2, 0.0, 0.0), rng.normal(0.0, 8e-9, v2.size)
    errors = []
    for shown in (y, np.where(new, y, np.nan)):
        model = slpi_ros.identify(record(t, v, shown))
        told = slpi_ros.verify([record(t2, v2, clean + noise)], model)
        (judged,) = told.axes["x"].records
        errors.append(judged.error.rms)
    assert errors[0] < 1.1 * errors[1]
    # And it is judged by fresh readings only, all of them.
    ((one,), (other,)) = (
        slpi_ros.verify([record(t, v, shown)], model).axes["x"].records for shown in (y, np.where(new, y, np.nan))
    )
    assert one.error.rms == pytest.approx(other.error.rms, rel=0.05) and 0.9 <= one.share <= 1.0


def test_it_is_told_and_judged_at_the_rate_of_the_sensor():
    rng = np.random.default_rng(6)
    t, v = drive(rng, 1000, 15.0)
    y, _ = held(rng, readings(rng, v, 8e-9, 0.0), 4, jitter=False)
    quality = slpi_ros.assess(record(t, v, y), "x")
    assert quality.displacement.held == pytest.approx(4.0, rel=0.01)
    assert quality.displacement.noise == pytest.approx(8e-9, rel=0.2)
    assert not quality.displacement.stuck and not quality.displacement.mixed
    assert any(one.level == "warn" and holds(one.text, 4, 250) for one in slpi_ros.findings(quality))
    fresh, rows = without_held(record(t, v, y), "x")
    assert rows == pytest.approx(4.0, rel=0.01) and np.isnan(fresh.displacement["x"]).mean() == pytest.approx(
        0.75, abs=0.01
    )


@pytest.mark.long
@pytest.mark.parametrize("jitter", [False, True])
@pytest.mark.parametrize("digits", [1e-9, 1e-8])
@pytest.mark.parametrize(("rate", "seconds", "speed"), [(1000, 10.0, 120.0), (10_000, 2.0, 300.0)])
def test_the_error_on_a_clean_record_is_that_of_the_fresh_readings(rate, seconds, speed, digits, jitter):
    rng = np.random.default_rng(11)
    t, v = drive(rng, rate, seconds, speed)
    other_t, other_v = drive(np.random.default_rng(12), 1000, 10.0)
    clean = Memory(STAGE, 0.0).forward_array(other_v)

    def error(y):
        model = slpi_ros.identify(record(t, v, y), kind="pi")
        return np.std(np.ravel(model.simulate(other_t, other_v)) - clean)

    y = readings(rng, v, 8e-9, digits)
    for rows in (1, 2, 3, 5, 10, 20):
        shown, new = held(rng, y, rows, jitter) if rows > 1 else (y, np.ones(y.size, dtype=bool))
        assert error(shown) <= 1.1 * error(np.where(new, shown, np.nan)), rows


@pytest.mark.parametrize("jitter", [0.0, 2e-5])
@pytest.mark.parametrize("sensor", [Sensor(0.002), Sensor(0.0, 5e-4), Sensor(0.0023, 0.005)])
def test_held_readings_of_a_sensor_whose_timing_is_known(sensor, jitter):
    """Without delay and lag readings that were equal are not: they are recognised before, and told after."""
    rng = np.random.default_rng(10)
    t, v = drive(rng, 1000, 12.0)
    t = t + rng.uniform(0.0, jitter, t.size)
    y, new = held(rng, sensor.apply(t, readings(rng, v, 0.0, 0.0)) + rng.normal(0.0, 8e-9, t.size), 5, jitter=False)
    shown, fresh = record(t, v, y), record(t, v, np.where(new, y, np.nan))
    assessed = assess_record(shown, Source(records=[shown]), {"x": sensor})
    (plain,) = (one.text for one in assess_record(shown, Source(records=[shown])).findings["x"] if "slower" in one.text)
    texts = [one.text for one in assessed.findings["x"]]
    assert plain in texts and holds(plain, 5, 200) and not any("missing" in text for text in texts)
    known = {"sensor_delay": sensor.delay, "sensor_lag": sensor.lag}
    models = [slpi_ros.identify(each, **known) for each in (shown, fresh)]
    fitted = [model.axes["x"].quality for model in models]
    assert fitted[0].samples == pytest.approx(np.count_nonzero(new), rel=0.02) == fitted[1].samples
    assert fitted[0].rms == pytest.approx(fitted[1].rms, rel=1e-6)
    # Of a record in which no reading is held the model is as good.
    t2, v2 = drive(rng, 1000, 5.0)
    clean = sensor.apply(t2, readings(rng, v2, 0.0, 0.0)) + rng.normal(0.0, 8e-9, t2.size)
    (one,) = slpi_ros.verify(record(t2, v2, clean), models[0]).axes["x"].records
    assert one.rest.rms < 4e-8
    # All fresh readings are judged, of all that there are, and none counts as missing.
    (judged,) = slpi_ros.verify(shown, models[0]).axes["x"].records
    assert judged.error.samples == pytest.approx(np.count_nonzero(new), rel=0.02) and 0.95 <= judged.share <= 1.0
    assert judged.unusable < 0.02
    _, changes = refit(models[0], shown)
    assert not changes["x"].drifted


@pytest.mark.long
def test_a_diagnosis_of_held_readings_of_a_late_sensor_is_one_of_the_fresh_ones():
    rng = np.random.default_rng(10)
    t, v = drive(rng, 1000, 12.0)
    y, new = held(rng, Sensor(0.0, 5e-4).apply(t, readings(rng, v, 0.0, 0.0)) + rng.normal(0.0, 8e-9, t.size), 5, False)
    model = slpi_ros.identify(record(t, v, y), sensor_lag=5e-4)
    diagnosed = slpi_ros.diagnose(record(t, v, y), model).extended.axes["x"]
    assert diagnosed.quality.samples == pytest.approx(np.count_nonzero(new), rel=0.02)


def test_held_readings_are_left_out_of_a_refit_of_a_model_with_effects():
    rng = np.random.default_rng(13)
    t, v = drive(rng, 1000, 12.0)
    y, new = held(rng, readings(rng, v, 8e-9, 0.0), 5, jitter=False)
    model = slpi_ros.identify(record(t, v, y))
    x = replace(model.axes["x"], effects=(Creep((2.0,), (0.01,)),))
    again, _ = refit(replace(model, axes={"x": x}), record(t, v, y))
    added = again.axes["x"].quality.samples - x.quality.samples
    assert added <= np.count_nonzero(new)


def test_slopes_of_held_readings_are_not_spoilt_by_one_of_them():
    """The neighbours of an outlier are as before, and so are missing readings."""
    t = np.arange(4000) * 1e-3
    x = 5e-6 * (1.0 - np.cos(2.0 * np.pi * t))
    sensor = Sensor(0.0, 0.005)
    y = sensor.apply(t, x)
    y[np.arange(t.size) % 5 != 0] = np.nan
    y[2000] += 1e-6
    back = sensor.undo(t, y)
    assert np.array_equal(np.isnan(back), np.isnan(y)) and back[2000] - x[2000] == pytest.approx(1e-6, rel=0.05)
    others = np.isfinite(y) & (np.arange(t.size) != 2000)
    np.testing.assert_allclose(back[others], x[others], rtol=0, atol=1e-8)
