"""CDR, the serialisation of ROS 2: single messages, and many messages of one layout as one structured array.

Messages with the same strings and array lengths differ only in their numbers, which are at fixed offsets. A block of
such messages is decoded by one comparison of the constant bytes and one NumPy view of the numbers.

Reference: OMG, Common Data Representation (DDS-XTypes 1.3, section 7.4). A value of n bytes is aligned to n bytes,
counted from the end of the encapsulation header of four bytes.
"""

import struct
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slpi_ros.arrays import FloatArray, Mask
from slpi_ros.io.input_limits import MOST_AXES, LimitError, require_count

ByteArray = NDArray[np.uint8]

ENCAPSULATION = 4
# Plain CDR, which every DDS of ROS 2 sends; the second byte is the byte order. Two bytes of options follow.
BYTE_ORDERS = {b"\0\0": ">", b"\0\1": "<"}
_DTYPES = {"i": "i4", "I": "u4"}


@dataclass(frozen=True)
class CdrLayout:
    """Offsets of the numbers in messages of one layout."""

    template: ByteArray  # (M,), one message of this layout
    fixed: Mask  # (M,), bytes that all messages share: neither numbers nor padding
    fields: Mapping[str, tuple[Any, int]]  # NumPy type and offset by name

    def decode(self, rows: ByteArray) -> NDArray[np.void] | None:
        """Return the fields of all messages (N, L), shape (N,), a view; None if one of them has another layout."""
        # Bytes after the end of the message are ignored, as some writers append undefined bytes.
        size = self.template.size
        if rows.shape[1] < size or not (rows[:, :size] == self.template)[:, self.fixed].all():
            return None
        return rows.view(self.dtype(rows.shape[1]))[:, 0]

    def dtype(self, length: int) -> np.dtype[np.void]:
        """Return the structured type of one message of `length` bytes."""
        return np.dtype(
            {
                "names": list(self.fields),
                "formats": [kind for kind, _ in self.fields.values()],
                "offsets": [offset for _, offset in self.fields.values()],
                "itemsize": length,
            }
        )


class CdrReader:
    """Reader of one serialised message, value by value, which also determines its layout; struct.error if truncated."""

    def __init__(self, data: bytes) -> None:
        order = BYTE_ORDERS.get(data[:2])
        if order is None:
            raise LimitError("messages that are not plain CDR, as ROS 2 writes them")
        self.order, self.data, self.at = order, data, ENCAPSULATION
        self._format = [order, "2s2x"]
        self._fixed = [(0, 2)]
        self._fields: dict[str, tuple[Any, int]] = {}

    def struct(self) -> struct.Struct:
        """Return a Struct that unpacks all values read so far, in order, after the two encapsulation bytes."""
        return struct.Struct("".join(self._format))

    def layout(self, start: int = 0) -> CdrLayout:
        """Return the layout of the data read from offset `start` on; values read without a name are fixed."""
        fixed = np.zeros(self.at, bool)
        for begin, end in self._fixed:
            fixed[begin:end] = True
        fields = {name: (kind, offset - start) for name, (kind, offset) in self._fields.items() if offset >= start}
        return CdrLayout(np.frombuffer(self.data, np.uint8, self.at - start, start), fixed[start:], fields)

    def integer(self, kind: str = "I", name: str = "") -> int:
        """Read a 32-bit integer, signed (``i``) or unsigned (``I``)."""
        self._align(4)
        (value,) = struct.unpack_from(self.order + kind, self.data, self.at)
        self._pass(4, kind, name, self.order + _DTYPES[kind])
        return int(value)

    def string(self) -> str:
        """Read a string; UnicodeDecodeError if it is not UTF-8."""
        size = self.integer()
        text = self.data[self.at : self.at + size]
        if len(text) != size:
            raise struct.error("a string is cut off")
        self._pass(size, f"{size}s")
        return text.rstrip(b"\0").decode()

    def strings(self) -> tuple[str, ...]:
        """Read a sequence of names; LimitError if there are more than a stage has axes."""
        count = self.integer()
        require_count(count, MOST_AXES, "names in a message")
        return tuple(self.string() for _ in range(count))

    def doubles(self, name: str = "", count: int | None = None) -> tuple[int, int]:
        """Skip `count` doubles, default: a sequence preceded by its length; return their number and offset."""
        number = self.integer() if count is None else count
        if number:
            self._align(8)
        begin = self.at
        if begin + 8 * number > len(self.data):
            raise struct.error("an array is cut off")
        self._pass(8 * number, f"{number}d", name, (self.order + "f8", (number,)))
        return number, begin

    def array(self, name: str) -> FloatArray:
        """Return the doubles that were read with the field name `name`, shape (n,)."""
        (dtype, (count,)), offset = self._fields[name]
        return np.frombuffer(self.data, dtype, count, offset).astype(np.float64)

    def _align(self, size: int) -> None:
        gap = -(self.at - ENCAPSULATION) % size
        self.at += gap
        self._format.append(f"{gap}x")

    def _pass(self, size: int, kind: str, name: str = "", dtype: Any = None) -> None:
        if name:
            self._fields[name] = (dtype, self.at)
        else:
            self._fixed.append((self.at, self.at + size))
        self.at += size
        self._format.append(kind)


def serialise(*values: int | str | Sequence[float]) -> bytes:
    """Return a little-endian message that contains 32-bit unsigned integers, strings and sequences of doubles."""
    data = bytearray(b"\0\1\0\0")
    for value in values:
        if isinstance(value, str):
            text = value.encode() + b"\0"
            part = struct.pack("<I", len(text)) + text
        elif isinstance(value, int):
            part = struct.pack("<I", value)
        else:
            part = struct.pack("<I", len(value))
        data += bytes(-(len(data) - ENCAPSULATION) % 4) + part
        if not isinstance(value, int | str) and value:
            data += bytes(-(len(data) - ENCAPSULATION) % 8) + struct.pack(f"<{len(value)}d", *value)
    return bytes(data)


def float64(value: float) -> bytes:
    """Return a serialised Float64, in this machine's byte order."""
    return struct.pack("=2B2xd", 0, sys.byteorder == "little", value)


def multiarray_header(count: int) -> bytes:
    """Return the CDR header of a Float64MultiArray with `count` doubles, in this machine's byte order."""
    # No dimensions and data offset 0; the doubles then start at a multiple of eight bytes.
    return struct.pack("=2B2x3I4x", 0, sys.byteorder == "little", 0, 0, count)
