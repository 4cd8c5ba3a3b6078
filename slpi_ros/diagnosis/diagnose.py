"""Diagnosis of a model on records: its errors, their causes, and the model extended by them."""

from collections.abc import Sequence
from dataclasses import replace
from datetime import UTC, datetime
from typing import Any, NamedTuple

import numpy as np
from threadpoolctl import threadpool_limits

from slpi_ros.arrays import FloatArray, Mask
from slpi_ros.arrays.rates import fastest
from slpi_ros.diagnosis.answer import Answer, answer_of
from slpi_ros.diagnosis.effect_parameters import EachRecord
from slpi_ros.diagnosis.joint_fit import JointFit
from slpi_ros.diagnosis.prepare import Evidence, Part, driven_alike, evidence_of
from slpi_ros.diagnosis.result import CHANGED, AxisDiagnosis, Diagnosis, Given, RecordOutcome
from slpi_ros.diagnosis.ruler import NO_WORSE, beats
from slpi_ros.diagnosis.search import STEPS, is_own, seen
from slpi_ros.diagnosis.structures import BIAS
from slpi_ros.diagnosis.verdict import judged, signals_of
from slpi_ros.effects.base import EffectContext
from slpi_ros.effects.chain import Chain
from slpi_ros.effects.registry import EFFECTS, in_order
from slpi_ros.errors import SlpiError, UsageError
from slpi_ros.identification.bases import PlayBasis
from slpi_ros.identification.error_statistics import with_statistics
from slpi_ros.identification.free_run import FreeRun, free_run, likely_starts, rms_of
from slpi_ros.identification.held_readings import corrected_fresh
from slpi_ros.identification.progress import report_progress
from slpi_ros.identification.refit import require_own
from slpi_ros.identification.repeatability import Repeatability, repeatability_of
from slpi_ros.io.record import Record, common_stage
from slpi_ros.model.axis_model import AxisModel, Start
from slpi_ros.model.sensor import IDEAL
from slpi_ros.model.stage_model import StageModel

# Kinds that are refitted together with the effects. Any other kind is reported as unsuitable if its error exceeds that
# of the loop family by this factor.
REFITTED, WRONG_KIND = ("slpi", "pi"), 1.5
# A stage has changed if a new fit leaves at most this multiple of what the model left of its own records, or at most
# this share of what the model leaves: else something else than the hysteresis is the matter.
AS_ONCE, LITTLE = 1.5, 0.2
# A zero has moved if its shift exceeds this multiple of the error; number of parts for the uncertainty of a gain;
# fewest samples of a comparison.
ZERO, STRETCHES, FEWEST = 4.0, 8, 50


def diagnose(
    record: Record | Sequence[Record],
    model: StageModel,
    *,
    axes: Sequence[str] | None = None,
    start: float | None = None,
    stop: float | None = None,
) -> Diagnosis:
    """Find the causes of the errors of a model on records, and extend the model by them.

    Parameters
    ----------
    record : Record or sequence of Record
        Records of one stage. Hysteresis and effects are common to all records; initial state, offset, drift and lines
        are fitted to each record. Each of several records is held out once.
    model : StageModel
        Model of the same stage. The known delay and lag of its sensor are taken out of the readings first.
    axes : sequence of str, optional
        Axes to be diagnosed; by default all that the model and every record contain.
    start, stop : float, seconds, optional
        Fit only samples with ``start <= t < stop``; t is counted from the first stamp of each record.

    Returns
    -------
    Diagnosis
        Diagnosis of each axis, with free-run errors, and the extended model.

    Raises
    ------
    UsageError
        If records and model belong to different stages or share no axis, or a record is given twice.
    RecordError, IdentificationError
        If the records contain too little data.
    """
    records = [record] if isinstance(record, Record) else list(record)
    common_stage(records, model.hardware_id)
    _require_different(records)
    undone = {name: axis.sensor.undo for name, axis in model.axes.items() if axis.sensor}
    records = [corrected_fresh(each, undone) for each in records]
    source = ", ".join(each.source for each in records)
    common = [axis for axis in records[0].axes if all(axis in each.axes for each in records)]
    chosen = list(axes) if axes else [axis for axis in model.axes if axis in common]
    if not chosen:
        held = "; ".join(f"{each.source} holds axes {', '.join(each.axes)}" for each in records)
        raise UsageError(f"{held}; the model {', '.join(model.axes)}: none in common; give bags of the same axes")
    found: dict[str, AxisDiagnosis] = {}
    extended = dict(model.axes)
    for axis in chosen:
        try:
            with threadpool_limits(1):
                known = model.axis(axis)
                found[axis], new = _diagnose_axis(records, axis, replace(known, sensor=IDEAL), start, stop)
                extended[axis] = replace(new, sensor=known.sensor)
        except SlpiError as error:
            where = f"{source}: axis '{axis}': "
            raise type(error)(where + str(error).removeprefix(where)) from None
    created = datetime.now(UTC).isoformat(timespec="seconds")
    return Diagnosis(found, replace(model, axes=extended, created=created), source)


def following(
    records: Sequence[Record], model: StageModel, *, start: float | None = None, stop: float | None = None
) -> tuple[StageModel, tuple[str, ...]]:
    """Return a model that follows the quantities of its records, and sentences on those that its axes do not follow.

    Hysteresis and effect are fitted jointly; a quantity counts as in a diagnosis, but no other cause is looked for.
    UsageError if the kind of the model is not fitted together with effects.
    """
    axes, told = dict(model.axes), []
    source = ", ".join(each.source for each in records)
    for axis, known in model.axes.items():
        if known.kind not in REFITTED:
            raise UsageError(
                f"kind '{known.kind}' is not fitted with recorded quantities; choose one of {', '.join(REFITTED)}"
            )
        undone = [corrected_fresh(each, {axis: known.sensor.undo}) if known.sensor else each for each in records]
        with threadpool_limits(1):
            evidence = evidence_of(undone, axis, replace(known, sensor=IDEAL), start, stop)
            names = [name for name, effect in EFFECTS.items() if effect.follows_quantities]
            now = answer_of(JointFit(evidence, ()), names).now
            follows = [key for effect in now.effects for key in effect.keys]
            if follows:
                axes[axis] = replace(_extended(known, now, source), sensor=known.sensor)
        left = [
            key for key in dict.fromkeys(key for each in records for key in each.surroundings) if key not in follows
        ]
        told += [f"axis '{axis}' does not follow {key}, as far as the records tell" for key in left]
    return replace(model, axes=axes), tuple(told)


def _require_different(records: Sequence[Record]) -> None:
    """Raise UsageError if a record is given twice: held out, it would be predicted from its copy."""
    for number, record in enumerate(records):
        for earlier in records[:number]:
            if np.array_equal(record.time_ns, earlier.time_ns) and all(
                axis in earlier.axes and np.array_equal(y, earlier.displacement[axis], equal_nan=True)
                for axis, y in record.displacement.items()
            ):
                raise UsageError(f"{record.source} and {earlier.source} are the same record; give each once")


def _diagnose_axis(
    records: Sequence[Record], axis: str, model: AxisModel, start: float | None, stop: float | None
) -> tuple[AxisDiagnosis, AxisModel]:
    report_progress(f"axis {axis}: fitting the hysteresis")
    evidence = evidence_of(records, axis, model, start, stop)
    same = len(records) == 1 and model.quality.source == records[0].source
    # Effects that belong to one record (drift, lines, the knots of a gain drift) do not apply to another.
    shared = [effect.without_records for effect in model.effects if same or not is_own(effect)]
    base = JointFit(evidence, shared)
    known = [effect for effect in shared if effect.in_phase(seen(base))]
    if len(known) < len(shared):
        base = JointFit(evidence, known)
    # Other kinds are not refitted; a comparison with the loop family shows whether they are suitable.
    fitted = model.kind in REFITTED
    family = evidence_of(records, axis, None, start, stop) if model.kind == "pi" else None
    runs = [_run(model, part, of_record=same) for part in evidence.parts]
    before = base.held_out.rms if fitted else rms_of(runs)
    other_kind = not fitted and before > WRONG_KIND * base.held_out.rms

    found = _answer(base, family if fitted else None)
    if other_kind:
        found = replace(found, structures=(BIAS, *found.structures))
    source = ", ".join(part.source for part in evidence.parts)
    given = _given(model, runs, found)
    extension = _extension(model, found, given, source)
    opponents = _opponents(model, found.base, runs, source) if extension else []
    while extension and not _carries_over(extension.judged, runs, opponents):
        # What makes a record worse is neither named nor in the model.
        if not found.named:
            extension = None
            break
        found = min(
            (found.without(one.name) for one in found.named),
            key=lambda each: rms_of(_runs(_extended(model, each.now, source), each.now, own=True)),
        )
        given = _given(model, runs, found)
        extension = _extension(model, found, given, source)
    # A hysteresis as smooth as beside the effects that were tried takes up less of what is left.
    signals = signals_of(found.now)
    if not (extension or found.named):
        # Nothing is explained, so that nothing is fitted beside the hysteresis of the given kind.
        found = replace(found, now=found.base)
    extension = extension or _Extension(model, runs, runs)
    outcomes = _outcomes(runs, extension.runs, found.now)
    noise, repeats, alike = found.now.noise, _repeatability(found.now), driven_alike(records, axis)
    told = judged(found, signals, noise, repeats, before, given, outcomes, alike)
    if extension.model is model:
        return told, model
    diagnosed = replace(extension.model.quality, verdict=told.verdict)
    return told, replace(extension.model, quality=diagnosed)


class _Extension(NamedTuple):
    """Refitted model, and its free run on each record.

    `judged` are its free runs with the effects of each record, such as drift, by which the causes are judged.
    """

    model: AxisModel
    runs: Sequence[FreeRun]
    judged: Sequence[FreeRun]


def _extension(model: AxisModel, answer: Answer, given: Given, source: str) -> _Extension | None:
    """Return the extension of a model by the effects of an answer; None if nothing is to refit."""
    # An effect that the records do not distinguish from others is part of it: at their drive rates each of these
    # predicts the same, and what is left without any is larger than what they differ by at others.
    if not (given.changed or BIAS in answer.structures or answer.named):
        return None
    extended = _extended(model, answer.now, source)
    return _Extension(extended, _runs(extended, answer.now), _runs(extended, answer.now, own=True))


def _runs(model: AxisModel, now: JointFit, *, own: bool = False) -> list[FreeRun]:
    """Return the free run of an extended model on each of its records, with what goes on from before it.

    With `own` instead with the effects of each record, such as drift.
    """
    separate: list[Any] = [effect for effect in now.effects if isinstance(effect, EachRecord)]
    begun = [effect.started(np.zeros_like(now.began.get(effect.name, ())), 2) for effect in model.effects]
    model = replace(model, effects=tuple(begun))
    runs = []
    for k, (part, rows) in enumerate(zip(now.evidence.parts, now.evidence.slices, strict=True)):
        # What goes on from before a record is unknown where the model is used.
        part = part if own else replace(part, y=part.y - now.settling[rows])
        added = [each.parts[k] for each in separate if own]
        # An error of the sensor goes with its reading, whose zero is not that of the model.
        for effect in added:
            if effect.side == "sensor":
                part = replace(part, y=effect.invert(part.y, EffectContext(part.t)))
        inside = [effect for effect in added if effect.side != "sensor"]
        effects = [*(effect.of_record(k) for effect in model.effects), *inside]
        runs.append(_run(replace(model, effects=in_order(effects)), part, of_record=True))
    return runs


def _opponents(model: AxisModel, base: JointFit, runs: Sequence[FreeRun], source: str) -> list[float]:
    """Return the errors (m, rms) on each record that an extended model must not exceed: those of the given model.

    A model of some of the records has fitted what is peculiar to these; on them it counts as fitted to all records.
    """
    own = _own(model, base.evidence)
    if own.all() or not own.any():
        return [run.rms for run in runs]
    refitted = _runs(_extended(model, base, source), base, own=True)
    return [
        max(run.rms, other.rms) if of_model else run.rms
        for run, other, of_model in zip(runs, refitted, own.tolist(), strict=True)
    ]


def _own(model: AxisModel, evidence: Evidence) -> Mask:
    """Return which records the model was identified from, mask of shape (records,)."""
    return np.array([part.source in model.quality.sources for part in evidence.parts])


def _carries_over(after: Sequence[FreeRun], before: Sequence[FreeRun], opponents: Sequence[float]) -> bool:
    """Return whether an extended model is no worse than the given one on all records, and than an opponent on each.

    `after` and `before` are the free runs of both models, `opponents` the errors (m, rms) on each record.
    """
    on_each = all(one.rms <= NO_WORSE * opponent for one, opponent in zip(after, opponents, strict=True))
    return on_each and rms_of(after) <= rms_of(before)


def _answer(base: JointFit, of_family: Evidence | None) -> Answer:
    """Return the answer, found with a coarser hysteresis if that is as good, and the joint fit without effects."""
    evidence, coarse = base.evidence, base.evidence.coarse
    if coarse is evidence:
        return _of_kind(base, of_family)
    quick = JointFit(coarse, base.effects)
    answer = _of_kind(quick, of_family.coarse if of_family else None)
    finest = of_family if of_family and BIAS in answer.structures else evidence
    # A smoothness that suits few vertices may leave many without any hold.
    finer = replace(answer.now.evidence, basis=finest.basis, smoothness=evidence.smoothness)
    now = JointFit(finer, answer.now.effects).smoothed().refined(STEPS)
    as_good = now.held_out.rms <= NO_WORSE * answer.now.held_out.rms
    return replace(answer, base=base, now=now) if as_good else answer


def _of_kind(base: JointFit, of_family: Evidence | None) -> Answer:
    """Return the answer, with the loop family as hysteresis if that predicts better than the kind of `base`."""
    if of_family is None:
        return answer_of(base)
    family = JointFit(of_family, base.effects)
    found = None
    if not beats(family.held_out, base.held_out, base.noise):
        found = answer_of(base)
        with_effects = JointFit(of_family, found.now.effects).refined(2)
        if not beats(with_effects.held_out, found.now.held_out, found.now.noise):
            return found
    answer = answer_of(family)
    return replace(answer, base=base, structures=(BIAS, *answer.structures))


def _repeatability(now: JointFit) -> Repeatability:
    """Return the largest repeatability of the records, between the rounding error and the held-out error."""
    repeats = [repeatability_of(part.t, part.v, part.y, residual) for part, residual in now.residuals]
    worst = max(repeats, key=lambda one: one.rms)
    return replace(worst, rms=min(max(worst.rms, now.evidence.rounding), now.held_out.rms))


def _run(model: AxisModel, part: Part, *, of_record: bool) -> FreeRun:
    model = model.surrounded({key: (part.t, value) for key, value in part.surroundings.items()})
    known, starts = _known(part), likely_starts(model, float(part.v[0]), part.history)
    y, before = part.y, EffectContext(part.t, before=part.before).without(model.effects).before
    if before:
        y = y - sum(effect.remembered(before, part.t) for effect in model.effects)
    return free_run(model, part.t, part.v, y, part.used, known, starts, others=part.others, of_record=of_record)


def _known(part: Part) -> Mask:
    """Return the mask of used samples to which the initial state only adds a constant; all used ones if too few."""
    known = part.used & part.after_reset
    return known if np.count_nonzero(known) >= FEWEST else part.used


def _given(model: AxisModel, runs: Sequence[FreeRun], answer: Answer) -> Given:
    """Compare the given model with the records; raise IdentificationError if it belongs to another stage."""
    evidence = answer.now.evidence
    motion = float(np.ptp(evidence.y[evidence.used]))
    own = _own(model, evidence)
    rms = rms_of(runs)
    if own.any() and not own.all():
        # Some effects within each record would also explain a gain that has changed between records.
        now = answer.now
        steady = now.only([effect.name for effect in now.effects if not EFFECTS[effect.name].changes_gain])
        compared = [_since(own, one) for one in (answer.base, steady)]
    else:
        compared = [_compared(model.hysteresis_only, one) for one in (answer.base, answer.now)]
    # Records of the same name may be different ones; then the error differs from the stored one.
    own_rms = model.quality.rms if own.all() and len(model.quality.sources) == own.size else 0.0
    compared = [replace(one, rms=rms, motion=motion, own_rms=own_rms) for one in compared]
    # Effects alter the fitted hysteresis, so the stage has changed only if both comparisons, without effects and with
    # them, show it.
    best = min(compared, key=lambda one: (one.changed, one.hysteresis_rms))
    if model.kind in REFITTED and not own.any():
        span = max(motion, float(np.ptp(model.displacement_range)))
        require_own(best.hysteresis_rms, best.refitted_rms, span)
    if best.changed:
        best = replace(best, explained=_fits_anew(model, answer, own, best.hysteresis_rms))
    zero = max((run.moved for run in runs), key=abs)
    moved = abs(zero) > ZERO * max(rms, CHANGED * motion)
    return replace(best, zero_moved=zero if moved else None)


def _fits_anew(model: AxisModel, answer: Answer, own: Mask, given_rms: float) -> bool:
    """Return whether effects, or a hysteresis fitted to each new record alone, leave as little as the model once did.

    Or a small share of `given_rms` (m), the error of the given hysteresis. `own` are the records of the model, mask of
    shape (records,).
    """
    evidence = answer.now.evidence
    allowed = max(AS_ONCE * max(model.quality.held_out_rms, answer.now.noise), LITTLE * given_rms)
    if min(answer.base.held_out.rms, answer.now.held_out.rms) <= allowed:
        return True
    alone = [JointFit(evidence.of_record(k)) for k in np.flatnonzero(~own).tolist()] if own.size > 1 else []
    return bool(alone) and all(one.held_out.rms <= allowed for one in alone)


def _compared(bare: AxisModel, one: JointFit) -> Given:
    """Compare the given hysteresis with the measured displacement minus the effects of the joint fit `one`."""
    errors, refitted, gains = [], [], []
    # Like the given hysteresis, the refitted one has monotone branches.
    hysteresis, begins = one.hysteresis()
    for part, rows, begin in zip(one.evidence.parts, one.evidence.slices, begins, strict=True):
        chosen = _known(part)
        target = (one.target - one.settling)[rows][chosen]
        starts = likely_starts(bare, float(part.v[0]), part.history)
        tried = [replace(bare, start=start).simulate(part.t, one.u[rows])[chosen] for start in starts]
        h = min(tried, key=lambda h: float(np.std(target - h)))
        errors.append(np.var(target - h))
        own = replace(bare, hysteresis=hysteresis, start=Start(float(one.u[rows][0]), begin, part.history))
        refitted.append(np.var(target - own.simulate(part.t, one.u[rows])[chosen]))
        gains.append(_gain(h, target))
    gain, variance = _weighted(*map(np.array, zip(*gains, strict=True)))
    given_rms, refitted_rms, deviation = (float(np.sqrt(x)) for x in (np.mean(errors), np.mean(refitted), variance))
    return Given(given_rms, refitted_rms, gain, deviation)


def _since(own: Mask, one: JointFit) -> Given:
    """Compare new records with those from which the given model was identified, the mask `own`, shape (records,)."""
    # The given model has absorbed the effects in its own records, which act differently in others. Therefore the
    # residuals of one joint fit to all records show whether the stage has changed in between.
    found = []
    for part, rows in zip(one.evidence.parts, one.evidence.slices, strict=True):
        chosen = _known(part) & one.equations.predictable[rows]
        enough = np.count_nonzero(chosen) >= FEWEST
        found.append(_gain(one.h[rows][chosen], (one.target - one.settling)[rows][chosen]) if enough else (0.0, np.inf))
    gains, deviations = np.array(found).T
    before, variance = _weighted(gains[own], deviations[own])
    after, variance_after = _weighted(gains[~own], deviations[~own])
    left_out = one.held_out.records[own]
    refitted = one.held_out.rms
    given_rms = float(np.sqrt(np.nanmean(left_out))) if np.isfinite(left_out).any() else refitted
    return Given(given_rms, refitted, after - before, float(np.sqrt(variance + variance_after)))


def _weighted(values: FloatArray, deviations: FloatArray) -> tuple[float, float]:
    """Return the mean of values weighted by inverse variance, and its variance; (0, inf) if all deviations are inf."""
    weights = 1.0 / np.maximum(np.square(deviations), 1e-300)
    if not weights.sum():
        return 0.0, np.inf
    return float(weights @ values / weights.sum()), float(1.0 / weights.sum())


def _gain(h: FloatArray, target: FloatArray) -> tuple[float, float]:
    """Return the gain of `target` relative to `h` (m) minus 1, and its standard deviation from `STRETCHES` parts."""
    moved, missed = h - h.mean(), target - h
    whole = float(moved @ missed / max(float(moved @ moved), 1e-300))
    left = missed - missed.mean() - whole * moved
    parts = [
        float(a @ b) for a, b in zip(np.array_split(moved, STRETCHES), np.array_split(left, STRETCHES), strict=True)
    ]
    return whole, float(np.sqrt(np.sum(np.square(parts))) / max(float(moved @ moved), 1e-300))


def _outcomes(runs: Sequence[FreeRun], runs_after: Sequence[FreeRun], now: JointFit) -> tuple[RecordOutcome, ...]:
    """Return the errors of each record in the free runs of the given and of the extended model."""
    several = len(now.evidence.parts) > 1
    errors = np.sqrt(now.held_out.records).tolist()
    left_out = [error if several and np.isfinite(error) else None for error in errors]
    return tuple(
        RecordOutcome(part.source, before.offset, before.rms, after.rms, other)
        for part, before, after, other in zip(now.evidence.parts, runs, runs_after, left_out, strict=True)
    )


def _extended(model: AxisModel, now: JointFit, source: str) -> AxisModel:
    """Return the model with jointly fitted hysteresis and effects, in the initial state of the first record."""
    evidence, first = now.evidence, now.evidence.parts[0]
    hysteresis, starts = now.hysteresis()
    y, errors = evidence.y[evidence.used], now.residual[evidence.used]
    voltage = evidence.v[evidence.used]
    extended = replace(
        model,
        kind="pi" if isinstance(evidence.basis, PlayBasis) else "slpi",
        hysteresis=hysteresis,
        start=Start(float(np.clip(first.v[0], *Chain.of(now.effects).clipped)), starts[0], first.history),
        voltage_range=(float(voltage.min()), float(voltage.max())),
        displacement_range=(float(y.min()), float(y.max())),
        effects=tuple(
            effect.started(now.began[effect.name], len(evidence.parts)).with_filters(evidence.courses)
            for effect in now.with_uncertainty()
            if not isinstance(effect, EachRecord)
        ),
        quality=replace(
            model.quality,
            rms=float(np.sqrt(np.mean(errors**2))),
            maximum=float(np.abs(errors).max()),
            held_out_rms=now.held_out.rms,
            floor_rms=now.noise,
            samples=y.size,
            source=source,
            fastest=max(fastest(part.t[part.used], part.v[part.used]) for part in evidence.parts),
            left_out_rms=now.held_out.rms if len(evidence.parts) > 1 else None,
        ),
    )
    quality = with_statistics(extended.quality, _errors(now), extended.displacement_range)
    extended = replace(extended, quality=quality, end=extended.at_rest(now.u, float(evidence.v[-1])))
    separate: list[Any] = [effect for effect in now.effects if isinstance(effect, EachRecord)]
    return _from_end(extended, sum(one.parts[0].from_end()[1] for one in separate))


def _from_end(model: AxisModel, by: float) -> AxisModel:
    """Return the model with the zero of the end of its first record: a drift of the record ends at zero.

    `by` (m) is where drifts that are not in the model were at that end.
    """
    counted = [effect.from_end() for effect in model.effects]
    moved = replace(model, effects=tuple(effect for effect, _ in counted)).shifted(by + sum(end for _, end in counted))
    return replace(moved, displacement_range=model.displacement_range)


def _errors(now: JointFit) -> list[tuple[FloatArray, ...]]:
    """Return times (s), displacements, residuals, and residuals with what belongs to each record (m), used samples."""
    drift = np.zeros_like(now.predicted)
    for effect in now.effects:
        if effect.side == "record":
            drift += now.predicted - now.prediction_without(effect.name)
    parts = []
    for part, rows in zip(now.evidence.parts, now.evidence.slices, strict=True):
        used, left = part.used, now.residual[rows]
        parts.append(tuple(x[used] for x in (part.t, part.y, left, left + drift[rows])))
    return parts
