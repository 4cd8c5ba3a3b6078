"""Identification of a model from records: read, check, fit."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

from slpi_ros.identification import fit
from slpi_ros.identification.cross_validation import CrossValidationReport, cross_validate
from slpi_ros.identification.held_readings import corrected_fresh
from slpi_ros.identification.uncertainty import CurveUncertainty, curve_uncertainty, require_known_uncertainty
from slpi_ros.io.record import Record
from slpi_ros.model.sensor import IDEAL, Sensor
from slpi_ros.model.stage_model import StageModel
from slpi_ros.workflows.records import (
    Findings,
    Source,
    fitted_record,
    require_causes,
    require_records,
    with_records,
)


@dataclass(frozen=True)
class IdentifyRequest:
    """Request of an identification: one model from all records."""

    source: Source
    kind: str = "slpi"
    loops_at_rest: bool = False  # ``slpi-published``: its operators start at rest
    sensor: Sensor = IDEAL

    def require_possible(self, *, uncertainty: bool = False) -> None:
        """Raise UsageError for a kind or an option that does not exist, before anything is read."""
        fit.fit_of(self.kind, loops_at_rest=self.loops_at_rest)
        if uncertainty:
            require_known_uncertainty(self.kind)


@dataclass(frozen=True)
class IdentifyOutcome:
    """Model, the records that it was identified from, as they were read, and the findings on each of them."""

    request: IdentifyRequest
    model: StageModel
    records: Sequence[Record]
    findings: Sequence[Findings]
    unmoved: Sequence[str] = ()  # named quantities that the stage does not follow, with the axis

    def held_out(self) -> dict[str, CrossValidationReport]:
        """Return the held-out errors of each axis, by cross-validation."""
        request, source = self.request, self.request.source
        return {
            axis: cross_validate(
                self._corrected(axis), axis, request.kind, loops_at_rest=request.loops_at_rest, **source.span
            )
            for axis in self.model.axes
        }

    def uncertainty(self) -> dict[str, CurveUncertainty]:
        """Return the uncertainty of the curves of each axis."""
        kind, source = self.request.kind, self.request.source
        return {axis: curve_uncertainty(self._corrected(axis), axis, kind, **source.span) for axis in self.model.axes}

    def _corrected(self, axis: str) -> list[Record]:
        sensor = self.request.sensor
        return [corrected_fresh(record, {axis: sensor.undo}) if sensor else record for record in self.records]


def identify(request: IdentifyRequest) -> IdentifyOutcome:
    """Identify a model."""
    request.require_possible()
    source, sensor = request.source, request.sensor
    records = replace(source, surroundings=source.surroundings or ()).read()
    found = require_records(records, source, {axis: sensor for record in records for axis in record.axes})
    model = fit.identify(
        records, request.kind, **source.span, axes=source.axes, loops_at_rest=request.loops_at_rest,
        sensor_delay=sensor.delay, sensor_lag=sensor.lag,
    )  # fmt: skip
    unmoved: Sequence[str] = ()
    if source.surroundings:
        # The diagnosis takes a fifth of a second to load.
        from slpi_ros.diagnosis.diagnose import following

        require_causes(records, source)
        model, unmoved = following(records, model, **source.span)
    fitted = {axis: [fitted_record(record, axis) for record in records] for axis in model.axes}
    return IdentifyOutcome(request, with_records(model, fitted), records, found, unmoved)
