"""Find the branch on which each sample of a voltage lies: the stack of turning points moves alike for all models."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from slpi_ros.hysteresis.reversals import monotone_runs
from slpi_ros.hysteresis.turning_points import END, Curve, Memory

FloatArray = NDArray[np.float64]

# What `Piece.origin` says of branches that started before the first sample.
AT_REST, LONG_FALL = -1, -2


class Piece(NamedTuple):
    """Samples ``start:stop`` on the branch that started at sample `origin`, or `AT_REST`, or is the `LONG_FALL`."""

    start: int
    stop: int
    direction: int
    origin: int


_IDENTITY = Curve.of(np.array([[0.0, END], [0.0, END]]))


class _Straight:
    """A shape without hysteresis: enough to move the stack."""

    def __init__(self, symmetric_rest: bool) -> None:
        self.symmetric_rest = symmetric_rest

    def branch(self, direction: int, v_turn: float) -> Curve:
        """Return the identity."""
        return _IDENTITY

    def first_rise(self, v_rest: float) -> Curve:
        """Return the identity."""
        return self.branch(1, v_rest)


def trace(v: FloatArray, *, symmetric_rest: bool, primed: bool = False) -> list[Piece]:
    """Cut a voltage into the branches that its samples lie on.

    Parameters
    ----------
    v : ndarray, shape (N,), volts
        The axis rests at the first value, which may be repeated.
    symmetric_rest : bool
        As in `slpi_ros.hysteresis.turning_points.Shape`.
    primed : bool
        As in `slpi_ros.hysteresis.turning_points.Memory`.

    Returns
    -------
    list of Piece
        In order; together they hold every sample but those still at rest.
    """
    if not v.size:
        return []
    memory = Memory(_Straight(symmetric_rest), float(v[0]), float(v[0]), primed=primed)
    origins = [LONG_FALL] if primed else []
    pieces: list[Piece] = []
    for start, stop in monotone_runs(v):
        if not start:
            continue
        for begin, end in memory.split_at_closures(v, start, stop, 0):
            if memory.depth > len(origins):
                origins.append(start - 1)
            del origins[memory.depth :]
            pieces.append(Piece(begin, end, memory.direction, origins[-1] if origins else AT_REST))
            memory.advance_to(float(v[end - 1]), float(v[end - 1]))
    return pieces
