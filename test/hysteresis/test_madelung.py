"""Madelung's laws, and what follows from them, for every kind of model."""

import numpy as np
from hypothesis import assume, given
from hypothesis import strategies as st
from numpy.typing import NDArray
from strategies import Case, cases, cases_and_paths, fractions, paths, stream_forward

FloatArray = NDArray[np.float64]


@st.composite
def loops(draw: st.DrawFn) -> tuple[Case, FloatArray, float, float, list[FloatArray], FloatArray]:
    """Draw a path, a move from a to b after it, two excursions between a and b, and a path after that."""
    case = draw(cases())
    before, after = draw(paths(case, max_size=6)), draw(paths(case, max_size=6))
    a, b = (case.span[0] + share * case.width for share in draw(st.tuples(fractions(-0.3, 1.3), fractions(-0.3, 1.3))))
    assume(abs(a - b) > 1e-6 * case.width)
    inner = [draw(paths(case, min(a, b), max(a, b), max_size=6)) for _ in range(2)]
    return case, before, a, b, inner, after


@given(loops())
def test_return_point_memory(drawn):
    case, before, a, b, (inner, _), after = drawn
    memory, twin = case.memory(), case.memory()
    for m in (memory, twin):
        stream_forward(m, before)
        m.forward(a)
        turned_at = m.forward(b)
    stream_forward(memory, inner)
    tolerance = 1e-9 * case.height
    assert abs(memory.forward(b) - turned_at) < tolerance
    np.testing.assert_allclose(stream_forward(memory, after), stream_forward(twin, after), rtol=0, atol=tolerance)


@given(loops())
def test_inner_history_is_wiped_out_when_an_extreme_is_passed(drawn):
    case, before, a, b, inner, after = drawn
    beyond = b + 0.1 * (b - a)
    answers = []
    for excursion in inner:
        memory = case.memory()
        stream_forward(memory, np.array([*before, a, b, *excursion, beyond]))
        answers.append(stream_forward(memory, np.array([beyond, *after])))
    np.testing.assert_allclose(*answers, rtol=0, atol=1e-9 * case.height)


@given(cases().flatmap(lambda case: st.tuples(st.just(case), paths(case), paths(case), paths(case))))
def test_a_sweep_over_everything_wipes_the_whole_memory(drawn):
    case, one, other, after = drawn
    reach = 2 * case.width + abs(case.rest[0] - case.span[0])
    # Down first: a virgin memory is symmetric about rest, one at the low end forgets on the way up.
    sweep = [case.rest[0] - reach, case.rest[0] + reach]
    answers = []
    for before in (one, other, []):
        memory = case.memory()
        stream_forward(memory, np.array([*before, *sweep]))
        assert memory.depth <= 2
        answers.append(stream_forward(memory, after))
    np.testing.assert_allclose(answers[0], answers[1], rtol=0, atol=1e-9 * case.height)
    np.testing.assert_allclose(answers[0], answers[2], rtol=0, atol=1e-9 * case.height)


@given(loops())
def test_closed_loops_close_and_repeat(drawn):
    case, before, a, b, _, _ = drawn
    memory = case.memory()
    stream_forward(memory, np.array([*before, a, b]))
    rounds = stream_forward(memory, np.tile(np.linspace(b, a, 30).tolist() + np.linspace(a, b, 30).tolist(), 3))
    first, second, third = rounds.reshape(3, -1)
    tolerance = 1e-9 * case.height
    assert abs(first[0] - first[-1]) < tolerance
    np.testing.assert_allclose(second, first, rtol=0, atol=tolerance)
    np.testing.assert_allclose(third, first, rtol=0, atol=tolerance)


@given(loops())
def test_loops_between_the_same_voltages_are_congruent(drawn):
    case, before, a, b, _, other = drawn
    loop = np.concatenate([np.linspace(b, a, 20), np.linspace(a, b, 20)])
    shapes = []
    for history in (before, other):
        memory = case.memory()
        stream_forward(memory, np.array([*history, a, b]))
        shapes.append(stream_forward(memory, loop) - memory.displacement)
    np.testing.assert_allclose(*shapes, rtol=0, atol=1e-9 * case.height)


@given(cases(("pi",)), fractions(0, 1), fractions(0.01, 1), fractions(-2, 2))
def test_loops_of_equal_span_are_congruent_in_a_pi_model(case, low, span, shift):
    a = case.span[0] + low * case.width
    loop = a + span * case.width * np.array([0, 1, 0.7, 0.3, 0, 0.2, 0.5, 1])
    shapes = []
    for moved in (loop, loop + shift * case.width):
        memory = case.memory()
        stream_forward(memory, moved[:2])
        shapes.append(stream_forward(memory, moved[2:]) - memory.displacement)
    np.testing.assert_allclose(*shapes, rtol=0, atol=1e-9 * case.height)


@given(cases_and_paths())
def test_slopes_stay_between_those_of_the_branches(drawn):
    """Strictly monotone, continuous, Lipschitz, also where loops close."""
    case, v = drawn
    y = stream_forward(case.memory(), v)
    moved, answered = np.diff([case.rest[0], *v]), np.diff([case.rest[1], *y])
    lowest, highest = case.slopes
    slack = 1e-11 * case.height
    assert (answered * np.sign(moved) >= lowest * np.abs(moved) - slack).all()
    assert (answered * np.sign(moved) <= highest * np.abs(moved) + slack).all()
    assert (answered[moved == 0] == 0).all()
    visible = np.abs(moved) > 1e-9 * case.width
    assert (np.sign(answered) == np.sign(moved))[visible].all()


@given(cases_and_paths(), st.lists(fractions(0, 1), min_size=1, max_size=7))
def test_points_inserted_on_the_way_change_nothing(drawn, shares):
    case, v = drawn
    starts = np.array([case.rest[0], *v[:-1]])
    between = starts[:, None] + np.sort(shares) * (v - starts)[:, None]
    resampled = np.column_stack([between, v])
    for drive in (stream_forward, lambda memory, x: memory.forward_array(x)):
        y = drive(case.memory(), resampled.ravel()).reshape(resampled.shape)[:, -1]
        np.testing.assert_allclose(y, stream_forward(case.memory(), v), rtol=0, atol=1e-9 * case.height)


@given(cases_and_paths(), st.integers(1, 4))
def test_repeated_samples_change_nothing(drawn, times):
    case, v = drawn
    y = stream_forward(case.memory(), np.repeat(v, times)).reshape(-1, times)
    assert (stream_forward(case.memory(), v) == y.T).all()


@given(cases_and_paths())
def test_depth_does_not_grow_under_a_periodic_voltage(drawn):
    case, v = drawn
    memory = case.memory()
    deepest = []
    for _ in range(6):
        deepest.append(max(_depth_after(memory, x) for x in v.tolist()))
    assert len(set(deepest[1:])) == 1
    assert deepest[-1] <= v.size + 1


def _depth_after(memory, v):
    memory.forward(v)
    return memory.depth
