"""What the output of a command (``-o``) may replace: what slpi wrote before, and anything else only when asked to."""
# Each check is made before the computation, so that a refusal costs no time. No check lets an output into a recording.

import os
import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

from slpi_ros.errors import SlpiError, UsageError
from slpi_ros.io.atomic_file import is_replaceable, require_no_folder
from slpi_ros.io.input_limits import BAG_BYTES, open_input

_Path = str | os.PathLike[str]

# First element of every page, by which it is known as one of slpi's.
PAGE_MARK = '<meta name="generator" content="slpi_ros">'
# First words of every file of gains.
GAINS_MARK = "# Gains of a compensator, by "
# Bytes at both ends of a file that tell what it is: a document and a page at its beginning, a table of results at its
# end; the longest header of a table is shorter, too.
_ENDS = 64 * 1024
# Every document begins with its schema.
_SCHEMA = re.compile(rb'\s*\{\s*"schema"\s*:\s*"slpi_ros/(\w+)/')
_RECORDING, _BAG_INFORMATION = "metadata.yaml", b"rosbag2_bagfile_information"
_BAG_FILES = (".mcap", ".db3", ".mcap.zstd", ".db3.zstd")
# Names of the files by which slpi knows its own folders.
_OWN_SUFFIXES = (".json", ".html", ".jsonl", ".parquet")
_ASK = "give another output, or --overwrite to replace it"


def allow_document(path: _Path, kind: str, *, overwrite: bool = False) -> list[str]:
    """Check that a document may be written to a file; return remarks on what it replaces that slpi did not write."""
    # The file may be missing, empty, or a document of the same `kind`, the middle part of the schema id; with
    # `overwrite`, also any other regular file.
    return _allow_file(Path(path), f"no {kind} document of slpi", overwrite, is_own=_kind(_ends(path)[0]) == kind)


def allow_table(path: _Path, header: str, *, overwrite: bool = False) -> list[str]:
    """Check that a table may be written: like `allow_document`, for a CSV file with the first line `header`."""
    first = _ends(path)[0].split(b"\n", 1)[0]
    return _allow_file(Path(path), f"no table with the columns {header}", overwrite, is_own=first == header.encode())


def allow_gains(path: _Path, *, overwrite: bool = False) -> list[str]:
    """Check that gains may be written: like `allow_document`, for a parameter file that ``slpi tune`` wrote."""
    own = _ends(path)[0].startswith(GAINS_MARK.encode())
    return _allow_file(Path(path), "no gains that slpi tune wrote", overwrite, is_own=own)


def allow_folder(
    path: _Path, *names: str, tables: Mapping[str, str] | None = None, overwrite: bool = False
) -> list[str]:
    """Check that files may be written into a folder; return remarks, as `allow_document` does."""
    # The folder may be missing, be without anything but empty files, or hold a document or a page of slpi. Of `names`,
    # the documents and pages to be written, and `tables` with their columns, those that exist must be slpi's as well.
    # With `overwrite`, the folder and these files may be any others.
    folder = Path(path)
    with _told(folder):
        _refuse_recording(folder, folder)
        if not folder.is_dir():
            # What is no folder is refused where the folder is made.
            return []
        require_no_folder(*(folder / name for name in (*names, *(tables or ()))))
        held = [each for each in sorted(folder.iterdir()) if each.is_dir() or not _is_empty(each)]
    if not any(map(_is_own, held)) and held and not overwrite:
        raise UsageError(
            f"{folder}: holds {held[0].name} and was not made by slpi; give another folder, or --overwrite to write "
            "into it"
        )
    remarks = []
    for name in names:
        if (folder / name).is_file():
            remarks += _replacing(folder / name, "no file of slpi", overwrite, is_own=_is_own(folder / name))
    for name, header in (tables or {}).items():
        if (folder / name).is_file():
            remarks += allow_table(folder / name, header, overwrite=overwrite)
    return remarks


def allow_bag(path: _Path, *, overwrite: bool = False) -> list[str]:
    """Check that a bag may be written as a folder: nothing is there or, with `overwrite`, only a rosbag2 folder."""
    bag = Path(path)
    _refuse_recording(bag, Path(os.path.realpath(bag)).parent)
    if not os.path.lexists(bag):
        return []
    if not overwrite:
        raise UsageError(f"{bag}: exists already; give another name, or --overwrite to replace a bag")
    if not _is_recording(bag):
        raise UsageError(f"{bag}: is no bag, and is not replaced by one; give another name")
    if other := [each.name for each in sorted(bag.iterdir()) if not _belongs_to_bag(each)]:
        raise UsageError(f"{bag}: is not replaced, as it also holds {other[0]}; move that away, or give another name")
    return [f"{bag}: replaced the bag that was there"]


def _allow_file(path: Path, unlike: str, overwrite: bool, *, is_own: bool) -> list[str]:
    if not str(path) or not is_replaceable(path):
        raise SlpiError(f"'{path}': cannot be written: no regular file; choose another place")
    with _told(path):
        require_no_folder(path)
        target = Path(os.path.realpath(path))
        if not target.parent.is_dir():
            raise SlpiError(f"{path}: cannot be written: there is no folder {target.parent}; choose another place")
        if not os.access(target.parent, os.W_OK):
            raise SlpiError(f"{path}: cannot be written: {target.parent} is write-protected; choose another place")
        _refuse_recording(path, target.parent)
        return _replacing(path, unlike, overwrite, is_own=is_own)


@contextmanager
def _told(path: Path) -> Iterator[None]:
    """Raise SlpiError for a name that no file can have, and for a place that cannot be looked at."""
    try:
        yield
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) else error
        raise SlpiError(f"{path}: cannot be written: {reason}; choose another place") from None


def _replacing(path: Path, unlike: str, overwrite: bool, *, is_own: bool) -> list[str]:
    """Return remarks on replacing a file; UsageError if it exists, holds something else and must not be replaced."""
    if not path.exists() or _is_empty(path) or is_own:
        return []
    if not overwrite:
        raise UsageError(f"{path}: exists and is {unlike}; {_ASK}")
    return [f"{path}: replaced what was there, {unlike}"]


def _refuse_recording(path: Path, folder: Path) -> None:
    """Raise UsageError if a folder is a recording or lies in one."""
    real = Path(os.path.realpath(folder))
    for place in (real, *real.parents):
        if _is_recording(place):
            raise UsageError(f"{path}: lies in the recording {place}; give another output (-o)")


def _is_recording(folder: Path) -> bool:
    return _BAG_INFORMATION in _ends(folder / _RECORDING)[0]


def _belongs_to_bag(path: Path) -> bool:
    return path.is_file() and (path.name == _RECORDING or path.name.endswith(_BAG_FILES))


def _is_empty(path: Path) -> bool:
    """Return whether a path is a file without content, which nobody loses."""
    try:
        return path.is_file() and path.stat().st_size == 0
    except OSError:
        return False


def _is_own(path: Path) -> bool:
    """Return whether slpi wrote a file: a document, a page, or the journal or table of a fleet."""
    if path.suffix not in _OWN_SUFFIXES:
        return False
    head, tail = _ends(path)
    if path.suffix == ".parquet":
        return b"slpi_ros/" in tail
    return bool(_kind(head)) or PAGE_MARK.encode() in head[:1000]


def _kind(head: bytes) -> str:
    """Return the kind of the document that begins with these bytes; "" if it is none."""
    found = _SCHEMA.match(head)
    return found[1].decode() if found else ""


def _ends(path: _Path) -> tuple[bytes, bytes]:
    """Return the first and the last bytes of a regular file; nothing if it cannot be read."""
    try:
        with open_input(path, BAG_BYTES) as file:
            head = file.read(_ENDS)
            file.seek(max(os.fstat(file.fileno()).st_size - _ENDS, 0))
            return head, file.read(_ENDS)
    except (OSError, ValueError):
        return b"", b""
