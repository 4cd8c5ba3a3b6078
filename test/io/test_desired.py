"""Desired displacements of bags and tables."""

import numpy as np
import pytest
from bag_makers import STORE, header, joint_state, rosbags_bag

from slpi_ros.errors import RecordError
from slpi_ros.io.bag_reader import read_bag
from slpi_ros.io.bag_writer import write_bag
from slpi_ros.io.desired import desired_of, read_path
from slpi_ros.io.tables import write_table

MS = 1_000_000
BEGIN = 10**9
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
    assert x[[45, 50, 55, 60]] == pytest.approx([3.0, 4.0, 3.5, 3.0]) and x[61:] == pytest.approx(2.0)
    assert np.isnan(y[:20]).all() and (y[20:85] == 5.0).all() and y[90] == pytest.approx(7.5) and y[99] == 5.0
    t, columns = read_path(bag)
    assert t[0] == 0.0 and columns["x"].max() == pytest.approx(4e-6) and columns["y"].max() == pytest.approx(8e-6)


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
