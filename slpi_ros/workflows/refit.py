"""Correction of a model with new records: read, check, refit, the oldest record first."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from slpi_ros.identification import refit as correction
from slpi_ros.identification.progress import report_progress
from slpi_ros.identification.refit import AxisChange
from slpi_ros.io.record import Record
from slpi_ros.model.stage_model import StageModel
from slpi_ros.workflows.records import (
    Source,
    fitted_record,
    require_followed,
    require_for_model,
    shared_axes,
    with_records,
)


@dataclass(frozen=True)
class RefitRequest:
    """Request of a refit: records, and the model that they correct."""

    source: Source
    model: StageModel


@dataclass(frozen=True)
class RefitStep:
    """A record, and the changes of each axis that it led to."""

    record: Record
    changes: Mapping[str, AxisChange]


@dataclass(frozen=True)
class RefitOutcome:
    """Corrected model, and the steps to it in order of time."""

    model: StageModel
    steps: Sequence[RefitStep]


def refit(request: RefitRequest) -> RefitOutcome:
    """Correct a model; each record corrects the model that the earlier ones have given."""
    model = request.model
    steps: list[RefitStep] = []
    source = request.source.for_model(model)
    records = sorted(source.read(coupled=True, stage=model.hardware_id), key=lambda record: int(record.time_ns[0]))
    for record in records:
        require_for_model([record], model, replace(source, axes=shared_axes([record], model, source)))
    require_followed(records, source, model)
    for record in records:
        report_progress(f"refit to {record.source}")
        corrected, changes = correction.refit(model, record, axes=source.axes, **source.span)
        fitted = {axis: [*model.axes[axis].quality.fitted, fitted_record(record, axis)] for axis in changes}
        model = with_records(corrected, fitted)
        steps.append(RefitStep(record, changes))
    return RefitOutcome(model, steps)
