"""A measured voltage without its noise."""

import numpy as np
import pytest
from identification.records import calibration, record_of, rms, stage

import slpi_ros
from slpi_ros.excitation.drives import DRIVES, calibration_drive, excite
from slpi_ros.hysteresis.reversals import monotone_runs
from slpi_ros.identification.signal_statistics import voltage_noise, without_noise


@pytest.mark.parametrize("rate", [50.0, 200.0, 1000.0])
@pytest.mark.parametrize("drive", DRIVES)
def test_a_commanded_voltage_is_left_alone(drive, rate):
    made = excite(("x", "y"), voltage_min=0.0, voltage_max=100.0, duration=120.0, rate=rate, drive=drive)
    for v in made.voltage.values():
        assert without_noise(made.t, v) is v


def test_what_is_no_noise_is_left_alone():
    t = np.arange(5000.0)
    random = np.random.default_rng(0).uniform(0.0, 100.0, t.size)
    triangle = 50.0 * np.abs((t / 7.3) % 2.0 - 1.0)
    coarse = np.round(50.0 * np.sin(0.01 * t) * 40.96) / 40.96
    for v in (random, triangle, coarse, t[:4], np.zeros(100)):
        assert without_noise(np.arange(v.size) * 1.0, v) is v


@pytest.mark.parametrize("often", [2, 3, 10])
def test_a_command_that_is_read_more_often_than_it_is_sent_is_left_alone(often):
    t, v = calibration_drive(0.0, 100.0, duration=30.0, rate=100.0, seed=1)
    readings = np.repeat(v, often)
    times = np.arange(readings.size) / (100.0 * often)
    assert without_noise(times, readings) is readings


@pytest.mark.parametrize("often", [2, 3])
def test_noise_that_is_read_more_often_than_it_is_measured_is_noise(often):
    _, v = calibration_drive(0.0, 100.0, duration=30.0, rate=100.0, seed=1)
    noisy = np.repeat(v + np.random.default_rng(0).normal(0.0, 0.05, v.size), often)
    assert voltage_noise(np.arange(noisy.size) / (100.0 * often), noisy) == pytest.approx(0.05, rel=0.1)


@pytest.mark.parametrize("rate", [200.0, 2000.0])
def test_noise_is_measured_and_mostly_gone(rate):
    t, v = calibration_drive(0.0, 100.0, duration=30.0, rate=rate, seed=1)
    noisy = v + np.random.default_rng(0).normal(0.0, 0.05, v.size)
    assert voltage_noise(t, noisy) == pytest.approx(0.05, rel=0.1)
    cleaned = without_noise(t, noisy)
    assert rms(cleaned - v) < 0.5 * 0.05
    # Turns are where they were, and there are no more of them than twice as many.
    assert np.abs(cleaned - v).max() < 6 * 0.05
    assert len(monotone_runs(cleaned)) < 2 * len(monotone_runs(v))
    assert noisy.min() <= cleaned.min() and cleaned.max() <= noisy.max()


def test_no_voltage_beyond_the_limits_of_the_amplifier():
    t = np.arange(6000) / 200.0
    clipped = np.clip(50.0 + 51.0 * np.sin(2.0 * t) + np.random.default_rng(0).normal(0.0, 0.05, t.size), 0.0, 100.0)
    cleaned = without_noise(t, clipped)
    assert cleaned is not clipped and cleaned.min() >= 0.0 and cleaned.max() <= 100.0


def test_sharp_turns_stay():
    t = 0.001 * np.arange(6000)
    v = 50.0 * np.abs(t % 2.0 - 1.0)
    cleaned = without_noise(t, v + np.random.default_rng(0).normal(0.0, 0.02, v.size))
    assert abs(cleaned[3000] - v[3000]) < 0.06 and abs(cleaned[2000] - v[2000]) < 0.06


def test_the_model_is_that_of_the_true_voltage():
    record, true = calibration(seed=1, duration=30.0)
    v = record.voltage["x"]
    noisy = v + np.random.default_rng(0).normal(0.0, 0.05, v.size)
    found = slpi_ros.identify(record_of(record.t, noisy, record.displacement["x"])).axes["x"]
    # Of the noise, 0.2 um/V, some is left in the errors; in the model, next to nothing.
    assert found.quality.rms < 11e-9
    other = stage(1)
    other.run(record.t, v)
    test = 50.0 - 45.0 * np.cos(np.linspace(0.0, 20.0, 2000))
    t = record.t[-1] + 0.01 * np.arange(1, test.size + 1)
    behind = slpi_ros.StageModel({"x": found}).simulate(np.append(record.t, t), np.append(v, test))[v.size :]
    assert rms(behind - other.run(t, test)[0]) < 8e-9
    assert rms(true - slpi_ros.StageModel({"x": found}).simulate(record.t, v)) < 6e-9
