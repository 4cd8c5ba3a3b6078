"""Rate dependence: loops widen with the logarithm of the rate, as thermally activated domain walls do."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial
from itertools import chain, product, repeat
from math import copysign, exp, log, sqrt
from typing import TYPE_CHECKING, Any

import numpy as np

from slpi_ros.arrays import FloatArray
from slpi_ros.effects.base import Candidate, Effect, EffectContext, FitContext, StreamingAround, Unsure, by_record
from slpi_ros.effects.excitation import DriveLimits, DrivePath, Excitation, loops, move, remaining, safe_duration
from slpi_ros.effects.parameters import Fit, parameter
from slpi_ros.hysteresis.rate_law import followed, solved

if TYPE_CHECKING:
    from slpi_ros.hysteresis.turning_points import Memory

# Thresholds of the candidates, as shares of the voltage range, and onset rates, as shares of the rms rate.
# With a slow onset the law explains creep, too; fits from a slow and from a fast one end at different laws.
THRESHOLDS, ONSETS = (0.002, 0.01, 0.04), ((1e-5, 1e-3), (0.1, 1.0))
# A law whose threshold is below this share of the candidate's is another one.
LEAST_SHARE = 0.05
# A record begins with a hold if it rests for at least this many samples, within this share of the voltage range.
HOLD_SAMPLES, AT_REST = 50, 1e-3
# Age (s) of the step before a hold, as a share of the hold, with which its fit begins.
AGE = 0.1
# Smallest age of a step, in units of the threshold over the onset rate, and the age from which nothing is left of it.
SOONEST, FORGOTTEN = 1e-12, 10.0
# A state at the start below this size (V) is none.
NO_START = 1e-6


def _draw(path: DrivePath, limits: DriveLimits) -> None:
    spans, doublings, count = (0.6, 0.3, 0.15), 3, 2
    # Loops of one span take 2 (1 + 2 + 4) times the shortest leg.
    quickest = remaining(limits) / (len(spans) * count * 2 * (2**doublings - 1))
    quickest = max(quickest, limits.quickest(spans[0]), safe_duration(spans[0]))
    for span in spans:
        move(path, 0.5 - span / 2)
        for doubling in range(doublings):
            loops(path, 0.5 - span / 2, 0.5 + span / 2, quickest * 2**doubling, count)


@dataclass(frozen=True)
class RateDependence(Effect):
    """Rate law of the hysteresis (Eyring), ``v = u + c asinh((du/dt) / s0)``, ``y = H[u] + g (v - u)``.

    The hysteresis ``H`` feels the voltage ``u``, which follows the applied voltage ``v``; the reversible part ``g`` of
    the displacement does not wait for it. Both directions are solved exactly at each sample, by backward differences.

    References
    ----------
    H. Eyring, Viscosity, plasticity, and diffusion as examples of absolute reaction rates, J. Chem. Phys. 4, 283, 1936.
    """

    acts_on = "hysteresis"
    side = "stage"
    what = (
        "loops widen with the logarithm of the drive rate, and creep at rest, by one law (Eyring): "
        "`v = u + c asinh(u'/s0)`, with a reversible part that does not wait"
    )
    compensated = "exactly"
    time_shift = "partly"
    dynamic = True
    excitation = Excitation(
        "Loops of three sizes at three speeds each, some of different size at the same volts per second: a linear "
        "filter treats these alike, loops that widen with the drive rate do not.",
        _draw,
        separates=("lag", "delay"),
    )

    threshold: float = parameter(
        "V", "half-width c that loops gain for each factor of e in the rate", 0, 1e5,
        fit=Fit("logarithmic", 1e-4, 1e-6),
    )  # fmt: skip
    onset_rate: float = parameter(
        "V/s", "rate s0 above which they widen", 1e-12, 1e12, fit=Fit("logarithmic", 1e-4, 1e-9)
    )
    reversible_gain: float = parameter(
        "m/V", "gain g of the reversible part", 0, 1e3, default=0.0,
        fit=Fit("linear", lambda _, of: 1e-9 / of.voltage, 0.0),
    )  # fmt: skip
    # Of the records of the fit, other than 0 after a step just before them; any other one starts at equilibrium, as
    # streaming does.
    initial: tuple[float, ...] = parameter(
        "V", "difference v - u at the start of each record", -1e5, 1e5, default=(), count=(0, 1000),
        fit=Fit("relative", start=True),
    )  # fmt: skip

    @property
    def unsure(self) -> Unsure:
        """The creep of the law, which goes on for ever: beyond the records it is true within half of it either way."""
        return Unsure(slow_volts=self.threshold / sqrt(12.0))

    @classmethod
    def limited(cls, changed: dict[str, Any]) -> dict[str, Any]:
        """Return new parameters, with 0 for small states at the start."""
        return changed | {"initial": tuple(0.0 if abs(lead) < NO_START else lead for lead in changed["initial"])}

    def plausible(self, context: FitContext) -> bool:
        """Return whether the records reach the rate above which loops widen, and these by less than the range."""
        # Below that rate the law is a lag, ``c / s0``.
        widest = self.threshold * float(np.arcsinh(context.fastest / self.onset_rate))
        return self.onset_rate <= context.fastest and widest <= float(np.ptp(context.v))

    @property
    def lasting(self) -> "RateDependence":
        """The law without the starts of its records."""
        return replace(self, initial=())

    def of_record(self, k: int) -> "RateDependence":
        """Return the law with the start of the record of number `k` of those that it was fitted to."""
        return replace(self, initial=self.initial[k : k + 1])

    def apply(self, signal: FloatArray, around: EffectContext) -> FloatArray:
        """Return the voltage that the hysteresis feels, shape (N,), volts."""
        from slpi_ros.hysteresis.compiled import felt

        leads, law = chain(self.initial, repeat(0.0)), (self.threshold, self.onset_rate)
        return around.each(lambda v, record: felt(record.t, v, *law, next(leads)), signal)

    def beside(self, v: FloatArray, u: FloatArray) -> FloatArray:
        """Return the reversible displacement, shape (N,), m, for applied voltages `v` and felt ones `u`, volts."""
        lead = v - u
        lead *= self.reversible_gain
        return lead

    @by_record
    def invert(self, signal: FloatArray, around: EffectContext) -> FloatArray:
        """Return the applied voltage, shape (N,), volts, for the felt voltage `signal`; it starts at equilibrium."""
        dt, change, v = np.diff(around.t), np.diff(signal), signal.copy()
        moving = np.where(dt > 0.0, np.arcsinh(change / (self.onset_rate * np.where(dt > 0.0, dt, 1.0))), 0.0)
        # A change in no time leaves the difference as it was.
        last = np.maximum.accumulate(np.where(dt > 0.0, np.arange(dt.size), -1))
        v[1:] += self.threshold * np.where(last >= 0, moving[last], 0.0)
        return v

    @classmethod
    def fit(cls, context: FitContext) -> Iterator[Candidate]:
        """Yield laws over a grid of thresholds and onset rates, with a free reversible gain."""
        rate, span = float(np.sqrt(np.mean(np.gradient(context.u, context.t) ** 2))), float(np.ptp(context.u))
        records = zip(*(context.around.split(each) for each in (context.t, context.u, context.y)), strict=True)
        holds = [_hold(t, u, y, span) for t, u, y in records]
        for group, onsets in enumerate(ONSETS):
            for share, onset in product(THRESHOLDS, onsets):
                one = cls(share * span, onset * rate)
                one = replace(one, initial=tuple(copysign(one.after(AGE * abs(hold)), hold) for hold in holds))
                u = one.apply(context.u, context.around)
                columns = np.column_stack([context.respond(u) - context.h, context.u - u])
                yield Candidate(columns, partial(cls._grown, one), positive=2, group=group)

    @staticmethod
    def _grown(one: "RateDependence", gains: FloatArray) -> "RateDependence | None":
        times, reversible = gains.tolist()
        if times < LEAST_SHARE:
            return None
        initial = tuple(times * lead for lead in one.initial) if any(one.initial) else ()
        return replace(one, threshold=times * one.threshold, reversible_gain=reversible / times, initial=initial)

    def after(self, age: float) -> float:
        """Return the difference ``v - u`` (V), without its sign, a time `age` (s) after a large step; 0 for no age."""
        old = self.onset_rate * age / self.threshold if self.threshold else 0.0
        return 2.0 * self.threshold * float(np.arctanh(exp(-max(old, SOONEST)))) if 0.0 < old < FORGOTTEN else 0.0

    def describe(self) -> str:
        """Describe the widening for each decade of the rate, and where it begins."""
        decade = self.threshold * log(10.0)
        beside = f"; a part of the motion, {self.reversible_gain * 1e9:.3g} nm per volt, follows the voltage at once"
        return (
            f"above {self.onset_rate:.3g} V/s, a voltage that changes ten times faster widens the loops by "
            f"{decade:.3g} V on either side{beside if self.reversible_gain else ''}"
        )

    def laws(self) -> Mapping[str, FloatArray]:
        """Return threshold (V), onset rate (V/s) and reversible gain (m/V) for the compiled inverse."""
        return {"rate": np.array([self.threshold, self.onset_rate, self.reversible_gain])}

    def streaming(self) -> "StreamingRateDependence":
        """Return the streaming rate law."""
        return StreamingRateDependence(self)


class StreamingRateDependence(StreamingAround):
    """Streaming (sample by sample) rate law around the hysteresis."""

    def __init__(self, law: RateDependence) -> None:
        self._c, self._s0, self._g = law.threshold, law.onset_rate, law.reversible_gain
        self._v = self._u = 0.0
        self._wish: float | None = None
        # Magnitudes of ``w`` of the last samples, for the first guess of the next one.
        self._w = self._before = self._earlier = 0.0

    def start(self, x: float) -> None:
        """Initialise to equilibrium at `x` (V)."""
        self.restore((x, x))

    def forward(self, dt: float, x: float) -> float:
        """Advance by `dt` (s) to the applied voltage `x` (V) and return the voltage (V) that the hysteresis feels."""
        self._wish = None
        scale = self._s0 * dt
        if scale > 0.0:
            way = x - self._u
            if way:
                self._w = solved(scale, self._c, abs(way), self._w)
                self._u = followed(self._c, x, self._u, self._w)
        else:
            # In no time the difference between the two voltages stays what it was.
            self._u += x - self._v
        self._v = x
        return self._u

    def inverse(self, dt: float, wanted: float, memory: "Memory", lower: float, upper: float) -> float:
        """Return the voltage (V) within limits for a displacement (m), `dt` (s) later; the memory moves to ``u``."""
        scale = self._s0 * dt
        if scale > 0.0:
            before, earlier = self._before, self._earlier
            self._earlier, self._before = before, self._w
            guess = 3.0 * before - 2.0 * earlier
            w = memory.inverse_of_law(wanted, self._g * self._c, self._c, scale, lower, upper, guess)
            self._w, self._u = abs(w), memory.voltage
            v = self._u + self._c * w
            self._v = lower if v < lower else upper if v > upper else v
        elif self._wish != wanted:
            lead = self._v - self._u
            self._u = memory.inverse(wanted - self._g * lead, lower - lead, upper - lead)
            self._v = min(max(self._u + lead, lower), upper)
        self._wish = wanted
        return self._v

    @property
    def applied(self) -> float:
        """Applied voltage (V)."""
        return self._v

    @property
    def beside(self) -> float:
        """Reversible displacement (m) beside that of the hysteresis."""
        return self._g * (self._v - self._u)

    def resume(self, other: "StreamingRateDependence", x: float) -> None:
        """Take over the voltages of another model's law."""
        self.restore(other.snapshot())

    def snapshot(self) -> tuple[float, float]:
        """Return applied and felt voltage (V)."""
        return self._v, self._u

    def restore(self, state: tuple[float, float]) -> None:
        """Replace the state by one returned by `snapshot`."""
        self._w = self._before = self._earlier = 0.0
        self.undo(state)

    def undo(self, state: tuple[float, float]) -> None:
        """Go back to the voltages before this sample; what it found remains the first guess."""
        self._v, self._u = state
        self._wish = None


def _hold(t: FloatArray, u: FloatArray, y: FloatArray, span: float) -> float:
    """Return the duration (s) of the hold with which a record begins, with the sign of its creep; 0 without one."""
    moved = np.abs(u - u[0]) > AT_REST * span
    end = int(np.argmax(moved)) if moved.any() else u.size
    if end < HOLD_SAMPLES:
        return 0.0
    share = end // 5
    return float(np.copysign(t[end - 1] - t[0], np.mean(y[end - share : end]) - np.mean(y[:share])))
