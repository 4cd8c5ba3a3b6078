"""Voltage and displacement on topics of their own: every type of message, every clock, against plain loops."""

import itertools

import numpy as np
import pytest
from bag_makers import array, float64, joint_state, rosbags_bag, vector
from hypothesis import given, settings
from hypothesis import strategies as st
from refusals import holds, refusal

from slpi_ros.errors import RecordError
from slpi_ros.io.alignment import SeparateTopics, Signals, combine
from slpi_ros.io.bag_reader import read_bag
from slpi_ros.io.desired import desired_of

BOTH = SeparateTopics("command", "sensor")
MS = 10**6


def signals(time, columns, *, stamped=True, field="data", named=True, logged=None):
    time = np.asarray(time, np.int64)
    columns = {name: np.asarray(column, float) for name, column in columns.items()}
    logged = time + 7 if logged is None else np.asarray(logged, np.int64)
    return Signals(logged, time if stamped else None, {}, {field: columns}, named)


def aligned(v_time, v, y_time, y, **how):
    record = combine(
        signals(v_time, {"x": v}), signals(y_time, {"x": y}), SeparateTopics("command", "sensor", **how), (), "bag"
    )
    return record.time_ns.tolist(), record.voltage["x"].tolist(), record.displacement["x"].tolist()


def test_a_command_holds_until_the_next():
    time, v, y = aligned([10, 20, 30, 40], [1, 2, 3, 4], [5, 10, 19, 20, 35, 40, 41], [7, 1, 1, 2, 3, 4, 9])
    assert time == [10, 19, 20, 35, 40]
    assert v == y == [1, 1, 2, 3, 4]


def test_a_turn_between_two_displacements_is_kept():
    time, v, y = aligned([0, 10, 20, 30, 40, 50], [0, 1, 5, 4, 3, 4], [5, 35, 50], [7, 8, 9])
    assert time == [5, 20, 35, 40, 50]
    assert v == [0, 5, 4, 3, 4]
    np.testing.assert_array_equal(y, [7, np.nan, 8, np.nan, 9])


def test_a_measured_voltage_is_interpolated():
    assert aligned([0, 10, 20], [1, 3, 2], [0, 5, 15, 20, 21], [1, 2, 3, 4, 5], held=False) == (
        [0, 5, 15, 20],
        [1, 2, 2.5, 2],
        [1, 2, 3, 4],
    )


def test_on_the_clock_of_a_command():
    how = {"clock": "voltage"}
    assert aligned([0, 10, 20, 30], [1, 2, 3, 4], [0, 10, 30], [0, 10, 50], **how) == (
        [5, 15, 25],
        [1, 2, 3],
        [5, 20, 40],
    )
    assert aligned([0, 10, 20, 30], [1, 2, 3, 4], [10, 30], [10, 50], held=False, **how) == (
        [10, 20, 30],
        [2, 3, 4],
        [10, 30, 50],
    )


def test_nothing_is_known_within_a_gap():
    y_time = [*range(0, 100, 10), *range(400, 500, 10)]
    voltage = range(0, 500, 25)
    time, _, y = aligned(voltage, voltage, y_time, y_time, clock="voltage", held=False)
    assert [t for t, value in zip(time, y, strict=True) if np.isnan(value)] == [*range(100, 400, 25)]
    # A command goes on; whether a measured voltage did, nobody knows.
    for held in (True, False):
        _, v, _ = aligned(y_time, y_time, voltage, voltage, held=held)
        assert np.isnan(v).any() != held


times = st.lists(st.integers(0, 60), min_size=2, max_size=25, unique=True).map(sorted)


@given(times, times, st.data(), st.booleans())
def test_against_a_plain_loop(v_time, y_time, data, held):
    v = [data.draw(st.integers(1, 5)) for _ in v_time]
    y = [1.0 + t for t in y_time]
    inside = [t for t in y_time if v_time[0] <= t <= v_time[-1]]
    if not inside or max(v_time[0], y_time[0]) >= min(v_time[-1], y_time[-1]):
        assert holds(refusal(RecordError, aligned, v_time, v, y_time, y, held=held), "bag")
        return
    time, v_read, y_read = aligned(v_time, v, y_time, y, held=held)
    measured = ~np.isnan(y_read)
    assert [t for t, own in zip(time, measured, strict=True) if own] == inside
    assert time == sorted(time)
    if held:
        assert v_read == [v[max(i for i, s in enumerate(v_time) if s <= t)] for t in time]
        # All extremes that the commands reach between two displacements are there.
        for before, after in itertools.pairwise(inside):
            reached = [x for s, x in zip(v_time, v, strict=True) if before < s <= after]
            seen = [x for t, x in zip(time, v_read, strict=True) if before <= t <= after]
            if reached:
                assert min(seen) <= min(reached)
                assert max(seen) >= max(reached)
    else:
        gap = 10 * np.median(np.diff(v_time))
        for t, x in zip(time, v_read, strict=True):
            after = next(i for i, s in enumerate(v_time) if s >= t)
            if v_time[after] == t:
                assert x == v[after]
            elif v_time[after] - v_time[after - 1] > gap:
                assert np.isnan(x)
            else:
                share = (t - v_time[after - 1]) / (v_time[after] - v_time[after - 1])
                assert x == pytest.approx(v[after - 1] + share * (v[after] - v[after - 1]))


@pytest.mark.parametrize("clock", ["displacement", "voltage"])
@pytest.mark.parametrize("rate", [313.0, 2900.0])
def test_a_stage_that_follows_at_once_shows_no_lag(clock, rate):
    # The true displacement is proportional to the command in force; sensor and command know nothing of each other.
    v_time = MS * np.arange(2000)
    v = 50 - 50 * np.cos(2 * np.pi * v_time / 1e9)
    y_time = (1e9 * np.arange(rate) / rate).astype(np.int64) + 123_456
    y = v[np.searchsorted(v_time, y_time, side="right") - 1]
    _, v_read, y_read = (np.array(column) for column in aligned(v_time, v, y_time, y, clock=clock))
    both = np.isfinite(y_read)
    error = y_read[both] - v_read[both]
    slope = np.gradient(v_read[both])
    if clock == "displacement":
        assert not error.any()
    else:
        assert np.max(np.abs(error)) < 2 * np.max(np.abs(np.diff(v)))
        # A lag of half a period would be -0.5.
        assert abs(error @ slope / (slope @ slope)) < 0.05


def test_stamps_of_1_7e18_ns_are_not_rounded():
    start = 1_700_000_000_000_000_001
    time, v, _ = aligned([start, start + 3], [0, 3], [start + 1, start + 2], [1, 1], held=False)
    assert time == [start + 1, start + 2]
    assert v == [1, 2]


V_MESSAGES = {
    "number": lambda t, v: float64(v[0]),
    "array": lambda t, v: array(*v),
    "labelled": lambda t, v: array(*v, labels=["axes"]),
    "effort": lambda t, v: joint_state(t, ("x", "y", "z")[: len(v)], [0.0] * len(v), v),
    "position": lambda t, v: joint_state(t, ("x", "y", "z")[: len(v)], v, ()),
    "vector": lambda t, v: vector(t, *v),
}
Y_MESSAGES = {
    "number": lambda t, y: float64(y[0]),
    "array": lambda t, y: array(*y),
    "joints": lambda t, y: joint_state(t, ("z", "y", "x")[-len(y) :], y[::-1], ()),
    "vector": lambda t, y: vector(t, *y, frame_id="stage"),
}


@settings(max_examples=50)
@given(st.sampled_from(list(V_MESSAGES)), st.sampled_from(list(Y_MESSAGES)), st.sampled_from(["mcap", "sqlite3"]))
def test_every_type_with_every_other(tmp_path_factory, driving, moving, storage):
    v_width = 1 if driving == "number" else 3
    y_width = 1 if moving == "number" else 3
    if v_width > y_width:
        return
    rows = range(1, 30)
    v = {t: [10.0 * t + axis for axis in range(v_width)] for t in rows}
    y = {t: [-10.0 * t - axis for axis in range(y_width)] for t in rows}
    bag = rosbags_bag(
        tmp_path_factory.mktemp("types") / "bag",
        {
            "/command": [(1000 * t, V_MESSAGES[driving](1000 * t, v[t])) for t in rows],
            "/sensor": [(1000 * t + 1, Y_MESSAGES[moving](1000 * t + 1, y[t])) for t in rows],
        },
        storage,
    )
    record = read_bag(bag, BOTH)
    assert sorted(record.axes) == ["x", "y", "z"][:y_width]
    for number, axis in enumerate(sorted(record.axes)):
        assert record.displacement[axis].tolist() == [-10.0 * t - number for t in rows][:-1]
        column = number if driving in ("effort", "position", "vector") else record.axes.index(axis)
        assert record.voltage[axis].tolist() == [10.0 * t + (column if v_width > 1 else 0) for t in rows][:-1]
    stamped = driving in ("effort", "position", "vector") and moving in ("joints", "vector")
    assert any("time of recording" in note for note in record.notes) != stamped
    assert record.hardware_id == ("stage" if moving == "vector" else "")


def test_columns_without_names_are_taken_in_the_order_of_the_axes():
    v = signals([0, 10, 20], {"0": [1, 1, 1], "1": [2, 2, 2]}, named=False)
    y = signals([0, 10, 20], {"x": [5, 5, 5], "y": [6, 6, 6]})
    record = combine(v, y, BOTH, (), "bag")
    assert (record.voltage["x"][0], record.voltage["y"][0]) == (1, 2)
    assert record.notes == ("'command' names no axes: its columns were taken for x, y, in this order",)
    record = combine(v, y, BOTH, ("y", "x"), "bag")
    assert record.axes == ("y", "x")
    assert (record.voltage["x"][0], record.voltage["y"][0]) == (2, 1)
    assert record.displacement["x"][0] == 5


def test_axes_that_do_not_match():
    xy = signals([0, 10], {"x": [1, 2], "y": [1, 2]})
    ab = signals([0, 10], {"a": [1, 2], "b": [1, 2]})
    two = signals([0, 10], {"0": [1, 2], "1": [3, 4]}, named=False)
    one = signals([0, 10], {"0": [1, 2]}, named=False)
    four = signals([0, 10], {str(n): [1, 2] for n in range(4)}, named=False)
    assert holds(refusal(RecordError, combine, ab, xy, BOTH, (), "bag"), "voltage", "a, b", "x, y")
    assert holds(refusal(RecordError, combine, xy, xy, BOTH, ("w",), "bag"), "displacement", "x, y", "w")
    assert holds(refusal(RecordError, combine, xy, one, BOTH, (), "bag"), "displacement", 1, "x, y")
    assert holds(refusal(RecordError, combine, two, xy, BOTH, ("x",), "bag"), "voltage", 2, "x")
    assert holds(refusal(RecordError, combine, four, four, BOTH, (), "bag"), "displacement", 4)
    assert combine(four, four, BOTH, "abcd", "bag").axes == ("a", "b", "c", "d")
    assert combine(xy, one, BOTH, ("y",), "bag").axes == ("y",)
    assert combine(xy, signals([0, 10], {"y": [1, 2], "z": [1, 2]}), BOTH, (), "bag").axes == ("y",)


def test_clocks_that_do_not_agree():
    v = signals([0, 10, 20], {"x": [1, 2, 3]}, logged=[1000, 1010, 1020])
    y = signals([500, 510, 520], {"x": [1, 2, 3]}, logged=[1001, 1011, 1021])
    record = combine(v, y, BOTH, (), "bag")
    assert record.time_ns.tolist() == [1001, 1011]
    assert "header stamps are of different clocks" in record.notes[0]
    apart = signals([500, 510, 520], {"x": [1, 2, 3]}, logged=[2001, 2011, 2021])
    assert holds(refusal(RecordError, combine, v, apart, BOTH, (), "bag"), "bag", "'command'", "'sensor'")
    back = signals([0, 20, 10], {"x": [1, 2, 3]})
    assert holds(refusal(RecordError, combine, back, v, BOTH, (), "bag"), "'command'", "1e-08 s", "message 2")


@pytest.mark.parametrize("ppm", [100.0, -100.0, 20.0])
def test_clocks_that_drift_apart_are_corrected(ppm):
    """180 s at 500 Hz, by a recorder whose delays scatter: 100 ppm are 18 ms in the end."""
    rng = np.random.default_rng(7)
    true = np.arange(90_000) * 2 * MS + 10**18
    v = np.sin(np.arange(true.size) / 50.0)
    own = 10**18 + np.rint((true - 10**18) * (1.0 + 1e-6 * ppm)).astype(np.int64)
    late = [MS + np.rint(0.3 * MS * rng.exponential(size=true.size)).astype(np.int64) for _ in range(2)]
    record = combine(
        signals(true, {"x": v}, logged=true + late[0]),
        signals(own, {"x": v}, logged=true + late[1]),
        SeparateTopics("command", "sensor", held=False),
        (),
        "bag",
    )
    error = np.abs(record.time_ns - true[np.searchsorted(true, record.time_ns - MS)])
    assert np.median(error) < 0.1 * MS and error.max() < 0.3 * MS
    (note,) = record.notes
    assert "ppm" in note and holds(note, "'sensor'", "'command'")
    same = combine(
        signals(true, {"x": v}, logged=true + late[0]), signals(true, {"x": v}, logged=true + late[1]), BOTH, (), "bag"
    )
    assert not same.notes


def test_topics_that_hold_no_signal(tmp_path):
    number = signals([0, 10], {"x": [1, 2]})
    nothing = signals([0, 10], {"x": [0, np.nan]})
    silent = refusal(RecordError, combine, number, nothing, BOTH, (), "bag")
    assert holds(silent, "bag", "'command'", "'sensor'")
    text = {"/command": [(1, float64(1))], "/sensor": [(1, vector(1, 1, 1, 1).vector)]}
    message = refusal(RecordError, read_bag, rosbags_bag(tmp_path / "bag", text), BOTH)
    assert holds(message, "'/sensor'", "geometry_msgs/msg/Vector3", "sensor_msgs/msg/JointState")


def test_a_desired_displacement_of_three_axes_in_a_vector(tmp_path):
    stamps = [10**9 + k * 10 * MS for k in range(60)]

    def state(k, stamp):
        return joint_state(stamp, names=("x", "y", "z"), position=(1e-6, 2e-6, 3e-6), effort=(k, k, k))

    topics = {
        "/stage_state": [(stamp, state(k, stamp)) for k, stamp in enumerate(stamps)],
        "/wanted": [(stamp, vector(stamp, 1e-6 * k, 2e-6 * k, 3e-6 * k)) for k, stamp in enumerate(stamps)],
    }
    bag = rosbags_bag(tmp_path / "bag", topics)
    held = desired_of(bag, read_bag(bag), "wanted")
    assert held.keys() == {"x", "y", "z"}
    assert np.allclose(held["z"], 3e-6 * np.arange(60), rtol=0, atol=1e-18)


def framed(frames, names=("x",)):
    """Return states of which each has its frame id and the names of its axes, 10 ms apart."""
    stamps = [10**9 + k * 10 * MS for k in range(len(frames))]
    axes = [names] * len(frames) if isinstance(names[0], str) else names
    return [
        (stamp, joint_state(stamp, each, [k] * len(each), [-k] * len(each), frame))
        for k, (stamp, frame, each) in enumerate(zip(stamps, frames, axes, strict=True))
    ]


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
@pytest.mark.parametrize(
    "frames", [["A"] * 9 + ["B"] * 9, ["A", "B"] * 9, ["A"] * 17 + ["other"], ["", "A", "map"] * 5 + ["B"]]
)
def test_messages_of_two_stages_are_no_record(tmp_path, frames, storage):
    bag = rosbags_bag(tmp_path / "bag", {"/stage_state": framed(frames)}, storage)
    other = next(frame for frame in frames if frame not in ("", "map", "A"))
    said = refusal(RecordError, read_bag, bag)
    assert holds(said, bag, "'stage_state'", "'A'", f"'{other}'", "--accept-stage")
    # Whichever of the two is the other name of the same stage.
    assert read_bag(bag, accept_stage=other).hardware_id == "A"
    assert read_bag(bag, accept_stage="A").hardware_id == other
    assert holds(refusal(RecordError, read_bag, bag, accept_stage="a third"), "'A'", f"'{other}'")


@pytest.mark.parametrize(
    ("frames", "stage"),
    [
        (["base_link", "A", "/map", "A", "world", ""] * 3, "A"),
        (["odom", "base_link"] * 9, "odom"),
        ([""] * 9, ""),
        (["N, serial number 12, firmware 1", "N, serial number 12, firmware 2"] * 9, "N, serial number 12, firmware 1"),
    ],
)  # fmt: skip
def test_what_names_no_other_stage_may_stand_beside_it(tmp_path, frames, stage):
    record = read_bag(rosbags_bag(tmp_path / "bag", {"/stage_state": framed(frames)}))
    assert record.hardware_id == stage and len(record) == len(frames)


def test_the_axes_of_one_of_two_stages_on_a_topic_can_be_read(tmp_path):
    states = framed(["A", "B"] * 9, [("x",), ("y", "z")] * 9)
    bag = rosbags_bag(tmp_path / "bag", {"/stage_state": states})
    assert holds(refusal(RecordError, read_bag, bag), "'A'", "'B'", "--axis")
    assert [read_bag(bag, axes=axes).hardware_id for axes in (["x"], ["y"], ["z", "y"])] == ["A", "B", "B"]
    refusal(RecordError, read_bag, bag, axes=["x", "z"])


@pytest.mark.parametrize("second", ["command", "sensor"])
def test_each_of_two_topics_is_of_one_stage(tmp_path, second):
    frames = {"command": ["A"] * 18, "sensor": ["A"] * 18} | {second: ["A", "B"] * 9}
    bag = rosbags_bag(tmp_path / "bag", {f"/{topic}": framed(names) for topic, names in frames.items()})
    assert holds(refusal(RecordError, read_bag, bag, BOTH), f"'{second}'", "'A'", "'B'")
    assert read_bag(bag, BOTH, accept_stage="B").hardware_id == "A"
    # What a quantity beside the stage names in its frames is no stage.
    states = {"/stage_state": framed(["A"] * 18), "/other": framed(["B", "C"] * 9)}
    beside = read_bag(rosbags_bag(tmp_path / "beside", states), surroundings=["/other:position.x"])
    assert beside.hardware_id == "A" and "/other:position.x" in beside.surroundings
