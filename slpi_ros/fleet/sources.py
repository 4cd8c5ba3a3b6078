"""The bags of a fleet: bags, folders of bags and CSV lists, and the given models."""

import csv
import os
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from slpi_ros.errors import RecordError, UsageError
from slpi_ros.io.bag_files import SUFFIXES, finished
from slpi_ros.io.stage_name import stage_name
from slpi_ros.io.unfinished_bags import abandoned_in, place_of
from slpi_ros.model.document import load_model
from slpi_ros.model.stage_model import StageModel

_Path = str | os.PathLike[str]
_LIST_COLUMNS = ("bag", "stage")


@dataclass(frozen=True)
class Bag:
    """A bag on disk; size and time of change tell a changed bag from a processed one, both 0 if there is none."""

    path: str  # absolute, folder or file
    stage: str = ""  # from a CSV list; "": the bag's hardware id names it
    size: int = 0  # bytes
    modified: int = 0  # ns


def find_bags(sources: Sequence[_Path]) -> list[Bag]:
    """Return the bags of all sources, each once, sorted by path."""
    # Sources are bags, folders that are searched recursively (hidden entries are skipped), and CSV files with the
    # columns ``bag`` and ``stage``; relative paths in a list start at its folder.
    if not sources:
        raise UsageError("no source given; name bags, folders of bags or CSV lists of bags")
    found: dict[str, str] = {}
    for source in map(place_of, map(Path, sources)):
        if not source.exists():
            raise RecordError(f"{source}: no such bag, folder or list; check the path")
        entries = _listed(source) if source.suffix == ".csv" else ((path, "") for path in _bags_below(source))
        for path, stage in entries:
            key = str(path.resolve())
            if stage and found.get(key, "") not in ("", stage):
                raise UsageError(f"{source}: {key} is of stage '{stage}' and of '{found[key]}'; list one stage")
            found[key] = stage or found.get(key, "")
    return [_as_bag(path, stage) for path, stage in sorted(found.items())]


def is_complete(bag: Bag, now: float, patience: float) -> bool:
    """Return whether a bag is completely written, or has not grown for `patience` (s) before `now` (s, Unix time)."""
    with suppress(OSError):
        if finished(Path(bag.path)) is not None:
            return True
    return now - bag.modified * 1e-9 >= patience


def load_models(folder: _Path | None) -> dict[str, StageModel]:
    """Return the newest model of each stage in a folder, searched recursively; files that name no stage fail."""
    if folder is None:
        return {}
    if not Path(folder).is_dir():
        raise UsageError(f"{folder}: no such folder of models; name one, or omit it")
    models: dict[str, StageModel] = {}
    for path in sorted(Path(folder).rglob("*.json")):
        model = load_model(path)
        if not (stage := stage_name(model.hardware_id)):
            raise UsageError(f"{path}: the model names no stage; identify it from a bag with a hardware id")
        if stage not in models or model.created > models[stage].created:
            models[stage] = model
    return models


def _bags_below(path: Path) -> Iterator[Path]:
    """Yield the bag at a path, or the bags below it if it is a folder without a bag of its own."""
    if path.is_file() or (path / "metadata.yaml").exists() or path == abandoned_in(path.parent):
        yield path
        return
    entries = sorted(entry for entry in path.iterdir() if not entry.name.startswith("."))
    files = [entry for entry in entries if entry.is_file() and entry.name.endswith(SUFFIXES)]
    # A recorder names the files of a bag after its folder; other files in a folder are bags by themselves.
    if files and all(file.name.startswith(f"{path.name}_") for file in files):
        yield path
        return
    yield from files
    for entry in entries:
        if entry.is_dir():
            yield from _bags_below(entry)


def _listed(source: Path) -> Iterator[tuple[Path, str]]:
    """Yield path and stage of each bag of a CSV list."""
    try:
        with source.open(encoding="utf-8-sig", newline="") as file:
            rows = csv.DictReader(file, skipinitialspace=True)
            if not set(_LIST_COLUMNS) <= set(rows.fieldnames or ()):
                raise UsageError(f"{source}: columns are {rows.fieldnames}; give {','.join(_LIST_COLUMNS)}")
            for row in rows:
                if row["bag"]:
                    yield source.parent / row["bag"].strip(), (row["stage"] or "").strip()
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise RecordError(f"{source}: cannot be read as a list of bags: {error}; give UTF-8 CSV") from None


def _as_bag(path: str, stage: str) -> Bag:
    place = Path(path)
    size, modified = 0, 0
    try:
        for file in place.iterdir() if place.is_dir() else (place,):
            stat = file.stat()
            size, modified = size + stat.st_size, max(modified, stat.st_mtime_ns)
    except OSError:
        # A bag that cannot be read is a row of the result with its reason.
        return Bag(path, stage)
    return Bag(path, stage, size, modified)
