"""Rate dependence: loops widen as the drive gets faster, more than a linear filter makes them.

It has two forms. What is lost to friction shows on the displacement: loops wider about their middle, and a backlash.
Where the thresholds themselves grow, the hysteresis sees the voltage through a play (see `coercivity`).
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from math import copysign, exp
from typing import ClassVar, overload

import numpy as np
from scipy.signal import savgol_filter

from slpi_ros.effects.base import (
    Candidate,
    EffectContext,
    FloatArray,
    Removable,
    ResidualView,
    Side,
    by_record,
    require,
)
from slpi_ros.effects.filters import Uniform
from slpi_ros.errors import ModelError
from slpi_ros.hysteresis.reversals import monotone_runs

CoercivityState = tuple[float, float, float, float]

# The reversible part is nearly linear over a coercivity: so many chords lead to where it has a value.
CHORDS = 8
# A command at the end of the play, to rounding, is not inside.
INSIDE = 1 - 1e-9


def reversible(v: FloatArray, gains: Sequence[float]) -> FloatArray:
    """Return the reversible part, shape (N,), metres, at voltages, shape (N,), volts."""
    return np.asarray(np.polynomial.polynomial.polyval(v, [0.0, *gains]), dtype=np.float64)


class StreamingCoercivity:
    """The play sample by sample.

    The command for a desired displacement depends on its own rate: taken from the commands, that would run away. The
    inverse takes the rate from the voltage that comes out; where that rests, from a command inside the play.

    Parameters
    ----------
    half_width : callable
        Of the play, volts, at a rate, V/s.
    settling, reversible
        As in `RateDependence`.
    """

    def __init__(self, half_width: Callable[[float], float], settling: float, reversible: Sequence[float]) -> None:
        self._half_width, self._settling, self._reversible = half_width, settling, tuple(reversible)
        self.start(0.0)

    def start(self, x: float) -> None:
        """Be at rest at `x` (V)."""
        self._v = self._u = x
        self._rate = self._rate_out = 0.0

    def forward(self, dt: float, x: float) -> float:
        """Move to the command `x` (V), `dt` (s) later; return the voltage (V) that the hysteresis sees."""
        way, before = x - self._v, self._u
        self._rate = self._settled(dt, self._rate, way)
        half_width = self._half_width(self._rate)
        self._v, self._u = x, min(max(before, x - half_width), x + half_width)
        moved = self._u - before
        if moved or abs(x - before) < INSIDE * self._half_width(self._rate_out):
            self._rate_out = self._settled(dt, self._rate_out, moved or way)
        return self._u

    def inverse(self, dt: float, wanted: float) -> float:
        """Return the command (V) for a voltage (V) at the hysteresis."""
        way = wanted - self._u
        return self.ahead(wanted, copysign(1.0, way)) if way else self._v

    def ahead(self, u: float, direction: float) -> float:
        """Return the command (V) that moves the hysteresis on at `u` (V), in a direction, -1 or 1."""
        return u + direction * self._half_width(self._rate_out)

    def within(self, reversible_bypass: float) -> tuple[float | None, float]:
        """Return the command (V) that leads a displacement (m) round the resting hysteresis; None: that must move.

        The other number is the direction of the command from the middle of the play, -1 or 1.
        """
        low, high = (self.between(self.ahead(self._u, side), self._u) for side in (-1.0, 1.0))
        direction = 1.0 if reversible_bypass > 0.5 * (low + high) else -1.0
        if not low < reversible_bypass < high:
            return None, direction
        v, slope = self._u, 0.5 * (high - low) / self._half_width(self._rate_out)
        for _ in range(CHORDS):
            v += (reversible_bypass - self.between(v, self._u)) / slope
        return v, direction

    @property
    def reversible_bypass(self) -> float:
        """Displacement (m) that goes round the hysteresis."""
        return self.between(self._v, self._u)

    def between(self, v: float, u: float) -> float:
        """Return what goes round the hysteresis (m) at a command `v` (V) where that sees `u` (V)."""
        return sum(gain * (v**power - u**power) for power, gain in enumerate(self._reversible, start=1))

    def snapshot(self) -> CoercivityState:
        """Return both voltages and their rates."""
        return self._v, self._u, self._rate, self._rate_out

    def restore(self, state: CoercivityState) -> None:
        """Take over a state from `snapshot`."""
        self._v, self._u, self._rate, self._rate_out = state

    def _settled(self, dt: float, before: float, way: float) -> float:
        if dt <= 0.0:
            return before
        rate = abs(way) / dt
        return rate + (before - rate) * (exp(-dt / self._settling) if self._settling else 0.0)


# Share of the latest rate in the smoothed one.
SMOOTHING = 0.5
# Time over which rates of voltage and displacement are compared, seconds.
COMPARISON = 0.02

RateState = tuple[float | None, float, float, float | None, float, float, float]


class StreamingRateDependence:
    """Rate dependence sample by sample; it looks at the voltage too.

    The voltage for a desired displacement depends on its own rate: taken from the voltages, that would run away. The
    inverse therefore takes the rate from the desired displacements, and only slowly learns how the two compare.

    Parameters
    ----------
    widening, backlash, exponent, reference_rate, transition : float
        As in `RateDependence`.
    """

    def __init__(
        self, widening: float, backlash: float, exponent: float, reference_rate: float, transition: float
    ) -> None:
        self._widening, self._backlash = widening, backlash
        self._exponent, self._reference_rate, self._transition = exponent, reference_rate, transition
        self._middle: Callable[[float], float] = float
        self.start(0.0)

    def attach(self, middle: Callable[[float], float]) -> None:
        """Tell where the middle of the largest loop is: displacement (m) at a voltage (V)."""
        self._middle = middle

    def start(self, x: float) -> None:
        """Be at rest at `x` (m); the next voltage is the one it rests at."""
        self._u: float | None = None
        self._rate = self._direction = self._desired_rate = self._volts = self._metres = 0.0
        self._desired: float | None = x
        self._asked: float | None = None

    def drive(self, dt: float, u: float) -> None:
        """Note the voltage `u` (V), `dt` (s) after the last one."""
        way = 0.0 if self._u is None else u - self._u
        if dt > 0.0:
            self._rate += SMOOTHING * (way / dt - self._rate)
            self._compare(dt, way)
        if self._asked is not None or dt > 0.0:
            self._desired, self._asked = self._asked, None
        self._direction = self._turned(way)
        self._u = u

    def forward(self, dt: float, x: float) -> float:
        """Return the displacement (m) of the wider loops for one of the loops at rest (m)."""
        if self._u is None or not self._rate:
            return x
        behind = self._backlash * self._direction
        return x + self._speed(self._rate) * (self._widening * (x - self._middle(self._u)) - behind)

    def inverse(self, dt: float, wanted: float) -> float:
        """Return the displacement (m) of the loops at rest for one of the wider loops (m)."""
        self._asked = wanted
        if self._u is None or self._desired is None or dt <= 0.0:
            return wanted
        rate = (
            self._desired_rate + SMOOTHING * ((wanted - self._desired) / dt - self._desired_rate)
        ) * self._volts_per_metre()
        speed, middle = self._speed(rate), self._middle(self._u + rate * dt)
        back = wanted + speed * (self._widening * middle + self._backlash * self._turned(rate * dt))
        return back / (1 + speed * self._widening)

    def snapshot(self) -> RateState:
        """Return voltage, rate, direction, and what is known of the desired displacements."""
        return self._u, self._rate, self._direction, self._desired, self._desired_rate, self._volts, self._metres

    def restore(self, state: RateState) -> None:
        """Take over a state from `snapshot`."""
        self._u, self._rate, self._direction, self._desired, self._desired_rate, self._volts, self._metres = state
        self._asked = None

    def _turned(self, way: float) -> float:
        """Return the direction after a way (V)."""
        if not way:
            return self._direction
        toward = copysign(1.0, way)
        return toward + (self._direction - toward) * exp(-abs(way) / self._transition)

    def _speed(self, rate: float) -> float:
        return float((abs(rate) / self._reference_rate) ** self._exponent)

    def _compare(self, dt: float, way: float) -> None:
        """Note the last desired displacement, and how its rate compares with that of the voltage."""
        if self._asked is None or self._desired is None:
            self._desired_rate = 0.0
            return
        went = self._asked - self._desired
        self._desired_rate += SMOOTHING * (went / dt - self._desired_rate)
        kept = exp(-dt / COMPARISON)
        self._volts = kept * self._volts + abs(way)
        self._metres = kept * self._metres + abs(went)

    def _volts_per_metre(self) -> float:
        """Return by how many volts the voltage goes on for each metre: as in the middle of the loop, and as of late."""
        u = self._u or 0.0
        slope = 1 / max((self._middle(u + 1.0) - self._middle(u - 1.0)) / 2, 1e-15)
        seen = self._volts / self._metres if self._metres > 0.0 else slope
        return min(max(seen, slope / 3), 3 * slope)


# Powers, and ways as shares of the voltage range, that are looked for.
EXPONENTS, TRANSITIONS = (0.2, 0.5, 0.8), (0.01, 0.04, 0.12)

# Where thresholds grow, the search goes on from one law, with little and much coercivity (share of the voltage range).
COERCIVE_EXPONENT, COERCIVE_ONSET, SETTLING, COERCIVITIES = 0.3, 0.1, 2e-3, (0.02, 0.06)
# Gains of the reversible part.
POWERS, MOST_POWERS = 3, 6

# Samples over which the rate is smoothed where the whole path is known.
WINDOW = 7


@dataclass(frozen=True)
class RateDependence:
    """``y = h + (|du/dt| / r)^e (widening (h - m(u)) - backlash z)``, or a coercivity ``c (|dv/dt| / r)^e``.

    In the first form ``m`` is the middle of the largest loop, and ``z`` the direction of the voltage ``u``, -1 to
    1: after a turn it comes round with the way, ``dz = (sign(du) - z) |du| / transition``. In the second form the
    hysteresis sees ``u = play(v)`` of half-width ``c (s / r)^e``, where ``s`` follows ``|dv/dt|``, and the reversible
    part ``R(v) - R(u)``, ``R(v) = g1 v + g2 v^2 + ..``, goes round it. An instance is of one form.

    Parameters
    ----------
    widening : float
        How much wider the loops are at the reference rate.
    backlash : float, metres
        By how much the stage stays behind at the reference rate.
    exponent : float
        ``e``.
    reference_rate : float, V/s
        ``r``.
    transition : float, volts
        Way after a turn within which the direction comes round, to 1/e; of the first form.
    coercivity : float, volts
        ``c``; 0 for the first form.
    onset : float, V/s
        The coercivity grows as ``(1 + s / onset)^e - 1``: with a small exponent, as a logarithm. 0: as ``s^e``.
    settling : float, seconds
        Time constant with which the coercivity gets used to another rate.
    reversible : tuple of float, m/V, m/V^2, ..
        Gains of the part that the coercivity does not hold back.
    uncertainty : mapping of str to float
    """

    name: ClassVar[str] = "rate_dependence"
    removable: ClassVar[Removable] = "always"

    widening: float
    backlash: float
    exponent: float
    reference_rate: float
    transition: float
    coercivity: float = 0.0
    onset: float = 0.0
    settling: float = 0.0
    reversible: tuple[float, ...] = ()
    uncertainty: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Refuse what cannot be undone."""
        require(
            self,
            ("widening", 0 <= self.widening <= 10, "from 0 to 10"),
            ("backlash", abs(self.backlash) <= 1, "within 1 m"),
            ("exponent", 0 < self.exponent <= 4, "more than 0, at most 4"),
            ("reference_rate", 1e-9 <= self.reference_rate <= 1e12, "from 1e-9 to 1e12 V/s"),
            ("transition", 1e-9 <= self.transition <= 1e5, "from 1e-9 to 1e5 V"),
            ("coercivity", 0 <= self.coercivity <= 1e5, "from 0 to 1e5 V"),
            ("settling", 0 <= self.settling <= 100, "from 0 to 100 s"),
            ("onset", 0 <= self.onset <= 1e12, "from 0 to 1e12 V/s"),
            ("reversible", len(self.reversible) <= MOST_POWERS, f"at most {MOST_POWERS} gains"),
            ("coercivity", not (self.coercivity and (self.widening or self.backlash)), "0 beside other parts"),
        )

    @property
    def side(self) -> Side:
        """Where it acts: on the voltage where thresholds grow."""
        return "voltage" if self.coercivity else "displacement"

    @by_record
    def apply(self, signal: FloatArray, around: EffectContext) -> FloatArray:
        """Return the displacement of the wider loops, shape (N,), metres; or the voltage at the hysteresis, volts."""
        if self.coercivity:
            from slpi_ros.effects.coercivity_path import play, settled_rate

            return play(signal, self._growth(settled_rate(around.t, signal, self.settling)))
        middle, speed, direction = self._drive(around)
        return signal + speed * (self.widening * (signal - middle) - self.backlash * direction)

    def invert(self, signal: FloatArray, around: EffectContext) -> FloatArray:
        """Return the displacement of the loops at rest, shape (N,), metres, for the voltage that drives them.

        Or the command, shape (N,), volts, for the voltage at the hysteresis, whose rate is taken for its own.
        """
        if self.coercivity:
            from slpi_ros.effects.coercivity_path import settled_rate

            half_width = self._growth(settled_rate(around.t, signal, self.settling))
            return signal + half_width * np.sign(np.gradient(signal)) if signal.size > 1 else signal.copy()
        middle, speed, direction = self._drive(around)
        back = signal + speed * (self.widening * middle + self.backlash * direction)
        return np.asarray(back / (1 + speed * self.widening), dtype=np.float64)

    def reversible_bypass(self, v: FloatArray, u: FloatArray) -> FloatArray:
        """Return what goes round the hysteresis, shape (N,), metres, at commands `v` where that sees `u`, volts."""
        return reversible(v, self.reversible) - reversible(u, self.reversible)

    @classmethod
    def fit(cls, left: ResidualView) -> Iterator[Candidate]:
        """Yield several powers of the rate: on the displacement with quick and slow turns, and as coercivity."""
        reference = float(np.sqrt(np.mean(np.gradient(left.u, left.t) ** 2)))
        yield from cls._losing(left, reference)
        yield from cls._coercive(left, reference)

    @classmethod
    def _losing(cls, left: ResidualView, reference: float) -> Iterator[Candidate]:
        for exponent in EXPONENTS:
            for transition in (float(share * np.ptp(left.u)) for share in TRANSITIONS):
                one = cls(1.0, 1e-6, exponent, reference, transition)
                parts = (replace(one, backlash=0.0), replace(one, widening=0.0))
                columns = np.column_stack([part.apply(left.h, left.around) - left.h for part in parts])
                yield Candidate(columns, partial(cls._times, one), positive=2)

    @classmethod
    def _coercive(cls, left: ResidualView, reference: float) -> Iterator[Candidate]:
        span, onset = float(np.ptp(left.u)), COERCIVE_ONSET * reference
        for share in COERCIVITIES:
            one = cls(0.0, 0.0, COERCIVE_EXPONENT, reference, span, share * span, onset, SETTLING)
            u = one.apply(left.u, left.around)
            through = [left.u**power - u**power for power in range(1, POWERS + 1)]
            yield Candidate(np.column_stack([left.respond(u) - left.h, *through]), partial(cls._grown, one))

    @staticmethod
    def _grown(one: "RateDependence", gains: FloatArray) -> "RateDependence | None":
        times, *through = gains.tolist()
        if times <= 0:
            return None
        return replace(one, coercivity=times * one.coercivity, reversible=tuple(gain / times for gain in through))

    @staticmethod
    def _times(one: "RateDependence", gains: FloatArray) -> "RateDependence | None":
        wider, behind = gains.tolist()
        return replace(one, widening=wider, backlash=behind * one.backlash) if gains.max() > 0 else None

    def describe(self) -> str:
        """Say how much at which rate."""
        if self.coercivity:
            return (
                f"at {self.reference_rate:.3g} V/s the coercivity is {self.coercivity:.3g} V larger than at rest, "
                f"and at other rates {self._law()}"
            )
        parts = [f"by {self.widening * 100:.3g} %"] if self.widening else []
        parts += [f"by {self.backlash * 1e9:.3g} nm on either side"] if self.backlash else []
        return (
            f"at {self.reference_rate:.3g} V/s the loops are wider {' and '.join(parts) or 'by nothing'}, "
            f"and at other rates as their power {self.exponent:.2g}"
        )

    def _law(self) -> str:
        if not self.onset:
            return f"as their power {self.exponent:.2g}"
        return f"as the power {self.exponent:.2g} of 1 + rate / {self.onset:.3g} V/s, nearly their logarithm"

    def streaming(self) -> StreamingRateDependence | StreamingCoercivity:
        """Return the effect sample by sample."""
        if self.coercivity:
            return StreamingCoercivity(self._growth, self.settling, self.reversible)
        return StreamingRateDependence(
            self.widening, self.backlash, self.exponent, self.reference_rate, self.transition
        )

    def _drive(self, around: EffectContext) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return the loop's middle (m), the speed to the power and the direction, shape (N,) each."""
        if around.u is None or around.middle is None:
            raise ModelError("effect 'rate_dependence' needs the voltage that drives the hysteresis, and its loop")
        return around.middle(around.u), self._speed(around.t, around.u), self._direction(around.u)

    def _speed(self, t: FloatArray, u: FloatArray) -> FloatArray:
        grid = Uniform.over(t)
        if not grid.dt or u.size < WINDOW:
            return np.zeros_like(u)
        rate = savgol_filter(grid.on(u), WINDOW, 2, deriv=1, delta=grid.dt)
        return grid.off((np.abs(rate) / self.reference_rate) ** self.exponent)

    def _direction(self, u: FloatArray) -> FloatArray:
        if not self.backlash:
            return np.zeros_like(u)
        direction, now = np.zeros_like(u), 0.0
        for start, stop in monotone_runs(u):
            turn = u[max(start - 1, 0)]
            way = float(np.sign(u[stop - 1] - turn))
            direction[start:stop] = way + (now - way) * np.exp(-np.abs(u[start:stop] - turn) / self.transition)
            now = float(direction[stop - 1])
        return direction

    @overload
    def _growth(self, rate: float) -> float: ...
    @overload
    def _growth(self, rate: FloatArray) -> FloatArray: ...
    def _growth(self, rate: float | FloatArray) -> float | FloatArray:
        """Return the coercivity (V) at a rate (V/s)."""
        grown: float | FloatArray = (rate / self.reference_rate) ** self.exponent
        if self.onset:
            at_reference = (1 + self.reference_rate / self.onset) ** self.exponent - 1
            grown = ((1 + rate / self.onset) ** self.exponent - 1) / at_reference
        return self.coercivity * grown
