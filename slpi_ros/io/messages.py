"""A JointTrajectory as it comes over the wire, decoded at once: a million points as objects would take many seconds.

CDR, the wire format of ROS 2: points that hold equally many numbers each differ only in the numbers, at fixed offsets.
"""

import struct
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slpi_ros.io.joint_state import SECOND_NS
from slpi_ros.io.wire import ENCAPSULATION, Reader

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
