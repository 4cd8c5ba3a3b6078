"""The hysteresis engine: a stack of reversals and the current branch, driven by voltage or by displacement.

Every rate-independent operator with return-point memory obeys Madelung's laws:

1. a branch is determined by the reversal at which it starts;
2. it passes through the preceding reversal, where the loop closes;
3. a closed loop removes both its reversals from the memory, and the previous branch continues.

Models differ only in the *shape* of a branch, ``y = y_a + s F(s (v - v_a))`` with ``s = +1`` rising or ``-1`` falling.
``F`` is continuous, strictly increasing and piecewise linear, ``F(0) = 0``, and therefore invertible: one stack serves
both directions, exactly and causally.
"""

from bisect import bisect_right
from collections.abc import Iterator
from dataclasses import dataclass
from math import inf
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from slpi_ros.errors import UsageError
from slpi_ros.hysteresis.reversals import count_before, monotone_runs, require_finite

FloatArray = NDArray[np.float64]

# Largest distance of a voltage from rest (V); the last knot of every branch lies `END` beyond the others.
FAR = 1e5
END = 4 * FAR
# Number of cached branch curves; reversals can be numerous and curves are large.
KEPT_CURVES = 64
# Monotone runs with fewer samples are evaluated in a loop, which is faster than numpy.interp for these.
SHORT_RUN = 64


class Curve(NamedTuple):
    """A branch shape ``F`` as knots (V, m), strictly increasing from ``u[0] = f[0] = 0``, the last at distance `END`.

    The knots are stored as lists for a fast scalar search and as an array, shape (2, k).
    """

    u: list[float]
    f: list[float]
    knots: FloatArray

    @classmethod
    def of(cls, knots: FloatArray) -> "Curve":
        """Return the curve through knots, shape (2, k), volts and metres."""
        u, f = knots.tolist()
        return cls(u, f, knots)


class Shape(Protocol):
    """Branch shapes of a hysteresis model, as required by the engine."""

    @property
    def symmetric_rest(self) -> bool:
        """Whether rest is the middle of the memory: the first loop then closes at the mirror image of its reversal.

        If not, rest is the low end of the memory: a fall from rest is an ordinary branch that returns to rest.
        """

    def branch(self, direction: int, v_turn: float) -> Curve:
        """Return the shape of the branch that starts in `direction` at the reversal `v_turn` (V)."""

    def first_rise(self, v_rest: float) -> Curve:
        """Return the shape of the first rise from rest at `v_rest` (V)."""


@dataclass(frozen=True)
class MemoryState:
    """State of a `Memory`: direction (0 at rest), current point, and reversals, oldest first (V and m)."""

    direction: int
    voltage: float
    displacement: float
    turn_voltages: tuple[float, ...]
    turn_displacements: tuple[float, ...]


class Memory:
    """Reversal memory of one axis, driven by voltage (`forward`) or by displacement (`inverse`).

    Parameters
    ----------
    shape : Shape
        Branch shapes of the model.
    rest_voltage : float, volts
    rest_displacement : float, metres
        Initial point.
    primed : bool
        False: no previous motion. True: the initial point was reached by a long fall that wiped the memory.
    """

    __slots__ = (
        *("_shape", "_rest", "_far", "_turns", "_turn_curves", "_direction", "_v", "_y"),
        # current branch: origin, curve, closing point, and the range within which samples need no stack update
        *("_v0", "_y0", "_curve", "_u", "_f", "_close", "_reach_u", "_reach_f"),
    )

    def __init__(
        self, shape: Shape, rest_voltage: float = 0.0, rest_displacement: float = 0.0, *, primed: bool = False
    ) -> None:
        self._shape = shape
        self._rest = (rest_voltage, rest_displacement)
        # Displacement that corresponds to `FAR`, halved as a margin for the different branches of inner loops.
        far_out = (shape.first_rise(rest_voltage), shape.branch(1, rest_voltage), shape.branch(-1, rest_voltage))
        self._far = (FAR, min(float(np.interp(FAR / 2, *curve.knots)) for curve in far_out))
        self.restore(MemoryState(0, rest_voltage, rest_displacement, (), ()))
        if primed:
            top = rest_voltage + FAR
            fallen = float(np.interp(FAR, *shape.branch(-1, top).knots))
            self.restore(MemoryState(-1, rest_voltage, rest_displacement, (top,), (rest_displacement + fallen,)))

    @property
    def voltage(self) -> float:
        """Current voltage, volts."""
        return self._v

    @property
    def displacement(self) -> float:
        """Current displacement, metres."""
        return self._y

    @property
    def direction(self) -> int:
        """+1 rising, -1 falling, 0 at rest."""
        return self._direction

    @property
    def depth(self) -> int:
        """Number of reversals on the stack."""
        return len(self._turns[0])

    def snapshot(self) -> MemoryState:
        """Return the complete state for `restore`."""
        return MemoryState(self._direction, self._v, self._y, tuple(self._turns[0]), tuple(self._turns[1]))

    def restore(self, state: MemoryState) -> None:
        """Replace the state by one returned by `snapshot`."""
        self._direction = state.direction
        self._v, self._y = state.voltage, state.displacement
        self._turns: tuple[list[float], list[float]] = (list(state.turn_voltages), list(state.turn_displacements))
        # Cached curve of the branch that ended at each reversal, as most branches are continued later.
        self._turn_curves: list[Curve | None] = [None] * len(state.turn_voltages)
        self._enter_branch()

    # The stack

    def _turn_to(self, direction: int) -> None:
        """Push the current point as a reversal if the direction changes."""
        if direction == self._direction:
            return
        if self._direction:
            self._turns[0].append(self._v)
            self._turns[1].append(self._y)
            self._turn_curves.append(self._curve)
            if len(self._turn_curves) > KEPT_CURVES:
                self._turn_curves[-KEPT_CURVES - 1] = None
        self._direction = direction
        self._enter_branch()

    def _close_loop(self) -> None:
        """Remove the two reversals of the closed loop and continue on the previous branch."""
        older = self._turn_curves[-2] if len(self._turn_curves) > 1 else None
        for turns in (*self._turns, self._turn_curves):
            del turns[-2:]
        self._enter_branch(older)

    def _enter_branch(self, known: Curve | None = None) -> None:
        """Set the branch from the last reversal in the current direction, and its closing point.

        `known` is the cached curve of this branch, if available.
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
        # Beyond the closing point or the largest voltage the stack must be checked again.
        (v_rest, y_rest), (v_far, y_far) = self._rest, self._far
        self._reach_u = min(s * self._close[0], s * v_rest + v_far) - s * self._v0
        self._reach_f = min(s * self._close[1], s * y_rest + y_far) - s * self._y0

    def _first_closing(self, s: int) -> tuple[float, float]:
        """Return the point where the branch from the first reversal meets the branch that leaves rest."""
        v_rest, y_rest = self._rest
        if self._shape.symmetric_rest:
            return 2.0 * v_rest - self._turns[0][0], 2.0 * y_rest - self._turns[1][0]
        return (v_rest, y_rest) if s > 0 else (-inf, -inf)

    # Forward: voltage to displacement

    def forward(self, v: float) -> float:
        """Move to the voltage `v` (V) and return the displacement (m).

        Raises
        ------
        UsageError
            If `v` is not finite or out of range; the memory is unchanged.
        """
        s = self._direction
        if s * (v - self._v) > 0.0 and s * (v - self._v0) < self._reach_u:
            return self._follow_to_voltage(v)
        return self._turn_or_close_at_voltage(v)

    def _follow_to_voltage(self, v: float) -> float:
        """Advance along the current branch."""
        s, u_knots, f_knots = self._direction, self._u, self._f
        u = s * (v - self._v0)
        i = bisect_right(u_knots, u, 1)
        u_a, f_a = u_knots[i - 1], f_knots[i - 1]
        self._v = v
        self._y = y = self._y0 + s * (f_a + (u - u_a) * ((f_knots[i] - f_a) / (u_knots[i] - u_a)))
        return y

    def _turn_or_close_at_voltage(self, v: float) -> float:
        """Push a reversal or remove closed loops as required, and move to `v`."""
        if not abs(v - self._rest[0]) < self._far[0]:
            raise UsageError(f"voltage {v} V is out of range; leave such samples out")
        if v == self._v:
            return self._y
        s = 1 if v > self._v else -1
        self._turn_to(s)
        while s * (v - self._close[0]) >= 0.0:
            self._close_loop()
        return self._follow_to_voltage(v)

    # Inverse: displacement to voltage

    def inverse(self, y: float, lower: float = -inf, upper: float = inf) -> float:
        """Move to the displacement `y` (m), or as near as `lower` and `upper` (V) allow; return that voltage (V).

        The memory follows the returned voltage: for an unreachable displacement it stays at the limit.

        Raises
        ------
        UsageError
            If `y` is not finite or out of range; the memory is unchanged.
        """
        s = self._direction
        if s * (y - self._y) > 0.0 and s * (y - self._y0) < self._reach_f:
            return self._follow_to_displacement(y, lower, upper)
        return self._turn_or_close_at_displacement(y, lower, upper)

    def _follow_to_displacement(self, y: float, lower: float, upper: float) -> float:
        """Advance along the current branch, at most to a voltage limit."""
        s, u_knots, f_knots = self._direction, self._u, self._f
        f = s * (y - self._y0)
        i = bisect_right(f_knots, f, 1)
        if i == len(f_knots):
            raise UsageError(f"displacement {y} m cannot be reached by this model; leave such samples out")
        u_a, f_a = u_knots[i - 1], f_knots[i - 1]
        v = self._v0 + s * (u_a + (f - f_a) * ((u_knots[i] - u_a) / (f_knots[i] - f_a)))
        if lower <= v <= upper:
            self._v, self._y = v, y
            return v
        self._turn_or_close_at_voltage(min(max(v, lower), upper))
        return self._v

    def _turn_or_close_at_displacement(self, y: float, lower: float, upper: float) -> float:
        """Push a reversal or remove closed loops as required, and move to `y` within the limits."""
        if not abs(y - self._rest[1]) < self._far[1]:
            raise UsageError(f"displacement {y} m is out of range; leave such samples out")
        if not lower <= self._v <= upper:
            self._turn_or_close_at_voltage(min(max(self._v, lower), upper))
        if y == self._y:
            return self._v
        s = 1 if y > self._y else -1
        limit = upper if s > 0 else lower
        if s * (limit - self._v) <= 0.0:
            return self._v
        self._turn_to(s)
        while s * (y - self._close[1]) >= 0.0:
            if s * (limit - self._close[0]) < 0.0:
                self._turn_or_close_at_voltage(limit)
                return limit
            self._close_loop()
        return self._follow_to_displacement(y, lower, upper)

    # Batch evaluation: between two reversals the model is one monotone piecewise linear function

    def forward_array(self, v: FloatArray) -> FloatArray:
        """Move through the voltages `v`, shape (N,), volts; return the displacements, shape (N,), metres."""
        return self._through(v, 0, -inf, inf, None)

    def inverse_array(
        self, y: FloatArray, lower: float = -inf, upper: float = inf, reached: FloatArray | None = None
    ) -> FloatArray:
        """Move through the displacements `y`, shape (N,), metres; return the voltages, shape (N,), volts.

        `lower` and `upper` (V) limit the voltage as in `inverse`. The displacements reached within these limits, shape
        (N,), metres, are written to `reached`, if given.
        """
        if reached is not None:
            reached[:] = y
        return self._through(y, 1, lower, upper, reached)

    def split_at_closures(
        self, x: FloatArray, start: int, stop: int, coordinate: int, lower: float = -inf, upper: float = inf
    ) -> Iterator[tuple[int, int]]:
        """Divide the monotone run ``start:stop`` of `x` at loop closures, and update the stack.

        `coordinate` is the unit of `x`, shape (N,): 0 voltage (V), 1 displacement (m). Each piece lies on one branch
        and ends before a loop that closes beyond a voltage limit (V). The caller must `advance_to` the last sample of a
        piece before requesting the next piece.
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

    def advance_to(self, v: float, y: float) -> None:
        """Set the current point (V, m), which must lie ahead on the current branch."""
        self._v, self._y = v, y

    def _through(
        self, x: FloatArray, coordinate: int, lower: float, upper: float, reached: FloatArray | None
    ) -> FloatArray:
        """Evaluate the model along one coordinate `x` (0 voltage, 1 displacement), writing to `reached`."""
        x = np.ascontiguousarray(x, dtype=np.float64)
        if not x.size:
            return np.empty_like(x)
        rest, far = self._rest[coordinate], self._far[coordinate]
        # Minimum and maximum avoid a copy; NaN fails both comparisons.
        if not (rest - far < x.min() and x.max() < rest + far):
            require_finite(x)
            at = int(np.argmax(np.abs(x - rest)))
            raise UsageError(f"sample {at} is {x[at]} {'Vm'[coordinate]}, out of range; remove such samples")
        out = np.empty_like(x)
        for start, stop in monotone_runs(x):
            # Otherwise the axis is held at a voltage limit and has not reached the desired displacement.
            on_path = start and x[start - 1] == (self._y if coordinate else self._v)
            if stop - start >= SHORT_RUN and on_path:
                start = self._along_branches(x, out, start, stop, coordinate, lower, upper)
            noted = None if reached is None else reached[start:stop]
            out[start:stop] = self._sample_by_sample(x[start:stop].tolist(), coordinate, lower, upper, noted)
        return out

    def _along_branches(
        self, x: FloatArray, out: FloatArray, start: int, stop: int, coordinate: int, lower: float, upper: float
    ) -> int:
        """Evaluate the run ``start:stop`` branch by branch; return its end, which is earlier at a voltage limit."""
        done = start
        for begin, end in self.split_at_closures(x, start, stop, coordinate, lower, upper):
            drive, response = self._knots(coordinate, float(x[end - 1]))
            result = np.interp(x[begin:end], drive, response)
            if coordinate:
                end = begin + int(np.count_nonzero((result >= lower) & (result <= upper)))
            out[begin:end] = result[: end - begin]
            if end > begin:
                point = float(x[end - 1]), float(out[end - 1])
                self.advance_to(*(point[::-1] if coordinate else point))
                done = end
            if end - begin < len(result):
                break
        return done

    def _knots(self, coordinate: int, farthest: float) -> tuple[FloatArray, FloatArray]:
        """Return the branch up to `farthest` as ascending knots of input and output coordinate."""
        s = self._direction
        origin = (self._v0, self._y0)
        reach = s * (farthest - origin[coordinate])
        drive, response = self._curve.knots[:, :-1][:: 1 - 2 * coordinate]
        if reach > drive[-1]:
            # The last knot is too distant for exact arithmetic.
            (*_, d0, d1), (*_, r0, r1) = self._curve[1::-1] if coordinate else self._curve[:2]
            drive, response = np.append(drive, reach), np.append(response, r0 + (reach - d0) * ((r1 - r0) / (d1 - d0)))
        return (origin[coordinate] + s * drive)[::s], (origin[1 - coordinate] + s * response)[::s]

    def _sample_by_sample(
        self, run: list[float], coordinate: int, lower: float, upper: float, reached: FloatArray | None
    ) -> list[float]:
        """Evaluate a monotone run sample by sample; fast while samples stay on one branch."""
        responses: list[float] = []
        while len(responses) < len(run):
            x = run[len(responses)]
            responses.append(self.inverse(x, lower, upper) if coordinate else self.forward(x))
            if x == (self._y if coordinate else self._v):
                self._follow_run(run, responses, coordinate, lower, upper)
            elif reached is not None:
                reached[len(responses) - 1] = self._y
        return responses

    def _follow_run(
        self, run: list[float], responses: list[float], coordinate: int, lower: float, upper: float
    ) -> None:
        """Append the outputs of the samples on the current branch within the voltage limits."""
        s, origin = self._direction, (self._v0, self._y0)
        reach = self._reach_f if coordinate else self._reach_u
        drive, response = (self._f, self._u) if coordinate else (self._u, self._f)
        d_origin, r_origin = origin[coordinate], origin[1 - coordinate]
        last = present = self._y if coordinate else self._v
        i = bisect_right(drive, s * (present - d_origin), 1)
        for x in run[len(responses) :]:
            d = s * (x - d_origin)
            if not (s * (x - present) > 0.0 and d < reach and d < drive[-1]):
                break
            while drive[i] <= d:
                i += 1
            d_a, r_a = drive[i - 1], response[i - 1]
            answer = r_origin + s * (r_a + (d - d_a) * ((response[i] - r_a) / (drive[i] - d_a)))
            if coordinate and not lower <= answer <= upper:
                break
            responses.append(answer)
            present = x
        if present != last:
            self.advance_to(*((responses[-1], present) if coordinate else (present, responses[-1])))
