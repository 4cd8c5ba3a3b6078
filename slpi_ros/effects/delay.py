"""Delay: the displacement answers later, or the stamps of the two signals are apart."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import ClassVar

import numpy as np

from slpi_ros.effects.base import (
    Candidate,
    EffectContext,
    FloatArray,
    Removable,
    ResidualView,
    Side,
    by_record,
    require,
    usual_step,
)


@dataclass(frozen=True)
class Delay:
    """Transport delay, or an offset between the stamps of voltage and displacement.

    Parameters
    ----------
    seconds : float, seconds
        Negative where the displacement's stamps are early, or those of the voltage late.
    uncertainty : mapping of str to float
    """

    name: ClassVar[str] = "delay"
    side: ClassVar[Side] = "voltage"
    removable: ClassVar[Removable] = "path"

    seconds: float
    uncertainty: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Refuse what is no delay."""
        require(self, ("seconds", abs(self.seconds) <= 100, "from -100 to 100 s"))

    @by_record
    def apply(self, signal: FloatArray, around: EffectContext) -> FloatArray:
        """Shift the signal, shape (N,), to later; the first value is held before."""
        return np.interp(around.t - self.seconds, around.t, signal) if signal.size else signal.copy()

    def invert(self, signal: FloatArray, around: EffectContext) -> FloatArray:
        """Shift the signal, shape (N,), to earlier: a preview of the path; its end is held."""
        return np.interp(around.t + self.seconds, around.t, signal) if signal.size else signal.copy()

    @classmethod
    def fit(cls, left: ResidualView) -> Iterator[Candidate]:
        """Yield shifts by a part of a sample and by some, either way."""
        dt = usual_step(left.t)
        for seconds in (-4.0 * dt, 0.5 * dt, 2.0 * dt, 8.0 * dt):
            column = left.respond(cls(seconds).apply(left.u, left.around)) - left.h
            yield Candidate(column[:, None], partial(cls._times, seconds))

    @classmethod
    def _times(cls, seconds: float, gains: FloatArray) -> "Delay":
        return cls(seconds * float(gains[0]))

    def describe(self) -> str:
        """Say how long it is."""
        if self.seconds < 0:
            return f"the displacement is stamped {-self.seconds * 1e3:.3g} ms too early for its voltage"
        return f"the displacement answers {self.seconds * 1e3:.3g} ms after the voltage"

    def streaming(self) -> None:
        """Return None: without the path ahead there is no preview."""
        return
