"""The engine: a stack of turning points, and one branch that starts at the last of them.

Every rate-independent operator with return-point memory obeys Madelung's laws:

1. a branch is determined by the turning point it starts from;
2. it heads for the turning point before that one and passes through it: the loop closes;
3. once a loop is closed both its turning points are forgotten, and the older branch goes on.

Models differ only in the *shape* of a branch, ``y = y_a + s F(s (v - v_a))`` with ``s = +1`` rising or ``-1`` falling.
``F`` is continuous, strictly increasing and piecewise linear, ``F(0) = 0``; so is its inverse: one stack serves both
directions, exactly and causally.
"""

from bisect import bisect_right
from collections.abc import Iterator
from dataclasses import dataclass
from math import inf, isfinite

import numpy as np
from numpy.typing import NDArray

from slpi_ros.errors import UsageError
from slpi_ros.hysteresis.runs import count_before, monotone_runs
from slpi_ros.hysteresis.shape import FAR, Shape

FloatArray = NDArray[np.float64]

# A monotone run shorter than this is quicker sample by sample than through numpy.interp.
SHORT_RUN = 32


@dataclass(frozen=True)
class MemoryState:
    """A snapshot of the memory: present point and turning points, oldest first (V and m)."""

    direction: int
    voltage: float
    displacement: float
    turn_voltages: tuple[float, ...]
    turn_displacements: tuple[float, ...]


class Memory:
    """Turning-point memory of one axis, driven by voltage (`forward`) or by displacement (`inverse`).

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
        *("_shape", "_rest", "_turns", "_direction", "_v", "_y"),
        # the present branch: origin, curve, where it closes, and how far the quick path may go on it
        *("_v0", "_y0", "_curve", "_u", "_f", "_close", "_reach_u", "_reach_f"),
    )

    def __init__(
        self, shape: Shape, rest_voltage: float = 0.0, rest_displacement: float = 0.0, *, primed: bool = False
    ) -> None:
        self._shape = shape
        self._rest = (rest_voltage, rest_displacement)
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
        self._enter_branch()

    def forward(self, v: float) -> float:
        """Move to the voltage `v` (V) and return the displacement (m).

        Raises
        ------
        UsageError
            If `v` is not finite; the memory is untouched.
        """
        s = self._direction
        if s * (v - self._v) > 0.0 and s * (v - self._v0) < self._reach_u:
            return self._slide_to_voltage(v)
        return self._turn_or_close_at_voltage(v)

    def inverse(self, y: float, lower: float = -inf, upper: float = inf) -> float:
        """Move to the displacement `y` (m), or as near as the voltages from `lower` to `upper` (V) allow.

        The memory follows the voltage returned (V), so a displacement out of reach does it no harm: the axis waits at
        the limit until the wish comes back within reach.

        Raises
        ------
        UsageError
            If `y` is not finite; the memory is untouched.
        """
        s = self._direction
        if s * (y - self._y) > 0.0 and s * (y - self._y0) < self._reach_f:
            return self._slide_to_displacement(y, lower, upper)
        return self._turn_or_close_at_displacement(y, lower, upper)

    def forward_array(self, v: FloatArray) -> FloatArray:
        """Move through the voltages `v`, shape (N,), volts; return the displacements, shape (N,), metres."""
        return self._through(v, 0, -inf, inf)

    def inverse_array(self, y: FloatArray, lower: float = -inf, upper: float = inf) -> FloatArray:
        """Move through the displacements `y`, shape (N,), metres; return the voltages, shape (N,), volts.

        `lower` and `upper` (V) bound the voltage as in `inverse`.
        """
        return self._through(y, 1, lower, upper)

    def _slide_to_voltage(self, v: float) -> float:
        """Move on along the present branch."""
        s, u_knots, f_knots = self._direction, self._u, self._f
        u = s * (v - self._v0)
        i = bisect_right(u_knots, u, 1)
        u_a, f_a = u_knots[i - 1], f_knots[i - 1]
        self._v = v
        self._y = y = self._y0 + s * (f_a + (u - u_a) * ((f_knots[i] - f_a) / (u_knots[i] - u_a)))
        return y

    def _slide_to_displacement(self, y: float, lower: float, upper: float) -> float:
        """Move on along the present branch, at most to a voltage limit."""
        s, u_knots, f_knots = self._direction, self._u, self._f
        f = s * (y - self._y0)
        i = bisect_right(f_knots, f, 1)
        u_a, f_a = u_knots[i - 1], f_knots[i - 1]
        v = self._v0 + s * (u_a + (f - f_a) * ((u_knots[i] - u_a) / (f_knots[i] - f_a)))
        if lower <= v <= upper:
            self._v, self._y = v, y
            return v
        return self._stop_at(upper if s > 0 else lower)

    def _stop_at(self, limit: float) -> float:
        """Move on to a voltage limit, unless it is already behind."""
        if self._direction * (limit - self._v) > 0.0:
            self._turn_or_close_at_voltage(limit)
        return self._v

    def _turn_or_close_at_voltage(self, v: float) -> float:
        if not abs(v - self._rest[0]) < FAR:
            raise UsageError(f"voltage {v} V is none that a stage can be given; leave such samples out")
        if v == self._v:
            return self._y
        s = 1 if v > self._v else -1
        self._turn_to(s)
        while s * (v - self._close[0]) >= 0.0:
            self._close_loop()
        return self._slide_to_voltage(v)

    def _turn_or_close_at_displacement(self, y: float, lower: float, upper: float) -> float:
        if not isfinite(y):
            raise UsageError(f"displacement {y} m is none that a stage can take; leave such samples out")
        if y == self._y:
            return self._v
        s = 1 if y > self._y else -1
        limit = upper if s > 0 else lower
        if s * (limit - self._v) <= 0.0:
            return self._v
        self._turn_to(s)
        while s * (y - self._close[1]) >= 0.0:
            if s * (limit - self._close[0]) < 0.0:
                return self._stop_at(limit)
            self._close_loop()
        if s * (y - self._y0) >= self._f[-1]:
            raise UsageError(f"displacement {y} m is none that a stage can take; leave such samples out")
        return self._slide_to_displacement(y, lower, upper)

    def _turn_to(self, direction: int) -> None:
        """Push the present point as a turning point when the direction changes."""
        if direction == self._direction:
            return
        if self._direction:
            self._turns[0].append(self._v)
            self._turns[1].append(self._y)
        self._direction = direction
        self._enter_branch()

    def _close_loop(self) -> None:
        """Forget the loop that has just closed and go on along the older branch."""
        for turns in self._turns:
            del turns[-2:]
        self._enter_branch()

    def _enter_branch(self) -> None:
        """Look up the branch from the last turning point in the present direction, and where it closes."""
        s, shape = self._direction, self._shape
        v_turns, y_turns = self._turns
        if v_turns:
            self._v0, self._y0 = v_turns[-1], y_turns[-1]
            self._curve = shape.branch(s, self._v0)
            self._close = (v_turns[-2], y_turns[-2]) if len(v_turns) > 1 else self._first_closing(s)
        else:
            self._v0, self._y0 = self._rest
            falls_from_low_end = s < 0 and not shape.symmetric_rest
            self._curve = shape.branch(s, self._v0) if falls_from_low_end else shape.first_rise(self._v0)
            self._close = (s * inf, s * inf) if s else self._rest
        self._u, self._f, _ = self._curve
        self._reach_u = min(s * (self._close[0] - self._v0), self._u[-1])
        self._reach_f = min(s * (self._close[1] - self._y0), self._f[-1])

    def _first_closing(self, s: int) -> tuple[float, float]:
        """Where the branch from the very first turning point meets the one that leaves rest again."""
        v_rest, y_rest = self._rest
        if self._shape.symmetric_rest:
            return 2.0 * v_rest - self._turns[0][0], 2.0 * y_rest - self._turns[1][0]
        return (v_rest, y_rest) if s > 0 else (-inf, -inf)

    def _through(self, x: FloatArray, coordinate: int, lower: float, upper: float) -> FloatArray:
        """Drive one coordinate (0 voltage, 1 displacement) through `x` and return the other."""
        x = np.ascontiguousarray(x, dtype=np.float64)
        finite = np.isfinite(x)
        if not finite.all():
            at = int(np.argmin(finite))
            raise UsageError(f"sample {at} is {x[at]}; leave samples that are not finite out")
        out = np.empty_like(x)
        for start, stop in monotone_runs(x):
            # Not in step: held at a voltage limit, away from the wished displacement.
            in_step = start and x[start - 1] == (self._y if coordinate else self._v)
            if stop - start >= SHORT_RUN and in_step and x[stop - 1] != x[start - 1]:
                start = self._along_branches(x, out, start, stop, coordinate, lower, upper)
            samples = x[start:stop].tolist()
            if coordinate:
                out[start:stop] = [self.inverse(y, lower, upper) for y in samples]
            else:
                out[start:stop] = [self.forward(v) for v in samples]
        return out

    def _along_branches(
        self, x: FloatArray, out: FloatArray, start: int, stop: int, coordinate: int, lower: float, upper: float
    ) -> int:
        """Evaluate the run ``start:stop`` branch by branch; return where a voltage limit ended it, else `stop`."""
        for begin, end in self.pieces(x, start, stop, coordinate):
            drive, response = self._knots(coordinate, float(x[end - 1]))
            result = np.interp(x[begin:end], drive, response)
            if not coordinate:
                out[begin:end] = result
                self.arrive(float(x[end - 1]), float(result[-1]))
                continue
            inside = int(np.count_nonzero((result >= lower) & (result <= upper)))
            out[begin : begin + inside] = result[:inside]
            if inside:
                self.arrive(float(out[begin + inside - 1]), float(x[begin + inside - 1]))
            if begin + inside < end:
                return begin + inside
        return stop

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

    def pieces(self, x: FloatArray, start: int, stop: int, coordinate: int) -> Iterator[tuple[int, int]]:
        """Cut the monotone run ``start:stop`` where loops close, and move the stack along, branch by branch.

        `coordinate` tells what `x` is: 0 voltage, 1 displacement. Whoever consumes a piece must `arrive` at its last
        sample before taking the next.
        """
        s = 1 if x[stop - 1] > x[start - 1] else -1
        self._turn_to(s)
        while start < stop:
            cut = start + count_before(x[start:stop], s, self._close[coordinate])
            if cut > start:
                yield start, cut
            if cut < stop:
                self._close_loop()
            start = cut

    def arrive(self, v: float, y: float) -> None:
        """Set the present point (V, m), ahead on the present branch."""
        self._v, self._y = v, y
