"""Bags that are being finished in a folder."""

import os
import time
from collections.abc import Callable
from pathlib import Path

from slpi_ros.errors import UsageError
from slpi_ros.io.bag_files import partial_path

# The last bytes of a complete mcap file.
_MCAP_END = b"\x89MCAP0\r\n"
# Seconds. The writer of a slow record fills a whole chunk before its file grows.
PATIENCE = 120.0


class BagWatch:
    """Watches a folder for bags that are complete; one that is still being written is not.

    A rosbag2 folder is complete once it holds ``metadata.yaml``, which its writer adds last; a lone mcap file once it
    ends as such files do. Lone sqlite3 files do not tell, and are left out.

    Parameters
    ----------
    folder : path
        Bags that are complete there already count as seen, but for the newest one.
    patience : float, seconds
        A bag that is not complete and has not grown for so long counts as abandoned.

    Attributes
    ----------
    abandoned : tuple of Path
        Bags that were so at the last look, by name; they stay watched.

    Raises
    ------
    UsageError
        If there is no such folder.
    """

    def __init__(self, folder: str | os.PathLike[str], patience: float = PATIENCE) -> None:
        self.folder, self.patience = Path(folder), patience
        self.abandoned: tuple[Path, ...] = ()
        if not self.folder.is_dir():
            raise UsageError(f"{folder}: no such folder to watch for bags; make it, or name another")
        self._seen = set(self._dated(_finished)[:-1])

    def look(self) -> list[Path]:
        """Return the bags completed since the last look, oldest first; a folder that has gone holds none."""
        new = [bag for bag in self._dated(_finished) if bag not in self._seen]
        self._seen.update(new)
        last = time.time_ns() - int(self.patience * 1e9)
        self.abandoned = tuple(sorted(bag for bag, grown in self._dated(_grown) if grown <= last))
        return [path for path, _ in new]

    def _dated(self, date: Callable[[Path], int | None]) -> list[tuple[Path, int]]:
        """Return what has a date (ns), oldest first."""
        found = []
        for path in self._entries():
            try:
                when = date(path)
            except OSError:
                # Vanished in between: another look will tell.
                continue
            if when is not None:
                found.append((path, when))
        return sorted(found, key=lambda bag: bag[1])

    def _entries(self) -> list[Path]:
        try:
            return list(self.folder.iterdir())
        except OSError:
            return []


def _finished(path: Path) -> int | None:
    """Return when a bag was finished (ns), or None if it is none or still being written."""
    if path.name.startswith("."):
        return None
    metadata = path / "metadata.yaml"
    if path.is_dir():
        return metadata.stat().st_mtime_ns if metadata.is_file() and metadata.stat().st_size else None
    if path.suffix != ".mcap" or path.stat().st_size <= 2 * len(_MCAP_END):
        return None
    with path.open("rb") as file:
        file.seek(-len(_MCAP_END), os.SEEK_END)
        return path.stat().st_mtime_ns if file.read() == _MCAP_END else None


def _grown(path: Path) -> int | None:
    """Return when a bag that is not finished last grew (ns), or None if it is finished or none."""
    if _finished(path) is not None:
        return None
    if not path.is_dir():
        return path.stat().st_mtime_ns if path.suffix == ".mcap" and not path.name.startswith(".") else None
    folder = path
    if path.name.startswith("."):
        # Where this package's own recorder keeps what is not complete.
        folder = path / path.name[1:].removesuffix(".partial")
        if path != partial_path(path.with_name(folder.name)) or not folder.is_dir():
            return None
    parts = [file for file in folder.iterdir() if {".mcap", ".db3"}.intersection(file.suffixes)]
    return max(file.stat().st_mtime_ns for file in (folder, *parts)) if parts else None
