"""Causes that another one was in the way of at first, and a stage that has not changed though its record has."""

from dataclasses import replace

import numpy as np
import pytest

from slpi_ros.diagnosis.diagnose import diagnose
from slpi_ros.diagnosis.result import AMBIGUOUS, NAMED
from slpi_ros.effects.saturation import Saturation
from slpi_ros.effects.sensor_periodic import SensorPeriodic
from slpi_ros.excitation.drives import calibration_drive
from slpi_ros.identification.fit import identify
from slpi_ros.io.record import Record
from slpi_ros.simulation.axis import SimulatedAxis
from slpi_ros.simulation.parameters import AxisParameters

pytestmark = pytest.mark.long

NOISE = 8e-9
T, V = calibration_drive(0.0, 100.0, duration=60.0, rate=100.0, seed=3)
PARAMETERS = replace(AxisParameters.random(4), noise_rms=0.0, quantisation=0.0)
DRIFT = 2e-7 * (1.0 - np.exp(-T / 20.0))
JUMPS = sum(size * (at <= T) for at, size in ((17.3, 1.2e-7), (33.1, -8e-8), (48.0, 1.5e-7)))


def record(added, name, v=V, seed=1):
    """Return a record of the stage, with what is added to its displacement (m)."""
    path, _ = SimulatedAxis(PARAMETERS).run(T, v)
    y = path + added + NOISE * np.random.default_rng(seed).standard_normal(T.size)
    return Record(np.round(T * 1e9).astype(np.int64) + seed * 10**12, {"x": V}, {"x": y}, name)


@pytest.fixture(scope="module")
def clean():
    return record(0.0, "clean")


@pytest.fixture(scope="module")
def model(clean):
    return identify(clean)


@pytest.mark.parametrize("beside", [False, True])
@pytest.mark.parametrize(
    ("added", "causes"),
    [
        (DRIFT, {"thermal_drift"}),
        pytest.param(
            *(DRIFT + JUMPS, {"thermal_drift", "steps"}),
            marks=pytest.mark.xfail(reason="without a clean record a jump is found ten seconds late: 10.5 nm left"),
        ),
    ],
)
def test_drift_and_jumps_of_one_record_are_found_also_beside_a_clean_one(added, causes, beside, clean, model):
    moved = record(added, "moved", seed=2)
    found = diagnose([moved, clean] if beside else moved, model).axes["x"]
    told = [{effect.name, *effect.alternatives} for effect in found.effects]
    assert found.verdict in (NAMED, AMBIGUOUS) and len(told) == len(causes)
    assert all(any(cause in names for names in told) for cause in causes)
    assert found.after_rms < 1.3 * NOISE
    # The hysteresis is the same.
    assert "slpi refit" not in (found.next_experiment or "")


def test_what_no_hysteresis_explains_is_no_change_of_the_stage(model):
    wandering = np.cumsum(np.random.default_rng(5).standard_normal(T.size))
    found = diagnose(record(2e-7 * wandering / np.std(wandering), "wanders", seed=2), model).axes["x"]
    assert found.after_rms > 1.5 * NOISE or found.effects
    assert "slpi refit" not in (found.next_experiment or "")


def test_a_stage_that_has_changed_is_told(model):
    path, _ = SimulatedAxis(PARAMETERS).run(T, V)
    found = diagnose(record(0.02 * path, "changed", seed=2), model).axes["x"]
    assert "slpi refit" in found.next_experiment


def test_an_amplifier_that_clips_where_the_record_begins():
    """The error of the sensor goes with the absolute displacement, where the stage begins beyond the lower limit."""
    error = SensorPeriodic(6.3e-7, 4e-8, 0.7)
    y = record(0.0, "", v=Saturation(4.0, 90.0).apply(V, None)).displacement["x"]
    one = Record(np.round(T * 1e9).astype(np.int64), {"x": V}, {"x": error.apply(y, None)}, "clipped")
    diagnosis = diagnose(one, identify(one))
    found = diagnosis.axes["x"]
    assert {effect.name for effect in found.effects} == {"saturation", "sensor_periodic"}
    axis = diagnosis.extended.axes["x"]
    assert axis.start.voltage == pytest.approx(4.0, abs=0.05)
    error_rms = np.std(one.displacement["x"] - replace(axis).simulate(T, V, of_record=True))
    assert error_rms < 1.5 * NOISE
