"""Resonance: a lightly damped flexure mode that rings after every turn."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import partial
from math import pi
from typing import ClassVar

import numpy as np
from scipy.signal import lfilter

from slpi_ros.effects.base import Form, Left, rhythms, usual_step
from slpi_ros.effects.checks import require
from slpi_ros.effects.effect import Around, FloatArray, Removable, Side
from slpi_ros.effects.filters import Mode
from slpi_ros.effects.ringing import ResonanceFollower, Unringing
from slpi_ros.effects.uniform import Uniform

# Modes that are looked for: from this frequency (Hz) to this share of the sampling rate, at so many lines.
LOWEST, HIGHEST, LINES = 10.0, 0.45, 4
DAMPINGS = (0.02, 0.08)


@dataclass(frozen=True)
class Resonance:
    """A second-order mode, ``y'' + 2 z w y' + w^2 y = w^2 h``, ``w = 2 pi frequency``.

    The exact inverse of the sampled mode is unstable. This one places zeros on the mode's poles, which ends the ringing
    after every turn, follows ramps without error, and is a sum of a few old wishes: bounded.

    Parameters
    ----------
    frequency : float, hertz
        Undamped.
    damping : float
        Damping ratio ``z``, from above 0 to below 1.
    uncertainty : mapping of str to float
    """

    name: ClassVar[str] = "resonance"
    side: ClassVar[Side] = "displacement"
    removable: ClassVar[Removable] = "always"

    frequency: float
    damping: float
    uncertainty: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Refuse what is no mode."""
        require(
            self,
            ("frequency", 1e-3 <= self.frequency <= 1e7, "from 0.001 to 1e7 Hz"),
            ("damping", 1e-6 <= self.damping < 1, "from 1e-6 to below 1"),
        )

    def apply(self, signal: FloatArray, around: Around) -> FloatArray:
        """Return the displacement with ringing, shape (N,), metres; exact where the input is linear between samples."""
        grid = Uniform.over(around.t)
        if not grid.dt:
            return np.full_like(signal, signal[0]) if signal.size else signal.copy()
        numerator, denominator = self.mode.transfer(grid.dt)
        moved = grid.on(signal)
        return grid.off(moved[0] + lfilter(numerator, denominator, moved - moved[0]))

    def invert(self, signal: FloatArray, around: Around) -> FloatArray:
        """Return the displacement that rings to the given one, shape (N,), metres."""
        grid = Uniform.over(around.t)
        if not grid.dt:
            return signal.copy()
        between = max(1, round(Unringing.shortest(self.mode) / grid.dt))
        taps = Unringing.of(self.mode, between * grid.dt, preview=between * grid.dt).taps
        wished, left = grid.on(signal), (len(taps) - 2) * between
        padded = np.pad(wished, (left, 0), mode="edge")
        # The path goes on at its end as it came.
        padded = np.pad(padded, (0, between), mode="reflect", reflect_type="odd")
        parts = (tap * padded[left + (1 - k) * between :][: wished.size] for k, tap in enumerate(taps))
        return grid.off(sum(parts, np.zeros_like(wished)))

    @classmethod
    def fit(cls, left: Left) -> Iterator[Form]:
        """Yield modes where the spectrum of what is left has lines, and all over it."""
        highest = HIGHEST / usual_step(left.t)
        found = [frequency for frequency in rhythms(left, LINES, LOWEST) if frequency < highest]
        for frequency in (*found, *np.geomspace(min(2 * LOWEST, highest), highest, 10).tolist()):
            for damping in DAMPINGS:
                mode = cls(frequency, damping)
                column = mode.apply(left.h, left.around) - left.h
                yield Form(column[:, None], partial(cls._if_seen, mode), positive=1)

    @staticmethod
    def _if_seen(mode: "Resonance", gains: FloatArray) -> "Resonance | None":
        return mode if gains[0] > 0 else None

    def describe(self) -> str:
        """Say where it rings."""
        return f"the stage rings at {self.frequency:.4g} Hz after turns, with a damping ratio of {self.damping:.3g}"

    def follower(self) -> ResonanceFollower:
        """Return the mode sample by sample."""
        return ResonanceFollower(self.mode)

    @property
    def mode(self) -> Mode:
        """The mode as equations of motion."""
        return Mode(2 * pi * self.frequency, self.damping)
