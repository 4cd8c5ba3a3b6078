"""Compiled (Numba) engine of `turning_points` for whole paths, bit-identical; its import takes about 0.5 s."""

from collections.abc import Callable
from math import asinh, inf, sinh
from typing import Any, TypeVar, cast

import numpy as np

from slpi_ros.arrays import FloatArray, IntArray
from slpi_ros.hysteresis import compilation, rate_law
from slpi_ros.hysteresis.rate_law import LARGEST
from slpi_ros.hysteresis.shapes import END, Branches

Function = TypeVar("Function", bound=Callable[..., Any])


def compiled(function: Function) -> Function:
    """Return a function that is compiled by Numba at its first call, or the function itself where Numba is missing."""
    # The machine code is cached beside the source, or in ``NUMBA_CACHE_DIR`` or the user's cache folder; if none of
    # these is writable, every process compiles the function. Only changes of the function's own file invalidate the
    # cache: compiled functions that call each other must be in one file.
    njit = compilation.compiler()
    if njit is None:
        return function
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
def room(first: FloatArray, branches: Branches) -> FloatArray:
    """Return an array for the knots of any branch, shape (2, k); `first` are those of the first rise from rest."""
    return np.empty((2, max(first.shape[1], branches.knots.shape[3], 4 * branches.operators.shape[1] + 2)))


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
    walk: IntArray,
    ends: FloatArray,
    knots: FloatArray,
    rest: FloatArray,
    symmetric_rest: bool,
    first: FloatArray,
    branches: Branches,
) -> tuple[int, float, int, int]:
    """Move a memory along a path, as `Memory.forward` or `Memory.inverse` does at each sample.

    Return the number of samples evaluated (less than N if the model cannot reach the next one), the direction, the
    depth and, if the path moves, the index of the knot after the last sample.

    The path `x`, shape (N,), is voltage (V; `coordinate` 0) or displacement (m; `coordinate` 1). `lower` and `upper`
    (V) limit the voltage of the inverse; `point` must lie within them. `direction` is +1 rising, -1 falling, 0 at rest.
    `rest`, shape (2,), and `first`, shape (2, k), the knots of the first rise from there, are in V and m;
    `symmetric_rest` and `branches` are as in `Shape`.

    Modified in place, V and m: `out`, shape (N,), the other coordinate along the path; `point`, shape (2,), the current
    point; `turns`, shape (2, depth + N), the stack of reversals, of which the first `depth` columns are in use; if the
    path moves, `ends`, shape (2, 2) or (2, 0), starting point and closing point of the last branch, as columns;
    `knots`, shape (2, k), as from `room`, the knots of the last branch relative to its starting point. Of `walk`, shape
    (3, depth + N) or (3, 0), rows 0 and 1 are set to each sample's branch: the sample at which it started, -1 without
    reversal, and its direction; row 2 holds the sample of each reversal.
    """
    s, other = direction, 1 - coordinate
    low, high = (lower, upper) if coordinate else (-inf, inf)
    begin, close = np.empty(2), np.empty(2)
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
                return n, s, depth, i
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
    if entered and ends.size:
        for c in range(2):
            ends[c, 0], ends[c, 1] = begin[c], close[c]
    return n, s, depth, i


@compiled
def along(
    target: float,
    coordinate: int,
    lower: float,
    upper: float,
    point: FloatArray,
    at: IntArray,
    ends: FloatArray,
    knots: FloatArray,
) -> bool:
    """Move a memory on its present straight piece; return whether no end, loop closure or limit is met."""
    s, i, other = float(at[0]), at[2], 1 - coordinate
    if i == 0 or not s * (target - point[coordinate]) > 0.0 or not s * (target - ends[coordinate, 1]) < 0.0:
        return False
    u, u_a, f_a = s * (target - ends[coordinate, 0]), knots[coordinate, i - 1], knots[other, i - 1]
    if not u_a <= u < knots[coordinate, i]:
        return False
    slope = (knots[other, i] - f_a) / (knots[coordinate, i] - u_a)
    answer = ends[other, 0] + s * (f_a + (u - u_a) * slope)
    if coordinate == 1 and not lower <= answer <= upper:
        return False
    point[coordinate], point[other] = target, answer
    return True


@compiled
def moved(
    target: float,
    coordinate: int,
    lower: float,
    upper: float,
    point: FloatArray,
    turns: FloatArray,
    at: IntArray,
    ends: FloatArray,
    knots: FloatArray,
    rest: FloatArray,
    symmetric_rest: bool,
    first: FloatArray,
    branches: Branches,
) -> bool:
    """Move a memory to a voltage (V; `coordinate` 0) or displacement (m; 1); return False if it cannot be reached."""
    # It does what `Memory.forward` and `Memory.inverse` do. `at`, shape (4,), is modified in place: direction, depth of
    # the stack, index of the knot after the present point (0: `ends` and `knots` are not those of the present branch),
    # and 1 once the branch or its piece may have changed. `point` may lie outside the limits; else as in `through`.
    one, out, walk = np.empty(1), np.empty(1), np.empty((3, 0), dtype=np.int64)
    ways = 1 if coordinate == 0 or lower <= point[0] <= upper else 2
    for way in range(ways):
        driven = coordinate if way == ways - 1 else 0
        one[0] = target if way == ways - 1 else min(max(point[0], lower), upper)
        before, ends[0, 0] = ends[0, 0], np.nan
        done, direction, depth, knot = through(
            *(one, driven, lower, upper, out, float(at[0]), point, turns, at[1], walk, ends, knots),
            *(rest, symmetric_rest, first, branches),
        )
        if np.isnan(ends[0, 0]):
            ends[0, 0] = before
        else:
            at[2], at[3] = knot, 1
        at[0], at[1] = int(direction), depth
        if done < 1:
            return False
    return True


solved, followed = compiled(rate_law.solved), compiled(rate_law.followed)


@compiled
def felt(t: FloatArray, v: FloatArray, threshold: float, onset_rate: float, lead: float) -> FloatArray:
    """Return the voltage that the hysteresis feels, (N,), V, by `rate_law`, for threshold (V) and onset rate (V/s)."""
    # `lead` (V) is the difference of the two voltages, applied minus felt, at the first sample.
    felt_voltage, w, before, earlier = np.empty_like(v), 0.0, 0.0, 0.0
    u = v[0] - lead if v.size else 0.0
    for k in range(v.size):
        scale, way = onset_rate * (t[k] - t[k - 1]) if k else 0.0, v[k] - u
        if scale > 0.0:
            if way != 0.0:
                # Extrapolated from the two samples before the last one: it is computed while that one is being solved.
                guess = 3.0 * before - 2.0 * earlier
                w, before, earlier = solved(scale, threshold, abs(way), guess), w, before
                u = followed(threshold, v[k], u, w)
        elif k:
            # In no time the difference between the two voltages stays what it was.
            u += v[k] - v[k - 1]
        felt_voltage[k] = u
    return felt_voltage


@compiled
def through_law(
    dt: float,
    h: float,
    law: FloatArray,
    lower: float,
    upper: float,
    state: FloatArray,
    direction: float,
    point: FloatArray,
    turns: FloatArray,
    depth: int,
    rest: FloatArray,
    symmetric_rest: bool,
    first: FloatArray,
    branches: Branches,
) -> tuple[bool, float, int]:
    """Compensate the rate law and the hysteresis for one sample, as `StreamingRateDependence.inverse` does."""
    # Return whether the model can reach the sample, the direction and the depth. `dt` (s) is the time from the sample
    # before, and `h` (m) the desired displacement of hysteresis and reversible part. `law` holds threshold (V), onset
    # rate (V/s) and reversible gain (m/V). `state`, shape (5,), is modified in place: applied voltage (V), within the
    # limits, magnitudes of ``w`` of the last three samples, and the last `h` (NaN: none). All other arguments are as in
    # `through`.
    threshold, onset_rate, reversible = law[0], law[1], law[2]
    s, shape = direction, (rest, symmetric_rest, first, branches)
    one, other, walk = np.empty(1), np.empty(1), np.empty((3, 0), dtype=np.int64)
    ends, knots, knot = np.empty((2, 2)), room(first, branches), 0
    # Start of the branch, first knot of its present piece, end (V) and inverse slope (V/m; 0 if flat) of the piece.
    v_begin, y_begin, u_knot, f_knot, end_piece, rise = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    u, y, closes = point[0], point[1], False
    v, w, w_before, w_earlier, last = state
    scale, u0, y0, s_0, depth_0 = onset_rate * dt, u, y, s, depth
    lead = v - u0
    if not scale > 0.0 and h == last:
        return True, s, depth
    gain = reversible * threshold if scale > 0.0 else 0.0
    target = h if scale > 0.0 else h - reversible * lead
    turn = 1.0 if target > y0 else -1.0
    limit = upper if turn > 0.0 else lower
    if not scale > 0.0:
        limit -= lead
    guess, w_kept = 3.0 * w_before - 2.0 * w_earlier, w
    if scale > 0.0:
        w_earlier, w_before, w = w_before, w, 0.0
    if target != y0 and turn * (limit - u0) > 0.0:
        # The smallest step enters the branch.
        enter, next_piece = True, False
        step = np.nextafter(u0, turn * inf)
        while True:
            if enter:
                point[0], point[1], one[0] = u, y, step
                done, s, depth, knot = through(
                    one, 0, lower, upper, other, s, point, turns, depth, walk, ends, knots, *shape
                )
                if not done:
                    return False, s, depth
                u, y = point[0], point[1]
                if step == limit:
                    w = asinh(abs(limit - u0) / scale) if scale > 0.0 else 0.0
                    break
            if enter or next_piece:
                height = knots[1, knot] - knots[1, knot - 1]
                rise = (knots[0, knot] - knots[0, knot - 1]) / height if height > 0.0 else 0.0
                v_begin, y_begin, u_knot, f_knot = ends[0, 0], ends[1, 0], knots[0, knot - 1], knots[1, knot - 1]
                end_piece = v_begin + s * knots[0, knot]
                closes = s * (ends[0, 1] - end_piece) <= 0.0
                if closes:
                    end_piece = ends[0, 1]
            above = s * (target - y_begin) - f_knot
            v_line = v_begin + s * (u_knot + above * rise)
            if rise == 0.0:
                # On a flat piece only the reversible part moves; without it the piece is passed.
                w = max(above, 0.0) / gain if gain > 0.0 else LARGEST
                v_line = u0 + s * (scale * sinh(min(w, LARGEST))) if w < LARGEST else s * inf
            elif scale > 0.0:
                goal = max(s * (v_line - u0), 0.0)
                w = guess = solved(scale, rise * gain, goal, guess)
                v_line = u0 + s * (goal - rise * gain * w)
            end = limit if s * (limit - end_piece) < 0.0 else end_piece
            if s * (end - v_line) > 0.0:
                u, y = v_line, target - s * (gain * w)
                break
            if end == limit:
                enter, step = True, limit
            elif closes or knots[0, knot] >= END:
                # A rounding error must not leave it on the branch that ends here.
                enter, step = True, np.nextafter(end, turn * inf)
            else:
                enter, next_piece, knot = False, True, knot + 1
    wanted = u + threshold * (w if turn > 0.0 else -w) if scale > 0.0 else u + lead
    before, v = v, min(max(wanted, lower), upper)
    if v != wanted:
        # A limit holds the voltage back: the memory follows what is applied.
        point[0], point[1], s, depth = u0, y0, s_0, depth_0
        if scale > 0.0:
            way, u = v - u0, u0
            if way != 0.0:
                w = solved(scale, threshold, abs(way), 0.0)
                u = followed(threshold, v, u, w)
        else:
            u = u0 + (v - before)
        if u != u0:
            one[0] = u
            done, s, depth, knot = through(
                one, 0, lower, upper, other, s, point, turns, depth, walk, ends, knots, *shape
            )
            if not done:
                return False, s, depth
        u, y = point[0], point[1]
    if not scale > 0.0:
        w = w_kept
    point[0], point[1] = u, y
    state[:] = v, w, w_before, w_earlier, h
    return True, s, depth
