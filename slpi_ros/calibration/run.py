"""A whole calibration, from top to bottom: check, record, identify, verify, diagnose, choose the next drive, again."""

import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, field, replace

import numpy as np

from slpi_ros.arrays import FloatArray, IntArray
from slpi_ros.calibration.choice import next_drive
from slpi_ros.calibration.closed_loop import RASTER, AxisLoop, LoopResult, loops_of, moving, showing, too_slow
from slpi_ros.calibration.drives import LONGEST_PAUSE, SWEEP_SECONDS, checking, compensated, driven_so_far, exciting
from slpi_ros.calibration.kept import FOLLOWS, naming, require_kept
from slpi_ros.calibration.session import Session
from slpi_ros.calibration.settings import CALIBRATION, CalibrationSettings
from slpi_ros.compensator.loop_design import design
from slpi_ros.compensator.plausible import implausible_noise, implausible_stroke
from slpi_ros.diagnosis.result import Diagnosis
from slpi_ros.effects.base import Effect, EffectContext
from slpi_ros.errors import RecordError, SlpiError, length
from slpi_ros.excitation.drives import CALIBRATION as CALIBRATION_DRIVE
from slpi_ros.excitation.drives import SWEEP, Drive
from slpi_ros.identification.held_readings import slower_sensor, without_held
from slpi_ros.identification.progress import listening
from slpi_ros.identification.record_quality import Finding, missing_samples
from slpi_ros.identification.signal_statistics import noise
from slpi_ros.io.record import Record
from slpi_ros.io.stage_name import same_stage
from slpi_ros.model.stage_model import StageModel
from slpi_ros.verification.step_answers import step_answers
from slpi_ros.workflows.diagnose import DiagnoseRequest, diagnose
from slpi_ros.workflows.identify import IdentifyRequest, identify
from slpi_ros.workflows.records import Source

CHECK_DRIVE, VERIFICATION_DRIVE, LOOP_DRIVE = "check", "verification", "closed_loop"
# A displacement follows if it moves by this multiple of its noise.
MOVES = 10.0
# Rest before the first move of an axis that is diagnosed with it, seconds.
REST_BEFORE = 0.5
# Rounds of diagnosis and verification, at most.
MOST_ROUNDS = 3
# Ratio of two errors that differ by more than chance.
CLEARLY = 1.5
# First estimate of the time to diagnose a record, for each axis; period of messages while it lasts; seconds.
DIAGNOSING, TELL = 10.0, 5.0


@dataclass(frozen=True)
class Recording:
    """What the stage did during one drive, which may have been `kept` by an earlier run."""

    record: Record
    desired: Mapping[str, FloatArray]  # m, (N,), NaN where there was none; empty without compensator
    kept: bool = False
    off: str = ""  # why feedback was switched off, if it was


@dataclass(frozen=True)
class Request:
    """A drive to be recorded, by a `name` that is unique within a calibration."""

    name: str
    drive: Drive
    desired: Mapping[str, FloatArray]  # m, (N,), at the samples of the drive; empty without compensator
    loops: Mapping[str, AxisLoop] = field(default_factory=dict)  # feedback along the path; empty: none


@dataclass(frozen=True)
class TrackingError:
    """Error (m) of the compensated stage on one path, measured - desired, with the zero of the sweep before it."""

    mean: float  # of the magnitude
    rms: float
    maximum: float
    offset: float  # the median
    rest: float  # mean of the magnitude without the offset
    stroke: float  # displacement range of the model
    goal: float  # largest mean error that meets the target
    t: FloatArray  # s, from the first stamp of the record
    desired: FloatArray
    error: FloatArray

    @classmethod
    def of(cls, t: FloatArray, desired: FloatArray, error: FloatArray, stroke: float, goal: float) -> "TrackingError":
        """Return the error along a path, shape (N,) each."""
        offset, size = float(np.median(error)), np.abs(error)
        rms, rest = float(np.sqrt(np.mean(error**2))), float(np.abs(error - offset).mean())
        return cls(float(size.mean()), rms, float(size.max()), offset, rest, stroke, goal, t, desired, error)

    def part(self, part: slice) -> "TrackingError":
        """Return that of a part of the path."""
        return TrackingError.of(self.t[part], self.desired[part], self.error[part], self.stroke, self.goal)

    @property
    def met(self) -> bool:
        """Whether the error meets the target."""
        return self.mean <= self.goal

    def told(self) -> str:
        """Return the error in words."""
        return (
            f"mean error {length(self.mean)} ({self.mean / self.stroke:.3%} of the stroke), maximum "
            f"{length(self.maximum)}; offset {length(self.offset)}, mean error without it {length(self.rest)}"
        )


@dataclass(frozen=True)
class Step:
    """One step of a calibration: what it was done for (`why`) and what it showed (`finding`)."""

    name: str  # of the record or of the computation
    seconds: float  # of the drive, 0 for a computation
    why: str
    finding: str = ""
    errors: Mapping[str, TrackingError] | None = None  # of a verification
    missing: tuple[Finding, ...] = ()  # samples that its record lacks
    extended: frozenset[str] = frozenset()  # axes whose model, in a verification, has effects


@dataclass(frozen=True)
class Outcome:
    """Result of a calibration: the model that was verified last, and what this verification showed."""

    settings: CalibrationSettings
    model: StageModel
    errors: Mapping[str, TrackingError]
    diagnosis: Diagnosis  # the last one, of all records before the last verification
    steps: tuple[Step, ...]
    why: str  # the target is met or not, and why the calibration ended
    loops: Mapping[str, LoopResult] = field(default_factory=dict)  # of tuned feedback, if it was asked for

    @property
    def met(self) -> bool:
        """Whether every axis meets the target."""
        return all(error.met for error in self.errors.values())

    @property
    def seconds(self) -> float:
        """Sum of the durations of all drives, seconds."""
        return sum(step.seconds for step in self.steps)


@dataclass(frozen=True)
class Progress:
    """Progress of a calibration: the present step, and its number from 1."""

    doing: str
    step: int
    seconds_left: float  # for drives
    error: float | None  # m, the largest mean error in the latest verification
    missing: tuple[Finding, ...] = ()  # samples that the record of the step, just made, lacks


Recorder = Callable[[Request], Recording]


def calibrate(
    settings: CalibrationSettings,
    record: Recorder,
    report: Callable[[Progress], None] = lambda progress: None,
    clock: Callable[[], float] = time.monotonic,
) -> Outcome:
    """Calibrate a stage by itself; SlpiError if it does not follow the voltages, or the records allow no model.

    `clock`: the time of the stage, s, from any begin.
    """
    # `record` drives the stage and returns what it did; an exception ends the calibration. Given the same records it
    # takes the same decisions, so a calibration that was interrupted goes on where its records end.
    return _Calibration(settings, record, report, clock).run()


class _Calibration:
    def __init__(
        self,
        settings: CalibrationSettings,
        record: Recorder,
        report: Callable[[Progress], None],
        clock: Callable[[], float],
    ) -> None:
        self._settings, self._record, self._report, self._clock = settings, record, report, clock
        # When the last record has ended, and the time that it took beside its drive, seconds.
        self._ended, self._beside = clock(), 0.0
        self._steps: list[Step] = []
        self._records: list[Record] = []
        # Record of the check.
        self._first: Record | None = None
        self._session = Session()
        self._drives: list[tuple[str, Sequence[str]]] = []
        # Repeatability of each axis, metres, best known so far: what a diagnosis explains is no noise.
        self._repeatability: dict[str, float] = {}
        # Model and errors of each verification.
        self._verified: list[tuple[StageModel, dict[str, TrackingError]]] = []
        self._diagnosing = DIAGNOSING

    def run(self) -> Outcome:
        settings = self._settings
        self._check()
        if len(settings.axes) > 1:
            self._sweep()
        self._excite(
            CALIBRATION_DRIVE, settings.axes, CALIBRATION * len(settings.axes),
            "all loops that a path may visit, after a sweep that makes the memory known",
        )  # fmt: skip
        first = self._identify()
        self._verify(first)
        self._survey()
        ended = "no further record is expected to add information"
        for _ in range(MOST_ROUNDS):
            diagnosis = self._diagnose(first)
            while choice := next_drive(settings, diagnosis.axes, self._drives, self._left):
                self._excite(choice.drive, choice.axes, choice.seconds, choice.why)
                diagnosis = self._diagnose(first)
            if self._left < 0.0:
                ended = "the time budget is spent"
                break
            # No diagnosis makes the offset smaller.
            if all(error.rest <= error.goal for error in self._verify(diagnosis.extended).values()):
                break
        goals = {axis: settings.goal(rms) for axis, rms in self._repeatability.items()}

        def excess(verified: tuple[StageModel, dict[str, TrackingError]]) -> float:
            return max(error.rest / goals[axis] for axis, error in verified[1].items())

        best = min(self._verified, key=excess)
        if excess(self._verified[-1]) > CLEARLY * excess(best) and self._left >= 0.0:
            self._verify(best[0])
        judged = [
            {axis: replace(error, goal=goals[axis]) for axis, error in errors.items()} for _, errors in self._verified
        ]
        loops = self._tune(self._verified[-1][0], diagnosis.extended) if settings.tune else {}
        model = _left_at(self._verified[-1][0], self._records[-1])
        return Outcome(settings, model, judged[-1], diagnosis, tuple(self._steps), why(judged, diagnosis, ended), loops)

    @property
    def _left(self) -> float:
        """Time (s) left for drives before the last verification."""
        verification = max((step.seconds for step in self._steps if step.errors), default=self._settings.verification)
        return self._settings.budget - self._settings.loops - self._used - verification

    @property
    def _used(self) -> float:
        """Sum of the durations of all drives so far, seconds."""
        return sum(step.seconds for step in self._steps)

    @property
    def _pause(self) -> float:
        """Time (s) from the end of the last record to the next drive, as far as is known before it."""
        return min(self._clock() - self._ended + self._beside, LONGEST_PAUSE)

    def _begin(self, doing: str, missing: tuple[Finding, ...] = ()) -> None:
        errors = self._verified[-1][1] if self._verified else {}
        worst = max((error.mean for error in errors.values()), default=None)
        left = max(self._settings.budget - self._used, 0.0)
        self._report(Progress(doing, len(self._steps) + 1, left, worst, missing))

    def _did(
        self,
        record: Record,
        drive: Drive,
        why: str,
        finding: str,
        errors: Mapping[str, TrackingError] | None = None,
        extended: frozenset[str] = frozenset(),
    ) -> None:
        """Note the step of a drive."""
        missing = missing_samples(record)
        self._steps.append(Step(record.source, float(drive.t[-1]), why, finding, errors, missing, extended))

    def _recorded(
        self,
        kind: str,
        drive: Drive,
        desired: Mapping[str, FloatArray],
        loops: Mapping[str, AxisLoop] | None = None,
    ) -> Recording:
        name = f"{len(self._steps) + 1:02d}_{kind}"
        self._begin(f"recording {name}")
        asked = self._clock()
        recording = self._record(Request(name, drive, desired, loops or {}))
        self._ended = self._clock()
        self._beside = max(self._ended - asked - float(drive.t[-1]), 0.0)
        recording = replace(recording, record=self._session.following(recording.record, kept=recording.kept))
        if recording.kept:
            fitted = kind not in (CHECK_DRIVE, SWEEP, LOOP_DRIVE)
            require_kept(recording.record, drive, self._settings, self._first, fitted=fitted)
        if missing := missing_samples(recording.record):
            self._begin(f"recorded {name}", missing)
        if self._settings.accept_stage and same_stage(recording.record.hardware_id, self._settings.accept_stage):
            recording = replace(recording, record=replace(recording.record, hardware_id=""))
        return recording

    def _check(self) -> None:
        drive = checking(self._settings)
        recording = self._recorded(CHECK_DRIVE, drive, {})
        record = recording.record
        with naming(record) if recording.kept else nullcontext():
            findings = [_follows(axis, drive, record, self._settings) for axis in self._settings.axes]
        self._first = record
        self._did(record, drive, drive.why, "; ".join(findings))

    def _sweep(self) -> None:
        """Sweep all axes, so that those that wait for their turn in the calibration drive rest in a known state."""
        axes = self._settings.axes
        drive = exciting(self._settings, SWEEP, SWEEP_SECONDS * len(axes), axes, self._settings.seed)
        record = self._recorded(SWEEP, drive, {}).record
        self._did(record, drive, "an axis that waits rests in a known state", drive.why)

    def _excite(self, kind: str, axes: Sequence[str], seconds: float, why: str) -> None:
        drive = exciting(self._settings, kind, seconds, axes, self._settings.seed + len(self._steps))
        record = self._recorded(kind, drive, {}).record
        self._records.append(record)
        self._drives.append((kind, axes))
        period = float(np.median(np.diff(record.t)))
        held = {axis: without_held(record, axis)[1] for axis in axes}
        slow = [f"axis {axis}: {slower_sensor(rows, period)}" for axis, rows in held.items() if rows > 1.0]
        self._did(record, drive, why, "; ".join([drive.why, *slow]))

    def _identify(self) -> StageModel:
        self._begin("identifying the hysteresis")
        model = identify(IdentifyRequest(Source(records=self._records))).model
        self._repeatability = {name: axis.quality.floor_rms for name, axis in model.axes.items()}
        said = "; ".join(
            f"axis {name}: held-out error {length(axis.quality.held_out_rms)} rms, "
            f"sensor noise {length(axis.quality.floor_rms)}"
            for name, axis in model.axes.items()
        )
        self._steps.append(Step("identify", 0.0, "a first model, of hysteresis alone", said))
        return model

    def _survey(self) -> None:
        """Record the conditions that the calibration drive lacks, as far as the budget allows."""
        while choice := next_drive(self._settings, None, self._drives, self._left):
            self._excite(choice.drive, choice.axes, choice.seconds, choice.why)

    def _diagnose(self, first: StageModel) -> Diagnosis:
        count = len(self._records)
        begun = told = time.monotonic()
        about = self._diagnosing * count * len(self._settings.axes)
        self._begin(f"diagnosing {count} records, about {about:.0f} s")

        def tell(what: str) -> None:
            nonlocal told
            now = time.monotonic()
            if now - told >= TELL:
                told = now
                self._begin(f"diagnosing {count} records, {now - begun:.0f} s of about {about:.0f} s: {what}")

        with listening(tell):
            diagnosis = _diagnosed(self._records, first)
        self._diagnosing = (time.monotonic() - begun) / (count * len(self._settings.axes))
        self._repeatability = {name: found.repeatability_rms for name, found in diagnosis.axes.items()}
        finding = "; ".join(f"axis {name}: {found.summary}" for name, found in diagnosis.axes.items())
        self._steps.append(
            Step("diagnose", 0.0, f"causes of the error, judged on each of {count} records held out in turn", finding)
        )
        return diagnosis

    def _verify(self, model: StageModel) -> dict[str, TrackingError]:
        model = with_present_zero(model, self._records)
        drive, desired = compensated(self._settings, model, len(self._steps), self._records, self._pause)
        recording = self._recorded(VERIFICATION_DRIVE, drive, desired)
        # What the zero has done between two records is no error of the model, and after a reset ~/set_zero removes it.
        moved = moved_zeros(model, [*self._records, before_path(recording)])
        errors = {
            axis: tracking_error(recording, axis, model, self._settings.goal(self._repeatability[axis]), moved[axis])
            for axis in self._settings.axes
        }
        finding = "; ".join(
            f"axis {axis}: {error.told()}; the zero had moved by {length(moved[axis])} since the record before"
            for axis, error in errors.items()
        )
        model = model.shifted(moved)
        self._records.append(recording.record)
        extended = frozenset(name for name, axis in model.axes.items() if axis.effects)
        self._did(recording.record, drive, drive.why, finding, errors, extended)
        self._verified.append((model, errors))
        return errors

    def _tune(self, model: StageModel, diagnosed: StageModel) -> dict[str, LoopResult]:
        """Design the feedback of each axis, and follow steps and a raster with it.

        The model with the least error may know less of modes and delays than the one that was diagnosed.
        """
        settings, found = self._settings, dict[str, LoopResult]()
        self._begin("tuning the feedback")
        for name in settings.axes:
            try:
                made = design(diagnosed.axis(name), settings.rate)
                told = f"bandwidth {made.bandwidth:.3g} Hz, modulus margin {made.margin:.2f} predicted"
                found[name] = LoopResult(made, told)
            except SlpiError as none:
                found[name] = LoopResult(None, f"no feedback: {none}")
        shown = {name: one for name, one in found.items() if one.design}
        if shown:
            model = with_present_zero(model, self._records)
            path = replace(settings, path=showing(settings, model))
            drive, desired = compensated(path, model, len(self._steps), self._records, self._pause, in_advance=False)
            recording = self._recorded(LOOP_DRIVE, drive, desired, loops_of(found, model))
            for name, one in shown.items():
                error = tracking_error(recording, name, model, settings.goal(self._repeatability[name]))
                rate = reading_rate(recording.record, name)
                assert one.design
                if too_slow(diagnosed.axis(name), one.design.gains, 1.0 / rate):
                    told = f"{one.told}; not shown on the stage: {rate:.3g} readings a second are too few for it"
                    found[name] = replace(one, told=told)
                    continue
                steps = step_answers(error.t, error.desired, error.error, model.axis(name).quality.floor_rms)
                raster = error.part(moving(error.desired)).told()
                on_stage = f"on the stage a raster of {RASTER:.0%} of the stroke has a {raster}"
                told = "; ".join(filter(None, (one.told, on_stage, switched_off(recording))))
                found[name] = replace(one, told=told, steps=steps)
            self._records.append(recording.record)
        finding = "; ".join(f"axis {name}: {one.told}" for name, one in found.items())
        why = "feedback of the largest bandwidth: steps and a raster"
        if shown:
            self._did(recording.record, drive, why, finding)
        else:
            self._steps.append(Step("tune", 0.0, why, finding))
        return found


def switched_off(recording: Recording) -> str:
    """Return what is told of feedback that was switched off during a recording, "" if it was not."""
    if recording.kept:
        # Its bag holds what was sent and measured, and no reason.
        return "whether feedback was switched off is not known of a kept record"
    return f"feedback was switched off: {recording.off}" if recording.off else ""


def reading_rate(record: Record, axis: str) -> float:
    """Return the mean number of fresh readings of an axis per second."""
    fresh = without_held(record, axis)[0]
    t = fresh.t[np.isfinite(fresh.displacement[axis])]
    return float((t.size - 1) / (t[-1] - t[0]))


def _diagnosed(records: Sequence[Record], model: StageModel) -> Diagnosis:
    """Diagnose each axis on the records in which it moves."""
    found, extended = {}, {}
    for axis in model.axes:
        moving = [_from_first_move(record, axis) for record in records if np.ptp(record.voltage[axis]) > 0.0]
        one = diagnose(DiagnoseRequest(Source(records=moving, axes=[axis]), model)).diagnosis
        found[axis], extended[axis] = one.axes[axis], one.extended.axes[axis]
    source = ", ".join(record.source for record in records)
    return Diagnosis(found, replace(one.extended, axes=extended), source)


def _from_first_move(record: Record, axis: str) -> Record:
    """Return the record from shortly before the first move of an axis on."""
    # A long rest before tells nothing of the hysteresis, but keeps the initial state open while other axes couple in.
    v = record.voltage[axis]
    first = int(np.flatnonzero(np.abs(v - v[0]) > 0.0)[0])
    begin = max(int(np.searchsorted(record.t, record.t[first] - REST_BEFORE)), 0)
    return record.part(slice(begin, None))


def with_present_zero(model: StageModel, records: Sequence[Record]) -> StageModel:
    """Return the model with the zero of the last of the records, which begin at the start of the model."""
    return model.shifted(moved_zeros(model, records))


def before_path(recording: Recording) -> Record:
    """Return the part of a recording before its path: the sweep that makes the memory known."""
    along = np.any([np.isfinite(desired) for desired in recording.desired.values()], axis=0)
    return recording.record.part(slice(0, int(np.argmax(along))))


def moved_zeros(model: StageModel, records: Sequence[Record]) -> dict[str, float]:
    """Return by how much (m) the zero of each axis differs from the model in the last of the records."""
    # The median over rising and falling voltages: lag, rate and width of the loops cancel.
    t, voltage = driven_so_far(records)
    seen = model.simulate(t, voltage)
    last = records[-1]
    known = np.all([np.isfinite(v) for v in last.voltage.values()], axis=0)
    read = {axis: last.displacement[axis][known] for axis in model.axes}
    return {axis: float(np.nanmedian(y - seen[axis][-y.size :])) for axis, y in read.items()}


def _left_at(model: StageModel, last: Record) -> StageModel:
    """Return the model with the memory at the end of the last record, where the stage has been left."""
    axes = {}
    for name, axis in model.axes.items():
        v = last.voltage[name]
        known = np.isfinite(v)
        _, u, _ = axis.chain.reaching(v[known], EffectContext(last.t[known]))
        axes[name] = replace(axis, end=axis.at_rest(u, float(v[known][-1]), "end"))
    return replace(model, axes=axes)


def _follows(axis: str, drive: Drive, record: Record, settings: CalibrationSettings) -> str:
    """Return what the check has shown of an axis; RecordError if it does not follow, or as no stage does."""
    record.require_axis(axis)
    v, y = record.voltage[axis], record.displacement[axis]
    known = np.isfinite(v) & np.isfinite(y)
    if np.count_nonzero(known) < 20:
        raise RecordError(f"axis '{axis}': {np.count_nonzero(known)} readings during the check; check stage_state")
    v, y = v[known], y[known]
    wanted, applied = float(np.ptp(drive.voltage[axis])), float(np.ptp(v))
    if abs(applied - wanted) > FOLLOWS * wanted:
        raise RecordError(
            f"axis '{axis}': the applied voltage moved by {applied:.3g} V, the command by {wanted:.3g} V; check the "
            "amplifier, the order of the axes, and that effort is in volts"
        )
    by_chance = noise(y)
    slope = float(np.cov(v, y)[0, 1] / np.var(v))
    if abs(slope) * applied <= MOVES * by_chance:
        raise RecordError(
            f"axis '{axis}': the displacement moved by {abs(slope) * applied:.3g} m for {applied:.3g} V, with noise of "
            f"{by_chance:.3g} m; check the sensor and the order of the axes"
        )
    if slope < 0.0:
        raise RecordError(
            f"axis '{axis}': the displacement falls by {-slope * applied:.3g} m when the voltage rises by "
            f"{applied:.3g} V; change the sign of the displacement in the driver"
        )
    limits = settings.limits[settings.axes.index(axis)]
    # Over the whole range, before it goes there.
    units = implausible_stroke(slope * limits.span) or implausible_noise(y)
    if units and not settings.accept_units:
        raise RecordError(
            f"axis '{axis}': {units}, which no piezo stage has: it follows with {slope:.3g} m/V; check the unit and "
            "sensor_scale of the driver, or set accept_units:=true"
        )
    return f"axis {axis} follows with {slope * 1e6:.3g} µm/V"


def tracking_error(recording: Recording, axis: str, model: StageModel, goal: float, zero: float = 0.0) -> TrackingError:
    """Return the error along the path of a recording, without known errors of the sensor.

    `goal`: mean (m) to meet; `zero`: by how much (m) it has moved since that of the model.
    """
    record, desired = without_held(recording.record, axis)[0], recording.desired[axis]
    error = model.axis(axis).correct(record.t, record.displacement[axis]) - desired - zero
    along = np.isfinite(error)
    if not along.any():
        raise RecordError(f"{record.source}: axis '{axis}': no readings along the path; check stage_state")
    low, high = model.axis(axis).displacement_range
    return TrackingError.of(record.t[along], desired[along], error[along], high - low, goal)


def aligned(
    record: Record, sent_ns: IntArray, commands: Mapping[str, FloatArray], desired: Mapping[str, FloatArray]
) -> Recording:
    """Return a recording whose desired displacements belong to the applied voltages."""
    # Commands take some time to the stage and readings some time back. The delay between commanded and applied voltages
    # is removed, so that only what the stage itself does is left. `sent_ns` (M,) are stamps on the clock of the record;
    # `commands` (V) and `desired` (m, NaN where there was none) have the shape (M,).
    if not desired:
        return Recording(record, {})
    t = (record.time_ns - sent_ns[0]) * 1e-9
    sent = (sent_ns - sent_ns[0]) * 1e-9
    shift = _transport(t, sent, record, commands)
    return Recording(record, {axis: np.interp(t - shift, sent, y) for axis, y in desired.items()})


# Longest delay from a command to its reading (s) that is looked for, and the steps of the search.
LONGEST, FINE = 0.2, 1e-4


def _transport(t: FloatArray, sent: FloatArray, record: Record, commands: Mapping[str, FloatArray]) -> float:
    """Return the delay (s) of the applied voltages behind the commanded ones."""

    def miss(shift: float) -> float:
        return sum(
            float(np.nanmean(np.abs(record.voltage[axis] - np.interp(t - shift, sent, v))))
            for axis, v in commands.items()
        )

    shifts = np.arange(-0.02, LONGEST, 2e-3)
    best = float(shifts[int(np.argmin([miss(shift) for shift in shifts.tolist()]))])
    fine = best + np.arange(-2e-3, 2e-3, FINE)
    return float(fine[int(np.argmin([miss(shift) for shift in fine.tolist()]))])


def why(verified: Sequence[Mapping[str, TrackingError]], diagnosis: Diagnosis, ended: str) -> str:
    """Return one line: latest error and target of the worst axis, what stands in the way, and what to do."""
    name, worst = max(verified[-1].items(), key=lambda item: item[1].mean / item[1].goal)
    said = [
        f"target {'' if worst.met else 'not '}met",
        f"axis {name}: {worst.told()}; target {length(worst.goal)}",
    ]
    least = min((errors[name].mean for errors in verified[:-1]), default=worst.mean)
    if worst.mean > CLEARLY * least:
        said.append(
            f"the error has risen from {length(least)} to {length(worst.mean)} between two verifications: the stage "
            "drifts"
        )
    effects: Sequence[Effect] = [each.effect for each in diagnosis.axes[name].effects]
    lasting = [effect.name for effect in effects if effect.needs_feedback and not effect.shift]
    if lasting:
        said.append(f"{', '.join(lasting)} cannot be compensated without feedback")
    if late := sum(effect.shift for effect in effects):
        # On the path of the verification it is undone.
        said.append(f"the delay of {late * 1e3:.3g} ms is undone on a trajectory, and not by setpoints one by one")
    if abs(worst.offset) > worst.rest:
        creeps = any(effect.unsure.slow_share for effect in effects)
        said.append(
            f"most of it is the zero, which moves from the sweep to the path{' and still creeps' * creeps}: scan soon "
            "after a reset and ~/set_zero of the compensator, or close the loop"
        )
    return "; ".join(said if worst.met or not ended else [*said, ended])
