"""A model against records that start from any memory: a change is told where there is one, and only there."""

from dataclasses import replace

import numpy as np
import pytest
from identification.records import calibration, record_of, stage

import slpi_ros
from slpi_ros.effects.thermal_drift import ThermalDrift
from slpi_ros.excitation.drives import calibration_drive
from slpi_ros.identification.free_run import match
from slpi_ros.identification.refit import refit
from slpi_ros.identification.samples import select_samples
from slpi_ros.simulation.axis import SimulatedAxis

SEED = 1


@pytest.fixture(scope="module")
def model():
    return slpi_ros.identify(calibration(seed=SEED, duration=30.0)[0])


def again(before, v, gain=1.0, zero=0.0, rate=200.0):
    """Record the stage again after the voltages `before`, with another gain and zero (m)."""
    parameters = stage(SEED).parameters
    other = SimulatedAxis(replace(parameters, stroke=gain * parameters.stroke), SEED)
    before = np.append(before, v[0])
    other.run(np.arange(before.size) / rate - 1e3, before)
    t = np.arange(v.size) / rate
    return record_of(t, v, other.run(t, v)[1] + zero)


def of(model, record):
    return match(model.axes["x"], select_samples(record, "x", None, None))


HISTORIES = ([], [100.0, 0.0], [100.0], [70.0, 20.0, 60.0, 30.0], [0.0, 100.0, 40.0, 90.0])
WHOLE = calibration_drive(0.0, 100.0, duration=8.0, rate=200.0, seed=5)[1]
# About the middle of the range, with a growing amplitude: the initial state matters almost to the end.
GROWING = 50.0 + 40.0 * np.linspace(0.0, 1.0, 1600) * np.sin(np.arange(1600) * 0.02)


@pytest.mark.parametrize("v", [WHOLE, GROWING], ids=["whole range", "growing"])
@pytest.mark.parametrize("before", HISTORIES)
def test_a_stage_that_did_not_change_is_never_said_to_have(model, before, v):
    record = again(before, v)
    found = of(model, record)
    assert not found.gain_changed and not found.width_changed and not found.zero_moved
    assert not refit(model, record)[1]["x"].drifted
    # The best initial state gives the record's displacement where it is known.
    assert found.rms < 2e-8
    assert found.known_from < v.size


@pytest.mark.parametrize("gain", [0.99, 1.01])
def test_a_gain_that_changed_by_a_hundredth_is_told(model, gain):
    for before in HISTORIES[1:]:
        record = again(before, WHOLE, gain)
        found = of(model, record)
        assert found.gain_changed and found.gain_change == pytest.approx(gain - 1.0, rel=0.2)
        assert refit(model, record)[1]["x"].drifted


@pytest.mark.parametrize("zero", [-0.93e-6, 0.2e-6])
def test_a_moved_zero_is_told_as_that(model, zero):
    for before in HISTORIES:
        record = again(before, WHOLE, zero=zero)
        found = of(model, record)
        assert found.zero_moved and found.offset == pytest.approx(zero, rel=0.2)
        assert not found.gain_changed
        new, changes = refit(model, record)
        assert not changes["x"].drifted
        assert new.axes["x"].end.displacement - record.displacement["x"][-1] == pytest.approx(0.0, abs=4e-8)


def test_a_small_record_cannot_tell_a_moved_zero_from_another_history(model):
    v = 45.0 + 5.0 * np.sin(np.arange(800) * 0.05)
    found = of(model, again([100.0, 0.0, 70.0, 20.0, 60.0, 30.0], v, zero=0.1e-6))
    assert found.offset_uncertainty > 0.1e-6 and not found.zero_moved and not found.gain_changed


def test_a_drift_of_the_old_record_is_none_of_the_new_one(model):
    drifting = replace(model.axes["x"], effects=(ThermalDrift((0.0, 30.0), (0.0, 1e-6)),))
    found = match(drifting, select_samples(again([], WHOLE), "x", None, None), np.arange(WHOLE.size) / 200.0)
    assert not found.gain_changed and not found.zero_moved
