"""Fetch the public measured records with git, and turn them into tables and bags.

    python -m benchmarks.measured.fetch -o FOLDER

FOLDER receives a table ``RECORD.csv`` and a bag ``bags/RECORD`` of each record. The tables have to have the checksums
of the manifest. Of a repository only the commit that the manifest names is fetched, and of that only the files of its
records. With ``--mirror DIR`` nothing is fetched: DIR holds git repositories ``OWNER/NAME`` or ``OWNER/NAME.git``, bare
or not, as ``git clone`` makes them. ``insteadOf`` in a git configuration has the same use.
"""

import argparse
import hashlib
import os
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Protocol

from benchmarks.measured.manifest import MANIFEST, Manifest, MeasuredRecord, Source, read_manifest
from benchmarks.measured.sources import ExtractionError, table_of
from slpi_ros.errors import SlpiError
from slpi_ros.io.bag_writer import write_bag
from slpi_ros.io.columns import ColumnOptions
from slpi_ros.io.tables import import_with_summary

# Seconds after which git is given up.
PATIENCE = 600


class FetchError(Exception):
    """Files that could not be had, with the repository and the reason."""


class Files(Protocol):
    """Where the files of a repository come from."""

    def read(self, source: Source, path: str) -> bytes:
        """Return the content of a file at the source's commit; FetchError if it cannot be had."""
        ...


def _git(arguments: Sequence[str | Path], what: str) -> bytes:
    # Without a terminal git must not ask for a password: a repository that is gone looks like a private one.
    surroundings = {**os.environ, "GIT_TERMINAL_PROMPT": "0", "LC_ALL": "C"}
    try:
        done = subprocess.run(
            ["git", *map(str, arguments)], capture_output=True, check=True, env=surroundings, timeout=PATIENCE
        )
    except FileNotFoundError:
        raise FetchError("git is not installed") from None
    except subprocess.TimeoutExpired:
        raise FetchError(f"{what}: no answer within {PATIENCE} s") from None
    except subprocess.CalledProcessError as error:
        lines = error.stderr.decode(errors="replace").strip().splitlines() or ["git failed"]
        raise FetchError(f"{what}: {lines[0].removeprefix('fatal: ')}") from None
    return done.stdout


class Remote:
    """Repositories on GitHub, over https; each is fetched once into a folder of its own below `folder`."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._fetched: dict[Source, Path] = {}

    def read(self, source: Source, path: str) -> bytes:
        """Return the content of a file at the source's commit."""
        if source not in self._fetched:
            self._fetched[source] = self._fetch(source)
        return _git(["-C", self._fetched[source], "cat-file", "blob", f"{source.commit}:{path}"], source.repository)

    def _fetch(self, source: Source) -> Path:
        place = self._folder / source.repository.replace("/", "+")
        _git(["init", "--quiet", place], source.repository)
        url = f"https://github.com/{source.repository}.git"
        _git(["-C", place, "config", "remote.origin.url", url], source.repository)
        # Without its blobs: a file is fetched when it is read.
        fetch = ["fetch", "--quiet", "--depth", "1", "--filter=blob:none", "origin", source.commit]
        _git(["-C", place, *fetch], url)
        return place


class Mirror:
    """Repositories that are on this machine already, in `folder`."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def read(self, source: Source, path: str) -> bytes:
        """Return the content of a file at the source's commit."""
        places = [self._folder / f"{source.repository}{ending}" for ending in ("", ".git")]
        place = next((place for place in places if place.is_dir()), None)
        if place is None:
            raise FetchError(f"{self._folder} holds no {source.repository}")
        directory = place / ".git" if (place / ".git").is_dir() else place
        name = f"{source.commit}:{path}"
        return _git([f"--git-dir={directory}", "cat-file", "blob", name], f"{place}: {path}")


def extract(record: MeasuredRecord, name: str, source: Source, files: Files) -> bytes:
    """Return the table of a record as a CSV file; FetchError if it is not the one that the manifest describes."""
    contents = [files.read(source, path) for path in record.files]
    try:
        table = table_of(record.extraction, ",".join(record.columns), contents)
    except ExtractionError as error:
        raise FetchError(f"{name}: {error}") from None
    found = hashlib.sha256(table).hexdigest()
    if found != record.sha256:
        raise FetchError(f"{name}: the table has the sha256 {found}, not {record.sha256} of the manifest")
    return table


def write(name: str, table: bytes, folder: Path) -> str:
    """Write a table and its bag below `folder`; return a line that says what is there."""
    path = folder / f"{name}.csv"
    path.write_bytes(table)
    found = import_with_summary(path, ColumnOptions())
    bag = folder / "bags" / name
    bag.parent.mkdir(exist_ok=True)
    write_bag(bag, found.record, replace=True, desired=found.desired)
    return f"{name}: {len(found.record)} samples of {', '.join(found.record.axes)}, {found.record.t[-1]:.6g} s"


def fetch(manifest: Manifest, names: Sequence[str], files: Files, folder: Path) -> list[str]:
    """Fetch the records `names` into `folder`; return what went wrong, one line each."""
    problems: list[str] = []
    for name in names:
        record = manifest.records[name]
        try:
            table = extract(record, name, manifest.sources[record.source], files)
            print(write(name, table, folder), flush=True)
        except (FetchError, SlpiError, OSError) as error:
            if str(error) not in problems:
                problems.append(str(error))
    return problems


def main(arguments: Sequence[str] | None = None) -> int:
    """Fetch all records, or those named; return 1 if any could not be had."""
    parser = argparse.ArgumentParser(description="Fetch the public measured records: tables and bags.")
    parser.add_argument("-o", "--output", type=Path, required=True, help="folder of the tables and bags")
    parser.add_argument("--mirror", type=Path, help="folder of git repositories OWNER/NAME, instead of the network")
    parser.add_argument("--only", nargs="+", metavar="RECORD", help="these records alone")
    parser.add_argument("--manifest", type=Path, default=MANIFEST, help="another manifest")
    options = parser.parse_args(arguments)
    try:
        manifest = read_manifest(options.manifest)
        options.output.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        parser.error(f"{error.filename}: {error.strerror}")
    names = options.only or list(manifest.records)
    if unknown := [name for name in names if name not in manifest.records]:
        parser.error(f"no record {', '.join(unknown)}; there are {', '.join(manifest.records)}")
    with tempfile.TemporaryDirectory(prefix="measured_") as folder:
        files: Files = Mirror(options.mirror) if options.mirror else Remote(Path(folder))
        problems = fetch(manifest, names, files, options.output)
    for problem in problems:
        print(f"error: {problem}", file=sys.stderr)
    return 1 if problems else 0


if __name__ == "__main__":
    sys.exit(main())
