"""The hysteresis engine: a stack of reversals and the current branch, driven by voltage or by displacement.

Every rate-independent operator with return-point memory obeys Madelung's laws:

1. a branch is determined by the reversal at which it starts;
2. it passes through the preceding reversal, where the loop closes;
3. a closed loop removes both its reversals from the memory, and the previous branch continues.

Models differ only in the *shape* of a branch, ``y = y_a + s F(s (v - v_a))`` with ``s = +1`` rising or ``-1`` falling.
``F`` is continuous, strictly increasing and piecewise linear, ``F(0) = 0``, and therefore invertible: one stack of
reversals gives both displacement from voltage and voltage from displacement, exactly and causally.
"""

import sys
from bisect import bisect_right
from dataclasses import dataclass
from math import asinh, copysign, inf, sinh

import numpy as np

from slpi_ros.arrays import FloatArray, IntArray
from slpi_ros.errors import UsageError
from slpi_ros.hysteresis.compilation import compiler
from slpi_ros.hysteresis.rate_law import LARGEST, solved
from slpi_ros.hysteresis.reversals import require_finite
from slpi_ros.hysteresis.shapes import FAR, Branches, Curve, Shape

# Number of cached branch curves; reversals can be numerous and curves are large.
KEPT_CURVES = 64
# Fewest samples of a path for which loading the compiled engine, and calling it once loaded, takes less time than the
# loop over samples.
LOADED_FROM, COMPILED_FROM = 20_000, 200


@dataclass(frozen=True)
class MemoryState:
    """State of a `Memory`: direction (0 at rest), current point, and reversals, oldest first (V and m)."""

    direction: int
    voltage: float
    displacement: float
    turn_voltages: tuple[float, ...]
    turn_displacements: tuple[float, ...]

    @property
    def reversals(self) -> tuple[float, ...]:
        """Remembered reversals, oldest first, volts, without that from which a primed memory fell."""
        # It is far outside the voltage range of any stage.
        return tuple(v for v in self.turn_voltages if abs(v) < FAR / 2)


class Memory:
    """Reversal memory of one axis, driven by voltage (`forward`) or by displacement (`inverse`)."""

    # The initial point was reached, if `primed`, by a long fall, which erased the memory, else without previous motion.
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

    @property
    def far(self) -> float:
        """Largest distance of a displacement from rest, metres."""
        return self._far[1]

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

    def _turn_to(self, direction: int) -> None:
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
        """Set the branch from the last reversal, of a cached curve if `known`, and its closing point."""
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
        # Beyond the closing point, the largest voltage or the last knot the stack must be checked again.
        (v_rest, y_rest), (v_far, y_far) = self._rest, self._far
        self._reach_u = min(s * self._close[0], s * v_rest + v_far) - s * self._v0
        self._reach_f = min(min(s * self._close[1], s * y_rest + y_far) - s * self._y0, self._f[-1])

    def _first_closing(self, s: int) -> tuple[float, float]:
        """Return the point where the branch from the first reversal meets the branch that leaves rest."""
        v_rest, y_rest = self._rest
        if self._shape.symmetric_rest:
            return 2.0 * v_rest - self._turns[0][0], 2.0 * y_rest - self._turns[1][0]
        return (v_rest, y_rest) if s > 0 else (-inf, -inf)

    def forward(self, v: float) -> float:
        """Move to the voltage `v` (V) and return the displacement (m), or raise unchanged."""
        s = self._direction
        u = s * (v - self._v0)
        if not (s * (v - self._v) > 0.0 and u < self._reach_u):
            if not abs(v - self._rest[0]) < self._far[0]:
                raise UsageError(f"voltage {v} V is out of range; leave such samples out")
            if v == self._v:
                return self._y
            s = 1 if v > self._v else -1
            self._turn_to(s)
            while s * (v - self._close[0]) >= 0.0:
                self._close_loop()
            u = s * (v - self._v0)
        u_knots, f_knots = self._u, self._f
        i = bisect_right(u_knots, u, 1)
        u_a, f_a = u_knots[i - 1], f_knots[i - 1]
        self._v = v
        self._y = y = self._y0 + s * (f_a + (u - u_a) * ((f_knots[i] - f_a) / (u_knots[i] - u_a)))
        return y

    def inverse(self, y: float, lower: float = -inf, upper: float = inf) -> float:
        """Move to the displacement `y` (m), or as near as limits (V) allow; return the voltage, or raise unchanged."""
        # The memory follows the returned voltage: for an unreachable displacement it stays at the limit.
        s = self._direction
        f = s * (y - self._y0)
        if not (s * (y - self._y) > 0.0 and f < self._reach_f):
            if not abs(y - self._rest[1]) < self._far[1]:
                raise UsageError(f"displacement {y} m is out of range; leave such samples out")
            if not lower <= self._v <= upper:
                self.forward(min(max(self._v, lower), upper))
            s = 1 if y > self._y else -1
            limit = upper if s > 0 else lower
            if y == self._y or s * (limit - self._v) <= 0.0:
                return self._v
            self._turn_to(s)
            while s * (y - self._close[1]) >= 0.0:
                if s * (limit - self._close[0]) < 0.0:
                    self.forward(limit)
                    return limit
                self._close_loop()
            f = s * (y - self._y0)
            if f >= self._f[-1]:
                raise UsageError(f"displacement {y} m cannot be reached by this model; leave such samples out")
        u_knots, f_knots = self._u, self._f
        i = bisect_right(f_knots, f, 1)
        u_a, f_a = u_knots[i - 1], f_knots[i - 1]
        v = self._v0 + s * (u_a + (f - f_a) * ((u_knots[i] - u_a) / (f_knots[i] - f_a)))
        if not lower <= v <= upper:
            self.forward(min(max(v, lower), upper))
            return self._v
        self._v, self._y = v, y
        return v

    def inverse_of_law(
        self, y: float, gain: float, threshold: float, scale: float, lower: float, upper: float, guess: float
    ) -> float:
        """Move to the voltage ``u`` at which displacement plus ``gain w`` is `y` (m); return ``w`` or raise."""
        # Here ``w = asinh(d / scale)`` for the change ``d`` (V) of ``u``; see `slpi_ros.hysteresis.rate_law`. The
        # applied voltage ``u + threshold w`` stays within `lower` and `upper` (V): where they hold it back, ``u``
        # follows it by the law. `gain` is in metres, `threshold` and `scale` (more than 0) are in volts.
        if not abs(y - self._rest[1]) < self._far[1]:
            raise UsageError(f"displacement {y} m is out of range; leave such samples out")
        start, s = self._v, 1 if y > self._y else -1
        limit, other = (upper, lower) if s > 0 else (lower, upper)
        if s * (limit - start) <= 0.0:
            return self._follow_limit(limit, start, threshold, scale)
        if y == self._y:
            return 0.0 if start <= upper else self._follow_limit(upper, start, threshold, scale)
        self._turn_to(s)
        i = bisect_right(self._u, s * (start - self._v0), 1)
        while True:
            v0, u_knots, f_knots, close = self._v0, self._u, self._f, self._close[0]
            if i >= len(u_knots):
                raise UsageError(f"displacement {y} m cannot be reached by this model; leave such samples out")
            u_a, f_a = u_knots[i - 1], f_knots[i - 1]
            end, height, above = v0 + s * u_knots[i], f_knots[i] - f_a, s * (y - self._y0) - f_a
            if height > 0.0:
                rise = (u_knots[i] - u_a) / height
                # Way to the voltage without the part of `w`, on the straight line through this piece.
                goal = max(s * (v0 + s * (u_a + above * rise) - start), 0.0)
                rise *= gain
                w = guess = solved(scale, rise, goal, guess)
                v = start + s * (goal - rise * w)
            else:
                # On a flat piece only the part of `w` moves; without it the piece is passed.
                w = max(above, 0.0) / gain if gain > 0.0 else LARGEST
                v = start + s * (scale * sinh(min(w, LARGEST))) if w < LARGEST else s * inf
            if s * (end - v) > 0.0 and s * (close - v) > 0.0:
                applied = v + s * (threshold * w)
                if s * (applied - limit) > 0.0:
                    return self._follow_limit(limit, start, threshold, scale)
                self._v, self._y = v, y - s * (gain * w)
                if s * (applied - other) < 0.0:
                    return self._follow_limit(other, start, threshold, scale)
                return s * w
            if s * (close - end) > 0.0:
                i += 1
                continue
            if s * (close - limit) + threshold * asinh(s * (close - start) / scale) > 0.0:
                return self._follow_limit(limit, start, threshold, scale)
            self._v, self._y = self._close
            self._close_loop()
            i = bisect_right(self._u, s * (close - self._v0), 1)

    def _follow_limit(self, limit: float, start: float, threshold: float, scale: float) -> float:
        """Move from `start` (V) to the voltage that the hysteresis feels while `limit` (V) is applied; return ``w``."""
        way = limit - start
        w = copysign(solved(scale, threshold, abs(way), 0.0), way)
        self.forward(limit - threshold * w)
        return w

    def forward_array(self, v: FloatArray) -> FloatArray:
        """Move through the voltages `v`, shape (N,), volts; return the displacements, shape (N,), metres."""
        return self._through(v, 0, -inf, inf)

    def inverse_array(self, y: FloatArray, lower: float = -inf, upper: float = inf) -> FloatArray:
        """Move through the displacements `y`, (N,), m; return the voltages, (N,), V, limited as in `inverse`."""
        return self._through(y, 1, lower, upper)

    def _through(self, x: FloatArray, coordinate: int, lower: float, upper: float) -> FloatArray:
        """Return the other coordinate along `x`; `coordinate` of `x`: 0 voltage, 1 displacement."""
        x = np.require(x, np.float64, ("C", "W"))
        if not x.size:
            return np.empty_like(x)
        rest, far = self._rest[coordinate], self._far[coordinate]
        # Minimum and maximum avoid a copy; NaN fails both comparisons.
        if not (rest - far < x.min() and x.max() < rest + far):
            require_finite(x)
            at = int(np.argmax(np.abs(x - rest)))
            raise UsageError(f"sample {at} is {x[at]} {'Vm'[coordinate]}, out of range; remove such samples")
        if worth_compiling(x.size):
            return self.run_compiled(x, coordinate, lower, upper)
        if coordinate:
            return np.array([self.inverse(y, lower, upper) for y in x.tolist()])
        return np.array([self.forward(v) for v in x.tolist()])

    def run_compiled(
        self, x: FloatArray, coordinate: int, lower: float, upper: float, walk: IntArray | None = None
    ) -> FloatArray:
        """Return the other coordinate along `x`; `slpi_ros.hysteresis.compiled.through` describes the arguments."""
        from slpi_ros.hysteresis.compiled import room, through

        if coordinate and not lower <= self._v <= upper:
            self.forward(min(max(self._v, lower), upper))
        out = np.empty_like(x)
        direction, point, turns, depth = self.arrays(x.size)
        shape = self.shape_arrays()
        done, direction, depth, _ = through(
            *(x, coordinate, float(lower), float(upper), out, direction, point, turns, depth),
            np.empty((3, 0), dtype=np.int64) if walk is None else walk,
            np.empty((2, 0)),
            room(*shape[2:]),
            *shape,
        )
        v_turns, y_turns = turns[:, :depth].tolist()
        v, y = point.tolist()
        self.restore(MemoryState(int(direction), v, y, tuple(v_turns), tuple(y_turns)))
        if done < x.size:
            # Beyond the last knot: raises the error of the sample.
            (self.inverse if coordinate else self.forward)(float(x[done]))
        return out

    def arrays(self, more: int) -> tuple[float, FloatArray, FloatArray, int]:
        """Return direction, current point, stack with room for `more` reversals, and depth, for the compiled engine."""
        turns = np.empty((2, self.depth + more))
        turns[:, : self.depth] = self._turns
        return float(self._direction), np.array([self._v, self._y]), turns, self.depth

    def shape_arrays(self) -> tuple[FloatArray, bool, FloatArray, Branches]:
        """Return rest point, symmetry, knots of the first rise, and branches, for the compiled engine."""
        first = np.ascontiguousarray(self._shape.first_rise(self._rest[0]).knots)
        return np.array(self._rest, dtype=np.float64), self._shape.symmetric_rest, first, self._shape.branches


def worth_compiling(samples: int) -> bool:
    """Return whether the compiled engine is faster than the Python loop for this number of samples."""
    loaded = "slpi_ros.hysteresis.compiled" in sys.modules
    return samples >= (COMPILED_FROM if loaded else LOADED_FROM) and compiler() is not None


def always_compiled(samples: int) -> bool:
    """Return whether compiled code does this, whatever the process has loaded: where sums differ in the last digit."""
    return samples >= LOADED_FROM and compiler() is not None
