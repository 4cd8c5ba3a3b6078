"""From a record and a model to what the model gets wrong, why, and the model that gets it right."""

from collections.abc import Sequence
from dataclasses import replace
from datetime import UTC, datetime

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from slpi_ros.diagnosis.evidence import Evidence
from slpi_ros.diagnosis.explanation import Explanation
from slpi_ros.diagnosis.gather import driven_alike, evidence_of
from slpi_ros.diagnosis.judge import Given, judged
from slpi_ros.diagnosis.selection import Selection, counts, select
from slpi_ros.diagnosis.structure import BIAS
from slpi_ros.diagnosis.verdict import AxisDiagnosis, Diagnosis
from slpi_ros.errors import SlpiError, UsageError
from slpi_ros.identification.bases import PlayBasis
from slpi_ros.identification.progress import report_progress
from slpi_ros.identification.refit import require_own
from slpi_ros.identification.signal_statistics import Floor, floor_of
from slpi_ros.io.record import Record
from slpi_ros.model.stage_model import AxisModel, StageModel, Start

FloatArray = NDArray[np.float64]

# Kinds that are fitted to the record together with effects. Of another kind is said that it is the wrong one where its
# error is so many times that of the loop family.
REFITTED, WRONG_KIND = ("slpi", "pi"), 1.5


def diagnose(
    record: Record,
    model: StageModel,
    *,
    axes: Sequence[str] | None = None,
    start: float | None = None,
    stop: float | None = None,
) -> Diagnosis:
    """Find what a model gets wrong on a record, name the causes, and extend the model by them.

    Parameters
    ----------
    record : Record
    model : StageModel
        Of the same stage.
    axes : sequence of str, optional
        All that record and model share by default.
    start, stop : float, seconds, optional
        Explain only samples with ``start <= t < stop``, t from the record's first stamp.

    Returns
    -------
    Diagnosis
        All errors in it are free-run and held out.

    Raises
    ------
    UsageError
        If record and model are not of one stage, or share no axis.
    RecordError, IdentificationError
        If the record says too little.
    """
    if model.hardware_id and record.hardware_id and model.hardware_id != record.hardware_id:
        raise UsageError(
            f"this model does not belong to this bag: it is of stage '{model.hardware_id}', {record.source} of "
            f"'{record.hardware_id}'"
        )
    chosen = list(axes) if axes else [axis for axis in model.axes if axis in record.axes]
    if not chosen:
        raise UsageError(
            f"{record.source} holds axes {', '.join(record.axes)}, the model {', '.join(model.axes)}: none in common"
        )
    found: dict[str, AxisDiagnosis] = {}
    extended = dict(model.axes)
    for axis in chosen:
        try:
            with threadpool_limits(1):
                found[axis], extended[axis] = _diagnose_axis(record, axis, model.axis(axis), start, stop)
        except SlpiError as error:
            where = f"{record.source}: axis '{axis}': "
            raise type(error)(where + str(error).removeprefix(where)) from None
    created = datetime.now(UTC).isoformat(timespec="seconds")
    return Diagnosis(found, replace(model, axes=extended, created=created), record.source)


def _diagnose_axis(
    record: Record, axis: str, model: AxisModel, start: float | None, stop: float | None
) -> tuple[AxisDiagnosis, AxisModel]:
    report_progress(f"axis {axis}: fitting the hysteresis")
    evidence = evidence_of(record, axis, model, start, stop)
    base = Explanation(evidence, model.effects)
    given, gain = _error_of(model, evidence, evidence.v, evidence.y)
    if model.kind in REFITTED:
        selection = _selected(base, evidence_of(record, axis, None, start, stop) if model.kind == "pi" else None)
        own = _require_own(model, base, selection.now)
        before = base.held_out.rms
    else:
        # Such a kind is not fitted anew here: the loop family shows what it gets wrong.
        selection, before, own = select(base, None), given, given
        if given > WRONG_KIND * base.held_out.rms:
            selection = replace(selection, structures=(BIAS, *selection.structures))
    floor = _floor(selection.now)
    found = judged(selection, floor, before, Given(given, gain, own), driven_alike(record, axis))
    return found, _extended(model, selection.now, floor, record.source)


def _selected(base: Explanation, of_family: Evidence | None) -> Selection:
    """Return the outcome of the competition, beside the loop family where that does better than the kind of `base`."""
    if of_family is None:
        return select(base, None)
    family = Explanation(of_family, base.effects)
    if counts(base.held_out, family.held_out):
        return select(base, family)
    selection = select(base, None)
    with_effects = Explanation(of_family, selection.now.effects).refined(2)
    return select(base, family) if counts(selection.now.held_out, with_effects.held_out) else selection


def _floor(now: Explanation) -> Floor:
    evidence = now.evidence
    residual = np.where(evidence.used, now.residual, np.nan)
    floor = floor_of(evidence.t, evidence.v, evidence.y, residual)
    return replace(floor, rms=min(floor.rms, now.held_out.rms))


def _error_of(model: AxisModel, evidence: Evidence, u: FloatArray, y: FloatArray) -> tuple[float, float]:
    """Return the error (m) of the given model, driven by `u` (V), against `y` (m), but for the one at rest.

    Beside it stands by which share `y` moves more. It starts as it was identified or as the record seems to, whichever
    suits it better.
    """
    starts = [model.start]
    if model.causal:
        starts += [Start(float(u[0]), 0.0, history) for history in {evidence.history, model.start.history}]
    return min(_error_from(start, model, evidence, u, y) for start in starts)


def _error_from(
    start: Start, model: AxisModel, evidence: Evidence, u: FloatArray, y: FloatArray
) -> tuple[float, float]:
    simulated = replace(model, start=start).simulate(evidence.t, u)[evidence.used]
    errors, moved = simulated - y[evidence.used], simulated - simulated.mean()
    gain = float(moved @ -errors / max(float(moved @ moved), 1e-300))
    return float(np.sqrt(np.mean((errors - np.median(errors)) ** 2))), gain


def _require_own(model: AxisModel, base: Explanation, now: Explanation) -> float:
    """Refuse a model that has nothing to do with the record, whatever effects there are; return its error (m)."""
    span = max(float(np.ptp(now.evidence.y[now.evidence.used])), float(np.ptp(model.displacement_range)))
    bare = replace(model, effects=())
    error = min(_error_of(bare, one.evidence, one.u, one.target)[0] for one in (base, now))
    require_own(error, base.held_out.rms, span)
    return error


def _extended(model: AxisModel, now: Explanation, floor: Floor, source: str) -> AxisModel:
    """Return the model with the effects found, its hysteresis fitted together with them."""
    evidence = now.evidence
    hysteresis, at_start = now.hysteresis()
    y, errors = evidence.y[evidence.used], now.residual[evidence.used]
    voltage = evidence.v[evidence.used]
    extended = replace(
        model,
        kind="pi" if isinstance(evidence.basis, PlayBasis) else "slpi",
        hysteresis=hysteresis,
        start=Start(float(evidence.v[0]), at_start, evidence.history),
        voltage_range=(float(voltage.min()), float(voltage.max())),
        displacement_range=(float(y.min()), float(y.max())),
        effects=tuple(now.with_uncertainty()),
        quality=replace(
            model.quality,
            rms=float(np.sqrt(np.mean(errors**2))),
            maximum=float(np.abs(errors).max()),
            held_out_rms=now.held_out.rms,
            floor_rms=floor.rms,
            samples=y.size,
            source=source,
        ),
    )
    return replace(extended, end=extended.after(now.u))
