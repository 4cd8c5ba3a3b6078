"""Compiled (Numba) version of the engine in `turning_points` for whole paths; its results are bit-identical.

Importing Numba takes about 0.5 s: import this module only where a long path is evaluated.
"""

from collections.abc import Callable
from math import inf
from typing import Any, TypeVar, cast

import numpy as np
from numba import njit
from numpy.typing import NDArray

from slpi_ros.hysteresis.turning_points import END, Branches

FloatArray = NDArray[np.float64]
Function = TypeVar("Function", bound=Callable[..., Any])


def compiled(function: Function) -> Function:
    """Return a function that is compiled by Numba at its first call.

    The machine code is cached beside the source, or in ``NUMBA_CACHE_DIR`` or the user's cache folder; if none of these
    is writable, every process compiles the function. Only changes of the function's own file invalidate the cache:
    compiled functions that call each other must be in one file.
    """
    for kept in (True, False):
        try:
            return cast(Function, njit(cache=kept, nogil=True)(function))
        except RuntimeError:
            continue
    return function


@compiled
def composed(operators: FloatArray, amplitude: float, s: float, turn: float, knots: FloatArray) -> int:
    """Write the knots of a `MultiSlope` branch that starts at `turn` (V); return the index of the last knot."""
    n, count = operators.shape[1], 0
    starts, change = np.empty(n), np.empty(4 * n)
    # Sorted by insertion: the starts of the operators, and on a fall the three bends of their envelopes.
    for bend in range(1 if s > 0.0 else 4):
        for k in range(n):
            r, w = operators[0, k], operators[1, k]
            low, middle, high = -5.0 * r, 0.5 * amplitude + 1.5 * r, amplitude + 8.0 * r
            top = turn - r
            if s > 0.0:
                u = max(turn, max(top, min(1.2 * turn, 0.8 * turn + 0.2 * amplitude + 0.6 * r)) + r) - turn
            elif bend == 0:
                u = starts[k] = min(turn, max(top / 1.2, (top - 0.2 * amplitude - 0.6 * r) / 0.8))
                w *= 1.0 if u <= low or u > high else 0.8 if u > middle else 1.2
            elif bend == 1:
                u, w = low, (1.0 - 1.2) * w
            elif bend == 2:
                u, w = middle, (1.2 - 0.8) * w
            else:
                u, w = high, (0.8 - 1.0) * w
            if s < 0.0:
                if bend and u >= starts[k]:
                    continue
                u = turn - u
            at = count
            while at and knots[0, at] > u:
                knots[0, at + 1], change[at] = knots[0, at], change[at - 1]
                at -= 1
            knots[0, at + 1], change[at] = u, w
            count += 1
    knots[0, 0] = knots[1, 0] = slope = 0.0
    knots[0, count + 1] = knots[0, count] + END
    for k in range(count + 1):
        knots[1, k + 1] = knots[1, k] + slope * (knots[0, k + 1] - knots[0, k])
        if k < count:
            slope += change[k]
    return count + 1


@compiled
def interpolated(branches: Branches, s: float, turn: float, knots: FloatArray) -> int:
    """Write the knots of a branch that starts at `turn` (V), as in `Branches.curve`; return the index of the last."""
    vertices, side, row = branches.vertices, int(s < 0.0), 0
    while row < vertices.shape[1] and vertices[side, row] < s * turn:
        row += 1
    distance = vertices[side, row] - s * turn if row < vertices.shape[1] else 0.0
    last: int = branches.last[side, row]
    for c in range(2):
        for k in range(last + 1):
            knots[c, k] = branches.knots[side, row, c, k] + branches.change[side, row, c, k] * distance
    return last


@compiled
def through(
    x: FloatArray,
    coordinate: int,
    lower: float,
    upper: float,
    out: FloatArray,
    direction: float,
    point: FloatArray,
    turns: FloatArray,
    depth: int,
    rest: FloatArray,
    symmetric_rest: bool,
    first: FloatArray,
    branches: Branches,
    walk: NDArray[np.int64],
) -> tuple[int, float, int]:
    """Move a memory along a path, as `Memory.forward` or `Memory.inverse` does at each sample.

    Parameters
    ----------
    x : ndarray, shape (N,), volts or metres
    coordinate : int
        Coordinate of `x`: 0 voltage, 1 displacement.
    lower, upper : float, volts
        Voltage limits of the inverse; `point` must lie within them.
    out : ndarray, shape (N,)
        Output: the other coordinate along the path.
    direction : float
        +1 rising, -1 falling, 0 at rest.
    point : ndarray, shape (2,), volts and metres
        Current point; overwritten with the last point of the path.
    turns : ndarray, shape (2, depth + N), volts and metres
        Stack of reversals; the first `depth` columns are in use. Modified in place.
    depth : int
    rest : ndarray, shape (2,), volts and metres
    symmetric_rest, branches : bool, Branches
        As in `Shape`.
    first : ndarray, shape (2, k), volts and metres
        Knots of the first rise from rest.
    walk : ndarray of int, shape (3, depth + N), or (3, 0)
        Rows 0 and 1 are set to each sample's branch: the sample at which it started and its direction. Row 2 holds the
        sample of each reversal. A branch without reversal starts at sample -1.

    Returns
    -------
    done : int
        Number of samples evaluated; less than N if the model cannot reach the next one.
    direction : float
    depth : int
    """
    s, other = direction, 1 - coordinate
    low, high = (lower, upper) if coordinate else (-inf, inf)
    begin, close = np.empty(2), np.empty(2)
    knots = np.empty((2, max(first.shape[1], branches.knots.shape[3], 4 * branches.operators.shape[1] + 2)))
    n = last = i = 0
    entered = False
    while n < x.size:
        present = n
        target, driven = x[n], coordinate
        turn = 1.0 if target > point[driven] else -1.0
        limit = upper if turn > 0.0 else lower
        still = target == point[driven] or (driven == 1 and turn * (limit - point[0]) <= 0.0)
        if not still and turn != s:
            if s != 0.0:
                turns[0, depth], turns[1, depth] = point[0], point[1]
                if walk.size:
                    walk[2, depth] = n - 1
                depth += 1
            s, entered = turn, False
        while not still:
            if not entered:
                for c in range(2):
                    begin[c] = turns[c, depth - 1] if depth else rest[c]
                    if depth > 1:
                        close[c] = turns[c, depth - 2]
                    elif depth and symmetric_rest:
                        close[c] = 2.0 * rest[c] - begin[c]
                    else:
                        close[c] = rest[c] if depth and s > 0.0 else s * inf
                if not depth and (s > 0.0 or symmetric_rest):
                    last = first.shape[1] - 1
                    for k in range(last + 1):
                        knots[0, k], knots[1, k] = first[0, k], first[1, k]
                elif branches.operators.size:
                    last = composed(branches.operators, branches.scale[1], s, begin[0] - branches.scale[0], knots)
                else:
                    last = interpolated(branches, s, begin[0], knots)
                entered, i = True, 1
            if s * (target - close[driven]) >= 0.0:
                if driven == 1 and s * (limit - close[0]) < 0.0:
                    target, driven, i = limit, 0, 1
                else:
                    depth, entered = max(depth - 2, 0), False
                continue
            u = s * (target - begin[driven])
            if not u < knots[driven, last]:
                return n, s, depth
            while knots[driven, i] <= u:
                i += 1
            u_a, f_a = knots[driven, i - 1], knots[1 - driven, i - 1]
            slope = (knots[1 - driven, i] - f_a) / (knots[driven, i] - u_a)
            answer = begin[1 - driven] + s * (f_a + (u - u_a) * slope)
            if driven == 1 and not lower <= answer <= upper:
                target, driven, i = min(max(answer, lower), upper), 0, 1
                still = s * (target - point[0]) <= 0.0
                continue
            point[driven], point[1 - driven] = target, answer
            break
        out[n] = point[other]
        n += 1
        if not still and driven == coordinate:
            # Fast loop for following samples between the same knots: no loop closure, no limit.
            now, v, y = target, begin[coordinate], begin[other]
            end = min(knots[coordinate, i], s * (close[coordinate] - v))
            while n < x.size and s * (x[n] - now) >= 0.0:
                u = s * (x[n] - v)
                answer = y + s * (f_a + (u - u_a) * slope)
                if not (u < end and low <= answer <= high):
                    break
                now, out[n] = x[n], answer
                n += 1
            point[coordinate], point[other] = now, out[n - 1]
        for k in range(present if walk.size else n, n):
            walk[0, k], walk[1, k] = walk[2, depth - 1] if depth else -1, int(s)
    return n, s, depth
