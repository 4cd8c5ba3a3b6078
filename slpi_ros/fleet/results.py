"""The results of a fleet on disk: a journal of finished bags, and the table ``results.parquet`` made from it."""
# The journal ``journal.jsonl`` is appended to, one line per finished step, and each line is complete or dropped when it
# is read again. So a run that was killed at any moment is continued from what it had finished.

import json
import os
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

from slpi_ros.errors import SlpiError, UsageError
from slpi_ros.fleet.bags import Examined, Judged, Row
from slpi_ros.io.atomic_file import is_replaceable, make_folder
from slpi_ros.io.file_lock import lock

if TYPE_CHECKING:
    import pyarrow as pa

SCHEMA = "slpi_ros/fleet/1"
# Seconds between two moments at which the journal is forced to the disk; later lines are lost with the machine only.
SYNC = 1.0
TABLE, JOURNAL, LOCK = "results.parquet", "journal.jsonl", ".lock"


@dataclass
class State:
    """What is known of all bags."""

    examined: dict[str, Examined] = field(default_factory=dict)  # by path
    judged: dict[str, Judged] = field(default_factory=dict)  # by path
    references: dict[str, str] = field(default_factory=dict)  # reference models, in the folder, by stage

    def rows(self) -> list[Row]:
        """Return the rows of all bags, by stage, axis, date and path."""
        every = [row for one in self.judged.values() for row in one.rows]
        return sorted(every, key=lambda row: (row.stage, row.axis, row.date_ns or 0, row.bag))


class Results:
    """The folder of the results, created if missing, locked against other runs while it is open."""

    # The rows depend on `options`; a folder with results of others is refused.
    def __init__(self, folder: str | os.PathLike[str], options: Mapping[str, Any]) -> None:
        self.folder, self.state = Path(os.path.realpath(folder)), State()
        make_folder(self.folder, TABLE, JOURNAL, LOCK)
        self._lock = os.open(self.folder / LOCK, os.O_RDWR | os.O_CREAT, 0o644)
        self._file, self._synced = -1, 0.0
        try:
            if not lock(self._lock):
                raise SlpiError(f"{folder}: another run writes into this folder; wait for its end, or name another")
            self._file = os.open(self.folder / JOURNAL, os.O_RDWR | os.O_CREAT | os.O_APPEND, 0o644)
            self._read({"schema": SCHEMA, **options})
        except BaseException:
            self.close()
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Release the folder."""
        for descriptor in (self._file, self._lock):
            if descriptor >= 0:
                os.close(descriptor)
        self._file = self._lock = -1

    def add_examined(self, one: Examined) -> None:
        """Keep the examination of a bag; earlier rows of the bag no longer count."""
        self._append({"examined": asdict(one)})
        self._take_examined(one)

    def add_judged(self, path: str, judged: Judged, reference_of: str | None = None) -> None:
        """Keep the rows of a bag; with `reference_of`, its model becomes the reference of this stage."""
        self._append({"judged": {"bag": path, **asdict(judged), "reference_of": reference_of}})
        self._take_judged(path, judged, reference_of)

    def add_reference(self, stage: str, model: str) -> None:
        """Keep the path of the given reference model of a stage."""
        self._append({"reference": [stage, model]})
        self.state.references[stage] = model

    def write_table(self) -> None:
        """Write ``results.parquet`` atomically."""
        import pyarrow.parquet as pq

        target, draft = self.folder / TABLE, self.folder / f".{TABLE}.partial"
        if not is_replaceable(target):
            raise SlpiError(f"{target}: cannot be written: no regular file; choose another folder")
        try:
            pq.write_table(as_table(self.state.rows()), draft, compression="zstd")
            os.replace(draft, target)
        except OSError as error:
            draft.unlink(missing_ok=True)
            raise SlpiError(self._full(target, error)) from None

    def _append(self, entry: Mapping[str, Any]) -> None:
        line = json.dumps(entry, allow_nan=False, separators=(",", ":")).encode() + b"\n"
        end = os.lseek(self._file, 0, os.SEEK_END)
        try:
            written = os.write(self._file, line)
            if written < len(line):
                # The next write tells the reason.
                os.write(self._file, line[written:])
            if time.monotonic() - self._synced > SYNC:
                os.fsync(self._file)
                self._synced = time.monotonic()
        except OSError as error:
            os.ftruncate(self._file, end)
            raise SlpiError(self._full(self.folder / JOURNAL, error)) from None

    def _full(self, place: Path, error: OSError) -> str:
        return (
            f"{place}: cannot be written: {error.strerror or error}; the rows of {len(self.state.judged)} bags are "
            "kept: free some space and run the same command again"
        )

    def _read(self, header: Mapping[str, Any]) -> None:
        """Read the journal, drop an incomplete last line, and write the header of a new one."""
        with (self.folder / JOURNAL).open("rb") as file:
            text = file.read()
        whole = text.rfind(b"\n") + 1
        if whole < len(text):
            os.ftruncate(self._file, whole)
        lines = text[:whole].splitlines()
        if not lines:
            self._append(header)
            return
        where = self.folder / JOURNAL
        try:
            entries = [json.loads(line) for line in lines]
            found, wanted = dict(entries[0]), dict(header)
            if found.get("schema") != wanted["schema"]:
                raise SlpiError(f"{where}: schema is {found.get('schema')!r}, this version continues {SCHEMA!r}")
            if found != wanted:
                differing = ", ".join(key for key in wanted if found.get(key) != wanted[key])
                raise UsageError(f"{self.folder}: holds results of another {differing}; name another folder")
            for entry in entries[1:]:
                self._take(entry)
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            raise SlpiError(f"{where}: no journal of a fleet: {error}; name another folder") from None

    def _take(self, entry: Mapping[str, Any]) -> None:
        if "examined" in entry:
            self._take_examined(Examined.of_document(entry["examined"]))
        elif "judged" in entry:
            one = entry["judged"]
            rows = tuple(Row.of_document(row) for row in one["rows"])
            self._take_judged(one["bag"], Judged(rows, one["unexplained"], one["model"]), one["reference_of"])
        else:
            stage, model = entry["reference"]
            self.state.references[stage] = model

    def _take_examined(self, one: Examined) -> None:
        self.state.examined[one.bag.path] = one
        self.state.judged.pop(one.bag.path, None)

    def _take_judged(self, path: str, judged: Judged, reference_of: str | None) -> None:
        self.state.judged[path] = judged
        if reference_of is not None and judged.model:
            self.state.references[reference_of] = judged.model


def as_table(rows: Sequence[Row]) -> "pa.Table":
    """Return the rows as an Arrow table with the schema that ``msg_schemas/README.md`` describes."""
    import pyarrow as pa

    text, number = pa.string(), pa.float64()
    cause = pa.struct(
        [("name", text), ("parameters", text), ("gain_percent", number), ("share_of_residual", number),
         ("p_value", number)]
    )  # fmt: skip
    kinds = {
        "date_ns": pa.timestamp("ns", "UTC"),
        "samples": pa.int64(),
        "causes": pa.list_(cause),
        "findings": pa.list_(text),
    }
    columns, schema = [], []
    for item in fields(Row):
        default = number if item.default is None or isinstance(item.default, float) else text
        kind = kinds.get(item.name, default)
        values = [getattr(row, item.name) for row in rows]
        if item.name == "causes":
            values = [[dict(cause) for cause in causes] for causes in values]
        elif item.name == "findings":
            values = [[_utf8(finding) for finding in findings] for findings in values]
        elif kind == text:
            values = [_utf8(value) for value in values]
        columns.append(pa.array(values, kind))
        schema.append(pa.field(item.name.removesuffix("_ns"), kind))
    return pa.table(columns, schema=pa.schema(schema, {"schema": SCHEMA}))


def _utf8(text: str) -> str:
    """Return a text that a column can hold: bytes of the name of a file that are not UTF-8 are escaped."""
    return text.encode(errors="backslashreplace").decode()
