"""Gain drift: slow change of the sensitivity of the stage."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import partial

import numpy as np

from slpi_ros.arrays import FloatArray
from slpi_ros.effects.base import Candidate, Effect, EffectContext, FitContext, StreamingEffect, Unsure
from slpi_ros.effects.excitation import Excitation, full_loops
from slpi_ros.effects.parameters import Fit, parameter, require

# Numbers of uniform knots of the candidates. The first interval has more knots, spaced logarithmically (number per
# decade), as piezo ageing is logarithmic in time; the first lies after one loop and at least this many readings.
UNIFORM, PER_DECADE, FEWEST = (1, 2, 4, 8), 2.0, 100
# Numbers of knots at equal shares of the way of the voltage.
OF_TRAVEL = (8, 16)
# Largest gain: no piezo changes by more; and shortest duration (s).
LARGEST, TAKES = 0.3, 10.0


@dataclass(frozen=True)
class GainDrift(Effect):
    """A time-dependent factor on the displacement, ``y = origin + (1 + g(t)) (x - origin)``."""

    # ``g`` is 0 at the record's start, linear between knots, and constant after the last knot. The knots belong to the
    # record; after it the sensitivity stays at its last value, see `lasting`. The factor scales hysteresis, creep and
    # resonance, and acts before the cross coupling, so that other axes receive the scaled motion.
    side = "stage"
    what = "the sensitivity changes slowly"
    compensated = "as it was at the end of the record; its course belongs to the record"
    needs_feedback = True
    sharing = "separate"
    changes_gain = True
    excitation = Excitation(
        "Full loops one after the other, all alike and without a rest: voltage, memory and creep repeat, so a "
        "stroke that grows or shrinks is the sensitivity, where a drift moves both ends of each loop by the same "
        "(give it several minutes, or start after a rest).",
        full_loops,
        separates=("thermal_drift",),
        order=1,
    )

    times: tuple[float, ...] = parameter("s", "times of the knots from the record's start; 0 alone: constant", 0, 1e9)
    gains: tuple[float, ...] = parameter(
        "", "relative changes g of the sensitivity at the knots", -0.9, 10, above=True, fit=Fit("linear", 1e-5)
    )
    origin: float = parameter(
        "m", "displacement that does not change with the sensitivity", -1e3, 1e3,
        fit=Fit("linear", 1e-9, near_motion=True),
    )  # fmt: skip

    def __post_init__(self) -> None:
        super().__post_init__()
        rising = self.times == (0.0,) or all(a < b for a, b in zip((0.0, *self.times), self.times, strict=False))
        require(
            self,
            ("times", rising, "more than 0, strictly increasing"),
            ("gains", len(self.gains) == len(self.times), "one for each time"),
        )

    @property
    def courses(self) -> tuple[tuple[float, ...], ...]:
        """Changes of the gain at the knots."""
        return (self.gains,)

    def plausible(self, context: FitContext) -> bool:
        """Return whether it is small and slow, with an origin near the displacements."""
        return context.near_motion(self.origin) and self.times[-1] >= TAKES and max(map(abs, self.gains)) <= LARGEST

    def factor(self, t: FloatArray) -> FloatArray:
        """Return ``1 + g``, shape (N,), at times `t`, shape (N,), seconds from the record's start."""
        if self.times[0] == 0.0:
            return np.full(t.shape, 1.0 + self.gains[-1])
        return 1.0 + np.interp(t, (0.0, *self.times), (0.0, *self.gains))

    @property
    def unsure(self) -> Unsure:
        """How fast the sensitivity went on changing in the record."""
        if self.times[0] == 0.0:
            return Unsure()
        steps = np.diff((0.0, *self.gains))
        return Unsure(gain_drift=float(steps @ steps) / self.times[-1], origin=self.origin)

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
    def fit(cls, context: FitContext) -> Iterator[Candidate]:
        """Yield a straight line, and piecewise linear curves with uniform knots and additional early knots."""
        # Displacement shifts at the same knots are fitted with the gains; their ratio gives the origin.
        t, end = context.t - context.t[0], float(context.t[-1] - context.t[0])
        travel = np.cumsum(np.abs(np.diff(context.u, prepend=context.u[0])) * context.used)
        first = float(max(np.interp(2.0 * np.ptp(context.u), travel, t), t[context.used][:FEWEST][-1]))
        curves = [np.array([end])]
        for count in UNIFORM:
            knots = np.linspace(0.0, end, count + 1)[1:]
            early = int(np.ceil(PER_DECADE * np.log10(knots[0] / first))) if 0.0 < first < knots[0] else 0
            curves.append(np.append(np.geomspace(first, knots[0], early, endpoint=False), knots))
        # Run-in follows the way that the voltage has gone, which rests between bursts of motion.
        for count in OF_TRAVEL if travel[-1] > 0.0 else ():
            knots = np.interp(np.linspace(0.0, travel[-1], count + 1)[1:], travel, t)
            curves.append(np.append(knots[:-1], end))
        low, high = float(context.h.min()), float(context.h.max())
        for times in curves:
            hats = np.column_stack([np.interp(t, (0.0, *times), (0.0, *row)) for row in np.eye(times.size)])
            columns = np.column_stack([hats * (context.h - low)[:, None], hats * (high - low)])
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


class StreamingGainDrift(StreamingEffect):
    """Streaming (sample by sample) constant sensitivity factor, without state."""

    def __init__(self, origin: float, factor: float) -> None:
        self._origin, self._factor = origin, factor

    def forward(self, dt: float, x: float) -> float:
        """Return the displacement (m) with the changed sensitivity."""
        return self._origin + self._factor * (x - self._origin)

    def inverse(self, dt: float, wanted: float) -> float:
        """Return the displacement (m) with the initial sensitivity."""
        return self._origin + (wanted - self._origin) / self._factor
