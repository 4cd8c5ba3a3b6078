"""Serialized JointStates that are not laid out as usual."""

from collections.abc import Sequence

from rclpy.serialization import deserialize_message
from sensor_msgs.msg import JointState

from slpi_ros.io.joint_state import SECOND_NS


def as_rclpy_reads(data: bytes) -> tuple[int, Sequence[str], Sequence[float]]:
    """Return stamp (ns), names and positions of a serialized JointState; one that makes no sense names nothing."""
    try:
        message = deserialize_message(data, JointState)
    except RuntimeError:
        return 0, (), ()
    stamp = message.header.stamp
    return stamp.sec * SECOND_NS + stamp.nanosec, message.name, message.position
