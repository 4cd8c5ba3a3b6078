"""Assign each sample of a voltage to its branch, using the stack of reversals, which is the same for all models."""

from math import inf

import numpy as np

from slpi_ros.arrays import FloatArray, IntArray
from slpi_ros.hysteresis.shapes import END, Branches, Curve
from slpi_ros.hysteresis.turning_points import Memory, worth_compiling

# Origins of branches that started before the first sample.
AT_REST, LONG_FALL = -1, -2


class _Straight:
    """A shape without hysteresis, used only to update the stack of reversals."""

    _line = Curve.of(np.array([[0.0, END], [0.0, END]]))
    branches = Branches.interpolated(np.empty((2, 0)), 2 * [[(_line.knots, 0.0 * _line.knots)]])

    def __init__(self, symmetric_rest: bool) -> None:
        self.symmetric_rest = symmetric_rest

    def branch(self, direction: int, v_turn: float) -> Curve:
        """Return the identity curve."""
        return self._line

    def first_rise(self, v_rest: float) -> Curve:
        """Return the identity curve."""
        return self._line


def trace(v: FloatArray, *, symmetric_rest: bool, primed: bool = False) -> tuple[IntArray, IntArray]:
    """Return the origin and the direction of the branch of each sample of a voltage `v` (V), shape (N,) each.

    The first voltage, which may be repeated, is the rest voltage. The origin is the sample at which the branch started,
    or `AT_REST` or `LONG_FALL`; the direction is +1 rising, -1 falling, 0 at rest, or -1 at rest if `primed`.
    `symmetric_rest` is as in `Shape`, `primed` as in `Memory`.
    """
    v = np.require(v, np.float64, ("C", "W"))
    # Row 2 is the stack: the sample of each reversal.
    walk = np.full((3, v.size + primed), LONG_FALL)
    if v.size:
        memory = Memory(_Straight(symmetric_rest), float(v[0]), float(v[0]), primed=primed)
        if worth_compiling(v.size):
            memory.run_compiled(v, 0, -inf, inf, walk)
        else:
            depth = memory.depth
            for n, voltage in enumerate(v.tolist()):
                memory.forward(voltage)
                if memory.depth > depth:
                    walk[2, depth] = n - 1
                depth = memory.depth
                walk[:2, n] = walk[2, depth - 1] if depth else AT_REST, memory.direction
    return walk[0, : v.size], walk[1, : v.size]
