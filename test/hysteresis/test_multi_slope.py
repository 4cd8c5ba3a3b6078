"""The MPI model against the paper's recursion, operator by operator, and the laws that every shape keeps."""

from dataclasses import dataclass

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from strategies import UNITS, Case, fractions, paths, repeated, stream_forward, stream_inverse

from slpi_ros.errors import ModelError
from slpi_ros.hysteresis.multi_slope import MultiSlope, falling_envelope, thresholds_for
from slpi_ros.hysteresis.turning_points import Memory

FloatArray = NDArray[np.float64]

BOTH_WAYS = pytest.mark.parametrize(
    ("forward", "inverse"),
    [(stream_forward, stream_inverse), (Memory.forward_array, Memory.inverse_array)],
    ids=["stream", "batch"],
)


def eq_2(shape: MultiSlope, v: FloatArray, before: float) -> FloatArray:
    """Eq. 2 term by term, shape (N, n); `before` is the operators' output before the first sample."""
    r, v_p = shape.thresholds, shape.amplitude
    f = np.full_like(r, before)
    answers = np.empty((v.size, r.size))
    for i, u in enumerate(v - shape.origin):
        inner = np.minimum(1.2 * u, 0.8 * u + 0.2 * v_p + 0.6 * r)
        answers[i] = f = np.maximum(u - r, np.minimum(inner, f))
    return answers


@dataclass(frozen=True)
class MultiSlopeCase(Case):
    """A model and its memory at rest or primed; displacements of a path are by the mean gain."""

    @property
    def height(self) -> float:
        return self.shape.stroke(self.span[1], self.span[0])

    @property
    def rounding(self) -> float:
        """Operators that do not move within the range take part in the long fall before it."""
        return 1e-11 * self.width * float(self.shape.weights.sum())

    def displacements(self, v: FloatArray) -> FloatArray:
        return self.rest[1] + (v - self.rest[0]) * self.height / self.width

    def recursion(self, v: FloatArray) -> FloatArray:
        """Eq. 2 after a fall from far above to rest, whose displacement counts as that of rest."""
        operators = eq_2(self.shape, np.append(self.rest[0], v), np.inf)
        y = operators @ self.shape.weights
        return self.rest[1] + y[1:] - y[0]


@st.composite
def multi_slopes(draw: st.DrawFn) -> MultiSlope:
    """Draw a model with the paper's thresholds or others; some weights are zero."""
    amplitude = draw(st.sampled_from((120.0, 80.0, 20.0)))
    r = thresholds_for(amplitude)
    if draw(st.booleans()):
        r = np.cumsum(draw(st.lists(fractions(0.5, 15), min_size=1, max_size=8)))
    some = st.sampled_from((0.0, 1.0)) | fractions(0.05, 1)
    w = np.array(draw(st.lists(some, min_size=r.size, max_size=r.size)))
    # One operator at least moves within the range.
    w[0] += 0.2
    return MultiSlope(draw(st.sampled_from((0.0, -20.0, 7.5))), amplitude, r, w * draw(st.sampled_from(UNITS)))


@st.composite
def cases_and_paths(draw: st.DrawFn, primed: bool | None = None) -> tuple[MultiSlopeCase, FloatArray]:
    """Draw a model and a path; above rest, if the memory was never moved."""
    shape = draw(multi_slopes())
    low, high = shape.origin, shape.origin + shape.amplitude
    rest = low + draw(st.sampled_from((0.0, 0.1, 0.45))) * shape.amplitude
    y_rest = draw(st.sampled_from((0.0, 0.3))) * shape.stroke(high, low)
    primed = draw(st.booleans()) if primed is None else primed
    bends = np.concatenate([low + shape.thresholds, low + 0.5 * shape.amplitude + 1.5 * shape.thresholds, [high]])
    landmarks = tuple(bends[bends <= high].tolist())
    case = MultiSlopeCase(shape, (rest, y_rest), primed, (low, high), landmarks)
    return case, draw(paths(case, low=None if primed else rest))


@given(cases_and_paths())
def test_the_model_is_the_papers_recursion(drawn):
    case, v = drawn
    expected = case.recursion(v)
    np.testing.assert_allclose(stream_forward(case.memory(), v), expected, rtol=0, atol=case.rounding)
    np.testing.assert_allclose(case.memory().forward_array(v), expected, rtol=0, atol=case.rounding)


@given(multi_slopes(), st.data())
def test_from_zero_the_model_is_the_papers_recursion_from_nothing(shape, data):
    """Eq. 2 starts from y(0) = 0 at u = 0."""
    low, high = shape.origin, shape.origin + shape.amplitude
    v = data.draw(paths(MultiSlopeCase(shape, (low, 0.0), False, (low, high), (low, high)), low=low))
    expected = eq_2(shape, v, 0.0) @ shape.weights
    slack = 1e-12 * shape.stroke(high, low)
    np.testing.assert_allclose(Memory(shape, low).forward_array(v), expected, rtol=0, atol=slack)


@BOTH_WAYS
@repeated
@given(drawn=cases_and_paths())
def test_forward_of_inverse_is_the_identity(forward, inverse, drawn):
    case, path = drawn
    y = case.displacements(path)
    again = forward(case.memory(), inverse(case.memory(), y))
    np.testing.assert_allclose(again, y, rtol=0, atol=1e-9 * case.height)


@BOTH_WAYS
@repeated
@given(drawn=cases_and_paths())
def test_what_the_model_gives_is_reached_again(forward, inverse, drawn):
    case, v = drawn
    y = forward(case.memory(), v)
    again = forward(case.memory(), inverse(case.memory(), y))
    np.testing.assert_allclose(again, y, rtol=0, atol=1e-9 * case.height)


@given(cases_and_paths())
def test_the_inverse_streams_as_it_batches(drawn):
    case, path = drawn
    y = case.displacements(path)
    memory, twin = case.memory(), case.memory()
    streamed, batch = stream_inverse(twin, y), memory.inverse_array(y)
    np.testing.assert_allclose(streamed, batch, rtol=0, atol=1e-12 * case.width)
    assert memory.snapshot() == twin.snapshot()


@given(cases_and_paths(), st.lists(st.booleans(), min_size=1, max_size=9))
def test_steps_by_voltage_and_by_displacement_mix_on_one_memory(drawn, by_voltage):
    """A turn by voltage within a dead zone, and then on by displacement."""
    case, path = drawn
    memory = case.memory()
    v, y = np.empty_like(path), np.empty_like(path)
    for i, (voltage, displacement) in enumerate(zip(path, case.displacements(path), strict=True)):
        if by_voltage[i % len(by_voltage)]:
            v[i], y[i] = voltage, memory.forward(voltage)
        else:
            v[i], y[i] = memory.inverse(displacement), displacement
    np.testing.assert_allclose(stream_forward(case.memory(), v), y, rtol=0, atol=1e-9 * case.height)


@BOTH_WAYS
@repeated
@given(drawn=cases_and_paths(), limits=st.tuples(fractions(0, 0.4), fractions(0.6, 1)))
def test_limits_hold_in_dead_zones_too(forward, inverse, drawn, limits):
    case, path = drawn
    lower, upper = (case.span[0] + share * case.width for share in limits)
    lower = max(lower, case.rest[0])
    y = case.displacements(path)
    v = inverse(case.memory(), y, lower, upper)
    assert (v >= lower).all() and (v <= upper).all()
    got, inside = forward(case.memory(), v), (v > lower) & (v < upper)
    np.testing.assert_allclose(got[inside], y[inside], rtol=0, atol=1e-9 * case.height)
    assert (got[v == lower] >= y[v == lower] - 1e-9 * case.height).all()
    assert (got[v == upper] <= y[v == upper] + 1e-9 * case.height).all()


@given(cases_and_paths())
def test_displacement_never_falls_where_voltage_rises(drawn):
    case, v = drawn
    y = case.memory().forward_array(v)
    moved = np.diff(y, prepend=case.rest[1]) * np.sign(np.diff(v, prepend=case.rest[0]))
    assert (moved >= -case.rounding).all()
    steepest = 1.2 * case.shape.weights.sum()
    assert (moved <= steepest * np.abs(np.diff(v, prepend=case.rest[0])) + case.rounding).all()


@given(cases_and_paths(), st.tuples(fractions(0, 1), fractions(0, 1)))
def test_an_inner_loop_closes_and_leaves_no_trace(drawn, inner):
    case, before = drawn
    memory, undisturbed = case.memory(), case.memory()
    bottom = case.span[0] if case.primed else case.rest[0]
    # The last branch is long enough that the inner loop lies within it.
    before = np.append(before, [bottom, case.span[1], bottom + 0.2 * (case.span[1] - bottom)])
    for each in (memory, undisturbed):
        each.forward_array(before)
    turn = memory.voltage
    a, b = (turn + share * (case.span[1] - turn) for share in inner)
    out, back = memory.forward_array(np.array([max(a, b), min(a, b), max(a, b)]))[[0, 2]]
    assert back == pytest.approx(out, abs=case.rounding)
    after = np.linspace(max(a, b), case.span[1], 5)
    np.testing.assert_allclose(
        memory.forward_array(after), undisturbed.forward_array(after), rtol=0, atol=case.rounding
    )


@given(multi_slopes())
def test_a_cycle_comes_back_to_zero(shape):
    memory = Memory(shape, shape.origin)
    top = shape.origin + shape.amplitude
    up, down = memory.forward_array(np.array([top, shape.origin]))
    assert up == pytest.approx(shape.weights @ np.maximum(0.0, shape.amplitude - shape.thresholds), rel=1e-12)
    assert up == pytest.approx(shape.stroke(top, shape.origin), rel=1e-12)
    assert down == pytest.approx(0.0, abs=1e-12 * up)
    assert memory.depth == 0 or memory.forward(top) == pytest.approx(up, rel=1e-12)


def test_figures_by_hand():
    """V_p = 120 V, r = 20 V: rises from 20 V; down from 120 V waits until 1.2 u = 100 V, and then falls by 1.2."""
    memory = Memory(MultiSlope(0.0, 120.0, np.array([20.0]), np.array([1.0])))
    v = np.array([0, 20, 60, 120, 100, 80, 90, 60, 30, 0, 10])
    assert memory.forward_array(v) == pytest.approx([0, 0, 40, 100, 100, 96, 96, 72, 36, 0, 0], abs=1e-12)


def test_from_the_top_an_operator_of_small_threshold_falls_after_twice_its_threshold():
    """As the classical one; above V_p / 7 the steep part of the envelope catches it earlier."""
    r = np.array([0.0, 5.0, 10.0, 17.0])
    np.testing.assert_allclose(falling_envelope(120.0 - 2 * r, r, 120.0), 120.0 - r)
    assert falling_envelope(120.0 - 2 * 20.0, 20.0, 120.0) < 120.0 - 20.0


def test_bends_of_the_falling_envelope():
    """r = 10 V of V_p = 120 V: slope 1 below -50 V, 1.2 up to 75 V, 0.8 up to 200 V, then 1."""
    u = np.array([-150.0, -50.0, 0.0, 75.0, 175.0, 200.0, 300.0])
    assert falling_envelope(u, 10.0, 120.0) == pytest.approx([-160.0, -60.0, 0.0, 90.0, 170.0, 190.0, 290.0])


def test_the_inverse_jumps_over_the_dead_zone_at_a_turn():
    """Down from 60 V of 120 V even the lowest operator waits, until 1.2 u = 60 V."""
    memory = Memory(MultiSlope(0.0, 120.0, np.array([0.0]), np.array([1e-6])))
    assert memory.inverse(60e-6) == pytest.approx(60.0)
    assert memory.inverse(59.9999e-6) == pytest.approx(50.0, abs=1e-3)
    assert memory.inverse(60e-6) == pytest.approx(60.0, abs=1e-9)


def test_the_papers_thresholds():
    assert thresholds_for(120.0).tolist() == list(range(0, 130, 10))
    assert thresholds_for(119.9).size == 13 and thresholds_for(119.9)[-1] == 119.9
    assert thresholds_for(80.0) == pytest.approx(np.arange(0, 88, 8))
    assert thresholds_for(20.0) == pytest.approx(np.arange(0, 22, 2))


@pytest.mark.parametrize(
    ("origin", "amplitude", "thresholds", "weights"),
    [
        (0.0, 120.0, [], []),
        (0.0, 120.0, [0.0], [1.0, 2.0]),
        (0.0, 120.0, [[0.0]], [[1.0]]),
        (0.0, 120.0, [-1.0], [1.0]),
        (0.0, 120.0, [0.0, 0.0], [1.0, 1.0]),
        (0.0, 120.0, [0.0, np.inf], [1.0, 1.0]),
        (0.0, 120.0, [0.0, np.nan], [1.0, 1.0]),
        (0.0, 120.0, [0.0, 1.0], [1.0, np.nan]),
        (0.0, 120.0, [0.0, 1.0], [1.0, np.inf]),
        (0.0, 120.0, [0.0, 1.0], [1.0, -1e-9]),
        (0.0, 120.0, [0.0, 1.0], [0.0, 0.0]),
        (0.0, 0.0, [0.0], [1.0]),
        (0.0, -5.0, [0.0], [1.0]),
        (0.0, np.inf, [0.0], [1.0]),
        (np.nan, 120.0, [0.0], [1.0]),
    ],
)
def test_parameters_that_make_no_model(origin, amplitude, thresholds, weights):
    with pytest.raises(ModelError):
        MultiSlope(origin, amplitude, np.array(thresholds), np.array(weights))
