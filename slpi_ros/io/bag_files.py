"""Bags on disk: locating bags and topics, translating errors of damaged bags, watching a folder for new bags."""

import errno
import os
import re
import shutil
import sqlite3
import struct
import time
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import closing, contextmanager, suppress
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import BinaryIO

from slpi_ros.errors import RecordError, SlpiError, UsageError
from slpi_ros.io.bag_storage import MCAP_END, is_packed, zstd
from slpi_ros.io.input_limits import (
    BAG_BYTES,
    METADATA_BYTES,
    LimitError,
    most_unpacked,
    open_input,
    read_input,
)
from slpi_ros.io.unfinished_bags import abandoned_in, is_being_written, partial_path, place_of

SUFFIXES = (".mcap", ".db3", ".mcap.zstd", ".db3.zstd")
# The parts of a split bag end in their number; those of ROS 2 Lyrical begin with it, and end in a date.
_PART = re.compile(r"(?P<prefix>.*)_(?P<number>\d+)\.(?:mcap|db3)")
_COUNTED = re.compile(r"(?P<number>\d+)_(?P<prefix>.*?)(?:_\d{4}[-_\d]*)?\.(?:mcap|db3)")
_WANTED = "give a rosbag2 folder or an .mcap or .db3 file"
_LFS = b"version https://git-lfs"
# An alias in YAML. No recorder writes one, and nested ones stand for more text than any memory holds.
_ALIAS = re.compile(rb"(?:[:?-]\s+|[\[,{]\s*)\*\S")
# Seconds without growth until a recording counts as abandoned: a writer fills a whole chunk before its file grows.
PATIENCE = 120.0
# Bytes that are unpacked at once.
_BLOCK = 2**20


def locate(path: Path) -> list[Path]:
    """Return the paths to open for a bag: a folder with metadata, or its bag files in order; RecordError if none."""
    path = place_of(path)
    if not path.exists():
        hint = _WANTED
        if path.name and is_being_written(partial_path(path)):
            hint = f"its recording is unfinished, in {partial_path(path)}: wait for the recorder to end"
        raise RecordError(f"{path}: no such bag; {hint}")
    if path.is_file():
        if path.name.endswith(SUFFIXES):
            return [path]
        hint = {
            ".csv": "import the table first with `slpi import`",
            ".mat": "import the table first with `slpi import`",
            ".bag": "convert a ROS 1 bag first with `rosbags-convert`",
        }.get(path.suffix, _WANTED)
        raise RecordError(f"{path}: not a bag of ROS 2; {hint}")
    if not path.is_dir():
        raise RecordError(f"{path}: neither a folder nor a regular file; {_WANTED}")
    files = [file for file in path.iterdir() if file.name.endswith(SUFFIXES)]
    listed, _ = metadata(path)
    if not files:
        told = "whose metadata.yaml lists" if listed else "without metadata.yaml and without"
        raise RecordError(f"{path}: a folder {told} {', '.join(listed)[:200] or '.mcap or .db3 file'}; not a bag")
    return files if len(files) == 1 else _parts(files, listed, path)


def _parts(files: list[Path], listed: list[str], folder: Path) -> list[Path]:
    """Return the files of a split bag in order; RecordError if they are not the parts of a single bag."""
    plain = {file.name.removesuffix(".zstd"): file for file in files}
    known = [plain.pop(name) for name in dict.fromkeys(listed) if name in plain]
    # Parts that are not listed were written after metadata.yaml.
    for pattern in (_COUNTED, _PART):
        found = [(int(name["number"]), name["prefix"], name[0]) for one in plain if (name := pattern.fullmatch(one))]
        last = len(known) + len(plain)
        if [number for number, *_ in sorted(found)] == list(range(len(known), last)) and len(
            {p for _, p, _ in found}
        ) < 2:
            return [*known, *(plain[name] for *_, name in sorted(found))]
    if known:
        return [*known, *(plain[name] for name in sorted(plain))]
    raise RecordError(
        f"{folder}: {len(files)} bag files but no metadata.yaml, and they are not parts 0 to {len(files) - 1} of "
        f"one bag; make one with `ros2 bag reindex {folder}`, or give one of the files"
    )


def metadata(folder: Path) -> tuple[list[str], dict[str, int]]:
    """Return the files that ``metadata.yaml`` lists, by their names, and the numbers of messages by topic."""
    # Of any version; what it says of types and storage is in the files themselves, too.
    path = folder / "metadata.yaml"
    if not path.exists():
        return [], {}
    from ruamel.yaml import YAML

    with translated(folder):
        content = read_input(path, METADATA_BYTES)
        if _ALIAS.search(content):
            raise LimitError(f"{path.name} has an alias, which no recorder writes")
        told = YAML(typ="safe").load(content)["rosbag2_bagfile_information"]
        names = [os.path.basename(name).removesuffix(".zstd") for name in told.get("relative_file_paths") or []]
        counts: dict[str, int] = {}
        for topic in told.get("topics_with_message_count") or []:
            name, count = topic["topic_metadata"]["name"], topic["message_count"]
            if not (isinstance(name, str) and isinstance(count, int) and count >= 0):
                raise TypeError(f"name {name!r} or message_count {count!r} of a topic is wrong")
            counts[name] = counts.get(name, 0) + count
        return names, counts


@contextmanager
def unpacked(file: Path) -> Iterator[Path]:
    """Provide a bag file, decompressed to a temporary file if the recorder compressed it as a whole."""
    if file.suffix != ".zstd":
        yield file
        return
    with TemporaryDirectory() as folder:
        plain = Path(folder) / file.stem
        with zstd().open(file) as packed, plain.open("wb") as target:
            shutil.copyfileobj(packed, target)
        yield plain


@contextmanager
def translated(source: Path) -> Iterator[None]:
    """Translate every exception raised while reading a damaged bag into a one-line RecordError."""
    try:
        yield
    except SlpiError:
        raise
    except LimitError as error:
        raise RecordError(f"{source}: {error.strerror}: no recording of a stage; {_WANTED}") from None
    except PermissionError as error:
        raise RecordError(f"{source}: cannot be read ({one_line(error)}); check the permissions") from error
    except MemoryError as error:
        raise RecordError(f"{source}: not enough memory to read it; split it into shorter bags") from error
    except Exception as error:
        if getattr(error, "errno", None) == errno.ENOSPC:
            raise RecordError(f"{source}: no room to unpack it; free some, or set TMPDIR to another place") from error
        # A damaged file can raise any exception: of struct, zstd, yaml, sqlite, unicode...
        reason = one_line(error)
        raise RecordError(f"{source}: damaged or unfinished ({reason}); {_remedy(source)}") from error


def require_bounded(file: Path) -> None:
    """Raise an error if a file of a bag is truncated, empty, or would unpack without an end."""
    with open_input(file, BAG_BYTES) as stream:
        header = stream.read(100)
        if header.startswith(_LFS):
            raise RecordError(f"{file}: a pointer of Git LFS instead of the file; get it with `git lfs pull`")
        if not header:
            raise RecordError(f"{file}: an empty file; its recorder has written nothing, record again")
        if is_packed(header):
            # It is unpacked as a whole.
            _require_small(stream, file)
    if file.suffix == ".db3" or header.startswith(b"SQLite format 3"):
        _require_whole(file, header)


def _require_small(packed: BinaryIO, file: Path) -> None:
    """Raise LimitError if a packed file unpacks to more than any recording."""
    allowed = most_unpacked(file.stat().st_size)
    packed.seek(0)
    with zstd().open(packed) as plain:
        while data := plain.read(_BLOCK):
            allowed -= len(data)
            if allowed < 0:
                raise LimitError(f"{file.name} unpacks to more than any recording")


def _require_whole(file: Path, header: bytes) -> None:
    """Raise EOFError if an SQLite file is truncated (SQLite would read zeros) or its write-ahead log is not empty."""
    # LimitError if it has a view: a query instead of data, which may not end.
    journal = file.with_name(f"{file.name}-wal")
    if journal.exists() and journal.stat().st_size:
        raise EOFError(f"messages still in {journal.name}: `sqlite3 {file} 'PRAGMA wal_checkpoint'` moves them")
    # https://sqlite.org/fileformat.html: the size in the header counts if both change counters agree
    if len(header) == 100 and header[24:28] == header[92:96]:
        page, pages = struct.unpack_from(">H", header, 16)[0], struct.unpack_from(">I", header, 28)[0]
        size, wanted = file.stat().st_size, pages * (65536 if page == 1 else page)
        if size < wanted:
            raise EOFError(f"{size} bytes of {wanted} in {file.name}")
    with closing(sqlite3.connect(f"{file.absolute().as_uri()}?mode=ro&immutable=1", uri=True)) as base:
        query = "SELECT name FROM sqlite_master WHERE type = 'view' OR sql LIKE 'CREATE VIRTUAL%' LIMIT 1"
        if found := base.execute(query).fetchone():
            raise LimitError(f"{file.name} has a view {found[0]!r}, which no recorder writes")
        if not base.execute("SELECT 1 FROM sqlite_master WHERE name = 'messages'").fetchone():
            raise RecordError(
                f"{file}: it has no table of messages; if its recorder was killed, they are in {journal.name} beside "
                "the original: copy both"
            )


def _remedy(source: Path) -> str:
    """Return the remedy for a bag that cannot be opened."""
    if source.is_dir():
        return "rebuild metadata.yaml with `ros2 bag reindex`, or give its .mcap or .db3 file alone"
    if source.suffix == ".zstd":
        return f"test it with `zstd -t {source}`, and copy it anew"
    if source.suffix == ".mcap":
        return f"if its recorder was killed, recover with `mcap recover {source} -o NEW.mcap`"
    return f"try `sqlite3 {source} .recover | sqlite3 NEW.db3`"


def one_line(error: Exception) -> str:
    """Return the message of an error, at most 200 characters on one line."""
    return " ".join(str(error).split())[:200] or type(error).__name__


def match_topic(topics: Mapping[str, str], topic: str, msgtypes: Collection[str], source: Path) -> str:
    """Resolve a topic name, or its last parts if unambiguous, among full names by type, to one of the `msgtypes`."""
    contents = ", ".join(f"{name} ({topics[name]})" for name in sorted(topics)) or "no topics"
    wanted = absolute_name(topic)
    found = [name for name in topics if absolute_name(name) == wanted]
    found = found or sorted(name for name in topics if absolute_name(name).endswith(wanted))
    if not found:
        raise RecordError(
            f"{source}: no topic '{topic}'; the bag holds {contents}; name the right one (--topic, or "
            "--voltage-topic and --displacement-topic; of desired displacements --desired-topic)"
        )
    if len(found) > 1:
        raise RecordError(f"{source}: topic '{topic}' may be {' or '.join(found)}; give the full name")
    if topics[found[0]] not in msgtypes:
        raise RecordError(
            f"{source}: topic '{found[0]}' is {topics[found[0]]}, not {' or '.join(msgtypes)}: publish it as that, or "
            f"name another; the bag holds {contents}"
        )
    return found[0]


def absolute_name(topic: str) -> str:
    """Return the topic with exactly one leading slash."""
    return f"/{topic.strip('/')}"


class BagWatch:
    """Watch a folder for newly completed bags; bags still being written are ignored."""

    # A rosbag2 folder is complete when it contains ``metadata.yaml``, which its writer adds last; a single mcap file
    # when it ends with the magic bytes of a complete file. Single sqlite3 files are ignored, as they have no such mark.
    #
    # Bags that are complete from the beginning are not reported, except the newest one. An incomplete bag that has not
    # grown for `patience` (s) counts as abandoned, but is still watched.
    def __init__(self, folder: str | os.PathLike[str], patience: float = PATIENCE) -> None:
        self.folder, self.patience = Path(folder), patience
        self.abandoned: tuple[Path, ...] = ()
        if not self.folder.is_dir():
            raise UsageError(f"{folder}: no such folder to watch for bags; make it, or name another")
        self._seen = set(self._dated(finished)[:-1])

    def poll(self) -> list[Path]:
        """Return the bags completed since the last call, oldest first; none if the folder no longer exists."""
        new = [bag for bag in self._dated(finished) if bag not in self._seen]
        self._seen.update(new)
        last = time.time_ns() - int(self.patience * 1e9)
        self.abandoned = tuple(sorted(bag for bag, grown in self._dated(_grown) if grown <= last))
        return [path for path, _ in new]

    def _dated(self, date: Callable[[Path], int | None]) -> list[tuple[Path, int]]:
        """Return the entries of the folder for which `date` returns a time (ns), oldest first, with this time."""
        found = []
        # The folder, or an entry of it, may have been deleted in the meantime.
        with suppress(OSError):
            for path in self.folder.iterdir():
                with suppress(OSError):
                    if (when := date(path)) is not None:
                        found.append((path, when))
        return sorted(found, key=lambda bag: bag[1])


def finished(path: Path) -> int | None:
    """Return the time (ns) at which a bag was completed; None if `path` is no bag or is still being written."""
    if path.name.startswith("."):
        left = abandoned_in(path) if path.is_dir() else None
        return max(file.stat().st_mtime_ns for file in left.iterdir()) if left else None
    metadata = path / "metadata.yaml"
    if path.is_dir():
        return metadata.stat().st_mtime_ns if metadata.is_file() and metadata.stat().st_size else None
    if path.suffix != ".mcap" or path.stat().st_size <= 2 * len(MCAP_END):
        return None
    with open_input(path, BAG_BYTES) as file:
        file.seek(-len(MCAP_END), os.SEEK_END)
        return path.stat().st_mtime_ns if file.read() == MCAP_END else None


def _grown(path: Path) -> int | None:
    """Return the time (ns) at which an incomplete bag last grew; None if `path` is no bag or is complete."""
    if finished(path) is not None:
        return None
    if not path.is_dir():
        return path.stat().st_mtime_ns if path.suffix == ".mcap" and not path.name.startswith(".") else None
    folder = path
    if path.name.startswith("."):
        # The recorder of this package keeps an incomplete bag in such a folder.
        folder = path / path.name[1:].removesuffix(".partial")
        if path != partial_path(path.with_name(folder.name)) or not folder.is_dir():
            return None
    parts = [file for file in folder.iterdir() if {".mcap", ".db3"}.intersection(file.suffixes)]
    return max(file.stat().st_mtime_ns for file in (folder, *parts)) if parts else None
