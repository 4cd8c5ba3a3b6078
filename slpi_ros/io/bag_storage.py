"""Reading of the raw messages of one topic from an MCAP or SQLite file, in blocks.

MCAP files are read chunk by chunk, without a loop over the messages: ten times as fast as with rosbags. Format:
https://mcap.dev/spec. A file is a sequence of records. Most of them are chunks, which contain further records; each
chunk is followed by indexes of its messages. Chunks without the wanted topic are skipped.
"""

import sqlite3
import struct
import sys
import zlib
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from slpi_ros.arrays import IntArray
from slpi_ros.io.cdr import ByteArray
from slpi_ros.io.input_limits import CHUNK_BYTES, MESSAGE_BYTES, LimitError, most_unpacked

# Number of messages per block where the file itself has no chunks.
BLOCK = 4_000

_ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"


@dataclass(frozen=True)
class MessageBlock:
    """Block of consecutive serialised messages of one topic."""

    logged: IntArray  # ns, (n,), recording times
    messages: ByteArray | list[bytes]  # (n, L) if all have the same length L

    @classmethod
    def of(cls, logged: Sequence[int], messages: Sequence[bytes]) -> "MessageBlock":
        """Return a block of the given messages, decompressed if the recorder compressed each message."""
        times = np.array(logged, np.int64)
        if len(set(map(len, messages))) == 1 and messages[0]:
            rows = np.frombuffer(b"".join(messages), np.uint8).reshape(len(messages), -1)
            if not is_compressed(rows):
                return cls(times, rows)
        if any(map(is_packed, messages)):
            return cls.of(logged, list(_unpacked(messages)))
        return cls(times, list(messages))

    def each(self) -> list[bytes]:
        """Return the messages as a list."""
        if isinstance(self.messages, list):
            return self.messages
        return [row.tobytes() for row in self.messages]


def is_compressed(rows: ByteArray) -> bool:
    """Return whether any message, shape (n, L), begins with the zstd signature instead of a CDR header."""
    magic = np.frombuffer(_ZSTD_MAGIC, np.uint8)
    return rows.shape[1] >= magic.size and bool((rows[:, : magic.size] == magic).all(axis=1).any())


def is_packed(data: bytes) -> bool:
    """Return whether data begin with the zstd signature."""
    return data[:4] == _ZSTD_MAGIC


def _unpacked(messages: Iterable[bytes]) -> Iterator[bytes]:
    """Yield the messages of a block, unpacked; LimitError if they are larger than a chunk."""
    left = CHUNK_BYTES
    for message in messages:
        plain = decompressed(message, "zstd", left) if is_packed(message) else message
        left -= len(plain)
        yield plain


def decompressed(data: bytes, compression: str, most: int) -> bytes:
    """Decompress ("", "zstd", "lz4") to at most `most` bytes, else LimitError; EOFError if the data are cut off."""
    unpacked = b""
    while data:
        if compression == "":
            return data
        if compression == "zstd":
            decoder = zstd().ZstdDecompressor()
        elif compression == "lz4":
            # Rarely needed; lz4 is installed with rosbags, as is zstd.
            from lz4.frame import LZ4FrameDecompressor  # type: ignore[import-untyped]

            decoder = LZ4FrameDecompressor()
        else:
            raise ValueError(f"compression {compression!r} is not known")
        part = bytes(decoder.decompress(data, max_length=most + 1 - len(unpacked)))
        unpacked = unpacked + part if unpacked else part
        if len(unpacked) > most:
            raise LimitError(f"more than {most} bytes in one packed part")
        if not decoder.eof:
            raise EOFError("a packed part is cut off")
        # Several frames may follow each other.
        data = decoder.unused_data or b""
    return unpacked


def zstd() -> Any:
    """Return the module for zstd, which is part of Python since version 3.14."""
    if sys.version_info >= (3, 14):
        from compression import zstd as module
    else:
        from backports import zstd as module
    return module


# The first and last bytes of an MCAP file.
MCAP_END = b"\x89MCAP0\r\n"
_SCHEMA, _CHANNEL, _MESSAGE, _CHUNK, _MESSAGE_INDEX, _STATISTICS, _DATA_END = 0x03, 0x04, 0x05, 0x06, 0x07, 0x0B, 0x0F
# In the statistics, where the numbers of messages by channel begin, and each of them.
_COUNTS_AT, _COUNTED = 46, struct.Struct("<HQ")
_MAGIC_SIZE, _FOOTER_SIZE = 8, 37
_RECORD = struct.Struct("<BQ")
_CHUNK_HEAD = struct.Struct("<QQQII")
_INDEX_HEAD = struct.Struct("<HI")

# Header of a message record, which precedes the data of the message.
_MESSAGE_HEAD = np.dtype(
    [("op", "u1"), ("length", "<u8"), ("channel", "<u2"), ("sequence", "<u4"), ("log", "<u8"), ("publish", "<u8")]
)
# Bytes of the length of a message record that are not data.
_HEAD_IN_LENGTH = _MESSAGE_HEAD.itemsize - _RECORD.size


@dataclass(frozen=True)
class Connection:
    """Topic in a bag file, with the type and the encoding of its messages; a topic may have several."""

    topic: str
    msgtype: str  # as ``sensor_msgs/msg/JointState``
    encoding: str  # ``cdr`` for all of ROS 2
    count: int
    number: int  # in its file


def _connection(topic: str, msgtype: str, encoding: str, count: int, number: int) -> Connection:
    """Return a connection whose type is written as in ROS 2, whatever short name or name of DDS it has."""
    parts = [part.removesuffix("_") for part in msgtype.replace("::", "/").split("/") if part != "dds_"]
    short = len(parts) == 2 and encoding in ("cdr", "")
    return Connection(topic, "/".join([parts[0], "msg", parts[1]] if short else parts), encoding, count, number)


class McapFile:
    """Reader of a complete MCAP file; any exception if it is damaged."""

    def __init__(self, file: BinaryIO) -> None:
        self._file = file
        self._schemas: dict[int, str] = {}
        self._channels: dict[int, tuple[str, int, str]] = {}
        self._counts: dict[int, int] = {}
        self._end = file.seek(-_FOOTER_SIZE, 2)
        self._left = most_unpacked(self._end)
        if self._read(self._end + _FOOTER_SIZE - _MAGIC_SIZE, _MAGIC_SIZE) != MCAP_END:
            raise EOFError("no end of the file")
        summary = int.from_bytes(self._read(self._end + _RECORD.size, 8), "little")
        for op, start, length in self._records(summary or _MAGIC_SIZE):
            # Without a summary, channels are announced anywhere.
            if op == _CHUNK and not summary:
                self._walk(self._unpack(start, length), set())
            elif op in (_SCHEMA, _CHANNEL, _STATISTICS):
                self._learn(op, self._read(start, length))
        self._left = most_unpacked(self._end)

    @property
    def connections(self) -> list[Connection]:
        """Topics of the file; one whose messages are not counted is taken to have one."""
        counted = self._counts or dict.fromkeys(self._channels, 1)
        return [
            _connection(topic, self._schemas.get(schema, ""), encoding, counted.get(number, 0), number)
            for number, (topic, schema, encoding) in self._channels.items()
        ]

    def blocks(self, channels: set[int]) -> Iterator[MessageBlock]:
        """Yield the messages of some channels, chunk by chunk, as written."""
        chunk: tuple[int, int] | None = None
        indexes: list[bytes] = []
        bare: list[tuple[int, bytes]] = []
        for op, start, length in self._records(_MAGIC_SIZE):
            if op == _MESSAGE_INDEX:
                indexes.append(self._read(start, length))
                continue
            if chunk:
                yield from self._chunk(*chunk, indexes, channels)
                chunk, indexes = None, []
            if op == _CHUNK:
                chunk = start, length
            elif op == _MESSAGE and int.from_bytes(self._read(start, 2), "little") in channels:
                data = self._read(start, length)
                bare.append((int.from_bytes(data[6:14], "little"), data[_HEAD_IN_LENGTH:]))
            if len(bare) == BLOCK or (bare and op == _DATA_END):
                yield MessageBlock.of(*zip(*bare, strict=True))
                bare = []
            if op == _DATA_END:
                return
        raise EOFError("no end of the data section")

    def _records(self, position: int) -> Iterator[tuple[int, int, int]]:
        """Yield type, offset and length of the records from `position` to the footer."""
        while position < self._end:
            op, length = _RECORD.unpack(self._read(position, _RECORD.size))
            position += _RECORD.size
            if position + length > self._end:
                raise EOFError(f"record of {length} bytes at {position} reaches beyond the end")
            yield op, position, length
            position += length

    def _read(self, position: int, size: int) -> bytes:
        self._file.seek(position)
        if size > CHUNK_BYTES:
            raise LimitError(f"record of {size} bytes at {position}, larger than any recorder writes")
        data = self._file.read(size)
        if len(data) < size:
            raise EOFError(f"{len(data)} of {size} bytes at {position}")
        return data

    def _learn(self, op: int, data: bytes) -> None:
        """Store a schema, a channel, or the numbers of messages of all channels."""
        number = int.from_bytes(data[:2], "little")
        if op == _SCHEMA:
            self._schemas[number] = _text(data, 2)[0]
        elif op == _CHANNEL:
            topic, at = _text(data, 4)
            self._channels[number] = topic, int.from_bytes(data[2:4], "little"), _text(data, at)[0]
        else:
            self._counts = dict(_COUNTED.iter_unpack(data[_COUNTS_AT:]))

    def _chunk(self, start: int, length: int, indexes: list[bytes], channels: set[int]) -> Iterator[MessageBlock]:
        """Yield the messages of the channels in a chunk as one block, if there are any."""
        if indexes:
            offsets = _indexed(indexes, channels)
            if not offsets.size:
                return
            records = self._unpack(start, length)
        else:
            records = self._unpack(start, length)
            offsets = self._walk(records, channels)
        if offsets.size:
            yield _gather(np.frombuffer(records, np.uint8), offsets, channels)

    def _unpack(self, start: int, length: int) -> bytes:
        records = _records_of_chunk(self._read(start, length))
        self._left -= len(records)
        if self._left < 0:
            raise LimitError("the chunks unpack to more than any recording")
        return records

    def _walk(self, records: bytes, channels: set[int]) -> IntArray:
        """Return the offsets of the messages of the channels in a chunk without index; learn from the others."""
        offsets, position = [], 0
        while position < len(records):
            op, length = _RECORD.unpack_from(records, position)
            start = position + _RECORD.size
            if op in (_SCHEMA, _CHANNEL):
                self._learn(op, records[start : start + length])
            elif op == _MESSAGE and int.from_bytes(records[start : start + 2], "little") in channels:
                offsets.append(position)
            position = start + length
        return np.array(offsets, np.int64)


def _text(data: bytes, at: int) -> tuple[str, int]:
    """Return a text that is preceded by its size, and where it ends."""
    end = at + 4 + int.from_bytes(data[at : at + 4], "little")
    return data[at + 4 : end].decode(), end


def _indexed(indexes: list[bytes], channels: set[int]) -> IntArray:
    """Return the offsets of the wanted messages according to the indexes of a chunk, in ascending order."""
    offsets = [np.empty(0, np.int64)]
    for index in indexes:
        channel, size = _INDEX_HEAD.unpack_from(index)
        if channel in channels:
            entries = np.frombuffer(index, "<i8", size // 8, _INDEX_HEAD.size)
            offsets.append(entries[1::2])
    return np.sort(np.concatenate(offsets))


def _records_of_chunk(chunk: bytes) -> bytes:
    """Return the records in a chunk, decompressed, after a check of size and checksum."""
    _, _, size, checksum, name = _CHUNK_HEAD.unpack_from(chunk)
    start = _CHUNK_HEAD.size + name
    compression = chunk[_CHUNK_HEAD.size : start].decode()
    stored = int.from_bytes(chunk[start : start + 8], "little")
    if size > CHUNK_BYTES:
        raise LimitError(f"chunk of {size} bytes, larger than any recorder writes")
    records = decompressed(chunk[start + 8 : start + 8 + stored], compression, size)
    if len(records) != size:
        raise EOFError(f"chunk of {len(records)} bytes, not {size}")
    if checksum and zlib.crc32(records) != checksum:
        raise ValueError("checksum of a chunk does not agree")
    return records


def _gather(records: ByteArray, offsets: IntArray, channels: set[int]) -> MessageBlock:
    """Return the messages at the `offsets`, shape (n,), in the records of a chunk."""
    heads = _rows(records, offsets, _MESSAGE_HEAD.itemsize).view(_MESSAGE_HEAD)[:, 0]
    if (heads["op"] != _MESSAGE).any() or not np.isin(heads["channel"], list(channels)).all():
        raise ValueError("an index of messages points elsewhere")
    logged = heads["log"].astype(np.int64)
    starts = offsets + _MESSAGE_HEAD.itemsize
    sizes = heads["length"].astype(np.int64) - _HEAD_IN_LENGTH
    if (sizes == sizes[0]).all() and sizes[0] > 0:
        rows = _rows(records, starts, int(sizes[0]))
        if not is_compressed(rows):
            return MessageBlock(logged, rows)
    ends = (starts + sizes).tolist()
    if min(sizes) < 0 or max(ends) > records.size:
        raise EOFError("a message reaches beyond its chunk")
    return MessageBlock.of(
        logged.tolist(), [records[a:b].tobytes() for a, b in zip(starts.tolist(), ends, strict=True)]
    )


def _rows(data: ByteArray, starts: IntArray, length: int) -> ByteArray:
    """Return `length` bytes from each of the ascending offsets `starts`, shape (n, length)."""
    if starts[0] < 0 or starts[-1] + length > data.size:
        raise EOFError("a message reaches beyond its chunk")
    steps = np.diff(starts)
    if steps.size and (steps == steps[0]).all():
        view = np.lib.stride_tricks.as_strided
        return view(data[starts[0] :], (starts.size, length), (int(steps[0]), 1), writeable=False)
    rows: ByteArray = data[starts[:, None] + np.arange(length)]
    return rows


class SqliteFile:
    """Reader of an SQLite file of rosbag2; any exception if it is damaged."""

    def __init__(self, path: Path) -> None:
        self._size = path.stat().st_size
        self._base = sqlite3.connect(f"{path.absolute().as_uri()}?mode=ro&immutable=1", uri=True)
        self._base.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, MESSAGE_BYTES)
        count = "(SELECT count(*) FROM messages WHERE topic_id = topics.id)"
        topics = self._base.execute(f"SELECT name, type, serialization_format, {count}, id FROM topics").fetchall()
        for name, kind, *_ in topics:
            if not (isinstance(name, str) and isinstance(kind, str)):
                raise TypeError(f"name {name!r} or type {kind!r} of a topic is no text")
        self.connections = [_connection(*topic) for topic in topics]

    def blocks(self, topics: set[int]) -> Iterator[MessageBlock]:
        """Yield the messages of some topics, as recorded; LimitError if they are larger than the file."""
        query = f"SELECT timestamp, data FROM messages WHERE topic_id IN ({','.join(map(str, topics))}) ORDER BY id"
        rows, left = self._base.execute(query), most_unpacked(self._size)
        while block := rows.fetchmany(BLOCK):
            left -= sum(len(data) for _, data in block)
            if left < 0:
                raise LimitError("holds more bytes in messages than any recording")
            yield MessageBlock.of(*zip(*block, strict=True))

    def close(self) -> None:
        """Close the file."""
        self._base.close()
