"""The published SLPI model: each loop against play operators one by one, closure, linking, what stands in."""

import re
import warnings
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from numpy.typing import NDArray

from slpi_ros.errors import ModelError, UsageError
from slpi_ros.hysteresis.prandtl_ishlinskii import PrandtlIshlinskii
from slpi_ros.hysteresis.slpi_published import SeparatedLoops, SingleLoop, UnidentifiedLoopWarning, separate

FloatArray = NDArray[np.float64]

pytestmark = pytest.mark.filterwarnings("ignore::slpi_ros.hysteresis.slpi_published.UnidentifiedLoopWarning")

THRESHOLDS = np.arange(0.0, 50.0, 5.0)
PATH = np.concatenate(
    [np.arange(a, b, np.sign(b - a)) for a, b in ((0, 80), (80, 12), (12, 68), (68, 20), (20, 100), (100, -1))]
)

PATH_LOOPS = separate(PATH).loops

weights = st.lists(st.floats(0.0, 1e-7), min_size=9, max_size=9).map(lambda w: np.array([1e-7, *w]))


def per_operator(v: FloatArray, model: PrandtlIshlinskii, primed: bool) -> FloatArray:
    """Sum of play operators, one by one and sample by sample (Eq. 1 and 8), from 0 at 0 V."""
    total = np.zeros(v.size)
    for r, w in zip(model.thresholds, model.weights, strict=True):
        p = r if primed else 0.0
        start = p
        for k, x in enumerate(v):
            p = max(x - r, min(x + r, p))
            total[k] += w * (p - start)
    return total


def single(level: int, direction: int, vertex: float, span: float, w: FloatArray, run_in: float | None) -> SingleLoop:
    model = PrandtlIshlinskii(THRESHOLDS, w)
    return SingleLoop(level, direction, (vertex, vertex * 2e-7), (span, span * 2e-7), (0.0, 0.0), model, run_in)


def nested(w: list[FloatArray], run_in: float | None) -> SeparatedLoops:
    """The loops of `PATH`."""
    return SeparatedLoops((
        single(0, 1, 0.0, 100.0, w[0], run_in),
        single(1, -1, 80.0, 68.0, w[1], run_in),
        single(2, -1, 68.0, 48.0, w[2], run_in),
    ))  # fmt: skip


@given(st.lists(weights, min_size=3, max_size=3), st.sampled_from([None, 0.0]))
def test_each_loop_is_a_sum_of_play_operators(w: list[FloatArray], run_in: float | None) -> None:
    y = nested(w, run_in).along(0.0, 0.0).forward_array(PATH)
    for loop, own in zip(PATH_LOOPS, w, strict=True):
        drive = loop.direction * (PATH[loop.path] - PATH[loop.vertex])
        expected = per_operator(drive, PrandtlIshlinskii(THRESHOLDS, own), run_in is not None)
        # The closing sample is the lower loop's; all others are this one's.
        last = -1 if loop.closed else None
        got = loop.direction * (y[loop.path] - y[loop.vertex])
        np.testing.assert_allclose(got[:last], expected[:last], rtol=0, atol=1e-15)


@given(st.lists(weights, min_size=3, max_size=3))
def test_primed_loops_close(w: list[FloatArray]) -> None:
    loops = nested(w, 0.0)
    y = loops.along(0.0, 0.0).forward_array(PATH)
    for loop in PATH_LOOPS[1:]:
        memory = loops.nearest(loop.level, loop.direction, float(PATH[loop.vertex]), 50.0, 0).memory()
        drive = loop.direction * (PATH[loop.path] - PATH[loop.vertex])
        assert abs(memory.forward_array(drive)[-1]) <= 1e-9 * np.ptp(y)
    assert abs(y[-1] - y[0]) <= 1e-9 * np.ptp(y)


def test_at_rest_misses_the_vertex_by_the_sum_of_weights_and_thresholds() -> None:
    w = np.linspace(1e-7, 1e-8, 10)
    loop = single(1, -1, 80.0, 95.0, w, None)
    end = loop.memory().forward_array(np.array([0.0, 95.0, 0.0]))[-1]
    np.testing.assert_allclose(end, w @ THRESHOLDS, rtol=1e-12)


@given(weights, st.floats(0.0, 60.0))
def test_run_in_is_a_rise_after_a_long_fall(w: FloatArray, run_in: float) -> None:
    loop = single(0, 1, 0.0, 100.0, w, run_in)
    drive = np.concatenate([[-run_in], np.linspace(0.0, 100.0, 21), np.linspace(95.0, 0.0, 20)])
    expected = per_operator(drive + run_in, loop.model, primed=True)
    np.testing.assert_allclose(loop.memory().forward_array(drive[1:]), expected[1:] - expected[1], rtol=0, atol=1e-15)


@given(st.lists(weights, min_size=3, max_size=3))
def test_inverse_brings_the_path_back(w: list[FloatArray]) -> None:
    # Loops that close; their turns as they are in displacement.
    loops = nested(w, 0.0)
    y = loops.along(0.0, 0.0).forward_array(PATH)
    # An inner loop that is higher than the one around it is none in displacement.
    assume([loop.samples.tolist() for loop in separate(y).loops] == [loop.samples.tolist() for loop in PATH_LOOPS])
    placed = []
    for loop, found in zip(loops.loops, PATH_LOOPS, strict=True):
        span = float(np.max(np.abs(y[found.samples] - y[found.vertex])))
        placed.append(replace(loop, vertex=(loop.vertex[0], float(y[found.vertex])), span=(loop.span[0], span)))
    v = SeparatedLoops(tuple(placed)).along(0.0, 0.0).inverse_array(y)
    np.testing.assert_allclose(v, PATH, rtol=0, atol=1e-9 * 100)


@given(weights)
def test_inverse_at_rest_is_the_analytic_one(w: FloatArray) -> None:
    loop = single(0, 1, 0.0, 100.0, w, None)
    y = np.concatenate([np.linspace(0.0, 1e-5, 50), np.linspace(1e-5, 0.0, 50)])
    inverse = loop.model.inverse()
    expected = np.zeros(y.size)
    for r, weight in zip(inverse.thresholds, inverse.weights, strict=True):
        x = 0.0
        for k, p in enumerate(y):
            # Eq. 11, with the operator's own previous output.
            x = max(p - r, min(p + r, x))
            expected[k] += weight * x
    got = SeparatedLoops((loop,)).along(0.0, 0.0).inverse_array(y)
    np.testing.assert_allclose(got, expected, rtol=0, atol=1e-9 * np.max(np.abs(expected)))


def test_a_loop_keeps_its_place() -> None:
    w = [np.full(10, 2e-8)] * 3
    loops = nested(w, 0.0)
    moved = SeparatedLoops((loops.loops[0], replace(loops.loops[1], offset=(0.5, 3e-7)), loops.loops[2]))
    difference = moved.along(0.0, 0.0).forward_array(PATH) - loops.along(0.0, 0.0).forward_array(PATH)
    outer, first, second = (found.samples for found in PATH_LOOPS)
    assert not difference[outer].any()
    np.testing.assert_allclose(difference[first], 3e-7)
    np.testing.assert_allclose(difference[second], 3e-7)


def test_says_which_loops_were_never_identified() -> None:
    loops = nested([np.full(10, 2e-8)] * 3, 0.0)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        loops.along(0.0, 0.0).forward_array(PATH)
    other = np.concatenate([np.arange(0.0, 30.0), np.arange(30.0, 10.0, -1.0), np.arange(10.0, 100.0)])
    with pytest.warns(UnidentifiedLoopWarning) as warned:
        y = loops.along(0.0, 0.0).forward_array(other)
    # One loop; the first at sample 30: its level, vertex and span.
    assert re.findall(r"\d+", str(warned[0].message)) == ["1", "30", "1", "30", "20"] and len(warned) == 1
    assert np.all(np.isfinite(y)) and np.all(np.diff(y) * np.diff(other) >= 0)


def test_nearest_by_level_vertex_and_span() -> None:
    w = np.full(10, 2e-8)
    loops = SeparatedLoops((
        single(0, 1, 0.0, 100.0, w, 0.0),
        single(1, -1, 80.0, 60.0, w, 0.0),
        single(1, -1, 40.0, 20.0, w, 0.0),
        single(2, -1, 40.0, 20.0, w, 0.0),
    ))  # fmt: skip
    assert loops.nearest(1, -1, 45.0, 20.0, 0) is loops.loops[2]
    assert loops.nearest(1, -1, 75.0, 50.0, 0) is loops.loops[1]
    assert loops.nearest(2, -1, 45.0, 20.0, 0) is loops.loops[3]
    # Of another level, but much nearer.
    assert loops.nearest(2, -1, 80.0, 60.0, 0) is loops.loops[1]
    assert loops.nearest(1, -1, 75.0 * 2e-7, 50.0 * 2e-7, 1) is loops.loops[1]


def test_limits_clip_the_voltage_only() -> None:
    path = nested([np.full(10, 2e-8)] * 3, 0.0).along(0.0, 0.0)
    y = path.forward_array(PATH)
    np.testing.assert_array_equal(path.inverse_array(y, 10.0, 70.0), np.clip(path.inverse_array(y), 10.0, 70.0))


def test_refuses_what_is_no_model() -> None:
    w = np.full(10, 2e-8)
    inner = single(1, -1, 80.0, 60.0, w, 0.0)
    with pytest.raises(ModelError, match=r"\b0\b"):
        SeparatedLoops((inner,))
    outer = single(0, 1, 0.0, 100.0, w, 0.0)
    for broken in (
        replace(inner, span=(0.0, 1e-6)),
        replace(inner, direction=0),
        replace(inner, run_in=-1.0),
        replace(inner, model=PrandtlIshlinskii(np.array([5.0]), np.array([1e-7]))),
    ):
        with pytest.raises(ModelError, match=r"\b1\b"):
            SeparatedLoops((outer, broken))
    with pytest.raises(UsageError, match="nan"):
        SeparatedLoops((outer,)).along(0.0, 0.0).forward_array(np.array([0.0, np.nan]))


def test_a_start_that_is_nearly_there_makes_no_loop() -> None:
    loops = nested([np.full(10, 2e-8)] * 3, 0.0)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        # The sensor's noise at rest; the path starts a little below.
        y = loops.along(0.0, 1e-9).forward_array(PATH)
        v = loops.along(0.0, 1e-9).inverse_array(np.concatenate([[0.0], y[1:81]]))
    assert abs(v[0]) < 0.1
    # A nanometre is worth 0.05 V on this stage.
    np.testing.assert_allclose(v, PATH[:81], atol=0.1)
