"""The memory of a stage, kept over a restart of the node: JSON, validated."""

import hashlib
import json
import os
import struct
import zlib
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

from slpi_ros.errors import ModelError
from slpi_ros.io.atomic_file import all_or_nothing
from slpi_ros.io.schemas import validate
from slpi_ros.model.document import format_model
from slpi_ros.model.limits import Limits
from slpi_ros.model.stage_model import StageModel

# As the model says, but not verified; being wiped; wiped since; kept over a restart.
ASSUMED, RESETTING, KNOWN, RESTORED = "assumed", "resetting", "known", "restored"
# A drive may miss either end of the identified voltages by this share of their span: measured ends are noisy.
TOLERATED_SHARE = 0.01


@dataclass(frozen=True)
class MemoryConfidence:
    """How far a memory is to be trusted.

    Parameters
    ----------
    state : str
        `ASSUMED`, `RESETTING`, `KNOWN` or `RESTORED`.
    doubt : str
        Why it is assumed, where there is more to say than that nothing has verified it.
    spanned : (float, float), volts
        Lowest and highest voltage of the drive that made it known.
    contradicted : bool
        Whether a measured displacement fits none of the memories that were considered.
    """

    state: str = ASSUMED
    doubt: str = ""
    spanned: tuple[float, float] = (0.0, 0.0)
    contradicted: bool = False

    def over(self, identified: tuple[float, float]) -> "MemoryConfidence":
        """Return what it is worth for a model identified on these voltages (V).

        Loops wider than the drive are not wiped by it: what the stage did there before still counts.
        """
        (low, high), (lowest, highest) = self.spanned, identified
        margin = TOLERATED_SHARE * (highest - lowest)
        if self.state not in (KNOWN, RESTORED) or (low <= lowest + margin and highest - margin <= high):
            return self
        doubt = (
            f"wiped from {low:.6g} to {high:.6g} V only, while the model was identified from {lowest:.6g} to "
            f"{highest:.6g} V; reset it within wider voltage limits, or identify within these"
        )
        return replace(self, state=ASSUMED, doubt=doubt)


# What a record begins with: a mark of what it belongs to, and its number.
HEAD = struct.Struct("<IQ")
VOLTAGE_BYTES, CHECKSUM_BYTES = 8, 4


class LastVoltages:
    """Notes every command in two microseconds.

    Two records are written in turn, each with a checksum: whenever the process dies, one of them is whole. The system
    keeps what has been written, so nothing waits for the disk; only when the machine itself fails may it be lost.

    Parameters
    ----------
    path : path-like
        A file of that name is emptied.
    mark : int
        Of what the records belong to, 32 bits; it may be changed at any time.

    Raises
    ------
    ModelError
        If the file cannot be written.
    """

    def __init__(self, path: str | os.PathLike[str], mark: int) -> None:
        self._path, self.mark, self._number = path, mark, 0
        try:
            self._file = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_CLOEXEC, 0o644)
        except (OSError, ValueError) as error:
            raise ModelError(f"{path}: cannot be written: {error}; choose another place") from None

    def note(self, voltages: bytes) -> None:
        """Note the voltages (V) of all axes, each 8 bytes as the machine has them.

        Raises
        ------
        ModelError
            If the file cannot be written.
        """
        self._number = number = self._number + 1
        record = HEAD.pack(self.mark, number) + voltages
        try:
            os.pwrite(self._file, record + zlib.crc32(record).to_bytes(4, "little"), (number & 1) * (len(record) + 4))
        except OSError as error:
            raise ModelError(f"{self._path}: cannot be written: {error.strerror}; make room") from None

    def discard(self) -> None:
        """Remove the file: nothing will be given any more."""
        os.close(self._file)
        with suppress(OSError):
            os.unlink(self._path)


def read_last_voltages(path: str | os.PathLike[str], mark: int, axes: int) -> tuple[float, ...] | None:
    """Return the voltages (V) noted last for so many axes; None where no whole record bears the mark."""
    size = HEAD.size + VOLTAGE_BYTES * axes + CHECKSUM_BYTES
    try:
        with Path(path).open("rb") as file:
            data = file.read(2 * size)
    except (OSError, ValueError):
        return None
    found = []
    for record in (data[:size], data[size:]):
        body, checksum = record[:-CHECKSUM_BYTES], record[-CHECKSUM_BYTES:]
        if len(record) == size and zlib.crc32(body) == int.from_bytes(checksum, "little"):
            belongs_to, number = HEAD.unpack_from(body)
            if belongs_to == mark:
                found.append((number, struct.unpack_from(f"{axes}d", body, HEAD.size)))
    return max(found)[1] if found else None


SCHEMA = "slpi_ros/saved_memory/1"
# Characters; a memory of many axes has a few thousand.
LONGEST = 1_000_000
INTERRUPTED = "the reset was interrupted"
CRASHED = "restored from before a crash: the last voltage is right, turns just before may be missing; reset it"


@dataclass(frozen=True)
class SavedAxis:
    """Where one axis was.

    Parameters
    ----------
    reversal_voltages : tuple of float, volts
        Where the drive turned, oldest first, and last its voltage.
    certain : bool
        Whether the memory was known.
    doubt : str
        Why that may no longer be so; not saved.
    """

    reversal_voltages: tuple[float, ...]
    certain: bool
    doubt: str = ""

    def confidence(self, identified: tuple[float, float]) -> MemoryConfidence:
        """Return how far it is to be trusted with its model, identified on these voltages (V)."""
        if self.certain and not self.doubt:
            return MemoryConfidence(RESTORED, spanned=identified)
        return MemoryConfidence(doubt=self.doubt)

    def after_crash(self, voltage: float) -> "SavedAxis":
        """Return what is known of the axis if it was given this voltage (V) last, after it was saved."""
        moved = () if voltage == self.reversal_voltages[-1] else (voltage,)
        return SavedAxis((*self.reversal_voltages, *moved), self.certain, CRASHED)


@dataclass(frozen=True)
class SavedMemory:
    """Where a stage was.

    Parameters
    ----------
    model : str
        `model_id` of the model it belongs to.
    complete : bool
        Whether the node ended in order after it was saved; if not, the drive may have turned since.
    axes : mapping of axis name to SavedAxis
    """

    model: str
    complete: bool
    axes: Mapping[str, SavedAxis]

    def require_fit(self, model: StageModel, names: Sequence[str], limits: Sequence[Limits]) -> None:
        """Raise ModelError unless it belongs to this model and has a voltage within the limits for every axis."""
        if self.model != model_id(model):
            raise ModelError("the saved memory belongs to another model; it is left out")
        for name, allowed in zip(names, limits, strict=True):
            if name not in self.axes:
                raise ModelError(f"the saved memory has no axis '{name}'; it is left out")
            voltage = self.axes[name].reversal_voltages[-1]
            if not allowed.lower <= voltage <= allowed.upper:
                raise ModelError(
                    f"the saved memory has {voltage:g} V for axis '{name}', outside {allowed.lower:g}.."
                    f"{allowed.upper:g} V; it is left out"
                )


def model_id(model: StageModel) -> str:
    """Return a fingerprint of a model's document, 64 hexadecimal digits."""
    return hashlib.sha256(format_model(model).encode()).hexdigest()


def save_memory(memory: SavedMemory, path: str | os.PathLike[str]) -> int:
    """Write a saved memory, all of it or nothing; return the mark for the voltages to come.

    Raises
    ------
    ModelError
        If the file cannot be written.
    """
    document = {
        "schema": SCHEMA,
        "model": memory.model,
        "complete": memory.complete,
        "axes": {
            name: {"went_through_V": list(axis.reversal_voltages), "certain": axis.certain}
            for name, axis in memory.axes.items()
        },
    }
    text = json.dumps(document, allow_nan=False)
    with all_or_nothing(path, ModelError) as file:
        file.write(text)
    return _mark(text)


def last_voltages(path: str | os.PathLike[str], mark: int) -> LastVoltages:
    """Return what notes the voltages given after a memory was saved to `path`, in the order of its axes.

    Raises
    ------
    ModelError
        If the file beside it cannot be written.
    """
    return LastVoltages(_beside(path), mark)


def load_memory(path: str | os.PathLike[str]) -> SavedMemory | None:
    """Read a saved memory, moved on to the voltages given last; None where there is no such file yet.

    Raises
    ------
    ModelError
        If the file cannot be read or holds something else.
    """
    try:
        with Path(path).open(encoding="utf-8") as file:
            text = file.read(LONGEST + 1)
        document = json.loads(text, parse_constant=_refuse)
    except FileNotFoundError:
        return None
    except (OSError, ValueError, RecursionError) as error:
        reason = error.strerror if isinstance(error, OSError) else error
        raise ModelError(f"{path}: no saved memory: {reason}; it is left out") from None
    try:
        validate(document, "saved_memory", str(path))
    except RecursionError:
        raise ModelError(f"{path}: no saved memory: nested too deeply; it is left out") from None
    axes = {
        name: SavedAxis(tuple(map(float, axis["went_through_V"])), axis["certain"])
        for name, axis in document["axes"].items()
    }
    if not document["complete"]:
        saved = tuple(axis.reversal_voltages[-1] for axis in axes.values())
        last = read_last_voltages(_beside(path), _mark(text), len(axes)) or saved
        axes = {name: axis.after_crash(v) for (name, axis), v in zip(axes.items(), last, strict=True)}
    return SavedMemory(document["model"], document["complete"], axes)


class MemoryFile:
    """Keeps the memory of a stage in a file, and beside it the voltages given since.

    Parameters
    ----------
    path : str
        "": no file; all methods do nothing then.
    """

    def __init__(self, path: str) -> None:
        self._path = path
        self._saved: SavedMemory | None = None
        self._last: LastVoltages | None = None

    def find(self, model: StageModel, names: Sequence[str], limits: Sequence[Limits]) -> Mapping[str, SavedAxis] | None:
        """Return where the axes were when the node last ended; None where there is no file.

        Raises
        ------
        ModelError
            If the file cannot be read, or does not belong to this model, these axes and limits.
        """
        saved = load_memory(self._path) if self._path else None
        if saved is None:
            return None
        saved.require_fit(model, names, limits)
        return saved.axes

    def save(self, model: StageModel | None, axes: Mapping[str, SavedAxis], complete: bool) -> None:
        """Write the memory, if it has changed; `complete`: nothing will move until the node has ended.

        Raises
        ------
        ModelError
            If the file cannot be written.
        """
        if not self._path or model is None:
            return
        memory = SavedMemory(model_id(model), complete, axes)
        if memory == self._saved:
            return
        mark = save_memory(memory, self._path)
        self._saved = memory
        if self._last and complete:
            self._last.discard()
            self._last = None
        elif self._last:
            self._last.mark = mark
        elif not complete:
            self._last = last_voltages(self._path, mark)

    def note(self, voltages: bytes) -> None:
        """Note what has just been given, for a life after a crash; called for each command.

        Raises
        ------
        ModelError
            If the file cannot be written.
        """
        if self._last:
            self._last.note(voltages)


def _mark(text: str) -> int:
    """Return what tells which text of a memory noted voltages belong to."""
    return zlib.crc32(text.encode())


def _beside(path: str | os.PathLike[str]) -> str:
    return f"{os.fspath(path)}.last"


def _refuse(constant: str) -> float:
    raise ValueError(f"{constant} is no voltage")
