"""Thermal drift: slow change of the displacement, independent of the voltage."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import ClassVar

import numpy as np

from slpi_ros.effects.base import Candidate, EffectBase, EffectContext, FloatArray, ResidualView, Side, Signal, require

# Numbers of knots of the candidates.
KNOTS = (2, 3, 5, 8, 13)


@dataclass(frozen=True)
class ThermalDrift(EffectBase):
    """A displacement that depends on time only, linear between knots and constant outside.

    Parameters
    ----------
    times : tuple of float, length K >= 1, seconds
        Knots from the record's start, strictly increasing.
    values : tuple of float, length K, metres, displacement at the knots
    """

    name: ClassVar[str] = "thermal_drift"
    acts_on: ClassVar[Signal] = "displacement"
    side: ClassVar[Side] = "record"

    times: tuple[float, ...]
    values: tuple[float, ...]
    uncertainty: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        rising = all(a < b for a, b in zip(self.times, self.times[1:], strict=False))
        require(
            self,
            ("times", 1 <= len(self.times) <= 10000 and rising, "1 to 10000 numbers, strictly increasing"),
            ("times", all(abs(time) <= 1e9 for time in self.times), "within 1e9 s"),
            ("values", len(self.values) == len(self.times), "one for each time"),
            ("values", all(abs(value) <= 1e3 for value in self.values), "within 1000 m"),
        )

    def apply(self, signal: FloatArray, around: EffectContext) -> FloatArray:
        """Return the displacement with drift, shape (N,), metres."""
        return signal + np.interp(around.t, self.times, self.values)

    def invert(self, signal: FloatArray, around: EffectContext) -> FloatArray:
        """Return the displacement without drift, shape (N,), metres."""
        return signal - np.interp(around.t, self.times, self.values)

    @classmethod
    def fit(cls, left: ResidualView) -> Iterator[Candidate]:
        """Yield piecewise linear curves with an increasing number of knots."""
        for knots in KNOTS:
            times = np.linspace(left.t[0], left.t[-1], knots)
            # A constant is part of the displacement at rest.
            hats = np.column_stack([np.interp(left.t, times, row) for row in np.eye(knots)[1:]])
            yield Candidate(hats, partial(cls._through, times))

    @classmethod
    def _through(cls, times: FloatArray, gains: FloatArray) -> "ThermalDrift":
        return cls(tuple(times.tolist()), (0.0, *gains.tolist()))

    def describe(self) -> str:
        """Describe the range and the duration."""
        way, span = max(self.values) - min(self.values), self.times[-1] - self.times[0]
        return f"whatever the voltage, the stage drifts by {way * 1e6:.3g} µm within {span:.3g} s of this record"
