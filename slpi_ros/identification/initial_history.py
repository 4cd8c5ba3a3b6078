"""The initial history of a record: what moved the stage before it began is not known, and must not be judged.

`choose_start` chooses the history for a fit. `match` compares a model with a record that starts from any memory: what
the record makes known decides whether the stage has changed, and the rest says nothing.
"""

import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from slpi_ros.effects.base import Effect
from slpi_ros.effects.chain import loop_middle
from slpi_ros.effects.gain_drift import GainDrift
from slpi_ros.identification.samples import FEWEST, Samples
from slpi_ros.model.axis_model import AxisModel, Start

FloatArray = NDArray[np.float64]

# Turns of the decaying drive that stands for "somewhere in the middle".
MIDDLE_LOOPS = 20
# Another start than rest must explain the record this much better than rest does.
BETTER = 0.9
# The beginning of a record disagrees with the rest when its error is this many times as large.
DISAGREES = 3.0
# What came before the memory was wiped is left out when it makes the rest of the record fit this much worse.
MISLEADING = 1.1


class InitialHistoryWarning(UserWarning):
    """The beginning of a record does not agree with the rest, whatever went before."""


class Fit(Protocol):
    """A fit of the samples it was made for."""

    def reweighted(self) -> "Fit":
        """Return the fit with outliers weighed down."""

    def residual(self) -> FloatArray:
        """Return the error of every sample, fitted or not, shape (N,)."""


def histories(samples: Samples) -> list[tuple[float, ...]]:
    """Return what may have gone before: nothing (rest), a long fall, a long rise, a decaying oscillation.

    Each is a list of voltages (V) as in `slpi_ros.model.stage_model.Start`.
    """
    v0, low, high = float(samples.v[0]), float(samples.v.min()), float(samples.v.max())
    shrink = 1.0 - np.arange(1, MIDDLE_LOOPS) / MIDDLE_LOOPS
    decay = np.column_stack([v0 + (high - v0) * shrink, v0 - (v0 - low) * shrink])
    middle = [low, *decay.ravel().tolist()]
    return [(), (v0,), (low,), tuple(middle)]


@dataclass(frozen=True)
class InitialHistory:
    """What a fit takes for granted about the beginning of a record.

    Parameters
    ----------
    history : tuple of float, volts
        As in `slpi_ros.model.stage_model.Start`.
    only_wiped : bool
        Whether what came before the memory was wiped is left out: no history explains it.
    """

    history: tuple[float, ...]
    only_wiped: bool

    def of(self, samples: Samples) -> Samples:
        """Return the samples to be fitted, with the history before them."""
        return (samples.only(samples.wiped) if self.only_wiped else samples).after(self.history)


def choose_start(samples: Samples, pose: Callable[[Samples], Fit]) -> InitialHistory:
    """Choose the history that explains the record best.

    Parameters
    ----------
    samples : Samples
        From rest.
    pose : callable
        Makes a fit of samples.

    Returns
    -------
    InitialHistory
    """
    wiped = samples.fitted & samples.wiped
    enough = np.count_nonzero(wiped) >= FEWEST and samples.mostly_wiped
    candidates = histories(samples)
    residuals = [_residual(pose(samples.after(history)), samples) for history in candidates]
    rms = [np.sqrt(np.mean(residual[samples.fitted] ** 2)) for residual in residuals]
    best = int(np.argmin(rms))
    if rms[best] > BETTER * rms[0]:
        best = 0
    unseen = not np.any(samples.fitted & ~samples.wiped)
    if unseen:
        best = len(candidates) - 1
    history = candidates[best]
    only_wiped = False
    if enough and not unseen:
        alone = _residual(pose(samples.only(samples.wiped).after(candidates[-1])), samples)
        if np.sqrt(np.mean(residuals[best][wiped] ** 2)) > MISLEADING * np.sqrt(np.mean(alone[wiped] ** 2)):
            only_wiped = True
            history = history or candidates[-1]
    return InitialHistory(history, only_wiped)


def warn_of_rest(samples: Sequence[Samples], beginnings: Sequence[InitialHistory]) -> None:
    """Warn of how many samples are left aside, as no history explains them."""
    pairs = zip(samples, beginnings, strict=True)
    excluded = sum(np.count_nonzero(part.fitted & ~part.wiped) for part, beginning in pairs if beginning.only_wiped)
    if excluded:
        count = sum(np.count_nonzero(part.fitted) for part in samples)
        warnings.warn(
            f"{excluded} of {count} samples are left out: what comes before the voltage has gone over its whole range "
            "does not agree with the rest, whatever went before; `slpi diagnose` tells whether it is something else",
            InitialHistoryWarning,
            stacklevel=3,
        )


def warn_of_initial_history(before: FloatArray, after: FloatArray) -> None:
    """Warn where errors (m) from before the memory was wiped are much larger than those from after it."""
    if before.size and after.size:
        first, rest = (float(np.sqrt(np.mean(errors**2))) * 1e9 for errors in (before, after))
        if first > DISAGREES * rest:
            warnings.warn(
                f"{before.size} of {before.size + after.size} samples, before the voltage has gone over its whole "
                f"range, are off by {first:.3g} nm rms and never left out; the others by {rest:.3g} nm; "
                "`slpi diagnose` tells whether there is something beside the hysteresis",
                InitialHistoryWarning,
                stacklevel=3,
            )


def _residual(fit: Fit, samples: Samples) -> FloatArray:
    """Return the errors of a fit on `samples`, without those of its history."""
    return fit.reweighted().residual()[-samples.v.size :]


# Voltages at which the last move before a record may have begun, as shares of the way to either end, in `match`.
LAST_MOVES = np.linspace(0.0, 1.0, 9)
# Readings of one stretch between two new extremes of the voltage need to be so many to be compared with each other.
FEWEST_OF_STRETCH = 20
# Parts of the record that are left out in turn for the uncertainty of `match`.
PARTS = 10
# A change is one beyond chance if it exceeds this many of its standard deviations.
BEYOND_CHANCE = 4.0
# Errors beyond this many robust standard deviations are outliers.
OUTLIER = 6.0


@dataclass(frozen=True)
class Match:
    """How a model fits a record whose initial history is not known.

    Parameters
    ----------
    start : Start
        The initial history that explains the record best, at the first voltage that reaches the hysteresis, with the
        displacement in the record's own zero.
    offset, offset_uncertainty : float, metres
        By how much the zero of the record lies above that of the model, and by how much no more is known: what an
        unknown history can hide, and the standard deviation.
    gain_change, gain_uncertainty : float
        By which share the record's loops are higher, and its standard deviation.
    width_change, width_uncertainty : float
        By which share they are wider beyond that, and its standard deviation.
    rms : float, metres
        Error of the model on the `known` samples, but for the zero.
    rms_explained : float, metres
        What is left of it beside changes of gain and width, a lag and a linear drift.
    known_from : int
        First sample from which on the initial history does not matter, but for the zero; N if there is none.
    known : ndarray of bool, shape (N,)
        Samples that can be judged: with each other, between two new extremes of the voltage.
    residual : ndarray, shape (N,), metres
        Model minus measurement, free-run from `start`; NaN where not fitted.
    """

    start: Start
    offset: float
    offset_uncertainty: float
    gain_change: float
    gain_uncertainty: float
    width_change: float
    width_uncertainty: float
    rms: float
    rms_explained: float
    known_from: int
    known: NDArray[np.bool_]
    residual: FloatArray

    @property
    def gain_changed(self) -> bool:
        """Whether the gain differs beyond chance."""
        return abs(self.gain_change) > BEYOND_CHANCE * self.gain_uncertainty

    @property
    def width_changed(self) -> bool:
        """Whether the width of the loops differs beyond chance, and beyond what the gain does."""
        return abs(self.width_change) > BEYOND_CHANCE * self.width_uncertainty

    @property
    def zero_moved(self) -> bool:
        """Whether the zero lies elsewhere, whatever the initial history was."""
        return abs(self.offset) > self.offset_uncertainty


def match(axis: AxisModel, samples: Samples, t: FloatArray | None = None) -> Match:
    """Compare a model with a record, whatever moved the stage before.

    Between two new extremes of the voltage the initial history adds nothing but a constant, so that the readings there
    can be compared with each other. After both ends of the model's range were visited the zero is known, too.

    Parameters
    ----------
    axis : AxisModel
        Its effects that belong to one record (drift, hum) are left aside.
    samples : Samples
        The record, without an earlier drive.
    t : ndarray, shape (N,), seconds, optional
        Times of the samples; needed where the model has effects.

    Returns
    -------
    Match
    """
    time = np.arange(float(samples.v.size)) if t is None else t
    axis = replace(axis, effects=lasting_effects(axis))
    starts = _possible_starts(axis, float(samples.v[0]))
    predictions = [replace(axis, start=start).simulate(time, samples.v) for start in starts]
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


def lasting_effects(axis: AxisModel) -> tuple[Effect, ...]:
    """Return the effects of an axis that another record shows too: no drift or hum, and the gain that a drift left."""
    lasting: list[Effect] = []
    for effect in axis.effects:
        if isinstance(effect, GainDrift):
            # From the first moment on what it was at the end.
            lasting.append(replace(effect, times=(1e-9,), gains=effect.gains[-1:], uncertainty={}))
        elif effect.removable != "record":
            lasting.append(effect)
    return tuple(lasting)


def _possible_starts(axis: AxisModel, v: float) -> list[Start]:
    """Return possible states of the memory at the voltage `v` (V), those farthest from each other among them."""
    if not axis.causal:
        return [axis.start, axis.start]
    low, high = axis.voltage_range
    ways = [[low, high, v], [high, low, v]]
    ways += [[low, high, v + share * (low - v), v] for share in LAST_MOVES[1:-1]]
    ways += [[high, low, v + share * (high - v), v] for share in LAST_MOVES[1:-1]]
    shrink = 1.0 - np.arange(MIDDLE_LOOPS + 1) / MIDDLE_LOOPS
    decay = np.column_stack([v + (high - v) * shrink, v + (low - v) * shrink]).ravel()
    ways.append([low, *decay.tolist()])
    starts = [axis.after(np.array(way)) for way in ways]
    # Within the range that was visited a stage that had never been moved is like one whose memory was wiped.
    wiped = [replace(start, from_rest=False) for start in starts]
    return [*wiped, axis.after(np.array([v])), axis.after(np.array([v]), "end")]


def _stretches(v: FloatArray, apart: FloatArray, tolerance: float) -> NDArray[np.int64]:
    """Return the number of the stretch of each sample, shape (N,), in which the initial history adds a constant.

    Parameters
    ----------
    v : ndarray, shape (N,), volts
    apart : ndarray, shape (N,), metres
        By how much the displacements of possible histories differ.
    tolerance : float, metres
        Smaller changes of that do not count.
    """
    extends = np.zeros(v.size, dtype=bool)
    for extreme in (np.maximum.accumulate(v), np.minimum.accumulate(v)):
        extends[1:] |= extreme[1:] != extreme[:-1]
    # Where new extremes change nothing, as the memory is known, the stretch goes on.
    level = np.floor(np.abs(apart - apart[-1]) / tolerance)
    extends &= level > 0
    # Every sample at a new extreme is a stretch of its own, with too few samples to count.
    return np.cumsum(extends | np.append(False, extends[:-1]))


def _inliers(residual: FloatArray, stretch: NDArray[np.int64], counted: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return which samples, shape (N,), do not lie far off their neighbours in the residual (m)."""
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
    axis: AxisModel,
    samples: Samples,
    t: FloatArray,
    predicted: FloatArray,
    stretch: NDArray[np.int64],
    known: NDArray[np.bool_],
) -> tuple[FloatArray, FloatArray, float, float]:
    """Return the changes of gain and width, their standard deviations, and the error before and after them (m)."""
    if np.count_nonzero(known) < FEWEST:
        return np.zeros(2), np.full(2, np.inf), axis.quality.held_out_rms, axis.quality.held_out_rms
    bare = replace(axis, effects=())
    voltages, centre = loop_middle(lambda v: bare.simulate(np.zeros(v.size), v), *axis.voltage_range)
    middle = np.interp(samples.v, voltages, centre)
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
    ridge = 1e-9 * error.size * np.eye(scale.size)
    whole = np.linalg.solve(matrices.sum(axis=0) + ridge, vectors.sum(axis=0))
    left_out = np.array(
        [
            np.linalg.solve(matrices.sum(axis=0) - matrices[k] + ridge, vectors.sum(axis=0) - vectors[k])
            for k in range(PARTS)
        ]
    )
    chance = np.sqrt((PARTS - 1) * np.var(left_out, axis=0))
    # The model itself is not known better than its own error.
    uncertainty = np.hypot(chance, axis.quality.held_out_rms / BEYOND_CHANCE)
    left = float(np.sqrt(np.mean((error - columns @ whole) ** 2)))
    return (whole / scale)[:2], (uncertainty / scale)[:2], float(np.sqrt(np.mean(error**2))), left
