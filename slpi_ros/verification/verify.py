"""Verification of a model on records not used for its identification, and causes of the error of compensated paths.

Errors are absolute, measured - model, from the initial state of the record: the given one, that at an end of the
model's voltage range if the record begins there, else an estimated one. Of an unknown initial state the samples are
judged to which it only adds a constant, or all if these are too few.
"""

import warnings
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import numpy as np
from scipy.ndimage import maximum_filter1d, minimum_filter1d

from slpi_ros.arrays import FloatArray, IntArray, Mask
from slpi_ros.arrays.rates import rates
from slpi_ros.diagnosis.fingerprint import Left, Signals, lines_of
from slpi_ros.errors import SlpiError, UsageError
from slpi_ros.hysteresis.slpi_published import UnidentifiedLoopWarning
from slpi_ros.identification.cross_validation import level_classes, loop_levels, region_classes, speed_classes
from slpi_ros.identification.free_run import AS_WELL, Match, match, starts_at_end
from slpi_ros.identification.held_readings import corrected_fresh
from slpi_ros.identification.repeatability import repeatability_of
from slpi_ros.identification.samples import FEWEST, Samples, select_samples
from slpi_ros.io.record import Record, common_stage
from slpi_ros.model.axis_model import RESOLUTION, START_MEMORIES, AxisModel, StartMemory
from slpi_ros.model.coverage import record_beyond, surroundings_beyond
from slpi_ros.model.stage_model import StageModel
from slpi_ros.verification.tracking import ErrorPart, Tracking, track

SCHEMA = "slpi_ros/verification/2"
# Default tolerance as a multiple of the repeatability.
TIMES_REPEATABILITY = 3.0
# A change of gain contributes to the offset if the error after fitting it is below this share of the error before.
MOSTLY = 0.5
# Approximate number of samples from which tables are computed.
TABLE_SAMPLES = 40_000
# Smallest shares of the samples that are judged: for a judgement without those before the initial state is known,
# without a warning, and at all.
MOST_KNOWN, FEW, LEAST = 0.6, 0.2, 0.05
# Lines of the spectrum are told if they hold more than this share of the mean square of the residual.
LINES = 0.25
# Verdicts.
PASSED, FAILED, UNPROVED = "passed", "failed", "unproved"
# A voltage stands if it stays within this share of its range for this many samples; shares of moving and standing
# samples from which both are reported.
STANDS, STANDS_FOR, BOTH = 1e-3, 50, 0.05


@dataclass(frozen=True)
class RecordVerification:
    """Verification of one axis on one record of N samples; errors (m) are measured - model."""

    error: ErrorPart  # absolute, of the judged samples, named after the record
    constant: float  # m, part of the error
    rest: ErrorPart  # without the constant
    offset: float  # m, shift of the zero, without that of a changed gain
    offset_uncertainty: float  # m, from the unknown initial state and random errors
    limit: float  # m, rms
    absolute: bool  # the limit holds for the error, else for the rest
    samples: int  # all of the part that was to be judged
    known_from: float | None  # s, from when they are judged; None: estimated state, all are
    begins_known: bool
    history: tuple[float, ...]
    moving: ErrorPart | None  # absolute error, where there is a standing one
    standing: ErrorPart | None
    repeatability_rms: float  # m
    repeatability_source: str  # what it was estimated from
    zero_moved: bool  # the offset exceeds its uncertainty
    gain: float  # relative change of the loops' height
    width: float  # relative change of the loops' width, in addition
    match: Match
    outside: int  # voltages outside the range of the identification
    beyond: str  # where the record is faster or wider than that of the identification
    t: FloatArray  # s, (N,)
    v: FloatArray  # V, (N,)
    measured: FloatArray  # m, (N,)
    model: FloatArray  # m, (N,), with the constant
    judged: Mask  # (N,)
    lines: Left | None = None  # of the spectrum of the rest; None: they hold little of it
    tracking: Tracking | None = None  # None: the desired displacement is not known
    corrected: str = ""  # what was taken out of the readings, as known of the sensor
    independent: bool = True  # the model was not identified from it
    lacking: tuple[str, ...] = ()  # quantities that the model follows and the record does not hold
    holds: tuple[str, ...] = ()  # those that it holds
    span: tuple[float | None, float | None] = (None, None)  # s, the part that was to be judged; None: no limit
    start_memory: StartMemory | None = None  # the initial state, as given

    @property
    def share(self) -> float:
        """Share of the judged samples in all samples."""
        return self.error.samples / self.samples

    @property
    def unusable(self) -> float:
        """Share of the readings that cannot be judged, whatever the initial state is."""
        return 1.0 - float(np.count_nonzero(np.isfinite(self.measured))) / self.samples

    @property
    def is_part(self) -> bool:
        """Whether only a part of the record was to be judged."""
        return self.span != (None, None)

    @property
    def unrepeated_rms(self) -> float:
        """Part of the error that no model explains, m rms: the repeatability, or the lines of the spectrum."""
        lines = self.lines.share * self.rest.rms**2 if self.lines else 0.0
        return float(np.sqrt(max(self.repeatability_rms**2, lines)))

    @property
    def foreign(self) -> bool:
        """Whether the loops are more than twice or less than half as high: another stage, or other units."""
        return not 0.5 <= 1.0 + self.gain <= 2.0

    @property
    def judged_error(self) -> float:
        """Rms error that is compared with the limit, metres."""
        return self.error.rms if self.absolute else self.rest.rms

    @property
    def verdict(self) -> str:
        """`PASSED`, `FAILED`, or `UNPROVED`.

        Nothing is proved if too few samples are judged, if the state alone may exceed the limit, or if the error is
        small on a record that the model was identified from, or without a quantity that the model follows.
        """
        hidden = self.absolute and not self.begins_known and self.offset_uncertainty > self.limit
        if self.share < LEAST or (hidden and self.rest.rms <= self.limit):
            return UNPROVED
        if self.judged_error > self.limit:
            return FAILED
        return PASSED if self.independent and not self.lacking else UNPROVED

    @property
    def passed(self) -> bool:
        """Whether the verdict is `PASSED`."""
        return self.verdict == PASSED

    @property
    def left(self) -> FloatArray:
        """Measured - model of the judged samples without the constant, shape (M,), metres."""
        return (self.measured - self.model)[self.judged]

    def to_document(self) -> dict[str, Any]:
        """Return the figures as in ``msg_schemas/verification.schema.json``."""
        return {
            "source": self.error.name,
            "verdict": self.verdict,
            "passed": self.passed,
            "independent": self.independent,
            "samples": self.error.samples,
            "share": self.share,
            "rms_m": self.error.rms,
            "maximum_m": self.error.maximum,
            "constant_m": self.constant,
            "rest_rms_m": self.rest.rms,
            "rest_maximum_m": self.rest.maximum,
            "moving_rms_m": self.moving.rms if self.moving else None,
            "standing_rms_m": self.standing.rms if self.standing else None,
            "limit_m": self.limit,
            "limit_of": "rms_m" if self.absolute else "rest_rms_m",
            "repeatability_rms_m": self.repeatability_rms,
            "repeatability_source": self.repeatability_source,
            "start": "known" if self.begins_known or self.known_from is not None else "estimated",
            "known_from_s": self.known_from,
            "offset_m": self.offset,
            "offset_uncertainty_m": self.offset_uncertainty,
            "zero_moved": self.zero_moved,
            "gain_change": self.gain,
            "width_change": self.width,
            "outside_samples": self.outside,
            "lines": self.lines.to_document() if self.lines else None,
            "tracking": None if self.tracking is None else self.tracking.to_document(),
        }


Judged = TypeVar("Judged")


def counted(records: Sequence[Judged], facts: Iterable[tuple[bool, str]]) -> Sequence[Judged]:
    """Return the records that decide about a verdict; `facts` tell of each whether it is independent, and its verdict.

    Independent ones and those that fail; all, if there is none of these.
    """
    pairs = zip(records, facts, strict=True)
    return [one for one, (independent, verdict) in pairs if independent or verdict == FAILED] or records


@dataclass(frozen=True)
class AxisVerification:
    """Verification of one axis on all records."""

    overall: ErrorPart  # absolute error of all judged samples
    rest: ErrorPart  # without the constant of each record
    resolution: float  # m, held-out error of the model at its identification
    records: tuple[RecordVerification, ...]
    by_level: tuple[ErrorPart, ...]  # the rest by nesting depth of the loop
    by_speed: tuple[ErrorPart, ...]  # by the magnitude of dv/dt
    by_region: tuple[ErrorPart, ...]  # by voltage

    @property
    def verdict(self) -> str:
        """The worst verdict of the records: `FAILED`, then `UNPROVED`, then `PASSED`.

        Where other records are there, those that the model was identified from only count if they fail.
        """
        return worst_verdict([one.verdict for one in self.counted])

    @property
    def counted(self) -> tuple[RecordVerification, ...]:
        """The records that decide about the verdict."""
        return tuple(counted(self.records, [(one.independent, one.verdict) for one in self.records]))

    @property
    def passed(self) -> bool:
        """Whether every record passes that the model was not identified from, and no other fails."""
        return self.verdict == PASSED

    @property
    def unproved(self) -> RecordVerification:
        """The record that says why nothing is proved, where the verdict is `UNPROVED`."""
        return next(one for one in self.counted if one.verdict == UNPROVED)

    @property
    def worst(self) -> RecordVerification:
        """Record with the largest ratio of error to limit, of those that count."""
        return max(self.counted, key=lambda one: one.judged_error / one.limit if one.limit else np.inf)

    def to_document(self) -> dict[str, Any]:
        """Return the figures as in ``msg_schemas/verification.schema.json``."""
        return {
            "verdict": self.verdict,
            "passed": self.passed,
            "rms_m": self.overall.rms,
            "maximum_m": self.overall.maximum,
            "rest_rms_m": self.rest.rms,
            "rest_maximum_m": self.rest.maximum,
            "samples": self.overall.samples,
            "resolution_m": self.resolution,
            "records": [record.to_document() for record in self.records],
            "by_level": [part.to_document() for part in self.by_level],
            "by_speed": [part.to_document() for part in self.by_speed],
            "by_region": [part.to_document() for part in self.by_region],
        }


def worst_verdict(verdicts: Sequence[str]) -> str:
    """Return `FAILED` if any is, else `UNPROVED` if any is, else `PASSED`."""
    return next((one for one in (FAILED, UNPROVED) if one in verdicts), PASSED)


@dataclass(frozen=True)
class Verification:
    """Verification of the model of the stage `hardware_id` by axis, with the `tolerance` (m) as given."""

    axes: Mapping[str, AxisVerification]
    tolerance: float | None
    hardware_id: str = ""

    @property
    def verdict(self) -> str:
        """The worst verdict of the axes."""
        return worst_verdict([axis.verdict for axis in self.axes.values()])

    @property
    def passed(self) -> bool:
        """Whether every axis passes."""
        return self.verdict == PASSED

    @property
    def given(self) -> dict[str, float | str | None]:
        """What was given of all records, for documents: the part to be judged and the initial state; None: nothing."""
        one = next(iter(self.axes.values())).records[0]
        return {"start_s": one.span[0], "stop_s": one.span[1], "start_memory": one.start_memory}

    def to_document(self) -> dict[str, Any]:
        """Return the verification document, ``msg_schemas/verification.schema.json``."""
        return {
            "schema": SCHEMA,
            "hardware_id": self.hardware_id,
            "verdict": self.verdict,
            "passed": self.passed,
            "tolerance_m": self.tolerance,
            **self.given,
            "axes": {name: axis.to_document() for name, axis in self.axes.items()},
        }


def verify(
    records: Record | Sequence[Record],
    model: StageModel,
    tolerance: float | None = None,
    *,
    axes: Sequence[str] | None = None,
    desired: Sequence[Mapping[str, FloatArray] | None] | None = None,
    without_offset: bool = False,
    start: float | None = None,
    stop: float | None = None,
    start_memory: StartMemory | None = None,
    own: Sequence[str] = (),
) -> Verification:
    """Verify a model by free-run simulation of records not used for its identification.

    Parameters
    ----------
    records : Record or sequence of Record
    model : StageModel
        Model of the same stage. What it knows of the sensor is taken out of the readings first: all errors are those of
        the stage.
    tolerance : float, metres, optional
        Largest absolute rms error that passes. By default three times the record's repeatability, but at least
        the fraction `RESOLUTION` of the stroke, the best accuracy of a hysteresis model, for the error without its
        constant part.
    axes : sequence of str, optional
        Axes to be verified; by default all that the model and every record contain.
    desired : sequence of mapping of axis name to ndarray, shape (N,), metres, or None, optional
        Desired displacement of each record at its samples, NaN where there was none. If given, the tracking error of
        the compensator is evaluated as well.
    without_offset : bool
        Whether the tolerance holds for the error without its offset. Default False.
    start, stop : float, seconds, optional
        Judge only samples with ``start <= t < stop``; t is counted from the first stamp of each record.
    start_memory : {"end", "start", "wiped"}, optional
        Initial state of every record, as of `StageModel.compensate`; by default that at an end of the model's voltage
        range if a record begins there, else an estimated one.
    own : sequence of str, optional
        Sources of the records that the model was identified from: a small error on them proves nothing. Default none.

    Returns
    -------
    Verification

    Raises
    ------
    UsageError
        If records and model belong to different stages or share no axis, or the tolerance is not positive.
    RecordError
        If a record contains too little data.
    """
    records = [records] if isinstance(records, Record) else list(records)
    if tolerance is not None and not 0.0 < tolerance < np.inf:
        raise UsageError(f"tolerance {tolerance:g} m; give a positive one, or none")
    common_stage(records, model.hardware_id)
    names = axes or [name for name in model.axes if all(name in record.axes for record in records)]
    if not names:
        raise UsageError(
            f"no axis is in the model ({', '.join(model.axes)}) and in every record; check the axes' names"
        )
    paths = desired or [None] * len(records)
    found: dict[str, list[RecordVerification]] = {name: [] for name in names}
    for record, path in zip(records, paths, strict=True):
        # Errors are those of the stage, not those of its sensor.
        surrounded = model.surrounded(record)
        fresh = corrected_fresh(record, model.corrections)
        runs = _free_run(fresh, surrounded.stage_only, names, (start, stop), start_memory)
        for name in names:
            axis, run = surrounded.axis(name), runs[name]
            one = _judge(run, axis, record.source, tolerance, without_offset=without_offset)
            one = replace(
                one, independent=record.source not in own, holds=tuple(record.surroundings), span=(start, stop),
                start_memory=start_memory,
            )  # fmt: skip
            if path is not None and name in path:
                followed = path[name][np.isfinite(record.voltage[name])][: run.t.size]
                # From a known state nothing but the zero adds a constant.
                moved = one.offset if one.zero_moved else 0.0
                zero, explained = (one.constant,) * 2 if one.begins_known else (moved, run.explained)
                tracking = track(
                    (record.source, name), run.t, one.v, one.measured, followed,
                    one.model - explained, run.assumed, zero=zero,
                    noise_rms=one.unrepeated_rms,
                )  # fmt: skip
                one = replace(one, tracking=tracking)
            found[name].append(one)
    return Verification(
        {name: _summary(found[name], model.axis(name).quality.held_out_rms) for name in names},
        tolerance,
        model.hardware_id,
    )


@dataclass(frozen=True)
class _Run:
    """Free run of one axis on a record, from the given, the known or the estimated initial state."""

    t: FloatArray
    samples: Samples
    judged: Mask
    samples_in_span: int  # of the part that is to be judged
    begins_known: bool  # the initial state is known
    found: Match
    simulated: FloatArray  # m, (N,), with the constant error
    assumed: tuple[FloatArray, ...]  # from each initial state that a compensator may have assumed
    constant: float  # m
    offset: float
    explained: float  # m, of the constant: by a change of gain and a significant offset


def _free_run(
    record: Record,
    model: StageModel,
    names: Sequence[str],
    span: tuple[float | None, float | None],
    start_memory: StartMemory | None,
) -> dict[str, _Run]:
    """Simulate the axes on a record, each from its initial state, with cross coupling."""
    moving = [name for name in model.axes if name in record.axes and np.isfinite(record.voltage[name]).any()]
    runs, motions = {}, {}
    for name in dict.fromkeys((*names, *moving)):
        axis = model.axis(name)
        try:
            samples = select_samples(record, name, *span)
        except SlpiError:
            if name in names:
                raise
            # An axis at rest does not couple into others.
            continue
        t = record.t[np.isfinite(record.voltage[name])][: samples.v.size]
        with warnings.catch_warnings():
            # The effect of loops that were never identified is visible in the errors.
            warnings.simplefilter("ignore", UnidentifiedLoopWarning)
            runs[name] = _run(axis, t, samples, start_memory, -np.inf if span[0] is None else span[0])
            start = runs[name].found.start
            own = replace(runs[name].found.axis, start=start).uncoupled_displacement(t, samples.v)
        motions[name] = t, own - start.displacement
    coupled = {}
    for name in names:
        run, axis = runs[name], model.axis(name)
        if axis.chain.gains:
            others = {other: np.interp(run.t, *motion) for other, motion in motions.items() if other != name}
            alone = {other: np.zeros_like(run.t) for other in others}
            zero = np.zeros_like(run.t)
            moved = axis.seen(run.t, zero, others) - axis.seen(run.t, zero, alone)
            simulated = run.simulated + moved
            shift = float(np.median((run.samples.y - simulated)[run.judged]))
            run = replace(
                run,
                simulated=simulated + shift,
                constant=run.constant + shift,
                assumed=tuple(each + moved for each in run.assumed),
            )
        coupled[name] = run
    return coupled


def _run(axis: AxisModel, t: FloatArray, samples: Samples, start_memory: StartMemory | None, since: float) -> _Run:
    """Simulate an axis on a record from its initial state; samples before `since` (s) are not judged."""
    # A record need not begin as those of the model did.
    rested = replace(axis, effects=tuple(effect.rested for effect in axis.effects))
    ways = (_matched(one, t, samples, start_memory) for one in ([axis] if rested == axis else [axis, rested]))
    found, begins_known = min(ways, key=lambda way: _spread(way[0]))
    simulated = replace(found.axis, start=found.start).simulate(t, samples.v)
    # The outliers that `identify` leaves out are no error of the model.
    samples = samples.without_outliers(simulated)
    judged = samples.fitted if begins_known else _judged(samples, found)
    # A change of gain leaves the start displacement of the model unchanged.
    by_gain = 0.0
    if found.gain_changed and found.rms_explained < MOSTLY * found.rms:
        by_gain = found.gain_change * float(simulated[judged].mean() - axis.start.displacement)
    offset = found.offset - by_gain
    moved = abs(offset) > found.offset_uncertainty
    starts = [axis.initial(memory) for memory in START_MEMORIES] if axis.causal else [axis.start]
    shift = float(np.median((samples.y - simulated)[judged]))
    return _Run(
        t=t,
        samples=samples,
        judged=judged,
        # Held readings that jitter leave somewhat more fresh ones than their mean number of rows tells.
        samples_in_span=max(round(np.count_nonzero(t >= since) / samples.held), int(np.count_nonzero(judged))),
        begins_known=begins_known,
        found=found,
        simulated=simulated + shift,
        assumed=tuple(replace(axis, start=start).simulate(t, samples.v) for start in starts),
        constant=found.offset + shift,
        offset=offset,
        explained=by_gain + (offset if moved else 0.0),
    )


def _matched(axis: AxisModel, t: FloatArray, samples: Samples, start_memory: StartMemory | None) -> tuple[Match, bool]:
    """Compare the model with a record; return also whether the initial state is known."""
    # It is if it is given, or if the record begins at an end of the model's voltage range, unless the state there
    # explains the record worse than the samples to which any initial state only adds a constant.
    if start_memory:
        return match(axis, samples, t, axis.initial(start_memory)), True
    found = match(axis, samples, t)
    at_end = [match(axis, samples, t, start) for start in starts_at_end(axis, float(samples.v[0]))]
    if at_end:
        best = min(at_end, key=_spread)
        if _spread(best) <= AS_WELL * _spread(found, found.known_from):
            return best, True
    return found, False


def _judged(samples: Samples, found: Match) -> Mask:
    """Return the mask, (N,), of the samples that are judged where the initial state is unknown."""
    # Those to which it only adds a constant, unless they are few and the estimated one explains all others as well.
    known = samples.fitted & (np.arange(samples.v.size) >= found.known_from)
    share = np.count_nonzero(known) / np.count_nonzero(samples.fitted)
    if share >= MOST_KNOWN or (share >= LEAST and _spread(found) > AS_WELL * _spread(found, found.known_from)):
        return known
    return samples.fitted


def _spread(found: Match, first: int = 0) -> float:
    """Return the rms (m) of the residual without its mean from sample `first` on; infinite for too few samples."""
    residual = found.residual[first:]
    return float(np.nanstd(residual)) if np.count_nonzero(np.isfinite(residual)) >= FEWEST else np.inf


def _default_limit(axis: AxisModel, repeatability: float) -> float:
    """Return the default limit of the rms error (m) for a repeatability (m)."""
    low, high = axis.displacement_range
    return max(TIMES_REPEATABILITY * repeatability, RESOLUTION * (high - low))


def _judge(
    run: _Run, axis: AxisModel, source: str, tolerance: float | None, *, without_offset: bool
) -> RecordVerification:
    samples, judged, found = run.samples, run.judged, run.found
    t, v, y = run.t[judged], samples.v[judged], samples.y[judged]
    # What the model explains, such as the motion of another axis, is no noise.
    repeats = min(
        repeatability_of(t, v, y), repeatability_of(t, v, y, y - run.simulated[judged]), key=lambda one: one.rms
    )
    low, high = axis.voltage_range
    margin = 1e-6 * (high - low)
    rest = (samples.y - run.simulated)[judged]
    estimated = not run.begins_known and bool(judged[: found.known_from].any())
    stands = standing(v)
    both = BOTH <= float(np.mean(stands)) <= 1.0 - BOTH
    return RecordVerification(
        error=ErrorPart.of(source, rest + run.constant),
        constant=run.constant,
        rest=ErrorPart.of(source, rest),
        offset=run.offset,
        offset_uncertainty=found.offset_uncertainty,
        limit=_default_limit(axis, repeats.rms) if tolerance is None else tolerance,
        absolute=tolerance is not None and not without_offset,
        samples=run.samples_in_span,
        known_from=None if estimated else float(run.t[judged][0]),
        begins_known=run.begins_known,
        history=found.start.history,
        moving=ErrorPart.of("moving", (rest + run.constant)[~stands]) if both else None,
        standing=ErrorPart.of("standing", (rest + run.constant)[stands]) if both else None,
        repeatability_rms=repeats.rms,
        repeatability_source=repeats.source,
        zero_moved=bool(abs(run.offset) > found.offset_uncertainty),
        gain=found.gain_change,
        width=found.width_change,
        match=found,
        outside=int(np.count_nonzero((samples.v < low - margin) | (samples.v > high + margin))),
        beyond="; ".join(filter(None, [record_beyond(axis, run.t, samples.v), surroundings_beyond(axis, run.t)])),
        t=run.t,
        v=samples.v,
        measured=np.where(samples.fitted, samples.y, np.nan),
        model=run.simulated,
        judged=judged,
        lines=lines_of(Signals(t, v, y, rest), LINES),
        corrected=axis.describe_correction(),
        lacking=tuple(one.key for one in axis.followed if one.key not in axis.surroundings),
    )


def standing(v: FloatArray) -> Mask:
    """Return the mask, (N,), of the samples at which a voltage `v`, (N,), stands still."""
    width = min(STANDS_FOR, v.size)
    still = maximum_filter1d(v, width) - minimum_filter1d(v, width) <= STANDS * np.ptp(v)
    # The last sample of a window of even width is the one before its end.
    return np.asarray(maximum_filter1d(still.astype(np.int8), width, origin=-1 if width % 2 == 0 else 0) > 0)


def _summary(records: Sequence[RecordVerification], resolution: float) -> AxisVerification:
    """Return the errors of all records together, and by level, speed and region."""
    kept = [_thinned(record, TABLE_SAMPLES // len(records)) for record in records]
    error = np.concatenate([(one.measured - one.model)[at] for one, at in zip(records, kept, strict=True)])
    v, level, speed = (
        np.concatenate([signal[at] for signal, at in zip(signals, kept, strict=True)])
        for signals in (
            [one.v for one in records],
            [loop_levels(one.t, one.v) for one in records],
            [rates(one.t, one.v) for one in records],
        )
    )

    def cut(classes: Iterator[tuple[str, Mask]]) -> tuple[ErrorPart, ...]:
        return tuple(ErrorPart.of(name, error[chosen]) for name, chosen in classes if chosen.any())

    return AxisVerification(
        overall=ErrorPart.of("all", np.concatenate([one.left + one.constant for one in records])),
        rest=ErrorPart.of("all, without offset", np.concatenate([one.left for one in records])),
        resolution=resolution,
        records=tuple(records),
        by_level=cut(level_classes(level)),
        by_speed=cut(speed_classes(speed)),
        by_region=cut(region_classes(v)),
    )


def _thinned(record: RecordVerification, most: int) -> IntArray:
    at = np.flatnonzero(record.judged)
    return at[:: max(1, round(at.size / most))]
