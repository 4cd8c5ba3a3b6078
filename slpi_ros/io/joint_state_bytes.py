"""JointStates as they come over the wire: those of one sender differ in their stamps and positions only.

To build such a message as an object takes several times as long as to compensate what it says.
"""

import struct
from collections.abc import Sequence
from typing import Any

from slpi_ros.io.joint_state import SECOND_NS
from slpi_ros.io.wire import Reader

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
