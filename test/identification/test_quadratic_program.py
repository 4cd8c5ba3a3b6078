"""The quadratic program: conditions of optimality, and other solvers."""

import numpy as np
import osqp
import pytest
import scipy.sparse as sp
from scipy.optimize import minimize, nnls

from slpi_ros.errors import IdentificationError
from slpi_ros.identification import quadratic_program
from slpi_ros.identification.least_squares import solve_free
from slpi_ros.identification.quadratic_program import QuadraticProgram

CONDITIONS = ("well", "badly conditioned", "doubled columns", "without data")
ACTIVE = ("none", "few", "all")


def steps(p):
    return np.eye(p - 1, p, 1) - np.eye(p - 1, p)


def problem(seed):
    """A least-squares problem with a ridge: matrix, vector, constraints and bound."""
    rng = np.random.default_rng(seed)
    condition, active = CONDITIONS[seed % 4], ACTIVE[seed // 4 % 3]
    p = int(rng.integers(3, 50))
    a = rng.normal(size=(int(rng.integers(p, 4 * p)), p))
    if condition == "badly conditioned":
        a *= 10.0 ** rng.uniform(-4, 0, p)
    elif condition == "doubled columns":
        a[:, p - p // 2 :] = a[:, : p // 2]
    elif condition == "without data":
        a[:, rng.random(p) < 0.4] = 0.0
    y = a @ rng.normal(size=p) + 0.1 * rng.normal(size=a.shape[0])
    matrix, vector = a.T @ a, a.T @ y
    matrix[np.diag_indices(p)] += 1e-9 * np.trace(matrix)
    # Signs; rising sequences; the same with steps over two, which depend on them; and no order at all.
    rows = (np.eye(p), steps(p), np.vstack([steps(p), steps(p)[1:] + steps(p)[:-1]]), rng.normal(size=(2 * p, p)))
    constraints, free, inside = rows[seed // 12 % 4], solve_free(matrix, vector), np.cumsum(rng.uniform(0, 1, p))
    if active == "none":
        bound = constraints @ free - rng.uniform(0.1, 1.0, constraints.shape[0])
    else:
        # Satisfied at `inside`; all of them are tight there, or a few of them cut off the free minimum.
        room = rng.uniform(0.0, 5.0, constraints.shape[0]) if active == "few" else 0.0
        bound = constraints @ inside - room
        if active == "all":
            vector = matrix @ inside - constraints.T @ rng.uniform(0.1, 1.0, constraints.shape[0])
    return matrix, vector, sp.csr_array(constraints), bound


def value(problem, x):
    return 0.5 * x @ problem[0] @ x - problem[1] @ x


def by_osqp(matrix, vector, constraints, bound):
    """Solution of OSQP at 1e-9 with the most iterations that it is given; it need not be one."""
    solver = osqp.OSQP()
    upper = np.full(bound.size, np.inf)
    settings = {"eps_abs": 1e-9, "eps_rel": 1e-9, "max_iter": 20_000, "verbose": False, "adaptive_rho_interval": 50}
    solver.setup(sp.csc_matrix(np.triu(matrix)), -vector, sp.csc_matrix(constraints), bound, upper, **settings)
    return solver.solve(raise_error=False)


@pytest.mark.parametrize("seed", range(200))
def test_conditions_of_optimality_and_osqp(seed):
    """Feasible, stationary, complementary, and no objective of OSQP is lower unless it breaks constraints for it."""
    matrix, vector, constraints, bound = drawn = problem(seed)
    x, multipliers = QuadraticProgram(matrix, constraints, bound).solve(vector)
    size = np.max(np.abs(x))
    assert np.max(bound - constraints @ x) <= 1e-12 * size * max(1.0, abs(constraints).sum(axis=1).max())
    assert np.all(multipliers >= 0.0)
    scale = np.abs(matrix).sum(axis=0).max() * size
    assert np.max(np.abs(matrix @ x - vector - constraints.T @ multipliers)) <= 1e-12 * scale
    assert abs(multipliers @ (constraints @ x - bound)) <= 1e-10 * max(abs(value(drawn, x)), scale * size)
    other = by_osqp(*drawn)
    if other.info.status == "solved":
        lowered = multipliers @ np.maximum(bound - constraints @ other.x, 0.0)
        assert value(drawn, x) - value(drawn, other.x) <= 1e-9 * abs(value(drawn, x)) + lowered
    if ACTIVE[seed // 4 % 3] == "none":
        np.testing.assert_array_equal(x, solve_free(matrix, vector))


@pytest.mark.parametrize("seed", range(0, 200, 10))
def test_a_start_elsewhere_and_another_vector_before_change_nothing(seed):
    matrix, vector, constraints, bound = problem(seed)
    program = QuadraticProgram(matrix, constraints, bound)
    x, multipliers = program.solve(vector)
    np.testing.assert_array_equal(QuadraticProgram(matrix, constraints, bound).solve(vector).x, x)
    program.solve(2.0 * vector)
    near = np.random.default_rng(seed).uniform(0.0, 1.0, bound.size) * np.max(multipliers)
    drawn = matrix, vector
    assert value(drawn, program.solve(vector, near).x) == pytest.approx(value(drawn, x), rel=1e-9, abs=1e-12)


def test_what_block_pivoting_does_not_settle_is_left_to_others(monkeypatch):
    """OSQP names the active set, and the answer is as exact."""
    matrix, vector, constraints, bound = problem(4)
    expected = QuadraticProgram(matrix, constraints, bound).solve(vector)
    program = QuadraticProgram(matrix, constraints, bound)
    first, tries = program._from, []

    def fails_once(*arguments):
        tries.append(arguments)
        return None if len(tries) == 1 else first(*arguments)

    monkeypatch.setattr(program, "_from", fails_once)
    np.testing.assert_allclose(program.solve(vector).x, expected.x, rtol=1e-9, atol=1e-12)
    assert len(tries) == 2 and np.any(tries[1][1] > 0.0)


def test_one_by_one_where_blocks_do_not_end():
    """The fallback for signs that keep changing finds the same minimum."""
    rng = np.random.default_rng(3)
    for _ in range(20):
        a, wanted = rng.normal(size=(40, 15)), rng.normal(size=15)
        gram = a.T @ a + 0.1 * np.ones((15, 15))
        change = quadratic_program.nonnegative_change(gram, wanted, np.zeros(15))
        slow = quadratic_program.one_by_one(gram, wanted, np.zeros(15))
        np.testing.assert_allclose(change, slow, atol=1e-12)


@pytest.mark.parametrize("seed", range(5))
def test_non_negative_least_squares(seed):
    rng = np.random.default_rng(seed)
    a, y = rng.normal(size=(60, 12)), rng.normal(size=60)
    x, _ = QuadraticProgram(a.T @ a, sp.csr_array(np.eye(12)), np.zeros(12)).solve(a.T @ y)
    np.testing.assert_allclose(x, nnls(a, y)[0], atol=1e-12)


@pytest.mark.parametrize("seed", range(5))
def test_rising_sequences(seed):
    rng = np.random.default_rng(seed)
    a = rng.normal(size=(40, 8))
    y = a @ np.sort(rng.normal(size=8)) + rng.normal(size=40)
    rise = sp.csr_array(steps(8))
    x, _ = QuadraticProgram(a.T @ a, rise, np.full(7, 0.1)).solve(a.T @ y)
    other = minimize(
        lambda z: 0.5 * np.sum((a @ z - y) ** 2),
        np.arange(8.0),
        jac=lambda z: a.T @ (a @ z - y),
        method="SLSQP",
        constraints={"type": "ineq", "fun": lambda z: rise @ z - 0.1, "jac": lambda z: rise.toarray()},
        options={"ftol": 1e-14, "maxiter": 500},
    )
    np.testing.assert_allclose(x, other.x, atol=1e-4)
    assert np.min(rise @ x) >= 0.1 - 1e-12


def test_contradicting_constraints_are_told():
    rows = sp.csr_array(np.array([[1.0, 0.0], [-1.0, 0.0]]))
    with pytest.raises(IdentificationError, match="did not converge"):
        QuadraticProgram(np.eye(2), rows, np.array([1.0, 1.0])).solve(np.zeros(2))


def test_a_singular_problem_is_told():
    with pytest.raises(IdentificationError, match="does not determine"):
        solve_free(np.zeros((2, 2)), np.zeros(2))
