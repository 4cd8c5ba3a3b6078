"""A whole calibration on simulated stages, without ROS."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from calibration.stages import RATE, SimulatedRecorder, settings, stage_of
from refusals import holds
from strategies import FAMILY_CASE, axis_model

from slpi_ros.calibration.run import (
    Recording,
    aligned,
    before_path,
    calibrate,
    moved_zeros,
    reading_rate,
    switched_off,
    tracking_error,
    why,
    with_present_zero,
)
from slpi_ros.effects.creep import Creep
from slpi_ros.effects.delay import Delay
from slpi_ros.effects.thermal_drift import ThermalDrift
from slpi_ros.errors import IdentificationError, RecordError, SlpiError, length
from slpi_ros.io.record import Record
from slpi_ros.model.stage_model import StageModel
from slpi_ros.reports.calibration import write_files
from slpi_ros.simulation.character import Character


class Ended(SlpiError):
    """Raised by a recorder that is interrupted."""


def without(record, lost):
    """Return a record without the samples of a slice."""
    kept = np.delete(np.arange(len(record)), lost)
    signals = ({axis: x[kept] for axis, x in each.items()} for each in (record.voltage, record.displacement))
    return Record(record.time_ns[kept], *signals, record.source, record.hardware_id)


class Spoiled(SimulatedRecorder):
    """A recorder whose record of the check is spoiled."""

    def __init__(self, spoil):
        super().__init__(stage_of(Character()))
        self._spoil = spoil

    def __call__(self, request):
        record = super().__call__(request).record
        voltage, displacement = self._spoil(record.voltage["x"], record.displacement["x"])
        return Recording(Record(record.time_ns, {"x": voltage}, {"x": displacement}, record.source), {})


@pytest.mark.parametrize(
    "spoil",
    [
        lambda v, y: (v, -y),
        lambda v, y: (v, np.random.default_rng(0).normal(0.0, 1e-8, y.size)),
        lambda v, y: (0.3 * v, y),
        lambda v, y: (np.zeros_like(v), y),
        lambda v, y: (v, np.full_like(y, np.nan)),
    ],
    ids=["wrong sense", "no motion", "weak amplifier", "no voltage", "no reading"],
)
def test_a_stage_that_does_not_follow_is_not_driven_further(spoil):
    recorder = Spoiled(spoil)
    with pytest.raises(RecordError, match="'x'"):
        calibrate(settings(), recorder)
    assert [request.name for request in recorder.requests] == ["01_check"]


WRONG_UNITS = {
    "millimetres for micrometres": lambda v, y: (v, 1e-3 * y),
    "nanometres for micrometres": lambda v, y: (v, 1e3 * y),
    "noise of no sensor": lambda v, y: (v, 1e-6 * v + 1e-14 * np.random.default_rng(0).standard_normal(v.size)),
}


@pytest.mark.parametrize("name", WRONG_UNITS)
def test_a_stroke_or_noise_of_no_stage_is_not_driven_further(name):
    recorder = Spoiled(WRONG_UNITS[name])
    with pytest.raises(RecordError, match="accept_units"):
        calibrate(settings(), recorder)
    assert [request.name for request in recorder.requests] == ["01_check"]
    lowest, highest = (each(recorder.requests[0].drive.voltage["x"]) for each in (np.min, np.max))
    assert highest - lowest < 50.0


def test_it_goes_on_where_the_units_are_accepted():
    class Until(Spoiled):
        def __call__(self, request):
            if request.name != "01_check":
                raise Ended
            return super().__call__(request)

    with pytest.raises(Ended):
        calibrate(settings(accept_units=True), Until(WRONG_UNITS["millimetres for micrometres"]))


def test_a_record_that_allows_no_fit_ends_it():
    class Coarse(SimulatedRecorder):
        def __call__(self, request):
            recording = super().__call__(request)
            y = recording.record.displacement["x"]
            digit = 0.12 * np.ptp(y) if request.name != "01_check" else 1e-12
            return replace(recording, record=replace(recording.record, displacement={"x": np.round(y / digit) * digit}))

    recorder = Coarse(stage_of(Character()))
    with pytest.raises(IdentificationError, match="too coarse"):
        calibrate(settings(), recorder)
    assert len(recorder.requests) == 2


@pytest.mark.slow
def test_what_was_recorded_leads_to_the_same_drives_again():
    class Until(SimulatedRecorder):
        def __call__(self, request):
            if len(self.requests) == 3:
                raise Ended
            return super().__call__(request)

    first = Until(stage_of(Character(lag=0.004)))
    with pytest.raises(Ended):
        calibrate(settings(), first)
    kept = {recording.record.source: recording for recording in first.recordings}
    asked = []

    def again(request):
        asked.append(request)
        if request.name not in kept:
            raise Ended
        return kept[request.name]

    with pytest.raises(Ended):
        calibrate(settings(), again)
    assert [request.name for request in asked] == ["01_check", "02_calibration", "04_verification", "05_creep"]
    for before, after in zip(first.requests, asked, strict=False):
        assert np.array_equal(before.drive.voltage["x"], after.drive.voltage["x"])


def test_transport_between_command_and_reading_is_not_an_error_of_the_stage():
    t = np.arange(2000) / 200.0
    v = 50.0 + 40.0 * np.sin(2.0 * t)
    late = 0.0137
    applied = 50.0 + 40.0 * np.sin(2.0 * (t - late))
    record = Record(np.round(t * 1e9).astype(np.int64), {"x": applied}, {"x": 1e-7 * applied})
    found = aligned(record, record.time_ns, {"x": v}, {"x": 1e-7 * v})
    error = (record.displacement["x"] - found.desired["x"])[20:]
    assert np.abs(error).max() < 5e-9


def error_of(stage_error, goal=20e-9):
    """What is told of a path on which the stage is off by `stage_error` (m, by sample)."""
    t = np.arange(stage_error.size) / 200.0
    desired = 1e-5 + 5e-6 * np.sin(t)
    record = Record(np.round(t * 1e9).astype(np.int64), {"x": t}, {"x": desired + stage_error})
    return tracking_error(Recording(record, {"x": desired}), "x", MODEL, goal)


MODEL = StageModel({"x": replace(axis_model(FAMILY_CASE), displacement_range=(0.0, 20e-6))})


def test_errors_are_absolute_and_the_latest_verification_counts():
    scatter = np.random.default_rng(0).normal(0.0, 8e-9, 4000)
    first, moved = error_of(scatter), error_of(scatter + 60e-9)
    assert first.met and not moved.met
    assert moved.mean == pytest.approx(60e-9, rel=0.01)
    assert (moved.offset, moved.rest) == (pytest.approx(60e-9, rel=0.01), pytest.approx(first.rest, rel=1e-6))
    diagnosis = SimpleNamespace(axes={"x": SimpleNamespace(effects=())})
    said = why([{"x": first}, {"x": moved}], diagnosis, "the time budget is spent")
    risen = f"{length(first.mean)} to {length(moved.mean)}"
    assert said.startswith("target not met") and risen in said and "~/set_zero" in said
    assert why([{"x": moved}, {"x": first}], diagnosis, "").startswith("target met")


def test_a_delay_is_told_as_undone_on_a_trajectory_alone():
    for effect, told in [
        (Delay(4.8e-3), ["4.8 ms", "trajectory"]),
        (ThermalDrift((0.0, 1.0), (0.0, 0.0)), ["feedback"]),
    ]:
        axis = SimpleNamespace(effects=(SimpleNamespace(effect=effect),))
        said = why([{"x": error_of(np.full(100, 1e-9))}], SimpleNamespace(axes={"x": axis}), "")
        assert all(each in said for each in told) and ("feedback" in said) == (told == ["feedback"])


def test_lengths_are_told_in_their_own_unit():
    error = error_of(np.full(4000, 4.6e-6))
    assert length(error.offset) == "4.6 µm" and "offset 4.6 µm" in error.told() and "e+" not in error.told()


def test_the_zero_of_a_model_is_that_of_the_last_record():
    creep = Creep((0.5, 20.0), (0.02, 0.03))
    model = StageModel({"x": replace(MODEL.axes["x"], effects=(creep,))})
    t = np.arange(4000) / 200.0
    v = 50.0 - 50.0 * np.cos(t)
    stamps = np.round(t * 1e9).astype(np.int64)
    seen = model.simulate(np.append(t, t + 120.0), {"x": np.append(v, v)})["x"]
    records = [
        Record(stamps, {"x": v}, {"x": seen[:4000]}),
        Record(stamps + 120 * 10**9, {"x": v}, {"x": seen[4000:] + 0.3e-6}),
    ]
    axis = with_present_zero(model, records).axes["x"]
    assert axis.start.displacement - model.axes["x"].start.displacement == pytest.approx(0.3e-6, abs=1e-12)
    # The same motion, elsewhere.
    moved = axis.simulate(t, v) - model.axes["x"].simulate(t, v)
    np.testing.assert_allclose(moved, 0.3e-6, rtol=0, atol=1e-12)


def test_the_zero_of_a_verification_is_that_of_the_sweep_before_its_path():
    t = np.arange(4000) / 200.0
    v = 50.0 - 50.0 * np.cos(t)
    seen = MODEL.simulate(np.append(t, t + 20.0), {"x": np.append(v, v)})["x"]
    stamps = np.round(t * 1e9).astype(np.int64)
    before = Record(stamps, {"x": v}, {"x": seen[:4000]})
    # The zero moves between the records, and again before the path, which is an error.
    own = seen[4000:] + np.where(t < 10.0, 0.3e-6, 0.32e-6)
    desired = np.where(t < 10.0, np.nan, seen[4000:])
    recording = Recording(Record(stamps + 20 * 10**9, {"x": v}, {"x": own}), {"x": desired})
    moved = moved_zeros(MODEL, [before, before_path(recording)])["x"]
    assert moved == pytest.approx(0.3e-6, abs=1e-12)
    assert tracking_error(recording, "x", MODEL, 1e-8, moved).mean == pytest.approx(0.02e-6, abs=1e-12)


def test_the_rate_of_readings_is_that_of_the_sensor_not_of_the_messages():
    t = np.arange(4000) / RATE
    v = 50.0 - 50.0 * np.cos(t)
    y = MODEL.simulate(t, {"x": v})["x"] + np.random.default_rng(0).normal(0.0, 8e-9, t.size)
    record = Record(np.round(t * 1e9).astype(np.int64), {"x": v}, {"x": y})
    held = replace(record, displacement={"x": y[np.arange(t.size) // 5 * 5]})
    assert reading_rate(record, "x") == pytest.approx(RATE)
    assert reading_rate(held, "x") == pytest.approx(RATE / 5, rel=0.01)


def test_why_feedback_was_switched_off_is_not_known_of_a_kept_record():
    recording = Recording(Record(np.arange(2), {"x": np.zeros(2)}, {"x": np.zeros(2)}), {}, off="it oscillated")
    assert switched_off(recording).endswith("it oscillated") and not switched_off(replace(recording, off=""))
    assert "not known" in switched_off(replace(recording, kept=True, off=""))


@pytest.mark.slow
def test_a_hidden_cause_is_named_and_undone(tmp_path):
    recorder, steps = SimulatedRecorder(stage_of(Character(creep=0.015))), []
    outcome = calibrate(settings(), recorder, steps.append, lambda: recorder.now)
    assert outcome.met and outcome.seconds <= outcome.settings.budget
    assert [effect.name for effect in outcome.diagnosis.axes["x"].effects] == ["creep"]
    error = outcome.errors["x"]
    assert error.mean < 5e-4 * error.stroke
    verified = [step for step in outcome.steps if step.errors]
    first = verified[0].errors["x"]
    assert error.mean < 0.5 * first.mean
    assert [step.extended for step in verified] == [frozenset(), frozenset({"x"})]
    # The compensator starts where the last drive has left the stage.
    last = recorder.recordings[-1].record
    assert outcome.model.axes["x"].end.voltage == pytest.approx(last.voltage["x"][-1], abs=0.01)
    model = outcome.model.axes["x"]
    memory = model.memory("end")
    assert memory.displacement == pytest.approx(model.simulate(last.t, last.voltage["x"])[-1], abs=0.5e-6)
    assert list(dict.fromkeys(progress.step for progress in steps)) == list(range(1, len(outcome.steps) + 1))
    write_files(tmp_path, outcome)
    assert {path.name for path in tmp_path.iterdir()} == {"model.json", "report.html", "diagnosis"}
    page = (tmp_path / "report.html").read_text()
    assert all(step.name in page for step in outcome.steps)


@pytest.mark.long
def test_a_sensor_that_is_slower_than_the_record_and_lost_messages_are_told(tmp_path):
    class Held(SimulatedRecorder):
        def __call__(self, request):
            recording = super().__call__(request)
            (y,) = recording.record.displacement.values()
            record = replace(recording.record, displacement={"x": y[np.arange(y.size) // 2 * 2]})
            if request.name == "02_calibration":
                record = without(record, slice(2000, 2100))
            return replace(recording, record=record)

    recorder, progress = Held(stage_of(Character())), []
    outcome = calibrate(settings(), recorder, progress.append, lambda: recorder.now)
    assert outcome.met
    (lost,) = (step for step in outcome.steps if step.missing)
    assert lost.name == "02_calibration" and holds(lost.missing[0].text, 100)
    assert [said.missing for said in progress if said.missing] == [lost.missing]
    write_files(tmp_path, outcome)
    assert lost.missing[0].text in (tmp_path / "report.html").read_text()
    told = [step.finding for step in outcome.steps if step.name.endswith("_calibration")]
    assert told and all(holds(finding, 2, round(RATE / 2)) for finding in told)
