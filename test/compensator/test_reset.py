"""Ramps, and the reset: after it the memory is the same whatever it was before."""

from dataclasses import replace
from itertools import groupby

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from strategies import FAMILY_CASE, axis_model, cases, fractions, paths, stream_forward

from slpi_ros.compensator.controller import Controller, OperatingMode, StopReason
from slpi_ros.compensator.motion import Ramp
from slpi_ros.compensator.persistence import ASSUMED, INTERRUPTED, KNOWN, RESETTING, MemoryConfidence
from slpi_ros.errors import UsageError
from slpi_ros.model.limits import Limits, RateLimiter, decaying_turns
from slpi_ros.model.stage_model import StageModel

LIMITS = Limits(0.0, 100.0)


def drive(ramp: Ramp, v: float, limits: Limits, dt: float = 0.01) -> list[float]:
    """Return the voltages of a whole ramp."""
    pace, way = RateLimiter(limits, dt, v), []
    pace.begin(0)
    while not ramp.done:
        v = ramp.next(pace, round((len(way) + 1) * dt * 1e9))
        way.append(v)
        assert len(way) < 100_000
    return way


@given(cases(), st.data(), fractions(0, 1), st.integers(1, 12))
def test_a_reset_leaves_the_same_memory_whatever_was_before(case, data, final, cycles):
    """Two stages of one kind that were driven differently, within the limits."""
    low, high = case.span
    limits = Limits(min(low, case.rest[0]), max(high, case.rest[0]))
    turns = decaying_turns(limits, limits.lower + final * (limits.upper - limits.lower), cycles)
    ends = []
    for _ in range(2):
        memory = case.memory()
        stream_forward(memory, data.draw(paths(case, limits.lower, limits.upper)))
        stream_forward(memory, np.array(turns))
        further = data.draw(st.just(None)) or np.linspace(limits.lower, limits.upper, 7)
        ends.append([memory.displacement, *stream_forward(memory, further), *stream_forward(memory, further[::-1])])
    scale = 1e-9 * case.width * case.slopes[1]
    np.testing.assert_allclose(ends[0], ends[1], rtol=0, atol=scale)


@given(fractions(0, 100), st.integers(1, 20))
def test_a_reset_decays_within_its_limits_to_its_end(final, cycles):
    turns = decaying_turns(LIMITS, final, cycles)
    assert turns[:2] == [100.0, 0.0] and turns[-1] == final
    assert min(turns) >= 0.0 and max(turns) <= 100.0
    distances = np.abs(np.array(turns[2:]) - final)
    for side in (distances[::2], distances[1::2]):
        assert (np.diff(side) <= 1e-12).all()
    assert distances[-3:].max() <= 100.0 / cycles + 1e-9


@pytest.mark.parametrize(("final", "cycles"), [(50.0, 0), (101.0, 5), (-1.0, 5), (np.nan, 5)])
def test_resets_that_make_no_sense(final, cycles):
    with pytest.raises(UsageError, match="^[^\n]+$"):
        decaying_turns(LIMITS, final, cycles)


@given(st.lists(fractions(-50, 150), min_size=1, max_size=6), st.sampled_from([np.inf, 4000.0]), fractions(20, 500))
def test_a_ramp_visits_its_goals_within_limits_at_its_rate(goals, acceleration, rate):
    limits = Limits(0.0, 100.0, 300.0, acceleration)
    # A step to where the voltage is already takes time, and changes nothing.
    goals = [goal for goal, _ in groupby(goals, limits.clip)]
    way = drive(Ramp(goals, rate), 40.0, limits)
    steps = np.abs(np.diff([40.0, *way]))
    # After a step without a change, two periods count.
    assert steps.max() <= 2.0 * min(rate, 0.8 * 300.0) * 0.01 + 1e-9
    assert min(way) >= 0.0 and max(way) <= 100.0
    reached = [limits.clip(goal) for goal in goals]
    found = iter(way)
    assert all(any(abs(v - goal) <= 1e-9 for v in found) for goal in reached), "each one, in order"
    assert way[-1] == pytest.approx(reached[-1], abs=1e-9)
    if acceleration < np.inf:
        rates = np.diff([40.0, 40.0, *way]) / 0.01
        assert np.abs(np.diff(rates)).max() <= acceleration * 0.01 + 1e-6


def test_a_ramp_takes_the_time_its_rate_tells():
    assert len(drive(Ramp([90.0, 40.0], 50.0), 40.0, LIMITS)) == 200


def test_a_late_step_of_a_ramp_makes_up_for_one_output_period_and_no_more():
    pace, ramp = RateLimiter(LIMITS, 0.01, 40.0), Ramp([90.0], 50.0)
    assert [ramp.next(pace, 0), ramp.next(pace, 7 * 10**9)] == [41.0, 42.0]


def test_ramps_are_planned_at_four_fifths_of_the_slew_limit():
    limits = Limits(0.0, 100.0, 100.0)
    assert len(drive(Ramp([80.0], 1e4), 0.0, limits)) == 100


def test_a_ramp_that_is_done_stays():
    ramp = Ramp([], 1.0)
    assert ramp.done and ramp.next(RateLimiter(LIMITS, 0.1, 33.0), 0) == 33.0


@pytest.mark.parametrize(("goals", "rate"), [([1.0], 0.0), ([1.0], -1.0), ([np.nan], 1.0), ([np.inf], 1.0)])
def test_ramps_that_lead_nowhere(goals, rate):
    with pytest.raises(UsageError, match="^[^\n]+$"):
        Ramp(goals, rate)


def test_the_reset_of_a_family_visits_the_widest_loop_first():
    memory = FAMILY_CASE.memory()
    stream_forward(memory, np.array([70.0, 20.0, 50.0]))
    stream_forward(memory, np.array(decaying_turns(LIMITS, 50.0, 4)))
    turns = memory.snapshot().turn_voltages
    assert turns == (100.0, 0.0, 87.5, 12.5, 75.0, 25.0, 62.5, 37.5)


# What the memory is worth then


def stage(voltage: float = 100.0) -> StageModel:
    """Return a model that was identified from 0 V to a voltage."""
    return StageModel({"x": replace(axis_model(FAMILY_CASE), voltage_range=(0.0, voltage))}, "", "")


def reset(limits: Limits, model: StageModel, swaps_to: StageModel | None = None, steps: int = 10**6) -> Controller:
    """Return a compensator whose memory has been reset, or driven for so many steps."""
    made = Controller(["x"], [limits])
    made.use_model(model)
    made.activate(0)
    made.reset_memory(2, 1000.0, [30.0], 0)
    for k in range(1, steps):
        assert made.axes[0].confidence.state == RESETTING
        made.advance(k * 10**7, 0)
        if made.mode is not OperatingMode.RESETTING:
            break
        if swaps_to and k == 10:
            made.use_model(swaps_to)
    assert made.mode is OperatingMode.STREAMING or steps < 10**6
    made.stop(StopReason.DEACTIVATED, steps * 10**7)
    return made


@pytest.mark.parametrize(("limits", "state"), [
    (LIMITS, KNOWN), (Limits(-5.0, 200.0), KNOWN), (Limits(0.5, 99.5), KNOWN), (Limits(0.0, 100.0, 300.0, 4e3), KNOWN),
    (Limits(20.0, 40.0), ASSUMED), (Limits(0.0, 98.0), ASSUMED), (Limits(2.0, 100.0), ASSUMED),
])  # fmt: skip
def test_only_a_drive_through_all_that_was_identified_makes_the_memory_known(limits, state):
    trust = reset(limits, stage()).axes[0].confidence
    assert trust.state == state
    if state == ASSUMED:
        assert all(f"{v:g}" in trust.doubt for v in (limits.lower, limits.upper, 100.0)) and "\n" not in trust.doubt
    else:
        assert trust.doubt == ""


def test_an_interrupted_reset_leaves_the_memory_assumed():
    assert reset(LIMITS, stage(), steps=5).axes[0].confidence == MemoryConfidence(ASSUMED, INTERRUPTED)


def test_a_new_model_knows_the_memory_only_where_it_was_wiped():
    wider, noisy, narrower = stage(120.0), stage(100.5), stage(90.0)
    limits = Limits(0.0, 200.0)
    for after, state in ((wider, ASSUMED), (noisy, KNOWN), (narrower, KNOWN)):
        made = reset(limits, stage())
        made.use_model(after)
        assert made.axes[0].confidence.state == state
        assert reset(limits, stage(), swaps_to=after).axes[0].confidence.state == state
    # What was not known cannot become so by a model.
    made = reset(Limits(0.0, 90.0), stage())
    made.use_model(narrower)
    assert made.axes[0].confidence.state == ASSUMED
