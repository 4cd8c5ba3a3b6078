"""From records and a model to what the model gets wrong, why, and the model that gets it right."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from slpi_ros.diagnosis.effect_parameters import EachRecord
from slpi_ros.diagnosis.joint_fit import Explanation
from slpi_ros.diagnosis.prepare import Evidence, Part, driven_alike, evidence_of, one_speed
from slpi_ros.diagnosis.result import CHANGED, AxisDiagnosis, Diagnosis, Given, RecordOutcome, judged
from slpi_ros.diagnosis.selection import BIAS, DYNAMIC, Selection, counts, in_phase, select
from slpi_ros.effects.base import Effect
from slpi_ros.effects.creep import Creep
from slpi_ros.effects.gain_drift import GainDrift
from slpi_ros.errors import SlpiError, UsageError
from slpi_ros.identification.bases import PlayBasis
from slpi_ros.identification.initial_history import histories
from slpi_ros.identification.progress import report_progress
from slpi_ros.identification.refit import require_own
from slpi_ros.identification.repeatability_floor import Floor, floor_of
from slpi_ros.identification.samples import Samples
from slpi_ros.io.record import Record, common_stage
from slpi_ros.model.axis_model import AxisModel, Start
from slpi_ros.model.stage_model import StageModel

FloatArray = NDArray[np.float64]

# Kinds that are fitted to the record together with effects. Of another kind is said that it is the wrong one where its
# error is so many times that of the loop family.
REFITTED, WRONG_KIND = ("slpi", "pi"), 1.5
# Effects that do the same wherever they are not told apart: one of them may stand for the other.
SAME_ELSEWHERE = ({"delay", "lag"},)
# What creeps on from before a record is the stage's where all records agree within this share.
BEGAN_ALIKE = 0.3
# Initial histories explain a record as well as the best one with so many times its error; a zero has moved when that is
# so many times the error. The gain is compared on so many stretches, of so many samples at least.
AS_WELL, ZERO, STRETCHES, FEWEST = 1.1, 4.0, 8, 50


def diagnose(
    record: Record | Sequence[Record],
    model: StageModel,
    *,
    axes: Sequence[str] | None = None,
    start: float | None = None,
    stop: float | None = None,
) -> Diagnosis:
    """Find what a model gets wrong on records, name the causes, and extend the model by them.

    Parameters
    ----------
    record : Record or sequence of Record
        Of the same stage. Several share hysteresis and effects; initial history, constant, drift and hum are each
        record's own, and each record is left out in turn.
    model : StageModel
        Of the same stage.
    axes : sequence of str, optional
        All that records and model share by default.
    start, stop : float, seconds, optional
        Explain only samples with ``start <= t < stop``, t from the record's first stamp.

    Returns
    -------
    Diagnosis
        All errors in it are free-run and held out.

    Raises
    ------
    UsageError
        If records and model are not of one stage, or share no axis.
    RecordError, IdentificationError
        If the records say too little.
    """
    records = [record] if isinstance(record, Record) else list(record)
    common_stage(records, model.hardware_id)
    _require_different(records)
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
                found[axis], extended[axis] = _diagnose_axis(records, axis, model.axis(axis), start, stop)
        except SlpiError as error:
            where = f"{source}: axis '{axis}': "
            raise type(error)(where + str(error).removeprefix(where)) from None
    created = datetime.now(UTC).isoformat(timespec="seconds")
    return Diagnosis(found, replace(model, axes=extended, created=created), source)


def _require_different(records: Sequence[Record]) -> None:
    """Raise UsageError if a record is there twice: it would confirm itself."""
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
    # What belongs to one record says nothing of another.
    shared = [effect for effect in model.effects if same or effect.removable != "record"]
    base = Explanation(evidence, shared)
    known = [effect for effect in shared if in_phase(effect, base)]
    if len(known) < len(shared):
        base = Explanation(evidence, known)
    if model.kind in REFITTED:
        selection = _selected(base, evidence_of(records, axis, None, start, stop) if model.kind == "pi" else None)
        before = base.held_out.rms_of_records
    else:
        # Such a kind is not fitted anew here: the loop family shows what it gets wrong.
        selection, before = select(base, None), _given_rms(model, evidence)
        if before > WRONG_KIND * base.held_out.rms:
            selection = replace(selection, structures=(BIAS, *selection.structures))
    given = _given(model, selection)
    floor = _floor(selection.now)
    left_out = _ambiguous(selection)
    # Beside what stays open, nothing that was fitted together with it can be trusted elsewhere.
    refitted = given.changed or BIAS in selection.structures or bool(selection.named and not left_out)
    final = selection.now.only([effect.name for effect in selection.now.effects if effect.name not in left_out])
    extended = _extended(model, final, floor, ", ".join(part.source for part in evidence.parts)) if refitted else model
    outcomes = _outcomes(model, selection.now, final if refitted else None)
    missing = left_out if refitted else [named.name for named in selection.named]
    found = judged(selection, floor, before, given, outcomes, missing, driven_alike(records, axis))
    return found, extended


def _ambiguous(selection: Selection) -> list[str]:
    """Return the effects that may be something else, which would do otherwise on other records.

    What every record confirms of the others is told to them by either name.
    """
    alone = one_speed(selection.now.evidence)
    return [
        named.name
        for named in selection.named
        if (alone and named.name in DYNAMIC)
        or (
            named.alternatives
            and not named.confirmed
            and not any({named.name, *named.alternatives} <= same for same in SAME_ELSEWHERE)
        )
    ]


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
    """Return the floor of the record that repeats itself worst; no less than what rounding adds."""
    floors = []
    for part, rows in zip(now.evidence.parts, now.evidence.slices, strict=True):
        residual = np.where(part.used, now.residual[rows], np.nan)
        floors.append(floor_of(part.t, part.v, part.y, residual))
    worst = max(floors, key=lambda floor: floor.rms)
    return replace(worst, rms=min(max(worst.rms, now.evidence.rounding), now.held_out.rms))


@dataclass(frozen=True)
class _FreeRun:
    """A model along a record, from the initial history that suits it best.

    Parameters
    ----------
    errors : ndarray, shape (N,), metres
        Measured - model.
    rms : float, metres
        Without their constant.
    offsets : (float, float), metres
        Least and largest constant by initial histories that explain the record as well.
    """

    errors: FloatArray
    rms: float
    offsets: tuple[float, float]

    @property
    def offset(self) -> float:
        """The constant nearest to none, metres."""
        return min(self.offsets, key=abs)

    @property
    def moved(self) -> float:
        """By how much (m) the zero has moved, whatever went before the record; 0 where that may be all of it."""
        return 0.0 if self.offsets[0] <= 0.0 <= self.offsets[1] else self.offset


def _free_run(model: AxisModel, part: Part) -> _FreeRun:
    """Let a model run along a record from every initial history that may have been."""
    errors = [part.y - replace(model, start=start).simulate(part.t, part.v) for start in _starts(model, part)]
    chosen = _known(part)
    rms = np.array([np.std(each[part.used]) for each in errors])
    as_well = [each for each in errors if np.std(each[chosen]) <= AS_WELL * min(np.std(one[chosen]) for one in errors)]
    offsets = [float(np.median(each[chosen])) for each in as_well]
    best = int(np.argmin(rms))
    return _FreeRun(errors[best], float(rms[best]), (min(offsets), max(offsets)))


def _known(part: Part) -> NDArray[np.bool_]:
    """Return which samples do not depend on the initial history, but for a constant; all used where these are few."""
    known = part.used & part.wiped
    return known if np.count_nonzero(known) >= FEWEST else part.used


def _starts(model: AxisModel, part: Part) -> list[Start]:
    """Return starts for several initial histories, each where the model says that it leads."""
    if not model.causal:
        return [model.start]
    v0, (low, high) = float(part.v[0]), model.voltage_range
    ends = np.array([min(low, v0), max(high, v0)])
    whole = Samples(np.append(v0, ends), np.zeros(3), np.ones(3, dtype=bool))
    # Whatever went before, a sweep over the whole range ends at one displacement.
    swept = model.memory("start").forward_array(ends)[-1]
    found = [model.start] if model.start.voltage == v0 else []
    for history in dict.fromkeys((part.history, model.start.history, *histories(whole))):
        way = replace(model, start=Start(v0, 0.0, history)).memory("start").forward_array(ends)[-1]
        found.append(Start(v0, float(swept - way), history))
    return found


def _given_rms(model: AxisModel, evidence: Evidence) -> float:
    """Return the error (m) of the given model, without the constant of each record."""
    return float(np.sqrt(np.mean([_free_run(model, part).rms ** 2 for part in evidence.parts])))


def _given(model: AxisModel, selection: Selection) -> Given:
    """Compare the given model with the records, and refuse one that has nothing to do with them."""
    evidence = selection.now.evidence
    motion = float(np.ptp(evidence.y[evidence.used]))
    sources = model.quality.source.split(", ")
    own = np.array([part.source in sources for part in evidence.parts])
    runs = [_free_run(model, part) for part in evidence.parts]
    rms = float(np.sqrt(np.mean([run.rms**2 for run in runs])))
    if own.any() and not own.all():
        # A gain that drifts within each record would explain one that has changed in between.
        steady = selection.now.without(GainDrift.name)
        compared = [_since(own, one) for one in (selection.base, steady)]
    else:
        compared = [_compared(replace(model, effects=()), one) for one in (selection.base, selection.now)]
    # Records of the same names may be others, whose error tells.
    own_rms = model.quality.rms if own.all() and len(sources) == own.size else 0.0
    compared = [replace(one, rms=rms, motion=motion, own_rms=own_rms) for one in compared]
    # Effects change what a fit to the records makes of the hysteresis: a stage that has changed shows it without them
    # and beside them.
    best = min(compared, key=lambda one: (one.changed, one.hysteresis_rms))
    if model.kind in REFITTED and not own.any():
        span = max(motion, float(np.ptp(model.displacement_range)))
        require_own(best.hysteresis_rms, best.refitted_rms, span)
    zero = max((run.moved for run in runs), key=abs)
    moved = abs(zero) > ZERO * max(rms, CHANGED * motion)
    return replace(best, zero_moved=zero if moved else None)


def _compared(bare: AxisModel, one: Explanation) -> Given:
    """Compare the hysteresis of the given model with what effects leave for one to explain."""
    errors, refitted, gains, deviations = [], [], [], []
    # Like the given one, the other hysteresis has branches that rise.
    hysteresis, begins = one.hysteresis()
    for part, rows, begin in zip(one.evidence.parts, one.evidence.slices, begins, strict=True):
        chosen = _known(part)
        target = (one.target - one.settling)[rows][chosen]
        starts = _starts(bare, part)
        tried = [replace(bare, start=start).simulate(part.t, one.u[rows])[chosen] for start in starts]
        h = min(tried, key=lambda h: float(np.std(target - h)))
        errors.append(np.var(target - h))
        own = replace(bare, hysteresis=hysteresis, start=Start(float(one.u[rows][0]), begin, part.history))
        refitted.append(np.var(target - own.simulate(part.t, one.u[rows])[chosen]))
        gain, deviation = _gain(h, target)
        gains.append(gain)
        deviations.append(deviation)
    gain, variance = _weighted(np.array(gains), np.array(deviations))
    return Given(
        rms=0.0,
        hysteresis_rms=float(np.sqrt(np.mean(errors))),
        refitted_rms=float(np.sqrt(np.mean(refitted))),
        gain=gain,
        gain_deviation=float(np.sqrt(variance)),
        zero_moved=None,
        motion=0.0,
        own_rms=0.0,
    )


def _since(own: NDArray[np.bool_], one: Explanation) -> Given:
    """Compare records with those that the given model was identified from, `own`, shape (records,).

    The given model holds what effects did to its own records, and others show them in another way: what one explanation
    of all records leaves tells whether the stage has changed in between.
    """
    found = []
    for part, rows in zip(one.evidence.parts, one.evidence.slices, strict=True):
        chosen = _known(part) & one.joint.predictable[rows]
        enough = np.count_nonzero(chosen) >= FEWEST
        found.append(_gain(one.h[rows][chosen], (one.target - one.settling)[rows][chosen]) if enough else (0.0, np.inf))
    gains, deviations = np.array(found).T
    before, variance = _weighted(gains[own], deviations[own])
    after, variance_after = _weighted(gains[~own], deviations[~own])
    left_out = one.held_out.records[own]
    refitted = one.held_out.rms
    return Given(
        rms=0.0,
        hysteresis_rms=float(np.sqrt(np.nanmean(left_out))) if np.isfinite(left_out).any() else refitted,
        refitted_rms=refitted,
        gain=after - before,
        gain_deviation=float(np.sqrt(variance + variance_after)),
        zero_moved=None,
        motion=0.0,
        own_rms=0.0,
    )


def _weighted(values: FloatArray, deviations: FloatArray) -> tuple[float, float]:
    """Return the mean of values, weighted by their standard deviations, and its variance; 0 where none is known."""
    weights = 1.0 / np.maximum(np.square(deviations), 1e-300)
    if not weights.sum():
        return 0.0, np.inf
    return float(weights @ values / weights.sum()), float(1.0 / weights.sum())


def _gain(h: FloatArray, target: FloatArray) -> tuple[float, float]:
    """Return by which share a displacement moves more than `h` (m), and its standard deviation, from stretches."""
    moved, missed = h - h.mean(), target - h
    whole = float(moved @ missed / max(float(moved @ moved), 1e-300))
    left = missed - missed.mean() - whole * moved
    parts = [
        float(a @ b) for a, b in zip(np.array_split(moved, STRETCHES), np.array_split(left, STRETCHES), strict=True)
    ]
    return whole, float(np.sqrt(np.sum(np.square(parts))) / max(float(moved @ moved), 1e-300))


def _outcomes(model: AxisModel, now: Explanation, final: Explanation | None) -> tuple[RecordOutcome, ...]:
    """Return what became of each record; without `final` the model stays as it is."""
    left_out = [error if np.isfinite(error) else None for error in np.sqrt(now.held_out.records).tolist()] or [None]
    outcomes = []
    for part, rows, other in zip(now.evidence.parts, now.evidence.slices, left_out, strict=True):
        run = _free_run(model, part)
        after = float(np.std(final.residual[rows][part.used])) if final else run.rms
        outcomes.append(RecordOutcome(part.source, run.offset, run.rms, after, other))
    return tuple(outcomes)


def _extended(model: AxisModel, now: Explanation, floor: Floor, source: str) -> AxisModel:
    """Return the model with the effects found, its hysteresis fitted together with them, as the first record starts."""
    evidence, first = now.evidence, now.evidence.parts[0]
    hysteresis, starts = now.hysteresis()
    y, errors = evidence.y[evidence.used], now.residual[evidence.used]
    voltage = evidence.v[evidence.used]
    extended = replace(
        model,
        kind="pi" if isinstance(evidence.basis, PlayBasis) else "slpi",
        hysteresis=hysteresis,
        start=Start(float(first.v[0]), starts[0], first.history),
        voltage_range=(float(voltage.min()), float(voltage.max())),
        displacement_range=(float(y.min()), float(y.max())),
        effects=tuple(
            _creeping_on(effect, now) for effect in now.with_uncertainty() if not isinstance(effect, EachRecord)
        ),
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


def _creeping_on(effect: Effect, now: Explanation) -> Effect:
    """Return a creep that goes on from a move before the record, where all of several records say the same of it."""
    records = len(now.evidence.parts)
    if not isinstance(effect, Creep) or records == 1 or now.began.size != records or not effect.gains[0]:
        return effect
    moves = -now.began / effect.gains[0]
    initial = float(np.mean(moves))
    alike = bool(np.all(np.abs(moves - initial) <= BEGAN_ALIKE * abs(initial)))
    return replace(effect, initial=initial) if alike else effect
