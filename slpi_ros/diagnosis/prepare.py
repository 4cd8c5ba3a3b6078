"""Preparation of the data of one axis for the joint fit."""

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from slpi_ros.arrays import FloatArray, IntArray, Mask
from slpi_ros.effects.base import EffectContext, usual_step
from slpi_ros.effects.filters import Uniform
from slpi_ros.errors import RecordError
from slpi_ros.hysteresis.loop_family import LoopFamily
from slpi_ros.hysteresis.prandtl_ishlinskii import PrandtlIshlinskii
from slpi_ros.hysteresis.reversals import reversals
from slpi_ros.hysteresis.turning_points import Memory
from slpi_ros.identification.bases import Basis, SurfaceBasis
from slpi_ros.identification.drive import Runs
from slpi_ros.identification.free_run import InitialState, choose_start
from slpi_ros.identification.least_squares import FIRST_SMOOTHNESS, Problem, solve_free, walk_of
from slpi_ros.identification.linear_kinds import SELECTION_SAMPLES, SMOOTHNESS
from slpi_ros.identification.published_kinds import voltage_dead_band
from slpi_ros.identification.refit import basis_of
from slpi_ros.identification.samples import Samples, select_samples
from slpi_ros.identification.signal_statistics import digit
from slpi_ros.io.record import Course, Record
from slpi_ros.io.surroundings import clean, smoothed
from slpi_ros.model.axis_model import AxisModel

# Smallest numbers of samples and of reversals that allow a cross-validation.
FEWEST_SAMPLES, FEWEST_TURNS = 1000, 4
# Number of vertices of the loop family if those of the model do not cover the record.
VERTICES = 41
# Largest number of vertices of a loop family while effects are selected.
COARSE = 31
# A quantity is looked at if it has this many readings, and they span this share of the time.
FEWEST_READINGS, ENOUGH_TIME = 8, 0.7
# It is one of the stage itself if at least so many changes from reading to reading have this correlation with those of
# displacement or voltage.
FEWEST_CHANGES, GOES_WITH = 20, 0.7
# Samples before the reset of the hysteresis state may be excluded if at least this share of the samples remains.
ENOUGH_WIPED = 0.5
# They are excluded if their error exceeds that of the others by this factor, because the motion before the record is
# unknown.
DISAGREES = 2.0
# Axes whose voltages have a larger correlation than this have a common drive.
ONE_DRIVE = 0.98
# Reversals smaller than this share of the voltage range are ignored.
SMALLEST_TURN = 0.01
# A record has a single drive frequency if more than this share of its moves between reversals takes the same time,
# within this factor.
MOST_RUNS, ALMOST = 0.8, 1.25
# Share of the power of the voltage rate below the highest frequency that counts as excited.
EXCITED = 0.999
# A residual above this many robust standard deviations is an outlier if both neighbours are less than half as large.
OUTLIER = 10.0
# Largest number of samples used, from the start of a record. Records are not thinned here, because the differences
# between successive samples distinguish the effects.
MOST_SAMPLES = 200_000
# A sensor is at its limit if the extreme reading occurs at least this often, and this many times as often as each of
# the readings next to it.
AT_LIMIT, AT_LIMIT_TIMES = 20, 5


@dataclass(frozen=True)
class Part:
    """Data of one axis from one record, signals and masks of shape (N,)."""

    source: str
    t: FloatArray  # s, from the first stamp
    v: FloatArray  # V, as commanded or read
    y: FloatArray  # m
    used: Mask  # in the fit; outliers, drop-outs and an unknown start only drive the hysteresis
    seen: Mask  # valid displacement within the selected time, without outliers and mixed readings
    after_reset: Mask  # both ends of the voltage range visited: `history` only adds a constant
    history: tuple[float, ...]  # V, as in `slpi_ros.model.axis_model.Start`
    others: Mapping[str, FloatArray]  # m, of the other axes from the start of the record
    digit: float  # m, resolution of the readings, 0: continuous
    surroundings: Mapping[str, FloatArray] = field(default_factory=dict)  # recorded quantities, in their units
    courses: Mapping[str, Course] = field(default_factory=dict)  # their readings
    mixed: float = 0.0  # share of readings, not used, that are early, late or a mixture of two
    before: Course | None = None  # times (s, below 0) and displacements (m) of its session, None: unknown


@dataclass(frozen=True)
class Evidence:
    """Data of one axis for a joint fit; signals of shape (N,) are concatenated from all records."""

    parts: tuple[Part, ...]
    basis: Basis  # of the hysteresis
    smoothness: float  # weight of its roughness penalty
    beside: FloatArray = field(default_factory=lambda: np.empty((0, 0)))  # m, (N, k), free gains

    def __post_init__(self) -> None:
        if not self.beside.size:
            object.__setattr__(self, "beside", np.empty((self.t.size, 0)))

    @cached_property
    def t(self) -> FloatArray:
        """Time from the first stamp of each record, shape (N,), seconds."""
        return np.concatenate([part.t for part in self.parts])

    @cached_property
    def v(self) -> FloatArray:
        """Voltage, shape (N,), volts."""
        return np.concatenate([part.v for part in self.parts])

    @cached_property
    def y(self) -> FloatArray:
        """Displacement, shape (N,), metres."""
        return np.concatenate([part.y for part in self.parts])

    @cached_property
    def used(self) -> Mask:
        """Mask of the samples to be fitted, shape (N,)."""
        return np.concatenate([part.used for part in self.parts])

    @cached_property
    def others(self) -> Mapping[str, FloatArray]:
        """Displacements of the other axes that all records contain, relative to their start, shape (N,), metres."""
        return _in_all([part.others for part in self.parts])

    @cached_property
    def surroundings(self) -> Mapping[str, FloatArray]:
        """Quantities that all records contain, shape (N,), in their units."""
        return _in_all([part.surroundings for part in self.parts])

    @property
    def courses(self) -> Mapping[str, Sequence[Course]]:
        """Readings of the quantities that all records contain, of each record."""
        return {key: [part.courses[key] for part in self.parts] for key in self.surroundings}

    @cached_property
    def slices(self) -> tuple[slice, ...]:
        """Slice of the samples of each record."""
        ends = np.cumsum([0, *(part.t.size for part in self.parts)]).tolist()
        return tuple(slice(*pair) for pair in zip(ends[:-1], ends[1:], strict=True))

    @cached_property
    def rows(self) -> IntArray:
        """Indices of the rows of the problem that are samples, without those of initial states, shape (N,)."""
        leads = np.cumsum([len(part.history) for part in self.parts])
        rows: IntArray = np.arange(self.t.size) + np.repeat(leads, [part.t.size for part in self.parts])
        return rows

    @cached_property
    def around(self) -> EffectContext:
        """Context of the effects: time and the other axes."""
        return EffectContext(
            self.t,
            others=self.others,
            records=tuple(
                EffectContext(
                    part.t,
                    others=part.others,
                    grid=Uniform.over(part.t),
                    surroundings=part.surroundings,
                    before=part.before,
                )
                for part in self.parts
            ),
            surroundings=self.surroundings,
        )

    @cached_property
    def reversed(self) -> tuple[EffectContext, ...]:
        """Contexts of the records in reversed time."""
        times = [(part.t[-1] - part.t)[::-1] for part in self.parts]
        return tuple(EffectContext(t, grid=Uniform.over(t)) for t in times)

    @cached_property
    def rounding(self) -> float:
        """Rms rounding error of the finest sensor resolution among the records, metres."""
        return float(min(part.digit for part in self.parts) / np.sqrt(12.0))

    def samples(self, u: FloatArray) -> list[Samples]:
        """Return the samples of each record, after its initial state, for the voltage `u`, shape (N,), volts."""
        low, high = self.basis.grid[[0, -1]] if isinstance(self.basis, SurfaceBasis) else (-np.inf, np.inf)
        return [
            Samples(np.clip(u[rows], low, high), part.y, part.used).after(part.history)
            for rows, part in zip(self.slices, self.parts, strict=True)
        ]

    def problem(self, u: FloatArray) -> Problem:
        """Pose the problem of fitting the hysteresis, driven by the voltage `u`, shape (N,), volts."""
        return Problem.pose(self.samples(u), self.basis)

    def predict(self, samples: Sequence[Samples], x: FloatArray) -> FloatArray:
        """Return the displacement of the hysteresis at samples, shape (N,), for parameters `x`, in their unit."""
        walk, size = walk_of(samples, self.basis), self.basis.size
        increments = self.basis.increments(walk, x[:size])
        # The displacement at rest of each record.
        rest = walk.origin < 0
        increments[rest] += x[size:][walk.record[rest]]
        return walk.accumulated(increments)

    def poses_as(self, other: "Evidence") -> bool:
        """Return whether the hysteresis has the same equations for the same voltage."""
        return self.parts is other.parts and self.basis is other.basis and self.smoothness == other.smoothness

    @property
    def coarse(self) -> "Evidence":
        """The same data with at most `COARSE` vertices of a loop family, for which a fit takes half the time."""
        basis = self.basis
        if not isinstance(basis, SurfaceBasis) or basis.grid.size <= COARSE:
            return self
        return replace(self, basis=SurfaceBasis(np.linspace(basis.grid[0], basis.grid[-1], COARSE)))

    def of_record(self, k: int) -> "Evidence":
        """Return the data of record `k` only."""
        return Evidence((self.parts[k],), self.basis, self.smoothness)


def _in_all(records: Sequence[Mapping[str, FloatArray]]) -> dict[str, FloatArray]:
    """Return the signals that all records contain, by name, shape (N,)."""
    common = [name for name in records[0] if all(name in one for one in records)]
    return {name: np.concatenate([one[name] for one in records]) for name in common}


def evidence_of(
    records: Sequence[Record], axis: str, model: AxisModel | None, start: float | None = None, stop: float | None = None
) -> Evidence:
    """Return the data of one axis from records, with the hysteresis basis of `model`, by default a loop family."""
    read = [_readings(record, axis, start, stop) for record in records]
    _require_enough(read)
    basis = _basis(model, [samples for _, samples, _ in read])
    most = SELECTION_SAMPLES // (2 * len(read))
    thin = [samples.thinned(most) for _, samples, _ in read]
    beginnings = [
        _known_start(record, axis, samples) or choose_start(samples, lambda candidate: Problem.pose([candidate], basis))
        for record, samples in zip(records, thin, strict=True)
    ]
    started = [beginning.of(samples) for beginning, samples in zip(beginnings, thin, strict=True)]
    parts = tuple(
        Part(
            source=record.source,
            t=t,
            v=samples.v,
            y=samples.y,
            used=samples.fitted & ~_at_limit(samples),
            seen=samples.fitted,
            after_reset=samples.after_reset,
            history=beginning.history,
            others=others,
            digit=digit(samples.y[samples.fitted]),
            surroundings=(beside := _at_stamps(record, t)),
            courses={key: record.surroundings[key] for key in beside},
            before=_before(record, axis, t.size),
        )
        for record, (t, samples, others), beginning in zip(records, read, beginnings, strict=True)
    )
    smoothness, *_ = Problem.pose(started, basis).reweighted().best_smoothness(SMOOTHNESS, FIRST_SMOOTHNESS)
    evidence = Evidence(parts, basis, smoothness)
    residual = _residual(evidence)
    trusted = [
        _trusted(part, residual[rows], samples, only_after_reset=beginning.only_after_reset)
        for part, rows, (_, samples, _), beginning in zip(parts, evidence.slices, read, beginnings, strict=True)
    ]
    return replace(evidence, parts=tuple(trusted))


def _readings(
    record: Record, axis: str, start: float | None, stop: float | None
) -> tuple[FloatArray, Samples, dict[str, FloatArray]]:
    """Return times (s), samples, and displacements of the other axes (m) from one record."""
    samples = select_samples(record, axis, start, stop)
    t, others = _clock_and_others(record, axis)
    kept = np.diff(t[: samples.v.size], prepend=-np.inf) > 0.0
    if not np.count_nonzero(kept) > 0.5 * kept.size:
        raise RecordError(
            f"{record.source}: most stamps are equal, so that nothing can be said of time; record the stamps of the "
            "sensor"
        )
    # Of readings with equal stamps only the first is used: effects that depend on time cannot explain the others.
    chosen = np.flatnonzero(kept)[:MOST_SAMPLES]
    v, y, fitted, mixed = samples.v[chosen], samples.y[chosen], samples.fitted[chosen], samples.mixed * chosen.size
    samples = replace(samples, v=v, y=y, fitted=fitted, mixed=mixed // samples.v.size)
    return t[chosen], samples, {name: y[chosen] for name, y in others.items()}


def _known_start(record: Record, axis: str, samples: Samples) -> InitialState | None:
    """Return the initial state after the session before a record; None if that has not erased what was before it."""
    voltages = [each.voltage[axis] for each in record.before if axis in each.axes]
    v = np.concatenate([*(each[np.isfinite(each)] for each in voltages), samples.v[:1]])
    v = np.clip(v, samples.v.min(), samples.v.max())
    nothing = np.zeros(v.size + samples.v.size)
    if not Samples(np.append(v, samples.v), nothing, nothing > 0.0).after_reset[v.size]:
        return None
    return InitialState(tuple(surviving(v[reversals(v, _dead_band(v))])), only_after_reset=False)


def surviving(v: FloatArray) -> list[float]:
    """Return the reversals (V) that a path of voltages, shape (N,), has not wiped out, oldest first, and its end."""
    # Which ones are remembered does not depend on the shape of the loops.
    memory = Memory(PrandtlIshlinskii(np.zeros(1), np.ones(1)), float(v[0]), primed=True)
    memory.forward_array(v)
    return [*memory.snapshot().reversals, memory.voltage]


def _before(record: Record, axis: str, most: int) -> Course | None:
    """Return at most about `most` displacements (m) of the session before a record, and their times (s); None if none.

    Slow effects remember them.
    """
    own = [each for each in record.before if axis in each.axes]
    if not own:
        return None
    at = (np.concatenate([each.time_ns for each in own]) - record.time_ns[0]) * 1e-9
    y = np.concatenate([each.displacement[axis] for each in own])
    latest = np.maximum.accumulate(np.insert(at[:-1], 0, -np.inf))
    known = np.flatnonzero(np.isfinite(y) & (at > latest) & (at < 0.0))
    # The last one stays: what moved last is remembered best.
    known = known[:: min(-known.size // most, -1)][::-1]
    return (at[known], y[known]) if known.size > 1 else None


def no_cause(record: Record, course: Course, begins: float, ends: float) -> str:
    """Return why a recorded quantity can be no cause of what is between two times (s); "" if it can."""
    at, value = clean(course)
    if reason := few(at) or uncovered(at, begins, ends):
        return reason
    return f"it stays at {value[0]:.4g}" if np.ptp(value) == 0.0 else of_stage(record, (at, value))


def of_stage(record: Record, course: Course) -> str:
    """Return which signal of the stage itself a quantity goes with, from reading to reading; "" if with none."""
    # A stage that followed a second sensor of itself would be in a feedback loop.
    at, value = course
    changes = np.diff(value)
    if changes.size < FEWEST_CHANGES or not float(np.std(changes)) > 0.0:
        return ""
    for what, signals in (("displacement", record.displacement), ("voltage", record.voltage)):
        for axis, signal in signals.items():
            known = np.isfinite(signal)
            own = np.diff(np.interp(at, record.t[known], signal[known])) if known.any() else np.zeros(0)
            if own.size and float(np.std(own)) > 0.0 and (r := abs(float(np.corrcoef(changes, own)[0, 1]))) > GOES_WITH:
                return f"it goes with the {what} of axis '{axis}' (correlation of the changes {r:.2f}): it is no cause"
    return ""


def few(at: FloatArray) -> str:
    """Return how many readings there are, at times `at` (s, (n,)), and how many are needed; "" if enough."""
    if at.size >= FEWEST_READINGS:
        return ""
    return f"{at.size} readings at different times, at least {FEWEST_READINGS} are needed"


def uncovered(at: FloatArray, begins: float, ends: float) -> str:
    """Return which time readings at times `at` (s, (n,)) cover; "" if it is most of that between two times (s)."""
    if at.size and min(at[-1], ends) - max(at[0], begins) >= ENOUGH_TIME * (ends - begins):
        return ""
    covers = f"its readings go from {at[0]:.4g} to {at[-1]:.4g} s" if at.size else "it has no reading"
    return f"{covers} where {begins:.4g} to {ends:.4g} s are in use, of which {ENOUGH_TIME:.0%} are needed"


def _at_stamps(record: Record, t: FloatArray) -> dict[str, FloatArray]:
    """Return the quantities of a record at times `t`, shape (N,), s, that were recorded over most of that."""
    found = {}
    for key, course in record.surroundings.items():
        at, value = clean(course)
        if few(at) or uncovered(at, float(t[0]), float(t[-1])):
            continue
        if reason := of_stage(record, (at, value)):
            warnings.warn(f"{record.source}: {key} is not used: {reason}", stacklevel=2)
            continue
        found[key] = np.interp(t, *smoothed((at, value)))
    return found


def _trusted(part: Part, residual: FloatArray, samples: Samples, *, only_after_reset: bool) -> Part:
    """Return the data of a record without bad samples, as seen in the residual, shape (N,), of hysteresis alone."""
    path = part.y - residual
    samples = samples.without_mixed(path).without_outliers(path)
    used = part.used & samples.fitted
    used = used & ~_outliers(residual, used)
    if only_after_reset or _beginning_disagrees(residual, used, part.after_reset):
        used = used & part.after_reset
    known = samples.mixed + np.count_nonzero(samples.fitted)
    return replace(part, used=used, seen=samples.fitted, mixed=samples.mixed / known)


def _residual(evidence: Evidence) -> FloatArray:
    """Return the residual of a fit of hysteresis without effects, shape (N,), metres."""
    problem = evidence.problem(evidence.v).reweighted()
    matrix, vector = problem.equations
    x = solve_free(matrix + problem.penalty(evidence.smoothness, problem.count), vector)
    return (problem.y - problem.design.predict(x))[evidence.rows] * problem.scale


def _at_limit(samples: Samples) -> Mask:
    """Return the mask of the samples, shape (N,), at which the sensor is at an end of its range."""
    y, limited = samples.y, np.zeros(samples.y.size, dtype=bool)
    levels, count = np.unique(y[samples.fitted], return_counts=True)
    for end, near in ((0, count[1:4]), (-1, count[-4:-1])):
        if levels.size > AT_LIMIT and count[end] >= max(AT_LIMIT, AT_LIMIT_TIMES * near.max()):
            limited |= y == levels[end]
    return limited


def _beginning_disagrees(residual: FloatArray, used: Mask, after_reset: Mask) -> bool:
    """Return whether residuals before the reset of the hysteresis state are much larger than those after it."""
    before, after = residual[used & ~after_reset], residual[used & after_reset]
    if not before.size or after.size < ENOUGH_WIPED * (before.size + after.size):
        return False
    return bool(np.sqrt(np.mean(before**2)) > DISAGREES * np.sqrt(np.mean(after**2)))


def _clock_and_others(record: Record, axis: str) -> tuple[FloatArray, dict[str, FloatArray]]:
    """Return the times (s) at which the axis has a voltage, and the motion (m) of axes with a different drive."""
    own = record.voltage[axis]
    driven = np.isfinite(own)
    t, others = record.t, {}
    for name in record.axes:
        y = record.displacement[name]
        known = np.isfinite(y)
        moves = known.any() and np.ptp(y[known]) > 0.0
        if name != axis and moves and not _common(own, record.voltage[name]):
            others[name] = np.interp(t, t[known], y[known] - y[known][0])[driven]
    return t[driven], others


def driven_alike(records: Sequence[Record], axis: str) -> tuple[str, ...]:
    """Return the other axes with the same drive as `axis` in every record; their coupling cannot be identified."""
    others = [name for name in records[0].axes if name != axis]
    return tuple(
        name
        for name in others
        if all(name not in each.axes or _common(each.voltage[axis], each.voltage[name]) for each in records)
    )


def _common(own: FloatArray, other: FloatArray) -> bool:
    """Return whether two axes have a common drive, so that their motions cannot be distinguished."""
    both = np.isfinite(own) & np.isfinite(other)
    if np.count_nonzero(both) < 2 or not np.ptp(other[both]) > 0.0 or not np.ptp(own[both]) > 0.0:
        return False
    return bool(abs(np.corrcoef(own[both], other[both])[0, 1]) > ONE_DRIVE)


def _require_enough(read: Sequence[tuple[FloatArray, Samples, dict[str, FloatArray]]]) -> None:
    count = sum(int(np.count_nonzero(samples.fitted)) for _, samples, _ in read)
    if count < FEWEST_SAMPLES:
        raise RecordError(
            f"{count} usable samples are too few to leave some out and judge by them; record {FEWEST_SAMPLES} or more"
        )
    turns = sum(Runs.of(t, samples.v, _dead_band(samples.v)).turns for t, samples, _ in read)
    if turns < FEWEST_TURNS:
        raise RecordError(
            f"the voltage turns {turns} times: one loop only, and nothing to judge it by; record several loops of "
            "different size and speed, for example the drive of slpi excite"
        )


def _basis(model: AxisModel | None, samples: Sequence[Samples]) -> Basis:
    """Return the basis of the model's hysteresis, or of a loop family if that does not cover the voltages."""
    low, high = float(min(part.v.min() for part in samples)), float(max(part.v.max() for part in samples))
    if model is not None and isinstance(model.hysteresis, PrandtlIshlinskii | LoopFamily):
        basis, _ = basis_of(model)
        margin = 1e-6 * (high - low)
        if not isinstance(basis, SurfaceBasis):
            return basis
        if basis.grid[0] - margin <= low and high <= basis.grid[-1] + margin:
            return basis
    return SurfaceBasis(np.linspace(low, high, VERTICES))


def _outliers(residual: FloatArray, used: Mask) -> Mask:
    """Return the mask of single-sample outliers, shape (N,)."""
    size = np.where(used, np.abs(residual), 0.0)
    beside = np.maximum(np.append(size[1:], 0.0), np.insert(size[:-1], 0, 0.0))
    spread = 1.4826 * float(np.median(size[used]))
    alone: Mask = (size > OUTLIER * spread) & (beside < 0.5 * size)
    return alone


def one_speed(evidence: Evidence) -> bool:
    """Return whether all records have the same single drive frequency."""
    return drive_frequency(evidence) > 0.0


def drive_frequency(evidence: Evidence) -> float:
    """Return the single drive frequency (Hz) of all records; 0 if there are several."""
    found = [frequency_of_moves(part.t, part.v) for part in evidence.parts]
    return float(np.median(found)) if max(found) < ALMOST * min(found) else 0.0


def frequency_of_moves(t: FloatArray, v: FloatArray) -> float:
    """Return the single frequency (Hz) of a voltage `v` (V) at times `t` (s), shape (N,); 0 if it has several."""
    # The first move and the last one may be cut off.
    duration = Runs.of(t, v, _dead_band(v)).duration[1:-1]
    usual = float(np.median(duration)) if duration.size else 0.0
    alike = usual > 0.0 and np.mean((duration < ALMOST * usual) & (usual < ALMOST * duration)) > MOST_RUNS
    return 0.5 / usual if alike else 0.0


def excited_frequency(evidence: Evidence) -> float:
    """Return the highest frequency (Hz) that any record excites; see `EXCITED`."""
    found = []
    for part in evidence.parts:
        grid = np.arange(part.t[0], part.t[-1], usual_step(part.t))
        rate = np.diff(np.interp(grid, part.t, part.v))
        power = np.cumsum(np.abs(np.fft.rfft(rate * np.hanning(rate.size))) ** 2)
        found.append(np.fft.rfftfreq(rate.size, usual_step(part.t))[np.searchsorted(power, EXCITED * power[-1])])
    return float(max(found))


def _dead_band(v: FloatArray) -> float:
    """Return the size (V) up to which reversals of a voltage, shape (N,), are ignored as noise or as too small."""
    return max(voltage_dead_band(v), SMALLEST_TURN * float(np.ptp(v)))
