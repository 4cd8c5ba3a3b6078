"""Hysteresis operators in compiled form; all voltages are scaled to -1..1."""

import numpy as np
from numba import njit
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]


@njit(cache=True)
def lagged(u: FloatArray, shares: FloatArray) -> FloatArray:
    """Return a first-order lag of `u`, (N,); `shares` (N,) of the way that is gone in each step."""
    out = np.empty_like(u)
    x = u[0]
    for k in range(u.size):
        x += shares[k] * (u[k] - x)
        out[k] = x
    return out


def plays(u: FloatArray, radii: FloatArray, rows: IntArray) -> FloatArray:
    """Return the states of play operators with constant radii at increasing `rows`, (R, K), from rest at ``u[0]``."""
    return envelope_plays(u, u, radii, rows)


@njit(cache=True)
def envelope_plays(rising: FloatArray, falling: FloatArray, radii: FloatArray, rows: IntArray) -> FloatArray:
    """Return generalised play operators with the envelopes `rising` and `falling`, (N,), of the input, (R, K)."""
    states = np.full(radii.size, 0.5 * (rising[0] + falling[0]))
    out = np.empty((rows.size, radii.size))
    at = 0
    for k in range(rising.size):
        for i in range(radii.size):
            states[i] = max(rising[k] - radii[i], min(falling[k] + radii[i], states[i]))
        while at < rows.size and rows[at] == k:
            out[at] = states
            at += 1
    return out


@njit(cache=True)
def inverse_plays(
    wanted: FloatArray, radii: FloatArray, weights: FloatArray, states: FloatArray, limit: float
) -> FloatArray:
    """Return the input, (N,), with which weighted play operators (K,) give `wanted`, by bisection of each sample.

    `states` (K,) are those before the first sample. The input is kept within -limit..limit.
    """
    out, states = np.empty_like(wanted), states.copy()
    for k in range(wanted.size):
        low, high = -limit, limit
        for _ in range(50):
            middle, total = 0.5 * (low + high), 0.0
            for i in range(radii.size):
                total += weights[i] * max(middle - radii[i], min(middle + radii[i], states[i]))
            if total < wanted[k]:
                low = middle
            else:
                high = middle
        out[k] = 0.5 * (low + high)
        for i in range(radii.size):
            states[i] = max(out[k] - radii[i], min(out[k] + radii[i], states[i]))
    return out


def rate_plays(u: FloatArray, widening: FloatArray, radii: FloatArray, rows: IntArray) -> FloatArray:
    """Return play operators whose radii grow by `widening`, (N,), (R, K)."""
    return envelope_plays(u - widening, u + widening, radii, rows)


@njit(cache=True)
def relays(u: FloatArray, cells: int, fine: int, rows: IntArray) -> FloatArray:
    """Return the Preisach plane over -1..1 in `cells` by `cells` cells: the share of relays that are on, (R, C).

    Each cell holds `fine` by `fine` relays. Between two levels the row or column of relays that comes next is partly
    switched, so that the output is continuous. The plane is wiped at the start: on below the antidiagonal.
    """
    levels = cells * fine
    on = np.zeros((levels, levels), dtype=np.bool_)
    number = np.full((cells, cells), -1, dtype=np.int64)
    count = 0
    for i in range(cells):
        for j in range(i + 1):
            number[i, j] = count
            count += 1
    cell = np.zeros(count)
    middle = (u[0] + 1.0) / 2.0 * levels
    for i in range(levels):
        for j in range(i + 1):
            # relay (i, j) switches on above level i, off below level j
            if i + j + 1 < 2.0 * middle:
                on[i, j] = True
                cell[number[i // fine, j // fine]] += 1.0
    out = np.empty((rows.size, count))
    at, position, rising = 0, middle, True
    for k in range(u.size):
        x = min(max((u[k] + 1.0) / 2.0 * levels, 0.0), float(levels))
        if x > position:
            rising = True
        elif x < position:
            rising = False
        for i in range(max(int(np.floor(position - 1.0)), 0), min(int(np.floor(x)), levels)):
            # passed upwards: all relays that switch on at the upper edge of step i
            if x >= i + 1.0:
                for j in range(i + 1):
                    if not on[i, j]:
                        on[i, j] = True
                        cell[number[i // fine, j // fine]] += 1.0
        for j in range(min(int(np.ceil(position + 1.0)), levels) - 1, int(np.ceil(x)) - 1, -1):
            if x <= j:
                for i in range(j, levels):
                    if on[i, j]:
                        on[i, j] = False
                        cell[number[i // fine, j // fine]] -= 1.0
        position = x
        while at < rows.size and rows[at] == k:
            out[at] = cell
            step = min(int(x), levels - 1)
            part = x - step
            if rising:
                for j in range(step + 1):
                    if not on[step, j]:
                        out[at, number[step // fine, j // fine]] += part
            else:
                for i in range(step, levels):
                    if on[i, step]:
                        out[at, number[i // fine, step // fine]] -= 1.0 - part
            at += 1
    return out / (fine * fine)


@njit(cache=True)
def bouc_wen(u: FloatArray, beta: float, gamma: float, power: float) -> FloatArray:
    """Return the hysteretic variable of a Bouc-Wen model with unit gain, (N,), from 0 at ``u[0]``."""
    out = np.empty_like(u)
    z = 0.0
    previous = u[0]
    for k in range(u.size):
        du = u[k] - previous
        # Steps that are large against the loop are divided.
        parts = int(abs(du) / 0.02) + 1
        for _ in range(parts):
            size = abs(z) ** power
            d = du / parts
            z += d - (beta * abs(d) * (1.0 if z >= 0.0 else -1.0) + gamma * d) * size
            z = min(max(z, -1e3), 1e3)
        previous = u[k]
        out[k] = z
    return out


@njit(cache=True)
def relaxations(x: FloatArray, shares: FloatArray, rows: IntArray) -> FloatArray:
    """Return first-order lags of `x` (N,), (R, K); `shares` (N, K) of the way in each step; all start settled."""
    states = np.full(shares.shape[1], x[0])
    out = np.empty((rows.size, states.size))
    at = 0
    for k in range(x.size):
        for i in range(states.size):
            states[i] += shares[k, i] * (x[k] - states[i])
        while at < rows.size and rows[at] == k:
            out[at] = states
            at += 1
    return out


@njit(cache=True)
def polynomial_run(u: FloatArray, powers: IntArray, gains: FloatArray, first: float) -> FloatArray:
    """Return the free run of a polynomial NARX model, (N,), from `first` at rest.

    `powers` (T, 6) are the exponents of y(k-1), y(k-2), u(k), u(k-1), u(k)-u(k-1) and its sign in each term. The
    output is kept within -3..3, as a polynomial can grow without bound.
    """
    out = np.empty_like(u)
    y1, y2 = first, first
    for k in range(u.size):
        before = u[k - 1] if k > 0 else u[0]
        change = u[k] - before
        sign = 1.0 if change > 0.0 else (-1.0 if change < 0.0 else 0.0)
        values = (y1, y2, u[k], before, change, sign)
        y = 0.0
        for term in range(gains.size):
            product = gains[term]
            for i in range(6):
                for _ in range(powers[term, i]):
                    product *= values[i]
            y += product
        y = min(max(y, -3.0), 3.0)
        out[k] = y
        y2 = y1
        y1 = y
    return out
