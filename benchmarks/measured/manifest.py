"""The public measured records: where each comes from, what it holds, and which parts are fitted and judged."""

import json
import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any, TypeVar

MANIFEST = Path(__file__).with_name("manifest.json")

Made = TypeVar("Made")

_COMMIT = re.compile(r"[0-9a-f]{40}")
_SHA256 = re.compile(r"[0-9a-f]{64}")
_REPOSITORY = re.compile(r"[\w.-]+/[\w.-]+")


class ManifestError(ValueError):
    """An entry of the manifest that cannot be right."""


@dataclass(frozen=True)
class Source:
    """A public repository.

    Parameters
    ----------
    repository : str
        ``owner/name`` on GitHub.
    commit : str
        The commit that holds the files, 40 hexadecimal digits.
    licence : str
        Licence of the repository; ``none stated`` where it names none.
    device : str
        What was measured.
    moves : bool
        Whether a motion was measured; False for a polarisation.
    piezo : bool
        Whether that of a piezo.
    """

    repository: str
    commit: str
    licence: str
    device: str
    moves: bool = True
    piezo: bool = False

    def __post_init__(self) -> None:
        _require(bool(_REPOSITORY.fullmatch(self.repository)), f"repository '{self.repository}' is not owner/name")
        _require(bool(_COMMIT.fullmatch(self.commit)), f"{self.repository}: commit '{self.commit}' has not 40 digits")
        _require(bool(self.licence), f"{self.repository}: no licence; write 'none stated' where there is none")
        _require(bool(self.device), f"{self.repository}: not said what was measured")


@dataclass(frozen=True)
class MeasuredRecord:
    """A table that is extracted from files of a repository.

    Parameters
    ----------
    source : str
        Key of the source.
    files : tuple of str
        Paths in the repository.
    extraction : str
        Name of the function of ``sources.py`` that makes the table.
    columns : mapping of str to str
        Unit of each column of the table, in order; what the measured quantity is where it is no displacement.
    rate_hz : float
        Mean sampling rate, Hz.
    sha256 : str
        Of the extracted table, as a CSV file.
    known : str
        What is known of the record.
    """

    source: str
    files: tuple[str, ...]
    extraction: str
    columns: Mapping[str, str]
    rate_hz: float
    sha256: str
    known: str

    def __post_init__(self) -> None:
        _require(bool(self.files), "no files")
        for file in self.files:
            path = PurePosixPath(file)
            _require(not path.is_absolute() and ".." not in path.parts, f"path '{file}' leads out of the repository")
        _require(next(iter(self.columns), "") == "time_s", "the first column is not time_s")
        _require("voltage_V" in self.columns, "no column voltage_V")
        _require(any(name.startswith("displacement") for name in self.columns), "no column displacement..")
        _require(math.isfinite(self.rate_hz) and self.rate_hz > 0.0, f"rate_hz {self.rate_hz} is not above 0")
        _require(bool(_SHA256.fullmatch(self.sha256)), f"sha256 '{self.sha256}' has not 64 digits")


@dataclass(frozen=True)
class Span:
    """A part of a record, from `start` to before `stop`, s; by default all of it.

    For the tables: its `name`, and `why` a model of hysteresis can be worse there than a straight line.
    """

    record: str
    start: float = 0.0
    stop: float = math.inf
    name: str = ""
    why: str = ""

    def __post_init__(self) -> None:
        _require(0.0 <= self.start < self.stop, f"{self.record}: from {self.start} to {self.stop} s is no time span")

    def __str__(self) -> str:
        """Return the record's name and the time span, if it is not the whole record."""
        if self.start == 0.0 and math.isinf(self.stop):
            return self.record
        stop = "end" if math.isinf(self.stop) else f"{self.stop:g} s"
        return f"{self.record}, {self.start:g} s to {stop}"


@dataclass(frozen=True)
class Task:
    """One comparison: the parts that every method is fitted to, and those on which it is judged.

    Parameters
    ----------
    name : str
    axis : str
        Of the stage, as ``slpi import`` names it.
    fitted, judged : tuple of Span
    """

    name: str
    axis: str
    fitted: tuple[Span, ...]
    judged: tuple[Span, ...]

    def __post_init__(self) -> None:
        _require(bool(self.fitted) and bool(self.judged), f"task '{self.name}' fits or judges nothing")
        for judged in self.judged:
            for fitted in self.fitted:
                apart = judged.start >= fitted.stop or fitted.start >= judged.stop
                _require(judged.record != fitted.record or apart, f"task '{self.name}': {judged} is fitted and judged")


@dataclass(frozen=True)
class Manifest:
    """Sources and records by name, and the tasks."""

    sources: Mapping[str, Source]
    records: Mapping[str, MeasuredRecord]
    tasks: tuple[Task, ...]

    def __post_init__(self) -> None:
        for name, record in self.records.items():
            _require(record.source in self.sources, f"record '{name}': unknown source '{record.source}'")
        names = [task.name for task in self.tasks]
        _require(len(set(names)) == len(names), "two tasks have the same name")
        for task in self.tasks:
            for span in (*task.fitted, *task.judged):
                _require(span.record in self.records, f"task '{task.name}': unknown record '{span.record}'")


def _require(holds: bool, message: str) -> None:
    if not holds:
        raise ManifestError(message)


def read_manifest(path: Path = MANIFEST) -> Manifest:
    """Read a manifest; ManifestError, with the entry, if it cannot be right."""
    document = json.loads(path.read_text(encoding="utf-8"))
    return Manifest(
        sources={name: _made(Source, name, entry) for name, entry in document["sources"].items()},
        records={
            name: _made(MeasuredRecord, name, {**entry, "files": tuple(entry["files"])})
            for name, entry in document["records"].items()
        },
        tasks=tuple(
            _made(
                Task,
                entry["name"],
                {
                    **entry,
                    "fitted": tuple(_made(Span, entry["name"], span) for span in entry["fitted"]),
                    "judged": tuple(_made(Span, entry["name"], span) for span in entry["judged"]),
                },
            )
            for entry in document["tasks"]
        ),
    )


def _made(kind: type[Made], name: str, entry: Mapping[str, Any]) -> Made:
    try:
        return kind(**entry)
    except TypeError as error:
        raise ManifestError(f"{name}: {error}") from None
