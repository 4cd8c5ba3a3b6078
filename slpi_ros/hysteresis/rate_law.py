"""The equation of the rate law, ``v = u + c asinh((du/dt) / s0)`` (Eyring), for one sample.

With ``w = asinh(d / (s0 dt))`` for the change ``d`` of the voltage ``u`` that the hysteresis feels, both directions of
the law are ``a sinh(w) + b w = goal``, with a unique solution: the forward law with ``a = s0 dt`` and ``b = c``, the
inverse on a straight piece of a branch with the reversible gain, relative to its slope, times ``c`` as ``b``.

`slpi_ros.hysteresis.compiled` compiles `solved` and `followed`, too, and keeps the machine code until its own file
changes.
"""

from math import asinh, exp

# The iteration ends after a step below this size: its convergence is cubic.
CONVERGED = 1e-4
# Largest number of iterations, a step after which they begin anew from the bound, and the largest guess.
MOST, TOO_FAR, LARGEST = 100, 1.5, 30.0


def solved(a: float, b: float, goal: float, guess: float) -> float:
    """Return ``w`` of ``a sinh(w) + b w = goal``, all >= 0, not a = b = 0, by Chebyshev's method from any `guess`."""
    if b == 0.0:
        return asinh(goal / a)
    if a == 0.0:
        return goal / b
    w, half = guess, 0.5 * a
    if not 0.0 < w < LARGEST:
        w = min(goal / b, asinh(goal / a))
    for k in range(MOST):
        # Numerator and denominator of Newton's step times exp(w), so that there is one division.
        grown = exp(w)
        up = half * grown * grown
        bent, inverse_slope = up - half, 1.0 / (up + half + b * grown)
        step = ((goal - b * w) * grown - bent) * inverse_slope
        curvature = 0.5 * step * bent * inverse_slope
        if abs(curvature) < 0.5:
            step -= step * curvature
        if k < 3 and (step > TOO_FAR or step <= -w):
            # Both terms are at most the goal, so that this bound is above the solution; all steps from it go down.
            w = min(goal / b, asinh(goal / a))
            continue
        w += step
        if abs(step) <= CONVERGED:
            break
    return w


def followed(threshold: float, v: float, u: float, w: float) -> float:
    """Return the voltage that the hysteresis feels next, for the applied voltage `v`, the last one `u` (V), and `w`."""
    # It follows without overshoot, whatever the rounding: a reversal would be remembered.
    if v > u:
        return min(max(v - threshold * w, u), v)
    return max(min(v + threshold * w, u), v)
