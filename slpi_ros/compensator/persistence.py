"""Storage of the hysteresis memory of a stage between runs of the node, as a validated JSON document."""

import hashlib
import json
import os
import stat
import struct
import time
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime

from slpi_ros.errors import ModelError
from slpi_ros.io.atomic_file import all_or_nothing, remove_file
from slpi_ros.io.file_lock import lock
from slpi_ros.io.input_limits import MEMORY_BYTES, MODEL_BYTES, open_input, read_input
from slpi_ros.io.schemas import validate
from slpi_ros.model.document import format_model
from slpi_ros.model.stage_model import StageModel

# States of the memory: taken from the model and not verified; being reset; reset; restored after a restart.
ASSUMED, RESETTING, KNOWN, RESTORED = "assumed", "resetting", "known", "restored"
# Tolerance for each end of the identified voltage range, as a fraction of its span: measured ends are noisy.
TOLERATED_SHARE = 0.01


@dataclass(frozen=True)
class MemoryConfidence:
    """Confidence in the hysteresis memory of an axis: `ASSUMED`, `RESETTING`, `KNOWN` or `RESTORED`."""

    state: str = ASSUMED
    doubt: str = ""  # why `ASSUMED`; "" if only because it has not been verified
    spanned: tuple[float, float] = (0.0, 0.0)  # V, of the reset
    contradicted: bool = False  # by a measured displacement, for every initial state of the model

    def over(self, identified: tuple[float, float]) -> "MemoryConfidence":
        """Return the confidence on a voltage range (V): a reset does not erase reversals outside its span."""
        (low, high), (lowest, highest) = self.spanned, identified
        margin = TOLERATED_SHARE * (highest - lowest)
        if self.state not in (KNOWN, RESTORED) or (low <= lowest + margin and highest - margin <= high):
            return self
        doubt = (
            f"reset from {low:.6g} to {high:.6g} V only, while the model was identified from {lowest:.6g} to "
            f"{highest:.6g} V; reset it within wider voltage limits, or identify within these"
        )
        return replace(self, state=ASSUMED, doubt=doubt)


# Where a zero comes from: the calibration, a reset of the memory on top of it, or `~/set_zero`.
CALIBRATION, RESET, SENSOR = "calibration", "reset", "sensor"


@dataclass(frozen=True)
class Zero:
    """Zero of an axis: `source`, `CALIBRATION`, `RESET` or `SENSOR`, and since when."""

    source: str = CALIBRATION
    offset: float = 0.0  # m, against that of the identified model
    at: str = ""  # ISO 8601; of the calibration: see the model

    @classmethod
    def now(cls, source: str, offset: float = 0.0) -> "Zero":
        """Return a zero of the present."""
        return cls(source, offset, datetime.now(UTC).isoformat(timespec="seconds"))


KEPT = "{}: another process keeps it; give each compensator a memory_file of its own"
# An entry: identifier of the saved memory that it belongs to, sequence number, voltages, and their checksum.
HEAD, CHECKSUM = struct.Struct("=IQ"), struct.Struct("=I")


class LastVoltages:
    """Store the voltages of every command in the file `path`.last; one write takes about two microseconds.

    One process at a time keeps them: the file is locked as long as that process lives.
    """

    # Two entries with checksums are written alternately, so one of them is intact after a crash of the process. The
    # data is not flushed to the disk: it survives the end of the process, but may be lost at a power failure. `mark` is
    # the identifier (32 bits) of the saved memory that the entries belong to, and may be changed at any time.
    def __init__(self, path: str | os.PathLike[str], mark: int) -> None:
        self._path, self.mark, self._number = _beside(path), mark, 0
        try:
            self._file = os.open(self._path, os.O_WRONLY | os.O_CREAT | os.O_NONBLOCK | os.O_CLOEXEC, 0o644)
        except (OSError, ValueError) as error:
            raise ModelError(f"{path}: cannot be written: {error}; choose another path") from None
        if not stat.S_ISREG(os.fstat(self._file).st_mode):
            os.close(self._file)
            raise ModelError(f"{self._path}: cannot be written: no regular file; choose another path")
        if not lock(self._file):
            os.close(self._file)
            raise ModelError(KEPT.format(path))
        os.ftruncate(self._file, 0)

    def note(self, voltages: bytes) -> None:
        """Write the voltages (V) of all axes, each as a double in native byte order."""
        self._number = number = self._number + 1
        record = HEAD.pack(self.mark, number) + voltages
        record += CHECKSUM.pack(zlib.crc32(record))
        try:
            os.pwrite(self._file, record, (number & 1) * len(record))
        except OSError as error:
            raise ModelError(f"{self._path}: cannot be written: {error.strerror}; free disk space") from None

    def discard(self) -> None:
        """Delete and close the file."""
        remove_file(self._path)
        os.close(self._file)


def is_kept(path: str | os.PathLike[str]) -> bool:
    """Return whether a living process keeps the last voltages of a saved memory."""
    try:
        with open_input(_beside(path), MEMORY_BYTES) as file:
            return not lock(file.fileno(), shared=True)
    except (OSError, ValueError):
        return False


def read_last_voltages(path: str | os.PathLike[str], mark: int, axes: int) -> tuple[float, ...] | None:
    """Return the last voltages (V) stored with a saved memory; None if no intact entry has the identifier `mark`."""
    entry = struct.Struct(f"{HEAD.format}{axes}dI")
    try:
        with open_input(_beside(path), MEMORY_BYTES) as file:
            records = [file.read(entry.size) for _ in range(2)]
    except (OSError, ValueError):
        return None
    found = []
    for record in records:
        if len(record) == entry.size:
            belongs_to, number, *voltages, checksum = entry.unpack(record)
            if belongs_to == mark and checksum == zlib.crc32(record[: -CHECKSUM.size]):
                found.append((number, tuple(voltages)))
    return max(found)[1] if found else None


SCHEMA = "slpi_ros/saved_memory/1"
INTERRUPTED = "the reset was interrupted"
CRASHED = "restored from before a crash: the last voltage is correct, the latest reversals may be missing; reset it"


@dataclass(frozen=True)
class SavedAxis:
    """Saved hysteresis state of one axis."""

    reversal_voltages: tuple[float, ...]  # V, at least one: oldest first, then the last voltage
    certain: bool  # whether the memory was reset or restored when it was saved
    doubt: str = ""  # why the saved state may be incomplete; not written to the file
    zero: Zero = Zero()
    # Distances (m) of slow effects from equilibrium, by their names, `age` (s) ago.
    relaxing: Mapping[str, tuple[float, ...]] = field(default_factory=dict)
    age: float = field(default=0.0, compare=False)

    def confidence(self, identified: tuple[float, float]) -> MemoryConfidence:
        """Return the confidence in the restored memory for a model identified on the voltage range `identified` (V)."""
        if self.certain and not self.doubt:
            return MemoryConfidence(RESTORED, spanned=identified)
        return MemoryConfidence(doubt=self.doubt)

    def after_crash(self, voltage: float) -> "SavedAxis":
        """Return the state recovered after a crash: the saved reversals, then the last output `voltage` (V)."""
        moved = () if voltage == self.reversal_voltages[-1] else (voltage,)
        return replace(self, reversal_voltages=(*self.reversal_voltages, *moved), doubt=CRASHED)


@dataclass(frozen=True)
class SavedMemory:
    """Saved hysteresis state of all axes of a stage."""

    model: str  # `model_id` of the model that it belongs to
    complete: bool  # False after a crash: reversals may be missing
    axes: Mapping[str, SavedAxis]

    def require_fit(self, model: StageModel, names: Sequence[str]) -> None:
        """Raise ModelError unless the state belongs to `model` and holds every axis."""
        if self.model != model_id(model):
            raise ModelError("the saved memory belongs to another model; only its last voltages are used")
        for name in names:
            if name not in self.axes:
                raise ModelError(f"the saved memory has no axis '{name}'; only its last voltages are used")

    @property
    def last_voltages(self) -> dict[str, float]:
        """Last output voltage of each axis, volts."""
        return {name: axis.reversal_voltages[-1] for name, axis in self.axes.items()}


def model_id(model: StageModel) -> str:
    """Return a fingerprint of a model's document, 64 hexadecimal digits."""
    return hashlib.sha256(format_model(model).encode()).hexdigest()


def save_memory(memory: SavedMemory, path: str | os.PathLike[str]) -> int:
    """Write a saved memory atomically; return its identifier for `LastVoltages`."""
    document = {
        "schema": SCHEMA,
        "model": memory.model,
        "complete": memory.complete,
        "saved_at_s": time.time(),
        "axes": {
            name: {
                "went_through_V": list(axis.reversal_voltages),
                "certain": axis.certain,
                "zero": {"from": axis.zero.source, "offset_m": axis.zero.offset, "at": axis.zero.at},
                "relaxing_m": axis.relaxing,
            }
            for name, axis in memory.axes.items()
        },
    }
    text = json.dumps(document, allow_nan=False)
    with all_or_nothing(path, ModelError) as file:
        file.write(text)
    return _mark(text)


def load_memory(path: str | os.PathLike[str]) -> SavedMemory | None:
    """Read a saved memory, updated with the last voltages after a crash; None if the file does not exist."""
    try:
        text = read_input(path, MEMORY_BYTES).decode()
        document = json.loads(text, parse_constant=_refuse)
    except FileNotFoundError:
        return None
    except (OSError, ValueError, RecursionError) as error:
        reason = error.strerror if isinstance(error, OSError) else error
        raise ModelError(f"{path}: no saved memory: {reason}; it is ignored") from None
    try:
        validate(document, "saved_memory", str(path))
    except RecursionError:
        raise ModelError(f"{path}: no saved memory: nested too deeply; it is ignored") from None
    age = max(time.time() - document.get("saved_at_s", 0.0), 0.0)
    axes = {
        name: SavedAxis(
            tuple(map(float, axis["went_through_V"])),
            axis["certain"],
            zero=Zero(zero["from"], float(zero["offset_m"]), zero["at"]) if (zero := axis.get("zero")) else Zero(),
            relaxing={effect: tuple(map(float, each)) for effect, each in axis.get("relaxing_m", {}).items()},
            age=age,
        )
        for name, axis in document["axes"].items()
    }
    if not document["complete"]:
        saved = tuple(axis.reversal_voltages[-1] for axis in axes.values())
        last = read_last_voltages(path, _mark(text), len(axes)) or saved
        axes = {name: axis.after_crash(v) for (name, axis), v in zip(axes.items(), last, strict=True)}
    return SavedMemory(document["model"], document["complete"], axes)


class MemoryFile:
    """Save the memory of a stage whenever it has changed, with the voltages since the last save."""

    def __init__(self, path: str) -> None:
        self.path = path
        self._saved: SavedMemory | None = None  # by this process
        self._last: LastVoltages | None = None

    def save(self, model: StageModel, axes: Mapping[str, SavedAxis], complete: bool) -> None:
        """Write the state of `axes` if it has changed; `complete`: no further voltage is output afterwards."""
        memory = SavedMemory(model_id(model), complete, axes)
        if memory == self._saved:
            return
        if self._saved is None:
            _require_no_other(self.path)
            if self.used:
                raise ModelError(KEPT.format(self.path))
        try:
            mark = save_memory(memory, self.path)
        except ModelError:
            if not complete and (self._saved is None or self._saved.complete):
                # The complete state in the file is no longer the present one, but a crash would make it look so.
                remove_file(self.path)
            raise
        self._saved = memory
        if self._last and complete:
            self._last.discard()
            self._last = None
        elif self._last:
            self._last.mark = mark
        elif not complete:
            self._last = LastVoltages(self.path, mark)

    @property
    def used(self) -> bool:
        """Whether another process keeps it."""
        return self._last is None and is_kept(self.path)

    def note(self, voltages: bytes) -> None:
        """Store the voltages just output (V, native doubles), for recovery after a crash; called for each command."""
        if self._last:
            self._last.note(voltages)


def _require_no_other(path: str) -> None:
    """Raise ModelError if the file is another document, such as a model; a damaged memory is replaced."""
    try:
        schema = json.loads(read_input(path, MODEL_BYTES))["schema"]
    except (OSError, ValueError, RecursionError, LookupError, TypeError):
        return
    if not str(schema).startswith(SCHEMA.rpartition("/")[0]):
        raise ModelError(f"{path}: cannot be written: it is a document of schema {schema!r}; choose another path")


def _mark(text: str) -> int:
    """Return the identifier that links stored voltages to the text of a saved memory."""
    return zlib.crc32(text.encode())


def _beside(path: str | os.PathLike[str]) -> str:
    return f"{os.fspath(path)}.last"


def _refuse(constant: str) -> float:
    raise ValueError(f"{constant} is not a voltage")
