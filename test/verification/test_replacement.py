"""A model that covers less than the one in use, is worse or foreign, needs a word before it takes its place."""

import re
from dataclasses import replace

import numpy as np
import pytest
from refusals import holds
from strategies import FAMILY_CASE, axis_model

from slpi_ros.errors import RecordError
from slpi_ros.excitation.drives import calibration_drive
from slpi_ros.io.record import Record
from slpi_ros.model.stage_model import StageModel
from slpi_ros.verification.replacement import doubt_about

X = axis_model(FAMILY_CASE)
LOW, HIGH = X.voltage_range
IN_USE = replace(X, quality=replace(X.quality, held_out_rms=8e-9, samples=8000, covered=0.8))


def of(axis=IN_USE, **changes):
    """Return a model with this axis, and changes of its range or quality."""
    reach = {name: changes.pop(name) for name in ("voltage_range",) if name in changes}
    return StageModel({"x": replace(axis, quality=replace(axis.quality, **changes), **reach)})


def test_a_model_as_good_as_the_one_in_use_is_taken():
    assert doubt_about(of(held_out_rms=9e-9), of()) == ""


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"voltage_range": (LOW, LOW + 0.05 * (HIGH - LOW))}, ["5%", "80%", f"{HIGH:.4g} V"]),
        ({"voltage_range": (HIGH + 1.0, HIGH + 2.0)}, ["0%"]),
        ({"covered": 0.3}, ["30%", "80%", "40%"]),
        ({"samples": 60}, [60, 8000, 800]),
        ({"held_out_rms": 485e-9}, ["485 nm", "8 nm", "24 nm"]),
    ],
)
def test_a_model_that_covers_less_or_is_much_worse_is_not(changes, told):
    reason = doubt_about(of(**changes), of())
    assert holds(reason, "axis 'x'", *told), reason


def test_a_larger_range_and_enough_samples_are_no_reason():
    """A refitted model counts the samples of all its records; a calibration has no fewer than a thousand."""
    assert doubt_about(of(voltage_range=(LOW - 5.0, HIGH + 5.0)), of()) == ""
    assert doubt_about(of(samples=1000), of(samples=1_000_000)) == ""
    assert doubt_about(of(samples=999), of(samples=1_000_000))


def test_a_foreign_model_is_not():
    shape = X.hysteresis
    foreign = replace(IN_USE, hysteresis=replace(shape, everett=1.3 * shape.everett, rise=1.3 * shape.rise))
    assert holds(doubt_about(of(foreign), of()), "axis 'x'", "10%")


def test_it_is_compared_with_the_model_in_use_on_its_own_record():
    t, v = calibration_drive(LOW, HIGH, duration=20.0, rate=100.0, seed=1)
    noise = 8e-9 * np.random.default_rng(1).standard_normal(t.size)
    y = X.simulate(t, v) + noise
    record = Record(np.round(t * 1e9).astype(np.int64), {"x": v}, {"x": y})
    assert doubt_about(of(held_out_rms=9e-9), of(), [record]) == ""
    # Its error would not stand out beside that of the model in use on the record of that, but on the same one it does.
    reason = doubt_about(of(held_out_rms=20e-9), of(), [record])
    error = float(np.sqrt(np.mean((noise - np.median(noise)) ** 2)))
    told = [float(number) * 1e-9 for number in re.findall(r"([\d.]+) nm", reason)]
    assert told == pytest.approx([20e-9, error, 2 * error], rel=0.05)
    # A model in use that the record contradicts gives way.
    changed = Record(record.time_ns, {"x": v}, {"x": 1.05 * y})
    assert doubt_about(of(held_out_rms=20e-9), of(), [changed]) == ""


def test_a_model_in_use_that_cannot_be_compared_is_no_reason(monkeypatch):
    def fail(*_, **__):
        raise RecordError("too little data")

    monkeypatch.setattr("slpi_ros.verification.replacement.verify", fail)
    record = Record(np.arange(3), {"x": np.zeros(3)}, {"x": np.zeros(3)})
    assert doubt_about(of(held_out_rms=20e-9), of(), [record]) == ""
