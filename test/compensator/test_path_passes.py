"""Passes of a path that comes again: recognised by content, whole or nothing, without what was late or held back."""

from types import SimpleNamespace

import numpy as np
import pytest

from slpi_ros.compensator.block import Block
from slpi_ros.compensator.path_passes import LATE, ComingAgain, PathPasses
from slpi_ros.compensator.statistics import TrackingStatistics
from slpi_ros.learning.repeated_paths import MOST_SAMPLES, SampledPath

PERIOD, MS = 1e-3, 1_000_000
N = 101
T_NS = np.arange(N, dtype=np.int64) * MS
Y = 1e-6 * (1.0 - np.cos(np.linspace(0.0, 2 * np.pi, N)))
START = 7_000 * MS


def sampled(y=Y, times=T_NS, names=("x",)):
    return SampledPath.of(names, times, np.column_stack([y] * len(names)), PERIOD)


def axis(name="x"):
    return SimpleNamespace(name=name, voltage=20.0, held=False, slewing=False, tracking=TrackingStatistics())


class Passes(PathPasses):
    """Passes, and which of them are to be learned from."""

    def __init__(self):
        super().__init__()
        self.again = ComingAgain()

    def ready(self, now_ns):
        return self.again.of(self.take(now_ns), self.corrections)

    @property
    def dropped(self):
        return self.again.dropped


def follow(passes, path, begin=START, learns=True, late=(), limited=None, one=None, read=lambda k: Y[k] + 3e-9):
    """Follow a pass from `begin` (ns) on; `late`: samples that are not output, `limited`: those by attribute."""
    one = one or axis()
    passes.begin(path, begin, begin - 5 * MS, PERIOD, learns)
    for k in range(N):
        now = begin + k * MS
        for attribute, samples in (limited or {}).items():
            setattr(one, attribute, k in samples)
        if k not in late:
            passes.output([one], now)
        if (value := read(k)) is not None:
            passes.read(["other", "x"], [1.0, value], now)
    return passes.ready(begin + 2 * N * MS)


def test_a_path_is_known_by_its_content_whatever_its_points():
    path = sampled()
    sparse = SampledPath.of(["x"], T_NS[:: N - 1], np.array([[0.0], [1e-6]]), PERIOD)
    dense = SampledPath.of(["x"], T_NS, np.linspace(0.0, 1e-6, N)[:, None], PERIOD)
    assert sparse.identity == dense.identity != path.identity
    assert sampled(Y + 2e-12).identity != path.identity
    assert sampled(times=T_NS * 2).identity != path.identity
    assert sampled(names=("y",)).identity != path.identity
    # The time until its first point is no part of the path.
    assert sampled(times=T_NS + MS).identity == path.identity
    assert sampled(times=T_NS + MS).start == pytest.approx(1e-3)


def test_what_is_too_short_is_no_path_and_a_long_one_is_learned_at_longer_intervals():
    assert SampledPath.of(["x"], [0], [[1e-6]], PERIOD) is None
    assert SampledPath.of(["x"], [0, 3 * MS], [[0.0], [1e-6]], PERIOD) is None
    long = SampledPath.of(["x"], [0, 100_000 * MS], [[0.0], [1e-6]], PERIOD)
    assert long.t.size == MOST_SAMPLES
    _, times, positions = long.corrected({"x": np.full(MOST_SAMPLES, 5e-9)}, PERIOD)
    # It is output at every period nevertheless.
    assert np.abs(np.diff(times) - MS).max() <= 1
    assert np.abs(positions[:, 0] - 5e-9 - np.linspace(0.0, 1e-6, times.size)).max() < 1e-14


def test_the_first_pass_is_remembered_and_learned_with_the_second():
    passes, path = Passes(), sampled()
    assert follow(passes, path) == []
    first, second = follow(passes, sampled(), START + 1_000 * MS)
    for one in (first, second):
        assert one.path.identity == path.identity and not one.dropped and not one.unusable
        assert one.measured["x"] == pytest.approx(Y + 3e-9, abs=1e-15)
        assert one.followed["x"] == pytest.approx(Y, abs=1e-15)
        assert one.voltage["x"] == pytest.approx(20.0)
    assert len(follow(passes, path, START + 2_000 * MS)) == 1


def test_a_correction_is_followed_and_is_not_what_was_desired():
    passes, path, one = Passes(), sampled(), axis()
    passes.corrections[path.identity] = {"x": np.linspace(0.0, 100e-9, N)}
    (done,) = follow(passes, path, one=one)
    assert done.followed["x"] == pytest.approx(Y + np.linspace(0.0, 100e-9, N), abs=1e-15)
    assert one.tracking.learned == pytest.approx(100e-9)
    one.tracking.desired = Y[-1] + 100e-9
    one.tracking.measure(Y[-1] + 3e-9)
    assert one.tracking.report().latest == pytest.approx(3e-9)


def test_passes_follow_each_other_without_a_pause():
    passes, path = Passes(), sampled()
    passes.corrections[path.identity] = {}
    length = (N - 1) * MS
    passes.begin(path, START, START - MS, PERIOD, True)
    one = axis()
    for k in range(2 * N - 1):
        if k == N // 2:
            # The next one is sent while this one is followed.
            passes.begin(path, START + length, START + k * MS, PERIOD, True)
        passes.output([one], START + k * MS)
        passes.read(["x"], [Y[k % (N - 1)]], START + k * MS)
    done = passes.ready(START + 2 * length + 1_000 * MS)
    assert [each.dropped for each in done] == ["", ""]
    for each in done:
        assert each.measured["x"] == pytest.approx(Y, abs=1e-15)


@pytest.mark.parametrize("how", ["cancelled", "replaced", "replaced later"])
def test_a_pass_that_does_not_end_tells_nothing(how):
    passes, path, other = Passes(), sampled(), sampled(2 * Y)
    passes.corrections[path.identity] = {}
    passes.begin(path, START, START, PERIOD, True)
    for k in range(50):
        passes.output([axis()], START + k * MS)
        passes.read(["x"], [Y[k]], START + k * MS)
    now = START + 50 * MS
    if how == "cancelled":
        passes.end(now)
        assert not passes.on
    else:
        passes.begin(other, now + 30 * MS if how == "replaced later" else 0, now, PERIOD, True)
    assert passes.ready(START + 10_000 * MS) == []


def test_a_pass_that_is_not_to_be_learned_still_tells_its_setpoints():
    passes, path, one = Passes(), sampled(), axis()
    passes.corrections[path.identity] = {"x": np.full(N, 8e-9)}
    assert follow(passes, path, learns=False, one=one) == []
    assert one.tracking.learned == 8e-9


def test_gaps_are_no_readings_and_too_many_of_them_tell_nothing():
    passes, path = Passes(), sampled()
    passes.corrections[path.identity] = {}
    (done,) = follow(passes, path, read=lambda k: None if 40 <= k < 48 else Y[k])
    assert np.flatnonzero(np.isnan(done.measured["x"])).tolist() == list(range(40, 48))
    assert follow(passes, path, START + 1_000 * MS, read=lambda k: None if 40 <= k < 60 else Y[k]) == []
    assert passes.dropped == "axis 'x': 20 % of its samples have no reading"
    assert follow(passes, path, START + 2_000 * MS, read=lambda _: None) == []
    assert passes.dropped == "axis 'x': 100 % of its samples have no reading"


def test_what_was_output_late_is_no_reading():
    passes, path = Passes(), sampled()
    passes.corrections[path.identity] = {}
    assert follow(passes, path, late=range(30, 60)) == []
    assert passes.dropped == "the computer was busy: the path was output up to 31 ms late"
    # A gap as long as that of one that is not late.
    (done,) = follow(passes, path, START + 1_000 * MS, late=range(30, 30 + round(LATE * 1e3) - 1))
    assert not np.isnan(done.measured["x"]).any()


@pytest.mark.parametrize(
    ("limited", "reason"),
    [
        ({"held": range(50, 60)}, "the voltage is held at a limit at 10 of its samples"),
        ({"slewing": range(50, 60)}, "slew_limit holds the voltage back at 10 of its samples"),
        ({"slewing": range(50, 52)}, None),
        # On the way to the first point.
        ({"slewing": range(5)}, None),
    ],
)
def test_what_a_limit_held_back_is_not_learned_from(limited, reason):
    passes, path = Passes(), sampled()
    passes.corrections[path.identity] = {}
    (done,) = follow(passes, path, limited=limited)
    assert done.unusable == ({"x": reason} if reason else {})
    missing = np.flatnonzero(np.isnan(done.measured["x"])).tolist()
    assert missing == (list(range(5)) if limited == {"slewing": range(5)} else [])


def test_a_path_that_repeats_is_learned_period_by_period_while_another_axis_moves_on():
    count, n = 5, N - 1
    times = np.arange(count * n + 1) * MS
    fast, slow = np.resize(Y[:-1], times.size), np.linspace(0.0, 3e-6, times.size)
    raster = np.column_stack([fast, slow])
    path = SampledPath.of(["x", "y"], times, raster, PERIOD, n * PERIOD)
    assert path.count == count and path.desired.keys() == {"x"} and path.desired["x"].size == n
    # As many lines more, and another slow axis: the same fast one.
    longer = SampledPath.of(["x", "y"], np.arange(2 * n + 1) * MS, raster[: 2 * n + 1] * [1.0, 2.0], PERIOD, n * PERIOD)
    assert longer.identity == path.identity
    # What does not repeat is one pass.
    assert SampledPath.of(["y"], times, slow[:, None], PERIOD, n * PERIOD).count == 1
    correction = np.linspace(0.0, 10e-9, n)
    _, out_ns, positions = path.corrected({"x": correction}, PERIOD)
    assert out_ns.tolist() == times.tolist()
    assert positions == pytest.approx(raster + np.column_stack([np.resize(correction, times.size), 0.0 * slow]))
    passes, one = Passes(), axis()
    passes.corrections[path.identity] = {"x": correction}
    passes.begin(path, START, START, PERIOD, True)
    for k in range(times.size):
        one.held = 250 <= k < 256
        passes.output([one, axis("y")], START + k * MS)
        passes.read(["x", "y"], [fast[k] + 1e-9 * (k // n), slow[k]], START + k * MS)
    done = passes.ready(START + 10_000 * MS)
    # The first one comes from elsewhere.
    assert [float(np.median(each.measured["x"] - Y[:-1])) for each in done] == pytest.approx([1e-9, 2e-9, 3e-9, 4e-9])
    assert [sorted(each.unusable) for each in done] == [[], ["x"], [], []]
    for each in done:
        assert each.followed["x"] == pytest.approx(Y[:-1] + correction, abs=1e-15)


def test_forgetting_begins_anew():
    passes, path = Passes(), sampled()
    passes.begin(path, START, START, PERIOD, True)
    passes.corrections[path.identity] = {"x": np.ones(N)}
    passes.forget()
    assert not passes.on and not passes.corrections
    assert follow(passes, path, START + 1_000 * MS) == []


LEAD_IN = 7


def block(stamp_ns=START, missed=""):
    """Return the block of the path, after a way to its beginning."""
    v = np.concatenate([np.linspace(10.0, 20.0, LEAD_IN), 20.0 + 1e6 * Y])
    return Block(stamp_ns, ("x",), PERIOD, v[:, None], LEAD_IN, missed)


def recorded(passes, one, late_ns=2 * MS, part=slice(None), volts=0.0):
    """Tell what a device has recorded of a block: readings and voltages."""
    read = np.concatenate([np.zeros(LEAD_IN), Y + 3e-9])[part, None]
    passes.recorded(one.stamp_ns + late_ns, ["x"], one.times_ns[part], read, one.voltages[part] + volts)
    return passes.ready(START + 10_000 * MS)


def test_a_pass_that_a_device_has_played_is_what_it_has_recorded():
    passes, path = Passes(), sampled()
    passes.corrections[path.identity] = {"x": np.full(N, 8e-9)}
    passes.begin_block(path, block(), True)
    assert not passes.on
    (done,) = recorded(passes, block())
    assert not done.dropped and not done.unusable
    assert done.measured["x"] == pytest.approx(Y + 3e-9, abs=1e-15)
    assert done.followed["x"] == pytest.approx(Y + 8e-9, abs=1e-15)
    assert done.voltage["x"] == pytest.approx(20.0 + 1e6 * Y)
    # It is told once.
    assert recorded(passes, block()) == []


def test_a_recording_of_something_else_tells_nothing():
    passes, path = Passes(), sampled()
    passes.corrections[path.identity] = {}
    for given in ({"late_ns": -1_000 * MS}, {"part": slice(0, N // 2)}, {"volts": 5.0}):
        passes.begin_block(path, block(), True)
        assert recorded(passes, block(), **given) == []
        passes.forget()
        passes.corrections[path.identity] = {}
    passes.begin_block(path, block(), False)
    assert recorded(passes, block()) == []
    # Of two blocks, the recording is that of the last one before it.
    for stamp in (START, START + 500 * MS):
        passes.begin_block(path, block(stamp), True)
    assert len(recorded(passes, block(START + 500 * MS))) == 1
    assert recorded(passes, block()) == []


def test_a_block_that_a_limit_holds_back_is_not_learned_from():
    passes, path = Passes(), sampled()
    passes.corrections[path.identity] = {}
    passes.begin_block(path, block(missed="axis 'x', 0.02 s after the beginning of the path: too fast"), True)
    (done,) = recorded(passes, block())
    assert "too fast" in done.unusable["x"]
