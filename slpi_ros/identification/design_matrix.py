"""A record's voltage as the stack of turning points sees it, and the linear prediction that follows from it.

Displacement is linear in a model's parameters: that of a sample is that of the turning point its branch started from,
plus what the branch adds. With ``A_local`` the branch parts, ``P`` picking each sample's turning point and ``T`` the
predictions at turning points, the whole record is ``(A_local + P T) x``; the product is never formed.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from slpi_ros.hysteresis.branches import AT_REST, LONG_FALL, trace

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class Walk:
    """Where each sample of a voltage stands.

    Parameters
    ----------
    v : ndarray, shape (N,), volts
    origin : ndarray of int, shape (N,)
        Sample at which its branch started, or `AT_REST` or `LONG_FALL`.
    direction : ndarray of int, shape (N,)
        +1, -1, or 0 for samples that still rest.
    first : ndarray of int, shape (N,)
        First sample of the record that each one belongs to: there the voltage rested.
    """

    v: FloatArray
    origin: NDArray[np.int64]
    direction: NDArray[np.int64]
    first: NDArray[np.int64]

    @classmethod
    def along(cls, v: FloatArray, *, symmetric_rest: bool, primed: bool) -> "Walk":
        """Walk through the voltage `v`, from rest (or primed) at its first value."""
        origin = np.full(v.size, LONG_FALL if primed else AT_REST)
        direction = np.full(v.size, -1 if primed else 0)
        for piece in trace(v, symmetric_rest=symmetric_rest, primed=primed):
            origin[piece.start : piece.stop] = piece.origin
            direction[piece.start : piece.stop] = piece.direction
        return cls(v, origin, direction, np.zeros(v.size, dtype=np.int64))

    @classmethod
    def joined(cls, walks: Sequence["Walk"]) -> "Walk":
        """Put the walks of several records one behind the other; each starts anew."""
        shifts = np.cumsum([0, *(walk.v.size for walk in walks[:-1])])
        moved = zip(walks, shifts.tolist(), strict=True)
        origin, first = zip(
            *((np.where(walk.origin >= 0, walk.origin + by, walk.origin), walk.first + by) for walk, by in moved),
            strict=True,
        )
        v, direction = (np.concatenate([getattr(walk, name) for walk in walks]) for name in ("v", "direction"))
        return cls(v, np.concatenate(origin), direction, np.concatenate(first))

    @property
    def v_rest(self) -> FloatArray:
        """Voltage at which each sample's record started, shape (N,), volts."""
        return self.v[self.first]

    @property
    def v_origin(self) -> FloatArray:
        """Voltage at which each sample's branch started, shape (N,), volts; where it rested, if it starts there."""
        return np.where(self.origin >= 0, self.v[np.maximum(self.origin, 0)], self.v_rest)

    @property
    def first_rise(self) -> NDArray[np.bool_]:
        """Which samples lie on the first rise from rest, shape (N,)."""
        return np.asarray((self.origin == AT_REST) & (self.direction > 0))

    @property
    def from_rest(self) -> NDArray[np.bool_]:
        """Which samples lie on a branch that leaves rest, shape (N,)."""
        return np.asarray((self.origin == AT_REST) & (self.direction != 0))

    @property
    def long_fall(self) -> NDArray[np.bool_]:
        """Which samples lie on the long fall that primed the memory, shape (N,)."""
        return np.asarray(self.origin == LONG_FALL)


@dataclass(frozen=True)
class Design:
    """The linear prediction: a column for each parameter, then one for each record's displacement at rest."""

    local: sp.csr_array
    turns: NDArray[np.int64]
    walk: Walk

    @cached_property
    def pick(self) -> sp.csr_array:
        """What picks each sample's turning point, shape (N, turns)."""
        own = np.flatnonzero(self.walk.origin >= 0)
        column = np.searchsorted(self.turns, self.walk.origin[own])
        return sp.csr_array((np.ones(own.size), (own, column)), shape=(self.walk.v.size, self.turns.size))

    @cached_property
    def at_turns(self) -> FloatArray:
        """Predictions at turning points, each from the one before it, shape (turns, p)."""
        rows: FloatArray = self.local[self.turns].toarray()
        before = self.walk.origin[self.turns]
        for row, origin in enumerate(before.tolist()):
            if origin >= 0:
                rows[row] += rows[np.searchsorted(self.turns, origin)]
        return rows

    @classmethod
    def of(cls, walk: Walk, branch_part: sp.csr_array) -> "Design":
        """Complete the `branch_part`, shape (N, size), of a basis by the columns of the displacements at rest."""
        rows = np.flatnonzero(walk.origin < 0)
        starts, record = np.unique(walk.first, return_inverse=True)
        no_turn = sp.csr_array((np.ones(rows.size), (rows, record[rows])), shape=(walk.v.size, starts.size))
        local = sp.csr_array(sp.hstack([branch_part, no_turn], format="csr"))
        return cls(local, np.unique(walk.origin[walk.origin >= 0]), walk)

    def predict(self, x: FloatArray) -> FloatArray:
        """Return the displacement of every sample, shape (N,), in the unit of `x`."""
        result: FloatArray = self.local @ x + self.pick @ (self.at_turns @ x)
        return result

    def normal_equations(self, y: FloatArray, weights: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return ``A' W A``, shape (p, p), and ``A' W y``, shape (p,), for weights of shape (N,)."""
        local, pick, at_turns = self.local, self.pick, self.at_turns
        weigh = sp.diags_array(weights)
        local_w, pick_w = (local.T @ weigh).tocsr(), (pick.T @ weigh).tocsr()
        mixed = (local_w @ pick) @ at_turns
        matrix = (local_w @ local).toarray() + mixed + mixed.T + at_turns.T @ ((pick_w @ pick) @ at_turns)
        return matrix, local_w @ y + at_turns.T @ (pick_w @ y)
