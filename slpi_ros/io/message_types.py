"""The types of message that can hold a voltage or a displacement, and what is where in them."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from slpi_ros.io.cdr import CdrBuilder, CdrLayout
from slpi_ros.io.joint_state import joint_state_layout

JOINT_STATE = "sensor_msgs/msg/JointState"


@dataclass(frozen=True)
class MessageType:
    """How one type of message is read.

    Parameters
    ----------
    stamped : bool
        Whether it has a header.
    named : bool
        Whether it names what its numbers belong to; else they are numbered.
    fields : tuple of str
        Those that hold its numbers.
    names : callable
        From a message to one name for each column.
    values : callable
        From a message to its numbers, field by field; one that is shorter than the names lacks the last of them.
    layout : callable
        From a message to the layout of all that are like it, with the same fields; None where it has no regular one.
    """

    stamped: bool
    named: bool
    fields: tuple[str, ...]
    names: Callable[[Any], tuple[str, ...]]
    values: Callable[[Any], Mapping[str, Sequence[float]]]
    layout: Callable[[Any], CdrLayout | None]


def _joint_state_layout(message: Any) -> CdrLayout | None:
    names = tuple(message.name)
    if not len(set(names)) == len(names) == len(message.position) == len(message.effort) > 0:
        return None
    return joint_state_layout(names, message.header.frame_id, len(message.velocity))


def _number_layout(_: Any) -> CdrLayout:
    builder = CdrBuilder()
    builder.doubles("data", 1)
    return builder.layout()


def _array_layout(message: Any) -> CdrLayout | None:
    if not len(message.data):
        return None
    builder = CdrBuilder()
    builder.count(len(message.layout.dim))
    for dimension in message.layout.dim:
        builder.string(dimension.label)
        builder.count(dimension.size)
        builder.count(dimension.stride)
    builder.count(message.layout.data_offset)
    builder.sequence("data", len(message.data))
    return builder.layout()


def _vector_layout(message: Any) -> CdrLayout:
    builder = CdrBuilder()
    builder.header(message.header.frame_id)
    builder.doubles("vector", 3)
    return builder.layout()


MESSAGE_TYPES = {
    JOINT_STATE: MessageType(
        stamped=True,
        named=True,
        fields=("position", "effort"),
        names=lambda message: tuple(message.name),
        values=lambda message: {"position": message.position, "effort": message.effort},
        layout=_joint_state_layout,
    ),
    "std_msgs/msg/Float64": MessageType(
        stamped=False,
        named=False,
        fields=("data",),
        names=lambda _: ("0",),
        values=lambda message: {"data": (message.data,)},
        layout=_number_layout,
    ),
    "std_msgs/msg/Float64MultiArray": MessageType(
        stamped=False,
        named=False,
        fields=("data",),
        names=lambda message: tuple(str(column) for column in range(len(message.data))),
        values=lambda message: {"data": message.data},
        layout=_array_layout,
    ),
    "geometry_msgs/msg/Vector3Stamped": MessageType(
        stamped=True,
        named=True,
        fields=("vector",),
        names=lambda _: ("x", "y", "z"),
        values=lambda message: {"vector": (message.vector.x, message.vector.y, message.vector.z)},
        layout=_vector_layout,
    ),
}
