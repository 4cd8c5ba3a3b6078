"""The inverse: one memory driven by displacement, or by voltage and displacement in turns."""

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from strategies import Case, cases_and_paths, stream_forward, stream_inverse

from slpi_ros.hysteresis.loop_family import LoopFamily
from slpi_ros.hysteresis.prandtl_ishlinskii import PrandtlIshlinskii, play
from slpi_ros.hysteresis.shapes import FAR
from slpi_ros.hysteresis.turning_points import Memory

STREAMED = (stream_forward, stream_inverse)
IN_BATCHES = (Memory.forward_array, Memory.inverse_array)


@pytest.mark.parametrize(("forward", "inverse"), [STREAMED, IN_BATCHES], ids=["stream", "batch"])
@given(drawn=cases_and_paths())
def test_inverse_of_forward_is_the_identity(forward, inverse, drawn):
    case, v = drawn
    y = forward(case.memory(), v)
    np.testing.assert_allclose(inverse(case.memory(), y), v, rtol=0, atol=1e-9 * case.width)


@pytest.mark.parametrize(("forward", "inverse"), [STREAMED, IN_BATCHES], ids=["stream", "batch"])
@given(drawn=cases_and_paths())
def test_forward_of_inverse_is_the_identity(forward, inverse, drawn):
    case, path = drawn
    y = case.displacements(path)
    v = inverse(case.memory(), y)
    np.testing.assert_allclose(forward(case.memory(), v), y, rtol=0, atol=1e-9 * case.height)


@given(cases_and_paths(), st.lists(st.booleans(), min_size=1, max_size=9))
def test_steps_by_voltage_and_by_displacement_mix_on_one_memory(drawn, by_voltage):
    case, path = drawn
    memory = case.memory()
    v, y = np.empty_like(path), np.empty_like(path)
    for i, (voltage, displacement) in enumerate(zip(path, case.displacements(path), strict=True)):
        if by_voltage[i % len(by_voltage)]:
            v[i], y[i] = voltage, memory.forward(voltage)
        else:
            v[i], y[i] = memory.inverse(displacement), displacement
        assert (memory.voltage, memory.displacement) == (v[i], y[i])
    np.testing.assert_allclose(stream_forward(case.memory(), v), y, rtol=0, atol=1e-9 * case.height)
    np.testing.assert_allclose(stream_inverse(case.memory(), y), v, rtol=0, atol=1e-9 * case.width)


@given(cases_and_paths(), st.lists(st.booleans(), min_size=1, max_size=3), st.integers(1, 60))
def test_batches_by_voltage_and_by_displacement_mix_on_one_memory(drawn, by_voltage, size):
    case, path = drawn
    memory, twin = case.memory(), case.memory()
    for i, part in enumerate(np.split(path, range(size, path.size, size))):
        if by_voltage[i % len(by_voltage)]:
            y = memory.forward_array(part)
            np.testing.assert_allclose(stream_forward(twin, part), y, rtol=0, atol=1e-9 * case.height)
        else:
            v = memory.inverse_array(case.displacements(part))
            np.testing.assert_allclose(
                stream_inverse(twin, case.displacements(part)), v, rtol=0, atol=1e-9 * case.width
            )
        assert memory.depth == twin.depth


@given(cases_and_paths())
def test_depth_does_not_grow_under_a_periodic_displacement(drawn):
    case, path = drawn
    memory = case.memory()
    deepest = []
    for _ in range(6):
        deepest.append(0)
        for y in case.displacements(path).tolist():
            memory.inverse(y)
            deepest[-1] = max(deepest[-1], memory.depth)
    assert len(set(deepest[1:])) == 1
    assert deepest[-1] <= path.size + 1


# A step of which the rounding of the reversal far above exceeds that of the loops.
FLAT = LoopFamily(np.array([0.0, 15.0]), np.array([[0.0, 0.0], [0.1912, 0.0]]), np.array([0.0, 0.75]), 0.198)


@given(cases_and_paths())
@example((Case(FLAT, (0.25, 0.595), True, (0.0, 15.0), (0.0, 15.0)), np.arange(6, -1, -1) / 32))
def test_inverse_rises_and_falls_with_the_displacement(drawn):
    case, path = drawn
    y = case.displacements(path)
    v = stream_inverse(case.memory(), y)
    wished, moved = np.diff([case.rest[1], *y]), np.diff([case.rest[0], *v])
    lowest, highest = (1 / slope for slope in reversed(case.slopes))
    slack = 1e-11 * case.height / case.slopes[0]
    if case.primed:
        # The displacement of the reversal far above is rounded to the last digit of its size.
        slack += 4 * np.spacing(FAR * case.slopes[1]) / case.slopes[0]
    assert (moved * np.sign(wished) >= lowest * np.abs(wished) - slack).all()
    assert (moved * np.sign(wished) <= highest * np.abs(wished) + slack).all()
    assert (moved[wished == 0] == 0).all()


@pytest.mark.parametrize(
    "shape",
    [play(5.0), PrandtlIshlinskii(np.array([0.0, 4.0, 9.0]), np.array([1.0, -1.0, 2.0]))],
    ids=["play", "level"],
)
def test_what_lies_on_a_level_piece_is_still_reached(shape):
    """Such a model has no inverse, but every displacement some voltage that gives it."""
    y = np.concatenate([np.linspace(0, 30, 50), np.linspace(30, -20, 50), [-10, 5, 0, 3, 3, -20, 40]])
    for inverse in (stream_inverse, Memory.inverse_array):
        v = inverse(Memory(shape), y)
        np.testing.assert_allclose(stream_forward(Memory(shape), v), y, rtol=0, atol=1e-9)
