"""Records of one session: what a stage still remembers of those before."""

from dataclasses import replace

import numpy as np
import pytest

from slpi_ros.diagnosis.diagnose import diagnose
from slpi_ros.diagnosis.prepare import evidence_of, surviving
from slpi_ros.effects.base import EffectContext
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


def test_what_went_before_a_record_is_what_the_whole_path_says(records):
    """Creep of a path is that of its second part alone, and what the first part leaves."""
    creep = Creep((0.2, 3.0, 40.0), (0.02, 0.01, 0.03))
    t = np.arange(0.0, 60.0, 0.01)
    h = 1e-5 * np.sin(2.0 * np.pi * 0.13 * t) + 4e-6 * (t > 25.0) + 1e-7 * t
    whole = creep.apply(h, EffectContext.since_start(t))
    begin = 4000
    own = creep.apply(h[begin:], EffectContext(t[begin:] - t[begin], before=(t[:begin] - t[begin], h[:begin])))
    # The last move before the record begins is a hundredth of a second of it.
    assert np.ptp(own - whole[begin:]) < 2e-3 * np.ptp(whole - h)
    alone = creep.apply(h[begin:], EffectContext(t[begin:] - t[begin]))
    assert np.ptp(alone - whole[begin:]) > 0.2 * np.ptp(whole - h)
    at, back = creep.hysteresis_before((t, whole))
    assert np.array_equal(at, t)
    assert np.abs((back - back[0]) - (h - h[0])).max() < 1e-3 * np.ptp(whole - h)


def test_the_memory_is_known_after_the_whole_range_was_passed(records):
    model = identify(records[0]).axes["x"]
    first, second, third = evidence_of(in_session(records), "x", model).parts
    assert first.before is None
    for part in (second, third):
        assert part.used.all() and part.history == (0.0,)
        at, y = part.before
        assert at[-1] < -0.9 * PAUSE and np.all(np.diff(at) > 0.0) and at.size <= 1.01 * part.t.size
    small = replace(records[1], voltage={"x": 0.3 * records[1].voltage["x"]})
    unknown, alone = (
        evidence_of([replace(records[2], before=before)], "x", model).parts[0] for before in ((small,), ())
    )
    assert unknown.history == alone.history != (0.0,)


@pytest.mark.parametrize(
    ("turns", "left"),
    [
        ([0.0, 100.0, 0.0], [0.0]),
        ([0.0, 100.0, 20.0, 60.0, 40.0], [0.0, 100.0, 20.0, 60.0, 40.0]),
        ([0.0, 100.0, 20.0, 60.0, 10.0], [0.0, 100.0, 10.0]),
        ([50.0, 60.0, 40.0, 80.0], [40.0, 80.0]),
        ([0.0, 0.0], [0.0]),
    ],
)
def test_a_wider_move_wipes_out_reversals(turns, left):
    assert surviving(np.array(turns))[-len(left) :] == left


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
    # The readings of a voltage have noise, and an axis that waits has nothing else.
    scattered = [
        replace(each, voltage={"x": 50.0 + 0.02 * np.random.default_rng(k).standard_normal(len(each))})
        for k, each in enumerate(records)
    ]
    assert len(in_session(scattered)) == 3


def test_a_session_is_in_the_order_of_its_stamps(records):
    ordered = in_session(reversed(records))
    assert [each.source for each in ordered] == [*DRIVES]
    assert [len(each.before) for each in ordered] == [0, 1, 2]
