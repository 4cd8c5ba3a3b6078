"""Compiled (Numba) version of the engine in `turning_points` for whole paths; its results are bit-identical.

Importing Numba takes about 0.5 s: import this module only where a long path is evaluated.
"""

from collections.abc import Callable
from math import exp, inf, isnan, nan
from typing import Any, NamedTuple, TypeVar, cast

import numpy as np
from numpy.typing import NDArray

from slpi_ros.hysteresis import compilation
from slpi_ros.hysteresis.turning_points import END, Branches

FloatArray = NDArray[np.float64]
Function = TypeVar("Function", bound=Callable[..., Any])


def compiled(function: Function) -> Function:
    """Return a function that is compiled by Numba at its first call, or the function itself where Numba is missing.

    The machine code is cached beside the source, or in ``NUMBA_CACHE_DIR`` or the user's cache folder; if none of these
    is writable, every process compiles the function. Only changes of the function's own file invalidate the cache:
    compiled functions that call each other must be in one file.
    """
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
    walk: NDArray[np.int64],
    piece: FloatArray,
    rest: FloatArray,
    symmetric_rest: bool,
    first: FloatArray,
    branches: Branches,
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
    walk : ndarray of int, shape (3, depth + N), or (3, 0)
        Rows 0 and 1 are set to each sample's branch: the sample at which it started and its direction. Row 2 holds the
        sample of each reversal. A branch without reversal starts at sample -1.
    piece : ndarray, shape (2, 4) or (2, 0), volts and metres
        If the path moves, columns 0 to 3 are set to starting point and closing point of the last branch, and to the
        knots before and after the last sample, relative to the starting point.
    rest : ndarray, shape (2,), volts and metres
    symmetric_rest, branches : bool, Branches
        As in `Shape`.
    first : ndarray, shape (2, k), volts and metres
        Knots of the first rise from rest.

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
    if entered and piece.size:
        for c in range(2):
            piece[c, 0], piece[c, 1], piece[c, 2], piece[c, 3] = begin[c], close[c], knots[c, i - 1], knots[c, i]
    return n, s, depth


class Play(NamedTuple):
    """A play operator with rate-dependent half-width before the hysteresis.

    Parameters
    ----------
    coercivity, exponent, reference_rate, onset, settling : float
    reversible : ndarray, shape (k,)
        As in `slpi_ros.effects.rate_dependence.RateDependence`.
    inside : float
        Share of the half-width from which on a command is at the end of the play.
    trials, chords : int
        Numbers of iterations for the voltage at the hysteresis, and for a command within the play.
    """

    coercivity: float
    exponent: float
    reference_rate: float
    onset: float
    settling: float
    reversible: FloatArray
    inside: float
    trials: int
    chords: int


@compiled
def half_width(rate: float, coercivity: float, exponent: float, reference_rate: float, onset: float) -> float:
    """Return the half-width (V) of a play operator at a rate (V/s); parameters as in `RateDependence`."""
    if not onset:
        grown: float = (rate / reference_rate) ** exponent
    else:
        # The compiler moves this constant out of a loop.
        at_reference = (1.0 + reference_rate / onset) ** exponent - 1.0
        grown = ((1.0 + rate / onset) ** exponent - 1.0) / at_reference
    return coercivity * grown


@compiled
def bypass(gains: FloatArray, v: float, u: float) -> float:
    """Return the reversible displacement (m) at a command `v` (V) and a voltage `u` (V) of the hysteresis."""
    total, v_power, u_power = 0.0, 1.0, 1.0
    for gain in gains:
        v_power, u_power = v_power * v, u_power * u
        total += gain * (v_power - u_power)
    return total


@compiled
def transfer(source: FloatArray, target: FloatArray) -> None:
    """Copy a piece, shape (2, 4). An assignment of a whole array would take several seconds to compile."""
    for c in range(2):
        for k in range(4):
            target[c, k] = source[c, k]


@compiled
def on_piece(x: float, now: float, s: float, here: int, piece: FloatArray) -> float:
    """Return the other coordinate at `x`, ahead of `now`, on a piece of a branch as in `through`; NaN beyond it."""
    there, u = 1 - here, s * (x - piece[here, 0])
    if s * (x - now) > 0.0 and piece[here, 2] <= u < piece[here, 3] and s * (x - piece[here, 1]) < 0.0:
        slope = (piece[there, 3] - piece[there, 2]) / (piece[here, 3] - piece[here, 2])
        answer: float = piece[there, 0] + s * (piece[there, 2] + (u - piece[here, 2]) * slope)
        return answer
    return nan


@compiled
def through_play(
    elapsed: FloatArray,
    pause: float,
    h: FloatArray,
    lower: float,
    upper: float,
    rounding: FloatArray,
    out: FloatArray,
    held: NDArray[np.bool_],
    direction: float,
    point: FloatArray,
    turns: FloatArray,
    depth: int,
    play: Play,
    rest: FloatArray,
    symmetric_rest: bool,
    first: FloatArray,
    branches: Branches,
) -> tuple[int, float]:
    """Compensate a play operator before the hysteresis, as `StreamingInverse.move` does at each sample.

    Parameters
    ----------
    elapsed : ndarray, shape (N,), seconds
        Time since the preceding sample.
    pause : float, seconds
        Of a longer time only this last part counts for the new command.
    h : ndarray, shape (N,), metres
        Desired displacement of hysteresis and reversible part.
    rounding : ndarray, shape (2,), relative and metres
        Tolerances for rounding errors of voltages and displacements.
    out : ndarray, shape (N,), volts
        Output: the commands.
    held : ndarray of bool, shape (N,)
        Output: whether the command is held at the limit beyond which the displacement lies.
    turns : ndarray, shape (2, depth + 2 N + 2), volts and metres
    play : Play
    lower, upper, direction, point, depth, rest, symmetric_rest, first, branches
        As in `through`.

    Returns
    -------
    done : int
        Number of samples evaluated; less than N if the model cannot reach the next one.
    wanted : float, metres
        Last displacement of the hysteresis.
    """
    s, gains, shape = direction, play.reversible, (rest, symmetric_rest, first, branches)
    law = play.coercivity, play.exponent, play.reference_rate, play.onset
    settling, inside, trials, chords = play.settling, play.inside, play.trials, play.chords
    one, other, walk = np.empty(1), np.empty(1), np.empty((3, 0), dtype=np.int64)
    # Before the first motion the piece is not known; comparisons with NaN are false.
    piece, kept = np.full((2, 4), nan), np.empty((2, 4))
    command = u = aimed = point[0]
    rate = rate_out = rate_aimed = wanted = 0.0
    for n in range(h.size):
        missing = 0.0
        # Part 0: the last command during a pause; part 1: the new command.
        for part in range(0 if elapsed[n] > pause else 1, 2):
            dt = min(elapsed[n], pause) if part else elapsed[n] - pause
            width, aim = half_width(rate_out, *law), nan
            v, s_0, v_0, y_0, depth_0, moved = command, s, point[0], point[1], depth, False
            if part:
                low, high = bypass(gains, u - width, u), bypass(gains, u + width, u)
                way = 1.0 if h[n] - y_0 > 0.5 * (low + high) else -1.0
                if low < h[n] - y_0 < high:
                    v, slope = u, 0.5 * (high - low) / width
                    for _ in range(chords):
                        v += (h[n] - y_0 - bypass(gains, v, u)) / slope
                    missing = h[n] - bypass(gains, v, v_0) - y_0
                else:
                    before, reached = nan, v_0
                    for _ in range(trials):
                        wanted = h[n] - bypass(gains, reached + way * width, reached)
                        wanted = max(wanted, y_0) if way > 0.0 else min(wanted, y_0)
                        if wanted == before:
                            break
                        if moved:
                            s, depth, point[0], point[1] = s_0, depth_0, v_0, y_0
                            transfer(kept, piece)
                        before = wanted
                        if wanted == y_0:
                            reached = v_0
                            continue
                        moved = True
                        transfer(piece, kept)
                        reached = on_piece(wanted, y_0, s, 1, piece)
                        if lower <= reached <= upper:
                            point[0], point[1] = reached, wanted
                            continue
                        one[0] = wanted
                        done, s, depth = through(
                            one, 1, lower, upper, other, s, point, turns, depth, walk, piece, *shape
                        )
                        if not done:
                            return n, wanted
                        reached = point[0]
                    v, aim = reached + way * width, reached
                    missing = h[n] - bypass(gains, v, reached) - point[1]
                goal, v = v, min(max(v, lower), upper)
                if abs(missing) <= rounding[1]:
                    missing = goal - v if abs(goal - v) > rounding[0] * (1.0 + abs(goal)) else 0.0
            # The play operator moves with the command.
            change, u_0 = v - command, u
            if dt > 0.0:
                faded = exp(-dt / settling) if settling else 0.0
                rate = abs(change) / dt + (rate - abs(change) / dt) * faded
            reach = half_width(rate, *law)
            command, u = v, min(max(u_0, v - reach), v + reach)
            if dt > 0.0 and (u != u_0 or abs(v - u_0) < inside * width):
                speed = abs(u - u_0 if u != u_0 else change) / dt
                rate_out = speed + (rate_out - speed) * faded
            if isnan(aim):
                aimed, rate_aimed = u, rate_out
            else:
                if dt > 0.0:
                    speed = abs(aim - aimed) / dt
                    rate_aimed = speed + (rate_aimed - speed) * faded
                aimed, rate_out = aim, min(rate_out, rate_aimed)
            if u != point[0]:
                if moved:
                    s, depth, point[0], point[1] = s_0, depth_0, v_0, y_0
                    transfer(kept, piece)
                answer = on_piece(u, v_0, s, 0, piece)
                if not isnan(answer):
                    point[0], point[1] = u, answer
                    continue
                one[0] = u
                done, s, depth = through(one, 0, lower, upper, other, s, point, turns, depth, walk, piece, *shape)
                if not done:
                    return n, wanted
        short = h[n] - (point[1] + bypass(gains, command, u))
        limit = upper if missing > 0.0 else lower
        near = abs(command - limit) <= rounding[0] * (1.0 + abs(limit))
        out[n], held[n] = command, near and missing * short > 0.0
    return h.size, wanted
