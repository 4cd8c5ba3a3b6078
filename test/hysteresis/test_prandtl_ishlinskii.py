"""The play operator and the PI model against the papers' recursion, the papers' numbers and python-control."""

import control
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from strategies import cases_and_paths, prandtl_ishlinskii, stream_forward, stream_inverse

from slpi_ros.errors import ModelError
from slpi_ros.hysteresis.prandtl_ishlinskii import PrandtlIshlinskii, play
from slpi_ros.hysteresis.turning_points import Memory

FloatArray = NDArray[np.float64]

# SLPI paper, Tables 2-5; volts, micrometres per volt.
PAPER_THRESHOLDS = np.arange(0.0, 50.0, 5.0)
PAPER_WEIGHTS = {
    "table 2": [0.02943, 0.01351, 0.00040, 0.00206, 0.00230, 0.00265, 0.00249, 0.00550, 0.02802, 0.09411],
    "table 3": [0.03151, 0.01298, 0.01092, 0.00445, 0.00648, 0.00000, 0.00148, 0.00016, 0.00051, 0.00100],
    "table 4": [0.04045, 0.00000, 0.00893, 0.00537, 0.00456, 0.01136, 0.00000, 0.00000, 0.00000, 0.00000],
    "table 5": [0.03040, 0.01116, 0.01516, 0.00478, 0.00000, 0.00000, 0.00823, 0.00057, 0.00000, 0.00000],
}
# A drive like the paper's Fig. 4: up, inner loops on the way, and back to 0; then one below 0.
DRIVE = np.concatenate([
    np.linspace(a, b, 1 + round(abs(b - a) / 0.5))[1:]
    for a, b in [(0, 100), (100, 36), (36, 80), (80, 52), (52, 100), (100, 0), (0, 64), (64, -30), (-30, 100), (100, 0)]
])  # fmt: skip


def plays(x: FloatArray, thresholds: FloatArray, *, primed: bool) -> FloatArray:
    """Eq. 1 from x = 0, operator by operator, shape (N, n)."""
    r = np.asarray(thresholds)
    p = r.copy() if primed else np.zeros_like(r)
    answers = np.empty((x.size, r.size))
    for i, now in enumerate(x):
        answers[i] = p = np.maximum(now - r, np.minimum(now + r, p))
    return answers - (r if primed else 0.0)


def recursion(shape: PrandtlIshlinskii, x: FloatArray, *, primed: bool) -> FloatArray:
    return plays(x, shape.thresholds, primed=primed) @ shape.weights


def analytic_inverse(thresholds: FloatArray, weights: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Eq. 12 with the linear weight as the table's first, term by term."""
    n = len(weights)
    inverse_thresholds = [sum(weights[j] * (thresholds[i] - thresholds[j]) for j in range(i + 1)) for i in range(n)]
    inverse_weights = [1 / weights[0]]
    for i in range(1, n):
        inverse_weights.append(-weights[i] / (sum(weights[:i]) * sum(weights[: i + 1])))
    return np.array(inverse_thresholds), np.array(inverse_weights)


@given(cases_and_paths(("pi",)))
def test_the_model_is_a_sum_of_play_operators(drawn):
    case, v = drawn
    expected = case.rest[1] + recursion(case.shape, v - case.rest[0], primed=case.primed)
    np.testing.assert_allclose(stream_forward(case.memory(), v), expected, rtol=0, atol=1e-11 * case.height)
    np.testing.assert_allclose(case.memory().forward_array(v), expected, rtol=0, atol=1e-11 * case.height)


@given(cases_and_paths(("pi",)))
def test_the_inverse_is_a_sum_of_play_operators(drawn):
    case, path = drawn
    y = case.displacements(path)
    r, w = analytic_inverse(case.shape.thresholds, case.shape.weights)
    expected = case.rest[0] + plays(y - case.rest[1], r, primed=case.primed) @ w
    np.testing.assert_allclose(stream_inverse(case.memory(), y), expected, rtol=0, atol=1e-9 * case.width)
    np.testing.assert_allclose(case.memory().inverse_array(y), expected, rtol=0, atol=1e-9 * case.width)


@given(cases_and_paths(("pi",)))
def test_the_analytic_inverse_as_a_model_equals_the_inverse_of_the_memory(drawn):
    case, path = drawn
    # A long fall in metres is too long beside micrometres to be exact.
    primed = case.primed and case.slopes[1] > 1e-3
    y = case.displacements(path)
    v = stream_inverse(Memory(case.shape, *case.rest, primed=primed), y)
    one, other = (Memory(case.shape.inverse(), *case.rest[::-1], primed=primed) for _ in range(2))
    np.testing.assert_allclose(stream_forward(one, y), v, rtol=0, atol=1e-9 * case.width)
    np.testing.assert_allclose(stream_inverse(other, v), y, rtol=0, atol=1e-9 * case.height)


@given(prandtl_ishlinskii())
def test_the_inverse_of_the_inverse_is_the_model(model):
    twice = model.inverse().inverse()
    kept = np.append(True, model.weights[1:] != 0)
    np.testing.assert_allclose(twice.thresholds, model.thresholds[kept], rtol=1e-9)
    np.testing.assert_allclose(twice.weights, model.weights[kept], rtol=1e-9, atol=1e-9 * model.weights[0])


@pytest.mark.parametrize("primed", [False, True], ids=["virgin", "primed"])
@pytest.mark.parametrize("table", PAPER_WEIGHTS)
def test_the_papers_models(table, primed):
    weights = np.array(PAPER_WEIGHTS[table])
    model = PrandtlIshlinskii(PAPER_THRESHOLDS, weights)
    operators = plays(DRIVE, PAPER_THRESHOLDS, primed=primed)
    for threshold, expected in zip(PAPER_THRESHOLDS, operators.T, strict=True):
        alone = Memory(play(threshold), primed=primed)
        np.testing.assert_allclose(alone.forward_array(DRIVE), expected, rtol=0, atol=1e-9)
    y = Memory(model, primed=primed).forward_array(DRIVE)
    np.testing.assert_allclose(y, operators @ weights, rtol=0, atol=1e-11)
    np.testing.assert_allclose(Memory(model, primed=primed).inverse_array(y), DRIVE, rtol=0, atol=1e-9)

    r, w = analytic_inverse(PAPER_THRESHOLDS, weights)
    np.testing.assert_allclose(plays(y, r, primed=primed) @ w, DRIVE, rtol=0, atol=1e-9)
    inverse = model.inverse()
    np.testing.assert_allclose(inverse.thresholds, r[(weights != 0)], rtol=1e-12, atol=1e-15)
    np.testing.assert_allclose(inverse.weights, w[weights != 0], rtol=1e-12)
    np.testing.assert_allclose(Memory(inverse, primed=primed).forward_array(y), DRIVE, rtol=0, atol=1e-9)


@pytest.mark.parametrize("amplitude", [1.2, 2.0, 3.7, 50.0])
def test_describing_function_of_the_play_operator(amplitude):
    """First harmonic of the steady answer to a sine: python-control knows it in closed form."""
    n = 40_000
    sine = amplitude * np.sin(2 * np.pi * np.arange(n) / n)
    memory = Memory(play(1.0))
    memory.forward_array(sine)
    y = memory.forward_array(sine)
    harmonic = 2j / n * np.sum(y * np.exp(-2j * np.pi * np.arange(n) / n))
    expected = control.friction_backlash_nonlinearity(2.0).describing_function(amplitude)
    assert harmonic / amplitude == pytest.approx(expected, abs=1e-6)


@given(cases_and_paths(("pi",)), st.floats(0.0, 40.0))
def test_the_play_operator_moves_like_python_controls_backlash(drawn, threshold):
    case, path = drawn
    v = path - case.rest[0]
    backlash = control.friction_backlash_nonlinearity(2 * threshold)
    expected = [backlash(x) for x in v.tolist()]
    np.testing.assert_allclose(stream_forward(Memory(play(threshold)), v), expected, rtol=0, atol=1e-9)


def test_before_anything_moved_the_play_operator_gives_nothing():
    memory = Memory(play(3.0), 10.0, 7.0)
    assert stream_forward(memory, np.array([11.0, 13.0, 7.0, 13.5, 12.0])).tolist() == [7.0, 7.0, 7.0, 7.5, 7.5]


def test_a_primed_play_operator_stays_for_twice_its_threshold():
    memory = Memory(play(3.0), 10.0, 7.0, primed=True)
    assert stream_forward(memory, np.array([15.0, 16.0, 17.0])) == pytest.approx([7.0, 7.0, 8.0], abs=1e-9)
    falling = Memory(play(3.0), 10.0, 7.0, primed=True)
    assert falling.forward(9.0) == pytest.approx(6.0, abs=1e-9)


@pytest.mark.parametrize(
    ("thresholds", "weights"),
    [
        ([], []),
        ([0.0], [1.0, 2.0]),
        ([[0.0]], [[1.0]]),
        ([-1.0], [1.0]),
        ([0.0, 0.0], [1.0, 1.0]),
        ([0.0, 2.0, 1.0], [1.0, 1.0, 1.0]),
        ([0.0, np.nan], [1.0, 1.0]),
        ([0.0, np.inf], [1.0, 1.0]),
        ([0.0, 1.0], [1.0, np.nan]),
        ([0.0, 1.0], [np.inf, 1.0]),
        ([0.0, 1.0], [1.0, -1.5]),
        ([0.0], [-1.0]),
    ],
)
def test_parameters_that_make_no_model(thresholds, weights):
    with pytest.raises(ModelError):
        PrandtlIshlinskii(np.array(thresholds), np.array(weights))


@pytest.mark.parametrize(
    ("thresholds", "weights"), [([1.0], [1.0]), ([0.0, 1.0], [0.0, 1.0]), ([0.0, 1.0, 2.0], [1.0, -1.0, 1.0])]
)
def test_models_without_an_inverse(thresholds, weights):
    model = PrandtlIshlinskii(np.array(thresholds), np.array(weights))
    assert not model.invertible
    with pytest.raises(ModelError):
        model.inverse()
