"""The rate limiter by itself: what the output may do next, whatever it was asked to do and whenever."""

from dataclasses import replace
from math import inf, sqrt

import pytest
from hypothesis import given
from hypothesis import strategies as st
from strategies import fractions

from slpi_ros.effects.excitation import MEAN_SPEED
from slpi_ros.model.limits import PERIOD, Limits, RateLimiter, StageLimiter

MS = 1_000_000
LIMITS = Limits(0.0, 100.0, 20.0)


@pytest.mark.parametrize(("elapsed_ns", "counted"), [
    (-MS, 0.0), (0, 0.0), (1, 1e-9), (MS, 1e-3), (2 * MS, 2e-3), (2 * MS + 1, 2e-3), (10**10, 2e-3),
])  # fmt: skip
def test_the_time_since_the_last_change_counts_up_to_two_output_periods(elapsed_ns, counted):
    limiter = RateLimiter(LIMITS, PERIOD, 50.0)
    limiter.step(90.0, 10**12)
    before = limiter.voltage
    assert limiter.elapsed(10**12 + elapsed_ns) == pytest.approx(counted, abs=1e-15)
    assert limiter.step(90.0, 10**12 + elapsed_ns) == pytest.approx(before + 20.0 * counted, abs=1e-12)


def test_a_goal_that_is_asked_for_again_and_again_earns_no_time():
    """Only changes count: a hundred messages within a period move the voltage by what one does."""
    limiter = RateLimiter(LIMITS, PERIOD, 50.0)
    way = [limiter.step(90.0, 10**9 + k * 10_000) for k in range(1, 101)]
    assert way[-1] - 50.0 == pytest.approx(20.0 * (2e-3 + 0.99e-3))


@pytest.mark.parametrize(("present", "expected"), [
    # Within: down and up by the slew, clamped at the limits.
    (50.0, (48.0, 52.0)), (1.0, (0.0, 3.0)), (99.0, (97.0, 100.0)),
    # Outside: inside at the full rate, and not beyond the limit on the other side.
    (-5.0, (-3.0, -3.0)), (105.0, (103.0, 103.0)), (-1.0, (0.0, 1.0)), (101.0, (99.0, 100.0)),
])  # fmt: skip
def test_the_reach_is_clamped_to_the_limits(present, expected):
    limiter = RateLimiter(LIMITS, 0.05, present)
    assert limiter.reach(0) == pytest.approx(expected)
    assert limiter.limit(-1e3, 0) == pytest.approx(expected[0])
    assert limiter.limit(1e3, 0) == pytest.approx(expected[1])
    assert limiter.voltage == present
    assert limiter.move(1e3, 0) == pytest.approx(expected[1])


def test_without_a_rate_limit_the_limits_alone_count():
    limiter = RateLimiter(Limits(-3.0, 7.0), PERIOD, 50.0)
    assert limiter.reach(0) == (-3.0, 7.0)
    assert limiter.step(6.0, 0) == 6.0


STEPS_NS = st.one_of(st.integers(0, 5 * MS), st.sampled_from([0, 1, MS, 2 * MS, 10**9]))
BOUNDS = st.builds(
    lambda low, width, slew, acceleration: Limits(low, low + width, slew, acceleration),
    fractions(-20, 40), fractions(5, 100), fractions(10, 5000), st.just(inf) | fractions(1e3, 1e6),
)  # fmt: skip
EVENTS = st.lists(st.one_of(st.tuples(STEPS_NS, fractions(-50, 150)), BOUNDS, fractions(2e-4, 5e-3)), max_size=60)


@given(BOUNDS, fractions(-20, 140), EVENTS)
def test_whatever_happens_the_output_keeps_its_limits(limits, present, events):
    """Written from the definitions: the largest of all limits and periods since it last stood still."""
    limiter, now_ns, changed_ns = RateLimiter(limits, PERIOD, present), 10**12, None
    force, period = [(limits, PERIOD)], PERIOD
    v, rate = present, 0.0
    for event in events:
        if isinstance(event, Limits | float):
            limits, period = (event, period) if isinstance(event, Limits) else (limits, event)
            force.append((limits, period))
            limiter.change(limits, period)
            assert limiter.voltage == v
            continue
        now_ns += event[0]
        longest = max(each for _, each in force)
        gap = inf if changed_ns is None else (now_ns - changed_ns) * 1e-9
        if gap > 2.0 * longest:
            rate, force = 0.0, force[-1:]
        moving = rate != 0.0 and any(each.acceleration < inf for each, _ in force)
        if not moving:
            rate, force = 0.0, force[-1:]
        after = limiter.step(event[1], now_ns)
        step = after - v
        # Moving outwards is for braking only.
        low, high = min(each.lower for each, _ in force), max(each.upper for each, _ in force)
        assert min(low, v) - 1e-9 <= after <= max(high, v) + 1e-9
        assert abs(step) <= max(max(each.slew, abs(rate)) * min(gap, 2.0 * p) for each, p in force) + 1e-9
        acceleration = max(each.acceleration for each, _ in force)
        if acceleration < inf:
            dt = gap if gap <= 2.0 * longest else max(p for _, p in force)
            assert abs(step - rate * dt) <= acceleration * dt**2 * (1 + 1e-9) + 1e-9
            rate = step / dt if dt else rate
            if step or moving:
                changed_ns = now_ns
        elif step:
            changed_ns = now_ns
        v = after


@given(fractions(1, 99), fractions(50, 2000), st.just(inf) | fractions(2e3, 1e6))
def test_the_goal_is_reached_without_overshoot_and_as_fast_as_allowed(goal, slew, acceleration):
    limiter = RateLimiter(Limits(0.0, 100.0, slew, acceleration), PERIOD, 40.0)
    way = [limiter.step(goal, k * MS) for k in range(1, 4000)]
    assert way[-1] == pytest.approx(goal, abs=1e-9)
    low, high = min(goal, 40.0), max(goal, 40.0)
    assert min(way) >= low - 1e-9 and max(way) <= high + 1e-9
    distance = abs(goal - 40.0)
    fastest = distance / slew
    if acceleration < inf:
        peak = min(slew, sqrt(acceleration * distance))
        fastest = distance / peak + peak / acceleration
    first = next(k for k, v in enumerate(way, 1) if abs(v - goal) <= 1e-3 * distance + 1e-9)
    assert first <= 1.2 * fastest / PERIOD + 12


def test_lower_limits_wait_until_a_moving_axis_has_stopped_within_the_old_ones():
    """A change of `acceleration` while it moves broke the limit by a factor of ten."""
    gentle = Limits(0.0, 100.0, 500.0, 2000.0)
    limiter = RateLimiter(gentle, PERIOD, 10.0)
    for k in range(200):
        limiter.step(90.0, k * MS)
    assert limiter.rate == pytest.approx(400.0, rel=0.02)
    harder = replace(gentle, upper=limiter.voltage + 1.0, acceleration=200.0)
    limiter.limits = harder
    assert limiter.limits == gentle
    before, rates = limiter.voltage, [limiter.rate]
    for k in range(200, 1500):
        after = limiter.step(90.0, k * MS)
        rates.append((after - before) / PERIOD)
        before = after
        if limiter.limits == harder:
            break
    assert limiter.limits == harder and not limiter.in_motion
    assert max(abs(b - a) for a, b in zip(rates, rates[1:], strict=False)) <= 2000.0 * PERIOD * (1 + 1e-6)
    # Then back inside, within the new ones.
    assert before > harder.upper
    for k in range(1500, 6000):
        after = limiter.step(90.0, k * MS)
        assert abs((after - before) / PERIOD - rates[-1]) <= 200.0 * PERIOD * (1 + 1e-6) + 1e-6
        rates.append((after - before) / PERIOD)
        before = after
    assert before == pytest.approx(harder.upper, abs=1e-6)


def test_a_start_is_at_rest_and_takes_new_limits_at_once():
    limiter = RateLimiter(Limits(0.0, 100.0, 500.0, 2000.0), PERIOD, 10.0)
    for k in range(50):
        limiter.step(90.0, k * MS)
    limiter.change(LIMITS, 0.01)
    limiter.start(70.0)
    assert (limiter.voltage, limiter.rate, limiter.limits, limiter.period) == (70.0, 0.0, LIMITS, 0.01)
    assert limiter.step(0.0, 51 * MS) == pytest.approx(70.0 - 20.0 * 0.02)


def test_copies_go_their_own_ways():
    limiter = RateLimiter(LIMITS, PERIOD, 10.0)
    twin = limiter.copy()
    twin.step(50.0, 0)
    assert limiter.voltage == 10.0 and twin.voltage > 10.0


def test_all_axes_of_a_stage_keep_their_own_limits():
    stage = StageLimiter([LIMITS, Limits(-10.0, 10.0)], PERIOD)
    stage.start([50.0, 5.0])
    assert stage.voltages == (50.0, 5.0) and stage.within(stage.voltages, (50.0, 5.0), 0.0)
    assert stage.step((90.0, 20.0), 10**12) == (pytest.approx(50.0 + 20.0 * 2 * PERIOD), 10.0)
    assert stage.within((51.0, 9.8), (50.0, 10.0), 0.01) and not stage.within((51.1, 10.0), (50.0, 10.0), 0.01)
    with pytest.raises(ValueError, match="zip"):
        stage.step((1.0,), 10**12)


def test_gently_an_axis_without_a_slew_limit_moves_at_a_moderate_rate():
    assert LIMITS.gentle == 20.0 and Limits(-10.0, 10.0).gentle == pytest.approx(20.0 * MEAN_SPEED)
    stage = StageLimiter([LIMITS, Limits(-10.0, 10.0)], PERIOD)
    stage.start([50.0, 5.0])
    slow, moderate = stage.step((0.0, -10.0), 10**12, gently=True)
    assert slow == pytest.approx(50.0 - 20.0 * 2 * PERIOD) and moderate == pytest.approx(5.0 - 16.0 * 2 * PERIOD)
