"""Atomic writing of rosbag2 folders, mcap or sqlite3; no rosbags exception leaves this module."""

import os
import shutil
import sqlite3
from collections.abc import Iterable, Mapping
from contextlib import suppress
from functools import cache
from heapq import merge
from itertools import repeat
from operator import itemgetter
from pathlib import Path
from types import TracebackType
from typing import Any, Literal, Self

import numpy as np
from rosbags.rosbag2 import StoragePlugin, Writer, WriterError
from rosbags.rosbag2.storage_mcap import McapWriter
from rosbags.typesys import Stores, TypesysError, get_typestore

from slpi_ros.arrays import FloatArray
from slpi_ros.errors import RecordError, UsageError
from slpi_ros.io.bag_files import absolute_name, one_line
from slpi_ros.io.cdr import float64
from slpi_ros.io.desired import DESIRED
from slpi_ros.io.messages import FLOAT64, JOINT_STATE, encode_joint_states
from slpi_ros.io.record import Record
from slpi_ros.io.unfinished_bags import claim, is_being_written, partial_path

STORAGES = {"mcap": StoragePlugin.MCAP, "sqlite3": StoragePlugin.SQLITE3}

_BAG_VERSION: Literal[9] = 9  # what ROS 2 Jazzy writes
_WRITE_ERRORS = (OSError, sqlite3.Error, WriterError)


class BagWriter:
    """Write a rosbag2 folder; a context manager, which an exception makes discard the bag."""

    # An incomplete bag is in ``.NAME.partial`` next to the final `path`, so a folder at the final path is always a
    # complete bag; `sync` bounds what is lost of it when the process is killed. ``write`` writes to `topic` by default,
    # of type ``sensor_msgs/JointState``; None if all are added with ``add_topic``. With `replace`, a folder at this
    # path is deleted once the new bag is complete.
    def __init__(
        self,
        path: str | os.PathLike[str],
        *,
        storage: str = "mcap",
        topic: str | None = "/stage_state",
        replace: bool = False,
    ) -> None:
        if storage not in STORAGES:
            raise UsageError(f"no bag storage '{storage}'; choose {' or '.join(STORAGES)}")
        self.path = Path(path).absolute()
        if not self.path.name:
            raise RecordError(f"{path}: no name of a bag; give the name of a new folder")
        self.partial = partial_path(self.path)
        self.message_count = 0
        self._topic, self._replace = topic, replace
        self._connections: dict[str, Any] = {}
        if os.path.lexists(self.path) and not replace:
            raise RecordError(f"{path}: exists already; choose another name, or remove it first")
        if self.partial.exists():
            remedy = "wait for its recorder" if is_being_written(self.partial) else f"slpi reads it as {path}"
            raise RecordError(
                f"{self.partial}: an unfinished bag of the same name; {remedy}, or choose another name for the new one"
            )
        try:
            self._lock = claim(self.partial)
            self._writer = Writer(self.partial / self.path.name, version=_BAG_VERSION, storage_plugin=STORAGES[storage])
            self._writer.open()
        except _WRITE_ERRORS as error:
            shutil.rmtree(self.partial, ignore_errors=True)
            raise RecordError(f"{path}: cannot be made ({one_line(error)}); choose another name or place") from error
        if topic is not None:
            self.add_topic(topic)

    def add_topic(self, topic: str, msgtype: str = JOINT_STATE) -> None:
        """Add a topic of a type of ROS 2 Jazzy, like ``sensor_msgs/msg/JointState``; a missing slash is added."""
        name = absolute_name(topic)
        try:
            self._connections[name] = self._writer.add_connection(name, msgtype, typestore=typestore())
        except (KeyError, TypesysError) as error:
            raise RecordError(
                f"{name}: no definition of type {msgtype}, only of ROS 2 Jazzy's own; leave this topic out"
            ) from error
        except _WRITE_ERRORS as error:
            raise self._failure(error) from error

    def write(self, stamp_ns: int, message: bytes, topic: str | None = None) -> None:
        """Write a serialised message, CDR data with encapsulation header, with its log time (ns)."""
        name = absolute_name(topic or self._topic or "")
        if name not in self._connections:
            raise UsageError(f"{self.path}: topic '{name}' was not announced; call add_topic first")
        try:
            self._writer.write(self._connections[name], stamp_ns, message)
        except _WRITE_ERRORS as error:
            raise self._failure(error) from error
        self.message_count += 1

    def sync(self) -> None:
        """Write the messages so far to the disk, where they stay if the process is killed or the power fails."""
        storage: Any = self._writer.storage
        try:
            if not isinstance(storage, McapWriter):
                storage.conn.commit()
                return
            if storage.chunk.msgs:
                storage.close_chunk()
            storage.bio.flush()
            os.fsync(storage.bio.fileno())
        except _WRITE_ERRORS as error:
            raise self._failure(error) from error

    def close(self) -> None:
        """Complete the bag and move it to its final path; if it cannot be written, the partial folder remains."""
        try:
            self._writer.close()
            before = self.partial / f"{self.path.name}.replaced"
            if self._replace and self.path.exists():
                self.path.rename(before)
            (self.partial / self.path.name).rename(self.path)
            shutil.rmtree(before, ignore_errors=True)
            self.partial.rmdir()
            os.close(self._lock)
        except _WRITE_ERRORS as error:
            raise self._failure(error) from error

    def discard(self) -> None:
        """Abort writing and remove everything written so far."""
        # Aborting may fail on a full disk; the files are removed below in any case.
        with suppress(*_WRITE_ERRORS):
            self._writer.abort()
        shutil.rmtree(self.partial, ignore_errors=True)
        with suppress(OSError):
            os.close(self._lock)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if error is not None:
            self.discard()
            return
        try:
            self.close()
        except RecordError:
            self.discard()
            raise

    def _failure(self, error: Exception) -> RecordError:
        return RecordError(
            f"{self.path}: cannot be written ({one_line(error)}); free some space or choose another place"
        )


def write_bag(
    path: str | os.PathLike[str],
    record: Record,
    *,
    storage: str = "mcap",
    topic: str = "/stage_state",
    replace: bool = False,
    desired: Mapping[str, FloatArray] | None = None,
) -> None:
    """Write a record as a new rosbag2 folder that `slpi_ros.read_bag` reads back without loss, id as ``frame_id``.

    Desired displacements (m), (N,), NaN: none, of some axes become ``desired_displacement``, and recorded quantities
    without a field topics of their names, ``std_msgs/Float64``.
    """
    displacement = np.column_stack([record.displacement[axis] for axis in record.axes])
    voltage = np.column_stack([record.voltage[axis] for axis in record.axes])
    messages = encode_joint_states(record.time_ns, displacement, voltage, record.axes, record.hardware_id)
    # Readers sort by log time, which must not decrease: so the order of the record is kept where its stamps decrease.
    logged = np.maximum.accumulate(record.time_ns)
    written: list[Iterable[tuple[int, str, bytes]]] = [zip(map(int, logged), repeat(topic), messages, strict=False)]
    if desired:
        paths = np.column_stack([*desired.values()])
        wanted = encode_joint_states(record.time_ns, paths, np.full_like(paths, np.nan), tuple(desired))
        written.append(zip(map(int, logged), repeat(DESIRED), wanted, strict=False))
    beside = {key: course for key, course in record.surroundings.items() if ":" not in key}
    for key, (t, value) in beside.items():
        stamps = (int(record.time_ns[0]) + np.rint(t * 1e9).astype(np.int64)).tolist()
        written.append(sorted((at, key, float64(each)) for at, each in zip(stamps, value.tolist(), strict=True)))
    with BagWriter(path, storage=storage, topic=topic, replace=replace) as bag:
        for name, kind in {**({DESIRED: JOINT_STATE} if desired else {}), **dict.fromkeys(beside, FLOAT64)}.items():
            bag.add_topic(name, kind)
        for stamp, name, message in merge(*written, key=itemgetter(0)):
            bag.write(stamp, message, name)


@cache
def typestore() -> Any:
    """Return the type store of the supported message types, those of ROS 2 Jazzy."""
    return get_typestore(Stores.ROS2_JAZZY)
