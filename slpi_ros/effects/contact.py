"""Contact: from a displacement on the stage works against something, such as a stop or a sample."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Self

import numpy as np

from slpi_ros.arrays import FloatArray
from slpi_ros.effects.base import Candidate, Effect, EffectContext, FitContext, StreamingEffect
from slpi_ros.effects.excitation import DriveLimits, DrivePath, Excitation, loops, move, remaining
from slpi_ros.effects.parameters import Fit, parameter

# Number of positions of the candidates, smallest gain of one, and smallest share of the samples on either side.
POSITIONS, LEAST_GAIN, LEAST_SHARE = 16, 0.02, 0.02


def _draw(path: DrivePath, limits: DriveLimits) -> None:
    levels, span, count = (0.0, 0.2, 0.4, 0.6, 0.8), 0.2, 2
    seconds = remaining(limits) / (len(levels) * (2 * count + 1) + 8)
    for level in levels:
        move(path, level)
        loops(path, level, level + span, seconds, count)
    # Down again from ever less far: every level is passed after another history.
    for low, high in ((0.0, 1.0), (0.0, 0.75), (0.0, 0.5), (0.25, 1.0)):
        move(path, low)
        path.to(high, seconds)


@dataclass(frozen=True)
class Contact(Effect):
    """A change of the slope at one displacement, ``y = x + (gain - 1) max(x - position, 0)``."""

    side = "stage"
    what = "from a displacement on the stage works against something: a stop, a sample, a cable"
    compensated = "exactly"
    excitation = Excitation(
        "Loops of one small size at five levels, then turns from four heights: the slope changes at one displacement "
        "whatever came before, where that of a hysteresis depends on where the motion began.",
        _draw,
    )

    position: float = parameter(
        "m", "displacement from which on the slope is another", -1e3, 1e3, fit=Fit("linear", 1e-9)
    )
    gain: float = parameter(
        "", "slope beyond it over the slope before", 0, 1e3, above=True, fit=Fit("linear", 1e-5, LEAST_GAIN)
    )

    def plausible(self, context: FitContext) -> bool:
        """Return whether the stage is again and again on either side of the position."""
        y = context.y[context.used & ~context.first_rise()]
        beyond = float(np.mean(y > self.position)) if y.size else 0.0
        return LEAST_SHARE <= beyond <= 1.0 - LEAST_SHARE

    def shifted(self, by: float) -> Self:
        """Return the contact for a zero of the displacement that has moved by `by` (m)."""
        return replace(self, position=self.position + by)

    def apply(self, signal: FloatArray, around: EffectContext) -> FloatArray:
        """Return the displacement with the contact, shape (N,), metres."""
        beyond = self.position + self.gain * (signal - self.position)
        return np.where(signal > self.position, beyond, signal)

    def invert(self, signal: FloatArray, around: EffectContext) -> FloatArray:
        """Return the displacement without the contact, shape (N,), metres."""
        beyond = self.position + (signal - self.position) / self.gain
        return np.where(signal > self.position, beyond, signal)

    @classmethod
    def fit(cls, context: FitContext) -> Iterator[Candidate]:
        """Yield positions over the range of the displacement."""
        places = np.linspace(float(context.h.min()), float(context.h.max()), POSITIONS + 2)[1:-1]
        for position in places.tolist():
            column = np.maximum(context.h - position, 0.0)
            yield Candidate(column[:, None], partial(cls._at, position))

    @classmethod
    def _at(cls, position: float, gains: FloatArray) -> "Contact":
        return cls(position, max(1.0 + float(gains[0]), LEAST_GAIN))

    @property
    def steepest(self) -> float:
        """The larger one of both slopes."""
        return max(self.gain, 1.0)

    def describe(self) -> str:
        """Describe the position and the slope."""
        way = f"{self.gain:.3g} times the slope before"
        return f"beyond {self.position * 1e6:.4g} µm the stage works against something: {way}"

    def laws(self) -> Mapping[str, FloatArray]:
        """Return position (m) and gain for the compiled inverse."""
        return {"contact": np.array([self.position, self.gain])}

    def streaming(self) -> "StreamingContact":
        """Return the streaming contact."""
        return StreamingContact(self.position, self.gain)


class StreamingContact(StreamingEffect):
    """Streaming (sample by sample) contact, without state."""

    def __init__(self, position: float, gain: float) -> None:
        self._position, self._gain = position, gain

    def forward(self, dt: float, x: float) -> float:
        """Return the displacement (m) with the contact."""
        return self._position + self._gain * (x - self._position) if x > self._position else x

    def inverse(self, dt: float, wanted: float) -> float:
        """Return the displacement (m) without the contact."""
        return self._position + (wanted - self._position) / self._gain if wanted > self._position else wanted
