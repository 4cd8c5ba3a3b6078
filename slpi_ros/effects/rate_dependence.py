"""Rate dependence: loops widen as the drive gets faster, more than a linear filter makes them."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from typing import ClassVar

import numpy as np
from scipy.signal import savgol_filter

from slpi_ros.effects.checks import require
from slpi_ros.effects.effect import Around, FloatArray, Removable, Side
from slpi_ros.effects.form import Form, Left
from slpi_ros.effects.rate_follower import RateFollower
from slpi_ros.effects.uniform import Uniform
from slpi_ros.errors import ModelError
from slpi_ros.hysteresis.runs import monotone_runs

# Powers, and ways as shares of the voltage range, that are looked for.
EXPONENTS, TRANSITIONS = (0.2, 0.5, 0.8), (0.01, 0.04, 0.12)

# Samples over which the rate is smoothed where the whole path is known.
WINDOW = 7


@dataclass(frozen=True)
class RateDependence:
    """``y = h + (|du/dt| / r)^e (widening (h - m(u)) - backlash z)``.

    ``m`` is the middle of the largest loop, and ``z`` the direction of the voltage ``u``, -1 to 1: after a turn it
    comes round with the way, ``dz = (sign(du) - z) |du| / transition``.

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
        Way after a turn within which the direction comes round, to 1/e.
    uncertainty : mapping of str to float
    """

    name: ClassVar[str] = "rate_dependence"
    side: ClassVar[Side] = "displacement"
    removable: ClassVar[Removable] = "always"

    widening: float
    backlash: float
    exponent: float
    reference_rate: float
    transition: float
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
        )

    def apply(self, signal: FloatArray, around: Around) -> FloatArray:
        """Return the displacement of the wider loops, shape (N,), metres."""
        middle, speed, direction = self._drive(around)
        return signal + speed * (self.widening * (signal - middle) - self.backlash * direction)

    def invert(self, signal: FloatArray, around: Around) -> FloatArray:
        """Return the displacement of the loops at rest, shape (N,), metres, for the voltage that drives them."""
        middle, speed, direction = self._drive(around)
        back = signal + speed * (self.widening * middle + self.backlash * direction)
        return np.asarray(back / (1 + speed * self.widening), dtype=np.float64)

    @classmethod
    def fit(cls, left: Left) -> Iterator[Form]:
        """Yield several powers of the rate, with quick and slow turns."""
        reference = float(np.sqrt(np.mean(np.gradient(left.u, left.t) ** 2)))
        for exponent in EXPONENTS:
            for transition in (float(share * np.ptp(left.u)) for share in TRANSITIONS):
                one = cls(1.0, 1e-6, exponent, reference, transition)
                parts = (replace(one, backlash=0.0), replace(one, widening=0.0))
                columns = np.column_stack([part.apply(left.h, left.around) - left.h for part in parts])
                yield Form(columns, partial(cls._times, one), positive=2)

    @staticmethod
    def _times(one: "RateDependence", gains: FloatArray) -> "RateDependence | None":
        wider, behind = gains.tolist()
        return replace(one, widening=wider, backlash=behind * one.backlash) if gains.max() > 0 else None

    def describe(self) -> str:
        """Say how much at which rate."""
        parts = [f"by {self.widening * 100:.3g} %"] if self.widening else []
        parts += [f"by {self.backlash * 1e9:.3g} nm on either side"] if self.backlash else []
        return (
            f"at {self.reference_rate:.3g} V/s the loops are wider {' and '.join(parts) or 'by nothing'}, "
            f"and at other rates as their power {self.exponent:.2g}"
        )

    def follower(self) -> RateFollower:
        """Return the effect sample by sample."""
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
