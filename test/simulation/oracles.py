"""Solutions of the stage's differential equations by another way than its own."""

import numpy as np
from scipy.integrate import solve_ivp
from scipy.signal import lsim


def lagged(time_constant, t, u):
    """A first-order lag from rest at 0, evenly sampled."""
    return lsim(([1.0], [time_constant, 1.0]), u, t)[1]


def ringing(frequency, damping, t, u):
    """A second-order mode from rest at 0, evenly sampled."""
    omega = 2 * np.pi * frequency
    return lsim(([omega**2], [1.0, 2 * damping * omega, omega**2]), u, t)[1]


def integrated(rate_of_change, start, t, u):
    """Integrate ``dx/dt = rate_of_change(x, u)`` numerically over uneven samples with a linear input between them."""
    states = [np.array(start, dtype=float)]
    for begin, end, first, last in zip(t[:-1], t[1:], u[:-1], u[1:], strict=True):
        slope = (last - first) / (end - begin)

        def derivative(now, x, begin=begin, first=first, slope=slope):
            return rate_of_change(x, first + slope * (now - begin))

        solution = solve_ivp(derivative, (begin, end), states[-1], method="DOP853", rtol=1e-11, atol=1e-13)
        states.append(solution.y[:, -1])
    return np.array(states)
