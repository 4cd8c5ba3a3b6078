"""The linear prediction of identification is the engine's own, for every basis and start."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from slpi_ros.hysteresis.turning_points import Memory
from slpi_ros.identification import bases, design_matrix
from slpi_ros.identification.bases import PlayBasis, SurfaceBasis
from slpi_ros.identification.design_matrix import Design, Walk


def surface_parameters(basis, rng):
    n = basis.grid.size
    density = rng.uniform(0.1, 1.0, (n, n))
    surface = np.zeros((n, n))
    for i in range(1, n):
        for j in range(i - 1, -1, -1):
            surface[i, j] = surface[i - 1, j] + surface[i, j + 1] - surface[i - 1, j + 1] * (i - 1 > j) + density[i, j]
    rise = np.cumsum(rng.uniform(0.5, 1.5, n))
    return np.concatenate([surface[np.tril_indices(n, -1)], rise, [rng.normal()]])


def play_parameters(basis, rng):
    return np.concatenate([rng.uniform(0.1, 1.0, basis.size), [rng.normal()]])


BASES = {
    "slpi": (SurfaceBasis(np.linspace(-3.0, 9.0, 8)), surface_parameters),
    "pi": (PlayBasis(np.array([0.0, 0.7, 1.1, 4.0])), play_parameters),
}


@pytest.mark.parametrize("kind", BASES)
@pytest.mark.parametrize("primed", [False, True])
@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 10_000), corners=st.integers(2, 30), between=st.integers(1, 40))
def test_prediction_is_what_the_engine_simulates(kind, primed, seed, corners, between):
    rng = np.random.default_rng(seed)
    basis, draw = BASES[kind]
    x = draw(basis, rng)
    v = np.interp(np.linspace(0, corners - 1, corners * between), np.arange(corners), rng.uniform(-3, 9, corners))
    walk = Walk.along(v, symmetric_rest=basis.symmetric_rest, primed=primed)
    predicted = Design.of(walk, basis.branch_part(walk)).predict(x)
    increments = basis.increments(walk, x[:-1])
    np.testing.assert_allclose(increments, basis.branch_part(walk) @ x[:-1], atol=1e-9)
    np.testing.assert_allclose(walk.accumulated(increments + x[-1] * (walk.origin < 0)), predicted, atol=1e-9)
    memory = Memory(basis.shape(x, 1.0), float(v[0]), float(x[-1]), primed=primed)
    np.testing.assert_allclose(predicted, memory.forward_array(v), atol=1e-8)


@pytest.mark.parametrize("compiled", [False, True])
@pytest.mark.parametrize("kind", BASES)
@pytest.mark.parametrize("corners", [2, 20, 150])
def test_normal_equations_are_those_of_the_full_matrix(monkeypatch, compiled, kind, corners):
    """Of two records, one of which begins after a fall from far above; a quarter of the samples do not count."""
    monkeypatch.setattr(bases, "worth_compiling", lambda _: compiled)
    monkeypatch.setattr(design_matrix, "always_compiled", lambda _: compiled)
    rng = np.random.default_rng(3)
    basis, _ = BASES[kind]
    drives = [np.interp(np.linspace(0, corners, 300), np.arange(corners + 1), rng.uniform(-3, 9, corners + 1))] * 2
    walk = Walk.joined(
        [
            Walk.along(v, symmetric_rest=basis.symmetric_rest, primed=primed)
            for v, primed in zip(drives, (False, True), strict=True)
        ]
    )
    design = Design.of(walk, basis.branch_part(walk))
    full = np.column_stack([design.predict(unit) for unit in np.eye(basis.size + 2)])
    np.testing.assert_array_equal(full[:, -2:], np.eye(2)[walk.record])
    y, weights = rng.normal(size=600), rng.uniform(0, 1, 600) * (rng.random(600) < 0.75)
    matrix, vector = design.normal_equations(y, weights)
    np.testing.assert_allclose(matrix, full.T * weights @ full, atol=1e-9)
    np.testing.assert_allclose(vector, full.T @ (weights * y), atol=1e-9)


@pytest.mark.parametrize("primed", [False, True])
def test_compiled_rows_are_the_same_to_the_last_bit(monkeypatch, primed):
    rng = np.random.default_rng(5)
    basis, _ = BASES["slpi"]
    # Vertices and reversals within a cell, too.
    v = np.concatenate([rng.uniform(-3, 9, 300), np.linspace(-3.0, 9.0, 8), rng.uniform(0, 1, 50), [9.0, -3.0]])
    walk = Walk.along(v, symmetric_rest=False, primed=primed)
    parts = []
    for compiled in (False, True):
        monkeypatch.setattr(bases, "worth_compiling", lambda _, compiled=compiled: compiled)
        parts.append(basis.branch_part(walk))
    assert parts[0].nnz == parts[1].nnz
    np.testing.assert_array_equal(parts[0].toarray(), parts[1].toarray())


def test_roughness_vanishes_for_a_classical_pi_surface_with_smooth_branches():
    grid = np.linspace(0.0, 10.0, 9)
    basis = SurfaceBasis(grid)
    alpha, beta = np.meshgrid(grid, grid, indexing="ij")
    surface = 0.3 * (alpha - beta) + 0.02 * (alpha - beta) ** 2
    rise = surface[:, 0]
    x = np.concatenate([surface[np.tril_indices(9, -1)], rise, [5.0]])
    rough = basis.roughness @ x
    bend = 2 * 0.02 * (grid[1] - grid[0]) ** 2 * 9 / 41
    assert np.all((np.abs(rough) < 1e-12) | (np.abs(rough - bend) < 1e-12)), "only the first rise may bend"


def test_monotone_rows_hold_for_a_rising_surface_and_not_for_a_falling_one():
    basis, draw = BASES["slpi"]
    x = draw(basis, np.random.default_rng(0))
    rows, bound = basis.monotone(0.0)
    assert np.all(rows @ x >= bound - 1e-12)
    x[5] = -1.0
    assert not np.all(rows @ x >= bound - 1e-12)
