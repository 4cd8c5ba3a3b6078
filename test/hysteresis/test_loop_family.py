"""The loop family against Mayergoyz' formula: a sum over the extrema that are still remembered."""

import numpy as np
import pytest
from hypothesis import given
from numpy.typing import NDArray
from strategies import Case, cases_and_paths, loop_families, stream_forward, stream_inverse

from slpi_ros.errors import ModelError
from slpi_ros.hysteresis.loop_family import LoopFamily
from slpi_ros.hysteresis.turning_points import Memory

FloatArray = NDArray[np.float64]

GRID = np.array([0.0, 10.0, 30.0])
SURFACE = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [4.0, 2.5, 0.0]])
RISE = np.array([5.0, 6.5, 9.0])


def everett(family: LoopFamily, alpha: float, beta: float) -> float:
    """Displacement between the turning points `alpha` >= `beta`: bilinear on the grid, beyond it as at its end."""
    g = family.grid
    if alpha > g[-1]:
        alpha, beta = g[-1], beta - (alpha - g[-1])
    if beta < g[0]:
        alpha, beta = alpha + (g[0] - beta), g[0]
    if alpha > g[-1]:
        return family.everett[-1, 0] + family.edge_gain * (alpha - g[-1])
    i, j = (min(int(np.searchsorted(g, v, side="right")) - 1, g.size - 2) for v in (alpha, beta))
    a, b = (alpha - g[i]) / (g[i + 1] - g[i]), (beta - g[j]) / (g[j + 1] - g[j])
    corner = family.everett
    if i == j:
        return (a - b) * corner[i + 1, i]
    lower, upper = (corner[k, j] * (1 - b) + corner[k, j + 1] * b for k in (i, i + 1))
    return lower * (1 - a) + upper * a


def long_fall(family: LoopFamily, v: float) -> float:
    """Displacement on the fall that wipes the memory: from the highest vertex, straight outside the grid."""
    inside = np.clip(v, family.grid[0], family.grid[-1])
    return family.edge_gain * (v - inside) - everett(family, family.grid[-1], inside)


def first_rise(family: LoopFamily, v: float) -> float:
    inside = np.clip(v, family.grid[0], family.grid[-1])
    return np.interp(inside, family.grid, family.rise) + family.edge_gain * (v - inside)


def remembered_extrema(history: FloatArray) -> list[float]:
    """Highest voltage, lowest one after it, highest one after that, and so on to the present one."""
    extrema, start, highest = [], 0, True
    while start < history.size:
        ahead = history[start:]
        extreme = ahead.max() if highest else ahead.min()
        extrema.append(float(extreme))
        start += int(np.flatnonzero(ahead == extreme)[-1]) + 1
        highest = not highest
    return extrema


def displacement(case: Case, history: FloatArray) -> float:
    """Mayergoyz' sum for a history that begins at rest."""
    family, (v_rest, y_rest) = case.shape, case.rest
    if case.primed:
        top = max(history.max(), family.grid[-1], v_rest) + 1.0
        extrema = remembered_extrema(np.concatenate([[top], history]))[1:]
        y = y_rest + long_fall(family, extrema[0]) - long_fall(family, v_rest)
    else:
        extrema = remembered_extrema(history)
        y = y_rest + first_rise(family, extrema[0]) - first_rise(family, v_rest)
    for k in range(1, len(extrema)):
        older, newer = extrema[k - 1], extrema[k]
        y += everett(family, newer, older) if newer > older else -everett(family, older, newer)
    return float(y)


@given(cases_and_paths(("slpi",)))
def test_the_family_is_a_sum_over_remembered_extrema(drawn):
    case, v = drawn
    checked = np.unique(np.linspace(0, v.size - 1, 40).astype(int))
    expected = [displacement(case, np.concatenate([[case.rest[0]], v[: i + 1]])) for i in checked]
    np.testing.assert_allclose(stream_forward(case.memory(), v)[checked], expected, rtol=0, atol=1e-9 * case.height)
    np.testing.assert_allclose(case.memory().forward_array(v)[checked], expected, rtol=0, atol=1e-9 * case.height)


@given(cases_and_paths(("slpi",)))
def test_what_lies_above_the_diagonal_and_the_offset_of_the_rise_do_not_matter(drawn):
    case, v = drawn
    family = case.shape
    above = np.triu(np.full_like(family.everett, 7.0), 1)
    same = LoopFamily(family.grid, family.everett + above, family.rise + 3.0 * case.height, family.edge_gain)
    assert (np.triu(same.everett, 1) == 0).all()
    y = stream_forward(Memory(same, *case.rest, primed=case.primed), v)
    np.testing.assert_allclose(y, stream_forward(case.memory(), v), rtol=0, atol=1e-9 * case.height)


@given(loop_families())
def test_at_its_vertices_a_family_gives_its_parameters_back(family):
    """First rise to the highest vertex, then every branch that leaves it and every one that leaves the lowest."""
    grid, everett = family.grid, family.everett
    height = everett[-1, 0]
    memory = Memory(family, grid[0], 0.0)
    risen = stream_forward(memory, grid)
    np.testing.assert_allclose(
        risen, family.rise - family.rise[0], rtol=0, atol=1e-12 * height + 1e-15 * abs(family.rise[0])
    )
    fallen = risen[-1] - stream_forward(memory, grid[::-1])
    np.testing.assert_allclose(fallen, everett[-1, ::-1], rtol=0, atol=1e-11 * height)
    bottom = memory.displacement
    np.testing.assert_allclose(stream_forward(memory, grid) - bottom, everett[:, 0], rtol=0, atol=1e-11 * height)


def test_a_family_in_numbers():
    family = LoopFamily(GRID, SURFACE, RISE, 0.1)
    memory = Memory(family, 0.0, 100.0)
    v = [5.0, 20.0, 10.0, 5.0, 20.0, 30.0, 40.0, -10.0, 0.0, 40.0, 30.0, 20.0, 40.0]
    # At 20 V the row is halfway between those of 10 V and 30 V: 1.25 to 10 V, 2.5 to 0 V, hence 1.875 to 5 V.
    # From -10 V it goes as from 0 V, 1 to 0 V and 2.5 to 10 V; from 40 V as from 30 V, 1.25 to 30 V and 2.5 to 20 V.
    expected = [100.75, 102.75, 101.5, 100.875, 102.75, 104.0, 105.0, 99.0, 100.0, 105.0, 103.75, 102.5, 105.0]
    assert stream_forward(memory, np.array(v)) == pytest.approx(expected, abs=1e-12)
    again = Memory(family, 0.0, 100.0)
    assert stream_inverse(again, np.array(expected)) == pytest.approx(v, abs=1e-9)


def broken(name, value):
    good = {"grid": GRID, "everett": SURFACE, "rise": RISE, "edge_gain": 0.1}
    return {**good, name: value}


@pytest.mark.parametrize(
    "parameters",
    [
        broken("grid", GRID[:1]),
        broken("grid", GRID[:2]),
        broken("grid", GRID[::-1]),
        broken("grid", np.array([0.0, 10.0, 10.0])),
        broken("grid", np.array([0.0, 10.0, np.nan])),
        broken("grid", np.array([0.0, 10.0, np.inf])),
        broken("grid", GRID[None]),
        broken("everett", SURFACE[:2]),
        broken("everett", SURFACE.T),
        broken("everett", SURFACE * 0),
        broken("everett", SURFACE * np.nan),
        broken("everett", np.array([[0.0, 0, 0], [1, 0, 0], [2.5, 2.5, 0]])),
        broken("everett", np.array([[0.0, 0, 0], [4, 0, 0], [4, 2.5, 0]])),
        broken("rise", RISE[:2]),
        broken("rise", RISE[::-1]),
        broken("rise", np.array([5.0, 6.5, np.inf])),
        broken("edge_gain", 0.0),
        broken("edge_gain", -1.0),
        broken("edge_gain", np.nan),
        broken("edge_gain", np.inf),
    ],
)
def test_parameters_that_make_no_family(parameters):
    with pytest.raises(ModelError):
        LoopFamily(**parameters)


@pytest.mark.parametrize("value", [0.5, -0.5, np.nan])
def test_the_diagonal_must_be_zero(value):
    """Else a branch would start with a jump."""
    with pytest.raises(ModelError):
        LoopFamily(GRID, SURFACE + value * np.eye(3), RISE, 0.1)
