"""From the serialised messages of a topic to one array for each of its signals."""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slpi_ros.io.bag_storage import MessageBlock
from slpi_ros.io.messages import MESSAGE_TYPES, SECOND_NS, MessageType
from slpi_ros.io.record import FloatArray

Deserialise = Callable[[bytes], Any]


@dataclass(frozen=True)
class Signals:
    """A topic, decoded.

    Parameters
    ----------
    logged : ndarray of int64, shape (N,), nanoseconds
        Times of recording, in ascending order.
    stamp : ndarray of int64, shape (N,), nanoseconds, or None
        Header stamps; None where no message is stamped.
    frame_id : str
        The first one that is not empty.
    fields : mapping of field to mapping of name to ndarray, shape (N,)
        ``position``, ``effort``, ``data`` or ``vector``, in it ``x`` or what the messages name. NaN where a message
        does not hold it. Names are in the order in which the messages first give them.
    named : bool
        Whether the messages give names; else they are ``0``, ``1``, ...
    """

    logged: NDArray[np.int64]
    stamp: NDArray[np.int64] | None
    frame_id: str
    fields: Mapping[str, Mapping[str, FloatArray]]
    named: bool

    @property
    def names(self) -> tuple[str, ...]:
        """Names that the messages give, or numbers of the columns."""
        return tuple(next(iter(self.fields.values())))


def decode_signals(
    blocks: Iterable[MessageBlock], msgtype: str, deserialise: Deserialise, expected: int = 0
) -> Signals | None:
    """Decode the messages of a topic, a whole block at once where all in it are alike.

    Parameters
    ----------
    blocks : iterable of MessageBlock
        Each is let go as soon as it is decoded.
    msgtype : str
        One of `MESSAGE_TYPES`.
    deserialise : callable
        Makes one message an object with the fields of its type.
    expected : int
        About how many messages there are in all.

    Returns
    -------
    Signals or None
        None where there is no message.
    """
    kind = MESSAGE_TYPES[msgtype]
    columns, frame_id = _Columns(expected), ""
    for block in blocks:
        part = _decode(block, kind, deserialise)
        columns.append(part.columns)
        frame_id = frame_id or part.frame_id
    if not columns.count:
        return None
    arrays = columns.arrays()
    logged, stamp = arrays[_LOGGED], arrays[_STAMP]
    if (logged[1:] < logged[:-1]).any():
        order = np.argsort(logged, kind="stable")
        arrays = {key: array[order] for key, array in arrays.items()}
        logged, stamp = arrays[_LOGGED], arrays[_STAMP]
    fields: dict[str, dict[str, FloatArray]] = {field: {} for field in kind.fields}
    for (field, name), array in arrays.items():
        if field:
            fields[field][name] = array
    return Signals(logged, stamp if stamp.any() else None, frame_id, fields, kind.named)


# Columns are found by field and name; the times have no field.
_Key = tuple[str, str]
_LOGGED, _STAMP = ("", "logged"), ("", "stamp")


@dataclass(frozen=True)
class _Part:
    """A block, decoded: columns of shape (n,)."""

    frame_id: str
    columns: Mapping[_Key, NDArray[Any]]


class _Columns:
    """Columns that grow by parts; of a long recording there is no room for two copies."""

    def __init__(self, expected: int) -> None:
        self.count = 0
        self._room = expected
        self._arrays: dict[_Key, NDArray[Any]] = {}

    def append(self, part: Mapping[_Key, NDArray[Any]]) -> None:
        start, self.count = self.count, self.count + part[_LOGGED].size
        if self.count > self._room:
            self._room = 2 * self.count
            self._arrays = {key: np.resize(array[:start], self._room) for key, array in self._arrays.items()}
        for key in [key for key in part if key not in self._arrays]:
            self._arrays[key] = np.empty(self._room, part[key].dtype)
            if start:
                self._arrays[key][:start] = np.nan
        for key, array in self._arrays.items():
            array[start : self.count] = part.get(key, np.nan)

    def arrays(self) -> dict[_Key, NDArray[Any]]:
        return {key: array[: self.count] for key, array in self._arrays.items()}


def _decode(block: MessageBlock, kind: MessageType, deserialise: Deserialise) -> _Part:
    if not isinstance(block.messages, list):
        first = deserialise(block.messages[0].tobytes())
        layout = kind.layout(first)
        rows = layout.decode(block.messages) if layout else None
        if rows is not None:
            return _alike(block, kind, first, rows)
    return _each(block, kind, [deserialise(message) for message in block.each()])


def _alike(block: MessageBlock, kind: MessageType, first: Any, rows: NDArray[np.void]) -> _Part:
    """Take the columns out of messages that all have the layout of the first one."""
    stamp = np.zeros(rows.size, np.int64)
    if kind.stamped:
        stamp = rows["sec"].astype(np.int64) * SECOND_NS + rows["nanosec"]
    columns = {_LOGGED: block.logged, _STAMP: stamp}
    for field in kind.fields:
        columns |= {(field, name): rows[field][:, place] for place, name in enumerate(kind.names(first))}
    return _Part(_frame_id(first, kind), columns)


def _each(block: MessageBlock, kind: MessageType, messages: list[Any]) -> _Part:
    """Match every message's numbers to their columns by name."""
    stamp = [_stamp(message) if kind.stamped else 0 for message in messages]
    columns: dict[_Key, NDArray[Any]] = {_LOGGED: block.logged, _STAMP: np.array(stamp, np.int64)}
    for name in dict.fromkeys(name for message in messages for name in kind.names(message)):
        columns |= {(field, name): np.full(len(messages), np.nan) for field in kind.fields}
    for row, message in enumerate(messages):
        for field, numbers in kind.values(message).items():
            # zip ends with the shorter one: what is behind the end of an array has no value
            for name, number in zip(kind.names(message), numbers, strict=False):
                columns[field, name][row] = number
    return _Part(next((_frame_id(m, kind) for m in messages if _frame_id(m, kind)), ""), columns)


def _stamp(message: Any) -> int:
    return int(message.header.stamp.sec) * SECOND_NS + int(message.header.stamp.nanosec)


def _frame_id(message: Any, kind: MessageType) -> str:
    return str(message.header.frame_id) if kind.stamped else ""
