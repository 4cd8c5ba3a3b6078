"""Desired displacements of bags and tables."""

from contextlib import suppress
from dataclasses import replace

import numpy as np
import pytest
from bag_makers import STORE, header, joint_state, rosbags_bag
from hypothesis import given
from hypothesis import strategies as st
from strategies import FAMILY_CASE, axis_model

from slpi_ros.compensator.controller import Controller
from slpi_ros.compensator.validation import RejectedError
from slpi_ros.errors import RecordError
from slpi_ros.io.bag_reader import read_bag
from slpi_ros.io.bag_writer import write_bag
from slpi_ros.io.desired import at_times, desired_of, read_desired, read_path
from slpi_ros.io.tables import write_table
from slpi_ros.model.limits import Limits
from slpi_ros.model.stage_model import StageModel

MS = 1_000_000
BEGIN = 10**9
MODEL = replace(axis_model(FAMILY_CASE), displacement_range=(2e-6, 14e-6))
STAGE = StageModel({"x": MODEL, "y": MODEL})
TIMES = [BEGIN + k * 10 * MS for k in range(100)]


def trajectory(stamp_ns: int, names: tuple[str, ...], times_ms: list[int], rows: list[tuple[float, ...]]):
    point, duration = (STORE.types[name] for name in (
        "trajectory_msgs/msg/JointTrajectoryPoint", "builtin_interfaces/msg/Duration"))  # fmt: skip
    none = np.empty(0)
    points = [
        point(positions=np.array(row), velocities=none, accelerations=none, effort=none,
              time_from_start=duration(sec=ms // 1000, nanosec=ms % 1000 * MS))
        for ms, row in zip(times_ms, rows, strict=True)
    ]  # fmt: skip
    return STORE.types["trajectory_msgs/msg/JointTrajectory"](header(stamp_ns), joint_names=list(names), points=points)


def bag_of(folder, **topics):
    states = [(t, joint_state(t, ("x", "y"), (1e-6, 2e-6), (k, k))) for k, t in enumerate(TIMES)]
    return rosbags_bag(folder, {"/stage_state": states, **{f"/{name}": rows for name, rows in topics.items()}})


def test_what_a_bag_is_written_with_is_read(tmp_path):
    record = read_bag(bag_of(tmp_path / "bag"))
    desired = 1e-6 * np.sin(record.t)
    write_bag(tmp_path / "with", record, desired={"y": np.where(record.t < 0.1, np.nan, desired)})
    found = desired_of(tmp_path / "with", read_bag(tmp_path / "with"))
    assert list(found) == ["y"] and np.isnan(found["y"][:10]).all()
    np.testing.assert_array_equal(found["y"][10:], desired[10:])


def test_messages_are_held_and_trajectories_interpolated(tmp_path):
    messages = [(TIMES[k], joint_state(TIMES[k], (axis,), (value,), ())) for k, axis, value in (
        (10, "x", 1e-6), (20, "y", 5e-6), (30, "x", 2e-6))]  # fmt: skip
    path = trajectory(TIMES[40], ("x",), [0, 100, 200], [(2e-6,), (4e-6,), (3e-6,)])
    # Without a stamp it begins when it arrives.
    late = trajectory(0, ("y",), [50, 150], [(7e-6,), (8e-6,)])
    trajectories = [(TIMES[35], path), (TIMES[80], late)]
    bag = bag_of(tmp_path / "bag", desired_displacement=messages, desired_trajectory=trajectories)
    found = desired_of(bag, read_bag(bag))
    x, y = found["x"] * 1e6, found["y"] * 1e6
    assert np.isnan(x[:10]).all() and (x[10:30] == 1.0).all() and x[30:41] == pytest.approx(2.0)
    assert x[[45, 50, 55, 60]] == pytest.approx([3.0, 4.0, 3.5, 3.0]) and x[61:] == pytest.approx(3.0)
    assert np.isnan(y[:20]).all() and (y[20:81] == 5.0).all()
    # From where the axis is to the first point, then from point to point; the last one is held.
    assert y[[83, 85, 90, 95, 99]] == pytest.approx([6.2, 7.0, 7.5, 8.0, 8.0])
    t, columns = read_path(bag)
    assert t[0] == 0.0 and columns["x"].max() == pytest.approx(4e-6) and columns["y"].max() == pytest.approx(8e-6)


RAMP = [0, 1000], [(0.0,), (10e-6,)]  # 10 um/s


def sampled(tmp_path, times, trajectories, messages=(), recorder_ms=0):
    """Return what is desired of x (um) at some times (ms); each message with its time in ms, recorded so much later."""
    named = {"desired_trajectory": trajectories, "desired_displacement": messages}
    topics = {
        name: [(BEGIN + (at + recorder_ms) * MS, each) for at, each in rows] for name, rows in named.items() if rows
    }
    bag = bag_of(tmp_path / "bag", **topics)
    found = desired_of(bag, read_bag(bag))
    return [float(found["x"][TIMES.index(BEGIN + at * MS)]) * 1e6 for at in times]


@pytest.mark.parametrize("stamp_ms", [0, 100, 5000])
def test_a_path_that_is_cancelled_is_desired_no_longer(tmp_path, stamp_ms):
    stop = trajectory(BEGIN + stamp_ms * MS if stamp_ms else 0, (), [], [])
    found = sampled(tmp_path, [0, 90, 110, 900], [(0, trajectory(BEGIN, ("x",), *RAMP)), (100, stop)])
    assert found == pytest.approx([0.0, 0.9, np.nan, np.nan], nan_ok=True)


def test_a_path_that_is_replaced_does_not_come_back(tmp_path):
    second = trajectory(0, ("x",), [0, 200], [(1e-6,), (2e-6,)])
    found = sampled(tmp_path, [90, 100, 200, 300, 310, 900], [(0, trajectory(BEGIN, ("x",), *RAMP)), (100, second)])
    assert found == pytest.approx([0.9, 1.0, 1.5, 2.0, 2.0, 2.0])


def test_an_axis_that_a_later_path_does_not_name_stays_where_it_is(tmp_path):
    second = trajectory(0, ("y",), [0, 200], [(1e-6,), (2e-6,)])
    found = sampled(tmp_path, [90, 110, 900], [(0, trajectory(BEGIN, ("x",), *RAMP)), (100, second)])
    assert found == pytest.approx([0.9, 1.0, 1.0])


def test_single_messages_are_rejected_while_a_path_is_followed_or_waits(tmp_path):
    # It comes at 200 ms and begins at 400.
    path = trajectory(BEGIN + 400 * MS, ("y",), [0, 100], [(1e-6,), (2e-6,)])
    states = [(at, joint_state(BEGIN + at * MS, ("x",), (at * 1e-9,), ())) for at in (100, 300, 450, 600)]
    found = sampled(tmp_path, [90, 110, 310, 460, 590, 610], [(200, path)], states)
    assert found == pytest.approx([np.nan, 0.1, 0.1, 0.1, 0.1, 0.6], nan_ok=True)


@pytest.mark.parametrize(
    "wrong",
    [
        trajectory(0, ("x",), [0, 200], [(1e-6,), (np.nan,)]),
        trajectory(0, ("x",), [200, 100], [(1e-6,), (2e-6,)]),
        trajectory(0, ("x", "x"), [0, 200], [(1e-6, 1e-6), (2e-6, 2e-6)]),
        trajectory(0, (), [0], [()]),
    ],
)
def test_what_is_rejected_as_a_whole_replaces_nothing(wrong, tmp_path):
    found = sampled(tmp_path, [90, 110, 900], [(0, trajectory(BEGIN, ("x",), *RAMP)), (100, wrong)])
    assert found == pytest.approx([0.9, 1.1, 9.0])


def test_a_recorder_with_a_clock_of_its_own(tmp_path):
    """With simulated time the times of recording are those of another clock."""
    path, stop = trajectory(BEGIN, ("x",), *RAMP), trajectory(BEGIN + 100 * MS, (), [], [])
    states = [(at, joint_state(BEGIN + at * MS, ("x",), (5e-6,), ())) for at in (10, 200)]
    found = sampled(tmp_path, [90, 110, 200, 900], [(0, path), (100, stop)], states, 10**9)
    assert found == pytest.approx([0.9, np.nan, 5.0, 5.0], nan_ok=True)


def test_a_path_for_a_drive_has_no_more_than_was_followed(tmp_path):
    second = trajectory(0, ("x",), [20, 200], [(1e-6,), (2e-6,)])
    bag = bag_of(
        tmp_path / "bag", desired_trajectory=[(BEGIN, trajectory(BEGIN, ("x",), *RAMP)), (BEGIN + 100 * MS, second)]
    )
    t, columns = read_path(bag)
    assert t == pytest.approx([0.0, 0.1, 0.12, 0.3]) and columns["x"] * 1e6 == pytest.approx([0.0, 1.0, 1.0, 2.0])


# What happens, after how many steps of 20 ms: a single setpoint, a path (begins so much later, None: at once; steps to
# the first and between the points), or an end.
STEP, PERIOD = 20 * MS, 5 * MS
SETPOINTS = st.sampled_from([("x",), ("y",), ("x", "y")])
FEW = st.integers(1, 6)
HAPPENS = st.lists(
    st.one_of(
        st.tuples(FEW, st.just("set"), SETPOINTS),
        st.tuples(
            FEW,
            st.just("path"),
            SETPOINTS,
            st.sampled_from([None, 0, 2, 5]),
            st.integers(0, 3),
            st.lists(FEW, max_size=3),
        ),
        st.tuples(FEW, st.just("cancel"), st.booleans()),
    ),
    max_size=8,
)


@given(HAPPENS, st.integers(0, 100))
def test_a_bag_tells_what_the_compensator_followed(tmp_path_factory, happens, seed):
    rng = np.random.default_rng(seed)
    made = Controller(["x", "y"], [Limits(0.0, 100.0)] * 2, period=PERIOD * 1e-9)
    made.use_model(STAGE)
    made.activate(BEGIN)
    events, at = {}, BEGIN
    for steps, *event in happens:
        at += steps * STEP
        # A single setpoint comes neither with the end of a path nor with its beginning.
        events[at + PERIOD if event[0] == "set" else at] = event
    seen, messages, trajectories = [], [], []
    for now in range(BEGIN, at + 25 * STEP, PERIOD):
        for _ in made.axes:
            made.advance(now, now)
        what, *how = events.get(now, [""])
        if what == "set":
            y = rng.uniform(4e-6, 12e-6, len(how[0])).tolist()
            messages.append((now, joint_state(now, how[0], y, ())))
            with suppress(RejectedError):
                made.update(now, how[0], y, now)
        elif what == "path":
            names, ahead, first, steps = how
            start_ns = 0 if ahead is None else now + ahead * STEP
            times = np.cumsum([first, *steps]) * STEP
            y = rng.uniform(4e-6, 12e-6, (times.size, len(names)))
            trajectories.append((now, trajectory(start_ns, names, (times // MS).tolist(), y.tolist())))
            made.follow(names, times, y, start_ns, now, now)
        elif what == "cancel":
            trajectories.append((now, trajectory(now if how[0] else 0, (), [], [])))
            made.follow([], [], [], 0, now, now)
        for _ in made.axes:
            made.advance(now, now)
        if (now - BEGIN) % STEP == STEP // 2:
            seen.append((now, [axis.tracking.desired for axis in made.axes]))
    topics = {"/stage_state": [(BEGIN, joint_state(BEGIN))]}
    named = {"/desired_displacement": messages, "/desired_trajectory": trajectories}
    bag = rosbags_bag(
        tmp_path_factory.mktemp("happens") / "bag", topics | {name: rows for name, rows in named.items() if rows}
    )
    found = at_times(read_desired(bag, ("x", "y")), np.array([now for now, _ in seen]))
    for place, axis in enumerate(("x", "y")):
        before = np.nan
        for (_, followed), y in zip(seen, found.get(axis, np.full(len(seen), np.nan)).tolist(), strict=True):
            if followed[place] is None or not np.isnan(y):
                expected = np.nan if followed[place] is None else followed[place]
                assert y == pytest.approx(expected, rel=1e-9, nan_ok=True)
            else:
                # On the way to a first point from where the bag does not tell.
                assert np.isnan(before)
            before = y


def test_a_bag_without_a_path(tmp_path):
    bag = bag_of(tmp_path / "bag")
    assert desired_of(bag, read_bag(bag)) is None
    with pytest.raises(RecordError, match=r"desired_displacement.*desired_trajectory"):
        read_path(bag)


def test_a_path_of_another_clock_is_refused(tmp_path):
    other = [(TIMES[0], joint_state(10**15 + k * MS, ("x",), (1e-6,), ())) for k in range(5)]
    bag = bag_of(tmp_path / "bag", desired_displacement=other)
    with pytest.raises(RecordError, match="one clock"):
        desired_of(bag, read_bag(bag))


def test_a_table_begins_at_zero(tmp_path):
    write_table(tmp_path / "path.csv", np.array([5.0, 6.0]), {"x": np.array([1e-6, 2e-6])}, "m")
    t, columns = read_path(tmp_path / "path.csv")
    assert t.tolist() == [0.0, 1.0] and columns["x"].tolist() == [1e-6, 2e-6]
