"""JointStates from bytes: what rclpy reads, whatever came before."""

import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

rclpy = pytest.importorskip("rclpy")

from rclpy.serialization import serialize_message  # noqa: E402
from sensor_msgs.msg import JointState  # noqa: E402
from std_msgs.msg import Float64MultiArray  # noqa: E402

from slpi_ros.io.cdr import multiarray_header  # noqa: E402
from slpi_ros.io.messages import JointStates  # noqa: E402

NUMBERS = st.lists(st.floats(allow_nan=False), max_size=4)
TEXTS = st.text(st.characters(codec="utf-8", exclude_characters="\0"), max_size=9)


@st.composite
def joint_states(draw: st.DrawFn) -> JointState:
    message = JointState(
        name=draw(st.lists(TEXTS, max_size=4)), position=draw(NUMBERS), velocity=draw(NUMBERS), effort=draw(NUMBERS)
    )
    message.header.frame_id = draw(TEXTS)
    message.header.stamp.sec = draw(st.integers(-(2**31), 2**31 - 1))
    message.header.stamp.nanosec = draw(st.integers(0, 2**32 - 1))
    return message


def said(message: JointState) -> tuple[int, list[str], list[float]]:
    stamp = message.header.stamp
    return stamp.sec * 10**9 + stamp.nanosec, message.name, list(message.position)


def read(reader: JointStates, data: bytes) -> tuple[int, list[str], list[float]] | None:
    found = reader.read(data)
    return found and (found[0], list(found[1]), list(found[2]))


@given(st.lists(joint_states(), min_size=1, max_size=4), st.lists(st.integers(0, 3), max_size=12))
def test_it_says_what_the_messages_say_in_any_order(messages, order):
    reader = JointStates()
    for i in (0, *order):
        message = messages[i % len(messages)]
        assert read(reader, serialize_message(message)) == said(message)


def test_padding_means_nothing_and_the_order_of_bytes_does():
    message = JointState(name=["x", "yy"], position=[1.0, 2.0])
    message.header.stamp.sec = 5
    data = bytearray(serialize_message(message))
    reader = JointStates()
    assert read(reader, bytes(data)) == said(message)
    at = data.index(b"\2\0\0\0x\0") + 6
    data[2:4], data[at : at + 2] = b"\xab\xcd", b"\xef\x99"
    assert read(reader, bytes(data)) == said(message)
    layout, texts = ">2B2xiII1s3xII2s2xI3sxI2d2I", (1, b"\0", 2, 2, b"x\0", 3, b"yy\0")
    big = struct.pack(layout, 0, 0, 5, 0, *texts, 2, 1.0, 2.0, 0, 0)
    assert read(reader, big) == said(message)
    assert read(reader, bytes(data)) == said(message)


@given(joint_states(), st.data())
def test_what_is_cut_or_no_plain_cdr_is_left_alone(message, data):
    whole = serialize_message(message)
    reader = JointStates()
    cut = whole[: data.draw(st.integers(0, 23))]
    assert reader.read(cut) is None
    assert reader.read(b"\0\7" + whole[2:]) is None
    assert read(reader, whole) == said(message)


@given(st.binary(max_size=80), st.binary(max_size=80))
def test_any_bytes_are_read_or_not_but_nothing_else(first, second):
    reader = JointStates()
    for data in (first, b"\0\1\0\0" + second):
        found = reader.read(data)
        assert found is None or isinstance(found[0], int)


@given(NUMBERS)
def test_numbers_are_written_as_rclpy_does(numbers):
    written = multiarray_header(len(numbers)) + struct.pack(f"={len(numbers)}d", *numbers)
    assert rclpy.serialization.deserialize_message(written, Float64MultiArray).data.tolist() == numbers
