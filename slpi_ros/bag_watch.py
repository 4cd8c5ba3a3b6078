"""Bags that are being finished in a folder."""

import os
from pathlib import Path

from slpi_ros.errors import UsageError

# The last bytes of a complete mcap file.
_MCAP_END = b"\x89MCAP0\r\n"


class BagWatch:
    """Watches a folder for bags that are complete; one that is still being written is not.

    A rosbag2 folder is complete once it holds ``metadata.yaml``, which its writer adds last; a lone mcap file once it
    ends as such files do. Lone sqlite3 files do not tell, and are left out.

    Parameters
    ----------
    folder : path
        Bags that are complete there already count as seen, but for the newest one.

    Raises
    ------
    UsageError
        If there is no such folder.
    """

    def __init__(self, folder: str | os.PathLike[str]) -> None:
        self.folder = Path(folder)
        if not self.folder.is_dir():
            raise UsageError(f"{folder}: no such folder to watch for bags; make it, or name another")
        self._seen = set(self._complete()[:-1])

    def look(self) -> list[Path]:
        """Return the bags completed since the last look, oldest first; a folder that has gone holds none."""
        new = [bag for bag in self._complete() if bag not in self._seen]
        self._seen.update(new)
        return [path for path, _ in new]

    def _complete(self) -> list[tuple[Path, int]]:
        """Return complete bags with the time they were finished (ns), oldest first."""
        found = []
        try:
            for path in self.folder.iterdir():
                finished = None if path.name.startswith(".") else _finished(path)
                if finished is not None:
                    found.append((path, finished))
        except OSError:
            # Vanished in between: another look will tell.
            pass
        return sorted(found, key=lambda bag: bag[1])


def _finished(path: Path) -> int | None:
    """Return when a bag was finished (ns), or None if it is none or still being written."""
    metadata = path / "metadata.yaml"
    if path.is_dir():
        return metadata.stat().st_mtime_ns if metadata.is_file() and metadata.stat().st_size else None
    if path.suffix != ".mcap" or path.stat().st_size <= 2 * len(_MCAP_END):
        return None
    with path.open("rb") as file:
        file.seek(-len(_MCAP_END), os.SEEK_END)
        return path.stat().st_mtime_ns if file.read() == _MCAP_END else None
