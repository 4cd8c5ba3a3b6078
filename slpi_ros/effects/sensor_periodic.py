"""Periodic error of the sensor, such as the nonlinearity of an interferometer."""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from math import cos, pi, sin
from typing import Any

import numpy as np

from slpi_ros.arrays import FloatArray
from slpi_ros.effects.base import (
    Candidate,
    Effect,
    EffectContext,
    FitContext,
    StreamingEffect,
    amplitude_and_phase,
    strongest_lines,
    wave,
)
from slpi_ros.effects.excitation import DriveLimits, DrivePath, Excitation, loops, remaining
from slpi_ros.effects.parameters import Fit, parameter, require

# Shortest and longest period (m), of a quarter and of half a wavelength of lasers from the violet to 1.55 um; number of
# spectral peaks, and number of displacement bins of the candidates.
SHORTEST, LONGEST, LINES, BINS = 50e-9, 0.8e-6, 4, 2**14
# Shortest period in rms rounding errors: rounding repeats with every digit, which is sqrt(12) times its rms.
ROUNDING_PERIOD = 1.3 * 12**0.5
# Largest difference of the zeros of records, as a share of the period, for a common error.
IN_PHASE = 0.1
# Largest amplitude over that at which a reading belongs to two displacements.
INVERTIBLE = 0.9

# Newton's method converges quadratically once the error is small.
_STEPS = 60
_CLOSE = 1e-12


def _draw(path: DrivePath, limits: DriveLimits) -> None:
    for share in (1 / 6, 1 / 3):
        loops(path, 0.0, 1.0, share * remaining(limits), 1, straight=True)


@dataclass(frozen=True)
class SensorPeriodic(Effect):
    """Periodic sensor error, ``y = x + amplitude sin(2 pi x / period + phase)``."""

    side = "sensor"
    what = "interferometer error, periodic in the displacement"
    compensated = "not the stage: the readings are corrected, as long as the zero of the sensor does not move"
    # A sensor may start each record with another phase.
    sharing = "either"
    excitation = Excitation(
        "Slow ramps of constant speed over the whole range, at two speeds: an error of the sensor has the same "
        "period in displacement at both speeds, line interference the same in time, and hysteresis is smooth.",
        _draw,
    )

    period: float = parameter(
        "m", "period in displacement, such as half a wavelength", 1e-12, 1e3,
        fit=Fit("relative", lambda value, _: 1e-5 * abs(value), SHORTEST, LONGEST),
    )  # fmt: skip
    amplitude: float = parameter("m", "amplitude", 0, 1e3, fit=Fit("relative", least=0.0, most=LONGEST))
    phase: float = parameter("rad", "phase at displacement 0", -1e3, 1e3, fit=Fit("angle", 1e-4))

    def __post_init__(self) -> None:
        super().__post_init__()
        require(self, ("amplitude", self.amplitude * 2 * pi < 0.99 * self.period, "less than period / 2 pi"))

    def plausible(self, context: FitContext) -> bool:
        """Return whether the period is longer than that of rounding."""
        return bool(self.period > ROUNDING_PERIOD * context.rounding)

    def agrees(self, other: "SensorPeriodic", context: FitContext) -> bool:
        """Return whether the periods of two records differ by less than half a period over the motion."""
        return abs(1.0 / self.period - 1.0 / other.period) * context.motion < 0.5

    def in_phase(self, context: FitContext) -> bool:
        """Return whether the phase is the same in all records."""
        # If the zeros of the records differ, so may those of other records, and the phase there is unknown.
        return float(np.ptp(context.zeros())) <= IN_PHASE * self.period

    def apply(self, signal: FloatArray, around: EffectContext) -> FloatArray:
        """Return the sensor reading, shape (N,), metres."""
        return signal + self.amplitude * np.sin(2 * pi / self.period * signal + self.phase)

    def invert(self, signal: FloatArray, around: EffectContext) -> FloatArray:
        """Return the displacement, shape (N,), metres, for the sensor reading."""
        k, amplitude, phase = 2 * pi / self.period, self.amplitude, self.phase
        low, high, x = signal - amplitude, signal + amplitude, signal.copy()
        for _ in range(_STEPS):
            angle = k * x + phase
            beyond = x + amplitude * np.sin(angle) - signal
            if not np.any(np.abs(beyond) > _CLOSE * amplitude):
                break
            low, high = np.where(beyond < 0, x, low), np.where(beyond > 0, x, high)
            step = x - beyond / (1 + k * amplitude * np.cos(angle))
            x = np.where((step < low) | (step > high), (low + high) / 2, step)
        return x

    @classmethod
    def fit(cls, context: FitContext) -> Iterator[Candidate]:
        """Yield the strongest spectral lines of the residual as a function of the displacement."""
        # Displacement seen by the sensor, which includes the other effects.
        seen = context.y - context.residual
        width = float(np.ptp(seen)) / BINS
        place = ((seen[context.used] - float(seen.min())) / width).astype(np.int64)
        power = np.abs(np.fft.rfft(np.bincount(place, context.residual[context.used], 4 * BINS)[: 4 * BINS])) ** 2
        lines = np.fft.rfftfreq(4 * BINS, width)
        power[(lines < 1 / LONGEST) | (lines > 1 / SHORTEST)] = 0.0
        for line in strongest_lines(power, lines, LINES, width=6):
            yield Candidate(wave(2 * np.pi * line * seen), partial(cls._of, 1 / line))

    @classmethod
    def _of(cls, period: float, gains: FloatArray) -> "SensorPeriodic":
        amplitude, phase = amplitude_and_phase(gains)
        return cls(**cls.limited({"period": period, "amplitude": amplitude, "phase": phase}))

    @classmethod
    def limited(cls, changed: dict[str, Any]) -> dict[str, Any]:
        """Return new parameters with an amplitude that leaves the readings invertible."""
        return changed | {"amplitude": min(changed["amplitude"], INVERTIBLE * changed["period"] / (2 * pi))}

    def describe(self) -> str:
        """Describe amplitude and period."""
        return (
            f"the sensor has a periodic error of {self.amplitude * 1e9:.3g} nm, with a period of "
            f"{self.period * 1e9:.4g} nm of displacement"
        )

    def streaming(self) -> "StreamingSensorError":
        """Return the streaming sensor error."""
        return StreamingSensorError(self)


class StreamingSensorError(StreamingEffect):
    """Streaming (sample by sample) sensor error, without state."""

    def __init__(self, sensor: SensorPeriodic) -> None:
        self._sensor = sensor
        self._k = 2 * pi / sensor.period

    def forward(self, dt: float, x: float) -> float:
        """Return the sensor reading (m) at the displacement `x` (m)."""
        return x + self._sensor.amplitude * sin(self._k * x + self._sensor.phase)

    def inverse(self, dt: float, wanted: float) -> float:
        """Return the displacement (m) for the reading `wanted` (m)."""
        k, amplitude, phase = self._k, self._sensor.amplitude, self._sensor.phase
        low, high, x = wanted - amplitude, wanted + amplitude, wanted
        for _ in range(_STEPS):
            beyond = x + amplitude * sin(k * x + phase) - wanted
            if abs(beyond) <= _CLOSE * amplitude:
                break
            low, high = (x, high) if beyond < 0 else (low, x)
            x -= beyond / (1 + k * amplitude * cos(k * x + phase))
            if not low <= x <= high:
                x = (low + high) / 2
        return x
