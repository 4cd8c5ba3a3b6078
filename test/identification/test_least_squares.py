"""The quadratic program against scipy's solvers."""

import numpy as np
import pytest
import scipy.sparse as sp
from scipy.optimize import minimize, nnls

from slpi_ros.errors import IdentificationError
from slpi_ros.identification.least_squares import solve_free, solve_qp


@pytest.mark.parametrize("seed", range(5))
def test_non_negative_least_squares(seed):
    rng = np.random.default_rng(seed)
    a, y = rng.normal(size=(60, 12)), rng.normal(size=60)
    x = solve_qp(a.T @ a, a.T @ y, sp.csr_array(np.eye(12)), np.zeros(12))
    np.testing.assert_allclose(x, nnls(a, y)[0], atol=1e-5)


@pytest.mark.parametrize("seed", range(5))
def test_rising_sequences(seed):
    rng = np.random.default_rng(seed)
    a = rng.normal(size=(40, 8))
    y = a @ np.sort(rng.normal(size=8)) + rng.normal(size=40)
    rise = sp.csr_array(np.eye(7, 8, 1) - np.eye(7, 8))
    x = solve_qp(a.T @ a, a.T @ y, rise, np.full(7, 0.1))
    other = minimize(
        lambda z: 0.5 * np.sum((a @ z - y) ** 2),
        np.arange(8.0),
        jac=lambda z: a.T @ (a @ z - y),
        method="SLSQP",
        constraints={"type": "ineq", "fun": lambda z: rise @ z - 0.1, "jac": lambda z: rise.toarray()},
        options={"ftol": 1e-14, "maxiter": 500},
    )
    np.testing.assert_allclose(x, other.x, atol=1e-4)
    assert np.min(rise @ x) > 0.1 - 1e-6


def test_a_free_solution_that_obeys_is_returned_as_it_is():
    matrix, vector = np.diag([2.0, 4.0]), np.array([2.0, 4.0])
    x = solve_qp(matrix, vector, sp.csr_array(np.eye(2)), np.zeros(2))
    np.testing.assert_array_equal(x, solve_free(matrix, vector))


def test_contradicting_constraints_are_told():
    rows = sp.csr_array(np.array([[1.0, 0.0], [-1.0, 0.0]]))
    with pytest.raises(IdentificationError, match="did not converge"):
        solve_qp(np.eye(2), np.zeros(2), rows, np.array([1.0, 1.0]))


def test_a_singular_problem_is_told():
    with pytest.raises(IdentificationError, match="does not determine"):
        solve_free(np.zeros((2, 2)), np.zeros(2))
