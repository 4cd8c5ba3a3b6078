"""Trajectories: checked as a whole, every point given at its time, as a command is, and nothing else moves."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from strategies import FAMILY_CASE, PI_CASE, axis_model, fractions

from slpi_ros.compensator import validation as rejection
from slpi_ros.compensator.axis import Axis
from slpi_ros.compensator.controller import OPEN_LOOP, Controller, OperatingMode, StopReason
from slpi_ros.compensator.trajectory import Trajectory, TrajectoryExecutor
from slpi_ros.compensator.validation import RejectedError
from slpi_ros.errors import SlpiError
from slpi_ros.model.limits import PERIOD, Limits
from slpi_ros.model.stage_model import StageModel

MS = 1_000_000
START = 10**18
MODEL = replace(axis_model(FAMILY_CASE), displacement_range=(2e-6, 14e-6))
STAGE = StageModel({"x": MODEL, "y": MODEL})
PATH = 8e-6 - 5e-6 * np.cos(np.linspace(0.0, 9.0, 300)) * np.linspace(0.3, 1.0, 300)
PACES = [{}, {"slew": 2000.0}, {"slew": 3000.0, "acceleration": 2e5}]


# When points are due: the executor alone


def ticks(times, start=0, names=("x",)):
    """Points whose displacement is their number."""
    rows = np.repeat(np.arange(len(times), dtype=float)[:, None], len(names), axis=1)
    return Trajectory.of(names, np.asarray(times), rows, start, axes=["x", "y", "z"])


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
def test_every_point_is_given_skipped_or_dropped_and_at_its_time(events):
    """Against a plain list of (deadline, trajectory, point)."""
    executor = TrajectoryExecutor()
    waiting: list[tuple[int, int, int]] = []
    now = 1000
    for number, (what, ahead, start, steps) in enumerate(events):
        now += ahead
        if what == "cancel":
            executor.cancel()
            waiting = []
        elif what == "start":
            times, begin = np.cumsum([ahead, *steps]), start and now + start - 20
            new = [(int(begin or now) + t, number, i) for i, t in enumerate(times.tolist())]
            new = [one for one in new if one[0] >= now]
            if not new:
                with pytest.raises(RejectedError) as caught:
                    executor.start(ticks(times, begin), now)
                assert caught.value.cause == rejection.STALE
            else:
                executor.start(ticks(times, begin), now)
                waiting = [*(one for one in waiting if begin and one[0] < new[0][0]), *new]
        while point := executor.due(now):
            same = [one for one in waiting if one[1] == waiting[0][1] and one[0] <= now]
            assert (point.deadline_ns, point.displacements) == (same[-1][0], [same[-1][2]])
            assert waiting[: len(same)] == same
            waiting = waiting[len(same) :]
        assert executor.remaining == len(waiting) and executor.on == bool(waiting)
        assert not waiting or waiting[0][0] > now
        assert executor.next_deadline_ns == (waiting[0][0] if waiting else None)


def test_a_clock_that_is_late_once_does_not_delay_what_follows():
    executor = TrajectoryExecutor()
    executor.start(ticks(np.arange(10) * 100, 1000), 0)
    given_points = []
    for now in (999, 1000, 1099, 1250, 1300, 1777, 1800):
        point = executor.due(now)
        given_points.append(point and int(point.displacements[0]))
        assert executor.due(now) is None
    assert given_points == [None, 0, None, 2, 3, 7, 8]
    assert (executor.skipped, executor.remaining, executor.next_deadline_ns) == (4, 1, 1900)


@pytest.mark.parametrize(("spacing", "crowded"), [(MS // 2, 6), (MS, 0), (2 * MS, 0)])
def test_skipped_points_that_are_closer_than_the_output_period_are_counted(spacing, crowded):
    executor = TrajectoryExecutor()
    executor.start(ticks(np.arange(10) * spacing, MS), 0)
    executor.due(MS)
    assert executor.due(MS + 7 * spacing).displacements == [7.0]
    assert (executor.skipped, executor.crowded) == (6, crowded)


def test_the_clock_may_stand_still_or_go_back():
    executor = TrajectoryExecutor()
    executor.start(ticks(np.arange(3) * 100, 1000), 0)
    assert executor.due(1100).displacements == [1.0]
    assert executor.due(1100) is executor.due(500) is None
    assert executor.next_deadline_ns == 1200


@given(st.lists(st.sampled_from((-30, 0, 1, 40)), min_size=3, max_size=3), st.integers(0, 120))
def test_each_axis_is_given_its_points_earlier_by_its_delay(delays, ahead):
    """What would have had to be given before now is left out, but for the last one."""
    executor, now = TrajectoryExecutor(), 10_000
    times = np.arange(5) * 50
    executor.start(ticks(times, now + ahead, "xyz"), now, {n: d * 1e-9 for n, d in zip("xyz", delays, strict=True)})
    due = {name: (now + ahead + times - delay).tolist() for name, delay in zip("xyz", delays, strict=True)}
    expected = {name: [(max(t, now), i) for i, t in enumerate(each) if t >= now] for name, each in due.items()}
    found: dict[str, list[tuple[int, int]]] = {"x": [], "y": [], "z": []}
    for at in range(now, now + 500):
        while point := executor.due(at):
            for name in point.names:
                found[name].append((at, int(point.displacements[0])))
    assert found == expected and executor.skipped == 0 and not executor.on


# What is given: as commands are


def controller(names="xy", stage=STAGE, **limits):
    made = Controller(list(names), [Limits(0.0, 100.0, **limits)] * len(names))
    made.use_model(stage)
    made.activate(START - 1000 * MS)
    return made


def twin(**limits):
    axis = Axis("x", Limits(0.0, 100.0, **limits), OPEN_LOOP)
    axis.use(MODEL, axis.prepare(MODEL))
    return axis


def send(made, names="x", path=PATH, start_ns=0, now=START):
    rows = np.column_stack([path] * len(names))
    made.follow(list(names), np.arange(len(rows)) * MS, rows, start_ns, now, now)


def follow(made, until_ns, step_ns=MS, since_ns=START):
    """Return the voltages after each point, shape (M, axes)."""
    return np.array([list(made.voltages) for now in range(since_ns, until_ns, step_ns) if made.advance(now, now)])


def expected_of(axis, path=PATH, first_ns=START):
    return [axis.update(1e-3, float(y), first_ns + i * MS) for i, y in enumerate(path)]


@pytest.mark.parametrize("limits", PACES)
def test_points_are_compensated_as_commands_are(limits):
    made = controller(**limits)
    send(made, "xy")
    voltages = follow(made, START + 300 * MS)
    assert voltages.shape == (300, 2) and made.mode is OperatingMode.STREAMING
    np.testing.assert_array_equal(voltages, np.column_stack([expected_of(twin(**limits))] * 2))


CURVES = MODEL.hysteresis
STEEP = replace(MODEL, hysteresis=replace(CURVES, everett=1.2 * CURVES.everett, rise=1.2 * CURVES.rise))
CHANGES = {
    "model": (
        lambda made: made.use_model(StageModel({"x": STEEP, "y": STEEP})),
        lambda axis: axis.use(STEEP, axis.prepare(STEEP)),
    ),
    "limits": (
        lambda made: made.use_limits([Limits(0.0, 100.0, 700.0)] * 2, START + 150 * MS),
        lambda axis: axis.use_limits(Limits(0.0, 100.0, 700.0), PERIOD),
    ),
}


@pytest.mark.parametrize("what", CHANGES)
@pytest.mark.parametrize("waits", [False, True])
def test_a_change_in_between_counts_for_the_points_to_come(what, waits):
    made, other = controller(slew=2000.0), twin(slew=2000.0)
    send(made, start_ns=START + 200 * MS if waits else 0)
    change_all, change_one = CHANGES[what]
    before = follow(made, START + 150 * MS)
    change_all(made)
    # What the lower slew limit holds back at the end follows later.
    after = follow(made, START + (500 if waits else 300) * MS, since_ns=START + 150 * MS)
    assert len(before) == (0 if waits else 150) and len(before) + len(after) == 300
    expected = expected_of(other, PATH[: len(before)])
    change_one(other)
    expected += expected_of(other, PATH[len(before) :], START + (200 if waits else 150) * MS)
    np.testing.assert_array_equal(np.concatenate([each[:, 0] for each in (before, after) if each.size]), expected)


@given(st.lists(st.integers(0, 500 * MS), max_size=30), st.sampled_from(PACES[1:]))
@example([297 * MS, 2 * MS, 4 * MS], PACES[2])  # still in motion at the last point
def test_a_late_clock_skips_points_but_never_exceeds_a_limit(steps, limits):
    made = controller("x", StageModel({"x": MODEL}), **limits)
    send(made)
    now, last_ns, last_v, given_points = START, START - 1000 * MS, 0.0, 0  # last_ns: of the last change
    for step in steps:
        now += step
        following = made.mode is OperatingMode.TRAJECTORY
        if not made.advance(now, now):
            continue
        # After the last point follows what the limits have held back.
        given_points += following
        v = made.voltages[0]
        assert 0.0 <= v <= 100.0
        assert abs(v - last_v) <= limits["slew"] * min((now - last_ns) * 1e-9, 2.0 * PERIOD) * (1 + 1e-12) + 1e-11
        last_v, last_ns = v, now if v != last_v else last_ns
    assert given_points + made.trajectory.skipped + made.trajectory.remaining == 300


def test_points_that_are_late_are_skipped_and_the_memory_knows_what_was_given():
    made, other = controller(), twin()
    send(made)
    voltages = follow(made, START + 310 * MS, 7 * MS)[:, 0]
    points = list(range(0, 300, 7)) + ([299] if 299 % 7 else [])
    assert made.trajectory.skipped == 300 - len(points) == 300 - len(voltages)
    np.testing.assert_array_equal(voltages, [other.update(1e-3, float(PATH[i]), 0) for i in points])
    assert made.axes[0].reversal_voltages == other.reversal_voltages


@given(st.integers(0, 299), fractions(0, 1))
def test_a_cancelled_trajectory_leaves_the_axis_where_its_points_led(done, share):
    made, other = controller(), twin()
    send(made)
    follow(made, START + done * MS)
    made.follow([], [], [], 0, START + done * MS, START + done * MS)
    expected_of(other, PATH[:done])
    assert made.mode is OperatingMode.STREAMING and not made.trajectory.on
    assert made.axes[0].stream.memory.snapshot() == other.stream.memory.snapshot()
    # No time has passed at the next command.
    y = 3e-6 + share * 10e-6
    made.update(1, ["x"], [y], START + done * MS)
    assert made.voltages[0] == other.update(0.0, y, 0)


def test_one_that_is_refused_changes_nothing():
    made, clean = controller(), controller()
    for each in (made, clean):
        send(each)
    voltages = [follow(made, START + 100 * MS)]
    with pytest.raises(SlpiError):
        send(made, path=PATH + 1e-3, now=START + 100 * MS)
    voltages.append(follow(made, START + 400 * MS, since_ns=START + 100 * MS))
    assert np.vstack(voltages).tolist() == follow(clean, START + 400 * MS).tolist()
    assert (made.counts["trajectories"], made.counts["trajectories_rejected"]) == (2, 1)


def test_replaced_at_once_appended_later_and_stopped():
    made = controller()
    send(made)
    follow(made, START + 50 * MS)
    now = START + 50 * MS
    send(made, "y", now=now)
    assert made.trajectory.remaining == 300
    send(made, "x", np.full(9, 5e-6), START + 100 * MS, now)
    assert made.trajectory.remaining == 50 + 9
    before = made.voltages[0]
    follow(made, START + 100 * MS, since_ns=now)
    assert made.voltages[0] == before and made.voltages[1] > 0.0
    assert made.trajectory.next_deadline_ns == made.next_due_ns(now, now) == START + 100 * MS
    made.stop(StopReason.CANCELED, START + 100 * MS)
    assert made.next_due_ns(now, now) is None and not made.advance(START + 10**12, START + 10**12)


def test_points_that_are_out_of_reach_or_too_fast_are_counted_as_they_are_given():
    made = controller(slew=100.0)
    send(made, path=np.concatenate([PATH, np.full(5000, 15e-6)]))
    assert made.counts["points_slew_limited"] == made.counts["points_held_at_limit"] == 0
    follow(made, START + 300 * MS)
    slewing = made.counts["points_slew_limited"]
    assert slewing > 100 and made.counts["points_held_at_limit"] == 0
    follow(made, START + 6000 * MS, since_ns=START + 300 * MS)
    assert made.counts["points_held_at_limit"] > 100 and made.counts["excursions"] == 1
    assert made.counts["points_slew_limited"] + made.counts["points_held_at_limit"] + np.count_nonzero(PATH) >= 5000


def test_points_far_apart_are_interpolated_at_the_output_rate_and_reached_at_their_times():
    made = controller("x", StageModel({"x": MODEL}))
    made.update(1, ["x"], [4e-6], START - 100 * MS)
    points, times = np.array([5e-6, 9e-6, 7e-6]), np.array([20, 50, 55]) * MS
    made.follow(["x"], times, points[:, None], 0, START, START)
    seen = {}
    while (due_ns := made.next_due_ns(START, START)) is not None and made.mode is OperatingMode.TRAJECTORY:
        assert made.advance(due_ns, due_ns)
        seen[(due_ns - START) / MS] = made.axes[0].stream.memory.displacement
    expected = np.interp(np.arange(1, 56), [0, 20, 50, 55], [4e-6, *points])
    assert list(seen) == list(range(1, 56))
    np.testing.assert_allclose(list(seen.values()), expected, rtol=0, atol=1e-13)


def test_a_trajectory_that_is_too_fast_is_told_before_it_begins():
    """With its first late point, and by how much."""
    y = MODEL.memory().forward_array(np.array([30.0, 90.0, 91.0]))
    quick, slow = controller(slew=100.0), controller(slew=100.0)
    for made, step in ((quick, 400 * MS), (slow, 700 * MS)):
        made.follow(["x"], np.arange(1, 4) * step, y[:, None], 0, START, START)
        assert not made.trajectory.moving and made.voltages[0] == 0.0
    assert slow.trajectory.too_fast == ""
    # 60 V in 0.4 s at 100 V/s.
    assert (
        "'x', point 1 at 0.8 s will be late by 0.2 s" in quick.trajectory.too_fast
        and "\n" not in quick.trajectory.too_fast
    )
    # It is about the limits, not about the clock: with none there is nothing to say.
    free = controller()
    free.follow(["x"], np.arange(1, 4) * MS, y[:, None], 0, START, START)
    assert free.trajectory.too_fast == ""


def test_what_a_trajectory_that_is_too_fast_has_not_reached_follows_after_it():
    made = controller("x", StageModel({"x": MODEL}), slew=100.0)
    made.follow(["x"], [10 * MS], [[10e-6]], 0, START, START)
    now = START
    while (due_ns := made.next_due_ns(now, now)) is not None:
        now = due_ns
        made.advance(now, now)
    assert made.mode is OperatingMode.STREAMING and now > START + 500 * MS
    assert made.axes[0].stream.memory.displacement == pytest.approx(10e-6, abs=1e-13)


def test_axes_are_matched_by_name():
    made = controller(stage=StageModel({"x": axis_model(FAMILY_CASE), "y": axis_model(PI_CASE)}))
    rows = np.array([[1e-6, 3e-6], [2e-6, 5e-6], [3e-6, 4e-6]])
    made.follow(["y", "x"], np.arange(3) * MS, rows, 0, START, START)
    x, y = FAMILY_CASE.memory(), PI_CASE.memory()
    expected = [[x.inverse(row[1]), y.inverse(row[0])] for row in rows.tolist()]
    assert follow(made, START + 3 * MS).tolist() == expected


# What makes no sense


nan, inf = float("nan"), float("inf")
GOOD = [[1e-6, 3e-6], [2e-6, 5e-6], [3e-6, 4e-6]]


def given_two(**changes) -> Trajectory:
    told = {"names": ["y", "x"], "time_from_start_ns": [0, MS, 2 * MS], "positions": GOOD}
    return Trajectory.of(**{**told, "axes": ["x", "y"], **changes})


@pytest.mark.parametrize(("changes", "cause", "said"), [
    ({"names": [], "positions": np.empty((3, 0))}, "empty", ""),
    ({"time_from_start_ns": [], "positions": []}, "empty", ""),
    ({"time_from_start_ns": [], "positions": np.empty((0, 2))}, "empty", ""),
    ({"names": ["x", "x"]}, "duplicate_axis", ""),
    ({"names": ["x", "z"]}, "unknown_axis", "'z'"),
    ({"names": ["x"]}, "length", "1 axes"),
    ({"positions": GOOD[:2]}, "length", "(2, 2)"),
    ({"positions": [1e-6, 2e-6, 3e-6]}, "length", "(3,)"),
    ({"positions": [[1e-6, 2e-6], [1e-6], [1e-6, 2e-6]]}, "length", ""),
    ({"positions": [["a\nb", 1], [1, 2], [1, 2]]}, "length", ""),
    ({"time_from_start_ns": [[0, 1, 2]]}, "length", "(1, 3)"),
    ({"time_from_start_ns": [0, [1], 2]}, "length", ""),
    ({"time_from_start_ns": [0.0, 1.0, 2.0]}, "not_finite", "float64"),
    ({"time_from_start_ns": [0, 1, 2**70]}, "not_finite", "object"),
    ({"time_from_start_ns": [0, 1, 2**63 + 5]}, "time_backwards|not_finite", ""),
    ({"time_from_start_ns": [0, 1, 2**62]}, "time_backwards", str(2**62)),
    ({"start_ns": -(2**62)}, "time_backwards", str(2**62)),
    ({"start_ns": 2**62}, "time_backwards", str(2**62)),
    ({"time_from_start_ns": [-1, 1, 2]}, "time_backwards", "point 0 at -1e-09 s"),
    ({"time_from_start_ns": [0, MS, MS]}, "time_backwards", "point 2 at 0.001 s"),
    ({"time_from_start_ns": [3, 2, 1]}, "time_backwards", "point 1"),
    ({"positions": [GOOD[0], [2e-6, nan], [nan, 4e-6]]}, "not_finite", "axis 'x', point 1"),
    ({"positions": [GOOD[0], GOOD[1], [-inf, 4e-6]]}, "not_finite", "axis 'y', point 2"),
])  # fmt: skip
def test_trajectories_that_make_no_sense(changes, cause, said):
    with pytest.raises(RejectedError) as caught:
        given_two(**changes)
    assert caught.value.cause in cause.split("|") and said in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize("ahead", [0, -MS])
def test_what_is_far_out_of_reach_is_refused_by_its_number_and_nothing_moves(ahead):
    made = controller()
    rows = np.array([[5e-6, 5e-6], [5e-6, 5e-6], [5e-6, 4.0]])
    before = [axis.stream.memory.snapshot() for axis in made.axes]
    with pytest.raises(RejectedError) as caught:
        made.follow(["y", "x"], [0, MS, 2 * MS], rows, START + ahead, START, START)
    assert caught.value.cause == rejection.OUT_OF_RANGE and "axis 'x', point 2" in str(caught.value)
    assert [axis.stream.memory.snapshot() for axis in made.axes] == before and not made.trajectory.on
