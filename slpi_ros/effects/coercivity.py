"""Coercivity that grows with the rate: the hysteresis sees the voltage through a play, its reversible part does not.

``u = play(v)`` of half-width ``c (s / r)^e``, where ``s`` follows ``|dv/dt|`` with a time constant, and what goes round
the hysteresis is ``R(v) - R(u)`` with ``R(v) = g1 v + g2 v^2 + ..``: the rate-dependent Prandtl-Ishlinskii operator
whose thresholds all grow alike.
"""

from collections.abc import Callable, Sequence
from math import copysign, exp

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
CoercivityState = tuple[float, float, float, float]

# The reversible part is nearly linear over a coercivity: so many chords lead to where it has a value.
CHORDS = 8
# A command at the end of the play, to rounding, is not inside.
INSIDE = 1 - 1e-9


def reversible(v: FloatArray, gains: Sequence[float]) -> FloatArray:
    """Return the reversible part, shape (N,), metres, at voltages, shape (N,), volts."""
    return np.asarray(np.polynomial.polynomial.polyval(v, [0.0, *gains]), dtype=np.float64)


def settled_rate(t: FloatArray, v: FloatArray, settling: float) -> FloatArray:
    """Return the rate (V/s) that a path, shape (N,), volts, has of late, from rest, at times `t`, shape (N,), s."""
    if v.size < 2:
        return np.zeros_like(v)
    # From the sample before to the one after; a follower knows only the one before.
    dt, way = (np.append(x[1:], x[-1]) - np.insert(x[:-1], 0, x[0]) for x in (t, v))
    rate = np.abs(np.divide(way, dt, out=np.zeros_like(v), where=dt > 0.0))
    kept = np.exp(-np.diff(t, prepend=t[:1]) / settling) if settling else np.zeros_like(v)
    settled, now = [], 0.0
    for value, share in zip(rate.tolist(), kept.tolist(), strict=True):
        now = value + (now - value) * share
        settled.append(now)
    return np.array(settled)


def play(v: FloatArray, half_width: FloatArray) -> FloatArray:
    """Return what is seen of a path, shape (N,), through a play of changing half-width, shape (N,), volts."""
    seen, now = np.empty_like(v), float(v[0]) if v.size else 0.0
    for place, (low, high) in enumerate(zip((v - half_width).tolist(), (v + half_width).tolist(), strict=True)):
        now = min(max(now, low), high)
        seen[place] = now
    return seen


class CoercivityFollower:
    """The play sample by sample.

    The command that a wish asks for depends on its own rate: taken from the commands, that would run away. The inverse
    takes the rate from the voltage that comes out; where that rests, from a command inside the play.

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

    def within(self, aside: float) -> tuple[float | None, float]:
        """Return the command (V) that leads a displacement (m) round the resting hysteresis; None: that must move.

        The other number is the direction of the command from the middle of the play, -1 or 1.
        """
        low, high = (self.between(self.ahead(self._u, side), self._u) for side in (-1.0, 1.0))
        direction = 1.0 if aside > 0.5 * (low + high) else -1.0
        if not low < aside < high:
            return None, direction
        v, slope = self._u, 0.5 * (high - low) / self._half_width(self._rate_out)
        for _ in range(CHORDS):
            v += (aside - self.between(v, self._u)) / slope
        return v, direction

    @property
    def aside(self) -> float:
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
