"""Read and write validated JSON model documents, on disk and for the topic ``stage_model``."""

import json
import os
import textwrap
from dataclasses import asdict
from math import isfinite
from typing import Any

from slpi_ros.effects import registry
from slpi_ros.errors import ModelError
from slpi_ros.hysteresis import kinds
from slpi_ros.io.atomic_file import all_or_nothing
from slpi_ros.io.input_limits import MODEL_BYTES, read_input
from slpi_ros.io.schemas import validate
from slpi_ros.model.axis_model import AxisModel, FitQuality, Start
from slpi_ros.model.sensor import Sensor
from slpi_ros.model.stage_model import StageModel

SCHEMA = "slpi_ros/model/1"


def load_model(path: str | os.PathLike[str]) -> StageModel:
    """Read a model document from a file.

    Parameters
    ----------
    path : path-like

    Returns
    -------
    StageModel

    Raises
    ------
    ModelError
        If there is no such file, or it is not a valid model document of this version.
    """
    try:
        text = read_input(path, MODEL_BYTES).decode()
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) else "it is not a text file"
        raise ModelError(f"{path}: cannot read a model: {reason}; give a file written by 'slpi identify'") from None
    return parse_model(text, str(path))


def save_model(model: StageModel, path: str | os.PathLike[str]) -> None:
    """Write a model document to a file atomically.

    Raises
    ------
    ModelError
        If the file cannot be written.
    """
    text = format_model(model)
    with all_or_nothing(path, ModelError) as file:
        file.write(text)


def parse_model(text: str, source: str) -> StageModel:
    """Build a model from the text of a document; `source` names it in messages.

    Raises
    ------
    ModelError
        If the text is not a valid model document of this version.
    """
    try:
        # Only finite numbers are valid: NaN, Infinity and 1e400 are refused at parsing.
        document = json.loads(text, parse_float=_finite, parse_int=_whole, parse_constant=_finite)
    except (ValueError, RecursionError) as error:
        raise ModelError(f"{source}: not a model document: {error}; give a file written by 'slpi identify'") from None
    schema = document.get("schema") if isinstance(document, dict) else None
    if schema != SCHEMA:
        found = textwrap.shorten(repr(schema), 80)
        raise ModelError(f"{source}: schema is {found}, this version reads {SCHEMA!r}; identify the stage again")
    _refuse_retired(document, source)
    try:
        validate(document, "model", source)
    except RecursionError:
        raise ModelError(f"{source}: not a model document: nested too deeply; identify the stage again") from None
    return model_from(document, source)


def _refuse_retired(document: dict[str, Any], source: str) -> None:
    """Raise ModelError if an effect has a form that this version no longer has."""
    axes = document.get("axes")
    for name, axis in axes.items() if isinstance(axes, dict) else ():
        effects = axis.get("effects", []) if isinstance(axis, dict) else []
        for effect in effects if isinstance(effects, list) else ():
            given = effect.get("parameters") if isinstance(effect, dict) else None
            if isinstance(given, dict) and effect.get("name") == "rate_dependence" and "exponent" in given:
                raise ModelError(
                    f"{source}: axis {name[:40]!r}: rate_dependence has a retired form (a power of the rate); diagnose "
                    "again from its bags with slpi diagnose"
                )


def model_from(document: dict[str, Any], source: str) -> StageModel:
    """Build a model from a document that follows the schema; `source` names it in messages.

    Raises
    ------
    ModelError
        If the numbers are inconsistent.
    """
    try:
        axes = {name: _axis_from(axis) for name, axis in document["axes"].items()}
    except (ModelError, OverflowError) as error:
        raise ModelError(f"{source}: {error}") from None
    return StageModel(axes, document["hardware_id"], document["created"])


def format_model(model: StageModel) -> str:
    """Return the JSON text of a model document."""
    document = {
        "schema": SCHEMA,
        "hardware_id": model.hardware_id,
        "created": model.created,
        "axes": {name: _axis_document(axis) for name, axis in model.axes.items()},
    }
    validate(document, "model", "the new model")
    return json.dumps(document, allow_nan=False)


def _finite(text: str) -> float:
    number = float(text)
    if not isfinite(number):
        raise ValueError(f"{text[:20]} is not a finite number")
    return number


def _whole(text: str) -> int:
    _finite(text)
    return int(text)


def _axis_from(axis: dict[str, Any]) -> AxisModel:
    quality = axis["quality"]
    ranges = {key: (float(axis[key][0]), float(axis[key][1])) for key in ("voltage_range_V", "displacement_range_m")}
    for key, (low, high) in ranges.items():
        if not low < high:
            raise ModelError(f"{key} {low:g}..{high:g} is empty")
    return AxisModel(
        kind=axis["kind"],
        hysteresis=kinds.from_document(axis["kind"], axis["hysteresis"]),
        start=_start_from(axis["start"]),
        end=_start_from(axis["end"]) if "end" in axis else None,
        voltage_range=ranges["voltage_range_V"],
        displacement_range=ranges["displacement_range_m"],
        quality=FitQuality(
            quality["rms_m"], quality["maximum_m"], quality["held_out_rms_m"], quality["floor_rms_m"],
            quality["samples"], quality["covered"], quality["source"],
        ),
        effects=tuple(map(registry.from_document, axis.get("effects", []))),
        sensor=Sensor(**axis.get("sensor", {})),
    )  # fmt: skip


def _start_from(start: dict[str, Any]) -> Start:
    history = tuple(map(float, start["history_V"]))
    return Start(float(start["voltage_V"]), float(start["displacement_m"]), history, start.get("from_rest", False))


def _start_document(start: Start) -> dict[str, Any]:
    document = {
        "voltage_V": start.voltage,
        "displacement_m": start.displacement,
        "history_V": list(start.history),
    }
    return document | ({"from_rest": True} if start.from_rest else {})


def _axis_document(axis: AxisModel) -> dict[str, Any]:
    quality = axis.quality
    return {
        "kind": axis.kind,
        "voltage_range_V": list(axis.voltage_range),
        "displacement_range_m": list(axis.displacement_range),
        "start": _start_document(axis.start),
        **({"end": _start_document(axis.end)} if axis.end else {}),
        "hysteresis": kinds.to_document(axis.hysteresis),
        "effects": [registry.to_document(effect) for effect in axis.effects],
        **({"sensor": asdict(axis.sensor)} if axis.sensor else {}),
        "quality": {
            "rms_m": quality.rms,
            "maximum_m": quality.maximum,
            "held_out_rms_m": quality.held_out_rms,
            "floor_rms_m": quality.floor_rms,
            "samples": quality.samples,
            "covered": quality.covered,
            "source": quality.source,
        },
    }
