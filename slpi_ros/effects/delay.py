"""Delay: transport delay of the displacement, or an offset between the stamps of the two signals."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import ClassVar

import numpy as np

from slpi_ros.arrays import FloatArray
from slpi_ros.effects.base import (
    Candidate,
    EffectBase,
    EffectContext,
    ResidualContext,
    Side,
    Signal,
    TimeShift,
    by_record,
    usual_step,
)
from slpi_ros.effects.excitation import DriveLimits, DrivePath, Excitation, at_speeds
from slpi_ros.effects.parameters import Fit, in_samples, parameter


def _draw(path: DrivePath, limits: DriveLimits) -> None:
    at_speeds(path, limits, 0.35, 0.65, straight=True)


@dataclass(frozen=True)
class Delay(EffectBase):
    """Transport delay, or offset between the stamps of voltage and displacement; its inverse needs future setpoints."""

    name: ClassVar[str] = "delay"
    acts_on: ClassVar[Signal] = "voltage"
    side: ClassVar[Side] = "stage"
    what: ClassVar[str] = "voltage and displacement are shifted in time"
    compensated: ClassVar[str] = "on trajectories"
    needs_feedback: ClassVar[bool] = True
    time_shift: ClassVar[TimeShift] = "only"
    dynamic: ClassVar[bool] = True
    excitation: ClassVar[Excitation] = Excitation(
        "The same triangle at six speeds: a delay shifts its sharp corners by one time at every speed and leaves "
        "them sharp, where a lag rounds them and rate dependence changes the loop between them.",
        _draw,
    )

    seconds: float = parameter(
        "s", "delay of the displacement; negative: stamped too early", -100, 100,
        fit=Fit("linear", in_samples, size=True),
    )  # fmt: skip
    uncertainty: Mapping[str, float] = field(default_factory=dict)

    @by_record
    def apply(self, signal: FloatArray, around: EffectContext) -> FloatArray:
        """Delay the signal, shape (N,), volts or metres; before the start it is constant."""
        return np.interp(around.t - self.seconds, around.t, signal, around.start) if signal.size else signal.copy()

    def invert(self, signal: FloatArray, around: EffectContext) -> FloatArray:
        """Advance the signal, shape (N,), volts or metres, using its future samples; the last value is held."""
        return np.interp(around.t + self.seconds, around.t, signal) if signal.size else signal.copy()

    @classmethod
    def fit(cls, context: ResidualContext) -> Iterator[Candidate]:
        """Yield delays of both signs, from a fraction of a sampling interval to several, and of many intervals."""
        dt = usual_step(context.t)
        for group, intervals in enumerate(((-4.0, 0.5, 2.0, 8.0), (32.0,))):
            for seconds in (dt * each for each in intervals):
                column = context.respond(cls(seconds).apply(context.u, context.around)) - context.h
                yield Candidate(column[:, None], partial(cls._times, seconds), group=group)

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
