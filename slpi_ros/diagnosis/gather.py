"""From a record and a model to what one axis's explanation is fitted to."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from slpi_ros.diagnosis.evidence import Evidence
from slpi_ros.diagnosis.explanation import Explanation
from slpi_ros.errors import RecordError
from slpi_ros.hysteresis.loop_family import LoopFamily
from slpi_ros.hysteresis.prandtl_ishlinskii import PrandtlIshlinskii
from slpi_ros.identification.bases import Basis, SurfaceBasis
from slpi_ros.identification.convex_fit import SELECTION_SAMPLES, SMOOTHNESS
from slpi_ros.identification.drive import Runs
from slpi_ros.identification.initial_history import choose_start
from slpi_ros.identification.least_squares import Problem
from slpi_ros.identification.published_kinds import voltage_dead_band
from slpi_ros.identification.refit import basis_of
from slpi_ros.identification.samples import Samples, select_samples
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
# A sample this many robust standard deviations off, while its neighbours are not half as far, is an outlier.
OUTLIER = 10.0
# Of a longer record so many samples in a row are looked at: effects are told apart by what happens between samples, so
# that none may be left out.
MOST_SAMPLES = 200_000


def evidence_of(
    record: Record, axis: str, model: AxisModel | None, start: float | None = None, stop: float | None = None
) -> Evidence:
    """Return what a record says about one axis, to be explained by a hysteresis like that of `model`, or a loop family.

    Raises
    ------
    RecordError, IdentificationError
        If it says too little.
    """
    samples = select_samples(record, axis, start, stop)
    t, others = _clock_and_others(record, axis)
    t, others = t[: samples.v.size], {name: y[: samples.v.size] for name, y in others.items()}
    later = np.diff(t, prepend=-np.inf) > 0.0
    if np.count_nonzero(later) > 0.5 * t.size and not later.all():
        # Of readings with one stamp the first counts: what depends on time cannot say anything of the others.
        samples = Samples(samples.v[later], samples.y[later], samples.fitted[later])
        t, others = t[later], {name: y[later] for name, y in others.items()}
    if samples.v.size > MOST_SAMPLES:
        samples = Samples(samples.v[:MOST_SAMPLES], samples.y[:MOST_SAMPLES], samples.fitted[:MOST_SAMPLES])
        t, others = t[:MOST_SAMPLES], {name: y[:MOST_SAMPLES] for name, y in others.items()}
    _require_enough(t, samples)
    basis = _basis(model, samples)
    thin = samples.thinned(SELECTION_SAMPLES // 2)
    beginning = choose_start(thin, lambda candidate: Problem.pose([candidate], basis))
    smoothness = _smoothness(beginning.of(thin), basis)
    evidence = Evidence(t, samples.v, samples.y, samples.fitted, beginning.history, basis, smoothness, others)
    residual = Explanation(evidence).residual
    used = samples.fitted & ~_outliers(residual, samples.fitted)
    if beginning.only_wiped or _beginning_disagrees(residual, used, samples.wiped):
        used = used & samples.wiped
    return replace(evidence, used=used, seen=samples.fitted)


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


def driven_alike(record: Record, axis: str) -> tuple[str, ...]:
    """Return the other axes whose drive cannot be told from that of an axis: nor can their motions."""
    own = record.voltage[axis]
    return tuple(name for name in record.axes if name != axis and _common(own, record.voltage[name]))


def _common(own: FloatArray, other: FloatArray) -> bool:
    """Return whether two axes have one drive, or the other none: then nothing tells their motions apart."""
    both = np.isfinite(own) & np.isfinite(other)
    if np.count_nonzero(both) < 2 or not np.ptp(other[both]) > 0.0 or not np.ptp(own[both]) > 0.0:
        return False
    return bool(abs(np.corrcoef(own[both], other[both])[0, 1]) > ONE_DRIVE)


def _require_enough(t: FloatArray, samples: Samples) -> None:
    if not np.median(np.diff(t)) > 0.0:
        raise RecordError("most stamps are equal, so that nothing can be said of time; record the stamps of the sensor")
    count = int(np.count_nonzero(samples.fitted))
    if count < FEWEST_SAMPLES:
        raise RecordError(
            f"{count} usable samples are too few to leave some out and judge by them; record {FEWEST_SAMPLES} or more"
        )
    turns = Runs.of(np.arange(float(samples.v.size)), samples.v, _dead_band(samples.v)).turns
    if turns < FEWEST_TURNS:
        raise RecordError(
            f"the voltage turns {turns} times: one loop only, and nothing to judge it by; record several loops of "
            "different size and speed, for example the drive of slpi excite"
        )


def _basis(model: AxisModel | None, samples: Samples) -> Basis:
    """Return the basis of the model's hysteresis, made to hold the record's voltages."""
    low, high = float(samples.v.min()), float(samples.v.max())
    if model is not None and isinstance(model.hysteresis, PrandtlIshlinskii | LoopFamily):
        basis, _ = basis_of(model)
        margin = 1e-6 * (high - low)
        if not isinstance(basis, SurfaceBasis):
            return basis
        if basis.grid[0] - margin <= low and high <= basis.grid[-1] + margin:
            return basis
    return SurfaceBasis(np.linspace(low, high, VERTICES))


def _smoothness(samples: Samples, basis: Basis) -> float:
    problem = Problem.pose([samples], basis).reweighted()
    return SMOOTHNESS[int(np.argmin(problem.scores(SMOOTHNESS)))]


def _outliers(residual: FloatArray, used: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return which samples stand alone, shape (N,)."""
    size = np.where(used, np.abs(residual), 0.0)
    beside = np.maximum(np.append(size[1:], 0.0), np.insert(size[:-1], 0, 0.0))
    spread = 1.4826 * float(np.median(size[used]))
    alone: NDArray[np.bool_] = (size > OUTLIER * spread) & (beside < 0.5 * size)
    return alone


def one_speed(evidence: Evidence) -> bool:
    """Return whether the record was driven at one frequency."""
    # The first move and the last one may be cut off.
    duration = Runs.of(evidence.t, evidence.v, _dead_band(evidence.v)).duration[1:-1]
    usual = float(np.median(duration))
    return bool(np.mean((duration < ALMOST * usual) & (usual < ALMOST * duration)) > MOST_RUNS)


def _dead_band(v: FloatArray) -> float:
    """Return the reversals (V) of a voltage, shape (N,), that are noise or too small to matter."""
    return max(voltage_dead_band(v), SMALLEST_TURN * float(np.ptp(v)))
