"""Diagnosis of the errors of a model on records: read, check, find the causes."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

from slpi_ros.diagnosis import diagnose as diagnosis
from slpi_ros.diagnosis.result import Diagnosis
from slpi_ros.io.record import Record
from slpi_ros.model.stage_model import StageModel
from slpi_ros.workflows.records import (
    Findings,
    Source,
    mismatch_in_data,
    require_causes,
    require_for_model,
    shared_axes,
    with_given_names,
)


@dataclass(frozen=True)
class DiagnoseRequest:
    """Request of a diagnosis: records, which are diagnosed together, and the model of their stage."""

    source: Source
    model: StageModel
    model_file: str | None = None  # the bags of the fit may be named by their place beside it


@dataclass(frozen=True)
class DiagnoseOutcome:
    """Diagnosis, the records that it judges, and the findings on each of them."""

    diagnosis: Diagnosis
    records: Sequence[Record]
    findings: Sequence[Findings]


def diagnose(request: DiagnoseRequest) -> DiagnoseOutcome:
    """Find the causes of the errors of a model."""
    source = request.source
    model = with_given_names(request.model, source.bags, request.model_file)
    records = source.read(coupled=True, stage=model.hardware_id)
    with mismatch_in_data():
        source = replace(source, axes=shared_axes(records, model, source))
        found = require_for_model(records, model, source)
        require_causes(records, source)
        told = diagnosis.diagnose(records, model, axes=source.axes, start=source.start, stop=source.stop)
    return DiagnoseOutcome(told, records, found)
