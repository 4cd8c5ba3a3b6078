"""Serialised messages of one topic, many at a time: what the readers of bag files yield."""

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slpi_ros.io.cdr import ByteArray

# Messages taken together where the file does not group them itself.
BLOCK = 4_000

_ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"


@dataclass(frozen=True)
class MessageBlock:
    """Some messages of a topic.

    Parameters
    ----------
    logged : ndarray of int64, shape (n,), nanoseconds
        When each was recorded.
    messages : ndarray of uint8, shape (n, L), or list of bytes, length n
        The former where all have the same length L.
    """

    logged: NDArray[np.int64]
    messages: ByteArray | list[bytes]

    @classmethod
    def of(cls, logged: Sequence[int], messages: Sequence[bytes]) -> "MessageBlock":
        """Make a block of single messages, decompressed where the recorder compressed each of them."""
        times = np.array(logged, np.int64)
        if len(set(map(len, messages))) == 1 and messages[0]:
            rows = np.frombuffer(b"".join(messages), np.uint8).reshape(len(messages), -1)
            if not is_compressed(rows):
                return cls(times, rows)
        if any(message[:4] == _ZSTD_MAGIC for message in messages):
            return cls.of(logged, [_unpacked(message) for message in messages])
        return cls(times, list(messages))

    def each(self) -> list[bytes]:
        """Return the messages one by one."""
        if isinstance(self.messages, list):
            return self.messages
        return [row.tobytes() for row in self.messages]


def is_compressed(rows: ByteArray) -> bool:
    """Say whether any of the messages, shape (n, L), was compressed by the recorder: CDR begins otherwise."""
    magic = np.frombuffer(_ZSTD_MAGIC, np.uint8)
    return rows.shape[1] >= magic.size and bool((rows[:, : magic.size] == magic).all(axis=1).any())


def _unpacked(message: bytes) -> bytes:
    return decompressed(message, "zstd") if message[:4] == _ZSTD_MAGIC else message


def decompressed(data: bytes, compression: str) -> bytes:
    """Return what was compressed, by one of the compressions of MCAP and rosbag2.

    Raises
    ------
    ValueError
        If there is no such compression.
    """
    match compression:
        case "":
            return data
        case "zstd":
            return bytes(zstd().decompress(data))
        case "lz4":
            # Rarely needed; rosbags brings it, as it does zstd.
            from lz4.frame import decompress  # type: ignore[import-untyped]

            return bytes(decompress(data))
    raise ValueError(f"compression {compression!r} is not known")


def zstd() -> Any:
    """Return the module for zstd, which is part of Python from 3.14 on."""
    if sys.version_info >= (3, 14):
        from compression import zstd as module
    else:
        from backports import zstd as module
    return module
