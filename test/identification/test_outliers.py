"""Lone outliers of voltage and displacement: found, counted, and without a say in ranges, reversals and errors."""

import warnings
from dataclasses import replace

import numpy as np
import pytest

import slpi_ros
from slpi_ros.diagnosis.prepare import evidence_of
from slpi_ros.excitation.drives import calibration_drive
from slpi_ros.identification.bad_readings import far_outliers, outliers_by_model
from slpi_ros.identification.free_run import InitialStateWarning
from slpi_ros.identification.record_quality import assess
from slpi_ros.identification.samples import select_samples
from slpi_ros.simulation.axis import SimulatedAxis
from slpi_ros.simulation.parameters import AxisParameters

NOISE = 5e-9
# Multiples of the noise and numbers of outliers; the others are long.
CORNERS = ((2, 600), (100, 50), (10_000, 5), (10_000, 600))


@pytest.fixture(scope="module")
def clean():
    """Return a record of a simulated stage."""
    t, v = calibration_drive(0.0, 100.0, duration=30.0, rate=200.0, seed=1)
    y = SimulatedAxis(AxisParameters.random(1), 1).run(t, v)[1]
    return slpi_ros.Record(np.round(t * 1e9).astype(np.int64), {"x": v}, {"x": y})


@pytest.fixture(scope="module")
def of_clean(clean):
    return slpi_ros.identify(clean).axes["x"]


def spoiled(record, signal, at, by):
    """Return the record with some readings of a signal off by so much."""
    x = getattr(record, signal)["x"].copy()
    x[at] += by
    return replace(record, **{signal: {"x": x}})


def error(model, clean):
    """Return the error (m, rms) along the clean record."""
    return float(np.std(model.memory("start").forward_array(clean.voltage["x"]) - clean.displacement["x"]))


def judge(record, clean, of_clean):
    """Assert that a model of a spoiled record is as good as that of the clean one, and good for the same range."""
    model = slpi_ros.identify(record).axes["x"]
    assert error(model, clean) <= 1.2 * error(of_clean, clean)
    noise = 6 * NOISE
    for mine, its in (
        (model.voltage_range, of_clean.voltage_range),
        (model.displacement_range, of_clean.displacement_range),
    ):
        assert its[0] - noise <= mine[0] and mine[1] <= its[1] + noise
    return model


@pytest.mark.parametrize("by", [500.0, 20.0, -30.0, 1e5])
def test_one_voltage_decides_nothing(clean, of_clean, by):
    record = spoiled(clean, "voltage", 3000, by)
    model = judge(record, clean, of_clean)
    assert model.quality.held_out_rms <= 1.2 * of_clean.quality.held_out_rms
    found = assess(record, "x").voltage
    assert found.spikes == 1 and found.high == pytest.approx(100.0)


@pytest.mark.parametrize(("count", "by"), [(1, 1e-2), (1, -1e-3), (1, 1e-4), (3, 1e-3)])
def test_displacements_far_away_decide_nothing(clean, of_clean, count, by):
    record = spoiled(clean, "displacement", np.array([3000, 1000, 5000])[:count], by)
    model = judge(record, clean, of_clean)
    assert model.quality.held_out_rms <= 1.2 * of_clean.quality.held_out_rms
    assert assess(record, "x").displacement.spikes == count


@pytest.mark.parametrize(
    ("times", "count"),
    [
        pytest.param(times, count, marks=() if (times, count) in CORNERS else pytest.mark.long)
        for times in (2, 100, 10_000)
        for count in (5, 50, 600)
    ],
)
def test_many_outliers_of_any_size_leave_the_model_as_it_is(clean, of_clean, count, times):
    rng = np.random.default_rng(3)
    at = rng.choice(len(clean), count, replace=False)
    judged = slpi_ros.identify(spoiled(clean, "displacement", at, times * NOISE * rng.choice([-1, 1], count))).axes["x"]
    assert error(judged, clean) <= 1.2 * error(of_clean, clean)
    assert judged.voltage_range == pytest.approx(of_clean.voltage_range)
    if times >= 100:
        assert judged.quality.held_out_rms <= 1.2 * of_clean.quality.held_out_rms
        assert judged.displacement_range == pytest.approx(of_clean.displacement_range, abs=6 * NOISE)


@pytest.mark.parametrize("volts", [1.0, 10.0, 100.0])
def test_voltages_that_no_displacement_follows_are_no_reversals(clean, of_clean, volts):
    rng = np.random.default_rng(4)
    at = rng.choice(len(clean), 50, replace=False)
    judge(spoiled(clean, "voltage", at, volts * rng.choice([-1, 1], 50)), clean, of_clean)


def test_what_the_other_signal_follows_is_none(clean):
    assert not any(off.size for off in far_outliers(clean.voltage["x"], clean.displacement["x"]))


@pytest.mark.parametrize("width", [1, 3, 20])
def test_pulses_that_the_stage_follows_are_none(width):
    v = np.interp(np.arange(4000), [0, 500, 1000, 1500, 2000], [20, 100, 0, 100, 20])
    for at in range(2100, 3900, 200):
        v[at : at + width] = 60.0
    y = 2e-7 * v + NOISE * np.random.default_rng(5).standard_normal(v.size)
    off_v, off_y = far_outliers(v, y)
    assert not off_v.size and not off_y.size


def test_ringing_after_a_jump_is_none():
    t = np.arange(6000) / 5000
    v = np.where(t < 0.4, 0.0, 50.0 + 40.0 * np.sin(2 * np.pi * 5.0 * (t - 0.4)))
    ringing = np.exp(-np.maximum(t - 0.4, 0.0) / 0.03) * np.sin(2 * np.pi * 900.0 * (t - 0.4))
    y = 2e-7 * v + np.where(t < 0.4, 0.0, 1e-5) * ringing + NOISE * np.random.default_rng(5).standard_normal(t.size)
    assert not far_outliers(v, y)[1].size


@pytest.mark.parametrize("seed", range(4))
def test_kinks_stay_in_the_fit(seed):
    """A stage of few play operators bends sharply; with noise single readings there lie beside their neighbours."""
    rng = np.random.default_rng(seed)
    t = np.arange(6000) / 200.0
    v = 50.0 * (1.0 - np.cos(2.0 * np.pi * 0.2 * t))
    y = 0.1e-6 * v
    for threshold in (3.0, 8.0, 15.0, 25.0):
        z = np.empty_like(v)
        z[0] = 0.0
        for k in range(1, v.size):
            z[k] = min(max(z[k - 1], v[k] - threshold), v[k] + threshold)
        y = y + 0.15e-6 * z
    y = y + NOISE * rng.normal(size=y.size)
    record = slpi_ros.Record(np.round(t * 1e9).astype(np.int64), {"x": v}, {"x": y})
    assert select_samples(record, "x", None, None).fitted.all()


@pytest.mark.parametrize("beside", [1, 2, 5])
def test_outliers_beside_each_other_are_found_with_a_model(clean, of_clean, beside):
    path = of_clean.memory("start").forward_array(clean.voltage["x"])
    at = np.concatenate([[0], (np.arange(1500, 4500, 500)[:, None] + np.arange(beside)).ravel(), [5999, 6000]])
    for signs in (1.0, np.where(np.arange(at.size) % 2, 1.0, -1.0)):
        y = spoiled(clean, "displacement", at, signs * 100 * NOISE).displacement["x"]
        assert outliers_by_model(path, y, clean.voltage["x"]).tolist() == at.tolist()


@pytest.mark.parametrize("noise", [0.0, 0.1 * NOISE, NOISE])
@pytest.mark.parametrize("kind", ["slpi", "pi"])
def test_what_a_model_gets_wrong_is_no_outlier(kind, noise):
    t, v = calibration_drive(0.0, 100.0, duration=30.0, rate=200.0, seed=2)
    y = SimulatedAxis(AxisParameters.random(2), 2).run(t, v)[0]
    y = y + noise * np.random.default_rng(6).standard_normal(t.size)
    model = slpi_ros.identify(slpi_ros.Record(np.round(t * 1e9).astype(np.int64), {"x": v}, {"x": y}), kind).axes["x"]
    assert not outliers_by_model(model.memory("start").forward_array(v), y, v).size


@pytest.mark.parametrize("readings", [1, 3, 2000])
def test_a_sudden_error_of_a_model_is_no_outlier(clean, readings):
    path = clean.displacement["x"].copy()
    path[2500 : 2500 + readings] += 400 * NOISE
    assert not outliers_by_model(path, clean.displacement["x"], clean.voltage["x"]).size


def selected(record, clean):
    """Return the samples of a record, and their largest change of voltage against the clean record, volts."""
    samples = select_samples(record, "x", None, None)
    return samples, float(np.abs(samples.v - clean.voltage["x"]).max())


@pytest.mark.parametrize("by", [20.0, -30.0, 500.0])
@pytest.mark.parametrize("count", [4, 5])
def test_runs_of_wrong_voltages_are_no_motion(clean, count, by):
    for at in (100, 3000, 5000):
        samples, changed = selected(spoiled(clean, "voltage", np.arange(at, at + count), by), clean)
        assert changed < 0.1 and samples.fitted.all()


@pytest.mark.parametrize("count", [1, 3, 5])
def test_both_signals_at_zero_are_a_lost_message(clean, count):
    at = np.arange(3000, 3000 + count)
    lost = spoiled(clean, "voltage", at, -clean.voltage["x"][at])
    lost = spoiled(lost, "displacement", at, -clean.displacement["x"][at])
    samples, changed = selected(lost, clean)
    assert changed < 0.1 and np.flatnonzero(~samples.fitted).tolist() == at.tolist()


def test_a_start_at_zero_is_no_lost_message():
    t = np.arange(3000) / 50.0
    v = 50.0 * np.exp(-t / 20.0) * np.abs(np.sin(0.5 * np.pi * t))
    off_v, off_y = far_outliers(v, 2e-7 * v)
    assert not off_v.size and not off_y.size


@pytest.mark.parametrize("at", [0, 1, 2, 4, slice(0, 5), -1, -2, -5, slice(-5, None)])
def test_outliers_among_the_first_and_last_readings_are_left_out(clean, at):
    at = np.atleast_1d(np.arange(len(clean))[at])
    samples, changed = selected(spoiled(clean, "voltage", at, 50.0), clean)
    assert changed < 1.0 and samples.fitted.all()
    samples, changed = selected(spoiled(clean, "displacement", at, 1e-4), clean)
    assert changed == 0.0 and np.flatnonzero(~samples.fitted).tolist() == at.tolist()


@pytest.mark.parametrize("by", [-5.0, 3.0])
@pytest.mark.parametrize("at", [0, 1, -2, -1])
@pytest.mark.parametrize("rest", [10, 30])
def test_a_wrong_voltage_beside_a_rest_at_an_end_is_no_range(at, by, rest):
    """Fast cycles with a short rest before and after them, in which the stage has just come to rest."""
    t = np.arange(2600) / 100.0
    v = 50.0 * (1.0 - np.cos(2.0 * np.pi * 0.5 * np.clip(t - 0.01 * rest, 0.0, 26.0 - 0.02 * rest)))
    v[-rest:] = v[-rest - 1]
    y = SimulatedAxis(AxisParameters.random(1), 1).run(t, v)[1]
    record = slpi_ros.Record(np.round(t * 1e9).astype(np.int64), {"x": v}, {"x": y})
    clean = select_samples(record, "x", None, None).v
    found = select_samples(spoiled(record, "voltage", at, by), "x", None, None).v
    assert np.abs(found - clean).max() < 0.5
    found = assess(spoiled(record, "voltage", at, by), "x").voltage
    assert found.spikes + found.stale == 1
    assert assess(record, "x").voltage.spikes == 0


@pytest.mark.parametrize("rate", [10.0, 200.0, 1000.0])
def test_digits_of_a_record_without_noise_are_no_outliers(rate):
    t = np.arange(int(60.0 * rate)) / rate
    v = 50.0 * (1.0 - np.cos(2.0 * np.pi * (0.2 if rate < 500.0 else 1.0) * t))
    record = slpi_ros.Record(np.round(t * 1e9).astype(np.int64), {"x": v}, {"x": np.round(2e-7 * v, 9)})
    assert select_samples(record, "x", None, None).fitted.all()
    found = assess(record, "x")
    assert found.displacement.spikes == found.voltage.spikes == 0


def test_outliers_at_the_beginning_are_no_wrong_history(clean):
    with warnings.catch_warnings():
        warnings.simplefilter("error", InitialStateWarning)
        slpi_ros.identify(spoiled(clean, "displacement", np.array([3, 20, 40, 41, 60, 61, 62, 80]), 3e-7))


def test_verify_and_diagnose_leave_out_what_identify_leaves_out(clean, of_clean):
    # Beside each other, and small enough to be found with a model only.
    at = (np.arange(1500, 4500, 500)[:, None] + np.arange(2)).ravel()
    record = spoiled(clean, "displacement", at, 100 * NOISE)
    assert select_samples(record, "x", None, None).fitted[at].any()
    model = slpi_ros.StageModel({"x": of_clean})
    checked = slpi_ros.verify(record, model).axes["x"].records[0]
    assert not checked.judged[at].any() and checked.judged.sum() >= 0.9 * len(clean)
    assert not evidence_of([record], "x", of_clean).used[at].any()
