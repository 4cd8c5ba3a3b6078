"""A JointTrajectory as it comes over the wire, decoded at once: a million points as objects would take many seconds.

CDR, the wire format of ROS 2: points that hold equally many numbers each differ only in the numbers, at fixed offsets.
"""

import struct
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slpi_ros.errors import RecordError
from slpi_ros.io.cdr import ENCAPSULATION, CdrBuilder, CdrLayout, Reader

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

SECOND_NS = 1_000_000_000

# header stamps count seconds in int32
_STAMP_END = 2**31 * SECOND_NS


@dataclass(frozen=True)
class JointStateBlock:
    """Many messages of one layout.

    Parameters
    ----------
    stamp_ns : ndarray of int64, shape (N,), nanoseconds
        Header stamps.
    position : ndarray, shape (N, K), metres
        One column for each joint.
    effort : ndarray, shape (N, K), volts
        One column for each joint; the stage's drivers put the applied voltage here.
    """

    stamp_ns: NDArray[np.int64]
    position: NDArray[np.float64]
    effort: NDArray[np.float64]


@lru_cache(maxsize=64)
def joint_state_layout(names: tuple[str, ...], frame_id: str = "", velocities: int = 0) -> CdrLayout:
    """Return the layout of messages with these names.

    Parameters
    ----------
    names : tuple of str, length K
        Joint names, each with one position and one effort.
    frame_id : str
        As in the header.
    velocities : int
        Length of the array ``velocity``, which is not read.

    Returns
    -------
    CdrLayout
        Shared between callers: do not write to its arrays.
    """
    if not names:
        raise RecordError("a stage_state message needs at least one axis name")
    builder = CdrBuilder()
    builder.header(frame_id)
    builder.count(len(names))
    for name in names:
        builder.string(name)
    builder.sequence("position", len(names))
    builder.sequence("velocity", velocities)
    builder.sequence("effort", len(names))
    return builder.layout()


def encode_joint_states(block: JointStateBlock, names: tuple[str, ...], frame_id: str = "") -> list[bytes]:
    """Return one serialised message for each stamp.

    Parameters
    ----------
    block : JointStateBlock
        What they hold.
    names : tuple of str, length K
        Joint names.
    frame_id : str
        As in the header.

    Raises
    ------
    RecordError
        If a stamp does not fit into a header: before 1970 or after 2038.
    """
    unfit = (block.stamp_ns < 0) | (block.stamp_ns >= _STAMP_END)
    if unfit.any():
        raise RecordError(
            f"sample {int(unfit.argmax())}: time {block.stamp_ns[unfit][0] / SECOND_NS:g} s does not "
            "fit into a message stamp (0 to 2^31 s); shift the time axis"
        )
    layout = joint_state_layout(names, frame_id)
    size = layout.template.size
    data = np.tile(layout.template, block.stamp_ns.size)
    fields = data.view(layout.dtype(size))
    fields["sec"], fields["nanosec"] = np.divmod(block.stamp_ns, SECOND_NS)
    fields["position"], fields["effort"] = block.position, block.effort
    stream = data.tobytes()
    return [stream[start : start + size] for start in range(0, len(stream), size)]


# Encapsulation, seconds, nanoseconds: what stands before the names.
FIRST = 3


class JointStates:
    """Reads the JointStates of one topic; those that are laid out as the one before with one look."""

    def __init__(self) -> None:
        self._layout = struct.Struct("2s2x")
        self._kind = b""
        self._fixed: tuple[Any, ...] = ()
        self._fixed_end = FIRST
        self._names: tuple[str, ...] = ()

    def read(self, data: bytes) -> tuple[int, tuple[str, ...], Sequence[float]] | None:
        """Return stamp (ns), names and positions of a serialized message; None where they cannot be read."""
        try:
            told = self._layout.unpack_from(data)
            known = told[FIRST : self._fixed_end] == self._fixed and told[0] == self._kind
        except struct.error:
            known = False
        if not known:
            try:
                told = self._learn(data)
            except (struct.error, UnicodeDecodeError, MemoryError):
                return None
        return told[1] * SECOND_NS + told[2], self._names, told[self._fixed_end :]

    def _learn(self, data: bytes) -> tuple[Any, ...]:
        """Read a message part by part, and remember where they are."""
        reader = Reader(data)
        reader.number("i")
        reader.number()
        reader.string()
        names = tuple(reader.string() for _ in range(reader.number()))
        count, _ = reader.doubles()
        layout = reader.layout()
        told = layout.unpack_from(data)
        self._fixed_end = len(told) - count
        self._layout, self._names = layout, names
        self._kind, self._fixed = told[0], told[FIRST : self._fixed_end]
        return told


# positions, velocities, accelerations, effort
SEQUENCES = 4
# Bytes of a point without any numbers.
SMALLEST_POINT = 24


@dataclass(frozen=True)
class TrajectoryArrays:
    """What a JointTrajectory says.

    Parameters
    ----------
    start_ns : int, nanoseconds
        The header's stamp.
    names : tuple of str, length K
    time_from_start_ns : ndarray of int64, shape (N,), nanoseconds
    positions : ndarray, shape (N, K)
    """

    start_ns: int
    names: tuple[str, ...]
    time_from_start_ns: NDArray[np.int64]
    positions: NDArray[np.float64]


@dataclass(frozen=True)
class _Layout:
    """Where the parts of a point are, relative to its begin."""

    counts: tuple[int, ...]
    count_offsets: tuple[int, ...]
    positions: int
    time: int
    size: int

    @classmethod
    def read(cls, reader: Reader) -> "_Layout":
        begin, counts, offsets, places = reader.at, [], [], []
        for _ in range(SEQUENCES):
            offsets.append(reader.at + -(reader.at - ENCAPSULATION) % 4 - begin)
            count, place = reader.doubles()
            counts.append(count)
            places.append(place - begin)
        reader.number("i")
        time = reader.at - 4 - begin
        reader.number()
        return cls(tuple(counts), tuple(offsets), places[0], time, reader.at - begin)


def decode_trajectory(data: bytes) -> TrajectoryArrays | None:
    """Return what a serialized JointTrajectory says; None where its points are not alike, or it is none."""
    try:
        return _decode(data)
    except (struct.error, UnicodeDecodeError, IndexError, ValueError, TypeError, MemoryError):
        return None


def _decode(data: bytes) -> TrajectoryArrays | None:
    reader = Reader(data)
    start_ns = reader.number("i") * SECOND_NS + reader.number()
    reader.string()
    names = tuple(reader.string() for _ in range(reader.number()))
    points = reader.number()
    if points * SMALLEST_POINT > len(data):
        return None
    times, positions = np.empty(points, np.int64), np.empty((points, len(names)), order="F")
    # Only the first point may begin elsewhere relative to the alignment of doubles.
    done = 0
    while done < points:
        begin, layout = reader.at, _Layout.read(reader)
        if layout.counts[0] != len(names):
            return None
        alike = 1 if done == 0 else points - done
        if begin + alike * layout.size > len(data):
            return None
        block = _Block(data, reader.order, begin, alike, layout)
        if not block.is_alike():
            return None
        times[done : done + alike] = block.times()
        positions[done : done + alike] = block.positions()
        done += alike
    return TrajectoryArrays(start_ns, names, times, positions)


@dataclass(frozen=True)
class _Block:
    """Points of one layout, one after the other."""

    data: bytes
    order: str
    begin: int
    points: int
    layout: _Layout

    def column(self, kind: str, offset: int, width: int = 1) -> NDArray[Any]:
        dtype = np.dtype(self.order + kind)
        shape, strides = (self.points, width), (self.layout.size, dtype.itemsize)
        return np.ndarray(shape, dtype, self.data, self.begin + offset, strides)

    def is_alike(self) -> bool:
        pairs = zip(self.layout.counts, self.layout.count_offsets, strict=True)
        return all(bool((self.column("u4", offset) == count).all()) for count, offset in pairs)

    def times(self) -> NDArray[np.int64]:
        seconds = self.column("i4", self.layout.time)[:, 0].astype(np.int64)
        nanoseconds = self.column("u4", self.layout.time + 4)[:, 0].astype(np.int64)
        return seconds * SECOND_NS + nanoseconds

    def positions(self) -> NDArray[Any]:
        return self.column("f8", self.layout.positions, self.layout.counts[0])
