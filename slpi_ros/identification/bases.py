"""Bases of the models that are linear in their parameters: branch increments, roughness, monotonicity constraints."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np
import scipy.sparse as sp

from slpi_ros.arrays import FloatArray, IntArray
from slpi_ros.hysteresis.kinds import Hysteresis
from slpi_ros.hysteresis.loop_family import LoopFamily
from slpi_ros.hysteresis.prandtl_ishlinskii import PrandtlIshlinskii
from slpi_ros.hysteresis.turning_points import worth_compiling
from slpi_ros.identification.design_matrix import Walk

# Least slope of a branch as a share of the mean gain, so that every branch has an inverse.
LEAST_GAIN = 0.02
# Weight of the penalty that keeps the first rise parallel to a rise from the low end.
RISE_TIE = 0.1
# Share of the grid whose mean slope extrapolates the largest branches beyond the grid.
END_SHARE = 0.1
# Number of vertices for which roughness is scaled, so that a weight has the same effect on every grid.
REFERENCE_VERTICES = 41


def banded(band: Sequence[float], rows: int, columns: int) -> sp.csr_array:
    """Return the matrix, shape (rows, columns), each row of which holds `band` from the diagonal on."""
    diagonals = np.repeat(np.array(band)[:, None], columns, axis=1)
    return sp.csr_array(sp.dia_array((diagonals, np.arange(len(band))), shape=(rows, columns)))


class Basis(Protocol):
    """Interface of a basis; its parameters ``x``, shape (size + 1,), end with the displacement at rest."""

    @property
    def size(self) -> int:
        """Number of parameters without the displacement at rest."""

    @property
    def symmetric_rest(self) -> bool:
        """As in `slpi_ros.hysteresis.shapes.Shape`."""

    def branch_part(self, walk: Walk) -> sp.csr_array:
        """Return the displacement increment along each sample's branch per unit of each parameter, shape (N, size)."""

    def increments(self, walk: Walk, x: FloatArray) -> FloatArray:
        """Return the product of `branch_part` and parameters `x`, shape (size,), without the matrix, shape (N,)."""

    @property
    def roughness(self) -> sp.csr_array:
        """The matrix R, shape (r, size + 1), of the roughness penalty ``|R x|^2`` on the coefficients x."""

    def monotone(self, gain: float) -> tuple[sp.csr_array, FloatArray]:
        """Return ``C``, shape (m, size + 1), and bound of ``C x >= bound``, for a mean gain in units of x per volt."""

    def shape(self, x: FloatArray, gain: float) -> Hysteresis:
        """Return the model with parameters `x` (m) and mean gain `gain` (m/V)."""

    def covered(self, branch_part: sp.csr_array) -> float:
        """Return the share of the parameters that the samples of a `branch_part` determine, 0..1."""


@dataclass(frozen=True)
class SurfaceBasis:
    """Basis of the loop family on a uniform grid (V): Everett values below the diagonal, then the first rise."""

    grid: FloatArray
    symmetric_rest: bool = False

    @property
    def size(self) -> int:
        """Number of Everett values below the diagonal plus values of the first rise."""
        n = self.grid.size
        return n * (n - 1) // 2 + n

    @cached_property
    def _column(self) -> IntArray:
        """Parameter index of each vertex pair, shape (n, n); -1 on and above the diagonal."""
        n = self.grid.size
        column = np.full((n, n), -1)
        column[np.tril_indices(n, -1)] = np.arange(n * (n - 1) // 2)
        return column

    @property
    def _rise_columns(self) -> IntArray:
        n = self.grid.size
        return n * (n - 1) // 2 + np.arange(n)

    def branch_part(self, walk: Walk) -> sp.csr_array:
        """Return rows of the signed Everett function from reversal to sample, or of the first rise up to the sample."""
        v, v_origin, sign = walk.v, walk.v_origin, walk.direction.astype(np.float64)
        rises, falls_long = walk.first_rise, walk.long_fall
        upper, lower = np.maximum(v, v_origin), np.minimum(v, v_origin)
        part = self._surface_rows(upper, lower, np.where(rises | falls_long, 0.0, sign))
        if falls_long.any():
            top = np.full(v.size, self.grid[-1])
            fall = falls_long.astype(np.float64)
            part = part + self._surface_rows(top, walk.v_rest, fall) - self._surface_rows(top, v, fall)
        if rises.any():
            rise = rises.astype(np.float64)
            part = part + self._rise_rows(v, rise) - self._rise_rows(v_origin, rise)
        return sp.csr_array(part)

    def increments(self, walk: Walk, x: FloatArray) -> FloatArray:
        """Return the increment along the branch of each sample for parameters `x`, shape (size,), in their unit."""
        surface, rise = self._surface(x), x[self._rise_columns]
        rises, falls_long = walk.first_rise, walk.long_fall
        upper, lower = np.maximum(walk.v, walk.v_origin), np.minimum(walk.v, walk.v_origin)
        along = self._everett(surface, upper, lower) * np.where(rises | falls_long, 0, walk.direction)
        if falls_long.any():
            v, top = walk.v[falls_long], np.full(np.count_nonzero(falls_long), self.grid[-1])
            fallen = self._everett(surface, top, walk.v_rest[falls_long]) - self._everett(surface, top, v)
            along[falls_long] = fallen
        if rises.any():
            v, v_origin = walk.v[rises], walk.v_origin[rises]
            along[rises] = np.interp(v, self.grid, rise) - np.interp(v_origin, self.grid, rise)
        return along

    def _surface(self, x: FloatArray) -> FloatArray:
        """Return the Everett function at the vertices, shape (n, n), of parameters `x`; 0 on and above the diagonal."""
        n = self.grid.size
        surface = np.zeros((n, n))
        surface[np.tril_indices(n, -1)] = x[: n * (n - 1) // 2]
        return surface

    def _everett(self, surface: FloatArray, upper: FloatArray, lower: FloatArray) -> FloatArray:
        """Return the Everett function interpolated as in `_surface_rows`, shape (N,)."""
        (i, p), (j, q) = self._cell(upper), self._cell(lower)
        flat, at = surface.ravel(), i * self.grid.size + j
        below, above = flat[at], flat[at + self.grid.size]
        left, right = below + p * (above - below), flat[at + 1]
        right = right + p * (flat[at + self.grid.size + 1] - right)
        between: FloatArray = np.where(i == j, (p - q) * above, left + q * (right - left))
        return between

    def _cell(self, v: FloatArray) -> tuple[IntArray, FloatArray]:
        x = (v - self.grid[0]) / (self.grid[1] - self.grid[0])
        cell = np.clip(x.astype(np.int64), 0, self.grid.size - 2)
        return cell, x - cell

    def _surface_rows(self, upper: FloatArray, lower: FloatArray, factor: FloatArray) -> sp.csr_array:
        """Return rows of `factor` times the Everett function: bilinear, linear in cells on the diagonal."""
        if worth_compiling(upper.size):
            from slpi_ros.identification.compiled_design import surface_rows

            low, step = float(self.grid[0]), float(self.grid[1] - self.grid[0])
            pointers, indices, values = surface_rows(upper, lower, factor, low, step, self.grid.size)
            return sp.csr_array((values, indices, pointers), shape=(upper.size, self.size))
        moved = np.flatnonzero(factor)
        (i, p), (j, q), by = self._cell(upper[moved]), self._cell(lower[moved]), factor[moved]
        # In ascending order of the parameters.
        weights = np.stack([by * (1 - p) * (1 - q), by * (1 - p) * q, by * p * (1 - q), by * p * q], axis=1)
        columns = np.stack(
            [self._column[i, j], self._column[i, j + 1]] + [self._column[i + 1, j + k] for k in (0, 1)], 1
        )
        on_diagonal = np.flatnonzero(i == j)
        weights[on_diagonal] = 0.0
        weights[on_diagonal, 2] = (by * (p - q))[on_diagonal]
        return self._rows(moved, columns, np.where(columns < 0, 0.0, weights), upper.size)

    def _rise_rows(self, v: FloatArray, factor: FloatArray) -> sp.csr_array:
        moved = np.flatnonzero(factor)
        (cell, p), by = self._cell(v[moved]), factor[moved]
        columns = self._rise_columns[np.stack([cell, cell + 1], axis=1)]
        return self._rows(moved, columns, np.stack([by * (1 - p), by * p], axis=1), v.size)

    def _rows(self, at: IntArray, columns: IntArray, values: FloatArray, count: int) -> sp.csr_array:
        """Return a matrix of `count` rows with `values` in some `columns`, shape (m, k) each, of the rows `at` (m,)."""
        used, filled = values != 0.0, np.zeros(count + 1, dtype=np.int64)
        filled[at + 1] = np.count_nonzero(used, axis=1)
        return sp.csr_array((values[used], columns[used], np.cumsum(filled)), shape=(count, self.size))

    @cached_property
    def roughness(self) -> sp.csr_array:
        """Rows of the roughness penalty, shape (r, size + 1)."""
        # Third differences along branches penalise uneven loops; second differences along the diagonal penalise uneven
        # change of the loops from vertex to vertex (zero for the classical PI model); the first rise is penalised for
        # curvature and for deviation from the rise that starts at the low end.
        n, column, rise = self.grid.size, self._column, self._rise_columns
        i, j = np.tril_indices(n, -1)
        scale = n / REFERENCE_VERTICES
        along = [
            self._differences([(i + k, j, w) for k, w in enumerate((-1.0, 3.0, -3.0, 1.0))]),
            self._differences([(i, j - k, w) for k, w in enumerate((-1.0, 3.0, -3.0, 1.0))]),
        ]
        across = self._differences([(i + k, j + k, w) for k, w in enumerate((1.0, -2.0, 1.0))])
        bend = banded((1.0, -2.0, 1.0), n - 2, n)
        step = banded((-1.0, 1.0), n - 1, n)
        low_end = sp.csr_array((np.ones(n - 1), (np.arange(1, n), column[1:, 0])), shape=(n, self.size))
        as_rise = sp.csr_array((np.ones(n), (np.arange(n), rise)), shape=(n, self.size))
        first = sp.csr_array(([1.0], ([0], [rise[0]])), shape=(1, self.size))
        blocks = [scale**2 * block for block in along] + [scale * across]
        blocks += [scale * bend @ as_rise, RISE_TIE * step @ (as_rise - low_end), RISE_TIE * first]
        rows = sp.vstack(blocks, format="csr")
        return sp.csr_array(sp.hstack([rows, sp.csr_array((rows.shape[0], 1))], format="csr"))

    def _differences(self, stencil: list[tuple[IntArray, IntArray, float]]) -> sp.csr_array:
        """Return rows of weighted sums of Everett values for stencils within the triangle; the diagonal is zero."""
        n = self.grid.size
        fits = np.ones(stencil[0][0].size, dtype=bool)
        for i, j, _ in stencil:
            fits &= (i < n) & (j >= 0) & (i >= j)
        rows = np.arange(np.count_nonzero(fits))
        total = sp.csr_array((rows.size, self.size))
        for i, j, weight in stencil:
            column = self._column[i[fits], j[fits]]
            on = column >= 0
            total = total + sp.csr_array((np.full(on.sum(), weight), (rows[on], column[on])), shape=total.shape)
        return sp.csr_array(total)

    def monotone(self, gain: float) -> tuple[sp.csr_array, FloatArray]:
        """Return the constraints that branches and first rise have at least the share `LEAST_GAIN` of the mean gain."""
        n = self.grid.size
        i, j = np.tril_indices(n, -1)
        upward = self._differences([(i, j, 1.0), (i - 1, j, -1.0)])
        downward = self._differences([(i, j, 1.0), (i, j + 1, -1.0)])
        rise = sp.csr_array(
            (np.tile([-1.0, 1.0], n - 1), (np.repeat(np.arange(n - 1), 2), np.repeat(self._rise_columns, 2)[1:-1])),
            shape=(n - 1, self.size),
        )
        rows = sp.vstack([upward, downward, rise], format="csr")
        least = LEAST_GAIN * gain * (self.grid[1] - self.grid[0])
        matrix = sp.hstack([rows, sp.csr_array((rows.shape[0], 1))], format="csr")
        return sp.csr_array(matrix), np.full(rows.shape[0], least)

    def shape(self, x: FloatArray, gain: float) -> LoopFamily:
        """Return the loop family with parameters `x` (m); `gain` is not used."""
        n = self.grid.size
        surface = self._surface(x)
        last = max(1, round(END_SHARE * n))
        risen, fallen = surface[-1, 0] - surface[-1 - last, 0], surface[-1, 0] - surface[-1, last]
        edge_gain = float(risen + fallen) / (2 * last * float(self.grid[1] - self.grid[0]))
        return LoopFamily(self.grid, surface, x[self._rise_columns] - x[self._rise_columns[0]], edge_gain)

    def covered(self, branch_part: sp.csr_array) -> float:
        """Return the share of the Everett values that the samples of a `branch_part` determine, 0..1."""
        pairs = self.size - self.grid.size
        touched = np.unique(branch_part.indices)
        return float(np.count_nonzero(touched < pairs) / pairs)


class OperatorWeights(ABC):
    """Base class of bases with one weight for each operator; `thresholds` (V) has shape (size,)."""

    thresholds: FloatArray

    @property
    def size(self) -> int:
        """Number of operators."""
        return self.thresholds.size

    @property
    def roughness(self) -> sp.csr_array:
        """Return a zero row: the non-negative weights need no roughness penalty."""
        return sp.csr_array((1, self.size + 1))

    def increments(self, walk: Walk, x: FloatArray) -> FloatArray:
        """Return the increment along the branch of each sample for parameters `x`, shape (size,), in their unit."""
        along: FloatArray = self.branch_part(walk) @ x
        return along

    @abstractmethod
    def branch_part(self, walk: Walk) -> sp.csr_array:
        """Return the motion of each operator along the branch of each sample, shape (N, size)."""

    def monotone(self, gain: float) -> tuple[sp.csr_array, FloatArray]:
        """Return the constraints of non-negative weights and a positive weight at the lowest threshold."""
        bound = np.zeros(self.size)
        bound[0] = LEAST_GAIN * gain
        return banded((1.0,), self.size, self.size + 1), bound

    def covered(self, branch_part: sp.csr_array) -> float:
        """Return the share of operators that move within the samples of a `branch_part`, 0..1."""
        return float(np.count_nonzero(np.unique(branch_part.indices) < self.size) / self.size)


@dataclass(frozen=True)
class PlayBasis(OperatorWeights):
    """Basis of the classical PI model with one weight for each threshold (V)."""

    thresholds: FloatArray
    symmetric_rest: bool = True

    def branch_part(self, walk: Walk) -> sp.csr_array:
        """Return the motion (V) of each play operator along the branch of each sample, shape (N, size)."""
        way = np.abs(walk.v - walk.v_origin)[:, None]
        play = np.where(walk.from_rest[:, None], 1.0, 2.0) * self.thresholds
        play[walk.long_fall] = 0.0
        moved = np.maximum(way - play, 0.0) * walk.direction[:, None]
        return sp.csr_array(moved)

    def shape(self, x: FloatArray, gain: float) -> PrandtlIshlinskii:
        """Return the PI model with weights `x` (m/V); `gain` is not used."""
        return PrandtlIshlinskii(self.thresholds, np.maximum(x[:-1], 0.0))
