"""What records say about one axis: what an explanation is fitted to."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from slpi_ros.effects.base import EffectContext, usual_step
from slpi_ros.effects.filters import Uniform
from slpi_ros.errors import RecordError
from slpi_ros.hysteresis.loop_family import LoopFamily
from slpi_ros.hysteresis.prandtl_ishlinskii import PrandtlIshlinskii
from slpi_ros.identification.bases import Basis, SurfaceBasis
from slpi_ros.identification.design_matrix import Design, Walk
from slpi_ros.identification.drive import Runs
from slpi_ros.identification.initial_history import choose_start
from slpi_ros.identification.least_squares import Problem, solve_free
from slpi_ros.identification.linear_kinds import SELECTION_SAMPLES, SMOOTHNESS
from slpi_ros.identification.published_kinds import voltage_dead_band
from slpi_ros.identification.refit import basis_of
from slpi_ros.identification.samples import Samples, select_samples
from slpi_ros.identification.signal_statistics import digit
from slpi_ros.io.record import Record
from slpi_ros.model.axis_model import AxisModel

FloatArray = NDArray[np.float64]

# Blocks left out need some samples each, and hysteresis some turns, or nothing is left to judge by.
FEWEST_SAMPLES, FEWEST_TURNS = 1000, 4
# Vertices of a loop family where the model has none that fit the record.
VERTICES = 41
# Samples from before the memory was wiped are left out where at least this share is left.
ENOUGH_WIPED = 0.5
# The beginning of a record disagrees with the rest when its error is this many times as large: nobody knows what had
# moved the stage before.
DISAGREES = 2.0
# Axes whose voltages are correlated more than this have a common drive.
ONE_DRIVE = 0.98
# Smaller reversals, as a share of the voltage range, do not count.
SMALLEST_TURN = 0.01
# A record has one drive frequency when this share of its moves from turn to turn takes the same time, up to a factor.
MOST_RUNS, ALMOST = 0.8, 1.25
# The power of the voltage rate up to the highest frequency that a drive excites, as a share of all.
EXCITED = 0.999
# A sample this many robust standard deviations off, while its neighbours are not half as far, is an outlier.
OUTLIER = 10.0
# Of a longer record so many samples in a row are looked at: effects are told apart by what happens between samples, so
# that none may be left out.
MOST_SAMPLES = 200_000
# A sensor is at its limit where so many readings are one and the same extreme one, and so many times as many as there
# are of the readings next to it.
AT_LIMIT, AT_LIMIT_TIMES = 20, 5


@dataclass(frozen=True)
class Part:
    """One axis of one record.

    Parameters
    ----------
    source : str
    t : ndarray, shape (N,), seconds
        From the first stamp.
    v : ndarray, shape (N,), volts
        As commanded or read.
    y : ndarray, shape (N,), metres
    used : ndarray of bool, shape (N,)
        Samples that are explained; the others (outliers, drop-outs, what came before the memory was known) only move
        the memory.
    seen : ndarray of bool, shape (N,)
        Samples whose displacement is known and asked for.
    wiped : ndarray of bool, shape (N,)
        Samples from where on the initial history no longer matters but for a constant.
    history : tuple of float, volts
        As in `slpi_ros.model.stage_model.Start`.
    others : mapping of axis name to ndarray, shape (N,), metres
        How far the other axes of the record have moved since its start.
    digit : float, metres
        Step between two readings of the sensor; 0 where they are continuous.
    mixed : float
        Share of the readings that are early, late or a mixture of two neighbouring values; they are not used.
    """

    source: str
    t: FloatArray
    v: FloatArray
    y: FloatArray
    used: NDArray[np.bool_]
    seen: NDArray[np.bool_]
    wiped: NDArray[np.bool_]
    history: tuple[float, ...]
    others: Mapping[str, FloatArray]
    digit: float
    mixed: float = 0.0


@dataclass(frozen=True)
class Evidence:
    """What records say about one axis; signals of shape (N,) hold those of all records, one behind the other.

    Parameters
    ----------
    parts : tuple of Part
        One for each record.
    basis : Basis
        Of the hysteresis.
    smoothness : float
    beside : ndarray, shape (N, k), metres
        Columns that stand beside the hysteresis, whatever their gains.
    older_moves : bool
        Whether creep goes on from moves long before a record as well, not only from one just before it.
    """

    parts: tuple[Part, ...]
    basis: Basis
    smoothness: float
    beside: FloatArray = field(default_factory=lambda: np.empty((0, 0)))
    older_moves: bool = False

    def __post_init__(self) -> None:
        """Give `beside` its rows."""
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
    def used(self) -> NDArray[np.bool_]:
        """Samples that are explained, shape (N,)."""
        return np.concatenate([part.used for part in self.parts])

    @cached_property
    def others(self) -> Mapping[str, FloatArray]:
        """Motions of the axes that all records hold, shape (N,), metres."""
        common = set.intersection(*(set(part.others) for part in self.parts))
        return {
            name: np.concatenate([part.others[name] for part in self.parts])
            for name in self.parts[0].others
            if name in common
        }

    @cached_property
    def slices(self) -> tuple[slice, ...]:
        """Where each record's samples stand."""
        ends = np.cumsum([0, *(part.t.size for part in self.parts)]).tolist()
        return tuple(slice(*pair) for pair in zip(ends[:-1], ends[1:], strict=True))

    @cached_property
    def rows(self) -> NDArray[np.int64]:
        """Rows of the problem that are samples, not those of an initial history, shape (N,)."""
        leads = np.cumsum([len(part.history) for part in self.parts])
        rows: NDArray[np.int64] = np.arange(self.t.size) + np.repeat(leads, [part.t.size for part in self.parts])
        return rows

    @cached_property
    def around(self) -> EffectContext:
        """Time and the other axes, as effects look at them."""
        return EffectContext(
            self.t,
            others=self.others,
            records=tuple(EffectContext(part.t, others=part.others, grid=Uniform.over(part.t)) for part in self.parts),
        )

    @cached_property
    def rounding(self) -> float:
        """What rounding to the digits of the sensors adds at least, metres rms."""
        return float(min(part.digit for part in self.parts) / np.sqrt(12.0))

    def each(self, columns: Sequence[FloatArray]) -> FloatArray:
        """Return columns of each record, shape (N_k, m_k) each, as columns that are zero on the other records."""
        whole = np.zeros((self.t.size, sum(own.shape[1] for own in columns)))
        first = 0
        for rows, own in zip(self.slices, columns, strict=True):
            whole[rows, first : first + own.shape[1]] = own
            first += own.shape[1]
        return whole

    def samples(self, u: FloatArray) -> list[Samples]:
        """Return the samples of each record after its initial history, driven by `u`, shape (N,), volts."""
        low, high = self.basis.grid[[0, -1]] if isinstance(self.basis, SurfaceBasis) else (-np.inf, np.inf)
        return [
            Samples(np.clip(u[rows], low, high), part.y, part.used).after(part.history)
            for rows, part in zip(self.slices, self.parts, strict=True)
        ]

    def problem(self, u: FloatArray) -> Problem:
        """Pose the problem of the hysteresis driven by `u`, shape (N,), volts."""
        return Problem.pose(self.samples(u), self.basis)

    def design(self, samples: Sequence[Samples]) -> Design:
        """Return the design matrix of the hysteresis for samples."""
        walks = [Walk.along(own.v, symmetric_rest=self.basis.symmetric_rest, primed=own.primed) for own in samples]
        walk = Walk.joined(walks)
        return Design.of(walk, self.basis.branch_part(walk))

    def of_record(self, k: int) -> "Evidence":
        """Return what one of the records says by itself."""
        return Evidence((self.parts[k],), self.basis, self.smoothness)

    def without_record(self, k: int) -> "Evidence":
        """Return what the other records say."""
        return Evidence((*self.parts[:k], *self.parts[k + 1 :]), self.basis, self.smoothness)


def evidence_of(
    records: Sequence[Record],
    axis: str,
    model: AxisModel | None,
    start: float | None = None,
    stop: float | None = None,
) -> Evidence:
    """Return what records say about one axis, to be explained by a hysteresis like that of `model`, or a loop family.

    Raises
    ------
    RecordError, IdentificationError
        If they say too little.
    """
    read = [_readings(record, axis, start, stop) for record in records]
    _require_enough(read)
    basis = _basis(model, [samples for _, samples, _ in read])
    most = SELECTION_SAMPLES // (2 * len(read))
    thin = [samples.thinned(most) for _, samples, _ in read]
    beginnings = [choose_start(samples, lambda candidate: Problem.pose([candidate], basis)) for samples in thin]
    started = [beginning.of(samples) for beginning, samples in zip(beginnings, thin, strict=True)]
    parts = tuple(
        Part(
            source=record.source,
            t=t,
            v=samples.v,
            y=samples.y,
            used=samples.fitted & ~_at_limit(samples),
            seen=samples.fitted,
            wiped=samples.wiped,
            history=beginning.history,
            others=others,
            digit=digit(samples.y[samples.fitted]),
        )
        for record, (t, samples, others), beginning in zip(records, read, beginnings, strict=True)
    )
    evidence = Evidence(parts, basis, _smoothness(started, basis))
    residual = _residual(evidence)
    trusted = [
        _trusted(part, residual[rows], samples, only_wiped=beginning.only_wiped)
        for part, rows, (_, samples, _), beginning in zip(parts, evidence.slices, read, beginnings, strict=True)
    ]
    return replace(evidence, parts=tuple(trusted))


def _readings(
    record: Record, axis: str, start: float | None, stop: float | None
) -> tuple[FloatArray, Samples, dict[str, FloatArray]]:
    """Return time (s), samples, and the motions of other axes (m) of one record."""
    samples = select_samples(record, axis, start, stop)
    t, others = _clock_and_others(record, axis)
    kept = np.diff(t[: samples.v.size], prepend=-np.inf) > 0.0
    if not np.count_nonzero(kept) > 0.5 * kept.size:
        raise RecordError(
            f"{record.source}: most stamps are equal, so that nothing can be said of time; record the stamps of the "
            "sensor"
        )
    # Of readings with one stamp the first counts: what depends on time cannot say anything of the others.
    chosen = np.flatnonzero(kept)[:MOST_SAMPLES]
    v, y, fitted, mixed = samples.v[chosen], samples.y[chosen], samples.fitted[chosen], samples.mixed * chosen.size
    samples = replace(samples, v=v, y=y, fitted=fitted, mixed=mixed // samples.v.size)
    return t[chosen], samples, {name: y[chosen] for name, y in others.items()}


def _trusted(part: Part, residual: FloatArray, samples: Samples, *, only_wiped: bool) -> Part:
    """Return a record without the samples that what a hysteresis alone leaves of them, shape (N,), shows to be bad."""
    samples = samples.without_mixed(part.y - residual)
    used = part.used & samples.fitted
    used = used & ~_outliers(residual, used)
    if only_wiped or _beginning_disagrees(residual, used, part.wiped):
        used = used & part.wiped
    known = samples.mixed + np.count_nonzero(samples.fitted)
    return replace(part, used=used, seen=samples.fitted, mixed=samples.mixed / known)


def _residual(evidence: Evidence) -> FloatArray:
    """Return what a hysteresis alone leaves, shape (N,), metres."""
    problem = evidence.problem(evidence.v).reweighted()
    matrix, vector = problem.design.normal_equations(problem.y, problem.weights)
    x = solve_free(matrix + problem.penalty(evidence.smoothness, problem.count), vector)
    return (problem.y - problem.design.predict(x))[evidence.rows] * problem.scale


def _at_limit(samples: Samples) -> NDArray[np.bool_]:
    """Return which samples, shape (N,), the sensor read at the end of its range."""
    y, limited = samples.y, np.zeros(samples.y.size, dtype=bool)
    levels, count = np.unique(y[samples.fitted], return_counts=True)
    for end, near in ((0, count[1:4]), (-1, count[-4:-1])):
        if levels.size > AT_LIMIT and count[end] >= max(AT_LIMIT, AT_LIMIT_TIMES * near.max()):
            limited |= y == levels[end]
    return limited


def _beginning_disagrees(residual: FloatArray, used: NDArray[np.bool_], wiped: NDArray[np.bool_]) -> bool:
    """Return whether what came before the memory was wiped is explained much worse than what came after it."""
    before, after = residual[used & ~wiped], residual[used & wiped]
    if not before.size or after.size < ENOUGH_WIPED * (before.size + after.size):
        return False
    return bool(np.sqrt(np.mean(before**2)) > DISAGREES * np.sqrt(np.mean(after**2)))


def _clock_and_others(record: Record, axis: str) -> tuple[FloatArray, dict[str, FloatArray]]:
    """Return time (s) where the axis was driven, and how far other axes with a drive of their own have moved (m)."""
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
    """Return the other axes whose drive no record tells from that of an axis: nor can their motions be told apart."""
    others = [name for name in records[0].axes if name != axis]
    return tuple(
        name
        for name in others
        if all(name not in each.axes or _common(each.voltage[axis], each.voltage[name]) for each in records)
    )


def _common(own: FloatArray, other: FloatArray) -> bool:
    """Return whether two axes have one drive, or the other none: then nothing tells their motions apart."""
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
    """Return the basis of the model's hysteresis, made to hold the voltages of all records."""
    low, high = float(min(part.v.min() for part in samples)), float(max(part.v.max() for part in samples))
    if model is not None and isinstance(model.hysteresis, PrandtlIshlinskii | LoopFamily):
        basis, _ = basis_of(model)
        margin = 1e-6 * (high - low)
        if not isinstance(basis, SurfaceBasis):
            return basis
        if basis.grid[0] - margin <= low and high <= basis.grid[-1] + margin:
            return basis
    return SurfaceBasis(np.linspace(low, high, VERTICES))


def _smoothness(samples: Sequence[Samples], basis: Basis) -> float:
    problem = Problem.pose(samples, basis).reweighted()
    return SMOOTHNESS[int(np.argmin(problem.scores(SMOOTHNESS)))]


def _outliers(residual: FloatArray, used: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return which samples stand alone, shape (N,)."""
    size = np.where(used, np.abs(residual), 0.0)
    beside = np.maximum(np.append(size[1:], 0.0), np.insert(size[:-1], 0, 0.0))
    spread = 1.4826 * float(np.median(size[used]))
    alone: NDArray[np.bool_] = (size > OUTLIER * spread) & (beside < 0.5 * size)
    return alone


def one_speed(evidence: Evidence) -> bool:
    """Return whether all records were driven at one and the same frequency."""
    return drive_frequency(evidence) > 0.0


def drive_frequency(evidence: Evidence) -> float:
    """Return the one frequency (Hz) of the drive of all records; 0 where there are several."""
    found = []
    for part in evidence.parts:
        # The first move and the last one may be cut off.
        duration = Runs.of(part.t, part.v, _dead_band(part.v)).duration[1:-1]
        usual = float(np.median(duration)) if duration.size else 0.0
        if not (usual > 0.0 and np.mean((duration < ALMOST * usual) & (usual < ALMOST * duration)) > MOST_RUNS):
            return 0.0
        found.append(0.5 / usual)
    return float(np.median(found)) if max(found) < ALMOST * min(found) else 0.0


def excited_frequency(evidence: Evidence) -> float:
    """Return the frequency (Hz) below which the fastest record has `EXCITED` of the power of its voltage rate."""
    found = []
    for part in evidence.parts:
        grid = np.arange(part.t[0], part.t[-1], usual_step(part.t))
        rate = np.diff(np.interp(grid, part.t, part.v))
        power = np.cumsum(np.abs(np.fft.rfft(rate * np.hanning(rate.size))) ** 2)
        found.append(np.fft.rfftfreq(rate.size, usual_step(part.t))[np.searchsorted(power, EXCITED * power[-1])])
    return float(max(found))


def _dead_band(v: FloatArray) -> float:
    """Return the reversals (V) of a voltage, shape (N,), that are noise or too small to matter."""
    return max(voltage_dead_band(v), SMALLEST_TURN * float(np.ptp(v)))
