"""Hysteresis that depends on the rate of the voltage, in two physical forms."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class RateLaw:
    """How a coercivity grows with the rate: by a power, or logarithmically as thermally activated domain walls do.

    Parameters
    ----------
    strength : float
        Growth at the reference rate, in the unit of what grows.
    reference_rate : float, V/s
        At this rate the growth is `strength`.
    exponent : float
        Of the power law; 0 for the logarithmic one.
    onset : float, V/s
        Below this rate the logarithmic law is linear.
    settling : float, seconds
        Time constant with which walls get used to another rate.
    """

    strength: float
    reference_rate: float = 100.0
    exponent: float = 0.0
    onset: float = 5.0
    settling: float = 0.005

    def growth(self, t: FloatArray, v: FloatArray) -> FloatArray:
        """Return the growth along a path, shape (N,), of voltages (V) at times (s)."""
        rate = _settled(t, np.abs(np.gradient(v, t)), self.settling)
        if self.exponent:
            return np.asarray(self.strength * (rate / self.reference_rate) ** self.exponent, dtype=np.float64)
        return np.asarray(
            self.strength * np.log1p(rate / self.onset) / np.log1p(self.reference_rate / self.onset), dtype=np.float64
        )


@dataclass(frozen=True)
class Viscosity:
    """Domain walls that switch later the faster the voltage moves.

    Parameters
    ----------
    law : RateLaw
        In volts for ``coercivity``, in metres for ``friction``.
    form : {"coercivity", "friction"}
        ``coercivity``: every relay's thresholds move apart, each by the growth, so that relays see the voltage through
        a play of that half-width. ``friction``: walls drag the stage behind by a force whose direction follows the
        voltage over `transition`, and whose size is the growth.
    transition : float, volts
        Constant of the exponential with which the friction turns round.
    """

    law: RateLaw
    form: Literal["coercivity", "friction"] = "coercivity"
    transition: float = 6.0

    def relay_voltage(self, t: FloatArray, v: FloatArray) -> FloatArray:
        """Return the voltage that the relays see, shape (N,), V."""
        if self.form != "coercivity":
            return v
        half_width = self.law.growth(t, v)
        lowest, highest = (v - half_width).tolist(), (v + half_width).tolist()
        seen, played = np.empty_like(v), float(v[0]) if v.size else 0.0
        for index, (low, high) in enumerate(zip(lowest, highest, strict=True)):
            played = min(max(played, low), high)
            seen[index] = played
        return seen

    def drag(self, t: FloatArray, v: FloatArray) -> FloatArray:
        """Return by how much the stage is pulled back, shape (N,), metres."""
        if self.form != "friction":
            return np.zeros_like(v)
        direction, now = np.empty_like(v), 0.0
        for index, move in enumerate(np.diff(v, prepend=v[:1]).tolist()):
            way = 1.0 if move > 0 else -1.0
            now = way + (now - way) * float(np.exp(-abs(move) / self.transition))
            direction[index] = now
        return self.law.growth(t, v) * direction


def _settled(t: FloatArray, x: FloatArray, time_constant: float) -> FloatArray:
    """Return `x` as an element follows it that takes each sample as held since the last."""
    settled, now = np.empty_like(x), float(x[0]) if x.size else 0.0
    left = np.exp(-np.diff(t, prepend=t[:1]) / time_constant).tolist()
    for index, (share, value) in enumerate(zip(left, x.tolist(), strict=True)):
        now = value + (now - value) * share
        settled[index] = now
    return settled
