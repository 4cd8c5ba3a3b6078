"""Slew limit of the amplifier: its current bounds how fast the voltage at the piezo changes."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import partial

import numpy as np

from slpi_ros.arrays import FloatArray
from slpi_ros.effects.base import Candidate, Effect, EffectContext, FitContext, StreamingEffect, by_record
from slpi_ros.effects.excitation import DriveLimits, DrivePath, Excitation, move, remaining, safe_duration
from slpi_ros.effects.parameters import Fit, parameter

# Rates of the candidates as shares of the fastest of the drive, which is this quantile of its rates.
SHARES, FASTEST = (0.12, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 0.96), 0.999
# Gains of a candidate for which its rate is near enough.
NEAR = (0.25, 4.0)
# Smallest share of the moving samples that are faster, and largest share of all that are late by this share of the
# voltage range: an amplifier that is nearly always late has a lag.
LEAST_FASTER, MOST_LATE, LATE = 5e-4, 0.6, 0.002


def _draw(path: DrivePath, limits: DriveLimits) -> None:
    count = 8
    quickest, each = max(limits.quickest(1.0, straight=True), safe_duration(1.0)), remaining(limits) / count
    move(path, 0.0)
    for seconds in np.geomspace(max(0.6 * each, quickest), quickest, count).tolist():
        path.to(1.0 - path.at, seconds, straight=True)
        path.hold(max(each - seconds, 0.1 * each))


@dataclass(frozen=True)
class Slew(Effect):
    """Limit of the rate of the voltage at the piezo, ``|du/dt| <= rate``, which else is the command."""

    acts_on = "voltage"
    side = "stage"
    what = "the amplifier's current limits how fast its voltage changes"
    compensated = "no voltage undoes it: faster motion is out of reach, and what is late is known"
    time_shift = "partly"
    dynamic = True
    excitation = Excitation(
        "Straight ramps over the whole range, ever faster up to the slew limit, a hold after each: an amplifier at "
        "its own limit arrives later and later from one speed on and is exact below, where a lag is late at any speed.",
        _draw,
        separates=("lag", "delay"),
        order=1,
    )

    rate: float = parameter(
        "V/s", "largest rate of the voltage, up and down", 1e-6, 1e12,
        fit=Fit("relative", lambda value, _: 1e-3 * value, 1e-6),
    )  # fmt: skip

    def plausible(self, context: FitContext) -> bool:
        """Return whether a noticeable part of the drive is faster, and the voltage is late there only."""
        rates = _rates(context.t, context.v)
        late = np.abs(self.apply(context.v, context.around) - context.v) > LATE * float(np.ptp(context.v))
        moving = rates > 0.01 * np.quantile(rates, FASTEST)
        return float(np.mean(rates[moving] > self.rate)) >= LEAST_FASTER and float(np.mean(late)) <= MOST_LATE

    @by_record
    def apply(self, signal: FloatArray, around: EffectContext) -> FloatArray:
        """Return the voltage at the piezo, shape (N,), volts; exact at each sample."""
        u, reached = signal.copy(), around.start
        steps = self.rate * np.diff(around.t, prepend=around.t[:1])
        # The voltage is late from a sample that is too fast to the next one that it reaches.
        fast = np.abs(np.diff(signal, prepend=signal[:1] if reached is None else reached)) > steps
        starts = np.flatnonzero(fast).tolist()
        most, wanted, k = steps.tolist(), signal.tolist(), 0
        for first in starts:
            if first < k:
                continue
            k, now = first, reached if first == 0 and reached is not None else wanted[first - 1]
            while k < len(wanted):
                way = wanted[k] - now
                k += 1
                if -most[k - 1] <= way <= most[k - 1]:
                    break
                u[k - 1] = now = now + (most[k - 1] if way > 0.0 else -most[k - 1])
        return u

    def invert(self, signal: FloatArray, around: EffectContext) -> FloatArray:
        """Return the voltage, shape (N,), volts, as it is: what the limit takes cannot be recovered."""
        return signal.copy()

    @classmethod
    def fit(cls, context: FitContext) -> Iterator[Candidate]:
        """Yield rates below the fastest of the drive."""
        fastest = float(np.quantile(_rates(context.t, context.u), FASTEST))
        for rate in [share * fastest for share in SHARES if fastest > 0.0]:
            yield Candidate(cls(rate).column(context)[:, None], partial(cls._near, rate))

    @classmethod
    def _near(cls, rate: float, gains: FloatArray) -> "Slew | None":
        return cls(rate) if NEAR[0] <= gains[0] <= NEAR[1] else None

    def describe(self) -> str:
        """Describe the rate."""
        return f"the amplifier's voltage does not change faster than {self.rate:.4g} V/s"

    def laws(self) -> Mapping[str, float]:
        """Return the rate (V/s) for the compiled inverse."""
        return {"slew": self.rate}

    def streaming(self) -> "StreamingSlew":
        """Return the streaming limit."""
        return StreamingSlew(self.rate)


class StreamingSlew(StreamingEffect):
    """Streaming (sample by sample) limit of the rate."""

    def __init__(self, rate: float) -> None:
        self._rate, self._output = rate, 0.0

    def start(self, x: float) -> None:
        """Initialise to equilibrium at `x` (V)."""
        self._output = x

    def forward(self, dt: float, x: float) -> float:
        """Advance by `dt` (s) to the command `x` (V) and return the voltage at the piezo (V)."""
        most, way = self._rate * dt, x - self._output
        self._output = x if -most <= way <= most else self._output + (most if way > 0.0 else -most)
        return self._output

    def inverse(self, dt: float, wanted: float) -> float:
        """Return `wanted` (V)."""
        return wanted

    def snapshot(self) -> float:
        """Return the voltage at the piezo (V)."""
        return self._output

    def restore(self, state: float) -> None:
        """Replace the state by one returned by `snapshot`."""
        self._output = state


def _rates(t: FloatArray, v: FloatArray) -> FloatArray:
    """Return the rates of a voltage (V/s), without its sign, between successive samples of a record, shape (M,)."""
    dt = np.diff(t)
    return np.abs(np.diff(v)[dt > 0.0]) / dt[dt > 0.0]
