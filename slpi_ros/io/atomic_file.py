"""Atomic writing of files."""

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TextIO

from slpi_ros.errors import SlpiError


@contextmanager
def all_or_nothing(path: str | os.PathLike[str], failure: type[SlpiError] = SlpiError) -> Iterator[TextIO]:
    """Open a UTF-8 text file that replaces `path` only if the ``with`` block ends without an error, else `failure`."""
    if not str(path) or not is_replaceable(Path(path)):
        raise failure(f"'{path}': cannot be written: no regular file; choose another place")
    # What a link leads to is replaced, not the link.
    target = Path(os.path.realpath(path)) if "\0" not in str(path) else Path(path)
    draft = target.parent / f".{target.name}.{os.getpid()}.partial"
    try:
        with draft.open("w", encoding="utf-8") as file:
            yield file
        os.replace(draft, target)
    except (OSError, ValueError) as error:
        # A name that no file can have, such as one with a NUL character, raises ValueError.
        reason = error.strerror if isinstance(error, OSError) else error
        raise failure(f"{path}: cannot be written: {reason}; choose another place") from None
    finally:
        with suppress(OSError, ValueError):
            draft.unlink(missing_ok=True)


def is_replaceable(path: Path) -> bool:
    """Return False if `path` is something that a file must not replace: a device, a pipe or a socket."""
    try:
        return path.is_file() or path.is_dir() or not os.path.lexists(path)
    except (OSError, ValueError):
        # The error message for an invalid name comes from opening the file.
        return True


def remove_file(path: str | os.PathLike[str]) -> None:
    """Delete a regular file if there is one and it can be deleted; a device, a pipe or a folder stays."""
    with suppress(OSError, ValueError):
        if Path(path).is_file():
            os.unlink(path)


@contextmanager
def output_folder(path: str | os.PathLike[str], *names: str) -> Iterator[Path]:
    """Create an output folder, see `make_folder`; new folders are removed if the ``with`` block raises an error."""
    if not str(path):
        raise SlpiError("'': no folder to write into; name one")
    missing = [place for place in (Path(path), *Path(path).parents) if not os.path.lexists(place)]
    make_folder(path, *names)
    try:
        yield Path(path)
    except BaseException:
        with suppress(OSError):
            # A folder that contains files by now is kept.
            for place in missing:
                place.rmdir()
        raise


def make_folder(path: str | os.PathLike[str], *names: str) -> None:
    """Create a folder and its parents if missing, and check that files with these `names` can be written there."""
    try:
        Path(path).mkdir(parents=True, exist_ok=True)
        reason = "" if os.access(path, os.W_OK) else "it is write-protected"
    except (OSError, ValueError) as error:
        reason = str(error.strerror if isinstance(error, OSError) else error)
    if reason:
        raise SlpiError(f"{path}: no folder to write into: {reason}; choose another place") from None
    require_no_folder(*(Path(path) / name for name in names))


def require_no_folder(*places: Path) -> None:
    """Raise SlpiError if one of the files to be written is a folder."""
    for place in places:
        if place.is_dir():
            raise SlpiError(f"{place}: cannot be written: a folder has that name; choose another place")
