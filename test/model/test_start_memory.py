"""The memory at the end of a record, and what a drive is taken to start from."""

import warnings
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from identification.records import calibration, record_of, stage
from strategies import FAMILY_CASE, axis_model, cases, fractions, paths

import slpi_ros
from slpi_ros.errors import UsageError
from slpi_ros.model.axis_model import MOST_TURNS, START_MEMORIES, AxisModel
from slpi_ros.model.document import format_model, parse_model
from slpi_ros.model.stage_model import HeldAtLimitWarning, StageModel

X = axis_model(FAMILY_CASE)


@st.composite
def driven_axes(draw: st.DrawFn) -> tuple[AxisModel, np.ndarray, np.ndarray]:
    """Return an axis, a drive that its record held, and another one after it."""
    case = draw(cases())
    turns = draw(st.lists(fractions(0, 1).map(lambda share: case.span[0] + share * case.width), max_size=3))
    first, second = (draw(paths(case, *case.span)) for _ in range(2))
    return axis_model(case, tuple(turns)), first, second


@given(driven_axes())
def test_the_end_stands_for_the_whole_drive(drawn):
    axis, first, second = drawn
    whole = axis.simulate(np.arange(first.size + second.size), np.concatenate([first, second]))
    end = axis.after(first)
    assert end.voltage == first[-1]
    after = replace(axis, start=end).simulate(np.arange(second.size), second)
    height = axis.displacement_range[1] - axis.displacement_range[0]
    np.testing.assert_allclose(after, whole[first.size :], rtol=0, atol=1e-9 * height + 1e-12 * abs(whole).max())


@given(driven_axes())
def test_a_drive_starts_from_the_end_unless_told_otherwise(drawn):
    axis, first, second = drawn
    axis = replace(axis, end=axis.after(first))
    y = np.clip(replace(axis, start=axis.end).simulate(np.arange(second.size), second), *axis.displacement_range)
    model = StageModel({"x": axis})
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", HeldAtLimitWarning)
        for start_memory in START_MEMORIES:
            batch = model.compensate(np.arange(y.size), y, start_memory=start_memory)
            step = model.stream("x", start_memory)
            streamed = [step(t, wish) for t, wish in enumerate(y.tolist())]
            np.testing.assert_allclose(streamed, batch, rtol=0, atol=1e-9 * np.ptp(axis.voltage_range))
            if start_memory == "end":
                assert (batch == model.compensate(np.arange(y.size), y)).all()


@given(driven_axes())
def test_a_wiped_memory_is_the_same_whatever_was_before(drawn):
    axis, first, second = drawn
    one, other = axis.initial("wiped"), replace(axis, end=axis.after(first)).initial("wiped")
    assert one.voltage == other.voltage == np.clip(0.0, *axis.voltage_range)
    motions = [
        replace(axis, start=start).simulate(np.arange(second.size), second) - start.displacement
        for start in (one, other)
    ]
    height = axis.displacement_range[1] - axis.displacement_range[0]
    # Outside the voltages that the reset went through, what was before still counts.
    low, high = axis.voltage_range
    if low <= min(axis.start.voltage, *axis.start.history, low) and second.min() >= low and second.max() <= high:
        np.testing.assert_allclose(*motions, rtol=0, atol=1e-9 * height)


def test_a_model_that_does_not_know_its_end_starts_where_the_record_did():
    assert X.end is None
    assert X.initial("end") == X.start
    with pytest.raises(UsageError, match="middle"):
        X.initial("middle")


def test_the_document_holds_both_and_older_ones_load():
    for end in (None, X.after(np.array([10.0, 60.0, 30.0])), replace(X, start=X.initial("wiped")).after(np.zeros(0))):
        model = StageModel({"x": replace(X, end=end)})
        assert parse_model(format_model(model), "test").axes["x"].end == end


def test_of_many_nested_turns_some_stand_for_all():
    shrink = np.repeat(1.0 - np.arange(3 * MOST_TURNS) / (3 * MOST_TURNS), 2)
    v = 50.0 + 50.0 * shrink * np.where(np.arange(shrink.size) % 2, -1.0, 1.0)
    for count in (v.size, v.size - 1):
        end = X.after(v[:count])
        assert MOST_TURNS - 2 <= len(end.history) <= MOST_TURNS
        assert end.history[0] == v.min()
        memory, whole = replace(X, start=end).memory("start"), X.memory("start")
        whole.forward_array(v[:count])
        assert memory.direction == whole.direction
        for u in (70.0, 20.0, 95.0, 100.0):
            assert memory.forward(u) == pytest.approx(whole.forward(u), abs=1e-9)


def test_the_stage_goes_on_from_where_its_record_ended():
    """Nobody resets it: what is asked next is reached; from the record's start it would not be."""
    record, _ = calibration(seed=3, duration=20.0)
    t, v = record.t, record.voltage["x"].copy()
    own, count = stage(3), 3300
    t, v = t[:count], v[:count]
    true, measured = own.run(t, v)
    model = slpi_ros.identify(record_of(t, v, measured))
    axis = model.axes["x"]
    assert axis.end.voltage == pytest.approx(v[-1], abs=1e-9)
    assert axis.end.displacement == pytest.approx(true[-1], abs=3e-8)
    low, high = axis.displacement_range
    desired = np.linspace(axis.end.displacement, 0.5 * (low + high), 100)
    after = t[-1] + 0.005 * np.arange(1, 101)
    reached = own.run(after, model.compensate(after, desired))[0][-1]
    assert abs(reached - desired[-1]) < 1e-3 * (high - low)


def test_the_end_is_that_of_the_record_and_not_of_its_fitted_part():
    record, _ = calibration(seed=3, duration=20.0)
    model = slpi_ros.identify(record, stop=15.0)
    assert model.axes["x"].end.voltage == pytest.approx(record.voltage["x"][-1], abs=1e-9)


def test_the_last_of_several_records_by_their_stamps_is_the_end():
    t, v = np.arange(2000) / 200.0, 50.0 - 50.0 * np.cos(np.arange(2000) * 0.02)
    one = stage(3)
    first = record_of(t, v, one.run(t, v)[1])
    later = replace(record_of(t, 0.7 * v, one.run(t + 20.0, 0.7 * v)[1]), time_ns=first.time_ns + 20_000_000_000)
    for records in ([first, later], [later, first]):
        axis = slpi_ros.identify(records).axes["x"]
        assert axis.end.voltage == pytest.approx(0.7 * v[-1], abs=1e-9)
        assert axis.start.voltage == pytest.approx(records[0].voltage["x"][0], abs=1e-9)
