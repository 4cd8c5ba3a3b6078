"""The memory of a stage, kept over a restart of the node: JSON, validated."""

import hashlib
import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from slpi_ros.errors import ModelError
from slpi_ros.files import all_or_nothing
from slpi_ros.model import StageModel
from slpi_ros.model_file import format_model
from slpi_ros.schemas import validate
from slpi_ros.stream import Limits

SCHEMA = "slpi_ros/saved_memory/1"
# Characters; a memory of many axes has a few thousand.
LONGEST = 1_000_000


@dataclass(frozen=True)
class SavedAxis:
    """Where one axis was.

    Parameters
    ----------
    went_through : tuple of float, volts
        Where the drive turned, oldest first, and last its voltage.
    certain : bool
        Whether the memory was known, and nothing has moved since it was saved.
    """

    went_through: tuple[float, ...]
    certain: bool


@dataclass(frozen=True)
class SavedMemory:
    """Where a stage was.

    Parameters
    ----------
    model : str
        `model_id` of the model it belongs to.
    complete : bool
        Whether the node ended in order after it was saved; if not, it may have moved on.
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
            voltage = self.axes[name].went_through[-1]
            if not allowed.lower <= voltage <= allowed.upper:
                raise ModelError(
                    f"the saved memory has {voltage:g} V for axis '{name}', outside {allowed.lower:g}.."
                    f"{allowed.upper:g} V; it is left out"
                )


def model_id(model: StageModel) -> str:
    """Return a fingerprint of a model's document, 64 hexadecimal digits."""
    return hashlib.sha256(format_model(model).encode()).hexdigest()


def save_memory(memory: SavedMemory, path: str | os.PathLike[str]) -> None:
    """Write a saved memory, all of it or nothing.

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
            name: {"went_through_V": list(axis.went_through), "certain": axis.certain}
            for name, axis in memory.axes.items()
        },
    }
    with all_or_nothing(path, ModelError) as file:
        json.dump(document, file, allow_nan=False)


def load_memory(path: str | os.PathLike[str]) -> SavedMemory | None:
    """Read a saved memory; None where there is no such file yet.

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
    return SavedMemory(document["model"], document["complete"], axes)


def _refuse(constant: str) -> float:
    raise ValueError(f"{constant} is no voltage")
