"""The closed loop of each axis from a model, and from a record of its frequency response where there is one."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import pi

import numpy as np

from slpi_ros.arrays import FloatArray
from slpi_ros.compensator.loop_design import MARGIN, Design, design
from slpi_ros.compensator.loop_margin import ComplexArray, Plant
from slpi_ros.errors import SlpiError, UsageError
from slpi_ros.identification.frequency_response import FrequencyResponse, frequency_response
from slpi_ros.io.record import Record, common_stage
from slpi_ros.model.axis_model import AxisModel
from slpi_ros.model.stage_model import StageModel
from slpi_ros.workflows.records import Source, mismatch_in_data

# Measured lines count for the design where their interval is within this share.
SURE = 0.2


@dataclass(frozen=True)
class TuneRequest:
    """Request of gains: `rate` (Hz) of the loop, modulus `margin`, `axes` (default: all), record of a response."""

    model: StageModel
    rate: float
    margin: float = MARGIN
    axes: Sequence[str] = ()
    source: Source | None = None


@dataclass(frozen=True)
class TuneOutcome:
    """Design of each axis, and its measured response where the record has one."""

    designs: Mapping[str, Design]
    responses: Mapping[str, FrequencyResponse]


def tune(request: TuneRequest) -> TuneOutcome:
    """Return the loop of each axis; SlpiError, which names the axis, where there is none."""
    model, names = request.model, request.axes or list(request.model.axes)
    for name in names:
        if name not in model.axes:
            raise UsageError(f"axis '{name}': the model has axes {', '.join(model.axes)}; name one of these")
    record = _record(request.source, model) if request.source else None
    designs, responses = {}, {}
    for name in names:
        axis = model.axes[name]
        try:
            measured = _measured(record, name)
            shape = beside_model(axis, measured) if measured else None
            designs[name] = design(axis, request.rate, request.margin, shape)
        except SlpiError as error:
            raise type(error)(f"axis '{name}': {error}") from None
        if measured:
            responses[name] = measured
    return TuneOutcome(designs, responses)


def _record(source: Source, model: StageModel) -> Record:
    """Return the record; ModelError if it is of another stage than the model."""
    record = source.read(stage=model.hardware_id)[0]
    with mismatch_in_data():
        common_stage([record], model.hardware_id)
    return record


def _measured(record: Record | None, name: str) -> FrequencyResponse | None:
    if record is None or name not in record.axes:
        return None
    return frequency_response(record.t, record.voltage[name], record.displacement[name])


def beside_model(axis: AxisModel, measured: FrequencyResponse) -> tuple[FloatArray, ComplexArray] | None:
    """Return frequencies (rad/s) and what was measured over what the model says where it is steepest, (M,) each."""
    sure = measured.relative <= SURE
    if np.count_nonzero(sure) < 3:
        return None
    omega = 2.0 * pi * measured.frequency[sure]
    return omega, measured.response[sure] / Plant.of(axis).response(omega)
