"""First-order lag, ``tau dz/dt = u - z``: exact where the input is linear between samples (first-order hold)."""

from math import exp, expm1
from typing import NamedTuple

# Below this ratio of step to time constant, series keep the digits that differences lose.
_SMALL = 1e-3


class Hold(NamedTuple):
    """``z1 = now u1 + before u0 + kept z0`` over one step; the three add up to 1."""

    now: float
    before: float
    kept: float


def hold(dt: float, time_constant: float) -> Hold:
    """Return how a lag goes on over a step `dt` (s); where no time passes, its output stays."""
    x = dt / time_constant
    moved = -expm1(-x)
    now = x / 2 - x**2 / 6 + x**3 / 24 - x**4 / 120 if x < _SMALL else 1 - moved / x
    return Hold(now, moved - now, exp(-x))
