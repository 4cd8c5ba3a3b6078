"""Hum: mains interference or another disturbance that is periodic in time."""

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
    Rule,
    Side,
    Signal,
    amplitude_and_phase,
    require,
    rhythms,
    wave,
)

# Number of spectral peaks that are tried, and lowest frequency (Hz); slower disturbances are drift or creep.
PEAKS, SLOWEST = 4, 2.0
MOST_LINES = 100


@dataclass(frozen=True)
class Line:
    """One line of hum: frequency (Hz), amplitude (m), and phase (rad) at the record's start."""

    frequency: float
    amplitude: float
    phase: float


@dataclass(frozen=True)
class Hum(EffectBase):
    """Sinusoids in time, ``y = x + sum_k amplitude_k sin(2 pi frequency_k t + phase_k)``.

    They are not compensated, as the phases are known only for the clock of the record.

    Parameters
    ----------
    lines : tuple of Line
        Frequencies in hertz, amplitudes in metres, and phases in radians at the record's start.
    """

    name: ClassVar[str] = "hum"
    acts_on: ClassVar[Signal] = "displacement"
    side: ClassVar[Side] = "record"

    lines: tuple[Line, ...]
    uncertainty: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        rules: list[Rule] = [("lines", 1 <= len(self.lines) <= MOST_LINES, f"a list of 1 to {MOST_LINES}")]
        for k, line in enumerate(self.lines):
            rules += [
                (f"lines.{k}.frequency", 0 < line.frequency <= 1e7, "more than 0 Hz, at most 1e7 Hz"),
                (f"lines.{k}.amplitude", 0 <= line.amplitude <= 1e3, "0 m or more, at most 1000 m"),
                (f"lines.{k}.phase", abs(line.phase) <= 1e6, "within 1e6 rad"),
            ]
        require(self, *rules)

    def apply(self, signal: FloatArray, around: EffectContext) -> FloatArray:
        """Return the displacement with hum, shape (N,), metres."""
        return signal + self.wave(around.t)

    def invert(self, signal: FloatArray, around: EffectContext) -> FloatArray:
        """Return the displacement without hum, shape (N,), metres."""
        return signal - self.wave(around.t)

    def wave(self, t: FloatArray) -> FloatArray:
        """Return the sum of the lines, shape (N,), metres, at times `t`, shape (N,), seconds."""
        waves = (one.amplitude * np.sin(2 * pi * one.frequency * t + one.phase) for one in self.lines)
        return sum(waves, np.zeros_like(t))

    @classmethod
    def fit(cls, left: ResidualView) -> Iterator[Candidate]:
        """Yield single lines at the strongest frequencies of the residual."""
        for frequency in rhythms(left, PEAKS, SLOWEST):
            yield Candidate(wave(2 * np.pi * frequency * left.t), partial(cls._at, frequency))

    @classmethod
    def _at(cls, frequency: float, gains: FloatArray) -> "Hum":
        return cls((Line(frequency, *amplitude_and_phase(gains)),))

    def describe(self) -> str:
        """Describe amplitude and frequency of each line."""
        parts = (f"{line.amplitude * 1e9:.3g} nm at {line.frequency:.4g} Hz" for line in self.lines)
        return f"the measured displacement contains hum of {', '.join(parts)}"
