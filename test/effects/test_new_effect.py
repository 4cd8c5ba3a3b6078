"""A new effect costs its own file and one entry in the registry; everything else follows."""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from effects.supply_sag import SupplySag

import slpi_ros
from slpi_ros.diagnosis.answer import answer_of
from slpi_ros.diagnosis.effect_parameters import bounded, free, moved, names, steps
from slpi_ros.diagnosis.joint_fit import JointFit
from slpi_ros.diagnosis.prepare import evidence_of
from slpi_ros.effects import registry
from slpi_ros.errors import ModelError
from slpi_ros.excitation.drives import calibration_drive, excite
from slpi_ros.excitation.effects import for_effect, separating
from slpi_ros.io import schemas
from slpi_ros.io.record import Record
from slpi_ros.model.document import load_model, save_model
from slpi_ros.simulation.stage import Stage

sys.path.append(str(Path(__file__).resolve().parents[2] / "tools"))

from make_schemas import GENERATED  # noqa: E402

NAME, GAIN, NOISE = "supply_sag", 1.5e-3, 5e-9


@pytest.fixture(autouse=True)
def registered(monkeypatch):
    """Add the effect to the registry, and generate the schemas as `make schemas` does."""
    monkeypatch.setitem(registry.EFFECTS, NAME, SupplySag)
    stored = schemas.load_schema
    monkeypatch.setattr(schemas, "_schema", lambda name: GENERATED.get(name, lambda same: same)(stored(name)))


@pytest.fixture(scope="module")
def record():
    t, v = calibration_drive(0.0, 100.0, duration=30.0, rate=250.0, seed=3)
    stage = Stage.random(["x"], 4, 0.0)
    y = np.array([stage.measure(stage.step(when, [volts]))[0] for when, volts in zip(t, v, strict=True)])
    y = y + GAIN * np.abs(np.gradient(y, t)) + NOISE * np.random.default_rng(5).standard_normal(t.size)
    return Record(np.round(t * 1e9).astype(np.int64), {"x": v}, {"x": y}, "sagging", "stage")


def test_it_is_found_fitted_described_saved_and_loaded(record, tmp_path):
    diagnosis = slpi_ros.diagnose(record, slpi_ros.identify(record))
    found = diagnosis.axes["x"]
    (named,) = found.effects
    assert (found.verdict, named.name, named.alternatives) == ("named", NAME, ())
    assert named.effect.gain == pytest.approx(GAIN, rel=0.1) and 0 < named.effect.uncertainty["gain"] < 0.1 * GAIN
    assert named.effect.describe() in named.evidence and found.after_rms < 1.5 * NOISE
    schemas.validate(diagnosis.to_document(), "diagnosis", "here")
    save_model(diagnosis.extended, tmp_path / "model.json")
    loaded = load_model(tmp_path / "model.json")
    assert loaded.axes["x"].effects == diagnosis.extended.axes["x"].effects == (named.effect,)
    t, v = record.t, record.voltage["x"]
    np.testing.assert_array_equal(loaded.simulate(t, v), diagnosis.extended.simulate(t, v))
    # An error of the sensor is in what the sensor says, and not in what the stage is driven to.
    bare = replace(loaded, axes={"x": replace(loaded.axes["x"], effects=())})
    assert not np.array_equal(bare.simulate(t, v), loaded.simulate(t, v))
    path = 0.5 * (bare.simulate(t, v) + np.mean(bare.axes["x"].displacement_range))
    np.testing.assert_array_equal(loaded.compensate(t, path), bare.compensate(t, path))


def test_its_plausibility_is_asked(record, monkeypatch):
    fit = JointFit(evidence_of([record], "x", slpi_ros.identify(record).axes["x"]))
    (one,) = answer_of(fit, [NAME]).now.effects
    assert one.gain == pytest.approx(GAIN, rel=0.1)
    monkeypatch.setattr("effects.supply_sag.LARGEST", 1e-6)
    assert not answer_of(fit, [NAME]).now.effects


def test_its_parameters_are_checked_and_fitted_as_its_fields_say():
    with pytest.raises(ModelError, match="gain"):
        SupplySag(2.0)
    effect, t, v = SupplySag(GAIN), np.linspace(0, 1, 101), np.linspace(0, 1, 101)
    assert (names(effect), free(effect).tolist(), steps(effect, t, v).tolist()) == (["gain"], [GAIN], [1e-8])
    assert moved(effect, free(effect) + bounded(effect, np.array([0.5]))) == SupplySag(GAIN + 0.5)
    assert registry.from_document(registry.to_document(effect)) == effect
    assert [each.name for each in registry.in_order([effect, registry.EFFECTS["lag"](0.1)])] == ["lag", NAME]


def test_it_has_a_drive_that_separates_it():
    drive = excite(voltage_min=0.0, voltage_max=100.0, drive=NAME)
    assert drive.why == for_effect(NAME).why and np.ptp(drive.voltage["x"]) == 100.0
    assert separating(("lag", NAME)) == NAME and separating(("lag", "delay")) == "lag"
