"""Reading of records from bags: rosbag2 folders or single files, mcap or sqlite3, compressed or not."""

import os
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, closing
from dataclasses import replace
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from slpi_ros.arrays import FloatArray
from slpi_ros.errors import RecordError, SlpiError, UsageError
from slpi_ros.io.alignment import SeparateTopics, Signals, combine
from slpi_ros.io.bag_files import absolute_name, locate, match_topic, metadata, require_bounded, translated, unpacked
from slpi_ros.io.bag_storage import Connection, McapFile, MessageBlock, SqliteFile
from slpi_ros.io.input_limits import BAG_BYTES, MOST_AXES, LimitError, open_input, require_count
from slpi_ros.io.message_order import in_order
from slpi_ros.io.messages import (
    JOINT_STATE,
    JOINT_TRAJECTORY,
    MESSAGE_TYPES,
    QUANTITY_TYPES,
    SECOND_NS,
    Message,
    kind_of,
    read_message,
)
from slpi_ros.io.record import BLOCK, Course, Record, each_block, new_column, release
from slpi_ros.io.stage_name import stage_name
from slpi_ros.io.surroundings import MOST, Chosen, courses, since_start_of, topics_beside, wild
from slpi_ros.io.unfinished_bags import NOTE, completed, is_abandoned

_Path = str | os.PathLike[str]
# Types of messages that are read.
_READ = {*MESSAGE_TYPES, *QUANTITY_TYPES, JOINT_TRAJECTORY}


def read_bag(
    path: _Path,
    topic: str | SeparateTopics = "stage_state",
    *,
    axes: Sequence[str] | None = None,
    surroundings: Sequence[str] | None = None,
    accept_stage: str = "",
) -> Record:
    """Read voltage and displacement of a stage from a bag, and the quantities that were recorded beside them.

    Parameters
    ----------
    path : path
        A rosbag2 folder, or a single ``.mcap`` or ``.db3`` file; compressed or not.
    topic : str or SeparateTopics
        Topic of type ``sensor_msgs/JointState`` (``position`` in metres, ``effort`` in volts), or separate topics for
        voltage and displacement. The leading slash and the namespace may be omitted if the name is unambiguous.
    axes : sequence of str, optional
        The axes to read, in this order; default: all axes that the messages name.
    surroundings : sequence of str, optional
        The quantities to read, ``topic`` or ``topic:field``; default: every ``sensor_msgs/Temperature``,
        ``RelativeHumidity``, ``FluidPressure``, ``std_msgs/Float64`` and ``geometry_msgs/WrenchStamped`` that is none
        of the stage's own topics, and joint states of other stages. Fields are ``force.z`` of a wrench and
        ``position.x`` of a joint state.
    accept_stage : str
        What is named so is of the same stage as the other messages of the topic. Default none: the messages of the
        axes may name one stage only.

    Returns
    -------
    Record
        Times are the header stamps; if no message is stamped, the recording times, which is stated in `notes`. Values
        are NaN where a message does not contain the axis.

    Raises
    ------
    RecordError
        If there is no such bag, topic or axis, the bag cannot be read, or the messages are of several stages; the
        message names the remedy.
    """
    path = Path(path)
    sources = locate(path)
    with Bag(sources, path) as bag:
        if isinstance(topic, SeparateTopics):
            voltage = bag.read(topic.voltage, MESSAGE_TYPES)
            displacement = bag.read(topic.displacement, MESSAGE_TYPES)
            record = combine(voltage, displacement, topic, axes or (), path, accept_stage)
            taken = [bag.full_name(name) for name in (topic.displacement, topic.voltage)]
            record = _with_surroundings(record, bag, displacement, taken, surroundings)
        else:
            state = bag.read(topic, (JOINT_STATE,))
            where = f"{path}, topic '{topic}'"
            chosen = _choose_axes(state, axes, where)
            record = _record_of(state, chosen, path, state.stage(chosen, where, accept_stage))
            record = _with_surroundings(record, bag, state, [bag.full_name(topic)], surroundings)
        return replace(record, notes=(*record.notes, *bag.notes))


def _record_of(state: Signals, chosen: Sequence[str], path: Path, stage: str) -> Record:
    unstamped = () if state.stamp is not None else ("time is that of recording: the messages are not stamped",)
    return Record(
        time_ns=state.logged if state.stamp is None else state.stamp,
        voltage={axis: state.fields["effort"][axis] for axis in chosen},
        displacement={axis: state.fields["position"][axis] for axis in chosen},
        source=str(path),
        hardware_id=stage,
        notes=(*state.notes, *unstamped),
    )


def _with_surroundings(
    record: Record, bag: "Bag", state: Signals, taken: Sequence[str], wanted: Sequence[str] | None
) -> Record:
    """Return the record with the `wanted` quantities, default: all; what is not wanted by name may be unreadable."""
    # `state` gives the clock of the record; of the topics `taken` the first is that of the stage.
    if wanted is None:
        beside = [topic for topic in topics_beside(bag.types, taken[0]) if topic not in taken]
        chosen = [Chosen(topic, "") for topic in beside if bag.holds(topic)]
    else:
        chosen = [Chosen.of(text) for text in wanted]
    if not (chosen and record.time_ns.size):
        return record
    found: dict[str, Course] = {}
    unread = []
    for topic, field in chosen:
        try:
            full, signals = bag.full_name(topic), bag.read(topic, QUANTITY_TYPES)
            since_start = since_start_of(signals, int(record.time_ns[0]), state)
            read = dict(courses(signals, Chosen(full, field), bag.types[full], since_start))
            if wanted is not None and not read:
                raise RecordError(f"topic '{topic}' has no finite reading; leave it out, or check its sensor")
            found |= read
            if full in taken and (not field or field.partition(".")[2] in record.axes):
                raise UsageError(f"'{topic}' is of the stage itself; name quantities beside it")
        except SlpiError as error:
            if wanted is not None:
                where = f"{record.source}: "
                raise type(error)(where + str(error).removeprefix(where)) from None
            unread.append(topic)
    notes = list(record.notes)
    if unread:
        notes.append(f"not read: {', '.join(unread)}")
    for key, (_, value) in found.items():
        if count := np.count_nonzero(wild(value)):
            notes.append(f"{key}: {count} of {value.size} readings are far from all others and left out")
    if wanted is None and len(found) > MOST:
        notes.append(f"the first {MOST} of {len(found)} quantities are read; name others (--with)")
        found = dict(list(found.items())[:MOST])
    return replace(record, surroundings=found, notes=tuple(notes))


def require_different(paths: Iterable[_Path]) -> list[Path]:
    """Return the paths of bags; UsageError if there is none, or one is given twice."""
    places = [Path(path) for path in paths]
    if not places:
        raise UsageError("no bag given; name at least one")
    for number, place in enumerate(places):
        if os.path.realpath(place) in {os.path.realpath(earlier) for earlier in places[:number]}:
            raise UsageError(f"{place}: given twice; name every bag once")
    return places


def require_one_stage(records: Sequence[Record]) -> None:
    """Raise RecordError unless all records have the same hardware id; a missing id differs from every given id."""
    for record in records[1:]:
        if stage_name(record.hardware_id) != stage_name(records[0].hardware_id):
            raise RecordError(
                f"{record.source}: of {_stage_of(record)}, but {records[0].source} of {_stage_of(records[0])}; give "
                "bags of one stage, with the same hardware id"
            )


def _stage_of(record: Record) -> str:
    return f"stage '{record.hardware_id}'" if record.hardware_id else "a stage without hardware id"


class Bag:
    """Bag opened for reading; a context manager that removes decompressed files at its end."""

    def __init__(self, sources: Sequence[Path], path: Path) -> None:
        self._sources = sources
        self._path = path
        self._files: list[tuple[McapFile | SqliteFile, Path]] = []
        self._topics: dict[str, str] = {}
        self._stack = ExitStack()
        self.notes: tuple[str, ...] = ()  # what is to be told of the bag as a whole

    def __enter__(self) -> Self:
        with ExitStack() as stack:
            for source in self._sources:
                with translated(source):
                    whole = stack.enter_context(completed(source))
                    self.notes = (NOTE,) if is_abandoned(source) else ()
                    require_bounded(whole)
                    self._files.append((self._open(stack.enter_context(unpacked(whole)), stack), source))
            for each in (each for file, _ in self._files for each in file.connections):
                # Of several types of one topic the one that is read comes first.
                known = self._topics.get(each.topic)
                if known is None or (known not in _READ and _type_of(each) in _READ):
                    self._topics[each.topic] = _type_of(each)
            self._stack = stack.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def _open(self, path: Path, stack: ExitStack) -> McapFile | SqliteFile:
        if path.suffix == ".db3":
            return stack.enter_context(closing(SqliteFile(path)))
        return McapFile(stack.enter_context(open_input(path, BAG_BYTES)))

    def holds(self, topic: str) -> bool:
        """Return whether there is a message on a topic, given by its full name or by its last parts."""
        wanted = absolute_name(topic)
        return any(absolute_name(name).endswith(wanted) and self._count(name) for name in self._topics)

    def read(self, topic: str, msgtypes: Iterable[str]) -> Signals:
        """Return the decoded messages of a topic, which must have one of the message types."""
        name = match_topic(self._topics, topic, tuple(msgtypes), self._path)
        with translated(self._path):
            signals = decode_signals(self._blocks(name), self._topics[name], self._count(name))
        if signals is None:
            raise RecordError(f"{self._path}: no message on topic '{topic}'; was the stage's driver running?")
        return replace(signals, notes=(*signals.notes, *self._missing(name, signals.received)))

    def _count(self, topic: str) -> int:
        return sum(each.count for file, _ in self._files for each in self._of(file, topic))

    def _of(self, file: McapFile | SqliteFile, topic: str) -> list[Connection]:
        """Return the connections of a topic whose messages have the type that is read."""
        return [each for each in file.connections if each.topic == topic and _type_of(each) == self._topics[topic]]

    def _missing(self, topic: str, received: int) -> Iterator[str]:
        """Yield what of a topic is not read: messages of another type, and those that only ``metadata.yaml`` knows."""
        others = [each for file, _ in self._files for each in file.connections if each.topic == topic]
        for each in others:
            if _type_of(each) != self._topics[topic] and each.count:
                yield f"{each.count} messages of another type, {_type_of(each)}, on the same topic are left out"
        listed, counts = metadata(self._path) if self._path.is_dir() else ([], {})
        there = {source.name.removesuffix(".zstd") for source in self._sources}
        gone, extra = [name for name in listed if name not in there], sorted(there - set(listed)) if listed else []
        read = received + sum(each.count for each in others if _type_of(each) != self._topics[topic])
        if gone and len(gone) < len(listed):
            yield f"{', '.join(gone)} of metadata.yaml is not in the folder: a part of the recording is missing"
        elif extra and not gone:
            yield f"{', '.join(extra)} is not in metadata.yaml, and is read, too"
        elif counts.get(topic, read) > read:
            yield f"metadata.yaml tells of {counts[topic]} messages, there are {read}: the others are lost"

    @property
    def types(self) -> Mapping[str, str]:
        """Message types by full name of the topic."""
        return self._topics

    def full_name(self, topic: str) -> str:
        """Return the full name of a topic."""
        return match_topic(self._topics, topic, tuple(self._topics.values()), self._path)

    def type_of(self, topic: str, msgtypes: Collection[str]) -> str:
        """Return the message type of a topic, which must be one of these."""
        return self._topics[match_topic(self._topics, topic, tuple(msgtypes), self._path)]

    def messages(self, topic: str) -> Iterator[tuple[int, bytes]]:
        """Yield the messages of a topic, each with its recording time (ns)."""
        with translated(self._path):
            for block in self._blocks(self.full_name(topic)):
                yield from zip(block.logged.tolist(), block.each(), strict=True)

    def _blocks(self, topic: str) -> Iterator[MessageBlock]:
        for file, source in self._files:
            with translated(source):
                if numbers := {each.number for each in self._of(file, topic)}:
                    yield from file.blocks(numbers)


def _type_of(connection: Connection) -> str:
    """Return the type of messages; with their encoding where it is not that of ROS 2."""
    plain = connection.encoding in ("cdr", "")
    return connection.msgtype if plain else f"{connection.msgtype} in {connection.encoding}"


def _choose_axes(state: Signals, axes: Sequence[str] | None, where: str) -> tuple[str, ...]:
    """Return the wanted axes, default: all; RecordError if an axis lacks one of the two signals."""
    names = ", ".join(state.names)
    if not names:
        raise RecordError(f"{where}: the messages name no axis; name[] must hold the axes")
    chosen = tuple(axes or state.names)
    for axis in chosen:
        if axis not in state.names:
            raise RecordError(f"{where}: no axis '{axis}'; there is {names} (--axis)")
        for field in ("position", "effort"):
            if all(np.isnan(part).all() for (part,) in each_block(state.fields[field][axis])):
                raise RecordError(
                    f"{where}: axis '{axis}' has no value in {field}[] of any message; position[] must hold "
                    f"the measured metres, effort[] the applied volts; else read other axes, of {names} (--axis), or "
                    "topics of their own (--voltage-topic, --displacement-topic)"
                )
    return chosen


def decode_signals(blocks: Iterable[MessageBlock], msgtype: str, expected: int = 0) -> Signals | None:
    """Decode the messages of a topic, None if there is none; blocks are released after decoding."""
    columns, frames = _Columns(expected), dict[str, frozenset[str]]()
    for block in blocks:
        told, part = _decode(block, msgtype)
        columns.append(part)
        _note(frames, told)
    if not columns.count:
        return None
    arrays = columns.arrays()
    received = arrays[_LOGGED].size
    values = {key: array for key, array in arrays.items() if key[0]}
    rows, stamped, notes = in_order(arrays[_LOGGED], arrays[_STAMP], values)
    if rows is not None and (rows.size < received or (np.diff(rows) < 0).any()):
        arrays = {key: array[rows] for key, array in arrays.items()}
    kind = kind_of(msgtype)
    fields: dict[str, dict[str, FloatArray]] = {field: {} for field in kind.fields}
    for (field, name), array in arrays.items():
        if field:
            fields[field][name] = array
    stamp = arrays[_STAMP] if stamped else None
    return Signals(arrays[_LOGGED], stamp, frames, fields, kind.named, tuple(notes), received)


# Key of a column: field and name; for times the field is empty.
_Key = tuple[str, str]
_Frames = dict[str, frozenset[str]]
_Part = tuple[_Frames, dict[_Key, NDArray[Any]]]
_LOGGED, _STAMP = ("", "logged"), ("", "stamp")
_MOST_EXPECTED = 10_000_000


class _Columns:
    """Growing columns, preallocated so that long records are not copied."""

    def __init__(self, expected: int) -> None:
        self.count = 0
        # What metadata say is only believed within reason.
        self._room = min(expected, _MOST_EXPECTED)
        self._arrays: dict[_Key, NDArray[Any]] = {}

    def append(self, part: Mapping[_Key, NDArray[Any]]) -> None:
        start, self.count = self.count, self.count + part[_LOGGED].size
        if self.count > self._room:
            self._room = 2 * self.count
            before, self._arrays = self._arrays, {}
            for key, array in before.items():
                wider = self._arrays[key] = new_column(self._room, array.dtype)
                for first in range(0, start, BLOCK):
                    part_of_it = slice(first, min(first + BLOCK, start))
                    wider[part_of_it] = array[part_of_it]
                    release(wider, array)
        new = [key for key in part if key not in self._arrays]
        require_count(len({name for _, name in (*self._arrays, *new)}), MOST_AXES + len((_LOGGED, _STAMP)), "names")
        for key in new:
            self._arrays[key] = new_column(self._room, part[key].dtype.newbyteorder("="))
            if start:
                self._arrays[key][:start] = np.nan
        for key, array in self._arrays.items():
            array[start : self.count] = part.get(key, np.nan)
        if self.count // BLOCK > start // BLOCK:
            release(*self._arrays.values())

    def arrays(self) -> dict[_Key, NDArray[Any]]:
        return {key: array[: self.count] for key, array in self._arrays.items()}


def _note(frames: _Frames, told: Mapping[str, Collection[str]]) -> None:
    """Add the names of the columns by frame id to those of earlier messages."""
    for frame, names in told.items():
        known = frames.get(frame)
        if known is None and len(frames) > MOST_AXES:
            # Two names of stages tell as much.
            continue
        if known is None or not known.issuperset(names):
            frames[frame] = (known or frozenset()).union(names)


def _decode(block: MessageBlock, msgtype: str) -> _Part:
    if not isinstance(block.messages, list):
        first = read_message(block.messages[0].tobytes(), msgtype)
        rows = first.layout.decode(block.messages) if first.is_regular() else None
        if rows is not None:
            return _alike(block, first, rows)
    return _each(block, msgtype, [read_message(message, msgtype) for message in block.each()])


def _alike(block: MessageBlock, first: Message, rows: NDArray[np.void]) -> _Part:
    """Return frames and columns of a block of messages that all have the layout of the first one."""
    stamp = np.zeros(rows.size, np.int64)
    if "sec" in first.layout.fields:
        stamp = rows["sec"].astype(np.int64) * SECOND_NS + rows["nanosec"]
    columns: dict[_Key, NDArray[Any]] = {_LOGGED: block.logged, _STAMP: stamp}
    for field in first.values:
        columns |= {(field, name): rows[field][:, place] for place, name in enumerate(first.names)}
    return {first.frame_id: frozenset(first.names)}, columns


def _each(block: MessageBlock, msgtype: str, messages: Sequence[Message]) -> _Part:
    """Return frames and columns of messages of different layouts, whose numbers are assigned by name."""
    stamp = np.array([message.stamp_ns for message in messages], np.int64)
    columns: dict[_Key, NDArray[Any]] = {_LOGGED: block.logged, _STAMP: stamp}
    names = dict.fromkeys(name for message in messages for name in message.names)
    require_count(len(names), MOST_AXES, "names")
    for name in names:
        columns |= {(field, name): np.full(len(messages), np.nan) for field in kind_of(msgtype).fields}
    for row, message in enumerate(messages):
        if len(set(message.names)) < len(message.names):
            raise LimitError(f"message {row + 1} of a block names an axis twice ({', '.join(message.names)})")
        for field, numbers in message.values.items():
            # zip stops at the shorter sequence: names beyond the end of an array have no value.
            for name, number in zip(message.names, numbers, strict=False):
                columns[field, name][row] = number
    frames = _Frames()
    for message in messages:
        _note(frames, {message.frame_id: message.names})
    return frames, columns
