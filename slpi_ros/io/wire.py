"""CDR, the wire format of ROS 2: messages read part by part, and the one that is written."""

import struct
import sys

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


def before_numbers(count: int) -> bytes:
    """Return what stands before the doubles, in this machine's order of bytes, of a Float64MultiArray of so many."""
    # No dimensions, no offset; then the doubles begin at a multiple of eight.
    return struct.pack("=2B2x3I4x", 0, sys.byteorder == "little", 0, 0, count)
