"""Clock: the displacement's stamps are of another clock than the voltage's."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from slpi_ros.arrays import FloatArray
from slpi_ros.effects.base import Candidate, Effect, EffectContext, FitContext, by_record
from slpi_ros.effects.excitation import DriveLimits, DrivePath, Excitation, loops, remaining, safe_duration
from slpi_ros.effects.parameters import Fit, Scales, parameter

# Rate by which the fit's column is computed.
STEP = 1e-6
# Shortest record (s): crystals differ by at most 100 ppm, less than a millisecond within this time, as a delay.
SHORTEST = 10.0


def _draw(path: DrivePath, limits: DriveLimits) -> None:
    half = max(limits.quickest(1.0), safe_duration(1.0))
    repeats = max(int(remaining(limits) / (2 * half)), 3)
    loops(path, 0.0, 1.0, remaining(limits) / (2 * repeats), repeats)


def _small(value: float, scales: Scales) -> float:
    return 0.05 * scales.interval / max(scales.duration, scales.interval)


@dataclass(frozen=True)
class Clock(Effect):
    """Stamps ``(1 + rate) t`` of the displacement at the time ``t`` from the record's start."""

    side = "record"
    what = "the clock of the displacement's stamps goes faster or slower than that of the voltage's"
    compensated = "no, it is of the record's stamps"
    excitation = Excitation(
        "The same full loop over and over, as quick as allowed: the shift between voltage and displacement grows from "
        "the first loop to the last, where a delay or a lag shifts all of them alike.",
        _draw,
        separates=("delay", "lag"),
        order=2,
    )

    rate: float = parameter(
        "", "by how much the displacement's clock goes faster, relative: 1e-6 is 1 ppm", -0.1, 0.1,
        fit=Fit("linear", _small),
    )  # fmt: skip

    @by_record
    def apply(self, signal: FloatArray, around: EffectContext) -> FloatArray:
        """Return what is read at the stamps, shape (N,), metres."""
        return self._at(1 / (1 + self.rate), signal, around)

    @by_record
    def invert(self, signal: FloatArray, around: EffectContext) -> FloatArray:
        """Return the displacement at times by the voltage's clock, shape (N,), metres."""
        return self._at(1 + self.rate, signal, around)

    def _at(self, scale: float, signal: FloatArray, around: EffectContext) -> FloatArray:
        return np.interp(around.t[:1] + scale * around.since, around.t, signal) if signal.size else signal

    @classmethod
    def fit(cls, context: FitContext) -> Iterator[Candidate]:
        """Yield the time derivative of the displacement, times the time from the record's start."""
        if not float(np.ptp(context.t)) >= SHORTEST:
            return
        seen = np.where(context.used, context.y - context.residual, context.h)
        column = (cls(STEP).apply(seen, context.around) - seen) / STEP
        yield Candidate(column[:, None], lambda gains: cls(float(gains[0])))

    def describe(self) -> str:
        """Describe the rate."""
        how = "faster" if self.rate > 0 else "slower"
        return f"the displacement's clock goes {abs(self.rate) * 1e6:.3g} ppm {how} than the voltage's in this record"
