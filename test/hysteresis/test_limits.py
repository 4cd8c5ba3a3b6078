"""Voltage limits of the inverse: the memory follows the voltage that is really given."""

import numpy as np
from hypothesis import example, given
from hypothesis import strategies as st
from numpy.typing import NDArray
from strategies import Case, cases, fractions, paths, stream_forward, stream_inverse

from slpi_ros.hysteresis.prandtl_ishlinskii import PrandtlIshlinskii
from slpi_ros.hysteresis.turning_points import Memory

FloatArray = NDArray[np.float64]


@st.composite
def limited(draw: st.DrawFn, *, inside: bool = True) -> tuple[Case, FloatArray, float, float, FloatArray]:
    """Draw a path, limits, and wishes that lie in and out of reach; `inside`: the path ends within the limits."""
    case = draw(cases())
    before = draw(paths(case, max_size=5))
    shares = sorted((draw(fractions(-0.2, 1.2)), draw(fractions(-0.2, 1.2))))
    lower, upper = (case.span[0] + share * case.width for share in shares)
    if inside:
        before = np.append(before, min(max(before[-1], lower), upper))
    return case, before, lower, upper, case.displacements(draw(paths(case)))


def after(case: Case, before: FloatArray) -> Memory:
    memory = case.memory()
    stream_forward(memory, before)
    return memory


@given(limited())
def test_voltage_stays_within_limits_and_the_memory_follows_it(drawn):
    case, before, lower, upper, wishes = drawn
    memory, twin = after(case, before), after(case, before)
    for y in wishes.tolist():
        v = memory.inverse(y, lower, upper)
        assert lower <= v <= upper
        assert memory.voltage == v
        if abs(memory.displacement - y) < 1e-9 * case.height:
            continue
        # Held: as near as the limits allow.
        assert v == (upper if y > memory.displacement else lower)
    memory = after(case, before)
    for y in wishes.tolist():
        assert abs(twin.forward(memory.inverse(y, lower, upper)) - memory.displacement) < 1e-9 * case.height


@given(limited())
def test_back_in_reach_nothing_remains_of_having_been_held(drawn):
    """At any moment the memory answers like one that was given the applied voltages and never knew of a wish."""
    case, before, lower, upper, wishes = drawn
    cut = wishes.size // 2
    memory, twin = after(case, before), after(case, before)
    stream_forward(twin, stream_inverse(memory, wishes[:cut], lower, upper))
    np.testing.assert_allclose(
        stream_inverse(memory, wishes[cut:], lower, upper),
        stream_inverse(twin, wishes[cut:], lower, upper),
        rtol=0,
        atol=1e-9 * case.width,
    )
    np.testing.assert_allclose(memory.displacement, twin.displacement, rtol=0, atol=1e-9 * case.height)


# The first sample of the run lies beyond where the loop closes, and that lies beyond the limit.
VIRGIN = Case(PrandtlIshlinskii(np.array([0.0, 30.0]), np.array([1.0, 1.0])), (0.0, 0.0), False, (0.0, 100.0), (0.0,))
LEAP = np.concatenate([[125.0], np.linspace(-200.0, -210.0, 40), [0.0]])


@given(limited())
@example((VIRGIN, np.array([80.0]), -20.0, 100.0, LEAP))
def test_batch_with_limits_equals_stream_with_limits(drawn):
    case, before, lower, upper, wishes = drawn
    memory, twin = after(case, before), after(case, before)
    v = memory.inverse_array(wishes, lower, upper)
    assert ((lower <= v) & (v <= upper)).all()
    np.testing.assert_allclose(v, stream_inverse(twin, wishes, lower, upper), rtol=0, atol=1e-9 * case.width)
    np.testing.assert_allclose(memory.displacement, twin.displacement, rtol=0, atol=1e-9 * case.height)


@given(limited())
def test_a_batch_with_limits_leaves_the_memory_where_its_voltages_lead(drawn):
    case, before, lower, upper, wishes = drawn
    memory, twin = after(case, before), after(case, before)
    stream_forward(twin, memory.inverse_array(wishes, lower, upper))
    np.testing.assert_allclose(memory.displacement, twin.displacement, rtol=0, atol=1e-9 * case.height)
    back = np.linspace(memory.voltage, memory.voltage - 0.5 * case.width, 50)
    np.testing.assert_allclose(memory.forward_array(back), twin.forward_array(back), rtol=0, atol=1e-9 * case.height)


@given(limited(inside=False))
@example((VIRGIN, np.array([0.0]), 10.0, 100.0, np.array([1.0, 30.0])))
@example((VIRGIN, np.array([5.0]), 10.0, 100.0, np.array([7.0, 30.0])))
@example((VIRGIN, np.array([5.0]), -100.0, 0.0, np.array([7.0, -30.0])))
@example((VIRGIN, np.array([0.0]), 10.0, 100.0, np.array([0.0, *np.linspace(0.1, 60.0, 60)])))
def test_from_outside_the_limits_the_first_voltage_is_inside(drawn):
    case, before, lower, upper, wishes = drawn
    for inverse in (stream_inverse, Memory.inverse_array):
        memory, twin = after(case, before), after(case, before)
        v = inverse(memory, wishes, lower, upper)
        assert ((lower <= v) & (v <= upper)).all()
        y = stream_forward(twin, v)
        np.testing.assert_allclose(memory.displacement, y[-1], rtol=0, atol=1e-9 * case.height)
        missed = np.abs(y - wishes) > 1e-9 * case.height
        assert (v == np.where(wishes > y, upper, lower))[missed].all()


@given(limited(), st.sampled_from((1, 80)), st.floats(0.01, 10))
def test_waiting_at_a_limit_moves_nothing(drawn, samples, excess):
    case, before, lower, upper, _ = drawn
    memory = after(case, before)
    for limit, sign in ((upper, 1), (lower, -1)):
        memory.forward(limit)
        kept = memory.snapshot()
        beyond = kept.displacement + sign * case.height * np.linspace(0, excess, samples + 1)
        assert (memory.inverse_array(beyond, lower, upper) == limit).all()
        assert memory.snapshot() == kept
        assert (stream_inverse(memory, beyond, lower, upper) == limit).all()
        assert memory.snapshot() == kept


@given(limited(), st.integers(1, 3))
def test_depth_does_not_grow_while_held(drawn, repetitions):
    case, before, lower, upper, wishes = drawn
    memory = after(case, before)
    depths = []
    for _ in range(3 + repetitions):
        stream_inverse(memory, wishes, lower, upper)
        depths.append(memory.depth)
    assert len(set(depths[1:])) == 1


def test_slewing_limits_that_follow_the_voltage():
    """Limits may change from sample to sample; the voltage catches up and then is on the path again."""
    case = VIRGIN
    memory, twin = case.memory(), case.memory()
    wishes = np.concatenate([np.full(30, 60.0), np.full(30, -40.0), np.full(30, 10.0)])
    for y in wishes.tolist():
        v = memory.voltage
        applied = memory.inverse(y, v - 7.0, v + 7.0)
        assert abs(applied - v) <= 7.0
        assert twin.forward(applied) == memory.displacement or abs(twin.displacement - memory.displacement) < 1e-12
    assert memory.displacement == 10.0
