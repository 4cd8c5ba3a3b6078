"""Convex quadratic programs, solved on their active set: few of many constraints hold with equality at the minimum."""

from typing import NamedTuple

import numpy as np
import osqp
import scipy.linalg
import scipy.linalg.lapack
import scipy.sparse as sp

from slpi_ros.arrays import FloatArray, IntArray
from slpi_ros.errors import IdentificationError

# Largest residuals of a solution, relative to the terms that they are sums of: of the constraints and of the gradient.
FEASIBLE, STATIONARY = 1e-13, 1e-13
# Proximal weight of the multipliers, whose matrix has a diagonal of 1: dependent constraints leave it singular. It
# slows the last digits, and does not change the solution.
PROXIMAL = 1e-12
# Most rounds before OSQP names the active set.
ROUNDS = 100
# Tolerance of OSQP, and its intervals (iterations) between checks and changes of its step, which by default depend on
# the time that it takes.
OSQP_TOLERANCE, CHECKED_EVERY, ADAPTED_EVERY = 1e-9, 25, 100
UNSOLVED = "the quadratic program did not converge; check the record for gross errors"


class Solution(NamedTuple):
    """Minimum of a quadratic program."""

    x: FloatArray  # (p,)
    multipliers: FloatArray  # of the constraints, (m,); 0 where they do not hold with equality


class QuadraticProgram:
    """Minimise ``x' M x / 2 - b' x`` subject to ``C x >= bound``, for one vector b or several.

    M, shape (p, p), is positive definite and factored once; C is sparse, shape (m, p). Solutions are feasible and
    optimal to rounding, which is tested by the residuals of both conditions, and the same in every run.
    """

    def __init__(self, matrix: FloatArray, constraints: sp.csr_array, bound: FloatArray) -> None:
        self._matrix, self._constraints, self._bound = matrix, constraints, bound
        self._turned = sp.csr_array(constraints.T)
        self._sizes = float(np.abs(matrix).sum(axis=0).max()), abs(constraints)
        self._root = cholesky(matrix)
        # Rows of C root^-T, scaled to unit norm, as far as they were needed, and their norms.
        self._rows, self._norms = np.empty((bound.size, matrix.shape[0])), np.zeros(bound.size)

    def solve(self, vector: FloatArray, near: FloatArray | None = None) -> Solution:
        """Return the solution for a vector b, shape (p,); `near`: multipliers of a similar problem, shape (m,)."""
        found = self._from(vector, np.zeros(self._bound.size) if near is None else near)
        if found is None:
            found = self._from(vector, self._osqp_multipliers(vector))
        if found is None:
            raise IdentificationError(UNSOLVED)
        return found

    def _from(self, vector: FloatArray, multipliers: FloatArray) -> Solution | None:
        """Return the solution, sought from `multipliers`, shape (m,); None if it is not found in `ROUNDS`."""
        constraints, (norm, sizes) = self._constraints, self._sizes
        x = self._moved(vector + self._turned @ multipliers)
        for _ in range(ROUNDS):
            gradient = vector + self._turned @ multipliers - self._matrix @ x
            gap = self._bound - constraints @ x
            held = multipliers > 0.0
            feasible = FEASIBLE * float(np.max(sizes @ np.abs(x) + np.abs(self._bound)))
            stationary = STATIONARY * max(norm * np.max(np.abs(x)), np.max(np.abs(vector)))
            if np.max(np.abs(gradient)) > stationary:
                x = x + self._moved(gradient)
                gap = self._bound - constraints @ x
            elif np.all(np.where(held, np.abs(gap), gap) <= feasible):
                return Solution(x, multipliers)
            chosen = np.flatnonzero(held | (gap > feasible))
            rows, norms = self._rows_of(chosen), self._norms[chosen]
            gram = rows @ rows.T
            gram[np.diag_indices_from(gram)] += PROXIMAL
            present = norms * multipliers[chosen]
            change = nonnegative_change(gram, gap[chosen] / norms, present)
            x = x + solve_triangular(self._root, change @ rows, trans="T")
            multipliers = np.zeros_like(multipliers)
            multipliers[chosen] = np.maximum(present + change, 0.0) / norms
        return None

    def _moved(self, vector: FloatArray) -> FloatArray:
        moved: FloatArray = scipy.linalg.cho_solve((self._root, True), vector, check_finite=False)
        return moved

    def _rows_of(self, chosen: IntArray) -> FloatArray:
        """Return the rows of ``C root^-T`` of the `chosen` constraints, shape (chosen, p)."""
        new = chosen[self._norms[chosen] == 0.0]
        if new.size:
            rows = solve_triangular(self._root, self._constraints[new].toarray().T).T
            self._norms[new] = np.linalg.norm(rows, axis=1)
            self._rows[new] = rows / self._norms[new, None]
        return self._rows[chosen]

    def _osqp_multipliers(self, vector: FloatArray) -> FloatArray:
        """Return the multipliers that OSQP finds, shape (m,)."""
        solver = osqp.OSQP()
        # No polishing step: it writes to standard output.
        solver.setup(
            sp.csc_matrix(np.triu(self._matrix)), -vector, sp.csc_matrix(self._constraints), self._bound,
            np.full(self._bound.size, np.inf), verbose=False, eps_abs=OSQP_TOLERANCE, eps_rel=OSQP_TOLERANCE,
            max_iter=50_000, check_termination=CHECKED_EVERY, adaptive_rho_interval=ADAPTED_EVERY,
        )  # fmt: skip
        result = solver.solve(raise_error=False)
        if "solved" not in result.info.status:
            raise IdentificationError(f"{UNSOLVED} (OSQP: {result.info.status})")
        multipliers: FloatArray = np.maximum(-result.y, 0.0)
        return multipliers


def cholesky(matrix: FloatArray, *, overwrite: bool = False) -> FloatArray:
    """Return the lower Cholesky factor of a positive definite matrix; what stands above its diagonal is undefined."""
    # The transpose of a matrix in C order is in the order of LAPACK.
    factor, failed = scipy.linalg.lapack.dpotrf(matrix.T, lower=1, clean=0, overwrite_a=overwrite)
    if failed:
        raise IdentificationError("the record does not determine the model; cover more of the voltage range")
    return np.asarray(factor)


def solve_triangular(root: FloatArray, right: FloatArray, trans: str = "N") -> FloatArray:
    """Return ``root^-1 right``, or with `trans` "T" ``root^-T right``, for a lower `root`, shape (p, p)."""
    # SciPy 1.11 takes nothing empty.
    if not right.size:
        return np.zeros(right.shape)
    solution: FloatArray = scipy.linalg.solve_triangular(root, right, trans, lower=True, check_finite=False)
    return solution


def nonnegative_change(gram: FloatArray, gap: FloatArray, present: FloatArray) -> FloatArray:
    """Minimise ``c' G c / 2 - gap' c`` over ``present + c >= 0``, shape (n,), for a positive definite G.

    By block pivoting from all c free: all wrong signs are exchanged at once, while that lowers their number; J. Kim and
    H. Park: Fast nonnegative matrix factorization, SIAM J. Sci. Comput. 33 (2011). Where it does not, one by one. The
    change, and not the sum, is sought: it is not rounded by what it changes.
    """
    free = np.ones(gap.size, dtype=bool)
    fewest, left = gap.size + 1, 3
    while left:
        at, change = np.flatnonzero(free), np.where(free, 0.0, -present)
        # SciPy 1.11 takes nothing empty.
        if at.size:
            root = cholesky(gram[np.ix_(at, at)])
            change[at] = scipy.linalg.cho_solve((root, True), (gap - gram @ change)[at], check_finite=False)
        # What is smaller than the rounding of the sum is no sign.
        rounding = 1e-15 * np.max(np.abs(gram) @ np.abs(change) + np.abs(gap), initial=0.0)
        wrong = np.where(free, present + change < 0.0, gram @ change - gap < -rounding)
        count = int(np.count_nonzero(wrong))
        if not count:
            return change
        fewest, left = (count, 3) if count < fewest else (fewest, left - 1)
        free = free ^ wrong
    return one_by_one(gram, gap, present)


def one_by_one(gram: FloatArray, gap: FloatArray, present: FloatArray) -> FloatArray:
    """Return what `nonnegative_change` does, by the method of Lawson and Hanson: slower, and sure to end."""
    from scipy.optimize import nnls

    root = np.tril(cholesky(gram))
    try:
        whole = nnls(root.T, root.T @ present + solve_triangular(root, gap), maxiter=20 * gap.size)[0]
    except RuntimeError:
        raise IdentificationError(UNSOLVED) from None
    return np.asarray(whole - present)
