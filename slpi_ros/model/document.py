"""Read and write validated JSON model documents, on disk and for the topic ``stage_model``."""

import json
import os
import textwrap
from dataclasses import asdict, replace
from math import isfinite
from typing import Any

from slpi_ros.effects import registry
from slpi_ros.errors import ModelError
from slpi_ros.hysteresis import kinds
from slpi_ros.io.atomic_file import all_or_nothing
from slpi_ros.io.input_limits import MODEL_BYTES, read_input
from slpi_ros.io.schemas import validate
from slpi_ros.model.axis_model import AxisModel, FitQuality, FittedRecord, Start
from slpi_ros.model.sensor import Sensor
from slpi_ros.model.stage_model import StageModel

# Version 1 was never released.
SCHEMA, EARLIER, RETIRED = "slpi_ros/model/3", "slpi_ros/model/2", "slpi_ros/model/1"
# Names of the fields of `FitQuality`, in order; those from the fastest rate on are optional.
QUALITY = (
    "rms_m", "maximum_m", "held_out_rms_m", "floor_rms_m", "samples", "covered", "source", "fastest_V_per_s",
    "regions_m", "drift_m_per_root_s", "duration_s", "left_out_rms_m", "verdict", "records",
)  # fmt: skip


def load_model(path: str | os.PathLike[str]) -> StageModel:
    """Read a model document, of this version or an earlier one, from a file; ModelError if it is none."""
    try:
        text = read_input(path, MODEL_BYTES).decode()
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) else "it is not a text file"
        raise ModelError(f"{path}: cannot read a model: {reason}; give a file written by 'slpi identify'") from None
    return parse_model(text, str(path))


def save_model(model: StageModel, path: str | os.PathLike[str]) -> None:
    """Write a model document to a file atomically; ModelError if the file cannot be written."""
    text = format_model(model)
    with all_or_nothing(path, ModelError) as file:
        file.write(text)


def parse_model(text: str, source: str) -> StageModel:
    """Build a model from the text of a document; ModelError, which begins with `source`, if it is not valid."""
    try:
        # Only finite numbers are valid: NaN, Infinity and 1e400 are refused at parsing.
        document = json.loads(text, parse_float=_finite, parse_int=_whole, parse_constant=_finite)
    except (ValueError, RecursionError) as error:
        raise ModelError(f"{source}: not a model document: {error}; give a file written by 'slpi identify'") from None
    schema = document.get("schema") if isinstance(document, dict) else None
    if schema == RETIRED:
        raise ModelError(
            f"{source}: schema is {schema!r}, which no release has had; identify the stage again from its bags"
        )
    if schema not in (SCHEMA, EARLIER):
        found = textwrap.shorten(repr(schema), 80)
        raise ModelError(
            f"{source}: schema is {found}, this version reads {SCHEMA!r} and {EARLIER!r}; use the "
            "version of slpi_ros that wrote it, or identify the stage again"
        )
    # All that an earlier document may hold means the same.
    document["schema"] = SCHEMA
    try:
        validate(document, "model", source)
    except RecursionError:
        raise ModelError(f"{source}: not a model document: nested too deeply; identify the stage again") from None
    return model_from(document, source)


def model_from(document: dict[str, Any], source: str) -> StageModel:
    """Build a model from a valid document of any version; ModelError, which begins with `source`."""
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
        quality=_quality_from(axis["quality"]),
        effects=tuple(map(registry.from_document, axis.get("effects", []))),
        sensor=Sensor(**axis.get("sensor", {})),
    )


def _quality_from(quality: dict[str, Any]) -> FitQuality:
    given: list[Any] = [quality.get(key) for key in QUALITY]
    found = FitQuality(*given)
    if "regions_m" in quality:
        found = replace(found, regions=tuple(quality["regions_m"]))
    if "records" in quality:
        found = replace(found, records=tuple(FittedRecord(**record) for record in quality["records"]))
    return found


def _start_from(start: dict[str, Any]) -> Start:
    history = tuple(map(float, start["history_V"]))
    return Start(float(start["voltage_V"]), float(start["displacement_m"]), history, start.get("from_rest", False))


def _start_document(start: Start) -> dict[str, Any]:
    document = {"voltage_V": start.voltage, "displacement_m": start.displacement, "history_V": list(start.history)}
    return document | ({"from_rest": True} if start.from_rest else {})


def _axis_document(axis: AxisModel) -> dict[str, Any]:
    quality = dict(zip(QUALITY, asdict(axis.quality).values(), strict=True))
    if axis.quality.regions is not None:
        quality["regions_m"] = list(axis.quality.regions)
    if axis.quality.records is not None:
        given = [(record.source, record.sha256) for record in axis.quality.records]
        quality["records"] = [{"source": source} | ({"sha256": sha256} if sha256 else {}) for source, sha256 in given]
    return {
        "kind": axis.kind,
        "voltage_range_V": list(axis.voltage_range),
        "displacement_range_m": list(axis.displacement_range),
        "start": _start_document(axis.start),
        **({"end": _start_document(axis.end)} if axis.end else {}),
        "hysteresis": kinds.to_document(axis.hysteresis),
        "effects": [registry.to_document(effect) for effect in axis.effects],
        **({"sensor": asdict(axis.sensor)} if axis.sensor else {}),
        "quality": {key: value for key, value in quality.items() if value is not None},
    }
