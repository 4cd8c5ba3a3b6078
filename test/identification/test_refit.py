"""Updating a model: drift is followed, and what the new record does not visit is not spoilt."""

from dataclasses import replace

import numpy as np
import pytest
from identification.records import calibration, record_of, rms, stage

import slpi_ros
from benchmarks.paths import scan_path
from slpi_ros.effects.creep import Creep
from slpi_ros.effects.cross_coupling import CrossCoupling
from slpi_ros.effects.lag import Lag
from slpi_ros.errors import IdentificationError, UsageError
from slpi_ros.excitation.drives import calibration_drive
from slpi_ros.identification.refit import refit
from slpi_ros.io.record import Record
from slpi_ros.model.document import format_model, parse_model
from slpi_ros.simulation.axis import SimulatedAxis

SEED = 1


@pytest.fixture(scope="module")
def model():
    return slpi_ros.identify(calibration(seed=SEED, duration=40.0)[0])


def drifted_stage(gain):
    parameters = stage(SEED).parameters
    return SimulatedAxis(replace(parameters, stroke=gain * parameters.stroke), SEED)


def small_loops():
    t = np.arange(3000) / 200.0
    return t, np.where(t < 2, 20 * t, 40 - 8 * np.sin(4.4 * (t - 2)))


def unseen_error(model, gain):
    """Mean error on a path over the whole range, metres."""
    t, desired = scan_path(3e-6, 0.93 * model.axes["x"].displacement_range[1], duration=20.0, rate=200.0, seed=9)
    return float(np.mean(np.abs(drifted_stage(gain).run(t, model.compensate(t, desired, "start"))[0] - desired)))


def test_small_loops_do_not_spoil_the_large_ones(model):
    t, v = small_loops()
    new, changes = refit(model, record_of(t, v, stage(SEED).run(t, v)[1]))
    assert not changes["x"].drifted
    assert unseen_error(new, 1.0) < 1.05 * unseen_error(model, 1.0)
    assert changes["x"].largest < 5e-9


@pytest.mark.parametrize("gain", [0.97, 1.03])
def test_a_gain_that_drifts_is_followed(model, gain):
    t, v = calibration_drive(0.0, 100.0, duration=15.0, rate=200.0, seed=3)
    new, changes = refit(model, record_of(t, v, drifted_stage(gain).run(t, v)[1]))
    change = changes["x"]
    assert change.drifted and change.gain == pytest.approx(gain - 1.0, abs=2e-3)
    assert change.error_after < 0.2 * change.error_before
    assert unseen_error(new, gain) < 0.05 * unseen_error(model, gain)


def test_drift_seen_in_small_loops_corrects_the_large_ones(model):
    t, v = small_loops()
    new, changes = refit(model, record_of(t, v, drifted_stage(1.03).run(t, v)[1]))
    assert changes["x"].gain == pytest.approx(0.03, abs=4e-3)
    assert unseen_error(new, 1.03) < 0.1 * unseen_error(model, 1.03)


def test_the_new_model_is_a_whole_document(model):
    t, v = small_loops()
    new, _ = refit(model, record_of(t, v, stage(SEED).run(t, v)[1]))
    again = parse_model(format_model(new), "test")
    np.testing.assert_array_equal(again.axes["x"].simulate(t, v), new.axes["x"].simulate(t, v))
    # The first rise, before the initial state is forgotten, is not fitted.
    assert 0 < again.axes["x"].quality.samples - model.axes["x"].quality.samples <= v.size
    assert again.axes["x"].voltage_range == model.axes["x"].voltage_range


def test_axes_that_the_record_does_not_hold_stay(model):
    both = replace(model, axes={"x": model.axes["x"], "z": model.axes["x"]})
    t, v = small_loops()
    new, changes = refit(both, record_of(t, v, stage(SEED).run(t, v)[1]))
    assert new.axes["z"] is both.axes["z"] and set(changes) == {"x"}


def test_classical_model_too():
    record = calibration(seed=SEED)[0]
    old = slpi_ros.identify(record, "pi")
    t, v = calibration_drive(0.0, 100.0, duration=15.0, rate=200.0, seed=3)
    y = drifted_stage(1.1).run(t, v)[1]
    new, _ = refit(old, record_of(t, v, y))
    assert rms(new.axes["x"].simulate(t, v) - y) < 0.7 * rms(old.axes["x"].simulate(t, v) - y)


def test_what_cannot_be_updated_is_refused(model):
    t, v = small_loops()
    y = stage(SEED).run(t, v)[1]
    record = record_of(t, v, y)
    with pytest.raises(UsageError, match="'a'.*'b'"):
        refit(replace(model, hardware_id="a"), replace(record, hardware_id="b"))
    with pytest.raises(UsageError, match="none of the model's axes x"):
        refit(model, record_of(t, v, y, axis="z"))
    with pytest.raises(IdentificationError, match="identify the stage anew"):
        refit(model, record_of(t, 3 * v, y))
    published = slpi_ros.identify(calibration(seed=SEED)[0], "smpi")
    with pytest.raises(UsageError, match="kind 'smpi' cannot be updated"):
        refit(published, record)


def test_effects_of_the_model_are_not_taken_for_hysteresis(model):
    effects = (Lag(0.02), Creep((2.0,), (0.05,)))
    with_effects = replace(model, axes={"x": replace(model.axes["x"], effects=effects)})
    t, v = calibration_drive(0.0, 100.0, duration=15.0, rate=200.0, seed=3)
    y = with_effects.simulate(t, v) + 8e-9 * np.random.default_rng(0).normal(size=t.size)
    new, changes = refit(with_effects, record_of(t, v, y))
    assert new.axes["x"].effects == with_effects.axes["x"].effects
    assert not changes["x"].drifted
    assert changes["x"].error_after < 9e-9
    assert refit(model, record_of(t, v, y))[1]["x"].drifted


def test_the_record_of_another_stage_is_refused(model):
    record, _ = calibration(seed=SEED + 1)
    foreign = replace(record, displacement={"x": 1.6 * record.displacement["x"]})
    with pytest.raises(IdentificationError, match="this model does not belong to this bag") as refusal:
        refit(model, foreign)
    assert str(refusal.value).count("axis 'x'") == 1


@pytest.mark.parametrize("excess", [1e-4, 5e-3])
def test_a_voltage_slightly_beyond_the_range_is_held_at_its_end(model, excess):
    low, high = model.axes["x"].voltage_range
    t, v = calibration_drive(low, high, duration=15.0, rate=200.0, seed=3)
    record = record_of(t, v, stage(SEED).run(t, v)[1])
    middle, width = (low + high) / 2, high - low
    beyond = np.where(np.abs(v - middle) > 0.495 * width, v + excess * width * np.sign(v - middle), v)
    within, _ = refit(model, record)
    new, changes = refit(model, replace(record, voltage={"x": beyond}))
    assert not changes["x"].drifted
    assert new.axes["x"].voltage_range == (low, high)
    assert unseen_error(new, 1.0) < 1.1 * unseen_error(within, 1.0)


def test_coupling_of_an_axis_that_is_not_updated_is_not_taken_for_hysteresis(model):
    """2 % of another axis, which moves by its whole stroke meanwhile, is 0.4 µm."""
    x = model.axes["x"]
    both = replace(model, axes={"x": replace(x, effects=(CrossCoupling({"y": 0.02}),)), "y": x})
    t, v = calibration_drive(0.0, 100.0, duration=15.0, rate=200.0, seed=3)
    _, other = calibration_drive(0.0, 100.0, duration=15.0, rate=200.0, seed=4)
    volts = {"x": v, "y": other}
    noise = 8e-9 * np.random.default_rng(0).normal(size=(2, t.size))
    moved = dict(zip("xy", np.array([both.simulate(t, volts)[name] for name in "xy"]) + noise, strict=True))
    assert 0.02 * np.ptp(moved["y"]) > 3e-7
    record = Record(np.round(t * 1e9).astype(np.int64), volts, moved, "test")
    new, changes = refit(both, record, axes=["x"])
    assert set(changes) == {"x"} and new.axes["y"] is both.axes["y"]
    assert not changes["x"].drifted and changes["x"].error_after < 9e-9
    # Without voltages of the other axis nothing is known of its motion.
    unknown = replace(record, voltage={"x": v, "y": np.full(t.size, np.nan)})
    assert refit(both, unknown, axes=["x"])[1]["x"].error_before > 5e-8
