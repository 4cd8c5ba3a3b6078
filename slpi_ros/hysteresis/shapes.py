"""Shapes of the branches of a hysteresis model, as its engine needs them."""

from collections.abc import Sequence
from typing import NamedTuple, Protocol

import numpy as np

from slpi_ros.arrays import FloatArray, IntArray

# Largest distance of a voltage from rest (V); the last knot of every branch lies `END` beyond the others.
FAR = 1e5
END = 4 * FAR


class Curve(NamedTuple):
    """A branch shape ``F`` as knots (V, m), increasing from ``u[0] = f[0] = 0``; the last `END` beyond the others."""

    # The knots are stored as lists for a fast scalar search and as an array, shape (2, k).
    u: list[float]
    f: list[float]
    knots: FloatArray

    @classmethod
    def of(cls, knots: FloatArray) -> "Curve":
        """Return the curve through knots, shape (2, k), volts and metres."""
        u, f = knots.tolist()
        return cls(u, f, knots)


class Branches(NamedTuple):
    """All branches of a shape as arrays, for the compiled engine; index 0 rising, 1 falling (voltages negated)."""

    # A branch is interpolated between vertices or composed of operators. Row k of `knots`, `change` and `last` is for
    # branches that start above vertex k - 1, up to vertex k.
    vertices: FloatArray = np.empty((2, 0))  # V, (2, n), ascending
    knots: FloatArray = np.empty((2, 0, 2, 0))  # V and m, (2, n + 1, 2, m), from vertex k
    change: FloatArray = np.empty((2, 0, 2, 0))  # their derivative with respect to the start's distance (V) below k
    last: IntArray = np.empty((2, 0), dtype=np.int64)  # (2, n + 1), index of the last knot
    operators: FloatArray = np.empty((2, 0))  # (2, k): thresholds (V), weights (m/V) of `MultiSlope`
    scale: tuple[float, float] = (0.0, 0.0)  # V, its origin and amplitude

    @classmethod
    def interpolated(cls, vertices: FloatArray, rows: Sequence[Sequence[tuple[FloatArray, FloatArray]]]) -> "Branches":
        """Return the branches for `rows` of knots and change, shape (2, k) each, n + 1 rows for each direction."""
        last = np.array([[knots.shape[1] - 1 for knots, _ in side] for side in rows], dtype=np.int64)
        packed = np.zeros((2, *last.shape, 2, int(last.max()) + 1))
        for side, of_side in enumerate(rows):
            for row, pair in enumerate(of_side):
                packed[:, side, row, :, : last[side, row] + 1] = pair
        return cls(vertices, packed[0], packed[1], last)

    def curve(self, direction: int, v_turn: float) -> Curve:
        """Return the interpolated branch that starts in `direction` at `v_turn` (V)."""
        side, u_turn = int(direction < 0), direction * v_turn
        vertices = self.vertices[side]
        row = int(vertices.searchsorted(u_turn))
        distance = vertices[row] - u_turn if row < vertices.size else 0.0
        count = self.last[side, row] + 1
        return Curve.of(self.knots[side, row, :, :count] + self.change[side, row, :, :count] * distance)


class Shape(Protocol):
    """Shapes of the branches of a hysteresis model, as `Memory` requires them."""

    @property
    def symmetric_rest(self) -> bool:
        """Whether the first loop closes at the mirror image of its reversal about the rest point (symmetric rest)."""
        # If not, the rest point is the low end of all loops: a rise after a fall from rest closes at the rest point.

    @property
    def branches(self) -> Branches:
        """All branches as arrays."""

    def branch(self, direction: int, v_turn: float) -> Curve:
        """Return the shape of the branch that starts in `direction` at the reversal `v_turn` (V)."""

    def first_rise(self, v_rest: float) -> Curve:
        """Return the shape of the first rise from rest at `v_rest` (V)."""
