"""Gain drift: slow change of the sensitivity of the stage."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import partial
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
    require,
)

# Numbers of uniform knots of the candidates. The first interval has more knots, spaced logarithmically (number per
# decade), as piezo ageing is logarithmic in time; the first lies after one loop and at least this many readings.
UNIFORM, PER_DECADE, FEWEST = (1, 2, 4, 8), 2.0, 100


@dataclass(frozen=True)
class GainDrift(EffectBase):
    """A time-dependent factor on the displacement, ``y = origin + (1 + g(t)) (x - origin)``.

    ``g`` is 0 at the record's start, linear between knots, and constant after the last knot. The knots belong to the
    record; after it the sensitivity stays at its last value, see `lasting`. The factor scales hysteresis, creep and
    resonance, and acts before the cross coupling, so that other axes receive the scaled motion.

    Parameters
    ----------
    times : tuple of float, length K >= 1, seconds
        Knots from the record's start, more than 0, strictly increasing; 0 alone: a constant sensitivity.
    gains : tuple of float, length K
        Relative change of sensitivity ``g`` at the knots.
    origin : float, metres
        Displacement that does not change with the sensitivity.
    """

    name: ClassVar[str] = "gain_drift"
    acts_on: ClassVar[Signal] = "displacement"
    side: ClassVar[Side] = "stage"

    times: tuple[float, ...]
    gains: tuple[float, ...]
    origin: float
    uncertainty: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        rising = self.times == (0.0,) or all(a < b for a, b in zip((0.0, *self.times), self.times, strict=False))
        require(
            self,
            ("times", 1 <= len(self.times) <= 10000 and rising, "1 to 10000 numbers, more than 0, strictly increasing"),
            ("times", all(time <= 1e9 for time in self.times), "at most 1e9 s"),
            ("gains", len(self.gains) == len(self.times), "one for each time"),
            ("gains", all(-0.9 < gain <= 10 for gain in self.gains), "more than -0.9, at most 10"),
            ("origin", abs(self.origin) <= 1e3, "within 1000 m"),
        )

    def factor(self, t: FloatArray) -> FloatArray:
        """Return ``1 + g``, shape (N,), at times `t`, shape (N,), seconds from the record's start."""
        if self.times[0] == 0.0:
            return np.full(t.shape, 1.0 + self.gains[-1])
        return 1.0 + np.interp(t, (0.0, *self.times), (0.0, *self.gains))

    @property
    def lasting(self) -> "GainDrift":
        """The sensitivity at the end of the record, constant."""
        return GainDrift((0.0,), self.gains[-1:], self.origin)

    def apply(self, signal: FloatArray, around: EffectContext) -> FloatArray:
        """Return the displacement with the changed sensitivity, shape (N,), metres."""
        return self.origin + self.factor(around.t) * (signal - self.origin)

    def invert(self, signal: FloatArray, around: EffectContext) -> FloatArray:
        """Return the displacement with the initial sensitivity, shape (N,), metres."""
        return self.origin + (signal - self.origin) / self.factor(around.t)

    @classmethod
    def fit(cls, left: ResidualView) -> Iterator[Candidate]:
        """Yield a straight line, and piecewise linear curves with uniform knots and additional early knots.

        Displacement shifts at the same knots are fitted with the gains; their ratio gives the origin.
        """
        t, end = left.t - left.t[0], float(left.t[-1] - left.t[0])
        travel = np.cumsum(np.abs(np.diff(left.u, prepend=left.u[0])) * left.used)
        first = float(max(np.interp(2.0 * np.ptp(left.u), travel, t), t[left.used][:FEWEST][-1]))
        curves = [np.array([end])]
        for count in UNIFORM:
            knots = np.linspace(0.0, end, count + 1)[1:]
            early = int(np.ceil(PER_DECADE * np.log10(knots[0] / first))) if 0.0 < first < knots[0] else 0
            curves.append(np.append(np.geomspace(first, knots[0], early, endpoint=False), knots))
        low, high = float(left.h.min()), float(left.h.max())
        for times in curves:
            hats = np.column_stack([np.interp(t, (0.0, *times), (0.0, *row)) for row in np.eye(times.size)])
            columns = np.column_stack([hats * (left.h - low)[:, None], hats * (high - low)])
            yield Candidate(columns, partial(cls._through, times, low, high))

    @classmethod
    def _through(cls, times: FloatArray, low: float, high: float, found: FloatArray) -> "GainDrift":
        """Return the gain drift for fitted gains and shifts; its origin is limited to the range `low` to `high` (m)."""
        gains, shifts = np.split(found, 2)
        # The weight of a knot is the duration that it represents.
        weighted = gains * np.gradient(np.append(0.0, times))[1:]
        share = -float(weighted @ shifts) / max(float(weighted @ gains), 1e-300)
        origin = low + min(max(share, 0.0), 1.0) * (high - low)
        return cls(tuple(times.tolist()), tuple(gains.tolist()), origin)

    def describe(self) -> str:
        """Describe the magnitude, the duration and the half time."""
        if self.times[0] == 0.0:
            way = "lower" if self.gains[-1] < 0 else "higher"
            return f"the sensitivity is {abs(self.gains[-1]) * 100:.2g} % {way} than that of the hysteresis"
        t = np.linspace(0.0, self.times[-1], 1001)
        change = self.factor(t) - 1.0
        largest = change[int(np.argmax(np.abs(change)))]
        half = t[int(np.argmax(np.abs(change) >= 0.5 * abs(largest)))]
        back = f", and is off by {change[-1] * 100:.2g} % at its end" if abs(change[-1] / (largest or 1)) < 0.9 else ""
        return (
            f"the sensitivity {'falls' if largest < 0 else 'rises'} by {abs(largest) * 100:.2g} % over "
            f"{self.times[-1]:.3g} s of this record, half of it in the first {half:.3g} s{back}"
        )

    def laws(self) -> Mapping[str, FloatArray]:
        """Return origin (m) and last factor for the compiled inverse."""
        return {"gain": np.array([self.origin, 1.0 + self.gains[-1]])}

    def streaming(self) -> "StreamingGainDrift":
        """Return the sensitivity at the end of the record as a streaming effect."""
        return StreamingGainDrift(self.origin, 1.0 + self.gains[-1])


class StreamingGainDrift(StreamingBase):
    """Streaming (sample by sample) constant sensitivity factor, without state."""

    def __init__(self, origin: float, factor: float) -> None:
        self._origin, self._factor = origin, factor

    def forward(self, dt: float, x: float) -> float:
        """Return the displacement (m) with the changed sensitivity."""
        return self._origin + self._factor * (x - self._origin)

    def inverse(self, dt: float, wanted: float) -> float:
        """Return the displacement (m) with the initial sensitivity."""
        return self._origin + (wanted - self._origin) / self._factor
