"""Bags on their way: where they lie, who writes them, and reading of what a killed recorder left."""

import os
import shutil
import sqlite3
import struct
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

from slpi_ros.errors import RecordError
from slpi_ros.io.file_lock import lock
from slpi_ros.io.input_limits import BAG_BYTES, open_input

# What a reader says of such a bag.
NOTE = "its recorder was killed, or the power failed: what was on the disk by then, all but the last second, is read"
_MAGIC = b"\x89MCAP0\r\n"
_RECORD = struct.Struct("<BQ")
_DATA_END = 0x0F
# End of the data section and footer, without a summary, as https://mcap.dev/spec has them.
_END = _RECORD.pack(_DATA_END, 4) + bytes(4) + _RECORD.pack(0x02, 20) + bytes(20) + _MAGIC
# Ends a rollback journal that names a second one, which SQLite might delete (https://sqlite.org/fileformat.html).
_SUPER_JOURNAL = b"\xd9\xd5\x05\xf9\x20\xa1\x63\xd7"


def partial_path(path: str | os.PathLike[str]) -> Path:
    """Return the folder that contains the bag of this path until it is complete."""
    path = Path(path)
    return path.with_name(f".{path.name}.partial")


def claim(partial: Path) -> int:
    """Make the folder of an unfinished bag; return a descriptor, whose lock says that its writer lives."""
    partial.mkdir(parents=True)
    folder = os.open(partial, os.O_RDONLY)
    lock(folder)
    return folder


def is_being_written(partial: Path) -> bool:
    """Return whether the writer of an unfinished bag lives."""
    try:
        folder = os.open(partial, os.O_RDONLY)
    except OSError:
        return False
    try:
        return not lock(folder, shared=True)
    finally:
        os.close(folder)


def abandoned_in(partial: Path) -> Path | None:
    """Return the folder of the bag that a killed recorder left in `partial`; None if there is none."""
    if not partial.name:
        return None
    bag = partial / partial.name[1:].removesuffix(".partial")
    is_one = partial == partial_path(partial.with_name(bag.name)) and bag.is_dir() and any(bag.iterdir())
    return bag if is_one and not is_being_written(partial) else None


def unused(path: Path) -> Path:
    """Return the path of a bag, with a number behind it if there is one of this name, complete or not."""
    number, free = 1, path
    while free.exists() or partial_path(free).exists():
        number, free = number + 1, path.with_name(f"{path.name}_{number}")
    return free


def set_aside(folder: Path, mark: str) -> None:
    """Rename the bags that killed recorders left in a folder: `mark` and the old name, by which they are read."""
    for partial in sorted(folder.glob(partial_path(folder / "*").name)):
        name = partial.name[1:].removesuffix(".partial")
        if name.startswith(mark) or not partial.is_dir() or is_being_written(partial):
            continue
        aside = unused(folder / f"{mark}{name}")
        # First the bag: interrupted here, the second call completes it.
        if (partial / name).is_dir():
            (partial / name).rename(partial / aside.name)
        partial.rename(partial_path(aside))


def place_of(path: Path) -> Path:
    """Return where the bag of a path is: there, or where a killed recorder left it, which both paths may name."""
    partial = path if path.is_dir() or not path.name else partial_path(path)
    left = abandoned_in(partial) if path == partial or not path.exists() else None
    return left or path


def is_abandoned(file: Path) -> bool:
    """Return whether a bag file lies, incomplete, where a killed recorder left it."""
    bag = file.absolute().parent
    return bag == abandoned_in(bag.parent) and not (bag / "metadata.yaml").exists()


@contextmanager
def completed(file: Path) -> Iterator[Path]:
    """Provide a bag file as it is, or, of one that a killed recorder left, a complete copy of what is in it."""
    journals = [journal for end in ("-journal", "-wal") if (journal := file.with_name(file.name + end)).is_file()]
    if not is_abandoned(file) or (file.suffix == ".db3" and not journals):
        yield file
        return
    with TemporaryDirectory() as folder:
        copy = Path(folder) / file.name
        if file.suffix == ".mcap":
            _complete(file, copy)
        else:
            _roll_back(file, journals, copy)
        yield copy


def _complete(file: Path, copy: Path) -> None:
    """Copy the records of an mcap file that are whole, and end it; RecordError if there are none."""
    with open_input(file, BAG_BYTES) as source, copy.open("wb") as target:
        size, end = source.seek(0, os.SEEK_END), len(_MAGIC)
        while end + _RECORD.size <= size:
            source.seek(end)
            kind, length = _RECORD.unpack(source.read(_RECORD.size))
            if kind in (0, _DATA_END) or end + _RECORD.size + length > size:
                break
            end += _RECORD.size + length
        if end <= len(_MAGIC):
            raise RecordError(f"{file}: its recorder was killed before anything was on the disk; record again")
        source.seek(0)
        shutil.copyfileobj(source, target)
        target.truncate(end)
        target.seek(end)
        target.write(_END)


def _roll_back(file: Path, journals: list[Path], copy: Path) -> None:
    """Copy an SQLite file with its journals, and undo in the copy what was not written to its end."""
    for each in (file, *journals):
        shutil.copyfile(each, copy.with_name(each.name))
        if each.name.endswith("-journal") and each.read_bytes()[-len(_SUPER_JOURNAL) :] == _SUPER_JOURNAL:
            raise ValueError(f"{each.name} names another journal, which no recorder writes")
    with closing(sqlite3.connect(copy)) as base:
        base.execute("PRAGMA journal_mode = DELETE")
        base.execute("SELECT count(*) FROM sqlite_master").fetchone()
