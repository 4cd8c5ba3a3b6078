"""The stack of turning points, and the branch on top of it.

Every rate-independent operator with return-point memory obeys Madelung's laws:

1. a branch is determined by the turning point it starts from;
2. it heads for the turning point before that one and passes through it: the loop closes;
3. once a loop is closed both its turning points are forgotten, and the older branch goes on.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from math import inf

import numpy as np
from numpy.typing import NDArray

from slpi_ros.hysteresis.reversals import count_before
from slpi_ros.hysteresis.shape import FAR, Curve, Shape

FloatArray = NDArray[np.float64]

# Turns can be many, curves are large.
KEPT_CURVES = 64


@dataclass(frozen=True)
class MemoryState:
    """A snapshot of the memory: present point and turning points, oldest first (V and m)."""

    direction: int
    voltage: float
    displacement: float
    turn_voltages: tuple[float, ...]
    turn_displacements: tuple[float, ...]


class TurningPoints:
    """What an axis remembers, and where it is.

    Parameters
    ----------
    shape : Shape
        The model.
    rest_voltage : float, volts
    rest_displacement : float, metres
        Where the stage is at the start.
    primed : bool
        False: it has never been moved. True: it came there by a long fall, which wiped its memory.
    """

    __slots__ = (
        *("_shape", "_rest", "_far", "_turns", "_left", "_direction", "_v", "_y"),
        # the present branch: origin, curve, where it closes, and how far the quick path may go on it
        *("_v0", "_y0", "_curve", "_u", "_f", "_close", "_reach_u", "_reach_f"),
    )

    def __init__(
        self, shape: Shape, rest_voltage: float = 0.0, rest_displacement: float = 0.0, *, primed: bool = False
    ) -> None:
        self._shape = shape
        self._rest = (rest_voltage, rest_displacement)
        # What `FAR` is for voltages; half of it leaves room for the loops, whose branches differ a little out there.
        far_out = (shape.first_rise(rest_voltage), shape.branch(1, rest_voltage), shape.branch(-1, rest_voltage))
        self._far = (FAR, min(float(np.interp(FAR / 2, *curve.knots)) for curve in far_out))
        self.restore(MemoryState(0, rest_voltage, rest_displacement, (), ()))
        if primed:
            top = rest_voltage + FAR
            fallen = float(np.interp(FAR, *shape.branch(-1, top).knots))
            self.restore(MemoryState(-1, rest_voltage, rest_displacement, (top,), (rest_displacement + fallen,)))

    @property
    def voltage(self) -> float:
        """Present voltage, volts."""
        return self._v

    @property
    def displacement(self) -> float:
        """Present displacement, metres."""
        return self._y

    @property
    def direction(self) -> int:
        """+1 rising, -1 falling, 0 at rest."""
        return self._direction

    @property
    def depth(self) -> int:
        """Number of turning points on the stack."""
        return len(self._turns[0])

    def snapshot(self) -> MemoryState:
        """Return the whole state, to be given back to `restore`."""
        return MemoryState(self._direction, self._v, self._y, tuple(self._turns[0]), tuple(self._turns[1]))

    def restore(self, state: MemoryState) -> None:
        """Take over a state from `snapshot`."""
        self._direction = state.direction
        self._v, self._y = state.voltage, state.displacement
        self._turns: tuple[list[float], list[float]] = (list(state.turn_voltages), list(state.turn_displacements))
        # The curve that was left at each turn, where it is known: most are entered again.
        self._left: list[Curve | None] = [None] * len(state.turn_voltages)
        self._enter_branch()

    def _turn_to(self, direction: int) -> None:
        """Push the present point as a turning point when the direction changes."""
        if direction == self._direction:
            return
        if self._direction:
            self._turns[0].append(self._v)
            self._turns[1].append(self._y)
            self._left.append(self._curve)
            if len(self._left) > KEPT_CURVES:
                self._left[-KEPT_CURVES - 1] = None
        self._direction = direction
        self._enter_branch()

    def _close_loop(self) -> None:
        """Forget the loop that has just closed and go on along the older branch."""
        older = self._left[-2] if len(self._left) > 1 else None
        for turns in (*self._turns, self._left):
            del turns[-2:]
        self._enter_branch(older)

    def _enter_branch(self, known: Curve | None = None) -> None:
        """Look up the branch from the last turning point in the present direction, and where it closes.

        `known` is its curve, if that has been looked up before.
        """
        s, shape = self._direction, self._shape
        v_turns, y_turns = self._turns
        if v_turns:
            self._v0, self._y0 = v_turns[-1], y_turns[-1]
            self._curve = known or shape.branch(s, self._v0)
            self._close = (v_turns[-2], y_turns[-2]) if len(v_turns) > 1 else self._first_closing(s)
        else:
            self._v0, self._y0 = self._rest
            falls_from_low_end = s < 0 and not shape.symmetric_rest
            self._curve = known or (shape.branch(s, self._v0) if falls_from_low_end else shape.first_rise(self._v0))
            self._close = (s * inf, s * inf) if s else self._rest
        self._u, self._f, _ = self._curve
        # Beyond its closing, or far away, a branch is no longer to be followed without a second look.
        (v_rest, y_rest), (v_far, y_far) = self._rest, self._far
        self._reach_u = min(s * self._close[0], s * v_rest + v_far) - s * self._v0
        self._reach_f = min(s * self._close[1], s * y_rest + y_far) - s * self._y0

    def _first_closing(self, s: int) -> tuple[float, float]:
        """Where the branch from the very first turning point meets the one that leaves rest again."""
        v_rest, y_rest = self._rest
        if self._shape.symmetric_rest:
            return 2.0 * v_rest - self._turns[0][0], 2.0 * y_rest - self._turns[1][0]
        return (v_rest, y_rest) if s > 0 else (-inf, -inf)

    def _knots(self, coordinate: int, farthest: float) -> tuple[FloatArray, FloatArray]:
        """Return the branch up to `farthest` as ascending knots of the driven and of the answering coordinate."""
        s = self._direction
        origin = (self._v0, self._y0)
        reach = s * (farthest - origin[coordinate])
        drive, response = self._curve.knots[:, :-1][:: 1 - 2 * coordinate]
        if reach > drive[-1]:
            # The last knot is too far away for exact arithmetic.
            (*_, d0, d1), (*_, r0, r1) = self._curve[1::-1] if coordinate else self._curve[:2]
            drive, response = np.append(drive, reach), np.append(response, r0 + (reach - d0) * ((r1 - r0) / (d1 - d0)))
        return (origin[coordinate] + s * drive)[::s], (origin[1 - coordinate] + s * response)[::s]

    def pieces(
        self, x: FloatArray, start: int, stop: int, coordinate: int, lower: float = -inf, upper: float = inf
    ) -> Iterator[tuple[int, int]]:
        """Cut the monotone run ``start:stop`` where loops close, and move the stack along, branch by branch.

        `coordinate` tells what `x` is: 0 voltage, 1 displacement. The pieces end before a loop that closes beyond a
        voltage limit. Whoever consumes a piece must `arrive` at its last sample before taking the next.
        """
        s = 1 if x[stop - 1] > x[start - 1] else -1
        limit = upper if s > 0 else lower
        if not lower <= self._v <= upper or self._v == limit:
            return
        self._turn_to(s)
        while start < stop:
            cut = start + count_before(x[start:stop], s, self._close[coordinate])
            if cut > start:
                yield start, cut
            if cut < stop:
                if s * (limit - self._close[0]) < 0.0:
                    return
                self._close_loop()
            start = cut

    def arrive(self, v: float, y: float) -> None:
        """Set the present point (V, m), ahead on the present branch."""
        self._v, self._y = v, y
