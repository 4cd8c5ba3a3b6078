"""Lag of the amplifier: first-order response of the piezo voltage to the command."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import partial

import numpy as np

from slpi_ros.arrays import FloatArray
from slpi_ros.effects.base import Candidate, Effect, EffectContext, FitContext, StreamingEffect, by_record, usual_step
from slpi_ros.effects.excitation import Excitation, at_speeds
from slpi_ros.effects.filters import DAMPING, Dynamics, Hold, filtered, first_order, hold
from slpi_ros.effects.parameters import Fit, in_samples, parameter

# Number of time constants after which the piezo has the voltage of the command.
SETTLED = 5.0


@dataclass(frozen=True)
class Lag(Effect):
    """First-order lag, ``tau du/dt = v - u``."""

    acts_on = "voltage"
    side = "stage"
    what = "first-order lag of the voltage, as of an amplifier, before the hysteresis"
    compensated = "yes"
    time_shift = "only"
    dynamic = True
    excitation = Excitation(
        "The same small loop as a sine, slow to fast: hysteresis stays as it is, the phase of a delay grows with "
        "frequency at full amplitude, and a lag also loses amplitude.",
        partial(at_speeds, low=0.45, high=0.55, straight=False),
        separates=("delay",),
    )

    time_constant: float = parameter(
        "s", "time constant tau", 0, 1e4, above=True, fit=Fit("relative", in_samples, 1e-6)
    )

    @by_record
    def apply(self, signal: FloatArray, around: EffectContext) -> FloatArray:
        """Return the lagged voltage, shape (N,), volts; exact if the command is linear between samples."""
        grid = around.uniform
        now, before, kept = hold(grid.dt, self.time_constant)
        v = grid.on(signal)
        # Before its start the signal was constant; a constant one is unchanged.
        lagged = grid.off(v[:1] + filtered([now, before], [1.0, -kept], v - v[:1]))
        return lagged - around.step(signal) * np.exp(-around.since / self.time_constant)

    @classmethod
    def fit(cls, context: FitContext) -> Iterator[Candidate]:
        """Yield lags from a fraction of a sampling interval to many intervals."""
        for samples in (0.5, 2.0, 8.0, 32.0):
            tau = samples * usual_step(context.t)
            yield Candidate(cls(tau).column(context)[:, None], partial(cls._times, tau))

    @classmethod
    def _times(cls, tau: float, gains: FloatArray) -> "Lag | None":
        return cls(tau * float(gains[0])) if gains[0] > 0 else None

    @property
    def slow_shift(self) -> float:
        """The time constant, seconds."""
        return self.time_constant

    @property
    def settling_time(self) -> float:
        """Time (s) after which the piezo has the voltage of the command."""
        return SETTLED * self.time_constant

    @property
    def dynamics(self) -> Dynamics:
        """The lag."""
        return first_order(self.time_constant)

    def describe(self) -> str:
        """Describe the time constant."""
        return f"the piezo's voltage lags behind the command with a time constant of {self.time_constant * 1e3:.3g} ms"

    def laws(self) -> Mapping[str, float]:
        """Return the time constant (s) for the compiled inverse."""
        return {"lag": self.time_constant}

    def streaming(self) -> "StreamingLag":
        """Return the streaming lag."""
        return StreamingLag(self.time_constant)


class StreamingLag(StreamingEffect):
    """Streaming (sample by sample) first-order lag."""

    def __init__(self, time_constant: float) -> None:
        self._time_constant = time_constant
        self._input = self._output = 0.0
        self._dt, self._hold = 0.0, hold(0.0, time_constant)

    def start(self, x: float) -> None:
        """Initialise to equilibrium at `x` (V)."""
        self._input = self._output = x

    def forward(self, dt: float, x: float) -> float:
        """Advance by `dt` (s) to the command `x` (V) and return the lagged voltage (V)."""
        now, before, _ = self._over(dt)
        # In differences: at rest exact.
        output = self._output
        self._output = output = output + (now * (x - output) + before * (self._input - output))
        self._input = x
        return output

    def inverse(self, dt: float, wanted: float) -> float:
        """Return the command (V) for the lagged voltage `wanted` (V); for ``dt = 0`` return `wanted`."""
        if dt <= 0.0:
            return wanted
        now, before, kept = self._over(dt)
        shift = DAMPING * before
        return wanted + (kept * (wanted - self._output) + (before - shift) * (wanted - self._input)) / (now + shift)

    def snapshot(self) -> tuple[float, float]:
        """Return command and lagged voltage (V)."""
        return self._input, self._output

    def restore(self, state: tuple[float, float]) -> None:
        """Replace the state by one returned by `snapshot`."""
        self._input, self._output = state

    def _over(self, dt: float) -> Hold:
        if dt != self._dt:
            self._dt, self._hold = dt, hold(dt, self._time_constant)
        return self._hold
