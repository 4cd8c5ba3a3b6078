"""A model judged on records that it has not seen, and compensated paths."""

import json
from dataclasses import replace

import numpy as np
import pytest
from bag_makers import joint_state, rosbags_bag
from identification.records import calibration, record_of, rms, stage
from reports.browser import Browser
from reports.pages import parsed

import slpi_ros
import slpi_ros.io.bag_writer
from slpi_ros.cli import main
from slpi_ros.effects.base import EffectContext
from slpi_ros.effects.contact import Contact
from slpi_ros.effects.creep import Creep
from slpi_ros.errors import RecordError, UsageError
from slpi_ros.excitation.drives import calibration_drive
from slpi_ros.io.schemas import validate
from slpi_ros.reports.verification import (
    describe_verification,
    little_judged,
    verification_good,
    verification_limits,
)
from slpi_ros.verification.tracking import CAUSES
from slpi_ros.verification.verify import UNPROVED

SEED, RATE = 2, 200.0
# Voltages between which a stage was moved before a record; the last one leads to where the record begins.
HISTORIES = ((), (0, 100, 0), (100,), (0, 100, 60), (0, 100, 0, 70, 30), (100, 20, 80))


@pytest.fixture(scope="module")
def model():
    return slpi_ros.identify(calibration(SEED)[0])


def after(history, start=0.0):
    """Return a stage that was driven through voltages and then to the start of a record."""
    driven = stage(SEED)
    if history:
        turns = (*history, start)
        v = np.interp(np.arange(100 * len(turns)) / 100, np.arange(len(turns)), turns)
        driven.run(np.arange(v.size) / RATE, v)
    return driven


def unseen(history=(), gain=1.0, offset=0.0):
    t, v = calibration_drive(0.0, 100.0, duration=12.0, rate=RATE, seed=7)
    return record_of(t, v, gain * after(history, v[0]).run(t + 100.0, v)[1] + offset)


def small_loops(history):
    t = np.arange(2400) / RATE
    v = 50.0 - 10.0 * np.cos(2.0 * np.pi * t) * np.exp(-t / 20.0)
    return record_of(t, v, after(history, 40.0).run(t + 100.0, v)[1])


def judged(record, model, **options):
    found = slpi_ros.verify(record, model, **options)
    validate(found.to_document(), "verification", "test")
    return found.axes["x"].records[0]


@pytest.mark.parametrize("history", HISTORIES)
@pytest.mark.parametrize("record", [unseen, small_loops])
def test_whatever_went_before_an_unchanged_stage_passes(record, history, model):
    one = judged(record(history), model)
    assert one.passed and not one.zero_moved
    assert one.rest.rms < 1.2 * 8e-9 and one.share > 0.95
    assert abs(one.constant) <= one.offset_uncertainty


@pytest.mark.parametrize(
    ("gain", "own", "verdict"),
    [
        ((1.0,), ("0",), "unproved"),
        ((1.0, 1.0), ("0",), "passed"),
        ((1.03, 1.0), ("0",), "failed"),
        ((1.0, 1.03), ("0",), "failed"),
        ((1.0, 1.0), ("0", "1"), "unproved"),
        ((1.0, 1.03), ("0", "1"), "failed"),
    ],
)
def test_a_record_of_the_fit_only_counts_if_it_fails(gain, own, verdict, model):
    records = [replace(unseen(gain=each), source=str(k)) for k, each in enumerate(gain)]
    found = slpi_ros.verify(records, model, own=own)
    validate(found.to_document(), "verification", "test")
    assert found.verdict == verdict and found.passed == (verdict == "passed")
    assert all(one.verdict != "passed" for one in found.axes["x"].records if not one.independent)


@pytest.mark.parametrize("offset", [-0.93e-6, 0.2e-6])
def test_a_moved_zero_is_no_error_of_the_loops(offset, model):
    one = judged(unseen((100, 20, 80), offset=offset), model)
    assert one.passed and one.zero_moved
    assert one.offset == pytest.approx(offset, abs=0.1 * abs(offset))


@pytest.mark.parametrize("offset", [-0.93e-6, 0.2e-6])
def test_a_contact_moves_with_the_zero(offset, model):
    contact, x = Contact(8e-6, 0.5), model.axes["x"]
    touching = replace(model, axes={"x": replace(x, effects=(contact,))})
    record = unseen((100, 20, 80))
    y = contact.apply(record.displacement["x"], EffectContext(record.t)) + offset
    one = judged(replace(record, displacement={"x": y}), touching)
    assert one.passed and one.zero_moved
    assert one.offset == pytest.approx(offset, abs=0.1 * abs(offset))
    assert one.rest.rms < 1.1 * judged(record, model).rest.rms


def test_a_tolerance_holds_for_the_absolute_error(model):
    record = unseen(offset=1.5e-7)
    found = slpi_ros.verify(record, model, tolerance=5e-8, start_memory="start")
    assert verification_limits(found)["x"].startswith("the zero")
    one = found.axes["x"].records[0]
    assert one.absolute and not one.passed and one.constant == pytest.approx(1.5e-7, rel=0.1)
    assert one.error.rms == pytest.approx(np.hypot(one.constant, one.rest.rms), rel=0.02)
    assert judged(record, model, tolerance=5e-8, start_memory="start", without_offset=True).passed
    assert judged(record, model, tolerance=2e-7, start_memory="start").passed


def test_what_an_unknown_initial_state_may_hide_is_unproved(model):
    one = judged(small_loops(()), model, tolerance=2e-8)
    assert one.verdict == UNPROVED and one.offset_uncertainty > 2e-8 > one.rest.rms
    found = slpi_ros.verify([unseen(), small_loops(())], model, tolerance=2e-8, start_memory=None)
    assert found.verdict == UNPROVED and not found.passed


def test_a_record_that_begins_at_an_end_of_the_range_is_judged_from_its_first_sample(model):
    t = np.arange(2400) / RATE
    v = 35.0 - 35.0 * np.cos(2.0 * np.pi * t) * np.exp(-t / 30.0) - 35.0 * (1.0 - np.exp(-t / 30.0))
    v[0] = 0.0
    one = judged(record_of(t, v, stage(SEED).run(t, v)[1]), model)
    assert one.begins_known and one.known_from == 0.0 and one.share > 0.95 and one.passed


def test_few_judged_samples_are_told_beside_the_verdict(model):
    record = unseen()
    y = record.displacement["x"].copy()
    y[: int(0.6 * y.size)] = np.nan
    found = slpi_ros.verify(replace(record, displacement={"x": y}), model)
    share = found.axes["x"].records[0].share
    assert share < 0.5 and f"({share:.0%})" in little_judged(found)
    assert little_judged(slpi_ros.verify(record, model)) == ""


@pytest.mark.parametrize("span", [(2.0, None), (None, 9.0), (3.0, 8.0)])
def test_a_part_of_a_record(span, model):
    record, (start, stop) = unseen(), span
    one = judged(record, model, start=start, stop=stop)
    t = one.t[one.judged]
    assert t.min() >= (start or 0.0) and t.max() < (stop or np.inf) and one.passed


def test_moving_and_standing_are_told_apart(model):
    t, moving = np.arange(4800) / RATE, np.arange(4800) < 2400
    v = np.where(moving, 50.0 - 50.0 * np.cos(2.0 * np.pi * np.minimum(t, 12.0)), 0.0)
    y = stage(SEED).run(t, v)[1] + np.where(moving, 3e-8 * np.sin(50.0 * t), 0.0)
    one = judged(record_of(t, v, y), model)
    assert one.standing.rms < one.moving.rms
    assert one.standing.samples + one.moving.samples == one.error.samples
    assert one.standing.samples == pytest.approx(2400, abs=60)


@pytest.mark.parametrize("amplitude", [3e-9, 4e-8])
def test_line_interference_is_told_where_it_is_much_of_the_error(amplitude, model):
    record = unseen()
    y = record.displacement["x"] + amplitude * np.sin(2.0 * np.pi * 50.1 * record.t)
    found = slpi_ros.verify(replace(record, displacement={"x": y}), model)
    validate(found.to_document(), "verification", "test")
    one, told = found.axes["x"].records[0], "\n".join(describe_verification(found))
    if amplitude < one.repeatability_rms:
        assert one.lines is None and "interference" not in told
        return
    assert one.lines.share == pytest.approx(0.5 * amplitude**2 / one.rest.rms**2, abs=0.05)
    assert "50.1 Hz (40.1 nm)" in told and "interference" in verification_good(found)
    # Of a record that fails for it, it is no error of the model.
    failed = slpi_ros.verify(replace(record, displacement={"x": y}), model, tolerance=2e-8)
    assert "interference" in verification_limits(failed)["x"]
    assert "no error of the model" in "".join(describe_verification(failed))


def test_line_interference_is_no_hysteresis_of_a_path(model):
    t, desired = path(model)
    v = model.compensate(t, desired, start_memory="start")
    y = after((), 0.0).run(t + 100.0, v)[1] + 7e-8 * np.sin(2.0 * np.pi * 50.0 * t)
    found = slpi_ros.verify(record_of(t, v, y), model, tolerance=3e-8, desired=[{"x": desired + 3e-6}])
    tracking = found.axes["x"].records[0].tracking
    assert tracking.rms["noise"] == pytest.approx(7e-8 / np.sqrt(2.0), rel=0.1) and tracking.rms["model"] < 2e-8
    limits = verification_limits(found)["x"]
    assert limits.startswith("line interference") and "the path, 3" in limits


@pytest.mark.parametrize(("gain", "foreign"), [(1e-3, True), (0.8, False), (1.3, False), (1e3, True)])
def test_loops_of_quite_another_height_are_those_of_another_stage(gain, foreign, model):
    one = judged(unseen(gain=gain), model)
    assert not one.passed and one.foreign is foreign


@pytest.mark.parametrize("gain", [0.99, 1.02])
def test_a_changed_gain_fails_and_is_no_moved_zero(gain, model):
    one = judged(unseen(gain=gain), model)
    assert not one.passed and not one.zero_moved
    assert one.gain == pytest.approx(gain - 1.0, rel=0.2)
    assert judged(unseen(gain=gain), model, tolerance=1e-6).passed


def test_the_error_is_that_of_the_samples_judged(model):
    record = unseen()
    one = judged(record, model)
    assert one.known_from == pytest.approx(float(record.t[one.judged][0]))
    rest = (record.displacement["x"] - one.model)[one.judged]
    assert one.rest.rms == pytest.approx(rms(rest)) and one.rest.maximum == pytest.approx(np.abs(rest).max())
    error = rest + one.constant
    assert one.error.rms == pytest.approx(rms(error)) and one.error.maximum == pytest.approx(np.abs(error).max())
    found = slpi_ros.verify([record, small_loops(())], model).axes["x"]
    for parts in (found.by_level, found.by_speed, found.by_region):
        total = sum(part.samples * part.rms**2 for part in parts)
        assert np.sqrt(total / found.rest.samples) == pytest.approx(found.rest.rms)


def test_a_coupled_axis_is_judged_with_the_motion_of_the_other(model):
    t, v = calibration_drive(0.0, 100.0, duration=12.0, rate=RATE, seed=7)
    other = 50.0 - 50.0 * np.cos(2.0 * np.pi * t / 3.1)
    y, z = stage(SEED).run(t, v)[1], stage(SEED).run(t, other)[1]
    record = replace(record_of(t, v, y + 0.01 * z), voltage={"x": v, "z": other}, displacement={"x": y, "z": z})
    record = replace(record, displacement={"x": y + 0.01 * z, "z": z})
    effect = slpi_ros.effects.cross_coupling.CrossCoupling({"z": 0.01})
    axis = model.axes["x"]
    coupled = replace(model, axes={"x": replace(axis, effects=(effect,)), "z": axis})
    alone = replace(model, axes={"x": axis, "z": axis})
    assert slpi_ros.verify(record, coupled, axes=["x"]).passed
    assert not slpi_ros.verify(record, alone, axes=["x"]).passed


def test_explained_motion_of_another_axis_is_no_noise(model):
    """Else the limit, three times the repeatability, would let a bad model pass."""
    t = np.arange(4000) / RATE
    v, other = (50.0 - 50.0 * np.cos(2.0 * np.pi * t / period) for period in (1.0, 3.1))
    y, z = stage(SEED).run(t, v)[1], stage(SEED).run(t, other)[1]
    alone = judged(record_of(t, v, y), model)
    record = replace(record_of(t, v, y), voltage={"x": v, "z": other}, displacement={"x": y + 0.01 * z, "z": z})
    axis = model.axes["x"]
    effect = slpi_ros.effects.cross_coupling.CrossCoupling({"z": 0.01})
    coupled = replace(model, axes={"x": replace(axis, effects=(effect,)), "z": axis})
    found = slpi_ros.verify(record, coupled, axes=["x"]).axes["x"].records[0]
    assert found.repeatability_rms == pytest.approx(alone.repeatability_rms, rel=0.1)
    assert found.limit == pytest.approx(alone.limit, rel=0.1)


def test_what_does_not_go_together_is_refused(model):
    with pytest.raises(UsageError):
        slpi_ros.verify(replace(unseen(), hardware_id="a"), replace(model, hardware_id="b"))
    with pytest.raises(UsageError):
        slpi_ros.verify(
            replace(unseen(), voltage={"q": unseen().voltage["x"]}, displacement={"q": np.zeros(2401)}), model
        )
    for tolerance in (0.0, -1.0, np.nan):
        with pytest.raises(UsageError):
            slpi_ros.verify(unseen(), model, tolerance)
    with pytest.raises(RecordError):
        slpi_ros.verify(unseen(), model, desired=[{"x": np.full(len(unseen()), np.nan)}])


@pytest.mark.parametrize("moved", [0.0, 3e-6])
def test_a_record_need_not_begin_as_those_of_the_model(moved, model):
    creep = Creep((10.0,), (0.1,), initial=3e-6)
    creeping = replace(model, axes={"x": replace(model.axes["x"], effects=(creep,))})
    record = unseen((100, 20, 80))
    y = replace(creep, initial=moved).apply(record.displacement["x"], EffectContext.since_start(record.t))
    one, plain = judged(replace(record, displacement={"x": y}), creeping), judged(record, model)
    assert one.passed
    assert one.share == plain.share
    assert one.rest.rms < 1.1 * plain.rest.rms


def path(model):
    t = np.arange(3000) / RATE
    low, high = model.axes["x"].displacement_range
    return t, low + (high - low) * (0.5 + 0.3 * np.sin(4.4 * t) * np.cos(0.69 * t))


def tracked(model, history=(), limits=(0.0, 100.0), delay=0, gain=1.0, offset=0.0):
    """Return how a path was followed by a stage with another history, limits, delay, gain or zero."""
    t, desired = path(model)
    v = np.clip(model.compensate(t, desired, start_memory="start"), *limits)
    v = np.concatenate([np.full(delay, v[0]), v[: v.size - delay]])
    y = gain * after(history, 0.0).run(t + 100.0, v)[1] + offset
    return judged(record_of(t, v, y), model, desired=[{"x": desired}]).tracking


@pytest.mark.parametrize(
    "blame, cause",
    [
        ("noise", {}),
        ("memory", {"history": (0, 100, 0)}),
        ("memory", {"history": (0, 100, 30, 60)}),
        ("limits", {"limits": (0.0, 60.0)}),
        ("delay", {"delay": 8}),
        ("model", {"gain": 1.02}),
        ("zero", {"offset": -5e-7}),
    ],
)
def test_what_is_left_of_a_compensated_path_is_blamed_on_its_cause(blame, cause, model):
    tracking = tracked(model, **cause)
    assert tracking.blame == blame and tracking.shares[blame] > 0.7
    assert set(tracking.shares) == set(CAUSES) and sum(tracking.shares.values()) == pytest.approx(1.0)
    if blame == "delay":
        assert tracking.delay == pytest.approx(8 / RATE, rel=0.1)
        assert tracking.behind == 0.0 and "voltages" in tracking.advice("delay")


@pytest.mark.parametrize("shift", [0.0, 4e-7])
def test_a_late_stage_is_told_from_its_hysteresis_and_zero(shift, model):
    t, desired = path(model)
    v = model.compensate(t, desired, start_memory="start")
    y = after((), 0.0).run(t + 100.0, v)[1]
    late = 3
    y = np.concatenate([np.full(late, y[0]), y[:-late]])
    tracking = judged(record_of(t, v, y), model, desired=[{"x": desired + shift}]).tracking
    parts = tracking.rms
    assert tracking.delay == tracking.behind == pytest.approx(late / RATE, rel=0.1)
    # A trajectory sends nothing ahead by a delay that the model does not hold.
    assert "slpi diagnose" in tracking.advice("delay")
    assert parts["delay"] == pytest.approx(rms(y - np.interp(t, t - late / RATE, y)), rel=0.15)
    # A path that counts from another zero.
    assert parts["zero"] == pytest.approx(shift, abs=0.2 * parts["delay"])
    assert max(parts["model"], parts["rate"], parts["command"]) < 0.3 * parts["delay"]


def test_what_goes_with_the_logarithm_of_the_rate_is_a_rate_dependence(model):
    t, desired = path(model)
    v = model.compensate(t, desired, start_memory="start")
    speed = np.gradient(desired, t)
    y = desired + 2e-8 * np.sign(speed) * np.log1p(np.abs(speed) / 1e-6)
    tracking = judged(record_of(t, v, y), model, desired=[{"x": desired}]).tracking
    assert tracking.shares["rate"] > 0.0 and tracking.delay == 0.0
    assert tracking.shares["delay"] == pytest.approx(0.0, abs=1e-6)
    assert tracking.shares["rate"] + tracking.shares["model"] > 0.9


@pytest.mark.parametrize("lost", [0, 30])
def test_times_at_which_a_path_is_off_are_told_with_gaps_of_the_record(lost, model):
    t, desired = path(model)
    v = model.compensate(t, desired, start_memory="start")
    # The voltage stands still for a while, and no reading comes.
    begin, end = 1500, 1600
    v[begin:end] = v[begin]
    kept = np.ones(t.size, bool)
    kept[end - lost : end] = False
    y = after((), 0.0).run(t + 100.0, v)[1]
    record = record_of(t[kept], v[kept], y[kept])
    found = slpi_ros.verify(record, model, desired=[{"x": desired[kept]}])
    tracking, told = found.axes["x"].records[0].tracking, "\n".join(describe_verification(found))
    burst = tracking.burst
    assert burst.share > 0.9 and burst.elsewhere < 2.5 * 8e-9 < tracking.rest_rms
    ((first, last),) = burst.times
    assert first == pytest.approx(t[begin], abs=0.2) and last == pytest.approx(t[end], abs=0.2)
    assert burst.gap == (pytest.approx((lost + 1) / RATE) if lost else 0.0)
    assert ("busy" in verification_limits(found)["x"]) == ("no reading" in told) == bool(lost)


def test_a_delay_that_varies_is_told_apart(model):
    t, desired = path(model)
    sent = model.compensate(t, desired, start_memory="start")
    delays = 0.05 * (1.0 + np.sin(0.8 * t))
    v = np.interp(t - delays, t, sent)
    found = slpi_ros.verify(record_of(t, v, after((), 0.0).run(t + 100.0, v)[1]), model, desired=[{"x": desired}])
    validate(found.to_document(), "verification", "test")
    tracking = found.axes["x"].records[0].tracking
    assert tracking.blame == "delay" and tracking.shares["delay"] > 0.9
    assert tracking.delays == pytest.approx((0.0, 0.1), abs=0.015)
    assert "varies" in "".join(describe_verification(found)) and "busy" in tracking.advice("delay")


@pytest.mark.parametrize("late", [0, 4])
def test_a_step_that_the_slew_limit_held_back_is_no_delay_of_the_path(late, model):
    t, _ = path(model)
    low, high = model.axes["x"].displacement_range
    desired = low + (high - low) * (0.3 + 0.1 * np.sin(4.4 * t) + 0.3 * (t > 7.0))
    v = model.compensate(t, desired, start_memory="start")
    for k, most in zip(range(1, v.size), np.diff(t) * 150.0, strict=True):
        v[k] = np.clip(v[k], v[k - 1] - most, v[k - 1] + most)
    v = np.concatenate([np.full(late, v[0]), v[: v.size - late]])
    y = after((), 0.0).run(t + 100.0, v)[1]
    tracking = judged(record_of(t, v, y), model, desired=[{"x": desired}]).tracking
    assert tracking.delay == pytest.approx(late / RATE, abs=0.5 / RATE) and tracking.delays is None
    assert tracking.shares["command"] > 0.4


@pytest.mark.parametrize(("gain", "volts"), [(0.98, 0.0), (1.0, 2.0)])
def test_voltages_of_another_model_are_no_delay(gain, volts, model):
    t, desired = path(model)
    v = np.clip(gain * model.compensate(t, desired, start_memory="start") + volts * np.sin(0.7 * t), 0.0, 100.0)
    tracking = judged(record_of(t, v, after((), 0.0).run(t + 100.0, v)[1]), model, desired=[{"x": desired}]).tracking
    assert tracking.delays is None and tracking.shares["delay"] < 0.1


def test_an_error_all_along_a_path_has_no_times(model):
    assert tracked(model).burst is None and tracked(model, gain=1.02).burst is None


def test_parts_of_the_error_add_up(model):
    tracking = tracked(model, (100, 20, 80), (0.0, 70.0), 2, 1.0, 1e-7)
    error = np.sum(list(tracking.parts.values()), axis=0)
    assert rms(error) == pytest.approx(tracking.error.rms)


@pytest.fixture(scope="module")
def folder(tmp_path_factory, model):
    """A model, a bag that passes, one that fails, and one of a path that was compensated from a wrong memory."""
    folder = tmp_path_factory.mktemp("verify")
    slpi_ros.save_model(model, folder / "model.json")
    slpi_ros.io.bag_writer.write_bag(folder / "good", unseen((100,), offset=-0.93e-6))
    slpi_ros.io.bag_writer.write_bag(folder / "bad", unseen(gain=1.02))
    t, desired = path(model)
    v = model.compensate(t, desired, start_memory="start")
    y = after((0, 100, 0)).run(t + 100.0, v)[1]
    stamps = np.round(t * 1e9).astype(np.int64).tolist()
    topics = {
        "/desired_displacement": [
            (s, joint_state(s, position=(d,), effort=())) for s, d in zip(stamps, desired, strict=True)
        ],
        "/stage_state": [
            (s + 10**6, joint_state(s + 10**6, position=(m,), effort=(u,)))
            for s, m, u in zip(stamps, y, v, strict=True)
        ],
    }
    rosbags_bag(folder / "tracked", topics)
    return folder


@pytest.fixture
def slpi(capsys):
    """Return a function that runs a command: exit code, standard output and error."""

    def run(*arguments):
        try:
            code = main(["verify", *map(str, arguments)])
        except SystemExit as stop:
            code = stop.code
        said = capsys.readouterr()
        return code, said.out, said.err

    return run


def test_command_passes_fails_and_writes(slpi, folder, tmp_path):
    code, said, complaint = slpi(folder / "good", "--model", folder / "model.json", "-o", tmp_path / "out")
    assert code == 0 and "-0.93" in said and not complaint
    document = json.loads((tmp_path / "out" / "verification.json").read_text())
    validate(document, "verification", "test")
    assert document["passed"] and document["axes"]["x"]["records"][0]["zero_moved"]
    assert parsed(tmp_path / "out" / "report.html").texts["verdict-x"].startswith("passed")
    both = (folder / "good", folder / "bad", "--model", folder / "model.json")
    code, said, _ = slpi(*both, "--json")
    assert code == 1 and [one["passed"] for one in json.loads(said)["axes"]["x"]["records"]] == [True, False]
    assert slpi(*both, "--tolerance", "1.0")[0] == 0


@pytest.mark.parametrize(
    "options", [("--tolerance", "0"), ("--tolerance", "nan"), ("--axis", "x", "x"), ("--clock", "voltage")]
)
def test_wrong_usage_is_told_apart_from_failure(slpi, folder, options):
    code, said, complaint = slpi(folder / "good", "--model", folder / "model.json", *options)
    assert code == 2 and not said and len(complaint.splitlines()) == 1


def test_data_that_do_not_allow_it_are_told_in_one_line(slpi, folder, tmp_path):
    for arguments in (
        (folder / "none", "--model", folder / "model.json"),
        (folder / "good", "--model", folder / "none.json"),
        (folder / "good", "--model", folder / "model.json", "--axis", "q"),
        (folder / "good", "--model", folder / "model.json", "--desired-topic", "stage_voltage"),
        (folder / "good", "--model", folder / "model.json", "-o", folder / "model.json"),
    ):
        code, said, complaint = slpi(*arguments)
        assert code == 1 and not said and len(complaint.splitlines()) == 1, arguments


def test_page_of_a_compensated_path_in_a_browser(slpi, folder, tmp_path):
    code, said, _ = slpi(folder / "tracked", "--model", folder / "model.json", "-o", tmp_path / "out")
    assert code == 0 and "memory" in said
    tracking = json.loads((tmp_path / "out" / "verification.json").read_text())["axes"]["x"]["records"][0]["tracking"]
    assert tracking["blame"] == "memory" and tracking["shares"]["memory"] > 0.7
    page = tmp_path / "out" / "report.html"
    browser = Browser(tmp_path / "profile")
    try:
        browser.open(page)
        assert browser.run("document.querySelectorAll('.js-plotly-plot').length") == len(parsed(page).charts) == 4
        assert not browser.complaints()
        assert [url for url in browser.fetched() if not url.startswith(("data:", "blob:"))] == [page.as_uri()]
    finally:
        browser.close()
