"""How an effect looks for itself in what a model leaves: forms of it, linear in a few gains, for a fit to judge."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import scipy.fft
from numpy.typing import NDArray

from slpi_ros.effects.effect import Around, Effect, FloatArray

# Neighbours of a spectrum's peak that belong to it, on either side.
LINE_WIDTH = 12


@dataclass(frozen=True)
class Form:
    """One form of an effect.

    Parameters
    ----------
    columns : ndarray, shape (N, k), metres
        What it would add, linear in k gains.
    effect : callable
        Returns the effect for gains of shape (k,), or None where they make none.
    positive : int
        Number of the last columns whose gains may not be negative; `effect` is given those alone, if there are any.
    """

    columns: FloatArray
    effect: Callable[[FloatArray], Effect | None]
    positive: int = 0


class Left(Protocol):
    """A hysteresis with the effects found so far, and what they leave of a record of N samples."""

    @property
    def t(self) -> FloatArray:
        """Time, shape (N,), seconds."""

    @property
    def u(self) -> FloatArray:
        """Voltage that drives the hysteresis, shape (N,), volts."""

    @property
    def h(self) -> FloatArray:
        """Displacement of the hysteresis, shape (N,), metres."""

    @property
    def y(self) -> FloatArray:
        """Measured displacement, shape (N,), metres."""

    @property
    def used(self) -> NDArray[np.bool_]:
        """Samples that count, shape (N,)."""

    @property
    def residual(self) -> FloatArray:
        """What is left of the measured displacement, shape (N,), metres."""

    @property
    def others(self) -> Mapping[str, FloatArray]:
        """Motion of the other axes from their start, shape (N,), metres."""

    @property
    def around(self) -> Around:
        """What effects may look at."""

    def respond(self, u: FloatArray) -> FloatArray:
        """Return the displacement of the hysteresis, shape (N,), metres, for another voltage."""


def usual_step(t: FloatArray) -> float:
    """Return the median time (s) from one sample to the next."""
    return float(np.median(np.diff(t)))


def wave(phase: FloatArray) -> FloatArray:
    """Return the two columns, shape (N, 2), whose sum is any sine of that phase (rad); see `amplitude_and_phase`."""
    return np.column_stack([np.sin(phase), np.cos(phase)])


def amplitude_and_phase(gains: FloatArray) -> tuple[float, float]:
    """Return amplitude and phase (rad) of the sine that two gains of `wave` make."""
    return float(np.hypot(gains[0], gains[1])), float(np.arctan2(gains[1], gains[0]))


def strongest_lines(
    power: FloatArray, at: NDArray[np.floating[Any]], count: int, width: int = LINE_WIDTH
) -> list[float]:
    """Return where (as `at`, shape (n,)) a spectrum, shape (n,), is highest, strongest first."""
    power, found = power.copy(), []
    for _ in range(count):
        k = int(np.argmax(power))
        if not power[k] > 0:
            break
        found.append(float(at[k]))
        power[max(0, k - width) : k + width + 1] = 0.0
    return found


def rhythms(left: Left, count: int, lowest: float) -> list[float]:
    """Return the frequencies (Hz), from `lowest` on, that are strongest in what is left."""
    dt = usual_step(left.t)
    grid = np.arange(left.t[0], left.t[-1], dt)
    even = np.interp(grid, left.t, np.where(left.used, left.residual, 0.0)) * np.hanning(grid.size)
    size = 4 * scipy.fft.next_fast_len(grid.size)
    frequency = np.fft.rfftfreq(size, dt)
    power = np.where(frequency >= lowest, np.abs(np.fft.rfft(even, size)) ** 2, 0.0)
    return strongest_lines(power, frequency, count)
