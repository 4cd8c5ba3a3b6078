"""Delay: transport delay of the displacement, or an offset between the stamps of the two signals."""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial

import numpy as np

from slpi_ros.arrays import FloatArray
from slpi_ros.effects.base import Candidate, Effect, EffectContext, FitContext, by_record, usual_step
from slpi_ros.effects.excitation import Excitation, at_speeds
from slpi_ros.effects.parameters import Fit, in_samples, parameter


@dataclass(frozen=True)
class Delay(Effect):
    """Transport delay, or offset between the stamps of voltage and displacement; its inverse needs future setpoints."""

    acts_on = "voltage"
    side = "stage"
    what = "voltage and displacement are shifted in time"
    compensated = "on trajectories"
    needs_feedback = True
    time_shift = "only"
    dynamic = True
    excitation = Excitation(
        "The same triangle at six speeds: a delay shifts its sharp corners by one time at every speed and leaves "
        "them sharp, where a lag rounds them and rate dependence changes the loop between them.",
        partial(at_speeds, low=0.35, high=0.65, straight=True),
    )

    seconds: float = parameter(
        "s", "delay of the displacement; negative: stamped too early", -100, 100,
        fit=Fit("linear", in_samples),
    )  # fmt: skip

    @by_record
    def apply(self, signal: FloatArray, around: EffectContext) -> FloatArray:
        """Delay the signal, shape (N,), volts or metres; before the start it is constant."""
        return np.interp(around.t - self.seconds, around.t, signal, around.start) if signal.size else signal.copy()

    def invert(self, signal: FloatArray, around: EffectContext) -> FloatArray:
        """Advance the signal, shape (N,), volts or metres, using its future samples; the last value is held."""
        return np.interp(around.t + self.seconds, around.t, signal) if signal.size else signal.copy()

    @classmethod
    def fit(cls, context: FitContext) -> Iterator[Candidate]:
        """Yield delays of both signs, from a fraction of a sampling interval to several, and of many intervals."""
        dt = usual_step(context.t)
        for group, intervals in enumerate(((-4.0, 0.5, 2.0, 8.0), (32.0,))):
            for seconds in (dt * each for each in intervals):
                yield Candidate(cls(seconds).column(context)[:, None], partial(cls._times, seconds), group=group)

    @classmethod
    def _times(cls, seconds: float, gains: FloatArray) -> "Delay":
        return cls(seconds * float(gains[0]))

    @property
    def shift(self) -> float:
        """The delay, seconds."""
        return self.seconds

    def describe(self) -> str:
        """Describe the delay."""
        if self.seconds < 0:
            return f"the displacement is stamped {-self.seconds * 1e3:.3g} ms too early for its voltage"
        return f"the displacement follows {self.seconds * 1e3:.3g} ms after the voltage"
