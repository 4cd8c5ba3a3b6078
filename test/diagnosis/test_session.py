"""Records of one session: what a stage still remembers of those before."""

from dataclasses import replace

import numpy as np
import pytest

from slpi_ros.diagnosis.diagnose import diagnose
from slpi_ros.diagnosis.prepare import drive_frequency, evidence_of
from slpi_ros.effects.creep import Creep
from slpi_ros.errors import UsageError
from slpi_ros.excitation.drives import excite
from slpi_ros.identification.fit import identify
from slpi_ros.io.record import Record
from slpi_ros.simulation.axis import SimulatedAxis
from slpi_ros.simulation.character import Character
from slpi_ros.simulation.dynamics import Creep as TrueCreep
from slpi_ros.simulation.parameters import AxisParameters
from slpi_ros.workflows.records import in_session

NOISE, PAUSE = 8e-9, 4.0
CREEP = Character(creep=0.025, creep_shortest=0.1, creep_longest=100.0)
DRIVES = {"calibration": 40.0, "creep": 25.0, "resonance": 25.0}
# Seconds after a step at which creep is compared.
LATER = np.array([1.0, 10.0, 20.0, 40.0])


@pytest.fixture(scope="module")
def records():
    axis, begin, made = SimulatedAxis(replace(AxisParameters.random(5), noise_rms=NOISE), 2, CREEP), 100.0, []
    for seed, (name, duration) in enumerate(DRIVES.items()):
        drive = excite(
            ("x",), voltage_min=0.0, voltage_max=100.0, slew_limit=400.0, duration=duration, rate=100.0, seed=seed,
            drive=name,
        )  # fmt: skip
        v = drive.voltage["x"]
        _, y = axis.run(begin + drive.t, v)
        made.append(Record(np.round((begin + drive.t) * 1e9).astype(np.int64), {"x": v}, {"x": y}, name))
        begin += float(drive.t[-1]) + PAUSE
    return made


def truth():
    creep, last, crept = TrueCreep(CREEP.creep, CREEP.creep_shortest, CREEP.creep_longest), 0.0, []
    creep.step(0.0, 0.0)
    creep.step(1e-9, 1.0)
    for t in LATER.tolist():
        crept.append(creep.step(t - last, 1.0) - 1.0)
        last = t
    return np.array(crept)


def found(records):
    """Return the creep after a step that a diagnosis finds, at `LATER`; faster one may be taken for hysteresis."""
    extended = diagnose(records, identify(records[0])).extended.axes["x"]
    [creep] = (effect for effect in extended.effects if isinstance(effect, Creep))
    times, gains = creep.chain
    return (gains * (1.0 - np.exp(-LATER[:, None] / times))).sum(axis=1)


def test_slow_creep_is_right_if_the_records_are_of_one_session(records):
    expected = truth()[1:] - truth()[0]
    session, apart = (
        np.abs((crept[1:] - crept[0]) / expected - 1.0) for crept in (found(in_session(records)), found(records))
    )
    assert session.max() < 0.05
    # Without it the slow part is fitted to what each record may have begun with.
    assert apart.max() > 2.0 * session.max()


def test_a_session_gives_the_voltages_before_a_record_and_no_reading(records):
    model = identify(records[0]).axes["x"]
    alone, after = (evidence_of([each[1]], "x", model).parts[0] for each in (records, in_session(records)))
    own = after.t >= 0.0
    assert np.array_equal(after.t[own], alone.t)
    assert np.allclose(after.v[own], alone.v, rtol=0.0, atol=1e-9)
    assert np.array_equal(after.y[own], alone.y)
    assert not after.used[~own].any() and not after.seen[~own].any()
    # Fewer samples of them do, as long as they hold the reversals.
    before, v = (records[0].time_ns - records[1].time_ns[0]) * 1e-9, records[0].voltage["x"]
    assert np.count_nonzero(~own) < v.size
    turns = np.flatnonzero(np.diff(np.sign(np.diff(v)))) + 1
    assert np.isin(v[turns], after.v[~own]).all()
    assert np.std(np.interp(before, after.t[~own], after.v[~own]) - v) < 0.01 * np.ptp(v)
    assert after.t[~own][-1] == pytest.approx(-PAUSE)
    assert np.all(np.diff(after.t) > 0.0)


def test_the_speed_of_a_record_is_that_of_its_own(records):
    t = np.arange(0.0, 20.0, 0.005)
    slow, fast = (
        Record(np.round((begin + t) * 1e9).astype(np.int64), {"x": v}, {"x": 1e-7 * v}, name)
        for begin, v, name in (
            (0.0, 50.0 * (1.0 - np.cos(2.0 * np.pi * 0.2 * t)), "slow"),
            (30.0, 50.0 * (1.0 - np.cos(2.0 * np.pi * 2.0 * t)), "fast"),
        )
    )
    evidence = evidence_of([replace(fast, before=(slow,))], "x", None)
    assert drive_frequency(evidence) == pytest.approx(2.0, rel=0.05)


def test_a_part_of_a_record_knows_the_rest_of_its_session(records):
    last = in_session(records)[2]
    part = last.part(slice(300, None))
    assert [each.source for each in part.before] == [*DRIVES]
    assert np.array_equal(part.before[-1].time_ns, last.time_ns[:300])
    assert last.part(slice(0, 100)).before == last.before
    assert records[2].part(slice(300, None)).before == ()


def test_records_of_other_sessions_are_refused(records):
    first, second, third = records
    moved = replace(third, voltage={"x": third.voltage["x"] + 5.0})
    with pytest.raises(UsageError, match="begins at 5 V"):
        in_session([first, second, moved])
    earlier = replace(second, time_ns=second.time_ns - 10 * 10**9)
    with pytest.raises(UsageError, match="overlap"):
        in_session([first, earlier])
    with pytest.raises(UsageError, match="no axis 'y'"):
        in_session([first, replace(second, voltage={"y": second.voltage["x"]}, displacement={"y": second.t})])


def test_a_session_is_in_the_order_of_its_stamps(records):
    ordered = in_session(reversed(records))
    assert [each.source for each in ordered] == [*DRIVES]
    assert [len(each.before) for each in ordered] == [0, 1, 2]
