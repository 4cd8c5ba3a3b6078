"""Assign each sample of a voltage to its branch, using the stack of reversals, which is the same for all models."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from slpi_ros.hysteresis.reversals import monotone_runs
from slpi_ros.hysteresis.turning_points import END, Curve, Memory

FloatArray = NDArray[np.float64]

# Values of `Piece.origin` for branches that started before the first sample.
AT_REST, LONG_FALL = -1, -2


class Piece(NamedTuple):
    """Samples ``start:stop`` on one branch, which started at sample `origin`, or is `AT_REST` or the `LONG_FALL`."""

    start: int
    stop: int
    direction: int
    origin: int


_IDENTITY = Curve.of(np.array([[0.0, END], [0.0, END]]))


class _Straight:
    """A shape without hysteresis, used only to update the stack of reversals."""

    def __init__(self, symmetric_rest: bool) -> None:
        self.symmetric_rest = symmetric_rest

    def branch(self, direction: int, v_turn: float) -> Curve:
        """Return the identity curve."""
        return _IDENTITY

    def first_rise(self, v_rest: float) -> Curve:
        """Return the identity curve."""
        return self.branch(1, v_rest)


def trace(v: FloatArray, *, symmetric_rest: bool, primed: bool = False) -> list[Piece]:
    """Divide a voltage signal into pieces that each lie on one branch.

    Parameters
    ----------
    v : ndarray, shape (N,), volts
        Voltage; the first value, which may be repeated, is the rest voltage.
    symmetric_rest : bool
        As in `slpi_ros.hysteresis.turning_points.Shape`.
    primed : bool
        As in `slpi_ros.hysteresis.turning_points.Memory`.

    Returns
    -------
    list of Piece
        Pieces in order; together they cover all samples except the initial ones at rest.
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
