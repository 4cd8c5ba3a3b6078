"""Bags in and out: the stage's recordings as rosbag2 folders or lone files, mcap or sqlite3, compressed or not.

Only this module and ``bag_writer`` import rosbags, and no rosbags exception leaves them. Of reading, rosbags does what
takes little time: it finds the files and the topics of a bag. It handles messages one by one, which takes long.
"""

import os
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray
from rosbags.rosbag2 import Reader

from slpi_ros.errors import RecordError, UsageError
from slpi_ros.io.alignment import SeparateTopics, combine, held_at
from slpi_ros.io.bag_files import absolute_name, locate, match_topic, translated, unpacked
from slpi_ros.io.bag_storage import MessageBlock, read_mcap, read_sqlite
from slpi_ros.io.bag_writer import STORAGES, BagWriter, typestore
from slpi_ros.io.messages import (
    JOINT_STATE,
    MESSAGE_TYPES,
    JointStateBlock,
    encode_joint_states,
)
from slpi_ros.io.record import Record
from slpi_ros.io.signals import Signals, decode_signals

__all__ = [
    "JOINT_STATE",
    "STORAGES",
    "BagWriter",
    "SeparateTopics",
    "read_bag",
    "read_bags",
    "read_desired",
    "write_bag",
]

_Path = str | os.PathLike[str]

DESIRED = "desired_displacement"


def read_bag(path: _Path, topic: str | SeparateTopics = "stage_state", *, axes: Sequence[str] | None = None) -> Record:
    """Read voltage and displacement of a stage from a bag.

    Parameters
    ----------
    path : path
        A rosbag2 folder, or a lone ``.mcap`` or ``.db3`` file; compressed or not.
    topic : str or SeparateTopics
        Name with or without the leading slash; it also finds ``/ns/stage_state`` when that is the only one.
        Of type ``sensor_msgs/JointState``: ``position`` in metres, ``effort`` in volts. Or two topics.
    axes : sequence of str, optional
        The axes to read, in this order; all that the messages name when not given or empty.

    Returns
    -------
    Record
        Time is the header stamp, or the time of recording where no header is stamped, which `notes` tell. NaN where a
        message does not hold an axis.

    Raises
    ------
    RecordError
        If there is no such bag, topic or axis, or the bag cannot be read; the message says what to do.
    """
    path = Path(path)
    sources = locate(path)
    with _Bag(sources, path) as bag:
        if isinstance(topic, SeparateTopics):
            voltage = bag.read(topic.voltage, MESSAGE_TYPES)
            displacement = bag.read(topic.displacement, MESSAGE_TYPES)
            return combine(voltage, displacement, topic, axes or (), path)
        state = bag.read(topic, (JOINT_STATE,))
    chosen = _choose_axes(state, axes, f"{path}, topic '{topic}'")
    return Record(
        time_ns=state.logged if state.stamp is None else state.stamp,
        voltage={axis: state.fields["effort"][axis] for axis in chosen},
        displacement={axis: state.fields["position"][axis] for axis in chosen},
        source=str(path),
        hardware_id=state.frame_id,
        notes=() if state.stamp is not None else ("time is that of recording: the messages are not stamped",),
    )


def read_bags(
    paths: Iterable[_Path], topic: str | SeparateTopics = "stage_state", *, axes: Sequence[str] | None = None
) -> list[Record]:
    """Read several bags of one stage.

    Parameters
    ----------
    paths : iterable of path
        At least one, none of them twice.
    topic, axes
        As for `read_bag`.

    Returns
    -------
    list of Record
        In the order of the paths.

    Raises
    ------
    UsageError
        If there is no path, or one of them comes twice.
    RecordError
        As from `read_bag`; also if the bags are of different stages.
    """
    places = [Path(path) for path in paths]
    if not places:
        raise UsageError("no bag given; name at least one")
    for number, place in enumerate(places):
        if place.resolve() in {earlier.resolve() for earlier in places[:number]}:
            raise UsageError(f"{place}: given twice; name every bag once")
    records = [read_bag(place, topic, axes=axes) for place in places]
    for record in records[1:]:
        if record.hardware_id != records[0].hardware_id:
            raise RecordError(
                f"{record.source}: of stage '{record.hardware_id}', but {records[0].source} of "
                f"'{records[0].hardware_id}'; give bags of one stage"
            )
    return records


def read_desired(path: _Path, record: Record, topic: str | None = None) -> dict[str, NDArray[np.float64]] | None:
    """Read the desired displacement beside a record of the same bag.

    Parameters
    ----------
    path : path
        The bag that `record` comes from.
    record : Record
    topic : str, optional
        Of any type that the compensator takes; ``desired_displacement`` by default.

    Returns
    -------
    dict of axis name to ndarray, shape (N,), metres, or None
        At the record's samples: each message holds until the next one; NaN before the first. None where the bag has no
        message on the default topic.

    Raises
    ------
    RecordError
        If the bag cannot be read, or the topic's clock is not that of the record.
    """
    path = Path(path)
    with _Bag(locate(path), path) as bag:
        if topic is None and not bag.holds(DESIRED):
            return None
        desired = bag.read(topic or DESIRED, MESSAGE_TYPES)
    return held_at(desired, record, f"{path}, topic '{topic or DESIRED}'")


def write_bag(path: _Path, record: Record, *, storage: str = "mcap", topic: str = "/stage_state") -> None:
    """Write a record as a new rosbag2 folder that ``read_bag`` reads back without loss.

    Parameters
    ----------
    path : path
        The folder to make.
    record : Record
        What to write; its hardware id becomes the messages' ``frame_id``.
    storage : {"mcap", "sqlite3"}
        File format.
    topic : str
        Name of the topic.

    Raises
    ------
    RecordError
        If the path exists, or cannot be written.
    """
    displacement = np.column_stack([record.displacement[axis] for axis in record.axes])
    voltage = np.column_stack([record.voltage[axis] for axis in record.axes])
    block = JointStateBlock(record.time_ns, displacement, voltage)
    messages = encode_joint_states(block, record.axes, record.hardware_id)
    # readers sort by log time: where stamps run backwards, the order of the record must survive
    logged = np.maximum.accumulate(record.time_ns)
    with BagWriter(path, storage=storage, topic=topic) as bag:
        for stamp, message in zip(logged.tolist(), messages, strict=True):
            bag.write_raw(stamp, message)


class _Bag:
    """A bag that is open for reading; its files stay unpacked until the end of ``with``."""

    def __init__(self, sources: Sequence[Path], path: Path) -> None:
        self._sources = sources
        self._path = path
        self._topics: dict[str, str] = {}
        self._counts: Counter[str] = Counter()
        self._files: list[tuple[Path, Path]] = []
        self._stack = ExitStack()

    def __enter__(self) -> Self:
        """Find the files and the topics."""
        with ExitStack() as stack:
            for source in self._sources:
                with translated(source):
                    self._open(source, stack)
            self._stack = stack.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        """Remove what was unpacked."""
        self._stack.close()

    def _open(self, source: Path, stack: ExitStack) -> None:
        reader = stack.enter_context(Reader(stack.enter_context(unpacked(source))))
        for connection in reader.connections:
            self._topics[connection.topic] = connection.msgtype
            self._counts[connection.topic] += connection.msgcount
        # A folder has a storage for each of its files, unpacked where it was compressed; a lone file is one.
        storages = getattr(reader.storage, "storages", [reader.storage])
        self._files += [(storage.path, source) for storage in storages]

    def holds(self, topic: str) -> bool:
        """Return whether there is a message on a topic, named in full or by its last parts."""
        wanted = absolute_name(topic)
        return any(name.endswith(wanted) and self._counts[name] for name in self._topics)

    def read(self, topic: str, msgtypes: Iterable[str]) -> Signals:
        """Return what the messages of a topic hold, which is of one of the types."""
        name = match_topic(self._topics, topic, tuple(msgtypes), self._path)
        with translated(self._path):
            msgtype = self._topics[name]
            signals = decode_signals(self._blocks(name), msgtype, _deserialiser(msgtype), self._counts[name])
        if signals is None:
            raise RecordError(f"{self._path}: no message on topic '{topic}'; was the stage's driver running?")
        return signals

    def _blocks(self, topic: str) -> Iterator[MessageBlock]:
        for file, source in self._files:
            with translated(source):
                yield from (read_mcap if file.suffix == ".mcap" else read_sqlite)(file, topic)


def _deserialiser(msgtype: str) -> Callable[[bytes], Any]:
    """Return a function from a message to an object; a short message makes it raise."""
    # not Typestore.deserialize_cdr: it refuses the garbage that rclpy's serialize_message leaves at the end
    definition = typestore().get_msgdef(msgtype)

    def deserialise(message: bytes) -> Any:
        decode = definition.deserialize_cdr_le if message[1] & 1 else definition.deserialize_cdr_be
        return decode(message[4:], 0, definition.cls, typestore())[0]

    return deserialise


def _choose_axes(state: Signals, axes: Sequence[str] | None, where: str) -> tuple[str, ...]:
    """Return the wanted axes, by default all, once it is sure that each has both signals."""
    names = ", ".join(state.names)
    if not names:
        raise RecordError(f"{where}: the messages name no axis; name[] must hold the axes")
    chosen = tuple(axes or state.names)
    for axis in chosen:
        if axis not in state.names:
            raise RecordError(f"{where}: no axis '{axis}'; there is {names}")
        for field in ("position", "effort"):
            if np.isnan(state.fields[field][axis]).all():
                raise RecordError(
                    f"{where}: axis '{axis}' has no value in {field}[] of any message; position[] must hold "
                    f"the measured metres, effort[] the applied volts; else read other axes, of {names}"
                )
    return chosen
