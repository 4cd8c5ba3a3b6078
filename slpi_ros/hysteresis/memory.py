"""The engine: an axis moves along the branches of its turning points, driven by voltage or by displacement.

Models differ only in the *shape* of a branch, ``y = y_a + s F(s (v - v_a))`` with ``s = +1`` rising or ``-1`` falling.
``F`` is continuous, strictly increasing and piecewise linear, ``F(0) = 0``; so is its inverse: one stack serves both
directions, exactly and causally.
"""

from bisect import bisect_right
from math import inf

import numpy as np
from numpy.typing import NDArray

from slpi_ros.errors import UsageError
from slpi_ros.hysteresis.reversals import monotone_runs, require_finite
from slpi_ros.hysteresis.stack import MemoryState, TurningPoints

__all__ = ["Memory", "MemoryState"]

FloatArray = NDArray[np.float64]

# A monotone run shorter than this is quicker sample by sample than through numpy.interp.
SHORT_RUN = 64


class Memory(TurningPoints):
    """Turning-point memory of one axis, driven by voltage (`forward`) or by displacement (`inverse`).

    Parameters are those of `TurningPoints`.
    """

    __slots__ = ()

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
        return self._through(v, 0, -inf, inf, None)

    def inverse_array(
        self, y: FloatArray, lower: float = -inf, upper: float = inf, reached: FloatArray | None = None
    ) -> FloatArray:
        """Move through the displacements `y`, shape (N,), metres; return the voltages, shape (N,), volts.

        `lower` and `upper` (V) bound the voltage as in `inverse`. The displacements that these allow, shape (N,),
        metres, are written to `reached`, if given.
        """
        if reached is not None:
            reached[:] = y
        return self._through(y, 1, lower, upper, reached)

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
        if i == len(f_knots):
            raise UsageError(f"displacement {y} m is none that this model can take; leave such samples out")
        u_a, f_a = u_knots[i - 1], f_knots[i - 1]
        v = self._v0 + s * (u_a + (f - f_a) * ((u_knots[i] - u_a) / (f_knots[i] - f_a)))
        if lower <= v <= upper:
            self._v, self._y = v, y
            return v
        return self._stop_at(min(max(v, lower), upper))

    def _stop_at(self, limit: float) -> float:
        """Move to a voltage limit."""
        self._turn_or_close_at_voltage(limit)
        return limit

    def _turn_or_close_at_voltage(self, v: float) -> float:
        if not abs(v - self._rest[0]) < self._far[0]:
            raise UsageError(f"voltage {v} V is none that a stage can be given; leave such samples out")
        if v == self._v:
            return self._y
        s = 1 if v > self._v else -1
        self._turn_to(s)
        while s * (v - self._close[0]) >= 0.0:
            self._close_loop()
        return self._slide_to_voltage(v)

    def _turn_or_close_at_displacement(self, y: float, lower: float, upper: float) -> float:
        if not abs(y - self._rest[1]) < self._far[1]:
            raise UsageError(f"displacement {y} m is none that a stage can take; leave such samples out")
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
                return self._stop_at(limit)
            self._close_loop()
        return self._slide_to_displacement(y, lower, upper)

    def _through(
        self, x: FloatArray, coordinate: int, lower: float, upper: float, reached: FloatArray | None
    ) -> FloatArray:
        """Drive one coordinate (0 voltage, 1 displacement) through `x` and return the other; note what was missed."""
        x = np.ascontiguousarray(x, dtype=np.float64)
        if not x.size:
            return np.empty_like(x)
        rest, far = self._rest[coordinate], self._far[coordinate]
        # Two passes without a copy; NaN fails both comparisons.
        if not (rest - far < x.min() and x.max() < rest + far):
            require_finite(x)
            at = int(np.argmax(np.abs(x - rest)))
            raise UsageError(f"sample {at} is {x[at]} {'Vm'[coordinate]}, none of a stage; leave such samples out")
        out = np.empty_like(x)
        for start, stop in monotone_runs(x):
            # Not in step: held at a voltage limit, away from the wished displacement.
            in_step = start and x[start - 1] == (self._y if coordinate else self._v)
            if stop - start >= SHORT_RUN and in_step:
                start = self._along_branches(x, out, start, stop, coordinate, lower, upper)
            noted = None if reached is None else reached[start:stop]
            out[start:stop] = self._sample_by_sample(x[start:stop].tolist(), coordinate, lower, upper, noted)
        return out

    def _sample_by_sample(
        self, run: list[float], coordinate: int, lower: float, upper: float, reached: FloatArray | None
    ) -> list[float]:
        """Move through a monotone run; return its answers. Quick where most samples stay on the branch of the last."""
        answers: list[float] = []
        while len(answers) < len(run):
            x = run[len(answers)]
            answers.append(self.inverse(x, lower, upper) if coordinate else self.forward(x))
            if x == (self._y if coordinate else self._v):
                self._slide_through(run, answers, coordinate, lower, upper)
            elif reached is not None:
                reached[len(answers) - 1] = self._y
        return answers

    def _slide_through(
        self, run: list[float], answers: list[float], coordinate: int, lower: float, upper: float
    ) -> None:
        """Answer samples of a run as long as they follow the present one on its branch, within voltage limits."""
        s, origin = self._direction, (self._v0, self._y0)
        reach = self._reach_f if coordinate else self._reach_u
        drive, response = (self._f, self._u) if coordinate else (self._u, self._f)
        d_origin, r_origin = origin[coordinate], origin[1 - coordinate]
        last = present = self._y if coordinate else self._v
        i = bisect_right(drive, s * (present - d_origin), 1)
        for x in run[len(answers) :]:
            d = s * (x - d_origin)
            if not (s * (x - present) > 0.0 and d < reach and d < drive[-1]):
                break
            while drive[i] <= d:
                i += 1
            d_a, r_a = drive[i - 1], response[i - 1]
            answer = r_origin + s * (r_a + (d - d_a) * ((response[i] - r_a) / (drive[i] - d_a)))
            if coordinate and not lower <= answer <= upper:
                break
            answers.append(answer)
            present = x
        if present != last:
            self.arrive(*((answers[-1], present) if coordinate else (present, answers[-1])))

    def _along_branches(
        self, x: FloatArray, out: FloatArray, start: int, stop: int, coordinate: int, lower: float, upper: float
    ) -> int:
        """Evaluate the run ``start:stop`` branch by branch; return how far, which a voltage limit may end early."""
        reached = start
        for begin, end in self.pieces(x, start, stop, coordinate, lower, upper):
            drive, response = self._knots(coordinate, float(x[end - 1]))
            result = np.interp(x[begin:end], drive, response)
            if coordinate:
                end = begin + int(np.count_nonzero((result >= lower) & (result <= upper)))
            out[begin:end] = result[: end - begin]
            if end > begin:
                present = float(x[end - 1]), float(out[end - 1])
                self.arrive(*(present[::-1] if coordinate else present))
                reached = end
            if end - begin < len(result):
                break
        return reached
