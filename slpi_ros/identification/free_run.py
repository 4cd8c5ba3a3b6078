"""Free run of a model on a record, whose initial state is unknown as the stage has moved before the first sample."""

import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from slpi_ros.arrays import FloatArray, IntArray, Mask
from slpi_ros.errors import length
from slpi_ros.identification.samples import FEWEST, Samples
from slpi_ros.model.axis_model import AxisModel, Start

# Cycles of the decaying oscillation that represents an initial state near the middle of the loop.
MIDDLE_LOOPS = 20
# A history other than rest is chosen if its rms error is below this share of the error from rest.
SMALLER_ERROR = 0.9
# Ratio of the errors before and after the hysteresis state is reset, above which a warning is issued.
DISAGREES = 3.0
# Samples before the reset of the hysteresis state are excluded if they increase the error after it by this factor.
MISLEADING = 1.1


class InitialStateWarning(UserWarning):
    """The first samples of a record do not agree with the rest for any initial state."""


class Fit(Protocol):
    """Fit to samples, as returned by the function `pose` of `choose_start`."""

    def reweighted(self) -> "Fit":
        """Return the fit with reduced weights of outliers."""

    def residual(self) -> FloatArray:
        """Return the error of every sample, fitted or not, shape (N,), model minus measured."""


def histories(samples: Samples) -> list[tuple[float, ...]]:
    """Return the candidate initial states (V): none (rest), a long fall, a long rise, a decaying oscillation."""
    v0, low, high = float(samples.v[0]), float(samples.v.min()), float(samples.v.max())
    shrink = 1.0 - np.arange(1, MIDDLE_LOOPS) / MIDDLE_LOOPS
    decay = np.column_stack([v0 + (high - v0) * shrink, v0 - (v0 - low) * shrink])
    middle = [low, *decay.ravel().tolist()]
    return [(), (v0,), (low,), tuple(middle)]


@dataclass(frozen=True)
class InitialState:
    """Initial `history` (V) that a fit assumes for a record, as in `slpi_ros.model.axis_model.Start`."""

    history: tuple[float, ...]
    only_after_reset: bool  # samples before the reset of the state are excluded: no history explains them

    def of(self, samples: Samples) -> Samples:
        """Return the samples to be fitted, preceded by the voltages of the initial state."""
        return (samples.only(samples.after_reset) if self.only_after_reset else samples).after(self.history)


def choose_start(samples: Samples, pose: Callable[[Samples], Fit]) -> InitialState:
    """Choose the initial state with the lowest error of the fits that `pose` makes to samples without one."""
    after_reset = samples.fitted & samples.after_reset
    enough = np.count_nonzero(after_reset) >= FEWEST and samples.mostly_after_reset
    candidates = histories(samples)
    residuals = [_residual(pose(samples.after(history)), samples) for history in candidates]
    rms = [np.sqrt(np.mean(residual[samples.fitted] ** 2)) for residual in residuals]
    best = int(np.argmin(rms))
    if rms[best] > SMALLER_ERROR * rms[0]:
        best = 0
    unseen = not np.any(samples.fitted & ~samples.after_reset)
    if unseen:
        best = len(candidates) - 1
    history = candidates[best]
    only_after_reset = False
    if enough and not unseen:
        alone = _residual(pose(samples.only(samples.after_reset).after(candidates[-1])), samples)
        if np.sqrt(np.mean(residuals[best][after_reset] ** 2)) > MISLEADING * np.sqrt(np.mean(alone[after_reset] ** 2)):
            only_after_reset = True
            history = history or candidates[-1]
    return InitialState(history, only_after_reset)


def warn_of_rest(samples: Sequence[Samples], beginnings: Sequence[InitialState]) -> None:
    """Issue InitialStateWarning with the number of samples that are excluded because no history explains them."""
    pairs = zip(samples, beginnings, strict=True)
    excluded = sum(
        np.count_nonzero(part.fitted & ~part.after_reset) for part, beginning in pairs if beginning.only_after_reset
    )
    if excluded:
        count = sum(np.count_nonzero(part.fitted) for part in samples)
        warnings.warn(
            f"{excluded} of {count} samples are left out: before the voltage has gone over its whole range, they agree "
            "with the rest for no initial state; `slpi diagnose` tests for other causes",
            InitialStateWarning,
            stacklevel=3,
        )


def warn_of_initial_history(before: FloatArray, after: FloatArray) -> None:
    """Warn if the errors (m) before the reset of the hysteresis state are much larger than those after it."""
    if before.size and after.size:
        first, rest = (float(np.sqrt(np.mean(errors**2))) for errors in (before, after))
        if first > DISAGREES * rest:
            warnings.warn(
                f"{before.size} of {before.size + after.size} samples, before the voltage has gone over its whole "
                f"range, have an error of {length(first)} rms, the others {length(rest)}; the former do not count in "
                "the held-out error; `slpi diagnose` tests for effects other than hysteresis",
                InitialStateWarning,
                stacklevel=3,
            )


def _residual(fit: Fit, samples: Samples) -> FloatArray:
    """Return the errors of a fit on `samples`, shape (N,), without those of the initial state."""
    return fit.reweighted().residual()[-samples.v.size :]


# An initial state is possible up to this multiple of the lowest error.
AS_WELL = 1.1


@dataclass(frozen=True)
class FreeRun:
    """Free run of a model on a record from the initial state with the lowest error."""

    rms: float  # m, without the mean
    offsets: tuple[float, float]  # m, extremes over all possible initial states of the median of measured - model

    @property
    def offset(self) -> float:
        """Offset with the smallest magnitude, metres."""
        return min(self.offsets, key=abs)

    @property
    def moved(self) -> float:
        """Shift of the zero (m) that remains for every possible initial state; 0 if one of them can explain it."""
        return 0.0 if self.offsets[0] <= 0.0 <= self.offsets[1] else self.offset


def free_run(
    axis: AxisModel,
    t: FloatArray,
    v: FloatArray,
    y: FloatArray,
    used: Mask,
    known: Mask,
    starts: Sequence[Start],
    *,
    others: Mapping[str, FloatArray],
    of_record: bool,
) -> FreeRun:
    """Return the best free run of a model from the initial states `starts` over a record, shape (N,), s, V and m."""
    # The error is that of the samples `used`, the offset that of those `known`: the state only adds a constant to them.
    errors = [y - replace(axis, start=start).simulate(t, v, others, of_record=of_record) for start in starts]
    spread = [float(np.std(error[known])) for error in errors]
    as_well = [error for error, own in zip(errors, spread, strict=True) if own <= AS_WELL * min(spread)]
    offsets = [float(np.median(error[known])) for error in as_well]
    return FreeRun(min(float(np.std(error[used])) for error in errors), (min(offsets), max(offsets)))


def rms_of(runs: Sequence[FreeRun]) -> float:
    """Return the rms (m) of the errors of several free runs, each without its mean."""
    return float(np.sqrt(np.mean([run.rms**2 for run in runs])))


def likely_starts(axis: AxisModel, v: float, *others: tuple[float, ...]) -> list[Start]:
    """Return the initial states at the voltage `v` (V) for the usual histories and `others`."""
    # Their displacements are such that after a sweep over the whole range all are alike.
    if not axis.causal:
        return [axis.start]
    low, high = axis.hysteresis_range
    # A saturation keeps the hysteresis within its limits.
    v = min(max(v, axis.chain.clipped[0]), axis.chain.clipped[1])
    ends = np.array([min(low, v), max(high, v)])
    usual = histories(Samples(np.append(v, ends), np.zeros(3), np.ones(3, dtype=bool)))
    swept = axis.memory("start").forward_array(ends)[-1]
    found = [axis.start] if axis.start.voltage == v else []
    for history in dict.fromkeys((*others, axis.start.history, *usual)):
        way = replace(axis, start=Start(v, 0.0, history)).memory("start").forward_array(ends)[-1]
        found.append(Start(v, float(swept - way), history))
    return found


# Share of a range within which a voltage is at its end.
AT_END = 0.005
# In `match`: candidate start voltages of the last move before a record, as shares of the distance to either end.
LAST_MOVES = np.linspace(0.0, 1.0, 9)
# Fewest samples of a stretch (between two new extremes of the voltage) that is used in the comparison.
FEWEST_OF_STRETCH = 20
# Number of parts of the record for the jackknife uncertainty of `match`.
PARTS = 10
# A change is significant if it exceeds this many of its standard deviations.
BEYOND_CHANCE = 4.0
# Errors beyond this many robust standard deviations are outliers.
OUTLIER = 6.0
# Number of voltages at which the largest loop is computed.
LEVELS = 201
# Steps in which effects that act at a displacement are put where the zero of a record is.
ALIGNMENTS = 3


@dataclass(frozen=True)
class Match:
    """Comparison of a model with a record of unknown initial state."""

    axis: AxisModel  # the model, with what acts at a displacement where the zero of the record puts it
    start: Start  # with the lowest error; its displacement includes the offset of the record
    begun: float  # m, its displacement without the offset that is left
    offset: float  # m, zero of the record minus that of the model
    offset_uncertainty: float  # m, half the range of unknown histories plus `BEYOND_CHANCE` standard deviations
    gain_change: float  # relative, of the loop height
    gain_uncertainty: float  # standard deviation
    width_change: float  # relative, of the loop width in addition
    width_uncertainty: float  # standard deviation
    rms: float  # m, of the `known` samples, without the offset
    rms_explained: float  # m, after a fit of gain, width, lag and linear drift
    known_from: int  # first sample after which the history affects only the offset; N: none
    known: Mask  # (N,), fitted, no outliers, in stretches long enough for a comparison
    residual: FloatArray  # m, (N,), model minus measured, free-run from `start`; NaN where not fitted

    @property
    def gain_changed(self) -> bool:
        """Whether the change of gain is significant."""
        return abs(self.gain_change) > BEYOND_CHANCE * self.gain_uncertainty

    @property
    def width_changed(self) -> bool:
        """Whether the change of loop width, in addition to that of gain, is significant."""
        return abs(self.width_change) > BEYOND_CHANCE * self.width_uncertainty

    @property
    def zero_moved(self) -> bool:
        """Whether the zero has moved by more than the initial state and the uncertainty explain."""
        return abs(self.offset) > self.offset_uncertainty


def match(axis: AxisModel, samples: Samples, t: FloatArray | None = None, start: Start | None = None) -> Match:
    """Compare a model, from voltage to displacement of the stage, with a record of unknown initial state."""
    found, moved = _match(axis, samples, t, start), 0.0
    # What acts at a displacement, such as a contact, moves with the zero.
    for _ in range(ALIGNMENTS if any(effect.shifted(1.0) != effect for effect in axis.effects) else 0):
        by = float(found.start.displacement - found.begun)
        moved += by
        start = start and replace(start, displacement=start.displacement + by)
        found = _match(axis.shifted(moved), samples, t, start)
    return replace(found, offset=moved + found.offset)


def _match(axis: AxisModel, samples: Samples, t: FloatArray | None, start: Start | None) -> Match:
    # While the voltage stays within the range visited so far, the unknown initial state adds only a constant, so the
    # samples of such a stretch can be compared with each other. Once both ends of the model's voltage range have been
    # visited, the offset is known as well. `t` (s, (N,)) is needed only with effects.
    time = np.arange(float(samples.v.size)) if t is None else t
    starts = [start] if start else _possible_starts(axis, float(samples.v[0]))
    predictions = [replace(axis, start=one).simulate(time, samples.v) for one in starts]
    fitted = samples.fitted
    errors = [prediction[fitted] - samples.y[fitted] for prediction in predictions]
    best = int(np.argmin([_mean_size(error - np.median(error)) for error in errors]))
    predicted = predictions[best]
    apart = np.ptp(predictions, axis=0)
    tolerance = max(0.5 * axis.quality.floor_rms, 1e-4 * float(np.ptp(axis.displacement_range)))
    unlike = np.flatnonzero(np.abs(apart - apart[-1]) > tolerance)
    known_from = int(unlike[-1]) + 1 if unlike.size else 0
    stretch = _stretches(samples.v, apart, tolerance)
    residual = np.where(fitted, predicted - samples.y, np.nan)
    counted = fitted & (np.bincount(stretch, fitted)[stretch] >= FEWEST_OF_STRETCH)
    known = counted & _inliers(residual, stretch, counted)
    changes, uncertainty, rms, rms_explained = _changes(axis, samples, time, predicted, stretch, known)
    last = known & (stretch == stretch[known][-1]) if known.any() else fitted
    levels = np.mean(np.array(predictions)[:, last], axis=1)
    middle = float(levels[best] - (levels.min() + levels.max()) / 2)
    zero = float(-np.median(residual[last]))
    spread = float(np.ptp(levels)) / 2
    return Match(
        axis=axis,
        begun=starts[best].displacement,
        start=replace(starts[best], displacement=starts[best].displacement + zero),
        offset=zero + middle,
        offset_uncertainty=spread + BEYOND_CHANCE * max(axis.quality.held_out_rms, rms_explained),
        gain_change=changes[0],
        gain_uncertainty=uncertainty[0],
        width_change=changes[1],
        width_uncertainty=uncertainty[1],
        rms=rms,
        rms_explained=rms_explained,
        known_from=known_from,
        known=known,
        residual=residual + zero,
    )


def starts_at_end(axis: AxisModel, v: float) -> list[Start]:
    """Return the states at an end of the model's voltage range if `v` (V) is one, else none."""
    # There a stage has lost its memory of the range, unless it has never moved, as before the record of the model.
    low, high = axis.voltage_range
    near = AT_END * (high - low)
    if not axis.causal or low + near < v < high - near:
        return []
    ends = [low, high, v] if v >= high - near else [high, low, v]
    rest = [axis.start] if not axis.start.history and abs(axis.start.voltage - v) <= near else []
    return [replace(axis.after(np.clip(ends, *axis.hysteresis_range)), from_rest=False), *rest]


def ways_to(low: float, high: float, v: float) -> list[tuple[float, ...]]:
    """Return the voltages (V) before `v` (V) that lead to the possible states there, in a range from `low` to `high`.

    The first two come from an end of the range, from above and from below, others have turned once more; the last is a
    decaying oscillation.
    """
    ways: list[tuple[float, ...]] = [(low, high), (high, low)]
    ways += [(low, high, v + share * (low - v)) for share in LAST_MOVES[1:-1]]
    ways += [(high, low, v + share * (high - v)) for share in LAST_MOVES[1:-1]]
    shrink = 1.0 - np.arange(MIDDLE_LOOPS) / MIDDLE_LOOPS
    decay = np.column_stack([v + (high - v) * shrink, v + (low - v) * shrink]).ravel()
    return [*ways, (low, *decay.tolist())]


def largest_loop(axis: AxisModel, low: float, high: float) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return voltages from `low` to `high` (V) and the displacements (m) there, rising and falling, (LEVELS,) each."""
    rise = np.linspace(low, high, LEVELS)
    loop = np.concatenate([rise[-1:], rise, rise[::-1]])
    _, rising, falling = np.split(axis.hysteresis_only.simulate(np.zeros(loop.size), loop), [1, 1 + rise.size])
    return rise, rising, falling[::-1]


def _possible_starts(axis: AxisModel, v: float) -> list[Start]:
    """Return possible hysteresis states at the voltage `v` (V), including the two extreme states."""
    if not axis.causal:
        return [axis.start, axis.start]
    starts = [axis.after(np.array([*way, v])) for way in ways_to(*axis.hysteresis_range, v)]
    # Within the visited range, a stage at rest behaves like one whose hysteresis state was reset.
    after_reset = [replace(start, from_rest=False) for start in starts]
    return [*after_reset, axis.after(np.array([v])), axis.after(np.array([v]), "end")]


def _stretches(v: FloatArray, apart: FloatArray, tolerance: float) -> IntArray:
    """Return the stretch number of each sample, shape (N,); in a stretch the initial state adds only a constant."""
    # `apart` (m, (N,)) is the range of the displacements over all histories; changes below `tolerance` are ignored.
    extends = np.zeros(v.size, dtype=bool)
    for extreme in (np.maximum.accumulate(v), np.minimum.accumulate(v)):
        extends[1:] |= extreme[1:] != extreme[:-1]
    # Once the hysteresis state is known, new extremes do not start a new stretch.
    level = np.floor(np.abs(apart - apart[-1]) / tolerance)
    extends &= level > 0
    # Every sample at a new extreme forms a separate stretch, too short to be compared.
    return np.cumsum(extends | np.append(False, extends[:-1]))


def _inliers(residual: FloatArray, stretch: IntArray, counted: Mask) -> Mask:
    """Return the mask, shape (N,), of the counted samples whose residual (m) is close to that of their neighbours."""
    inside = np.zeros(residual.size, dtype=bool)
    at = np.flatnonzero(counted)
    if at.size < FEWEST:
        return counted
    off = residual[at] - np.convolve(np.pad(residual[at], 2, mode="edge"), np.full(5, 0.2), mode="valid")
    inside[at] = np.abs(off) <= OUTLIER * max(1.4826 * float(np.median(np.abs(off))), 1e-300)
    return inside


def _mean_size(error: FloatArray) -> float:
    return float(np.mean(np.abs(error)))


def _changes(
    axis: AxisModel, samples: Samples, t: FloatArray, predicted: FloatArray, stretch: IntArray, known: Mask
) -> tuple[FloatArray, FloatArray, float, float]:
    """Return changes of gain and width, their standard deviations, and the rms errors (m) before and after the fit."""
    if np.count_nonzero(known) < FEWEST:
        return np.zeros(2), np.full(2, np.inf), axis.quality.held_out_rms, axis.quality.held_out_rms
    # Mid-line of the largest loop: the mean of its rising and its falling branch.
    levels, rising, falling = largest_loop(axis, *axis.voltage_range)
    middle = np.interp(samples.v, levels, (rising + falling) / 2)
    # A lag or delay, and a slow drift, change neither gain nor width.
    speed = np.gradient(predicted, np.maximum.accumulate(t + 1e-9 * np.arange(t.size)))
    columns = np.column_stack([predicted, predicted - middle, speed, t])[known]
    _, group = np.unique(stretch[known], return_inverse=True)

    def centred(x: FloatArray, counts: FloatArray) -> FloatArray:
        means = (
            np.column_stack([np.bincount(group, column * (counts > 0)) for column in x.T])
            / np.maximum(np.bincount(group, counts), 1.0)[:, None]
        )
        return x - means[group]

    everywhere = np.ones(group.size)
    columns = centred(columns, everywhere)
    error = centred((samples.y - predicted)[known][:, None], everywhere)[:, 0]
    scale = np.sqrt(np.mean(columns**2, axis=0))
    scale[scale == 0.0] = 1.0
    columns = columns / scale
    part = np.arange(error.size) * PARTS // error.size
    matrices = np.array([columns[part == k].T @ columns[part == k] for k in range(PARTS)])
    vectors = np.array([columns[part == k].T @ error[part == k] for k in range(PARTS)])
    own_error, rest = axis.quality.held_out_rms, np.array([0, 2, 3])
    both = _solved(matrices, vectors, own_error, error.size)
    alone = _solved(matrices[:, rest][:, :, rest], vectors[:, rest], own_error, error.size)
    changes, uncertainty = both[0] / scale, both[1] / scale
    if abs(changes[1]) <= BEYOND_CHANCE * uncertainty[1]:
        # Small loops hardly separate gain from width: without a significant change of width, fit the gain alone.
        changes[0], uncertainty[0] = alone[0][0] / scale[0], alone[1][0] / scale[0]
    left = float(np.sqrt(np.mean((error - columns @ both[0]) ** 2)))
    return changes[:2], uncertainty[:2], float(np.sqrt(np.mean(error**2))), left


def _solved(matrices: FloatArray, vectors: FloatArray, own_error: float, count: int) -> tuple[FloatArray, FloatArray]:
    """Solve the sum of the normal equations of all parts; return solution and standard deviations (jackknife)."""
    # Columns have a mean square of 1; `own_error` (m) is the held-out error of the model.
    ridge = 1e-9 * count * np.eye(matrices.shape[1])
    matrix, vector = matrices.sum(axis=0) + ridge, vectors.sum(axis=0)
    whole = np.linalg.solve(matrix, vector)
    left_out = [np.linalg.solve(matrix - own, vector - part) for own, part in zip(matrices, vectors, strict=True)]
    chance = np.sqrt((PARTS - 1) * np.var(left_out, axis=0))
    # The model's own error limits the accuracy; collinear columns share that error in any proportion.
    alike = np.sqrt(np.diag(np.linalg.inv(matrix / count)))
    return whole, np.hypot(chance, alike * own_error / BEYOND_CHANCE)
