"""Decomposition of a voltage into hysteresis branches, and the design matrix of the linear prediction.

Displacement is linear in a model's parameters: the displacement of a sample is that of the reversal at which its
branch started, plus the increment along the branch. With the increments ``A_local``, the matrix ``P`` that selects
each sample's reversal and the predictions ``T`` at reversals, the displacements are ``(A_local + P T) x``;
the product is never formed.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from slpi_ros.arrays import FloatArray, IntArray, Mask
from slpi_ros.hysteresis.branches import AT_REST, LONG_FALL, trace
from slpi_ros.hysteresis.turning_points import always_compiled


@dataclass(frozen=True)
class Walk:
    """Hysteresis branch of each sample of a voltage; all arrays have shape (N,)."""

    v: FloatArray  # V
    origin: IntArray  # the sample at which the branch started, or `AT_REST` or `LONG_FALL`
    direction: IntArray  # 1: rising, -1: falling, 0: before the first motion
    first: IntArray  # the first sample of the record

    @classmethod
    def along(cls, v: FloatArray, *, symmetric_rest: bool, primed: bool) -> "Walk":
        """Find the branches of a voltage `v`, shape (N,), that starts at rest or, if `primed`, after a long fall."""
        return cls(v, *trace(v, symmetric_rest=symmetric_rest, primed=primed), np.zeros(v.size, dtype=np.int64))

    @classmethod
    def joined(cls, walks: Sequence["Walk"]) -> "Walk":
        """Concatenate the walks of several records; each record keeps its own initial state."""
        shifts = np.cumsum([0, *(walk.v.size for walk in walks[:-1])])
        moved = zip(walks, shifts.tolist(), strict=True)
        origin, first = zip(
            *((np.where(walk.origin >= 0, walk.origin + by, walk.origin), walk.first + by) for walk, by in moved),
            strict=True,
        )
        v, direction = (np.concatenate([getattr(walk, name) for walk in walks]) for name in ("v", "direction"))
        return cls(v, np.concatenate(origin), direction, np.concatenate(first))

    @cached_property
    def turns(self) -> IntArray:
        """Reversals, samples at which branches start, ascending."""
        return np.flatnonzero(np.bincount(self.origin[self.origin >= 0], minlength=1))

    @cached_property
    def branch(self) -> IntArray:
        """Index into `turns` of the reversal at which each sample's branch started, shape (N,); -1 for none."""
        place = np.empty(self.v.size, dtype=np.int64)
        place[self.turns] = np.arange(self.turns.size)
        return np.where(self.origin >= 0, place[np.maximum(self.origin, 0)], -1)

    @cached_property
    def _before(self) -> list[tuple[int, int]]:
        """Pairs of a reversal and the reversal at which its branch started, as indices into `turns`, ascending."""
        before = self.branch[self.turns]
        rows = np.flatnonzero(before >= 0)
        return list(zip(rows.tolist(), before[rows].tolist(), strict=True))

    def accumulated(self, increments: FloatArray) -> FloatArray:
        """Return the displacement of every sample, shape (N,), from its increment along its branch, shape (N,)."""
        at_turns = increments[self.turns].tolist()
        for row, before in self._before:
            at_turns[row] += at_turns[before]
        whole: FloatArray = increments + np.array([*at_turns, 0.0])[self.branch]
        return whole

    @property
    def v_rest(self) -> FloatArray:
        """Voltage at which each sample's record started, shape (N,), volts."""
        return self.v[self.first]

    @property
    def v_origin(self) -> FloatArray:
        """Voltage at which each sample's branch started, shape (N,), volts; `v_rest` for branches without reversal."""
        return np.where(self.origin >= 0, self.v[np.maximum(self.origin, 0)], self.v_rest)

    @property
    def record(self) -> IntArray:
        """Number of the record of each sample, shape (N,)."""
        return np.cumsum(self.first == np.arange(self.first.size)) - 1

    @property
    def first_rise(self) -> Mask:
        """Mask of the samples on the first rise from rest, shape (N,)."""
        return np.asarray((self.origin == AT_REST) & (self.direction > 0))

    @property
    def from_rest(self) -> Mask:
        """Mask of the samples on a branch that starts at rest, shape (N,)."""
        return np.asarray((self.origin == AT_REST) & (self.direction != 0))

    @property
    def long_fall(self) -> Mask:
        """Mask of the samples on the long fall that initialised the hysteresis state, shape (N,)."""
        return np.asarray(self.origin == LONG_FALL)


@dataclass(frozen=True)
class Design:
    """Design matrix of the linear prediction: one column per parameter, then each record's displacement at rest."""

    local: sp.csr_array  # (N, p): increments along the branch of each sample
    walk: Walk

    @property
    def turns(self) -> IntArray:
        """Reversals, samples at which branches start, ascending."""
        return self.walk.turns

    @cached_property
    def pick(self) -> sp.csr_array:
        """Sparse matrix that selects the reversal at which each sample's branch started, shape (N, reversals)."""
        branch = self.walk.branch
        on_branch = branch >= 0
        pointers = np.concatenate([[0], np.cumsum(on_branch)])
        columns = branch[on_branch]
        return sp.csr_array((np.ones(columns.size), columns, pointers), shape=(self.walk.v.size, self.turns.size))

    @cached_property
    def at_turns(self) -> sp.csr_array:
        """Rows of the linear prediction at the reversals, accumulated from earlier reversals, shape (turns, p)."""
        # Products with powers of the selection double the number of accumulated reversals: (1 + P)(1 + P^2)(1 + P^4)...
        rows, before = sp.csr_array(self.local[self.turns]), self.pick[self.turns]
        while before.nnz:
            rows, before = rows + before @ rows, before @ before
        rows.eliminate_zeros()
        return rows

    @classmethod
    def of(cls, walk: Walk, branch_part: sp.csr_array) -> "Design":
        """Return the design matrix of a `branch_part`, shape (N, size), with a column for each displacement at rest."""
        no_turn, record, size = walk.origin < 0, walk.record, branch_part.shape[1]
        ends = branch_part.indptr[1:][no_turn]
        local = sp.csr_array(
            (
                np.insert(branch_part.data, ends, 1.0),
                np.insert(branch_part.indices, ends, size + record[no_turn]),
                branch_part.indptr + np.append(0, np.cumsum(no_turn)).astype(branch_part.indptr.dtype),
            ),
            shape=(walk.v.size, size + int(record[-1]) + 1),
        )
        return cls(local, walk)

    def predict(self, x: FloatArray) -> FloatArray:
        """Return the displacement of every sample, shape (N,), for parameters `x`, shape (p,), in the unit of `x`."""
        return self.walk.accumulated(self.local @ x)

    def rows(self, chosen: NDArray[np.integer[Any]]) -> "Rows":
        """Return the rows of some samples."""
        return Rows(self.local[chosen], self.pick[chosen], self.at_turns)

    def normal_equations(self, y: FloatArray, weights: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return ``A' W A``, shape (p, p), and ``A' W y``, shape (p,), for `y` and `weights` of shape (N,)."""
        if always_compiled(y.size):
            from slpi_ros.identification.compiled_design import accumulate

            local, walk, size = self.local, self.walk, self.local.shape[1]
            half, vector = np.zeros((size, size)), np.zeros(size)
            accumulate(local.indptr, local.indices, local.data, walk.branch, walk.turns, weights, y, half, vector)
            half += half.T
            return half, vector
        chosen = np.flatnonzero(weights)
        rows = self.rows(chosen)
        return rows.gram(weights[chosen]), rows.project(weights[chosen] * y[chosen])


@dataclass(frozen=True)
class Rows:
    """Rows ``A = local + pick at_turns`` of a design matrix for n samples: shapes (n, p), (n, turns) and (turns, p)."""

    local: sp.csr_array
    pick: sp.csr_array
    at_turns: sp.csr_array

    def predict(self, x: FloatArray) -> FloatArray:
        """Return ``A x``, shape (n,)."""
        result: FloatArray = self.local @ x + self.pick @ (self.at_turns @ x)
        return result

    def weight(self, parameters: FloatArray) -> FloatArray:
        """Return the sum of the absolute coefficients of each row, shape (n,), weighted by `parameters`, shape (p,)."""
        result: FloatArray = abs(self.local) @ parameters + self.pick @ (abs(self.at_turns) @ parameters)
        return result

    def project(self, signals: FloatArray) -> FloatArray:
        """Return ``A' J`` for `signals` J, shape (n,) or (n, k)."""
        local, pick, at_turns = self._transposed
        result: FloatArray = local @ signals + at_turns @ (pick @ signals)
        return result

    @cached_property
    def _transposed(self) -> tuple[sp.csc_array, sp.csc_array, sp.csc_array]:
        return self.local.T, self.pick.T, self.at_turns.T

    def gram(self, weights: FloatArray | None = None) -> FloatArray:
        """Return ``A' W A``, shape (p, p), for `weights`, shape (n,); 1 by default."""
        local, pick = self.local.T, self.pick.T
        if weights is not None:
            diagonal = sp.dia_array((weights[None], [0]), shape=(weights.size, weights.size))
            local, pick = local @ diagonal, pick @ diagonal
        mixed = (local @ self.pick) @ self.at_turns
        whole = local @ self.local + mixed + mixed.T + self.at_turns.T @ ((pick @ self.pick) @ self.at_turns)
        result: FloatArray = whole.toarray()
        return result
