"""What a hysteresis model has to say to the engine: the shape of its branches."""

from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

# No voltage may lie farther than this from rest (V); the last knot of every branch lies `END` beyond the others.
FAR = 1e5
END = 4 * FAR


class Curve(NamedTuple):
    """A branch shape ``F`` as knots (V, m), strictly increasing from ``u[0] = f[0] = 0``, the last one `END` beyond.

    The same knots twice: as lists, which are quick to search one by one, and as an array, shape (2, k).
    """

    u: list[float]
    f: list[float]
    knots: FloatArray

    @classmethod
    def of(cls, knots: FloatArray) -> "Curve":
        """Return the curve through knots, shape (2, k)."""
        u, f = knots.tolist()
        return cls(u, f, knots)


class Shape(Protocol):
    """What a hysteresis model has to say to the engine: how a branch looks."""

    @property
    def symmetric_rest(self) -> bool:
        """Whether rest lies in the middle of the memory (virgin: the first turn closes at its mirror image).

        If not, rest is the low end of the memory: a fall from it is an ordinary branch that returns to it.
        """

    def branch(self, direction: int, v_turn: float) -> Curve:
        """Return the shape of the branch that starts in `direction` at the turning point `v_turn` (V)."""

    def first_rise(self, v_rest: float) -> Curve:
        """Return the shape of the first rise from rest at `v_rest` (V)."""
