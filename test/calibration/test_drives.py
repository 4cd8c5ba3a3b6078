"""The drives of a calibration stay within all limits, and begin and end at rest."""

from dataclasses import replace

import numpy as np
import pytest
from calibration.stages import SimulatedRecorder, settings, stage_of

from slpi_ros.calibration.drives import checking, compensated, driven_so_far, exciting
from slpi_ros.calibration.run import Request
from slpi_ros.effects.creep import Creep
from slpi_ros.effects.delay import Delay
from slpi_ros.errors import UnreachableError, UsageError
from slpi_ros.excitation.drives import DRIVES
from slpi_ros.identification.fit import identify
from slpi_ros.io.record import Record
from slpi_ros.model.limits import Limits
from slpi_ros.model.stage_model import StageModel
from slpi_ros.simulation.character import Character

LIMITS = {
    "usual": Limits(0.0, 100.0, 1000.0, 1e5),
    "slow": Limits(-20.0, 80.0, 40.0),
    "sluggish": Limits(0.0, 100.0, 300.0, 2000.0),
}


def require_within(drive, chosen):
    for axis, limits, rest in zip(chosen.axes, chosen.limits, chosen.rest, strict=True):
        v = drive.voltage[axis]
        rate = np.diff(v) * chosen.rate
        assert limits.lower <= v.min() and v.max() <= limits.upper
        assert np.abs(rate).max() <= limits.slew * (1 + 1e-9)
        assert np.abs(np.diff(rate)).max(initial=0.0) * chosen.rate <= limits.acceleration * (1 + 1e-6)
        assert v[[0, -1]] == pytest.approx(rest, abs=1e-3)


@pytest.mark.parametrize("limits", LIMITS)
def test_every_drive_is_within_its_limits(limits):
    chosen = settings("xy", limits=(LIMITS[limits],) * 2, rest=(10.0, 0.0))
    require_within(checking(chosen), chosen)
    for drive in DRIVES:
        require_within(exciting(chosen, drive, 20.0, chosen.axes, 1), chosen)


@pytest.mark.parametrize("limits", LIMITS)
def test_the_verification_goes_through_the_compensator_within_its_limits(limits):
    chosen = settings("x", limits=(LIMITS[limits],), rest=(10.0,))
    recorder = SimulatedRecorder(stage_of(Character(), noise_rms=1e-9))
    calibration = exciting(chosen, "calibration", 40.0, chosen.axes, 1)
    model = identify(recorder(Request("calibration", calibration, {})).record)
    drive, desired = compensated(chosen, model, 7)
    require_within(drive, chosen)
    record = recorder(Request("verification", drive, desired)).record
    for axis in chosen.axes:
        error = record.displacement[axis] - desired[axis]
        error = error[np.isfinite(error)]
        assert error.size >= 20.0 * chosen.rate
        assert np.abs(error - np.median(error)).mean() < 2e-3 * np.ptp(record.displacement[axis])
    other = compensated(chosen, model, 8)[1]["x"]
    assert not np.allclose(np.nan_to_num(other)[: drive.t.size], np.nan_to_num(desired["x"])[: other.size], atol=1e-7)


@pytest.mark.parametrize(
    "limits", ["sluggish", *(pytest.param(name, marks=pytest.mark.long) for name in ("usual", "slow"))]
)
def test_a_given_path_is_driven_as_it_is(limits):
    chosen = settings("xy", limits=(LIMITS[limits],) * 2, rest=(10.0, 0.0))
    recorder = SimulatedRecorder(stage_of(Character(), Character(), noise_rms=1e-9))
    calibration = exciting(chosen, "calibration", 80.0, chosen.axes, 1)
    model = identify(recorder(Request("calibration", calibration, {})).record)
    low, high = model.axes["x"].displacement_range
    t = np.arange(600) / chosen.rate
    y = low + (high - low) * (0.5 + 0.05 * np.sin(2.0 * np.pi * t))
    own = replace(chosen, path={"x": y})
    assert own.verification == pytest.approx(3.0) and own.least < chosen.least
    drive, desired = compensated(own, model, 7)
    require_within(drive, chosen)
    windows = np.lib.stride_tricks.sliding_window_view(desired["x"], y.size)
    assert (windows == y).all(axis=1).any()
    assert np.nanmax(desired["y"]) == np.nanmin(desired["y"])
    record = recorder(Request("verification", drive, desired)).record
    error = (record.displacement["x"] - desired["x"])[np.isfinite(desired["x"])]
    assert np.abs(error).max() < 0.01 * (high - low)
    with pytest.raises(UnreachableError, match="desired_path: axis 'x'"):
        compensated(replace(chosen, path={"x": y + (high - low)}), model, 7)


@pytest.mark.parametrize(
    "wrong",
    [
        {"budget": 30.0},
        {"rest": (120.0,)},
        {"limits": (Limits(0.0, float("inf")),)},
        {"target": -1e-9},
        {"axes": ()},
    ],
)
def test_settings_that_allow_no_calibration_are_refused(wrong):
    with pytest.raises(UsageError):
        settings(**wrong)


def test_the_verification_undoes_a_delay():
    chosen = settings("x", rest=(10.0,))
    recorder = SimulatedRecorder(stage_of(Character(delay=0.01), noise_rms=1e-9))
    calibration = exciting(chosen, "calibration", 40.0, chosen.axes, 1)
    model = identify(recorder(Request("calibration", calibration, {})).record)
    late = replace(model, axes={"x": replace(model.axis("x"), effects=(Delay(0.01),))})
    drive, desired = compensated(chosen, late, 7)
    require_within(drive, chosen)
    slope = np.gradient(desired["x"], drive.t)
    for sent, least, most in [(drive, -1e-3, 1e-3), (compensated(chosen, late, 7, in_advance=False)[0], 9e-3, 11e-3)]:
        reached = late.simulate(drive.t, sent.voltage)["x"]
        known, error = slope[np.isfinite(slope)], (desired["x"] - reached)[np.isfinite(slope)]
        error -= error.mean()
        assert least < float(known @ error / (known @ known)) < most


def test_memory_and_creep_go_on_from_the_records_over_the_pause_before_a_verification():
    chosen = settings("x")
    recorder = SimulatedRecorder(stage_of(Character(), noise_rms=1e-9))
    before = recorder(Request("calibration", exciting(chosen, "calibration", 40.0, chosen.axes, 1), {})).record
    axis = identify(before).axis("x")
    creep = Creep((1.0, 10.0, 100.0), (0.02, 0.02, 0.02), axis.start.displacement)
    model = StageModel({"x": replace(axis, effects=(creep,))})
    for assumed, least, most in [(70.0, 0.0, 0.1e-9), (20.0, 10e-9, 50e-9)]:
        drive, desired = compensated(chosen, model, 7, [before], assumed)
        stamps = before.time_ns[-1] + np.round((70.0 + drive.t) * 1e9).astype(np.int64)
        t, v = driven_so_far([before, Record(stamps, drive.voltage, desired, "verification")])
        error = model.simulate(t, v)["x"][-drive.t.size :] - desired["x"]
        assert least <= abs(np.nanmedian(error)) < most
