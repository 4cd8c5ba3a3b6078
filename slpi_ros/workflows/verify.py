"""Verification of a model on records that it has not seen: read, check, judge."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

from slpi_ros.io.desired import desired_of
from slpi_ros.io.record import Record
from slpi_ros.model.axis_model import StartMemory
from slpi_ros.model.stage_model import StageModel
from slpi_ros.verification import verify as verification
from slpi_ros.verification.verify import Verification
from slpi_ros.workflows.records import (
    Findings,
    Source,
    mismatch_in_data,
    require_followed,
    require_for_model,
    shared_axes,
    with_given_names,
)


@dataclass(frozen=True)
class VerifyRequest:
    """Request of a verification."""

    source: Source
    model: StageModel
    tolerance: float | None = None  # m, rms; default: as for `slpi_ros.verify`
    desired_topic: str | None = None  # default: ``desired_displacement``, where a bag has it
    without_offset: bool = False  # the tolerance holds for the error without its constant part
    start_memory: StartMemory | None = None  # initial state of the records, if known
    model_file: str | None = None  # the bags of the fit may be named by their place beside it


@dataclass(frozen=True)
class VerifyOutcome:
    """Verification, the records that it judges, and the findings on each of them."""

    verification: Verification
    records: Sequence[Record]
    findings: Sequence[Findings]

    @property
    def independent(self) -> list[bool]:
        """Whether the model was identified without each of the records."""
        return [one.independent for one in next(iter(self.verification.axes.values())).records]


def verify(request: VerifyRequest) -> VerifyOutcome:
    """Verify a model."""
    model = request.model
    source = request.source.for_model(model)
    records = source.read(coupled=True, stage=model.hardware_id)
    desired = None
    if not source.records:
        read = zip(source.bags, records, strict=True)
        desired = [desired_of(bag, record, request.desired_topic) for bag, record in read]
    named = with_given_names(model, records, source, request.model_file)
    own = [] if source.records else [name for axis in named.axes.values() for name in axis.quality.sources]
    with mismatch_in_data():
        source = replace(source, axes=shared_axes(records, model, source))
        found = require_for_model(records, model, source)
        require_followed(records, source, model)
        told = verification.verify(
            records, model, request.tolerance, axes=source.axes, desired=desired, without_offset=request.without_offset,
            start=source.start, stop=source.stop, start_memory=request.start_memory,
            own=own,
        )  # fmt: skip
    return VerifyOutcome(told, records, found)
