"""Further records of a hidden stage, and the drive that a diagnosis advises."""

from dataclasses import replace

import numpy as np
import pytest
from scripts import importable

RATE, SECONDS = 200.0, 8.0


@pytest.fixture(scope="module")
def benchmarks():
    """Return the modules under test, imported as scripts import them."""
    with importable("benchmarks"):
        import confusion
        import hidden

        yield {"hidden": hidden, "confusion": confusion}


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


def test_the_advised_command_is_run(benchmarks):
    advice = "Record `slpi excite -o drive.csv --voltage-min 5 --voltage-max 85 --for creep`. And so on."
    options = ("--rate", f"{RATE:g}", "--duration", f"{SECONDS:g}")
    name, t, voltage = benchmarks["confusion"].advised_drive(advice, *options)
    assert name == "creep" and t.size == voltage["x"].size == SECONDS * RATE + 1
    assert voltage["x"].min() == 5.0 and 70.0 < voltage["x"].max() <= 85.0
    assert benchmarks["confusion"].advised_drive("Nothing to record.")[0] == ""
