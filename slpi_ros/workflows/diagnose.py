"""Diagnosis of the errors of a model on records: read, check, find the causes."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

from slpi_ros.diagnosis import diagnose as diagnosis
from slpi_ros.diagnosis.result import Diagnosis
from slpi_ros.io.record import Record
from slpi_ros.model.axis_model import FittedRecord
from slpi_ros.model.stage_model import StageModel
from slpi_ros.workflows.records import (
    Findings,
    Source,
    fitted_record,
    in_session,
    mismatch_in_data,
    require_causes,
    require_for_model,
    shared_axes,
    with_given_names,
    with_records,
)


@dataclass(frozen=True)
class DiagnoseRequest:
    """Request of a diagnosis: records, which are diagnosed together, and the model of their stage."""

    source: Source
    model: StageModel
    model_file: str | None = None  # the bags of the fit may be named by their place beside it
    session: bool = False  # the records are of one session, see `in_session`


@dataclass(frozen=True)
class DiagnoseOutcome:
    """Diagnosis, the records that it judges, and the findings on each of them."""

    diagnosis: Diagnosis
    records: Sequence[Record]
    findings: Sequence[Findings]


def diagnose(request: DiagnoseRequest) -> DiagnoseOutcome:
    """Find the causes of the errors of a model."""
    source = request.source
    records = source.read(coupled=True, stage=request.model.hardware_id)
    model = with_given_names(request.model, records, source, request.model_file)
    if request.session:
        records = in_session(records)
    with mismatch_in_data():
        source = replace(source, axes=shared_axes(records, model, source))
        found = require_for_model(records, model, source)
        require_causes(records, source)
        told = diagnosis.diagnose(records, model, axes=source.axes, start=source.start, stop=source.stop)
    extended = with_records(told.extended, _fitted(told.extended, model, records))
    return DiagnoseOutcome(replace(told, extended=extended), records, found)


def _fitted(extended: StageModel, model: StageModel, records: Sequence[Record]) -> dict[str, list[FittedRecord]]:
    """Return the records of each axis that was extended."""
    names = {record.source for record in records}
    fitted = {}
    for axis, one in extended.axes.items():
        if one.quality is not model.axes[axis].quality:
            # The calibrator diagnoses parts of its bags, by the names of the whole ones.
            before = [each for each in model.axes[axis].quality.records or () if each.source in names]
            fitted[axis] = [*before, *(fitted_record(record, axis) for record in records)]
    return fitted
