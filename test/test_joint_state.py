"""The byte layout of JointState streams, against rosbags and rclpy, which know nothing of it."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rosbags.typesys import Stores, get_typestore

from slpi_ros.errors import RecordError
from slpi_ros.joint_state import JointStateBlock, decode_joint_states, joint_state_layout

TYPE = "sensor_msgs/msg/JointState"
STORE = get_typestore(Stores.ROS2_JAZZY)

texts = st.text(st.characters(exclude_categories=["Cs"], exclude_characters="\0"), max_size=9)
numbers = st.floats(allow_nan=True, width=64)
stamps = st.integers(0, 2**31 * 10**9 - 1)


def message(stamp_ns, names, position, effort, frame_id="", velocity=()):
    time = STORE.types["builtin_interfaces/msg/Time"](sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9)
    header = STORE.types["std_msgs/msg/Header"](stamp=time, frame_id=frame_id)
    arrays = {"position": position, "velocity": velocity, "effort": effort}
    arrays = {name: np.array(values, float) for name, values in arrays.items()}
    return STORE.types[TYPE](header=header, name=list(names), **arrays)


def serialised(*args, little_endian=True, **kwargs) -> bytes:
    return bytes(STORE.serialize_cdr(message(*args, **kwargs), TYPE, little_endian=little_endian))


def decode(*messages):
    return decode_joint_states(messages, lambda data: STORE.deserialize_cdr(data, TYPE))


@given(st.lists(texts, min_size=1, max_size=4), texts, stamps, st.data())
def test_encoded_as_rosbags_does(names, frame_id, stamp, data):
    position, effort = (data.draw(st.lists(numbers, min_size=len(names), max_size=len(names))) for _ in "pe")
    block = JointStateBlock(np.array([stamp]), np.array([position]), np.array([effort]))
    encoded = joint_state_layout(tuple(names), frame_id).encode(block)
    assert encoded == [serialised(stamp, names, position, effort, frame_id)]


@given(st.lists(texts, min_size=1, max_size=4, unique=True), texts, st.integers(0, 3), st.data())
def test_all_at_once_agrees_with_one_by_one(names, frame_id, velocities, data):
    rows = st.lists(numbers, min_size=len(names), max_size=len(names))
    drawn = data.draw(st.lists(st.tuples(stamps, rows, rows), min_size=1, max_size=5))
    messages = [serialised(t, names, p, e, frame_id, [1.0] * velocities) for t, p, e in drawn]
    assert joint_state_layout(tuple(names), frame_id, velocities).decode(messages) is not None
    alike = decode(*messages)
    # one more message of another length leaves only the slow way
    each = decode(*messages, serialised(0, [*names, "one more"], [], []))
    assert alike.frame_id == frame_id
    assert alike.stamp_ns.tolist() == each.stamp_ns[:-1].tolist() == [stamp for stamp, _, _ in drawn]
    for name in names:
        np.testing.assert_array_equal(alike.position[name], each.position[name][:-1])
        np.testing.assert_array_equal(alike.effort[name], each.effort[name][:-1])


def test_names_of_one_length_are_not_mixed_up():
    samples = decode(serialised(1, ["a", "b"], [1, 2], [3, 4]), serialised(2, ["b", "a"], [5, 6], [7, 8]))
    assert samples.position["a"].tolist() == [1, 6]
    assert samples.effort["b"].tolist() == [4, 7]


def test_short_arrays_and_absent_joints_are_nan():
    samples = decode(
        serialised(1, ["a", "b"], [1, 2], [3, 4]), serialised(2, ["b", "c"], [5], []), serialised(3, [], [], [])
    )
    assert list(samples.position) == ["a", "b", "c"]
    np.testing.assert_array_equal(samples.position["a"], [1, np.nan, np.nan])
    np.testing.assert_array_equal(samples.position["b"], [2, 5, np.nan])
    np.testing.assert_array_equal(samples.effort["b"], [4, np.nan, np.nan])
    assert np.isnan(samples.position["c"]).all()


def test_big_endian_messages():
    samples = decode(*[serialised(t, ["a"], [t], [-t], little_endian=False) for t in (1, 2, 3)])
    assert samples.stamp_ns.tolist() == samples.position["a"].tolist() == [1, 2, 3]


def test_garbage_in_padding_and_at_the_end():
    clean = serialised(7, ["x", "long"], [1, 2], [3, 4], "id")
    layout = joint_state_layout(("x", "long"), "id")
    dirty = bytearray(clean)
    for place in np.flatnonzero(~layout.fixed):
        if not any(first <= place < first + 16 for first in layout.offsets.values()):
            dirty[place] = 0xFB
    assert dirty != clean
    block = layout.decode([clean + b"garbage", bytes(dirty) + b"\xff" * 7])
    assert block is not None
    assert block.position.tolist() == [[1, 2]] * 2
    assert block.effort.tolist() == [[3, 4]] * 2


def test_rclpy_both_ways():
    serialization = pytest.importorskip("rclpy.serialization")
    joint_state = pytest.importorskip("sensor_msgs.msg").JointState
    block = JointStateBlock(np.array([12_000_000_034]), np.array([[1.5, 2.5]]), np.array([[3.5, 4.5]]))
    layout = joint_state_layout(("x", "another"), "stage")
    read = serialization.deserialize_message(layout.encode(block)[0], joint_state)
    assert (read.header.stamp.sec, read.header.stamp.nanosec) == (12, 34)
    assert (read.header.frame_id, list(read.name)) == ("stage", ["x", "another"])
    assert (list(read.position), list(read.effort)) == ([1.5, 2.5], [3.5, 4.5])
    again = layout.decode([serialization.serialize_message(read)] * 3)
    assert again is not None
    assert again.stamp_ns.tolist() == [12_000_000_034] * 3
    assert again.position.tolist() == [[1.5, 2.5]] * 3


@pytest.mark.parametrize("stamp", [-1, 2**31 * 10**9])
def test_stamp_that_no_header_can_hold(stamp):
    block = JointStateBlock(np.array([0, stamp]), np.zeros((2, 1)), np.zeros((2, 1)))
    with pytest.raises(RecordError, match="sample 1: time .* does not fit"):
        joint_state_layout(("x",)).encode(block)
