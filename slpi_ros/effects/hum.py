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
    Side,
    Signal,
    amplitude_and_phase,
    require,
    rhythms,
    wave,
)

# Number of spectral peaks that are tried, and lowest frequency (Hz); slower disturbances are drift or creep.
LINES, SLOWEST = 4, 2.0


@dataclass(frozen=True)
class Hum(EffectBase):
    """A sinusoid in time, ``y = x + amplitude sin(2 pi frequency t + phase)``.

    Parameters
    ----------
    frequency : float, hertz
    amplitude : float, metres
    phase : float, radians
        Phase at the record's start.
    uncertainty : mapping of parameter name to standard deviation, optional
    """

    name: ClassVar[str] = "hum"
    acts_on: ClassVar[Signal] = "displacement"
    side: ClassVar[Side] = "record"

    frequency: float
    amplitude: float
    phase: float
    uncertainty: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Validate the parameters."""
        require(
            self,
            ("frequency", 0 < self.frequency <= 1e7, "more than 0 Hz, at most 1e7 Hz"),
            ("amplitude", 0 <= self.amplitude <= 1e3, "0 m or more, at most 1000 m"),
            ("phase", abs(self.phase) <= 1e6, "within 1e6 rad"),
        )

    def apply(self, signal: FloatArray, around: EffectContext) -> FloatArray:
        """Return the displacement with hum, shape (N,), metres."""
        return signal + self.wave(around.t)

    def invert(self, signal: FloatArray, around: EffectContext) -> FloatArray:
        """Return the displacement without hum, shape (N,), metres."""
        return signal - self.wave(around.t)

    def wave(self, t: FloatArray) -> FloatArray:
        """Return the sinusoid, shape (N,), metres, at times `t`, shape (N,), seconds."""
        return self.amplitude * np.sin(2 * pi * self.frequency * t + self.phase)

    @classmethod
    def fit(cls, left: ResidualView) -> Iterator[Candidate]:
        """Yield the strongest frequencies in the spectrum of the residual."""
        for frequency in rhythms(left, LINES, SLOWEST):
            yield Candidate(wave(2 * np.pi * frequency * left.t), partial(cls._at, frequency))

    @classmethod
    def _at(cls, frequency: float, gains: FloatArray) -> "Hum":
        return cls(frequency, *amplitude_and_phase(gains))

    def describe(self) -> str:
        """Describe amplitude and frequency."""
        return f"the measured displacement contains hum of {self.amplitude * 1e9:.3g} nm at {self.frequency:.4g} Hz"

    def streaming(self) -> None:
        """Return None: the phase is known only for the clock of the record, so hum cannot be predicted in operation."""
        return
