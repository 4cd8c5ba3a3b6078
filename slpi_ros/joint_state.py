"""From a stream of ``sensor_msgs/JointState`` messages to one array per joint, and back to messages.

Where the joint names do not change there is a short cut: in CDR, the wire format of ROS 2, such messages
differ only in the stamp and in the numbers, which stay at fixed offsets, so a whole recording is one
structured array. That is many times faster than message by message.
"""

import struct
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slpi_ros.errors import RecordError

NANOSECONDS = 1_000_000_000

# header stamps count seconds in int32
_STAMP_END = 2**31 * NANOSECONDS

# "plain CDR, little-endian" and two bytes of options; alignment counts from behind them.
_ENCAPSULATION = b"\x00\x01\x00\x00"


@dataclass(frozen=True)
class JointSamples:
    """A decoded stream, joint by joint.

    Parameters
    ----------
    stamp_ns : ndarray of int64, shape (N,), nanoseconds
        Header stamps.
    frame_id : str
        The first one that is not empty.
    position, effort : mapping of joint name to ndarray, shape (N,)
        NaN where a message does not hold the joint.
    """

    stamp_ns: NDArray[np.int64]
    frame_id: str
    position: Mapping[str, NDArray[np.float64]]
    effort: Mapping[str, NDArray[np.float64]]


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


@dataclass(frozen=True)
class JointStateLayout:
    """Where everything is in a message with given names.

    Parameters
    ----------
    template : ndarray of uint8, shape (M,)
        A whole message with zeros for the stamp and the numbers.
    fixed : ndarray of bool, shape (M,)
        The bytes that are the same in every such message: no numbers, and no padding, which holds garbage.
    offsets : dict of str to int
        First byte of the stamp and of the two arrays.
    joints : int
        Number of joints K.
    """

    template: NDArray[np.uint8]
    fixed: NDArray[np.bool_]
    offsets: dict[str, int]
    joints: int

    def decode(self, messages: Sequence[bytes]) -> JointStateBlock | None:
        """Return the numbers of all messages, or None when one of them has another layout.

        Parameters
        ----------
        messages : sequence of bytes, length N
            Serialised messages; whatever follows the message proper is ignored (some writers append garbage).
        """
        length = len(messages[0])
        if length < self.template.size or any(len(message) != length for message in messages):
            return None
        data = np.frombuffer(b"".join(messages), np.uint8).reshape(-1, length)
        if (data[:, : self.template.size][:, self.fixed] != self.template[self.fixed]).any():
            return None
        fields = data.reshape(-1).view(self._fields(length))
        stamp = fields["sec"].astype(np.int64) * NANOSECONDS + fields["nanosec"]
        return JointStateBlock(stamp, fields["position"].astype(float), fields["effort"].astype(float))

    def encode(self, block: JointStateBlock) -> list[bytes]:
        """Return one serialised message for each stamp.

        Raises
        ------
        RecordError
            If a stamp does not fit into a header: before 1970 or after 2038.
        """
        unfit = (block.stamp_ns < 0) | (block.stamp_ns >= _STAMP_END)
        if unfit.any():
            raise RecordError(
                f"sample {int(unfit.argmax())}: time {block.stamp_ns[unfit][0] / NANOSECONDS:g} s does not "
                "fit into a message stamp (0 to 2^31 s); shift the time axis"
            )
        size = self.template.size
        data = np.tile(self.template, block.stamp_ns.size)
        fields = data.view(self._fields(size))
        fields["sec"], fields["nanosec"] = np.divmod(block.stamp_ns, NANOSECONDS)
        fields["position"], fields["effort"] = block.position, block.effort
        stream = data.tobytes()
        return [stream[start : start + size] for start in range(0, len(stream), size)]

    def _fields(self, length: int) -> np.dtype[np.void]:
        """Return the structured type of one message of so many bytes."""
        numbers = ("<f8", (self.joints,))
        formats = {"sec": "<i4", "nanosec": "<u4", "position": numbers, "effort": numbers}
        return np.dtype(
            {
                "names": list(formats),
                "formats": list(formats.values()),
                "offsets": [self.offsets[name] for name in formats],
                "itemsize": length,
            }
        )


class _Builder:
    """Appends CDR values to a message and remembers which bytes are fixed."""

    def __init__(self) -> None:
        self.data = bytearray(_ENCAPSULATION)
        self.fixed = bytearray(b"\x01\x01\x00\x00")

    def _append(self, data: bytes, align: int, fixed: bool) -> int:
        gap = (len(_ENCAPSULATION) - len(self.data)) % align
        start = len(self.data) + gap
        self.data += bytes(gap) + data
        self.fixed += bytes(gap) + bytes([fixed]) * len(data)
        return start

    def count(self, number: int) -> None:
        self._append(struct.pack("<I", number), 4, fixed=True)

    def string(self, text: str) -> None:
        data = text.encode() + b"\0"
        self.count(len(data))
        self._append(data, 1, fixed=True)

    def integer(self) -> int:
        return self._append(bytes(4), 4, fixed=False)

    def doubles(self, number: int) -> int:
        self.count(number)
        # an empty sequence is its count alone: no alignment for doubles that do not come
        return self._append(bytes(8 * number), 8 if number else 1, fixed=False)


@lru_cache(maxsize=64)
def joint_state_layout(names: tuple[str, ...], frame_id: str = "", velocities: int = 0) -> JointStateLayout:
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
    JointStateLayout
        Shared between callers: do not write to its arrays.
    """
    if not names:
        raise RecordError("a stage_state message needs at least one axis name")
    builder = _Builder()
    offsets = {"sec": builder.integer(), "nanosec": builder.integer()}
    builder.string(frame_id)
    builder.count(len(names))
    for name in names:
        builder.string(name)
    offsets["position"] = builder.doubles(len(names))
    builder.doubles(velocities)
    offsets["effort"] = builder.doubles(len(names))
    template = np.frombuffer(bytes(builder.data), np.uint8)
    fixed = np.frombuffer(bytes(builder.fixed), np.uint8).astype(bool)
    return JointStateLayout(template, fixed, offsets, len(names))


def decode_joint_states(messages: Sequence[bytes], deserialise: Callable[[bytes], Any]) -> JointSamples:
    """Decode a stream of messages, all at once if they are alike.

    Parameters
    ----------
    messages : sequence of bytes, length N >= 1
        Serialised messages.
    deserialise : callable
        Makes one of them an object with the fields of ``sensor_msgs/JointState``.

    Returns
    -------
    JointSamples
        Joints in the order in which the messages first name them.
    """
    alike = _decode_alike(messages, deserialise(messages[0]))
    return alike or _decode_each([deserialise(message) for message in messages])


def _decode_alike(messages: Sequence[bytes], first: Any) -> JointSamples | None:
    """Decode messages that all have the layout of the first one; None when they do not."""
    names = tuple(first.name)
    if not len(set(names)) == len(names) == len(first.position) == len(first.effort) > 0:
        return None
    layout = joint_state_layout(names, first.header.frame_id, len(first.velocity))
    block = layout.decode(messages)
    if block is None:
        return None
    return JointSamples(
        block.stamp_ns,
        first.header.frame_id,
        {name: block.position[:, column].copy() for column, name in enumerate(names)},
        {name: block.effort[:, column].copy() for column, name in enumerate(names)},
    )


def _decode_each(messages: Sequence[Any]) -> JointSamples:
    """Match every message's numbers to the joints by name."""
    names = list(dict.fromkeys(name for message in messages for name in message.name))
    position = {name: np.full(len(messages), np.nan) for name in names}
    effort = {name: np.full(len(messages), np.nan) for name in names}
    for row, message in enumerate(messages):
        # zip ends with the shorter one: a joint behind the end of an array has no value
        for signal, values in ((position, message.position), (effort, message.effort)):
            for name, value in zip(message.name, values, strict=False):
                signal[name][row] = value
    stamps = [m.header.stamp.sec * NANOSECONDS + m.header.stamp.nanosec for m in messages]
    frame_id = next((m.header.frame_id for m in messages if m.header.frame_id), "")
    return JointSamples(np.array(stamps, np.int64), frame_id, position, effort)


def choose_joints(samples: JointSamples, axes: Sequence[str] | None, where: str) -> tuple[str, ...]:
    """Return the wanted joints, by default all, once it is sure that each has both signals.

    Raises
    ------
    RecordError
        If there is no such joint, or one without any position or effort; begins with `where`.
    """
    names = ", ".join(samples.position)
    if not names:
        raise RecordError(f"{where}: the messages name no axis; name[] must hold the axes")
    chosen = tuple(axes or samples.position)
    for axis in chosen:
        if axis not in samples.position:
            raise RecordError(f"{where}: no axis '{axis}'; there is {names}")
        for signal, field in ((samples.position, "position"), (samples.effort, "effort")):
            if np.isnan(signal[axis]).all():
                raise RecordError(
                    f"{where}: axis '{axis}' has no value in {field}[] of any message; position[] must hold "
                    f"the measured metres, effort[] the applied volts; else read other axes, of {names}"
                )
    return chosen
