"""CDR, the wire format of ROS 2: many messages of one layout as one structured array.

Messages whose strings and array lengths do not change differ only in their numbers, which stay at fixed offsets.
Decoding a whole recording that way is many times faster than message by message.
"""

import struct
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

ByteArray = NDArray[np.uint8]

# "plain CDR, little-endian" and two bytes of options; alignment counts from behind them.
_ENCAPSULATION = b"\x00\x01\x00\x00"


@dataclass(frozen=True)
class CdrLayout:
    """Where everything is in messages of one layout.

    Parameters
    ----------
    template : ndarray of uint8, shape (M,)
        A whole message with zeros for its numbers.
    fixed : ndarray of bool, shape (M,)
        The bytes that are the same in every such message: no numbers, and no padding, which holds garbage.
    fields : mapping of str to (dtype, int)
        NumPy type and first byte of what is not fixed.
    """

    template: ByteArray
    fixed: NDArray[np.bool_]
    fields: Mapping[str, tuple[Any, int]]

    def decode(self, rows: ByteArray) -> NDArray[np.void] | None:
        """Return the fields of all messages, or None when one of them has another layout.

        Parameters
        ----------
        rows : ndarray of uint8, shape (N, L)
            Serialised messages; what follows the message proper is ignored, as some writers append garbage.

        Returns
        -------
        structured ndarray, shape (N,)
            A view of `rows`.
        """
        size = self.template.size
        if rows.shape[1] < size or not ((rows[:, :size] == self.template) | ~self.fixed).all():
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


class CdrBuilder:
    """Appends values to a message and remembers which bytes are fixed."""

    def __init__(self) -> None:
        self._data = bytearray(_ENCAPSULATION)
        self._fixed = bytearray(b"\x01\x01\x00\x00")
        self._fields: dict[str, tuple[Any, int]] = {}

    def layout(self) -> CdrLayout:
        """Return the layout of what has been appended."""
        template = np.frombuffer(bytes(self._data), np.uint8)
        return CdrLayout(template, np.frombuffer(bytes(self._fixed), np.uint8).astype(bool), dict(self._fields))

    def count(self, number: int) -> None:
        """Append a fixed unsigned integer of 32 bits: the length of an array, most often."""
        self._append(struct.pack("<I", number), 4, fixed=True)

    def string(self, text: str) -> None:
        """Append a fixed string."""
        data = text.encode() + b"\0"
        self.count(len(data))
        self._append(data, 1, fixed=True)

    def integer(self, name: str, kind: str) -> None:
        """Append an integer of 32 bits that varies."""
        self._fields[name] = (kind, self._append(bytes(4), 4, fixed=False))

    def header(self, frame_id: str) -> None:
        """Append a ``std_msgs/Header`` whose stamp varies."""
        self.integer("sec", "<i4")
        self.integer("nanosec", "<u4")
        self.string(frame_id)

    def doubles(self, name: str, number: int) -> None:
        """Append so many doubles that vary."""
        # nothing is no double: no alignment for what does not come
        offset = self._append(bytes(8 * number), 8 if number else 1, fixed=False)
        self._fields[name] = (("<f8", (number,)), offset)

    def sequence(self, name: str, number: int) -> None:
        """Append an array of doubles that vary, with its fixed length before it."""
        self.count(number)
        self.doubles(name, number)

    def _append(self, data: bytes, align: int, fixed: bool) -> int:
        gap = (len(_ENCAPSULATION) - len(self._data)) % align
        start = len(self._data) + gap
        self._data += bytes(gap) + data
        self._fixed += bytes(gap) + bytes([fixed]) * len(data)
        return start


# Alignment counts from behind the encapsulation.
ENCAPSULATION = 4
# Plain CDR, which every DDS of ROS 2 sends; the second byte tells the order of bytes.
BYTE_ORDERS = {b"\0\0": ">", b"\0\1": "<"}


class Reader:
    """Reads the parts of a serialized message one by one; struct.error where it is cut off.

    Parameters
    ----------
    data : bytes

    Attributes
    ----------
    order : str
        Of bytes, as the module ``struct`` writes it.
    at : int
        Where the next part begins, but for its alignment.

    Raises
    ------
    struct.error
        If it is not plain CDR.
    """

    def __init__(self, data: bytes) -> None:
        order = BYTE_ORDERS.get(data[:2])
        if order is None:
            raise struct.error("not plain CDR")
        self.order, self.data, self.at = order, data, ENCAPSULATION
        self._format = [order, "2s2x"]

    def layout(self) -> struct.Struct:
        """Return what reads all that has been read so far at once: its encapsulation first, and texts with lengths."""
        return struct.Struct("".join(self._format))

    def number(self, kind: str = "I") -> int:
        """Read an integer of 32 bits."""
        self._align(4)
        (value,) = struct.unpack_from(self.order + kind, self.data, self.at)
        self._passed(4, kind)
        return int(value)

    def string(self) -> str:
        """Read a text; UnicodeDecodeError if it is none."""
        size = self.number()
        text = self.data[self.at : self.at + size]
        if len(text) != size:
            raise struct.error("a text is cut off")
        self._passed(size, f"{size}s")
        return text.rstrip(b"\0").decode()

    def doubles(self) -> tuple[int, int]:
        """Skip an array of doubles; return how many there are, and where they begin."""
        count = self.number()
        if count:
            self._align(8)
        begin = self.at
        self._passed(8 * count, f"{count}d")
        return count, begin

    def _align(self, size: int) -> None:
        gap = -(self.at - ENCAPSULATION) % size
        self._passed(gap, f"{gap}x")

    def _passed(self, size: int, kind: str) -> None:
        self.at += size
        self._format.append(kind)


def multiarray_header(count: int) -> bytes:
    """Return what stands before the doubles, in this machine's order of bytes, of a Float64MultiArray of so many."""
    # No dimensions, no offset; then the doubles begin at a multiple of eight.
    return struct.pack("=2B2x3I4x", 0, sys.byteorder == "little", 0, 0, count)
