"""A JointTrajectory from bytes: what rclpy reads, point by point, or nothing."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

rclpy = pytest.importorskip("rclpy")

from builtin_interfaces.msg import Duration  # noqa: E402
from rclpy.serialization import serialize_message  # noqa: E402
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint  # noqa: E402

from slpi_ros.io.messages import TrajectoryArrays, decode_trajectory  # noqa: E402

NUMBERS = st.floats(allow_nan=False)


@st.composite
def trajectories(draw: st.DrawFn, least: int = 0) -> JointTrajectory:
    names = draw(st.lists(st.text(st.characters(codec="utf-8", exclude_characters="\0"), max_size=9), max_size=4))
    message = JointTrajectory(joint_names=names)
    message.header.frame_id = draw(st.text(st.characters(codec="ascii", exclude_characters="\0"), max_size=9))
    message.header.stamp.sec = draw(st.integers(-(2**31), 2**31 - 1))
    message.header.stamp.nanosec = draw(st.integers(0, 2**32 - 1))
    more = [draw(st.booleans()) for _ in range(3)]
    for i in range(draw(st.integers(least, 6))):
        numbers = [draw(st.lists(NUMBERS, min_size=len(names), max_size=len(names))) for _ in range(4)]
        rest = [part if wanted else [] for part, wanted in zip(numbers[1:], more, strict=True)]
        time = Duration(sec=i, nanosec=draw(st.integers(0, 2**32 - 1)))
        message.points.append(JointTrajectoryPoint(
            positions=numbers[0], velocities=rest[0], accelerations=rest[1], effort=rest[2], time_from_start=time
        ))  # fmt: skip
    return message


def is_told(found: TrajectoryArrays, message: JointTrajectory) -> None:
    stamp = message.header.stamp
    assert found.start_ns == stamp.sec * 10**9 + stamp.nanosec
    assert list(found.names) == message.joint_names
    assert found.values.tolist() == [list(point.positions) for point in message.points]
    times = [point.time_from_start.sec * 10**9 + point.time_from_start.nanosec for point in message.points]
    assert found.time_from_start_ns.tolist() == times


@given(trajectories())
def test_it_says_what_the_message_says(message):
    is_told(decode_trajectory(serialize_message(message)), message)


@given(trajectories(least=1), st.data())
def test_points_that_are_not_alike_are_read_or_left_to_rclpy(message, data):
    longer = data.draw(st.integers(0, len(message.points) - 1))
    which = data.draw(st.sampled_from(["positions", "velocities", "accelerations", "effort"]))
    setattr(message.points[longer], which, [*getattr(message.points[longer], which), 1.0])
    found = decode_trajectory(serialize_message(message))
    # All points behind the first share one layout; a longer first one may shift that of the rest.
    if which == "positions" or (longer > 0 and len(message.points) > 2):
        assert found is None
    else:
        assert found is not None or len(message.points) > 2
        if found is not None:
            is_told(found, message)


@given(trajectories(), st.data())
def test_what_is_cut_off_is_no_trajectory_or_the_whole_one(message, data):
    text = serialize_message(message)
    end = data.draw(st.integers(0, len(text) - 1))
    found = decode_trajectory(text[:end])
    # rclpy's buffers end in some unused bytes: only those may be missing.
    if end < 28 + len(message.points) * (24 + 8 * len(message.joint_names)):
        assert found is None
    elif found is not None:
        is_told(found, message)


@given(st.binary(max_size=200))
def test_noise_is_no_trajectory_or_one_that_noise_can_hold(noise):
    for data in (noise, b"\0\1\0\0" + noise):
        found = decode_trajectory(data)
        if found is not None:
            assert found.values.shape == (found.time_from_start_ns.size, len(found.names))
            assert found.values.nbytes <= len(data)


def test_big_endian_is_read_too():
    body = b"".join([
        np.array([5, 7], ">i4").tobytes(), np.array([1], ">u4").tobytes(), b"\0" * 4,
        np.array([1, 2], ">u4").tobytes(), b"x\0\0\0", np.array([1, 1], ">u4").tobytes(), b"\0" * 4,
        np.array([2.5], ">f8").tobytes(), np.array([0, 0, 0, 3, 9], ">u4").tobytes(),
    ])  # fmt: skip
    found = decode_trajectory(b"\0\0\0\0" + body)
    assert (found.start_ns, found.names) == (5 * 10**9 + 7, ("x",))
    assert (found.values.tolist(), found.time_from_start_ns.tolist()) == ([[2.5]], [3 * 10**9 + 9])
