import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from slpi_ros.errors import UsageError
from slpi_ros.simulation.preisach import RelayTriangle

LOW, HIGH, LEVELS = -20.0, 120.0, 40
voltages = st.floats(LOW, HIGH)
unhurried = settings(max_examples=50, deadline=None)
histories = st.lists(voltages, max_size=8)


def density(bias, width):
    return np.exp(-width / 40) * (1 + 0.005 * bias)


def triangle():
    return RelayTriangle(LOW, HIGH, LEVELS, density)


def drive(relays, history):
    return [relays.step(v) for v in history]


@given(st.lists(voltages, min_size=1, max_size=12))
@unhurried
def test_it_is_the_sum_of_two_state_relays(history):
    """Every bundle taken apart into relays that know nothing but their own two thresholds."""
    bundle = 50
    spacing = (HIGH - LOW) / LEVELS
    row, column = np.tril_indices(LEVELS)
    within = (np.arange(bundle) + 0.5) / bundle
    up_at = LOW + spacing * (row[:, None] + within)
    down_at = LOW + spacing * (column[:, None] + within)
    bias, width = LOW + spacing * (row + column + 1) / 2, spacing * (row - column)
    weight = density(bias, width)
    tolerance = weight.sum() * 2 / LEVELS / bundle
    is_up = np.zeros(up_at.shape, dtype=bool)
    relays = triangle()
    for v in history:
        is_up = np.where(v >= up_at, True, np.where(v < down_at, False, is_up))
        # a bundle of so many relays rounds its share
        assert relays.step(v) == pytest.approx(weight @ is_up.mean(axis=1), abs=tolerance)


@given(histories, voltages, voltages)
@unhurried
def test_return_point_memory(history, a, b):
    """An excursion inside the last branch leaves no trace once its beginning is reached again."""
    relays = triangle()
    drive(relays, history)
    turn, back = min(a, b), max(a, b)
    drive(relays, [HIGH, turn, back])
    before, state = relays.output, relays.state
    drive(relays, [turn, back])
    assert relays.output == pytest.approx(before, abs=1e-9)
    np.testing.assert_array_equal(relays.state, state)


@given(histories, histories, voltages, voltages)
@unhurried
def test_a_larger_loop_wipes_out_what_went_before(one, other, low, high):
    low, high = min(low, high), max(low, high)
    inside = [np.clip(v, low, high) for v in one]
    with_memory, without = triangle(), triangle()
    drive(with_memory, [*other, LOW, high, low, *inside, high, low])
    drive(without, [high, low])
    np.testing.assert_array_equal(with_memory.state, without.state)
    assert with_memory.output == pytest.approx(without.output, abs=1e-9)


@given(histories, histories, voltages, voltages)
@unhurried
def test_minor_loops_between_the_same_voltages_are_congruent(one, other, low, high):
    low, high = min(low, high), max(low, high)
    loop = np.linspace(low, high, 9)
    heights = []
    for history in (one, other):
        relays = triangle()
        drive(relays, [*history, low, high])
        falling = np.array(drive(relays, loop[::-1]))
        heights.append(falling - falling[0])
    np.testing.assert_allclose(*heights, atol=1e-9)


@given(histories, voltages, voltages)
@unhurried
def test_monotone(history, a, b):
    relays = triangle()
    drive(relays, history)
    path = np.linspace(relays.voltage, a, 7)
    assert np.all(np.diff(drive(relays, path)) * np.sign(a - path[0]) >= -1e-9)


@given(histories, voltages)
@unhurried
def test_rate_independent(history, target):
    at_once, slowly = triangle(), triangle()
    drive(at_once, history)
    for v in history:
        drive(slowly, np.linspace(slowly.voltage, v, 13)[:-1])
        slowly.step(v)
    at_once.step(target)
    slowly.step(target)
    np.testing.assert_array_equal(slowly.state, at_once.state)
    assert slowly.output == pytest.approx(at_once.output, abs=1e-9)


@given(histories)
@unhurried
def test_the_running_sum_is_the_sum(history):
    relays = triangle()
    drive(relays, history)
    centres = LOW + (HIGH - LOW) / LEVELS * (np.arange(LEVELS) + 0.5)
    up, down = centres[:, None], centres[None, :]
    weight = np.tril(density((up + down) / 2, np.maximum(up - down, 0)))
    assert relays.output == pytest.approx(float(np.sum(weight * relays.state)), abs=1e-9)


def test_scale_and_all_down():
    relays, doubled = triangle(), triangle()
    doubled.step(50)
    doubled.scale(2)
    relays.step(50)
    assert doubled.output == pytest.approx(2 * relays.output)
    doubled.all_down()
    assert doubled.output == 0 and not doubled.state.any()
    assert doubled.step(70) == pytest.approx(2 * relays.step(70))


@pytest.mark.parametrize("voltage", [-20.1, 120.1, float("nan"), float("inf"), -float("inf")])
def test_a_voltage_out_of_range_is_refused_and_changes_nothing(voltage):
    relays = triangle()
    before = relays.step(30)
    with pytest.raises(UsageError):
        relays.step(voltage)
    assert relays.step(30) == before
