"""The SLPI loop family: one Prandtl-Ishlinskii model per loop vertex, interpolated between vertices.

All branches follow from one Everett function ``E(alpha, beta)``, ``beta <= alpha``: the displacement between the
reversals ``alpha`` and ``beta``. A falling branch from ``alpha`` is ``y_a - E(alpha, v)``, a rising one from ``beta``
is ``y_a + E(v, beta)``, with ``y_a`` the displacement at the reversal, so every loop closes. At a grid vertex the
branch is a classical PI model with thresholds at the grid's spacing; between vertices it is interpolated.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from math import inf

import numpy as np

from slpi_ros.arrays import FloatArray
from slpi_ros.errors import ModelError
from slpi_ros.hysteresis.shapes import END, FAR, Branches, Curve

# Knots and change of a row of `Branches`.
Row = tuple[FloatArray, FloatArray]


@dataclass(frozen=True)
class LoopFamily:
    """An Everett function on a voltage grid, and the curve of the first rise; ModelError if not strictly increasing."""

    grid: FloatArray  # V, (n,), n >= 2: vertices, strictly increasing
    everett: FloatArray  # m, (n, n): ``E(grid[i], grid[j])`` for ``j < i``, 0 on the diagonal, unused above
    rise: FloatArray  # m, (n,): first rise at the vertices, strictly increasing; an offset has no effect
    edge_gain: float  # m/V, slope of the first rise outside the grid and of branches beyond it
    symmetric_rest: bool = field(default=False, init=False)
    branches: Branches = field(init=False, repr=False)

    def __post_init__(self) -> None:
        for name in ("grid", "everett", "rise"):
            object.__setattr__(self, name, np.asarray(getattr(self, name), dtype=np.float64))
        n = self.grid.size
        if n < 2 or self.grid.shape != (n,) or self.everett.shape != (n, n) or self.rise.shape != (n,):
            raise ModelError(
                f"loop family: {n} vertices, Everett function {self.everett.shape}, first rise {self.rise.shape}; "
                "the Everett function must be square and as long as the grid"
            )
        if np.any(np.diag(self.everett) != 0.0):
            raise ModelError("loop family: the diagonal of the Everett function must be zero")
        triangle = np.where(np.tri(n, dtype=bool), self.everett, 0.0)
        below, beside = np.tri(n - 1, dtype=bool), np.diff(triangle, axis=1)[1:]
        up, down = np.diff(triangle, axis=0)[:, :-1][below], -beside[below]
        steps = (np.diff(self.grid), np.diff(self.rise), up, down, np.array([self.edge_gain], dtype=np.float64))
        if not all(np.isfinite(step).all() and np.min(step) > 0 for step in steps):
            raise ModelError(
                "loop family: grid, first rise, edge gain and every row and column of the Everett function must be "
                "finite and rise strictly"
            )
        object.__setattr__(self, "everett", triangle)
        rows, columns = [triangle[i, i::-1] for i in range(n)], [triangle[j:, j] for j in range(n)]
        top = self._edge(self.grid[-1] - self.grid[::-1], rows[-1])
        bottom = self._edge(self.grid - self.grid[0], columns[0])
        # A fall from far above, which erases the memory, has the slope of the first rise down to the grid.
        fall = np.column_stack([np.zeros(2), top + FAR / 2 * np.array([[1.0], [self.edge_gain]])])
        far = fall, np.sign(fall) * [[1.0], [self.edge_gain]]
        at_top, at_bottom = ((edge, np.zeros_like(edge)) for edge in (top, bottom))
        rising = [at_bottom, at_bottom, *_rows(self.grid, columns, top), at_top]
        falling = [far, at_top, *_rows(-self.grid[::-1], rows[::-1], bottom), at_bottom]
        vertices = np.array([[-inf, *self.grid], [-self.grid[-1] - FAR / 2, *-self.grid[::-1]]])
        object.__setattr__(self, "branches", Branches.interpolated(vertices, [rising, falling]))

    def _edge(self, u: FloatArray, f: FloatArray) -> FloatArray:
        """Return the knots, shape (2, n + 1), of branches that start at the end of the grid or beyond."""
        return np.array([np.append(u, u[-1] + END), np.append(f, f[-1] + END * self.edge_gain)])

    def branch(self, direction: int, v_turn: float) -> Curve:
        """Return the branch that starts at `v_turn` (V): an interpolated row or column of the Everett function."""
        # Beyond the grid the displacement between two reversals depends only on their distance, as in the classical PI
        # model, and the branches equal those at the end of the grid. A fall from far above, which erases the memory,
        # has the slope `edge_gain` down to the grid, and then follows the branch from the grid's upper end.
        return self.branches.curve(direction, v_turn)

    def first_rise(self, v_rest: float) -> Curve:
        """Return the curve of the first rise from `v_rest` (V)."""
        ahead = self.grid[self.grid > v_rest]
        u = np.concatenate([[0.0], ahead - v_rest])
        rise = np.interp(v_rest + u, self.grid, self.rise) + self.edge_gain * self._outside(v_rest + u)
        f = rise - rise[0]
        return Curve.of(np.array([np.append(u, u[-1] + END), np.append(f, f[-1] + END * self.edge_gain)]))

    def _outside(self, v: FloatArray) -> FloatArray:
        """Return the distance (V) of `v` (V) from the grid: positive above, negative below, 0 inside."""
        return v - np.clip(v, self.grid[0], self.grid[-1])


def _rows(vertices: FloatArray, lines: Sequence[FloatArray], edge: FloatArray) -> Iterator[Row]:
    """Yield the rows of `Branches` between vertices, for branches `lines` on the grid and `edge` beyond it."""
    for k in range(1, vertices.size):
        own, before = vertices[k:] - vertices[k], vertices[k:] - vertices[k - 1]
        # The first column is the reversal itself.
        knots = np.column_stack([np.zeros(2), [own, lines[k]], edge[:, -k - 1 :]])
        change = np.zeros_like(knots)
        change[:, 1 : before.size + 1] = ([before, lines[k - 1][1:]] - knots[:, 1 : before.size + 1]) / before[0]
        yield knots, change
