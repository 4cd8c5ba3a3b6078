"""Verification of a model on records not used for its identification, and causes of the error of compensated paths.

The motion before a record is unknown: an initial history and a constant offset are estimated for each record, and
nothing else. The samples to which the initial history only adds a constant are evaluated, or all if these are too few.
"""

import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slpi_ros.diagnosis.diagnose import diagnose
from slpi_ros.errors import RecordError, SlpiError, UsageError
from slpi_ros.hysteresis.slpi_published import UnidentifiedLoopWarning
from slpi_ros.identification.cross_validation import (
    level_classes,
    loop_levels,
    region_classes,
    speed_classes,
    speeds,
)
from slpi_ros.identification.initial_history import Match, match
from slpi_ros.identification.repeatability_floor import floor_of
from slpi_ros.identification.samples import FEWEST, Samples, select_samples
from slpi_ros.io.record import Record, common_stage
from slpi_ros.model.axis_model import RESOLUTION, START_MEMORIES, AxisModel
from slpi_ros.model.stage_model import StageModel

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
Mask = NDArray[np.bool_]

SCHEMA = "slpi_ros/verification/1"
# Default tolerance as a multiple of the repeatability floor.
TIMES_THE_FLOOR = 3.0
# A delay is accepted if it reduces the difference between model and desired displacement by this factor.
SMALLER_DIFFERENCE = 1.1
# A change of gain contributes to the offset if the error after fitting it is below this share of the error before.
MOSTLY = 0.5
# Approximate number of samples from which tables are computed.
TABLE_SAMPLES = 40_000
# A voltage is at a limit if it stays at the extreme of the record for at least this many samples.
FEWEST_AT_LIMIT = 3
# Longest delay that is searched for, in seconds and as a share of the record, and number of steps of the search.
LONGEST_DELAY, DELAY_SHARE, DELAY_STEPS = 0.5, 0.05, 200

CAUSES = {
    "zero": "the zero of the sensor has moved since the model was identified",
    "memory": "the compensator started from another memory than the stage had",
    "limits": "the voltage was at a limit",
    "delay": "the displacement follows the desired one later",
    "command": "the voltages are not those of this model: rate limits, feedback, a reset or another model",
    "effects": "the stage does what the model does not hold; `slpi diagnose` names it",
    "model": "the model's hysteresis is not that of the stage",
    "noise": "noise of the sensor",
}


@dataclass(frozen=True)
class ErrorPart:
    """Number of samples, and their rms and maximum error (m), for a part of the samples."""

    name: str
    samples: int
    rms: float
    maximum: float

    @classmethod
    def of(cls, name: str, error: FloatArray) -> "ErrorPart":
        """Summarise errors, shape (N,), metres, N > 0."""
        return cls(name, error.size, _rms(error), float(np.abs(error).max()))

    def to_document(self) -> dict[str, Any]:
        """Return the part as in ``msg_schemas/verification.schema.json``."""
        return {"name": self.name, "samples": self.samples, "rms_m": self.rms, "maximum_m": self.maximum}


@dataclass(frozen=True)
class Tracking:
    """Tracking error of a compensated path, and its causes.

    Parameters
    ----------
    error : ErrorPart
        Measured - desired displacement.
    shares : mapping of cause to float
        Share of each of `CAUSES` in the mean square error. Their sum is 1; a cause that counteracts others is negative.
    delay : float, seconds
        Delay of the displacement behind the desired one.
    effects : tuple of str
        Effects that a diagnosis of the record identified.
    t, desired : ndarray, shape (N,), seconds and metres
        Time and desired displacement, for charts.
    parts : mapping of cause to ndarray, shape (N,), metres
        Contribution of each cause to the error; "model" includes noise and effects.
    """

    error: ErrorPart
    shares: Mapping[str, float]
    delay: float
    effects: tuple[str, ...]
    t: FloatArray
    desired: FloatArray
    parts: Mapping[str, FloatArray]

    @property
    def blame(self) -> str:
        """The cause with the largest share."""
        return max(self.shares, key=lambda cause: self.shares[cause])

    def to_document(self) -> dict[str, Any]:
        """Return the figures as in ``msg_schemas/verification.schema.json``."""
        return {
            "rms_m": self.error.rms,
            "maximum_m": self.error.maximum,
            "samples": self.error.samples,
            "shares": dict(self.shares),
            "blame": self.blame,
            "delay_s": self.delay,
            "effects": list(self.effects),
        }


@dataclass(frozen=True)
class RecordVerification:
    """Verification of one axis on one record.

    Parameters
    ----------
    error : ErrorPart
        Error, measured - model, of the evaluated samples without the offset, named after the record.
    limit : float, metres
        Largest rms error that passes.
    floor_rms : float, metres
        Repeatability floor of the record.
    floor_source : str
        Data from which the floor was estimated.
    known_from : float or None, seconds
        Time from which the initial history only adds a constant; evaluation starts there. None if there is no such
        time: all samples are evaluated, from the estimated history.
    history : tuple of float, volts
        Initial history that best explains the record, as in `slpi_ros.model.axis_model.Start`.
    offset : float, metres
        Shift of the zero.
    offset_uncertainty : float, metres
        Uncertainty of the offset, due to the unknown initial history and to random errors.
    zero_moved : bool
        Whether the offset exceeds its uncertainty.
    gain, width : float
        Relative change of the height of the loops from those of the model, and additional change of their width.
    match : Match
        Comparison of the model with the record, with the uncertainties of these changes.
    outside : int
        Number of samples with a voltage outside the range of the identification.
    t, v, measured, model : ndarray, shape (N,), seconds, volts and metres
        Time, voltage and displacement of the record, and displacement of the model including the offset.
    judged : ndarray of bool, shape (N,)
        Mask of the evaluated samples.
    tracking : Tracking or None
        Tracking error; None if the desired displacement is not known.
    corrected : str
        What was taken out of the readings, as known of the sensor; "" if nothing.
    """

    error: ErrorPart
    limit: float
    floor_rms: float
    floor_source: str
    known_from: float | None
    history: tuple[float, ...]
    offset: float
    offset_uncertainty: float
    zero_moved: bool
    gain: float
    width: float
    match: Match
    outside: int
    t: FloatArray
    v: FloatArray
    measured: FloatArray
    model: FloatArray
    judged: Mask
    tracking: Tracking | None = None
    corrected: str = ""

    @property
    def passed(self) -> bool:
        """Whether the rms error is within the limit."""
        return self.error.rms <= self.limit

    @property
    def left(self) -> FloatArray:
        """Measured - model of the evaluated samples, shape (M,), metres."""
        return (self.measured - self.model)[self.judged]

    def to_document(self) -> dict[str, Any]:
        """Return the figures as in ``msg_schemas/verification.schema.json``."""
        return {
            "source": self.error.name,
            "passed": self.passed,
            "samples": self.error.samples,
            "rms_m": self.error.rms,
            "maximum_m": self.error.maximum,
            "limit_m": self.limit,
            "floor_rms_m": self.floor_rms,
            "floor_source": self.floor_source,
            "start": "estimated" if self.known_from is None else "known",
            "known_from_s": self.known_from,
            "offset_m": self.offset,
            "offset_uncertainty_m": self.offset_uncertainty,
            "zero_moved": self.zero_moved,
            "gain_change": self.gain,
            "width_change": self.width,
            "outside_samples": self.outside,
            "tracking": None if self.tracking is None else self.tracking.to_document(),
        }


@dataclass(frozen=True)
class AxisVerification:
    """Verification of one axis on all records.

    Parameters
    ----------
    overall : ErrorPart
        Error of all evaluated samples.
    resolution : float, metres
        Held-out error of the model at its identification.
    records : tuple of RecordVerification
    by_level, by_speed, by_region : tuple of ErrorPart
        Errors by nesting depth of the loop, by magnitude of dv/dt, and by voltage.
    """

    overall: ErrorPart
    resolution: float
    records: tuple[RecordVerification, ...]
    by_level: tuple[ErrorPart, ...]
    by_speed: tuple[ErrorPart, ...]
    by_region: tuple[ErrorPart, ...]

    @property
    def passed(self) -> bool:
        """Whether every record passes."""
        return all(record.passed for record in self.records)

    @property
    def worst(self) -> RecordVerification:
        """Record with the largest ratio of error to limit."""
        return max(self.records, key=lambda record: record.error.rms / record.limit if record.limit else np.inf)

    def to_document(self) -> dict[str, Any]:
        """Return the figures as in ``msg_schemas/verification.schema.json``."""
        return {
            "passed": self.passed,
            "rms_m": self.overall.rms,
            "maximum_m": self.overall.maximum,
            "samples": self.overall.samples,
            "resolution_m": self.resolution,
            "records": [record.to_document() for record in self.records],
            "by_level": [part.to_document() for part in self.by_level],
            "by_speed": [part.to_document() for part in self.by_speed],
            "by_region": [part.to_document() for part in self.by_region],
        }


@dataclass(frozen=True)
class Verification:
    """Verification of the model of a stage on records not used for its identification.

    Parameters
    ----------
    axes : mapping of axis name to AxisVerification
    tolerance : float or None, metres
        As given.
    hardware_id : str
        Hardware id of the stage.
    """

    axes: Mapping[str, AxisVerification]
    tolerance: float | None
    hardware_id: str = ""

    @property
    def passed(self) -> bool:
        """Whether every axis passes on every record."""
        return all(axis.passed for axis in self.axes.values())

    def to_document(self) -> dict[str, Any]:
        """Return the verification document, ``msg_schemas/verification.schema.json``."""
        return {
            "schema": SCHEMA,
            "hardware_id": self.hardware_id,
            "passed": self.passed,
            "tolerance_m": self.tolerance,
            "axes": {name: axis.to_document() for name, axis in self.axes.items()},
        }


def verify(
    records: Record | Sequence[Record],
    model: StageModel,
    tolerance: float | None = None,
    *,
    axes: Sequence[str] | None = None,
    desired: Sequence[Mapping[str, FloatArray] | None] | None = None,
) -> Verification:
    """Verify a model by free-run simulation of records not used for its identification.

    Parameters
    ----------
    records : Record or sequence of Record
    model : StageModel
        Model of the same stage. What it knows of the sensor is taken out of the readings first: all errors are those of
        the stage.
    tolerance : float, metres, optional
        Largest rms error that passes; by default three times the record's repeatability floor, but at least the
        fraction `RESOLUTION` of the stroke, the best accuracy that a hysteresis model attains.
    axes : sequence of str, optional
        Axes to be verified; by default all that the model and every record contain.
    desired : sequence of mapping of axis name to ndarray, shape (N,), metres, or None, optional
        Desired displacement of each record at its samples, NaN where there was none. If given, the tracking error of
        the compensator is evaluated as well.

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
        runs = _free_run(model.correct(record), model.stage_only, names)
        for name in names:
            axis, run = model.axis(name), runs[name]
            one = _judge(run, axis, record.source, tolerance)
            if path is not None and name in path:
                one = replace(one, tracking=_tracking(one, run, path[name], record, model, name))
            found[name].append(one)
    return Verification(
        {name: _summary(found[name], model.axis(name).quality.held_out_rms) for name in names},
        tolerance,
        model.hardware_id,
    )


@dataclass(frozen=True)
class _Run:
    """Free-run simulation of one axis on a record, from the initial history that best explains the record.

    `constant` (m) is the part of the offset due to a change of gain, plus `offset` if that is significant. `assumed`
    holds a simulation from each initial state that a compensator may have assumed.
    """

    t: FloatArray
    samples: Samples
    judged: Mask
    found: Match
    simulated: FloatArray
    assumed: tuple[FloatArray, ...]
    offset: float
    constant: float


def _free_run(record: Record, model: StageModel, names: Sequence[str]) -> dict[str, _Run]:
    """Simulate the axes on a record, each from the initial history that best explains it, with cross coupling."""
    moving = [name for name in model.axes if name in record.axes and np.isfinite(record.voltage[name]).any()]
    runs, motions = {}, {}
    for name in dict.fromkeys((*names, *moving)):
        axis = model.axis(name)
        try:
            samples = select_samples(record, name, None, None)
        except SlpiError:
            if name in names:
                raise
            # An axis at rest does not couple into others.
            continue
        t = record.t[np.isfinite(record.voltage[name])]
        with warnings.catch_warnings():
            # The effect of loops that were never identified is visible in the errors.
            warnings.simplefilter("ignore", UnidentifiedLoopWarning)
            runs[name] = _run(axis, t, samples)
            start = runs[name].found.start
            own = replace(axis, start=start).uncoupled_displacement(t, samples.v)
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
            simulated += np.median((run.samples.y - simulated)[run.judged])
            run = replace(run, simulated=simulated, assumed=tuple(each + moved for each in run.assumed))
        coupled[name] = run
    return coupled


def _run(axis: AxisModel, t: FloatArray, samples: Samples) -> _Run:
    """Simulate an axis on a record from the initial history that best explains it."""
    found = match(axis, samples, t)
    simulated = replace(axis, start=found.start).simulate(t, samples.v)
    # The outliers that `identify` leaves out are no error of the model.
    samples = samples.without_outliers(simulated)
    after = samples.fitted & (np.arange(t.size) >= found.known_from)
    judged = after if np.count_nonzero(after) >= FEWEST else samples.fitted
    # A change of gain leaves the start displacement of the model unchanged.
    by_gain = 0.0
    if found.gain_changed and found.rms_explained < MOSTLY * found.rms:
        by_gain = found.gain_change * float(simulated[judged].mean() - axis.start.displacement)
    offset = found.offset - by_gain
    moved = abs(offset) > found.offset_uncertainty
    starts = [axis.initial(memory) for memory in START_MEMORIES] if axis.causal else [axis.start]
    return _Run(
        t=t,
        samples=samples,
        judged=judged,
        found=found,
        simulated=simulated + float(np.median((samples.y - simulated)[judged])),
        assumed=tuple(replace(axis, start=start).simulate(t, samples.v) for start in starts),
        offset=offset,
        constant=by_gain + (offset if moved else 0.0),
    )


def _default_limit(axis: AxisModel, floor: float) -> float:
    """Return the default limit of the rms error (m) for a repeatability floor (m)."""
    low, high = axis.displacement_range
    return max(TIMES_THE_FLOOR * floor, RESOLUTION * (high - low))


def _judge(run: _Run, axis: AxisModel, source: str, tolerance: float | None) -> RecordVerification:
    samples, judged, found = run.samples, run.judged, run.found
    t, v, y = run.t[judged], samples.v[judged], samples.y[judged]
    # What the model explains, such as the motion of another axis, is no noise.
    floor = min(floor_of(t, v, y), floor_of(t, v, y, y - run.simulated[judged]), key=lambda one: one.rms)
    low, high = axis.voltage_range
    margin = 1e-6 * (high - low)
    return RecordVerification(
        error=ErrorPart.of(source, (samples.y - run.simulated)[judged]),
        limit=_default_limit(axis, floor.rms) if tolerance is None else tolerance,
        floor_rms=floor.rms,
        floor_source=floor.source,
        known_from=float(run.t[judged][0]) if samples.fitted[~judged].any() or not found.known_from else None,
        history=found.start.history,
        offset=run.offset,
        offset_uncertainty=found.offset_uncertainty,
        zero_moved=bool(abs(run.offset) > found.offset_uncertainty),
        gain=found.gain_change,
        width=found.width_change,
        match=found,
        outside=int(np.count_nonzero((samples.v < low - margin) | (samples.v > high + margin))),
        t=run.t,
        v=samples.v,
        measured=np.where(samples.fitted, samples.y, np.nan),
        model=run.simulated,
        judged=judged,
        corrected=axis.describe_correction(),
    )


def _summary(records: Sequence[RecordVerification], resolution: float) -> AxisVerification:
    """Return the errors of all records together, and by level, speed and region."""
    kept = [_thinned(record, TABLE_SAMPLES // len(records)) for record in records]
    error = np.concatenate([(one.measured - one.model)[at] for one, at in zip(records, kept, strict=True)])
    v, level, speed = (
        np.concatenate([signal[at] for signal, at in zip(signals, kept, strict=True)])
        for signals in (
            [one.v for one in records],
            [loop_levels(one.t, one.v) for one in records],
            [speeds(one.t, one.v) for one in records],
        )
    )

    def cut(classes: Iterator[tuple[str, Mask]]) -> tuple[ErrorPart, ...]:
        return tuple(ErrorPart.of(name, error[chosen]) for name, chosen in classes if chosen.any())

    return AxisVerification(
        overall=ErrorPart.of("all", np.concatenate([one.left for one in records])),
        resolution=resolution,
        records=tuple(records),
        by_level=cut(level_classes(level)),
        by_speed=cut(speed_classes(speed)),
        by_region=cut(region_classes(v)),
    )


def _thinned(record: RecordVerification, most: int) -> IntArray:
    """Return the indices of about `most` evaluated samples."""
    at = np.flatnonzero(record.judged)
    return at[:: max(1, round(at.size / most))]


def _tracking(
    one: RecordVerification, run: _Run, path: FloatArray, record: Record, model: StageModel, name: str
) -> Tracking:
    """Decompose the tracking error, measured - desired, by cause.

    ``m`` is the model from the initial history that explains the record, ``a`` the model from the initial state that
    the compensator seems to have assumed, and ``d`` the desired displacement (``d'``: delayed as the stage is)::

        y - d = (y - offset - m) + offset + (m - a) + (a - d') + (d' - d)
                 model, noise      zero     memory    command    delay
    """
    driven = np.isfinite(record.voltage[name])
    d = path[driven]
    at = np.isfinite(d) & run.samples.fitted
    if np.count_nonzero(at) < 2:
        raise RecordError(f"{record.source}: axis '{name}': no desired displacement while it was measured; record both")
    t, v, y, d = run.t[at], run.samples.v[at], run.samples.y[at], d[at]
    offset = one.offset if one.zero_moved else 0.0
    estimated = run.simulated[at] - run.constant
    assumed = min((each[at] for each in run.assumed), key=lambda each: _rms(each - d))
    delay = _delay(t, d, assumed)
    late = np.interp(t - delay, t, d)
    command = assumed - late
    limited = _at_limit(v, command)
    parts = {
        "zero": np.full(t.size, offset),
        "memory": estimated - assumed,
        "limits": np.where(limited, command, 0.0),
        "delay": late - d,
        "command": np.where(limited, 0.0, command),
        "model": y - offset - estimated,
    }
    error = y - d
    total = float(error @ error)
    shares = {cause: float(part @ error) / total if total else 0.0 for cause, part in parts.items()}
    named, explained = _effects(one, record, model, name)
    noise = min(one.floor_rms**2 * error.size / total if total else 0.0, max(shares["model"], 0.0))
    effects = explained * max(shares["model"] - noise, 0.0)
    shares |= {"model": shares["model"] - noise - effects, "effects": effects, "noise": noise}
    return Tracking(
        error=ErrorPart.of(record.source, error),
        shares={cause: shares[cause] for cause in CAUSES},
        delay=delay,
        effects=named,
        t=t,
        desired=d,
        parts=parts,
    )


def _delay(t: FloatArray, desired: FloatArray, model: FloatArray) -> float:
    """Return the delay (s) of the model behind the desired displacement; 0 if no delay is clearly better."""
    longest = min(LONGEST_DELAY, DELAY_SHARE * float(t[-1] - t[0]))
    shifts = np.linspace(0.0, longest, DELAY_STEPS + 1)
    misses = [_rms(model - np.interp(t - shift, t, desired)) for shift in shifts.tolist()]
    best = int(np.argmin(misses))
    return float(shifts[best]) if misses[best] < misses[0] / SMALLER_DIFFERENCE else 0.0


def _at_limit(v: FloatArray, command: FloatArray) -> Mask:
    """Return the mask of samples, shape (N,), with the voltage at a limit and a desired displacement beyond it."""
    margin = 1e-6 * float(np.ptp(v))
    limited = np.zeros(v.size, dtype=bool)
    for extreme, missing in ((v.max(), command < 0.0), (v.min(), command > 0.0)):
        there = np.abs(v - extreme) <= margin
        edges = np.flatnonzero(np.diff(np.pad(there, 1).astype(np.int8)))
        for start, stop in zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True):
            if stop - start >= FEWEST_AT_LIMIT:
                limited[start:stop] |= missing[start:stop]
    return limited


def _effects(one: RecordVerification, record: Record, model: StageModel, name: str) -> tuple[tuple[str, ...], float]:
    """Return the effects that a diagnosis identifies, and their share of the residual; none if the error is small."""
    if one.error.rms <= _default_limit(model.axis(name), one.floor_rms):
        return (), 0.0
    try:
        found = diagnose(record, model, axes=[name]).axes[name].effects
    except SlpiError:
        # With too little data for a diagnosis, the contribution of the model is still known.
        return (), 0.0
    return tuple(effect.name for effect in found), min(sum(max(one.share_of_residual, 0.0) for one in found), 1.0)


def _rms(error: FloatArray) -> float:
    return float(np.sqrt(np.mean(error**2)))
