"""The convex quadratic program that every identification ends in."""

import numpy as np
import osqp
import scipy.linalg
import scipy.sparse as sp
from numpy.typing import NDArray

from slpi_ros.errors import IdentificationError

FloatArray = NDArray[np.float64]

# A constraint may be missed by this much, in units of the scaled problem; the least gain is far above it.
TOLERANCE = 1e-7
# The solver's own habit.
CHECKED_EVERY = 25


def solve_qp(
    matrix: FloatArray,
    vector: FloatArray,
    constraints: sp.csr_array,
    bound: FloatArray,
    *,
    least_iterations: int = CHECKED_EVERY,
) -> FloatArray:
    """Minimise ``x' M x / 2 - b' x`` subject to ``C x >= bound``.

    Parameters
    ----------
    matrix : ndarray, shape (p, p)
        M, positive definite.
    vector : ndarray, shape (p,)
        b.
    constraints : sparse array, shape (m, p)
        C.
    bound : ndarray, shape (m,)
    least_iterations : int
        The solver does not stop before; convergence is checked each time so many have been done.

    Returns
    -------
    ndarray, shape (p,)

    Raises
    ------
    IdentificationError
        If the solver does not end with a solution.
    """
    free = solve_free(matrix, vector)
    if np.all(constraints @ free >= bound):
        return free
    # Without the polishing step: it gains nothing at this tolerance, and writes on standard output.
    solver = osqp.OSQP()
    solver.setup(
        sp.csc_matrix(np.triu(matrix)), -vector, sp.csc_matrix(constraints), bound, np.full(bound.size, np.inf),
        verbose=False, eps_abs=TOLERANCE, eps_rel=TOLERANCE, max_iter=50_000, check_termination=least_iterations,
    )  # fmt: skip
    solver.warm_start(x=free)
    result = solver.solve(raise_error=False)
    if result.info.status_val != osqp.SolverStatus.OSQP_SOLVED:
        raise IdentificationError(
            f"the quadratic program did not converge (OSQP: {result.info.status}); check the record for gross errors"
        )
    solution: FloatArray = result.x
    return solution


def solve_free(matrix: FloatArray, vector: FloatArray) -> FloatArray:
    """Minimise ``x' M x / 2 - b' x`` without constraints; parameters and errors as in `solve_qp`."""
    try:
        solution: FloatArray = scipy.linalg.cho_solve(scipy.linalg.cho_factor(matrix), vector)
    except np.linalg.LinAlgError:
        raise IdentificationError("the record does not determine the model; drive more of the voltage range") from None
    return solution
