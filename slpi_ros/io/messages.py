"""Decoding and encoding of serialised messages: JointState, JointTrajectory and other types of recorded signals."""

import struct
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from slpi_ros.arrays import FloatArray, IntArray
from slpi_ros.errors import RecordError
from slpi_ros.io.cdr import CdrLayout, CdrReader, serialise
from slpi_ros.io.input_limits import MOST_AXES, LimitError, require_count

JOINT_STATE, JOINT_TRAJECTORY = "sensor_msgs/msg/JointState", "trajectory_msgs/msg/JointTrajectory"
FLOAT64 = "std_msgs/msg/Float64"
SECOND_NS = 1_000_000_000
# header stamps count seconds in int32
_STAMP_END = 2**31 * SECOND_NS
_XYZ = ("x", "y", "z")


def _read_joint_state(reader: CdrReader) -> tuple[str, ...]:
    names = reader.strings()
    for field in ("position", "velocity", "effort"):
        reader.doubles(field)
    return names


def _read_array(reader: CdrReader) -> tuple[str, ...]:
    dimensions = reader.integer()
    require_count(dimensions, MOST_AXES, "dimensions of an array")
    for _ in range(dimensions):
        reader.string()
        reader.integer()
        reader.integer()
    reader.integer()
    count, _ = reader.doubles("data")
    require_count(count, MOST_AXES, "values in a message")
    return tuple(map(str, range(count)))


def _fixed(*fields: str, names: tuple[str, ...] = ("0",)) -> Callable[[CdrReader], tuple[str, ...]]:
    """Return how fields are read that hold a number for each name."""

    def read(reader: CdrReader) -> tuple[str, ...]:
        for field in fields:
            reader.doubles(field, len(names))
        return names

    return read


@dataclass(frozen=True)
class MessageType:
    """Rules for decoding one message type."""

    stamped: bool  # begins with a header
    named: bool  # there may be several columns, which have names, such as joint names; otherwise they are numbered
    fields: tuple[str, ...]  # that contain the numbers
    read: Callable[[CdrReader], tuple[str, ...]]  # everything after the header; returns the names of the columns


MESSAGE_TYPES = {
    JOINT_STATE: MessageType(True, True, ("position", "effort"), _read_joint_state),
    FLOAT64: MessageType(False, False, ("data",), _fixed("data")),
    "std_msgs/msg/Float64MultiArray": MessageType(False, False, ("data",), _read_array),
    "geometry_msgs/msg/Vector3Stamped": MessageType(True, True, ("vector",), _fixed("vector", names=_XYZ)),
}
_MEASURED = {"Temperature": "temperature", "RelativeHumidity": "relative_humidity", "FluidPressure": "fluid_pressure"}
# Types of quantities that are recorded beside a stage.
QUANTITY_TYPES = {
    # A variance follows the value.
    **{
        f"sensor_msgs/msg/{name}": MessageType(True, False, (field,), _fixed(field, "variance"))
        for name, field in _MEASURED.items()
    },
    FLOAT64: MESSAGE_TYPES[FLOAT64],
    "geometry_msgs/msg/WrenchStamped": MessageType(
        True, True, ("force", "torque"), _fixed("force", "torque", names=_XYZ)
    ),
    JOINT_STATE: MESSAGE_TYPES[JOINT_STATE],
}
_KINDS = MESSAGE_TYPES | QUANTITY_TYPES


def kind_of(msgtype: str) -> MessageType:
    """Return the rules for decoding one of the `MESSAGE_TYPES` or `QUANTITY_TYPES`."""
    return _KINDS[msgtype]


@dataclass(frozen=True)
class Message:
    """Decoded message."""

    stamp_ns: int  # 0 without header
    frame_id: str
    names: tuple[str, ...]  # of the columns, K
    values: Mapping[str, FloatArray]  # by field; n < K: without the last columns
    layout: CdrLayout  # of all messages with the same strings and lengths

    def is_regular(self) -> bool:
        """Return whether there are names, all different, and every field has one number for each name."""
        count = len(set(self.names))
        return count > 0 and all(len(self.names) == count == values.size for values in self.values.values())


def read_message(data: bytes, msgtype: str) -> Message:
    """Decode a serialised message of a type of `kind_of`; struct.error or UnicodeDecodeError if it is not valid."""
    kind, reader = kind_of(msgtype), CdrReader(data)
    stamp_ns, frame_id = 0, ""
    if kind.stamped:
        stamp_ns = reader.integer("i", "sec") * SECOND_NS + reader.integer("I", "nanosec")
        frame_id = reader.string()
    names = kind.read(reader)
    return Message(stamp_ns, frame_id, names, {field: reader.array(field) for field in kind.fields}, reader.layout())


def encode_joint_states(
    stamp_ns: IntArray, position: FloatArray, effort: FloatArray, names: tuple[str, ...], frame_id: str = ""
) -> Iterator[bytes]:
    """Return one serialised message for each header stamp (ns), shape (N,); positions (m) and voltages (V), (N, K)."""
    if not names:
        raise RecordError("a stage_state message needs at least one axis name")
    unfit = (stamp_ns < 0) | (stamp_ns >= _STAMP_END)
    if unfit.any():
        raise RecordError(
            f"sample {int(unfit.argmax())}: time {stamp_ns[unfit][0] / SECOND_NS:g} s does not "
            "fit into a message stamp (0 to 2^31 s); shift the time axis"
        )
    encoder = JointStateEncoder(names, frame_id)
    return (encoder.encode(int(stamp), *numbers) for stamp, *numbers in zip(stamp_ns, position, effort, strict=True))


def _joint_state(names: Sequence[str], frame_id: str) -> bytes:
    """Return a serialised message with zeros for stamp, positions and efforts."""
    zeros = (0.0,) * len(names)
    return serialise(0, 0, frame_id, len(names), *names, zeros, (), zeros)


class JointStateEncoder:
    """Encoder of the JointState messages of one publisher; in each of them only the numbers change."""

    def __init__(self, names: Sequence[str], frame_id: str) -> None:
        template = _joint_state(names, frame_id)
        self._data = bytearray(template)
        fields = read_message(template, JOINT_STATE).layout.fields
        self._stamp, self._numbers = struct.Struct("<2I"), struct.Struct(f"<{len(names)}d")
        self._places = tuple(fields[name][1] for name in ("sec", "position", "effort"))

    def encode(self, stamp_ns: int, positions: Sequence[float], efforts: Sequence[float]) -> bytes:
        """Return the message of one header stamp (ns), with positions (m) and efforts (V) of all names."""
        stamp, position, effort = self._places
        self._stamp.pack_into(self._data, stamp, *divmod(stamp_ns, SECOND_NS))
        self._numbers.pack_into(self._data, position, *positions)
        self._numbers.pack_into(self._data, effort, *efforts)
        return bytes(self._data)


# Number of values before the strings: encapsulation, seconds, nanoseconds.
FIRST = 3


class JointStates:
    """Decoder of the JointState messages of one topic; one ``unpack`` per message as long as the layout is the same."""

    def __init__(self) -> None:
        self._struct = struct.Struct("2s2x")
        self._kind = b""
        self._fixed: tuple[Any, ...] = ()
        self._fixed_end = FIRST
        self._names: tuple[str, ...] = ()

    def read(self, data: bytes) -> tuple[int, tuple[str, ...], Sequence[float]] | None:
        """Return stamp (ns), names and positions of a serialised message; None if it cannot be decoded."""
        try:
            values = self._struct.unpack_from(data)
            known = values[FIRST : self._fixed_end] == self._fixed and values[0] == self._kind
        except struct.error:
            known = False
        if not known:
            try:
                values = self._learn(data)
            except (struct.error, UnicodeDecodeError, MemoryError, LimitError):
                return None
        return values[1] * SECOND_NS + values[2], self._names, values[self._fixed_end :]

    def _learn(self, data: bytes) -> tuple[Any, ...]:
        """Read a message value by value and store its layout up to the positions; return the values."""
        reader = CdrReader(data)
        reader.integer("i")
        reader.integer()
        reader.string()
        names = reader.strings()
        count, _ = reader.doubles()
        unpacker = reader.struct()
        values = unpacker.unpack_from(data)
        self._fixed_end = len(values) - count
        self._struct, self._names = unpacker, names
        self._kind, self._fixed = values[0], values[FIRST : self._fixed_end]
        return values


# Size of a trajectory point with empty arrays, bytes.
SMALLEST_POINT = 24


@dataclass(frozen=True)
class TrajectoryArrays:
    """Decoded JointTrajectory."""

    start_ns: int  # header stamp
    names: tuple[str, ...]
    time_from_start_ns: IntArray  # (N,)
    values: FloatArray  # of the field that was read: positions in m, or effort in V; (N, names)


def decode_trajectory(data: bytes, field: str = "positions") -> TrajectoryArrays | None:
    """Decode a serialised JointTrajectory; return None if its points differ in layout or the message is invalid."""
    # Points of equal layout are decoded as one array, which is much faster than point by point.
    try:
        return _decode(data, field)
    except (struct.error, UnicodeDecodeError, IndexError, ValueError, TypeError, MemoryError, LimitError):
        return None


def _read_head(reader: CdrReader) -> tuple[int, tuple[str, ...], int]:
    """Read what is before the points of a JointTrajectory; return its stamp (ns), names, and the number of points."""
    start_ns = reader.integer("i") * SECOND_NS + reader.integer()
    reader.string()
    return start_ns, reader.strings(), reader.integer()


def _read_point(reader: CdrReader, field: str) -> int:
    """Read a point of a JointTrajectory; return the number of values in a field."""
    counts = {each: reader.doubles(each)[0] for each in ("positions", "velocities", "accelerations", "effort")}
    reader.integer("i", "sec")
    reader.integer("I", "nanosec")
    return counts[field]


def _decode(data: bytes, field: str) -> TrajectoryArrays | None:
    reader = CdrReader(data)
    start_ns, names, points = _read_head(reader)
    if points * SMALLEST_POINT > len(data):
        return None
    times, read = np.empty(points, np.int64), np.empty((points, len(names)), order="F")
    done = 0
    while done < points:
        begin = reader.at
        if _read_point(reader, field) != len(names):
            return None
        size = reader.at - begin
        # Only the first point may have another alignment (offset modulo eight) than the points after it.
        alike = 1 if done == 0 else points - done
        block = np.frombuffer(data, np.uint8, alike * size, begin).reshape(alike, size)
        rows = reader.layout(begin).decode(block)
        if rows is None:
            return None
        times[done : done + alike] = rows["sec"].astype(np.int64) * SECOND_NS + rows["nanosec"]
        read[done : done + alike] = rows[field]
        done += alike
    return TrajectoryArrays(start_ns, names, times, read)


def encode_trajectory(
    stamp_ns: int, names: Sequence[str], times_ns: IntArray, positions: FloatArray, effort: FloatArray
) -> bytes:
    """Return a serialised JointTrajectory: times (ns) since its stamp (N,), positions (m) and effort (V), (N, K).

    Positions of shape (N, 0) are left out.
    """
    point = [0.0] * positions.shape[1], (), (), [0.0] * effort.shape[1], 0, 0
    template = serialise(*divmod(stamp_ns, SECOND_NS), "", len(names), *names, len(times_ns), *point, *point)
    reader = CdrReader(template)
    _read_head(reader)
    parts = [template[: reader.at]]
    # Only the first point may begin at another place within eight bytes.
    for rows in (slice(0, 1), slice(1, None)):
        begin = reader.at
        _read_point(reader, "positions")
        data = np.tile(np.frombuffer(template[begin : reader.at], np.uint8), len(times_ns[rows]))
        points = data.view(reader.layout(begin).dtype(reader.at - begin))
        points["sec"], points["nanosec"] = np.divmod(times_ns[rows], SECOND_NS)
        points["positions"], points["effort"] = positions[rows], effort[rows]
        parts.append(data.tobytes())
    return b"".join(parts)
