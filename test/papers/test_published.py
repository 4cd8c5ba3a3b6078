"""The paper's own tables as models, against play operators one by one."""

import numpy as np
import pytest
from numpy.typing import NDArray

from slpi_ros.hysteresis.kinds import from_document, to_document
from slpi_ros.hysteresis.prandtl_ishlinskii import PrandtlIshlinskii
from slpi_ros.hysteresis.slpi_published import SeparatedLoops, SingleLoop, separate
from slpi_ros.hysteresis.turning_points import Memory
from slpi_ros.papers.slpi_study import TABLES, THRESHOLDS, ramps

FloatArray = NDArray[np.float64]

PATH = ramps((0.0, 80.0, 12.0, 68.0, 20.0, 80.0, 100.0, 0.0), 1.0)


def play(x: FloatArray, r: float, p: float = 0.0) -> FloatArray:
    """Eq. 1, sample by sample."""
    out = np.empty_like(x)
    for n, value in enumerate(x):
        p = max(value - r, min(value + r, p))
        out[n] = p
    return out


def forward(x: FloatArray, weights: FloatArray) -> FloatArray:
    """Eq. 8 with the tables' convention: the first weight is that of threshold 0."""
    return sum(w * play(x, r) for w, r in zip(weights, THRESHOLDS, strict=True))


def inverse(y: FloatArray, weights: FloatArray) -> FloatArray:
    """Eq. 10 to 12, corrected."""
    total = np.cumsum(weights)
    v = y / weights[0]
    for i in range(1, len(weights)):
        r = sum(weights[j] * (THRESHOLDS[i] - THRESHOLDS[j]) for j in range(i + 1))
        v = v - weights[i] / (total[i - 1] * total[i]) * play(y, r)
    return v


def table_model(number: int) -> PrandtlIshlinskii:
    """Return the PI model of Table 2 (level II), 3 (level I), 4 (level 0) or 5 (classical PI), volts to metres."""
    return PrandtlIshlinskii(np.array(THRESHOLDS), 1e-6 * np.array(TABLES[number]))


def table_loops(vertices: tuple[float, float], spans: tuple[float, float, float], *, at_rest: bool) -> SeparatedLoops:
    """Return the three loops of Tables 4, 3 and 2, each on the loop before it."""
    outer = _loop(4, 0, 1, (0.0, 0.0), spans[0], None)
    run_in = None if at_rest else 0.0
    first_vertex = vertices[0], outer.memory().forward(vertices[0])
    first = _loop(3, 1, -1, first_vertex, spans[1], run_in)
    way_back = first.memory()
    # Down to the turn, and up again to the next vertex.
    way_back.forward(spans[1])
    second_vertex = vertices[1], first_vertex[1] - way_back.forward(vertices[0] - vertices[1])
    return SeparatedLoops((outer, first, _loop(2, 2, -1, second_vertex, spans[2], run_in)))


def _loop(
    table: int, level: int, direction: int, vertex: tuple[float, float], span: float, run_in: float | None
) -> SingleLoop:
    model = table_model(table)
    height = SingleLoop(level, direction, vertex, (span, 1.0), (0.0, 0.0), model, run_in).memory().forward(span)
    return SingleLoop(level, direction, vertex, (span, height), (0.0, 0.0), model, run_in)


@pytest.mark.parametrize("number", TABLES)
def test_forward_and_inverse_of_a_table(number: int) -> None:
    weights = 1e-6 * np.array(TABLES[number])
    model = from_document("pi", to_document(table_model(number)))
    expected = forward(PATH, weights)
    y = Memory(model).forward_array(PATH)
    np.testing.assert_allclose(y, expected, rtol=0, atol=1e-14 * np.ptp(expected) * PATH.size)
    for v in (Memory(model).inverse_array(y), Memory(model.inverse()).forward_array(y), inverse(y, weights)):
        np.testing.assert_allclose(v, PATH, rtol=0, atol=1e-10)


@pytest.mark.parametrize("number", TABLES)
def test_thresholds_and_weights_are_ten_each(number: int) -> None:
    assert len(TABLES[number]) == len(THRESHOLDS) == 10
    assert min(TABLES[number]) >= 0


@pytest.mark.parametrize("at_rest", [True, False])
def test_tables_2_to_4_as_loops_of_one_path(at_rest: bool) -> None:
    loops = from_document(
        "slpi-published", to_document(table_loops((80.0, 68.0), (100.0, 68.0, 48.0), at_rest=at_rest))
    )
    y = loops.along(0.0, 0.0).forward_array(PATH)
    by_level = {0: 4, 1: 3, 2: 2}
    for loop in separate(PATH).loops:
        weights = 1e-6 * np.array(TABLES[by_level[loop.level]])
        drive = loop.direction * (PATH[loop.samples] - PATH[loop.vertex])
        # Primed: as if pushed to the other end of the play before.
        from_rest = at_rest or not loop.level
        expected = sum(
            w * (play(drive, r, 0.0 if from_rest else r) - (0.0 if from_rest else r))
            for w, r in zip(weights, THRESHOLDS, strict=True)
        )
        got = loop.direction * (y[loop.samples] - y[loop.vertex])
        np.testing.assert_allclose(got, expected, rtol=0, atol=1e-18 + 1e-12 * np.ptp(y))


def test_rebuilt_inverse_of_the_tables() -> None:
    loops = table_loops((80.0, 68.0), (100.0, 68.0, 48.0), at_rest=False)
    y = loops.along(0.0, 0.0).forward_array(PATH)
    np.testing.assert_allclose(loops.along(0.0, 0.0).inverse_array(y), PATH, rtol=0, atol=1e-9)
