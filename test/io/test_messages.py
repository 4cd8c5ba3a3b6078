"""The byte layout of JointState streams, against rosbags and rclpy, which know nothing of it."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from refusals import holds, refusal
from rosbags.typesys import Stores, get_typestore

from slpi_ros.errors import RecordError
from slpi_ros.io.bag_reader import decode_signals
from slpi_ros.io.bag_storage import MessageBlock
from slpi_ros.io.messages import JOINT_STATE, JointStateEncoder, encode_joint_states, read_message

STORE = get_typestore(Stores.ROS2_JAZZY)

texts = st.text(st.characters(exclude_categories=["Cs"], exclude_characters="\0"), max_size=9)
numbers = st.floats(allow_nan=True, width=64)
stamps = st.integers(0, 2**31 * 10**9 - 1)


def message(stamp_ns, names, position, effort, frame_id="", velocity=()):
    time = STORE.types["builtin_interfaces/msg/Time"](sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9)
    header = STORE.types["std_msgs/msg/Header"](stamp=time, frame_id=frame_id)
    arrays = {"position": position, "velocity": velocity, "effort": effort}
    arrays = {name: np.array(values, float) for name, values in arrays.items()}
    return STORE.types[JOINT_STATE](header=header, name=list(names), **arrays)


def serialised(*args, little_endian=True, **kwargs) -> bytes:
    return bytes(STORE.serialize_cdr(message(*args, **kwargs), JOINT_STATE, little_endian=little_endian))


def rows(*messages):
    return np.frombuffer(b"".join(messages), np.uint8).reshape(len(messages), -1)


def decode(*messages, blocks=1):
    parts = np.array_split(np.arange(len(messages)), blocks)
    return decode_signals(
        [MessageBlock.of(part.tolist(), [messages[row] for row in part]) for part in parts],
        JOINT_STATE,
    )


@given(st.lists(texts, min_size=1, max_size=4), texts, stamps, st.data())
def test_encoded_as_rosbags_does(names, frame_id, stamp, data):
    position, effort = (data.draw(st.lists(numbers, min_size=len(names), max_size=len(names))) for _ in "pe")
    encoded = encode_joint_states(np.array([stamp]), np.array([position]), np.array([effort]), tuple(names), frame_id)
    assert list(encoded) == [serialised(stamp, names, position, effort, frame_id)]


@given(st.lists(texts, min_size=1, max_size=4, unique=True), texts, st.integers(0, 3), st.data())
def test_all_at_once_agrees_with_one_by_one(names, frame_id, velocities, data):
    given_rows = st.lists(numbers, min_size=len(names), max_size=len(names))
    drawn = data.draw(st.lists(st.tuples(stamps, given_rows, given_rows), min_size=1, max_size=5))
    # In order, each with a stamp of its own: what else becomes of them is that of `message_order`.
    drawn = [(10**12 + 7 * number + t % 7, p, e) for number, (t, p, e) in enumerate(drawn)]
    messages = [serialised(t, names, p, e, frame_id, [1.0] * velocities) for t, p, e in drawn]
    assert read_message(messages[0], JOINT_STATE).layout.decode(rows(*messages)) is not None
    alike = decode(*messages)
    # one more message of another length leaves only the slow way
    each = decode(*messages, serialised(2 * 10**12, [*names, "one more"], [], []))
    assert alike.frames == {frame_id: frozenset(names)}
    stamp = np.zeros(len(drawn)) if alike.stamp is None else alike.stamp
    assert stamp.tolist() == each.stamp[:-1].tolist() == [stamp for stamp, _, _ in drawn]
    for column, name in enumerate(names):
        for place, field in ((1, "position"), (2, "effort")):
            given_values = [row[place][column] for row in drawn]
            np.testing.assert_array_equal(alike.fields[field][name], given_values)
            np.testing.assert_array_equal(each.fields[field][name][:-1], given_values)


def test_names_of_one_length_are_not_mixed_up():
    messages = [serialised(1, ["a", "b"], [1, 2], [3, 4]), serialised(2, ["b", "a"], [5, 6], [7, 8])]
    for blocks in (1, 2):
        fields = decode(*messages, blocks=blocks).fields
        assert fields["position"]["a"].tolist() == [1, 6]
        assert fields["effort"]["b"].tolist() == [4, 7]


@pytest.mark.parametrize("blocks", [1, 2, 3])
def test_short_arrays_and_absent_joints_are_nan(blocks):
    signals = decode(
        serialised(1, ["a", "b"], [1, 2], [3, 4]),
        serialised(2, ["b", "c"], [5], []),
        serialised(3, [], [], []),
        blocks=blocks,
    )
    position, effort = signals.fields["position"], signals.fields["effort"]
    assert signals.names == ("a", "b", "c")
    np.testing.assert_array_equal(position["a"], [1, np.nan, np.nan])
    np.testing.assert_array_equal(position["b"], [2, 5, np.nan])
    np.testing.assert_array_equal(effort["b"], [4, np.nan, np.nan])
    assert np.isnan(position["c"]).all()


def test_blocks_in_the_order_of_the_log():
    messages = [serialised(t, ["a"], [t], [-t]) for t in (1, 2, 3, 4)]
    blocks = [MessageBlock.of([30, 40], messages[2:]), MessageBlock.of([10, 30], messages[:2])]
    signals = decode_signals(blocks, JOINT_STATE)
    assert signals.logged.tolist() == [10, 30, 30, 40]
    assert signals.fields["position"]["a"].tolist() == signals.stamp.tolist() == [1, 3, 2, 4]


def test_big_endian_messages():
    signals = decode(*[serialised(t, ["a"], [t], [-t], little_endian=False) for t in (1, 2, 3)])
    assert signals.stamp.tolist() == signals.fields["position"]["a"].tolist() == [1, 2, 3]


def test_garbage_in_padding_and_at_the_end():
    clean = serialised(7, ["x", "long"], [1, 2], [3, 4], "id")
    layout = read_message(clean, JOINT_STATE).layout
    dirty = bytearray(clean)
    for place in np.flatnonzero(~layout.fixed):
        if not any(first <= place < first + 16 for _, first in layout.fields.values()):
            dirty[place] = 0xFB
    assert dirty != clean
    fields = layout.decode(rows(clean + b"garbage", bytes(dirty) + b"\xff" * 7))
    assert fields is not None
    assert fields["position"].tolist() == [[1, 2]] * 2
    assert fields["effort"].tolist() == [[3, 4]] * 2
    assert layout.decode(rows(clean[:-1])) is None


def test_rclpy_both_ways():
    serialization = pytest.importorskip("rclpy.serialization")
    joint_state = pytest.importorskip("sensor_msgs.msg").JointState
    stamp, position, effort = np.array([12_000_000_034]), np.array([[1.5, 2.5]]), np.array([[3.5, 4.5]])
    (encoded,) = encode_joint_states(stamp, position, effort, ("x", "another"), "stage")
    read = serialization.deserialize_message(encoded, joint_state)
    assert (read.header.stamp.sec, read.header.stamp.nanosec) == (12, 34)
    assert (read.header.frame_id, list(read.name)) == ("stage", ["x", "another"])
    assert (list(read.position), list(read.effort)) == ([1.5, 2.5], [3.5, 4.5])
    message = serialization.serialize_message(read)
    again = read_message(message, JOINT_STATE).layout.decode(rows(*[message] * 3))
    assert again is not None
    assert again["sec"].tolist() == [12] * 3
    assert again["nanosec"].tolist() == [34] * 3
    assert again["position"].tolist() == [[1.5, 2.5]] * 3


def test_one_message_after_the_other_as_all_at_once():
    stamps = np.array([12_000_000_034, 2**31 * 10**9 - 1])
    position, effort = np.array([[1.5, np.nan], [-3.5, 0.0]]), np.array([[3.5, 4.5], [5.5, 6.5]])
    names = ("x", "another")
    encoder = JointStateEncoder(names, "stage")
    one_by_one = [
        encoder.encode(*each) for each in zip(stamps.tolist(), position.tolist(), effort.tolist(), strict=True)
    ]
    assert one_by_one == list(encode_joint_states(stamps, position, effort, names, "stage"))


@pytest.mark.parametrize("stamp", [-1, 2**31 * 10**9])
def test_stamp_that_no_header_can_hold(stamp):
    stamps, zeros = np.array([0, stamp]), np.zeros((2, 1))
    message = refusal(RecordError, encode_joint_states, stamps, zeros, zeros, ("x",))
    assert holds(message, "sample 1", f"{stamp / 1e9:g} s", "2^31 s")
