"""Supply sag: the supply of the sensor sags with the current of the amplifier, and the reading with it.

The worked example of CONTRIBUTING.md: an effect that is none of the registry.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from slpi_ros.effects.base import Candidate, Effect, EffectContext, FitContext, FloatArray, StreamingEffect, by_record
from slpi_ros.effects.excitation import DriveLimits, DrivePath, Excitation, loops, remaining
from slpi_ros.effects.parameters import Fit, parameter

# Largest reading error as a share of the motion; more would be another fault.
LARGEST = 0.05


def _draw(path: DrivePath, limits: DriveLimits) -> None:
    for seconds in (remaining(limits) / 6, remaining(limits) / 24):
        loops(path, 0.0, 1.0, seconds, 2, straight=True)


@dataclass(frozen=True)
class SupplySag(Effect):
    """An error of the sensor in proportion to the speed, in either direction: ``y = x + gain |dx/dt|``."""

    side = "sensor"
    what = "the reading changes with the speed, in either direction alike"
    compensated = "not the stage: the readings are corrected"
    excitation = Excitation(
        "Straight ramps over the whole range at two speeds: the reading is off by the same on the way up and on the "
        "way down, where a lag is off by the opposite.",
        _draw,
        separates=("lag",),
    )

    gain: float = parameter("s", "displacement for each unit of speed", -1, 1, fit=Fit("linear", 1e-8))

    @by_record
    def apply(self, signal: FloatArray, around: EffectContext) -> FloatArray:
        return signal + self.gain * np.abs(_speed(signal, around.t))

    @by_record
    def invert(self, signal: FloatArray, around: EffectContext) -> FloatArray:
        return signal - self.gain * np.abs(_speed(signal, around.t))

    @classmethod
    def fit(cls, left: FitContext) -> Iterator[Candidate]:
        yield Candidate(cls(1.0).column(left)[:, None], lambda gains: cls(float(gains[0])))

    def plausible(self, view: FitContext) -> bool:
        fastest = float(np.percentile(np.abs(_speed(view.h, view.t)), 99))
        return abs(self.gain) * fastest <= LARGEST * view.motion

    def describe(self) -> str:
        return f"the reading is off by {self.gain * 1e3:.3g} nm for each um/s"

    def streaming(self) -> "StreamingSupplySag":
        return StreamingSupplySag(self.gain)


class StreamingSupplySag(StreamingEffect):
    """The error sample by sample; its state is the last displacement (m)."""

    def __init__(self, gain: float) -> None:
        self._gain, self._x = gain, 0.0

    def start(self, x: float) -> None:
        self._x = x

    def forward(self, dt: float, x: float) -> float:
        before, self._x = self._x, x
        return x + self._gain * abs(x - before) / dt if dt > 0.0 else x

    def inverse(self, dt: float, wanted: float) -> float:
        return wanted - self._gain * abs(wanted - self._x) / dt if dt > 0.0 else wanted

    def snapshot(self) -> float:
        return self._x

    def restore(self, state: float) -> None:
        self._x = state


def _speed(x: FloatArray, t: FloatArray) -> FloatArray:
    return np.diff(x, prepend=x[:1]) / np.maximum(np.diff(t, prepend=-np.inf), 1e-9)
