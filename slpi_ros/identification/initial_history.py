"""What moved the stage before the record began? Nobody knows; the record tells which assumption explains it best."""

import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from slpi_ros.identification.samples import FEWEST, Samples

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
    Beginning
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
