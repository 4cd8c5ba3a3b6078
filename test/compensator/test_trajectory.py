"""Trajectories: a block is what its samples are one by one, points come at their time, and nothing else moves."""

from dataclasses import dataclass, replace
from itertools import pairwise
from math import inf
from unittest import mock

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from strategies import FAMILY_CASE, PI_CASE, Case, axis_model, cases, fractions, paths

from slpi_ros.compensator import trajectory as deadlines
from slpi_ros.compensator import validation as rejection
from slpi_ros.compensator.trajectory import Plan, Standing, Streamer, Trajectory, prepare
from slpi_ros.compensator.validation import RejectedError
from slpi_ros.errors import SlpiError
from slpi_ros.model.axis_model import AxisModel
from slpi_ros.model.limits import MAX_DT, Limits
from slpi_ros.model.streaming import StreamingInverse, accepted_range

MS = 1_000_000
# A pause of 100 ms is the longest that counts in full.
STEPS = (1, 1000, MS, 7 * MS, 100 * MS, 100 * MS + 1, 3000 * MS)


@dataclass(frozen=True)
class Drawn:
    """An axis, what it went through, and a path for it."""

    case: Case
    model: AxisModel
    limits: Limits
    history: list[float]
    times: np.ndarray
    y: np.ndarray
    since: int

    def standing(self) -> Standing:
        stream = self.model.stream(self.limits)
        for v in self.history:
            stream.drive(stream.limits.clip(v))
        return Standing(self.model, stream, self.since)

    def trajectory(self, start_ns: int = 0) -> Trajectory:
        return Trajectory.of(["x"], self.times, self.y[:, None], start_ns, axes=["x"])


@st.composite
def times_of(draw: st.DrawFn, count: int) -> np.ndarray:
    steps = draw(st.lists(st.sampled_from(STEPS), min_size=1, max_size=6))
    first = draw(st.sampled_from((0, 5 * MS, 10_000 * MS)))
    return first + np.cumsum([0, *(steps[i % len(steps)] for i in range(count - 1))])


SLOW = st.sampled_from((inf,)) | fractions(1, 3000)
NONE = st.just(inf)


@st.composite
def drawn_axes(
    draw: st.DrawFn, slew: st.SearchStrategy[float] = SLOW, acceleration: st.SearchStrategy[float] = NONE
) -> Drawn:
    case = draw(cases())
    low, high = sorted(draw(st.tuples(fractions(0, 1), fractions(0, 1))))
    limits = Limits(case.span[0] + low * case.width, case.span[0] + high * case.width, draw(slew), draw(acceleration))
    model = axis_model(case)
    y = np.clip(case.displacements(draw(paths(case))), *accepted_range(model.displacement_range))
    history = draw(st.lists(fractions(0, 1).map(lambda share: case.span[0] + share * case.width), max_size=4))
    since = draw(st.sampled_from((0, 10**18 - 3 * MS, 10**18, 10**18 + MS)))
    return Drawn(case, model, limits, history, draw(times_of(y.size)), y, since)


def one_by_one(
    stream: StreamingInverse, y: np.ndarray, due: np.ndarray, since: int
) -> tuple[list[float], list[bool], list[bool]]:
    """Voltages, where held and where slewed, by `AxisStream.move` and nothing else."""
    v, held, slewed = [], [], []
    for wish, now in zip(y.tolist(), due.tolist(), strict=True):
        dt = max(now - since, 0) * 1e-9
        if dt > MAX_DT:
            stream.pace.rest()
        v.append(stream.move(min(dt, MAX_DT), wish))
        farther = wish > stream.memory.displacement
        at_limit = v[-1] == (stream.limits.upper if farther else stream.limits.lower)
        held.append(at_limit and stream.missed)
        slewed.append(not at_limit and stream.missed)
        since = now
    return v, held, slewed


def small_blocks(block: int = 3, patience: int = 2):
    return mock.patch.multiple(deadlines, BLOCK=block, PATIENCE=patience, MOST_PATIENCE=2 * patience)


def check_block(drawn: Drawn, block: int, patience: int) -> None:
    standing = drawn.standing()
    with small_blocks(block, patience):
        plan = prepare(drawn.trajectory(), {"x": standing}, 10**18)
    stream = drawn.standing().axis
    v, held, slewed = one_by_one(stream, drawn.y, 10**18 + drawn.times, drawn.since)
    np.testing.assert_allclose(plan.voltages[:, 0], v, rtol=0, atol=1e-8 * drawn.case.width)
    assert (plan.held | plan.slewed)[:, 0].tolist() == [any(one) for one in zip(held, slewed, strict=True)]
    # A gentle stop ends at the limit but for rounding.
    limits = stream.limits
    clear = np.minimum(np.abs(v - np.array(limits.lower)), np.abs(v - np.array(limits.upper))) > 1e-8 * drawn.case.width
    exact = (plan.voltages[:, 0] == limits.lower) | (plan.voltages[:, 0] == limits.upper)
    sure = clear | (exact & ((v == np.array(limits.lower)) | (v == np.array(limits.upper))))
    assert plan.held[sure, 0].tolist() == np.array(held)[sure].tolist()
    assert not (plan.held & plan.slewed).any()


blocks = given(drawn_axes(), st.sampled_from((1, 3, 20, 1024)), st.sampled_from((1, 4, 256)))


@blocks
def test_a_block_is_its_samples_one_by_one(drawn, block, patience):
    check_block(drawn, block, patience)


@given(
    drawn_axes(st.sampled_from((inf,)) | fractions(10, 3000), fractions(1e3, 1e6)),
    st.sampled_from((1, 3, 20, 1024)),
    st.sampled_from((1, 4, 256)),
)
def test_with_limited_acceleration_too(drawn, block, patience):
    check_block(drawn, block, patience)


def state(standing: Standing) -> tuple[object, ...]:
    stream = standing.axis
    return stream.memory.snapshot(), stream.pace.rate, stream.missed, stream.limits


def prepared(drawn: Drawn, standing: Standing, start_ns: int = 0, now: int = 10**18, running=None) -> Plan:
    with small_blocks():
        return prepare(drawn.trajectory(start_ns), {"x": standing}, now, running)


def apply(standing: Standing, streamer: Streamer[Plan], now: int, given: list[tuple[int, float]]) -> None:
    """Do what is due, as an axis does: the plan's voltage, as far as the limits allow."""
    while due := streamer.due(now):
        stream = standing.axis
        planned = due.points.voltages[:, 0]
        before = planned[due.point - 1] if due.point and not due.skipped else stream.voltage
        last = given[-1][0] if given else standing.since_ns
        dt = max(due.deadline_ns - last, 0) * 1e-9
        if dt > MAX_DT:
            stream.pace.rest()
        stream.drive(stream.pace.step(stream.voltage, float(planned[due.point]), min(dt, MAX_DT), float(before)))
        given.append((due.deadline_ns, stream.voltage))


@given(drawn_axes(slew=fractions(1, 3000)))
def test_a_plan_keeps_to_limits_and_slew(drawn):
    standing = drawn.standing()
    v = prepared(drawn, standing).voltages[:, 0]
    limits = standing.axis.limits
    assert ((limits.lower <= v) & (v <= limits.upper)).all()
    due = [drawn.since, *(10**18 + drawn.times).tolist()]
    way = [limits.slew * min(max(b - a, 0) * 1e-9, MAX_DT) for a, b in pairwise(due)]
    assert (
        np.abs(np.diff(v, prepend=standing.axis.voltage)) <= np.array(way) * (1 + 1e-12) + 1e-13 * drawn.case.width
    ).all()


@given(drawn_axes(acceleration=SLOW.map(lambda slow: 1e3 * slow)))
def test_a_plan_moves_nothing(drawn):
    standing = drawn.standing()
    before = state(standing)
    prepared(drawn, standing)
    assert state(standing) == before


@given(drawn_axes(), st.integers(0, 100))
def test_a_cancelled_trajectory_leaves_what_its_points_gave(drawn, share):
    standing, twin = drawn.standing(), drawn.standing()
    plan = prepared(drawn, standing)
    streamer: Streamer[Plan] = Streamer()
    assert streamer.start(plan, 10**18) == 0
    done, given = len(drawn.times) * share // 100, []
    for now in 10**18 + drawn.times[:done]:
        apply(standing, streamer, int(now), given)
    assert streamer.cancel() == drawn.times.size - done
    assert (streamer.next_deadline_ns, streamer.remaining, streamer.skipped) == (None, 0, 0)
    assert streamer.due(2**61) is None
    assert [v for _, v in given] == plan.voltages[:done, 0].tolist()
    for v in plan.voltages[:done, 0].tolist():
        twin.axis.memory.forward(v)
    assert standing.axis.memory.snapshot() == twin.axis.memory.snapshot()
    # What comes next goes on from there.
    since = int(10**18 + drawn.times[done - 1]) if done else drawn.since
    now = since + 50 * MS
    v, *_ = one_by_one(standing.axis.copy(), drawn.y, now + drawn.times, since)
    again = prepared(drawn, replace(standing, since_ns=since), now=now)
    np.testing.assert_allclose(again.voltages[:, 0], v, rtol=0, atol=1e-8 * drawn.case.width)


@given(drawn_axes(acceleration=NONE | fractions(1e3, 1e6)), st.integers(0, 110), st.integers(0, 100))
def test_an_appended_trajectory_goes_on_from_where_the_first_will_be(drawn, handover, accepted):
    """Accepted while the first one is under way, to begin during it or after it."""
    standing, begin = drawn.standing(), 10**18
    first = prepared(drawn, standing)
    streamer: Streamer[Plan] = Streamer()
    streamer.start(first, begin)
    at = begin + int(drawn.times[-1] * handover // 100)
    now, given = begin + int(drawn.times[-1] * min(accepted, handover) // 100), []
    for due in begin + drawn.times[: np.searchsorted(begin + drawn.times, now, "right")]:
        apply(standing, streamer, int(due), given)
    kept = max(int(np.searchsorted(begin + drawn.times, at + drawn.times[0])), len(given))
    live = replace(standing, since_ns=given[-1][0]) if given else standing
    second = prepared(drawn, live, at, now, streamer)
    assert streamer.start(second, now) == drawn.times.size - kept

    expected, oracle = first.voltages[:kept, 0].tolist(), drawn.standing()
    due = [drawn.since, *(begin + drawn.times[:kept]).tolist()]
    for v, before, now in zip(expected, due, due[1:], strict=False):
        oracle.axis.pace.moved(v - oracle.axis.voltage, min(max(now - before, 0) * 1e-9, MAX_DT))
        oracle.axis.drive(v)
    since = due[-1]
    v, *_ = one_by_one(oracle.axis, drawn.y[second.trajectory.cut :], at + drawn.times[second.trajectory.cut :], since)
    while streamer.next_deadline_ns is not None:
        apply(standing, streamer, streamer.next_deadline_ns, given)
    np.testing.assert_allclose([v for _, v in given], [*expected, *v], rtol=0, atol=1e-8 * drawn.case.width)
    assert streamer.skipped == 0


@given(drawn_axes(slew=fractions(1, 3000)), st.lists(st.integers(0, 5000 * MS), max_size=30))
def test_a_late_clock_skips_points_but_never_the_slew_limit(drawn, ticks):
    standing, twin = drawn.standing(), drawn.standing()
    plan = prepared(drawn, standing)
    streamer: Streamer[Plan] = Streamer()
    streamer.start(plan, 10**18)
    given: list[tuple[int, float]] = []
    for now in np.cumsum(ticks).tolist():
        apply(standing, streamer, 10**18 + now, given)
    assert len(given) + streamer.skipped + streamer.remaining == drawn.times.size
    v, since, limits = twin.axis.voltage, drawn.since, standing.axis.limits
    for due, after in given:
        assert limits.lower <= after <= limits.upper
        way = limits.slew * min(max(due - since, 0) * 1e-9, MAX_DT)
        assert abs(after - v) <= way * (1 + 1e-12) + 1e-13 * drawn.case.width
        v, since = after, due
        twin.axis.memory.forward(after)
    assert standing.axis.memory.snapshot() == twin.axis.memory.snapshot()


# The streamer alone


@dataclass(frozen=True)
class Ticks:
    """Points that are just numbers."""

    times: np.ndarray
    start: int

    @property
    def at_once(self) -> bool:
        return not self.start

    def deadlines_ns(self, now_ns: int) -> np.ndarray:
        return self.times + (self.start or now_ns)


EVENTS = st.lists(
    st.tuples(
        st.sampled_from(("start", "start", "tick", "tick", "tick", "cancel")),
        st.integers(0, 8),
        st.sampled_from((0, 0, 5, 18, 21, 30, 40)),
        st.lists(st.integers(1, 9), max_size=8),
    ),
    min_size=2,
    max_size=25,
)


@given(EVENTS)
def test_every_point_is_applied_skipped_or_dropped_and_at_its_time(events):
    """Against a plain list of (deadline, trajectory, point)."""
    streamer: Streamer[Ticks] = Streamer()
    waiting: list[tuple[int, Ticks, int]] = []
    now = 1000
    for what, ahead, start, steps in events:
        now += ahead
        if what == "cancel":
            assert streamer.cancel() == len(waiting)
            waiting = []
        elif what == "start":
            points = Ticks(np.cumsum([ahead, *steps]), start and now + start - 20)
            begin = points.start or now
            new = [(begin + time, points, i) for i, time in enumerate(points.times.tolist())]
            kept = [one for one in waiting if points.start and one[0] < new[0][0]]
            assert streamer.start(points, now) == len(waiting) - len(kept)
            waiting = [*kept, *new]
        skipped = streamer.skipped
        while due := streamer.due(now):
            same = [one for one in waiting if one[1] is due.points and one[0] <= now]
            assert (due.deadline_ns, due.points, due.point) == same[-1]
            assert waiting[: len(same)] == same
            assert due.skipped == len(same) - 1
            skipped += due.skipped
            waiting = waiting[len(same) :]
        assert streamer.skipped == skipped
        assert streamer.remaining == len(waiting)
        assert not waiting or waiting[0][0] > now
        assert streamer.next_deadline_ns == (waiting[0][0] if waiting else None)


def test_a_clock_that_is_late_once_does_not_delay_what_follows():
    streamer: Streamer[Ticks] = Streamer()
    streamer.start(Ticks(np.arange(10) * 100, 1000), 0)
    applied = []
    for now in (999, 1000, 1099, 1250, 1300, 1777, 1800):
        due = streamer.due(now)
        applied.append(due and (due.point, due.skipped))
        assert streamer.due(now) is None
    assert applied == [None, (0, 0), None, (2, 1), (3, 0), (7, 3), (8, 0)]
    assert (streamer.skipped, streamer.remaining, streamer.next_deadline_ns) == (4, 1, 1900)


def test_the_clock_may_stand_still_or_go_back():
    streamer: Streamer[Ticks] = Streamer()
    streamer.start(Ticks(np.arange(3) * 100, 1000), 0)
    assert streamer.due(1100).point == 1
    assert streamer.due(1100) is streamer.due(500) is None
    assert streamer.next_deadline_ns == 1200


# Several axes, times, known paths


def two_axes() -> dict[str, Standing]:
    return {
        name: Standing(axis_model(case), axis_model(case).stream(), 0)
        for name, case in (("x", FAMILY_CASE), ("y", PI_CASE))
    }


def given_two(**changes) -> Trajectory:
    points = {"x": [3e-6, 5e-6, 4e-6], "y": [1e-6, 2e-6, 3e-6]}
    told = {
        "names": ["y", "x"],
        "time_from_start_ns": [0, MS, 2 * MS],
        "positions": np.array([points["y"], points["x"]]).T,
    }
    return Trajectory.of(**{**told, "axes": ["x", "y"], **changes})


def test_axes_are_matched_by_name():
    plan = prepare(given_two(), two_axes(), 10**18)
    alone = prepare(given_two(names=["x"], positions=[[3e-6], [5e-6], [4e-6]]), two_axes(), 10**18)
    assert plan.trajectory.names == ("y", "x")
    assert plan.voltages[:, 1].tolist() == alone.voltages[:, 0].tolist()
    memory = FAMILY_CASE.memory()
    assert alone.voltages[:, 0].tolist() == [memory.inverse(y) for y in (3e-6, 5e-6, 4e-6)]


def test_an_axis_that_the_next_trajectory_does_not_name_is_none_of_its_business():
    standing, streamer = two_axes(), Streamer()
    streamer.start(prepare(given_two(start_ns=10**18), standing, 10**18), 10**18)
    late = given_two(names=["y"], positions=[[4e-6], [1e-6], [2e-6]], start_ns=10**18 + MS + 1)
    plan = prepare(late, standing, 10**18, streamer)
    memory = PI_CASE.memory()
    assert plan.voltages[:, 0].tolist() == pytest.approx(
        [memory.inverse(y) for y in (1e-6, 2e-6, 4e-6, 1e-6, 2e-6)][2:]
    )
    assert streamer.start(plan, 10**18) == 1
    # A late call misses neither the last point of x nor that of y.
    assert [(due.points is plan, due.point) for due in iter(lambda: streamer.due(2 * 10**18), None)] == [
        (False, 1),
        (True, 2),
    ]


def test_points_in_the_past_are_left_out_and_the_rest_is_on_time():
    late = given_two(start_ns=10**18)
    plan = prepare(late, two_axes(), 10**18 + 1)
    assert plan.trajectory.cut == 1
    assert plan.deadlines_ns(0).tolist() == [10**18 + MS, 10**18 + 2 * MS]
    whole = prepare(given_two(positions=given_two().positions[1:], time_from_start_ns=[0, 1]), two_axes(), 0)
    assert plan.voltages.tolist() == whole.voltages.tolist()
    assert len(late.useful_at(10**18)) == 3
    assert len(late.useful_at(10**18 + 2 * MS)) == 1


def test_a_trajectory_may_have_started_before_the_clock():
    plan = prepare(given_two(start_ns=-MS), two_axes(), 5)
    assert (plan.at_once, plan.trajectory.cut, plan.deadlines_ns(5).tolist()) == (False, 2, [MS])


def test_what_is_all_in_the_past_is_refused_and_what_runs_goes_on():
    streamer: Streamer[Plan] = Streamer()
    streamer.start(prepare(given_two(start_ns=10**18), two_axes(), 10**18), 10**18)
    with pytest.raises(RejectedError, match=r"^the trajectory ended 1e-09 s ago[^\n]*$") as caught:
        prepare(given_two(start_ns=10**18), two_axes(), 10**18 + 2 * MS + 1, streamer)
    assert caught.value.cause == rejection.STALE
    assert streamer.remaining == 3


def test_a_start_later_than_planned_only_leaves_more_time():
    """To plan a long path takes a while; one that starts at once starts after that."""
    plan, streamer = prepare(given_two(), two_axes(), 10**18), Streamer()
    streamer.start(plan, 10**18 + 700 * MS)
    assert streamer.next_deadline_ns == 10**18 + 700 * MS


def test_without_a_point_at_the_present_place_the_voltage_slews_there():
    model = axis_model(FAMILY_CASE)
    standing = Standing(model, model.stream(Limits(0.0, 100.0, 1000.0)), 10**18)
    y = np.full((300, 1), 10e-6)
    plan = prepare(Trajectory.of(["x"], MS * np.arange(300), y, axes=["x"]), {"x": standing}, 10**18)
    goal = FAMILY_CASE.memory().inverse(10e-6)
    np.testing.assert_allclose(plan.voltages[:, 0], np.minimum(np.arange(300.0), goal), atol=1e-9)
    assert plan.slewed[:, 0].tolist() == [i < goal for i in range(300)]
    assert not plan.held.any()


@pytest.mark.parametrize("case", [FAMILY_CASE, PI_CASE])
@pytest.mark.parametrize("acceleration", [inf, 5e6])
def test_a_jump_among_slow_turns_leaves_the_memory_right(case, acceleration):
    """What comes before and after the jump goes in blocks, and knows of every turn."""
    wave = 0.5 + 0.2 * np.sin(np.arange(2000) / 50) * np.linspace(1.0, 0.2, 2000)
    wave[900:1100] += 0.25
    wave[1500:] -= 0.2
    y = case.rest[1] + case.height * wave
    model, due = axis_model(case), 10**18 + MS * np.arange(2000)
    standing = Standing(model, model.stream(Limits(*case.span, 2000.0, acceleration)), 10**18 - MS)
    with small_blocks(64, 16):
        plan = prepare(Trajectory.of(["x"], due, y[:, None], axes=["x"]), {"x": standing}, 0)
    v, held, slewed = one_by_one(standing.axis, y, due, standing.since_ns)
    np.testing.assert_allclose(plan.voltages[:, 0], v, rtol=0, atol=1e-9 * case.width)
    assert plan.slewed[:, 0].tolist() == slewed
    assert 20 < sum(slewed) < 400 and not any(held)


def test_a_step_just_too_long_is_cut():
    model = axis_model(PI_CASE)
    standing = Standing(model, model.stream(Limits(0.0, 80.0, 1000.0)), 10**18 - MS)
    v = 1.005 * np.arange(1.0, 60.0)
    trajectory = Trajectory.of(["x"], MS * np.arange(59), PI_CASE.memory().forward_array(v)[:, None], axes=["x"])
    np.testing.assert_allclose(
        prepare(trajectory, {"x": standing}, 10**18).voltages[:, 0], np.arange(1.0, 60.0), atol=1e-9
    )


def test_an_axis_starts_from_rest_after_a_pause():
    model = axis_model(PI_CASE)
    limits = Limits(0.0, 80.0, inf, 100.0)
    due = 10**18 + 150 * MS * np.arange(1, 60)
    y = PI_CASE.memory().forward_array(np.linspace(0.9, 70.0, 59))
    standing = Standing(model, model.stream(limits), 10**18)
    plan = prepare(Trajectory.of(["x"], due, y[:, None], axes=["x"]), {"x": standing}, 0)
    steps = np.diff(plan.voltages[:, 0], prepend=0.0)
    # 100 V/s^2 over 0.1 s, which is what a pause counts.
    assert steps.max() == pytest.approx(1.0)
    v, *_ = one_by_one(standing.axis, y, due, 10**18)
    np.testing.assert_allclose(plan.voltages[:, 0], v, atol=1e-9)


@pytest.mark.parametrize("limits", [Limits(0.0, 100.0), Limits(0.0, 100.0, 9e3), Limits(0.0, 100.0, 2e4, 1e7)])
@pytest.mark.parametrize("at_once", [False, True])
def test_a_second_trajectory_knows_what_the_first_will_have_done_by_then(limits, at_once):
    rng, model, begin = np.random.default_rng(7), axis_model(FAMILY_CASE), 10**18
    first, second = 2e-6 + 8e-6 * rng.random((2, 50, 1))
    standing = Standing(model, model.stream(limits), begin - MS)
    times, streamer, given = MS * np.arange(50), Streamer(), []
    streamer.start(prepare(Trajectory.of(["x"], times, first, axes=["x"]), {"x": standing}, begin), begin)
    for now in (begin + times[:20]).tolist():
        apply(standing, streamer, now, given)
    live, now = replace(standing, since_ns=now), now + MS // 2
    start = now if at_once else begin + 30 * MS - MS // 4
    times = times + 5 * MS
    trajectory = Trajectory.of(["x"], times, second, 0 if at_once else start, axes=["x"])
    plan = prepare(trajectory, {"x": live}, now, streamer)
    assert streamer.start(plan, now) == (30 if at_once else 15)
    apply_all = [*given]
    while streamer.next_deadline_ns is not None and streamer.remaining > 50:
        apply(standing, streamer, streamer.next_deadline_ns, apply_all)
    v, *_ = one_by_one(standing.axis, second[:, 0], start + times, apply_all[-1][0])
    np.testing.assert_allclose(plan.voltages[:, 0], v, rtol=0, atol=1e-9)
    assert plan.slewed.any() == (limits.slew < inf)


def test_an_axis_in_motion_brakes_first_where_acceleration_is_limited():
    model = axis_model(FAMILY_CASE)
    standing = Standing(model, model.stream(Limits(0.0, 100.0, 1000.0, 1e4)), 10**18)
    for _ in range(40):
        standing.axis.move(0.001, 10e-6)
    here = standing.axis.copy().memory.forward(standing.axis.voltage + 0.35)
    plan = prepare(
        Trajectory.of(["x"], MS * np.arange(1, 200), np.full((199, 1), here), axes=["x"]), {"x": standing}, 10**18
    )
    v, *_ = one_by_one(standing.axis, np.full(199, here), 10**18 + MS * np.arange(1, 200), 10**18)
    np.testing.assert_allclose(plan.voltages[:, 0], v, rtol=0, atol=1e-9)


# What makes no sense


nan = float("nan")
GOOD = [[1e-6, 3e-6], [2e-6, 5e-6], [3e-6, 4e-6]]


@pytest.mark.parametrize(("changes", "cause", "said"), [
    ({"names": [], "positions": np.empty((3, 0))}, "empty", "no axis"),
    ({"time_from_start_ns": [], "positions": []}, "empty", "no points"),
    ({"time_from_start_ns": [], "positions": np.empty((0, 2))}, "empty", "no points"),
    ({"names": ["x", "x"]}, "duplicate_axis", "twice"),
    ({"names": ["x", "z"]}, "unknown_axis", "'z'"),
    ({"names": ["x"]}, "length", "1 axes"),
    ({"positions": GOOD[:2]}, "length", r"\(2, 2\)"),
    ({"positions": [1e-6, 2e-6, 3e-6]}, "length", r"\(3,\)"),
    ({"positions": [[1e-6, 2e-6], [1e-6], [1e-6, 2e-6]]}, "length", "no array"),
    ({"positions": [["a\nb", 1], [1, 2], [1, 2]]}, "length", "no array"),
    ({"time_from_start_ns": [[0, 1, 2]]}, "length", r"\(1, 3\)"),
    ({"time_from_start_ns": [0, [1], 2]}, "length", "no array"),
    ({"time_from_start_ns": [0.0, 1.0, 2.0]}, "not_finite", "float64"),
    ({"time_from_start_ns": [0, 1, 2**70]}, "not_finite", "object"),
    ({"time_from_start_ns": [0, 1, 2**63 + 5]}, "time_backwards|not_finite", ""),
    ({"time_from_start_ns": [0, 1, 2**62]}, "time_backwards", "no times of a clock"),
    ({"start_ns": -(2**62)}, "time_backwards", "no times of a clock"),
    ({"start_ns": 2**62}, "time_backwards", "no times of a clock"),
    ({"time_from_start_ns": [-1, 1, 2]}, "time_backwards", "point 0 at -1e-09 s does not come after the start"),
    ({"time_from_start_ns": [0, MS, MS]}, "time_backwards", r"point 2 at 0.001 s does not come after point 1"),
    ({"time_from_start_ns": [3, 2, 1]}, "time_backwards", "point 1"),
    ({"positions": [GOOD[0], [2e-6, nan], [nan, 4e-6]]}, "not_finite", "axis 'x', point 1: displacement is nan"),
    ({"positions": [GOOD[0], GOOD[1], [-inf, 4e-6]]}, "not_finite", "axis 'y', point 2: displacement is -inf"),
])  # fmt: skip
def test_trajectories_that_make_no_sense(changes, cause, said):
    with pytest.raises(RejectedError, match=rf"^[^\n]*{said}[^\n]*$") as caught:
        given_two(**changes)
    assert caught.value.cause in cause.split("|")


def test_what_is_far_out_of_reach_is_refused_by_its_number_and_nothing_moves():
    standing = two_axes()
    before = {name: state(one) for name, one in standing.items()}
    far = given_two(positions=[*GOOD[:2], [3e-6, 4.0]], start_ns=10**18)
    for now in (10**18, 10**18 + MS):
        with pytest.raises(RejectedError, match=r"^axis 'x', point 2: desired displacement 4e\+06 um[^\n]*$") as caught:
            prepare(far, standing, now)
        assert caught.value.cause == rejection.OUT_OF_RANGE
    assert {name: state(one) for name, one in standing.items()} == before


def test_what_no_voltage_reaches_is_refused_and_nothing_moves():
    """A range as wide as that is in no record, but may be in a document."""
    model = replace(axis_model(PI_CASE), displacement_range=(-10.0, 10.0))
    standing = Standing(model, model.stream(), 0)
    before = state(standing)
    with pytest.raises(SlpiError, match=r"^axis 'x': [^\n]*$"):
        prepare(Trajectory.of(["x"], [0, 1], [[1e-6], [9.0]], axes=["x"]), {"x": standing}, 0)
    assert state(standing) == before
