"""Self-heating: the sensitivity of the stage follows the mean square rate of its voltage, as dissipated power."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial
from itertools import chain, repeat
from math import expm1, inf
from typing import Any

import numpy as np

from slpi_ros.arrays import FloatArray
from slpi_ros.effects.base import Candidate, Effect, EffectContext, FitContext, StreamingEffect, decays, longest
from slpi_ros.effects.excitation import DriveLimits, DrivePath, Excitation, loops, move, remaining, safe_duration
from slpi_ros.effects.parameters import Fit, parameter

# Number of time constants of the candidates; the shortest (s), and the longest as a multiple of the longest record.
TIME_CONSTANTS, SHORTEST, LONGEST = 12, 1.0, 2.0
# Largest change of the sensitivity that is plausible, and bound of the change.
LARGEST, MOST = 0.3, 0.5
# Mean square rate at the start of a record, in multiples of the largest one in the records: none below, and none that
# is plausible above, where the stage that cools down would stand for any drift of the sensitivity.
WARM, HOT = 0.02, 2.0
# Smallest fall of the mean square rate within a record, as a share of its largest: of a stage that only warms up nobody
# can say that it does not drift.
COOLS = 0.3
# A change of the sensitivity at the start below this is none.
NO_START = 1e-4
# Largest number of bursts of the drive, share of the time that they take, and number of slow loops in each pause;
# shortest time for a burst and its pause, in multiples of the shortest move over the range.
BURSTS, FAST, SLOW_LOOPS, LEAST_TIME = 3, 0.3, 2, 14


def _draw(path: DrivePath, limits: DriveLimits) -> None:
    quickest = max(limits.quickest(1.0), safe_duration(1.0))
    bursts = min(max(int(remaining(limits) / (LEAST_TIME * quickest)), 1), BURSTS)
    each = remaining(limits) / bursts
    count = max(int(FAST * each / (2 * quickest)), 2)
    slow = max(0.5 * (1.0 - FAST) * each / (2 * SLOW_LOOPS), quickest)
    for _ in range(bursts):
        loops(path, 0.0, 1.0, quickest, count)
        move(path, 1.0)
        path.hold(0.4 * (1.0 - FAST) * each)
        move(path, 0.0)
        loops(path, 0.0, 1.0, slow, SLOW_LOOPS)


@dataclass(frozen=True)
class SelfHeating(Effect):
    """A factor on the displacement, ``y = x0 + (1 + gain P) (x - x0)``, ``time_constant dP/dt = (dv/dt)^2 - P``.

    ``P`` is the mean square rate of the voltage ``v`` at the piezo, 0 at first: a stage at rest is cold.
    """

    # At each sample the rate up to the one before counts, so that the inverse needs no voltage that it is to return. A
    # change of the voltage in no time has no rate. The factor never changes by more than `MOST`.
    side = "stage"
    what = "the sensitivity follows how fast the voltage moves, within seconds to minutes"
    compensated = "yes, from a cold start"
    needs_voltage = True
    changes_gain = True
    excitation = Excitation(
        "Bursts of fast full loops, each followed by a hold at the top and slow loops: what warms the stage comes and "
        "goes with its own motion, where a drift of zero or sensitivity goes on by itself.",
        _draw,
        separates=("gain_drift", "thermal_drift"),
        order=2,
    )

    gain: float = parameter(
        "s^2/V^2", "relative change of the sensitivity for each unit of the mean square rate of the voltage", -1e6, 1e6,
        fit=Fit("linear"),
    )  # fmt: skip
    time_constant: float = parameter(
        "s", "time constant with which the stage warms up and cools down", 1e-3, 1e7,
        fit=Fit("relative", least=SHORTEST, within_record=True),
    )  # fmt: skip
    origin: float = parameter(
        "m", "displacement that does not change with the sensitivity", -1e3, 1e3, default=0.0,
        fit=Fit("linear", 1e-9, near_motion=True),
    )  # fmt: skip
    # Of the records of the fit; any other one starts cold, as streaming does.
    initial: tuple[float, ...] = parameter(
        "V^2/s^2", "mean square rate of the voltage at the start of each record, 0: cold", 0, 1e18, default=(),
        count=(0, 1000), fit=Fit("relative", least=0.0, start=True),
    )  # fmt: skip

    @classmethod
    def limited(cls, changed: dict[str, Any]) -> dict[str, Any]:
        """Return new parameters, with 0 for small states at the start."""
        least = NO_START / max(abs(changed["gain"]), 1e-300)
        return changed | {"initial": tuple(0.0 if first < least else first for first in changed["initial"])}

    @property
    def lasting(self) -> "SelfHeating":
        """The effect without the starts of its records."""
        return replace(self, initial=())

    def of_record(self, k: int) -> "SelfHeating":
        """Return the effect with the start of the record of number `k` of those that it was fitted to."""
        return replace(self, initial=self.initial[k : k + 1])

    @property
    def most(self) -> float:
        """Mean square rate (V^2/s^2) at which the change of the sensitivity is the largest that there is."""
        return MOST / abs(self.gain) if self.gain else inf

    def plausible(self, context: FitContext) -> bool:
        """Return whether the change is small, comes and goes, and has an origin near the measured displacements."""
        near = context.near_motion(self.origin)
        # The voltage that the hysteresis feels is at most as fast as that at the piezo.
        around = context.around.driven(context.u)
        rates = _mean_square_rates(self.time_constant, around)
        largest = float(rates.max())
        fall = max(float(np.max(np.maximum.accumulate(own) - own)) for own in around.split(rates))
        moderate = abs(self.gain) * largest <= LARGEST and max((0.0, *self.initial)) <= HOT * largest
        return near and moderate and fall >= COOLS * largest

    def factor(self, around: EffectContext) -> FloatArray:
        """Return ``1 + gain P``, shape (N,)."""
        return 1.0 + self.gain * _mean_square_rates(self.time_constant, around, self.initial, self.most)

    def apply(self, signal: FloatArray, around: EffectContext) -> FloatArray:
        """Return the displacement with the changed sensitivity, shape (N,), metres."""
        return self.origin + self.factor(around) * (signal - self.origin)

    def invert(self, signal: FloatArray, around: EffectContext) -> FloatArray:
        """Return the displacement of the cold stage, shape (N,), metres."""
        return self.origin + (signal - self.origin) / self.factor(around)

    @classmethod
    def fit(cls, context: FitContext) -> Iterator[Candidate]:
        """Yield time constants up to a multiple of the longest record, for cold stages and for warm ones."""
        # A shift in proportion to each change of the sensitivity is fitted with it; their ratio gives the origin.
        slowest, (low, high) = LONGEST * longest(context.around), (float(context.h.min()), float(context.h.max()))
        if not slowest > SHORTEST:
            return
        for tau in np.geomspace(SHORTEST, slowest, TIME_CONSTANTS).tolist():
            rates = _mean_square_rates(tau, context.around)
            if most := float(rates.max()):
                moved = np.column_stack([context.h - low, np.full(rates.size, high - low)])
                own, cooling = (rates / most)[:, None] * moved, decays([tau], context.around)
                yield Candidate(own, partial(cls._through, tau, most, low, high))
                warm = [cooling[:, [k]] * moved for k in range(cooling.shape[1])]
                columns = np.column_stack([*warm, own])
                yield Candidate(columns, partial(cls._through, tau, most, low, high))

    @classmethod
    def _through(cls, tau: float, most: float, low: float, high: float, found: FloatArray) -> "SelfHeating | None":
        """Return it for fitted changes and shifts; its origin is limited to the range `low` to `high` (m)."""
        *starts, change, shift = found.tolist()
        if not 0.0 < abs(change) <= LARGEST:
            return None
        warm = [start / change for start in starts[::2]]
        if starts and max(warm) < WARM:
            return None
        initial = tuple(most * share if share >= WARM else 0.0 for share in warm)
        return cls(change / most, tau, low + min(max(-shift / change, 0.0), 1.0) * (high - low), initial)

    def describe(self) -> str:
        """Describe the change at a rate, and the time constant."""
        rate = (0.01 / abs(self.gain)) ** 0.5 if self.gain else inf
        way = "falls" if self.gain < 0 else "rises"
        return (
            f"the sensitivity follows the motion: at {rate:.3g} V/s rms it {way} by 1 %, with a time constant of "
            f"{self.time_constant:.3g} s"
        )

    def laws(self) -> Mapping[str, FloatArray]:
        """Return gain (s^2/V^2), time constant (s), origin (m) and bound (V^2/s^2) for the compiled inverse."""
        return {"heating": np.array([self.gain, self.time_constant, self.origin, self.most])}

    def streaming(self) -> "StreamingSelfHeating":
        """Return the streaming self-heating, at first cold."""
        return StreamingSelfHeating(self)


class StreamingSelfHeating(StreamingEffect):
    """Streaming (sample by sample) self-heating; its state is the mean square rate and the last voltage (V)."""

    def __init__(self, effect: SelfHeating) -> None:
        self._gain, self._time_constant, self._origin = effect.gain, effect.time_constant, effect.origin
        self._most, self._dt, self._moved = effect.most, 0.0, 0.0
        self._rate = self._voltage = self._last = 0.0

    def start(self, x: float) -> None:
        """Initialise to a cold stage."""
        self._rate, self._last = 0.0, self._voltage

    def reach(self, voltage: float) -> None:
        """Note the voltage (V) at the piezo for the next `forward`."""
        self._voltage = voltage

    def forward(self, dt: float, x: float) -> float:
        """Advance by `dt` (s) to the displacement `x` (m) and return it with the changed sensitivity (m)."""
        left = self._left(dt)
        self._rate = left
        if dt > 0.0:
            rate = (self._voltage - self._last) / dt
            self._rate = min(left + self._moved * rate * rate, self._most)
        self._last = self._voltage
        return self._origin + (1.0 + self._gain * left) * (x - self._origin)

    def inverse(self, dt: float, wanted: float) -> float:
        """Return the displacement of the cold stage (m)."""
        return self._origin + (wanted - self._origin) / (1.0 + self._gain * self._left(dt))

    def resume(self, other: "StreamingSelfHeating", x: float) -> None:
        """Take over the state of another model's self-heating."""
        self.restore(other.snapshot())

    def snapshot(self) -> tuple[float, float]:
        """Return the mean square rate (V^2/s^2) and the last voltage (V)."""
        return self._rate, self._last

    def restore(self, state: tuple[float, float]) -> None:
        """Replace the state by one returned by `snapshot`."""
        self._rate, self._last = min(state[0], self._most), state[1]

    def _left(self, dt: float) -> float:
        """Return what is left of the mean square rate (V^2/s^2) after `dt` (s)."""
        if dt != self._dt:
            self._dt, self._moved = dt, -expm1(-dt / self._time_constant)
        return self._rate * (1.0 - self._moved)


def _mean_square_rates(
    time_constant: float, around: EffectContext, initial: tuple[float, ...] = (), most: float = inf
) -> FloatArray:
    """Return the mean square rate of the voltage before each sample, shape (N,), V^2/s^2, at most `most`."""
    if around.voltage is None or not around.t.size:
        return np.zeros_like(around.t)
    from slpi_ros.effects.paths import heated

    first = chain(initial, repeat(0.0))

    def rates(t: FloatArray, v: FloatArray, _: EffectContext) -> FloatArray:
        return heated(np.diff(t, prepend=t[:1]), v, time_constant, next(first), most)

    return around.each(rates, around.t, around.voltage)
