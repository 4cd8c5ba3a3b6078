"""What is known of the sensor changes neither the model of the stage nor what is said of it."""

from dataclasses import replace

import numpy as np
import pytest
from identification.records import record_of, rms, stage
from refusals import holds
from scipy.signal import lsim

import slpi_ros
from slpi_ros.calibration.run import Recording, tracking_error
from slpi_ros.effects.gain_drift import GainDrift
from slpi_ros.effects.sensor_periodic import SensorPeriodic
from slpi_ros.effects.thermal_drift import ThermalDrift
from slpi_ros.excitation.drives import calibration_drive
from slpi_ros.model.sensor import Sensor
from slpi_ros.reports.verification import describe_verification

SEED, RATE, NOISE = 2, 500.0, 4e-9
PERIODIC = SensorPeriodic(6.33e-7, 2e-8, 0.7)
LATE = {"sensor_delay": 0.013, "sensor_lag": 0.008}


def said(t, x, periodic=False, late=True, seed=0):
    """Return the readings of a sensor, computed with equations of its own."""
    y = x + 2e-8 * np.sin(2 * np.pi * x / 6.33e-7 + 0.7) if periodic else x
    if late:
        fine = np.arange(t[0], t[-1], 1e-4)
        at = np.interp(fine, t, y)
        _, lagged, _ = lsim(([1.0], [LATE["sensor_lag"], 1.0]), at - at[0], fine - fine[0])
        y = np.interp(t - LATE["sensor_delay"], fine, lagged + at[0])
    return y + np.random.default_rng(seed).normal(0.0, NOISE, t.size)


def driven(seed):
    """Return times, voltages and true displacements of a drive of the stage, from rest."""
    t, v = calibration_drive(0.0, 100.0, duration=20.0, rate=RATE, seed=seed)
    return t, v, stage(SEED, 0.0).run(t, v)[0]


@pytest.fixture(scope="module")
def first():
    return driven(1)


@pytest.fixture(scope="module")
def other():
    return driven(7)


@pytest.fixture(scope="module")
def prompt(first):
    """The model from a sensor without any delay."""
    t, v, x = first
    return slpi_ros.identify(record_of(t, v, said(t, x, late=False)))


@pytest.fixture(scope="module")
def known(first):
    t, v, x = first
    return slpi_ros.identify(record_of(t, v, said(t, x)), **LATE)


def path():
    t = np.arange(2000) / RATE
    return t, 1e-6 * (9.0 - 6.0 * np.cos(2 * np.pi * 2.0 * t))


@pytest.mark.slow
def test_a_late_sensor_sends_the_stage_nowhere_else(first, prompt, known):
    """Along the path and sample by sample as if it had not been late; unknown, it counts as loops of the stage."""
    assert known.axes["x"].sensor == Sensor(LATE["sensor_delay"], LATE["sensor_lag"]) and not known.axes["x"].effects
    t, y = path()
    plain = slpi_ros.identify(record_of(first[0], first[1], said(first[0], first[2])))
    errors = {}
    for name, model in (("prompt", prompt), ("known", known), ("plain", plain)):
        stream = model.stream("x", "start")
        streamed = np.array([stream.step(*sample) for sample in zip(t.tolist(), y.tolist(), strict=True)])
        batch = model.compensate(t, y, "start")
        np.testing.assert_allclose(streamed, batch, rtol=0, atol=1e-6)
        error = stage(SEED, 0.0).run(t, batch)[0] - y
        errors[name] = rms(error - error.mean())
    assert errors["known"] < 1.3 * errors["prompt"] + 2e-9
    assert errors["plain"] > 5 * errors["known"]


def test_the_held_out_error_is_that_of_the_noise(prompt, known):
    before, after = (model.axes["x"].quality.held_out_rms for model in (prompt, known))
    # Undoing the lag of four samples amplifies the noise.
    assert before < 1.3 * NOISE and after < 5 * NOISE


@pytest.mark.parametrize("late", [False, True])
def test_verify_judges_the_stage(other, prompt, late):
    t, v, x = other
    record = record_of(t, v, said(t, x, periodic=True, late=late, seed=3))
    axis = replace(prompt.axes["x"], effects=(PERIODIC,))
    model = slpi_ros.StageModel({"x": axis})
    if late:
        model = model.with_sensor(delay=LATE["sensor_delay"], lag=LATE["sensor_lag"])
    found = slpi_ros.verify(record, model)
    right, wrong = found.axes["x"], slpi_ros.verify(record, prompt).axes["x"]
    lines = [line for line in describe_verification(found) if "taken out" in line]
    assert len(lines) == 1 and holds(lines[0], 20, 633, *((13, 8) if late else ()))
    assert right.overall.rms < (5 if late else 1.3) * NOISE
    assert wrong.overall.rms > 1.2e-8 and wrong.overall.rms > 2 * right.overall.rms


def test_the_tracking_error_is_that_of_the_stage(first, prompt):
    """The sensor's 20 nm are in no figure of a path that the stage follows."""
    model = slpi_ros.StageModel({"x": replace(prompt.axes["x"], effects=(PERIODIC,))})
    t, y = path()
    v = model.compensate(t, y, "start")
    x = stage(SEED, 0.0).run(t, v)[0]
    record = record_of(t, v, said(t, x, periodic=True, late=False))
    true = rms(x - y)
    tracking = slpi_ros.verify(record, model, desired=[{"x": y}]).axes["x"].records[0].tracking
    assert tracking.error.rms == pytest.approx(np.hypot(true, NOISE), rel=0.1)
    told = tracking_error(Recording(record, {"x": y}), "x", model, 1e-8)
    assert told.rms == pytest.approx(np.hypot(true, NOISE), rel=0.1)
    assert tracking_error(Recording(record, {"x": y}), "x", prompt, 1e-8).rms > 1.3e-8


@pytest.mark.long
def test_refit_takes_the_sensor_out_of_the_new_record(other, known):
    t, v, x = other
    new, changes = slpi_ros.refit(known, record_of(t, v, said(t, x, seed=5)))
    assert not changes["x"].drifted and changes["x"].error_before < 5 * NOISE
    assert new.axes["x"].sensor == known.axes["x"].sensor
    _, unaware = slpi_ros.refit(known.with_sensor(delay=0.0, lag=0.0), record_of(t, v, said(t, x, seed=5)))
    assert unaware["x"].error_before > 3 * changes["x"].error_before


def test_refit_leaves_out_what_belongs_to_the_old_record(other, prompt):
    t, v, x = other
    effects = (
        GainDrift((1.0, 20.0), (0.01, 1e-9), 0.0),
        ThermalDrift((0.0, 20.0), (0.0, 1e-6)),
    )
    model = slpi_ros.StageModel({"x": replace(prompt.axes["x"], effects=effects)})
    new, changes = slpi_ros.refit(model, record_of(t, v, said(t, x, late=False, seed=5)))
    assert changes["x"].error_before < 1.3 * NOISE
    assert new.axes["x"].effects == (effects[0].lasting,)


@pytest.mark.slow
def test_a_diagnosis_does_not_name_what_is_known(other, prompt):
    t, v, x = other
    record = record_of(t, v, said(t, x, seed=3))
    model = prompt.with_sensor(delay=LATE["sensor_delay"], lag=LATE["sensor_lag"])
    found = slpi_ros.diagnose(record, model)
    assert not {effect.name for effect in found.axes["x"].effects} & {"delay", "lag"}
    assert found.extended.axes["x"].sensor == model.axes["x"].sensor


@pytest.mark.slow
@pytest.mark.long
def test_a_diagnosis_names_what_is_not_known(other, prompt):
    t, v, x = other
    unaware = slpi_ros.diagnose(record_of(t, v, said(t, x, seed=3)), prompt)
    assert {effect.name for effect in unaware.axes["x"].effects} & {"delay", "lag"}
