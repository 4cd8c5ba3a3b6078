"""Rate dependence: loops widen as the drive gets faster, more than a linear filter makes them.

It has two forms. What is lost to friction shows on the displacement: loops wider about their middle, and a backlash.
Where the thresholds themselves grow, the hysteresis sees the voltage through a play (see `coercivity`).
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from typing import ClassVar, overload

import numpy as np
from scipy.signal import savgol_filter

from slpi_ros.effects.base import Form, Left
from slpi_ros.effects.checks import require
from slpi_ros.effects.coercivity import CoercivityFollower, play, reversible, settled_rate
from slpi_ros.effects.effect import Around, FloatArray, Removable, Side
from slpi_ros.effects.rate_follower import RateFollower
from slpi_ros.effects.uniform import Uniform
from slpi_ros.errors import ModelError
from slpi_ros.hysteresis.runs import monotone_runs

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

    def apply(self, signal: FloatArray, around: Around) -> FloatArray:
        """Return the displacement of the wider loops, shape (N,), metres; or the voltage at the hysteresis, volts."""
        if self.coercivity:
            return play(signal, self._growth(settled_rate(around.t, signal, self.settling)))
        middle, speed, direction = self._drive(around)
        return signal + speed * (self.widening * (signal - middle) - self.backlash * direction)

    def invert(self, signal: FloatArray, around: Around) -> FloatArray:
        """Return the displacement of the loops at rest, shape (N,), metres, for the voltage that drives them.

        Or the command, shape (N,), volts, for the voltage at the hysteresis, whose rate is taken for its own.
        """
        if self.coercivity:
            half_width = self._growth(settled_rate(around.t, signal, self.settling))
            return signal + half_width * np.sign(np.gradient(signal)) if signal.size > 1 else signal.copy()
        middle, speed, direction = self._drive(around)
        back = signal + speed * (self.widening * middle + self.backlash * direction)
        return np.asarray(back / (1 + speed * self.widening), dtype=np.float64)

    def aside(self, v: FloatArray, u: FloatArray) -> FloatArray:
        """Return what goes round the hysteresis, shape (N,), metres, at commands `v` where that sees `u`, volts."""
        return reversible(v, self.reversible) - reversible(u, self.reversible)

    @classmethod
    def fit(cls, left: Left) -> Iterator[Form]:
        """Yield several powers of the rate: on the displacement with quick and slow turns, and as coercivity."""
        reference = float(np.sqrt(np.mean(np.gradient(left.u, left.t) ** 2)))
        yield from cls._losing(left, reference)
        yield from cls._coercive(left, reference)

    @classmethod
    def _losing(cls, left: Left, reference: float) -> Iterator[Form]:
        for exponent in EXPONENTS:
            for transition in (float(share * np.ptp(left.u)) for share in TRANSITIONS):
                one = cls(1.0, 1e-6, exponent, reference, transition)
                parts = (replace(one, backlash=0.0), replace(one, widening=0.0))
                columns = np.column_stack([part.apply(left.h, left.around) - left.h for part in parts])
                yield Form(columns, partial(cls._times, one), positive=2)

    @classmethod
    def _coercive(cls, left: Left, reference: float) -> Iterator[Form]:
        span, onset = float(np.ptp(left.u)), COERCIVE_ONSET * reference
        for share in COERCIVITIES:
            one = cls(0.0, 0.0, COERCIVE_EXPONENT, reference, span, share * span, onset, SETTLING)
            u = one.apply(left.u, left.around)
            through = [left.u**power - u**power for power in range(1, POWERS + 1)]
            yield Form(np.column_stack([left.respond(u) - left.h, *through]), partial(cls._grown, one))

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

    def follower(self) -> RateFollower | CoercivityFollower:
        """Return the effect sample by sample."""
        if self.coercivity:
            return CoercivityFollower(self._growth, self.settling, self.reversible)
        return RateFollower(self.widening, self.backlash, self.exponent, self.reference_rate, self.transition)

    def _drive(self, around: Around) -> tuple[FloatArray, FloatArray, FloatArray]:
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
