"""Line interference or vibration: a signal that is periodic in time."""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from math import pi

import numpy as np

from slpi_ros.arrays import FloatArray
from slpi_ros.effects.base import Additive, Candidate, EffectContext, FitContext, amplitude_and_phase, rhythms, wave
from slpi_ros.effects.excitation import DriveLimits, DrivePath, Excitation, move, remaining
from slpi_ros.effects.parameters import Fit, parameter

# Number of spectral peaks that are tried, and lowest frequency (Hz); slower disturbances are drift or creep.
PEAKS, SLOWEST = 4, 2.0
MOST_LINES = 100
# Highest harmonic of the drive frequency that may be residual hysteresis, which decreases with the order; any frequency
# is close to a higher one.
MOST_HARMONICS = 15


def _draw(path: DrivePath, limits: DriveLimits) -> None:
    for level in (0.1, 0.5, 0.9):
        move(path, level)
        path.hold(remaining(limits) / 3)


@dataclass(frozen=True)
class Line:
    """One line: frequency (Hz), amplitude (m), and phase (rad) at the record's start."""

    frequency: float = parameter(
        "Hz", "frequency", 0, 1e7, above=True, fit=Fit("relative", lambda _, of: 1e-3 / of.duration, 1e-3)
    )
    amplitude: float = parameter("m", "amplitude", 0, 1e3, fit=Fit("relative", least=0.0))
    phase: float = parameter("rad", "phase at the record's start", -1e6, 1e6, fit=Fit("angle", 1e-4))


@dataclass(frozen=True)
class Hum(Additive):
    """Sinusoids in time, ``y = x + sum_k amplitude_k sin(2 pi frequency_k t + phase_k)``, on the record's clock."""

    side = "record"
    what = "disturbance that is periodic in time, one or several lines"
    compensated = "no"
    needs_feedback = True
    excitation = Excitation(
        "Rest at three levels: nothing is commanded, so what oscillates there at one frequency comes from outside; "
        "an error of the sensor does not, at rest (sample at more than twice the mains frequency).",
        _draw,
    )

    lines: tuple[Line, ...] = parameter("", "spectral lines", count=(1, MOST_LINES))

    def joined(self, other: "Hum") -> "Hum | None":
        """Return the lines of both."""
        lines = (*self.lines, *other.lines)
        return Hum(lines) if len(lines) <= MOST_LINES else None

    def plausible(self, context: FitContext) -> bool:
        """Return whether no line is a low harmonic of the single drive frequency of any record, within resolution."""
        return not any(
            drive
            and round(line.frequency / drive) <= MOST_HARMONICS
            and abs(line.frequency - round(line.frequency / drive) * drive) < 2.0 / duration
            for line in self.lines
            for drive, duration in context.drives()
        )

    def added(self, around: EffectContext) -> FloatArray:
        """Return the sum of the lines, shape (N,), metres."""
        waves = (one.amplitude * np.sin(2 * pi * one.frequency * around.t + one.phase) for one in self.lines)
        return sum(waves, np.zeros_like(around.t))

    @classmethod
    def fit(cls, context: FitContext) -> Iterator[Candidate]:
        """Yield single lines at the strongest frequencies of the residual."""
        for frequency in rhythms(context, PEAKS, SLOWEST):
            yield Candidate(wave(2 * np.pi * frequency * context.t), partial(cls._at, frequency))

    @classmethod
    def _at(cls, frequency: float, gains: FloatArray) -> "Hum":
        return cls((Line(frequency, *amplitude_and_phase(gains)),))

    def describe(self) -> str:
        """Describe amplitude and frequency of each line."""
        parts = (f"{line.amplitude * 1e9:.3g} nm at {line.frequency:.4g} Hz" for line in self.lines)
        return f"line interference or vibration of {', '.join(parts)}"
