"""Further records of a hidden stage, and small parts of ``benchmarks/next_record.py`` and ``start_memory.py``."""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import slpi_ros
from slpi_ros.diagnosis.result import AxisDiagnosis, Diagnosis, NamedEffect, Traces
from slpi_ros.effects.creep import Creep

BENCHMARKS = str(Path(__file__).resolve().parents[2] / "benchmarks")
RATE, SECONDS = 200.0, 8.0


@pytest.fixture(scope="module")
def benchmarks():
    """Return the modules under test, imported as scripts import them."""
    sys.path.append(BENCHMARKS)
    try:
        import hidden
        import next_record
        import start_memory

        yield {"hidden": hidden, "next_record": next_record, "start_memory": start_memory}
    finally:
        sys.path.remove(BENCHMARKS)


@pytest.fixture(scope="module")
def next_record(benchmarks):
    return benchmarks["next_record"]


@pytest.fixture(scope="module")
def stage(benchmarks):
    return benchmarks["hidden"].hide(7, ["lag", "hum"], base="preisach", axes=1, samples=6_000)


@pytest.fixture(scope="module")
def drive(benchmarks, stage):
    from hidden.drives import one_frequency

    from slpi_ros.excitation.legs import DriveSpec

    room = DriveSpec(0.0, float(stage.record.voltage["x"].max()), SECONDS, RATE)
    return {"x": one_frequency(room, 1.0, np.random.default_rng(3))}


def test_a_drive_of_one_frequency_has_one_and_covers_the_range(drive, stage):
    v = drive["x"]
    assert (v.min(), v.max()) == (0.0, stage.record.voltage["x"].max())
    turns = np.flatnonzero(np.diff(np.sign(np.diff(v))) != 0) + 1
    np.testing.assert_allclose(np.diff(turns) / RATE, 0.5, atol=1.5 / RATE)


def test_another_record_has_the_same_stage_and_its_own_history_zero_and_hum(benchmarks, stage, drive):
    again = benchmarks["hidden"].again
    one, same, other = (again(stage, number, drive, RATE) for number in (1, 1, 2))
    np.testing.assert_array_equal(one.record.displacement["x"], same.record.displacement["x"])
    np.testing.assert_array_equal(one.record.voltage["x"], other.record.voltage["x"])
    (lag, hum), (_, other_hum) = one.truth, other.truth
    assert lag.physics == stage.truth[0].physics
    assert replace(hum.physics.hum, phase=0.0) == replace(stage.truth[1].physics.hum, phase=0.0)
    assert len({each.physics.hum.phase for each in (stage.truth[1], hum, other_hum)}) == 3
    assert one.record.time_ns[0] != other.record.time_ns[0] and one.record.source != other.record.source
    # The history is forgotten once the drive was at both ends, but for the constant.
    apart = one.clean["x"] - other.clean["x"]
    swept = int(1.1 * RATE)
    assert np.ptp(apart[swept:]) < 1e-12 < np.ptp(apart)
    assert 1e-9 < abs(apart[-1]) < 2e-6
    np.testing.assert_allclose(np.std(one.record.displacement["x"] - one.reading["x"]), stage.floor["x"], rtol=0.1)


def test_contributions_of_another_record_are_what_is_missing_without(benchmarks, stage, drive):
    found = benchmarks["hidden"].again(stage, 1, drive, RATE)
    explained = sum(each.contribution for each in found.truth)
    np.testing.assert_allclose(found.reading["x"] - found.clean["x"], explained, atol=1e-12)


def test_drift_takes_another_course(benchmarks, drive):
    hidden = benchmarks["hidden"]
    stage = hidden.hide(3, ["thermal_drift", "gain_drift"], base="preisach", axes=1, samples=6_000)
    records = [hidden.again(stage, number, drive, RATE) for number in (1, 2)]
    for one, other, first in zip(*(record.truth for record in (*records, stage)), strict=True):
        assert one.physics != other.physics and type(one.physics)() != one.physics
        assert one.strength == other.strength == first.strength
        assert np.std(one.contribution - other.contribution) > 0.2 * np.std(one.contribution)


def test_the_advised_command_is_run(next_record):
    advice = "Record `slpi excite -o drive.csv --voltage-min 5 --voltage-max 85 --for creep`. And so on."
    options = ("--rate", f"{RATE:g}", "--duration", f"{SECONDS:g}")
    name, t, voltage = next_record.advised_drive(advice, *options)
    assert name == "creep" and t.size == voltage["x"].size == SECONDS * RATE + 1
    assert voltage["x"].min() == 5.0 and 70.0 < voltage["x"].max() <= 85.0
    assert next_record.advised_drive("Nothing to record.")[0] == ""


def test_a_third_record_begins_where_the_memory_is_known(next_record, benchmarks, stage, drive):
    draw = benchmarks["hidden"].again(stage, 3, drive, RATE, from_rest=True)
    judge = next_record.third_record(draw, "x", {"hum"})
    known = np.isfinite(judge.displacement["x"])
    assert not known[: int(0.9 * RATE)].any() and known[int(1.1 * RATE) :].all()
    gone = draw.record.displacement["x"] - judge.displacement["x"]
    np.testing.assert_allclose(gone[known], draw.truth[1].contribution[known], atol=1e-15)


def test_a_line_and_the_table_of_outcomes(next_record, capsys):
    case = next_record.Case("pair", 4, SECONDS, RATE)
    right = next_record.Outcome(case, ("lag", "hum"), "named", ("hum", "lag"), told=80.0, measured=75.0)
    wrong = replace(right, named=("hum", "creep"), measured=20.0)
    assert (right.right, right.invented, right.close) == (True, (), True)
    assert (wrong.right, wrong.invented, wrong.close) == (False, ("creep",), False)
    next_record.table([right, wrong, replace(right, failure="not drawn: ...")])
    assert capsys.readouterr().out.count("1 of 2") == 4


class Answers:
    """Stands for `slpi_ros.diagnose`, which takes too long here: ambiguous for one record, named for two."""

    def __init__(self):
        self.asked = []

    def __call__(self, records, model, axes=("x",)):
        records = [records] if isinstance(records, slpi_ros.Record) else records
        self.asked.append([record.source for record in records])
        alone = len(records) == 1
        effect = NamedEffect(Creep((1.0,), (0.01,)), 40.0, 0.5, 0.01, ("lag",) if alone else (), "", "")
        advice = "Record `slpi excite -o drive.csv --voltage-min 0 --voltage-max 60 --for creep`."
        verdict, advice = ("ambiguous", advice) if alone else ("named", None)
        no = np.zeros(0)
        traces = Traces(no, no, no, no, no)
        found = AxisDiagnosis(verdict, "", 1e-9, 1e-9, "", 1e-8, 1e-8, 6e-9, (effect,), advice, traces)
        # An effect that adds nothing to speak of.
        with_effect = {axis: replace(own, effects=(Creep((1.0,), (1e-9,)),)) for axis, own in model.axes.items()}
        return Diagnosis(dict.fromkeys(axes, found), model if alone else replace(model, axes=with_effect))


def test_an_ambiguous_record_and_the_advised_one(next_record, monkeypatch):
    answers = Answers()
    monkeypatch.setattr(slpi_ros, "diagnose", answers)
    outcome = next_record.run(next_record.Case("advised", 1, SECONDS, RATE))
    assert (outcome.truth, outcome.advice, outcome.first) == (("creep",), "creep", "creep/lag"), outcome.line()
    assert outcome.right and not outcome.invented and not outcome.failure
    assert [len(asked) for asked in answers.asked] == [1, 2]
    assert answers.asked[1][0] == answers.asked[0][0] != answers.asked[1][1]


@pytest.mark.slow
@pytest.mark.long
def test_a_pair_is_judged_on_a_third_record(next_record, monkeypatch):
    answers = Answers()
    monkeypatch.setattr(slpi_ros, "diagnose", answers)
    # Of pairs with these there is nothing to be judged on a third record.
    apart = {"gain_drift", "cross_coupling"}
    drawn = (next_record.run(next_record.Case("pair", seed, SECONDS, RATE)) for seed in range(1, 8))
    outcome = next(one for one in drawn if not (one.failure or apart & set(one.truth)))
    assert len(outcome.truth) == 2
    assert len(set(answers.asked[-1])) == 2
    # The model that was handed back is the given one but for next to nothing.
    assert (outcome.told, outcome.measured) == (pytest.approx(40.0), pytest.approx(0.0, abs=1e-3))


def test_one_memory(benchmarks):
    start = benchmarks["start_memory"]
    random = np.random.default_rng(0)
    t, v = start.calibration_drive(0.0, 100.0, duration=20.0, rate=start.RATE)
    model = slpi_ros.identify(start.record(0, t, v, np.zeros(0), 1.0, 0.0))
    t, v, before = start.drives(0, 8.0, random)
    for case in ("gain", "zero"):
        again = start.record(0, t, v, before, *start.CASES[case])
        assert set(start.judged(case, model, again, whole=True).values()) == {""}
