"""The SLPI loop family: one Prandtl-Ishlinskii model per loop vertex, interpolated between vertices.

All branches are cut from one surface ``E(alpha, beta)``, ``beta <= alpha``: the displacement between the turning
points ``alpha`` and ``beta``. A falling branch from ``alpha`` is ``y_a - E(alpha, v)``, a rising one from ``beta`` is
``y_a + E(v, beta)``, so every loop closes. At a grid vertex the branch is a classical PI model with thresholds at the
grid's spacing; between vertices it is interpolated.
"""

from bisect import bisect_left, bisect_right
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from slpi_ros.errors import ModelError
from slpi_ros.hysteresis.shape import END, Curve

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class LoopFamily:
    """The surface of branches, and the curve of the first rise.

    Parameters
    ----------
    grid : ndarray, shape (n,), volts
        Vertices, strictly increasing, n >= 2.
    surface : ndarray, shape (n, n), metres
        ``surface[i, j] = E(grid[i], grid[j])`` for ``j < i``; zero on the diagonal;
        what lies above the diagonal is not used.
        Strictly increasing with ``i`` and strictly decreasing with ``j``.
    rise : ndarray, shape (n,), metres
        Displacement of the first rise at the grid's vertices, strictly increasing; its offset does not matter.
    edge_gain : float, metres per volt
        Slope of every branch outside the grid, positive.

    Raises
    ------
    ModelError
        If the arrays do not fit each other or a branch would not rise strictly.
    """

    grid: FloatArray
    surface: FloatArray
    rise: FloatArray
    edge_gain: float
    symmetric_rest: bool = field(default=False, init=False)
    _nodes: list[float] = field(init=False, repr=False)
    _nodes_down: list[float] = field(init=False, repr=False)
    _rows_down: list[list[float]] = field(init=False, repr=False)
    _columns_up: list[list[float]] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        """Check the surface and lay its rows and columns out in the order in which branches run through them."""
        n = self.grid.size
        if n < 2 or self.surface.shape != (n, n) or self.rise.shape != (n,):
            raise ModelError(
                f"loop family: {n} vertices, surface {self.surface.shape}, first rise {self.rise.shape}; "
                "the surface must be square and as long as the grid"
            )
        triangle = np.where(np.tri(n, dtype=bool), self.surface, 0.0)
        below, beside = np.tri(n - 1, dtype=bool), np.diff(triangle, axis=1)[1:]
        up, down = np.diff(triangle, axis=0)[:, :-1][below], -beside[below]
        steps = (np.diff(self.grid), np.diff(self.rise), up, down, np.array([self.edge_gain]))
        if not all(np.isfinite(step).all() and np.min(step) > 0 for step in steps):
            raise ModelError("loop family: grid, first rise and every row and column of the surface must rise strictly")
        nodes = self.grid.tolist()
        object.__setattr__(self, "surface", triangle)
        object.__setattr__(self, "_nodes", nodes)
        object.__setattr__(self, "_nodes_down", nodes[::-1])
        object.__setattr__(self, "_rows_down", [triangle[i, i::-1].tolist() for i in range(n)])
        object.__setattr__(self, "_columns_up", [triangle[j:, j].tolist() for j in range(n)])

    def branch(self, direction: int, v_turn: float) -> Curve:
        """Return the branch that starts at `v_turn` (V): a row or a column of the surface, interpolated."""
        if direction > 0:
            return self._sweep(v_turn, self._nodes, self._columns_up, 1)
        return self._sweep(v_turn, self._nodes_down, self._rows_down, -1)

    def _sweep(self, v_turn: float, nodes: list[float], lines: list[list[float]], s: int) -> Curve:
        """Walk from `v_turn` along `nodes`, which run in direction `s`, on the lines of its two neighbours.

        ``lines[k]`` starts at grid vertex k, where the surface is zero.
        """
        gain, n = self.edge_gain, len(nodes)
        ahead = self._first_node_ahead(v_turn, s)
        if ahead == n:
            return Curve([0.0, END], [0.0, END * gain])
        u = [s * (node - v_turn) for node in nodes[ahead:]]
        near = ahead if s > 0 else n - 1 - ahead
        if ahead == 0:
            f = [value + gain * u[0] for value in lines[near]]
        else:
            share = u[0] / (nodes[ahead] - nodes[ahead - 1]) * s
            rest = 1.0 - share
            behind = lines[near - s]
            f = [share * b + rest * a for a, b in zip(lines[near], behind[1:], strict=True)]
        if u[0] > 0.0:
            u.insert(0, 0.0)
            f.insert(0, 0.0)
        u.append(u[-1] + END)
        f.append(f[-1] + END * gain)
        return Curve(u, f)

    def _first_node_ahead(self, v_turn: float, s: int) -> int:
        """Index, counted in direction `s`, of the first vertex at or ahead of `v_turn`."""
        if s > 0:
            return bisect_left(self._nodes, v_turn)
        return len(self._nodes) - bisect_right(self._nodes, v_turn)

    def first_rise(self, v_rest: float) -> Curve:
        """Return the first rise from `v_rest` (V)."""
        rise = self.extended_rise
        start = rise(v_rest)
        ahead = [node for node in self._nodes if node > v_rest]
        u = [0.0, *(node - v_rest for node in ahead)]
        f = [0.0, *(rise(node) - start for node in ahead)]
        u.append(u[-1] + END)
        f.append(f[-1] + END * self.edge_gain)
        return Curve(u, f)

    def extended_rise(self, v: float) -> float:
        """Return the first-rise curve at `v` (V), also outside the grid, metres."""
        inside = min(max(v, self._nodes[0]), self._nodes[-1])
        return float(np.interp(inside, self.grid, self.rise)) + self.edge_gain * (v - inside)
