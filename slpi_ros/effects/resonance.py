"""Resonance: a lightly damped flexure mode that is excited by every reversal."""

from collections import deque
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import partial
from math import pi
from typing import ClassVar

import numpy as np

from slpi_ros.effects.base import (
    Candidate,
    EffectBase,
    EffectContext,
    FloatArray,
    ResidualView,
    Side,
    Signal,
    StreamingBase,
    by_record,
    require,
    rhythms,
    usual_step,
)
from slpi_ros.effects.filters import Mode, filtered

# Smallest tap spacing, in units of 1 / w; smaller spacings give larger taps without benefit.
SPACING = 0.5
# Largest tap spacing, in units of 1 / w; larger spacings cannot cancel the oscillation.
WIDEST = 3.0


@dataclass(frozen=True)
class Unringing:
    """Finite-impulse-response inverse of a mode, ``sum_k taps[k] y(t + preview - k spacing)``.

    Parameters
    ----------
    taps : tuple of float
        Taps with sum 1: their zeros are at the poles of the mode, and one more zero compensates the remaining delay.
    spacing : float, seconds
    """

    taps: tuple[float, ...]
    spacing: float

    @staticmethod
    def shortest(mode: Mode) -> float:
        """Return the smallest useful spacing, seconds."""
        return SPACING / mode.omega

    @classmethod
    def of(cls, mode: Mode, spacing: float, preview: float = 0.0) -> "Unringing":
        """Return the taps for a spacing (s), if the desired displacement is known a `preview` (s) in advance."""
        zeros = (1.0, 0.0, 0.0)
        if spacing * mode.omega < WIDEST:
            total, product = mode.ringing(spacing)
            zeros = (1 / (1 - total + product), -total / (1 - total + product), product / (1 - total + product))
        delay = mode.lag / spacing + zeros[1] + 2 * zeros[2] - preview / spacing
        a, b, c = zeros
        return cls(
            (a * (1 + delay), b * (1 + delay) - a * delay, c * (1 + delay) - b * delay, -c * delay),
            spacing,
        )


class StreamingResonance(StreamingBase):
    """Streaming (sample by sample) second-order mode."""

    def __init__(self, mode: Mode) -> None:
        self._mode = mode
        self._dt, self._free = 0.0, mode.free(0.0)
        self._shortest = self._unringing = Unringing.of(mode, Unringing.shortest(mode))
        self.start(0.0)

    def start(self, x: float) -> None:
        """Initialise to equilibrium at `x` (m)."""
        self._input = self._position = x
        self._velocity = 0.0
        self._asked: float | None = None
        # Age (s) and value (m) of the stored desired displacements, newest last; constant before the oldest.
        self._desired: deque[tuple[float, float]] = deque([(0.0, x)])
        self._now = 0.0

    def forward(self, dt: float, x: float) -> float:
        """Advance by `dt` (s) to the input `x` (m) and return the position of the stage (m)."""
        if dt > 0.0:
            if dt != self._dt:
                self._dt, self._free = dt, self._mode.free(dt)
            m11, m12, m21, m22 = self._free
            slope = (x - self._input) / dt
            behind = self._mode.lag * slope
            position, velocity = self._position - self._input + behind, self._velocity - slope
            self._position = x - behind + m11 * position + m12 * velocity
            self._velocity = slope + m21 * position + m22 * velocity
        self._input = x
        self._remember(dt)
        return self._position

    def inverse(self, dt: float, wanted: float) -> float:
        """Return the input (m) for the desired position `wanted` (m)."""
        self._asked = wanted
        if max(dt, self._shortest.spacing) != self._unringing.spacing:
            self._unringing = Unringing.of(self._mode, dt) if dt > self._shortest.spacing else self._shortest
        taps, spacing = self._unringing.taps, self._unringing.spacing
        later, value, at = self._now + dt, wanted, self._now + dt - spacing
        needed, k = taps[0] * wanted, 1
        # From the newest sample to the oldest, with linear interpolation.
        for earlier, before in reversed(self._desired):
            while at >= earlier:
                share = (at - earlier) / (later - earlier) if later > earlier else 0.0
                needed += taps[k] * (before + (value - before) * share)
                k += 1
                if k == len(taps):
                    return needed
                at -= spacing
            later, value = earlier, before
        return needed + sum(taps[k:]) * value

    def snapshot(self) -> tuple[float | tuple[float, ...], ...]:
        """Return input, position, velocity, and the desired displacements by age."""
        ages = tuple(self._now - t for t, _ in self._desired)
        return self._input, self._position, self._velocity, ages, tuple(y for _, y in self._desired)

    def restore(self, state: tuple[float | tuple[float, ...], ...]) -> None:
        """Replace the state by one returned by `snapshot`."""
        self._input, self._position, self._velocity, ages, desired = state  # type: ignore[assignment]
        self._now = 0.0
        self._desired = deque((-age, y) for age, y in zip(ages, desired, strict=True))  # type: ignore[arg-type]
        self._asked = None

    def _remember(self, dt: float) -> None:
        """Store the last desired displacement (the position if none was given) and drop those older than all taps."""
        self._now += dt
        desired = self._desired
        if dt <= 0.0:
            desired.pop()
        desired.append((self._now, self._position if self._asked is None else self._asked))
        self._asked = None
        oldest = self._now - 4 * max(self._shortest.spacing, dt)
        while len(desired) > 2 and desired[1][0] <= oldest:
            desired.popleft()


# Modes of the candidates: lowest frequency (Hz), highest as share of the sampling rate, number of spectral peaks.
LOWEST, HIGHEST, LINES = 10.0, 0.45, 4
DAMPINGS = (0.02, 0.08)


@dataclass(frozen=True)
class Resonance(EffectBase):
    """A second-order mode, ``y'' + 2 z w y' + w^2 y = w^2 h``, ``w = 2 pi frequency``.

    The exact inverse of the sampled mode is unstable. This inverse has zeros at the poles of the mode, which cancels
    the oscillation after reversals; it follows ramps without error and is bounded, as a finite sum of past setpoints.

    Parameters
    ----------
    frequency : float, hertz
        Undamped natural frequency.
    damping : float
        Damping ratio ``z``, from above 0 to below 1.
    uncertainty : mapping of parameter name to standard deviation, optional
    """

    name: ClassVar[str] = "resonance"
    acts_on: ClassVar[Signal] = "displacement"
    side: ClassVar[Side] = "stage"

    frequency: float
    damping: float
    uncertainty: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Validate the parameters."""
        require(
            self,
            ("frequency", 1e-3 <= self.frequency <= 1e7, "from 0.001 to 1e7 Hz"),
            ("damping", 1e-6 <= self.damping < 1, "from 1e-6 to below 1"),
        )

    @by_record
    def apply(self, signal: FloatArray, around: EffectContext) -> FloatArray:
        """Return the displacement with the resonance, shape (N,), metres; exact for an input linear between samples."""
        grid = around.uniform
        if not grid.dt:
            return np.full_like(signal, signal[0]) if signal.size else signal.copy()
        numerator, denominator = self.mode.transfer(grid.dt)
        moved = grid.on(signal)
        return grid.off(moved[0] + filtered(numerator, denominator, moved - moved[0]))

    def invert(self, signal: FloatArray, around: EffectContext) -> FloatArray:
        """Return the input of the mode, shape (N,), metres, for the displacement `signal`, shape (N,), metres."""
        grid = around.uniform
        if not grid.dt:
            return signal.copy()
        between = max(1, round(Unringing.shortest(self.mode) / grid.dt))
        taps = Unringing.of(self.mode, between * grid.dt, preview=between * grid.dt).taps
        desired, left = grid.on(signal), (len(taps) - 2) * between
        padded = np.pad(desired, (left, 0), mode="edge")
        # The path is extrapolated by reflection at its end.
        padded = np.pad(padded, (0, between), mode="reflect", reflect_type="odd")
        parts = (tap * padded[left + (1 - k) * between :][: desired.size] for k, tap in enumerate(taps))
        return grid.off(sum(parts, np.zeros_like(desired)))

    @classmethod
    def fit(cls, left: ResidualView) -> Iterator[Candidate]:
        """Yield modes at the strongest frequencies of the residual, and on a logarithmic grid."""
        highest = HIGHEST / usual_step(left.t)
        found = [frequency for frequency in rhythms(left, LINES, LOWEST) if frequency < highest]
        for frequency in (*found, *np.geomspace(min(2 * LOWEST, highest), highest, 10).tolist()):
            for damping in DAMPINGS:
                mode = cls(frequency, damping)
                column = mode.apply(left.h, left.around) - left.h
                yield Candidate(column[:, None], partial(cls._if_seen, mode), positive=1)

    @staticmethod
    def _if_seen(mode: "Resonance", gains: FloatArray) -> "Resonance | None":
        return mode if gains[0] > 0 else None

    def describe(self) -> str:
        """Describe frequency and damping."""
        return f"the stage rings at {self.frequency:.4g} Hz after reversals, with a damping ratio of {self.damping:.3g}"

    def streaming(self) -> StreamingResonance:
        """Return the streaming mode."""
        return StreamingResonance(self.mode)

    @property
    def mode(self) -> Mode:
        """The mode as a differential equation."""
        return Mode(2 * pi * self.frequency, self.damping)
