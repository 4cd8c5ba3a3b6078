from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from strategies import FAMILY_CASE, Case, cases, fractions, paths

from slpi_ros.errors import UnreachableError, UsageError
from slpi_ros.hysteresis.loop_family import LoopFamily
from slpi_ros.hysteresis.prandtl_ishlinskii import PrandtlIshlinskii
from slpi_ros.hysteresis.turning_points import Memory
from slpi_ros.model.limits import MAX_DT, Limits, RateLimiter
from slpi_ros.model.streaming import ROUNDING, TOLERATED_SHARE, StreamingInverse

RANGE = (2e-6, 14e-6)


def stream_of(
    case: Case = FAMILY_CASE, limits: Limits | None = None, reach: tuple[float, float] = RANGE
) -> StreamingInverse:
    return StreamingInverse(case.memory(), reach, limits or Limits(0.0, 100.0))


@st.composite
def streams(draw: st.DrawFn, slew: st.SearchStrategy[float]) -> tuple[Case, Limits, list[tuple[float, float]]]:
    """Draw limits, and samples (s, m) in order."""
    case = draw(cases())
    low, high = sorted(draw(st.tuples(fractions(-0.1, 1.1), fractions(-0.1, 1.1))))
    limits = Limits(case.span[0] + low * case.width, case.span[0] + high * case.width, draw(slew))
    y = case.displacements(draw(paths(case))).tolist()
    steps = draw(st.lists(fractions(0, 0.5), min_size=1, max_size=9))
    t = draw(st.sampled_from((0.0, -3.0, 1.7e9))) + np.cumsum([steps[i % len(steps)] for i in range(len(y))])
    return case, limits, list(zip(t.tolist(), y, strict=True))


def everywhere(case: Case) -> tuple[float, float]:
    reach = 100 * case.width * case.slopes[1]
    return case.rest[1] - reach, case.rest[1] + reach


@given(streams(st.just(np.inf)))
def test_without_slew_limit_the_stream_is_the_inverse_within_limits(drawn):
    case, limits, samples = drawn
    stream, memory = stream_of(case, limits, everywhere(case)), case.memory()
    memory.forward(min(max(memory.voltage, limits.lower), limits.upper))
    for t, y in samples:
        v = stream.step(t, y)
        assert v == memory.inverse(y, limits.lower, limits.upper) == stream.voltage
        assert limits.lower <= v <= limits.upper


# At the lower limit, where the inverse of the displacement at rest is that limit but for its last digits.
LOW = 2.4e-5
EVERETT = np.array([[0.0, 0.0, 0.0], [1.5e-6, 0.0, 0.0], [3e-6, 1.5e-6, 0.0]])
RAMP = LoopFamily(np.array([LOW, 15.000024, 30.000024]), EVERETT, np.array([0.0, 1.5e-6, 3e-6]), 1e-7)
AT_THE_LIMIT = (
    Case(RAMP, (LOW, 9e-7), True, (LOW, 30.000024), (LOW, 15.000024, 30.000024)),
    Limits(LOW, 30.000024, 1.0),
    [(0.0, -3e-7), (0.5, 5.099999999999999e-06), (0.5, 9e-7)],
)


@given(streams(fractions(1, 1000)))
@example(AT_THE_LIMIT)
def test_with_a_slew_limit_the_voltage_keeps_to_it_and_the_memory_to_the_voltage(drawn):
    case, limits, samples = drawn
    stream, twin = stream_of(case, limits, everywhere(case)), case.memory()
    before, voltage = samples[0][0], stream.voltage
    assert limits.lower <= voltage <= limits.upper
    twin.forward(voltage)
    for t, y in samples:
        v = stream(t, y)
        assert limits.lower <= v <= limits.upper
        # Time counts in whole nanoseconds.
        assert abs(v - voltage) <= limits.slew * (t - before + 1e-9) + 1e-12 * max(1.0, abs(v))
        assert abs(twin.forward(v) - stream.memory.displacement) < 1e-9 * case.height
        before, voltage = t, v
    # Given time, it gets where it would have been told to go at once.
    for _ in range(int(2 * case.width / (limits.slew * MAX_DT)) + 2):
        t += MAX_DT
        there = stream.step(t, y)
    assert stream.step(t + 1, y) == pytest.approx(there, abs=1e-9 * case.width)
    assert there == pytest.approx(twin.inverse(y, limits.lower, limits.upper), abs=1e-9 * case.width)


def test_at_the_first_sample_the_voltage_stays_and_catches_up_from_there():
    stream = stream_of(limits=Limits(0.0, 100.0, 50.0))
    goal = stream_of().step(0.0, 10e-6)
    assert goal > 70
    # A pause counts no longer than 0.1 s.
    times = (7.0, 7.06, 7.06, 7.1, 9.0)
    assert [stream.step(t, 10e-6) for t in times] == pytest.approx([0.0, 3.0, 3.0, 5.0, 10.0])
    assert [stream.step(9.1 + 0.1 * k, 10e-6) for k in range(20)][-1] == pytest.approx(goal)


def test_a_wish_that_has_been_met_for_long_earns_no_time():
    """At 1 kHz the next one moves the voltage by what the slew limit allows in 1 ms."""
    stream = stream_of(limits=Limits(0.0, 100.0, 50.0))
    for k in range(3000):
        before = stream.step(1e-3 * k, 3e-6)
    assert not stream.missed
    assert stream.step(3.0, 10e-6) - before == pytest.approx(0.05)


def test_without_slew_limit_the_first_sample_is_met_at_once():
    stream = stream_of()
    v = stream.step(0.0, 10e-6)
    memory = FAMILY_CASE.memory()
    assert memory.forward(v) == pytest.approx(10e-6, abs=1e-15)


@pytest.mark.parametrize(("limits", "voltage"), [((10.0, 90.0), 10.0), ((-50.0, -20.0), -20.0), ((-5.0, 5.0), 0.0)])
def test_an_axis_that_rests_outside_its_limits_goes_inside_first(limits, voltage):
    stream = stream_of(limits=Limits(*limits))
    assert stream.voltage == voltage
    assert not stream.held
    twin = FAMILY_CASE.memory()
    assert twin.forward(voltage) == stream.memory.displacement


def test_a_slewing_axis_never_leaves_its_limits_by_rounding():
    stream = stream_of(limits=Limits(0.1, 0.7, 0.3))
    for i in range(100):
        assert 0.1 <= stream.step(0.1 * i, (14e-6, 2e-6)[i // 10 % 2]) <= 0.7


@pytest.mark.parametrize("sample", [
    (np.nan, 5e-6), (np.inf, 5e-6), (-np.inf, 5e-6), (2.0, np.nan), (2.0, np.inf), (2.0, -np.inf), (0.5, 5e-6),
])  # fmt: skip
def test_samples_that_make_no_sense_move_nothing(sample):
    refused(sample, UsageError)


margin = TOLERATED_SHARE * (RANGE[1] - RANGE[0])


@pytest.mark.parametrize("y", [RANGE[0] - 1.01 * margin, RANGE[1] + 1.01 * margin, 10.0, -1e300])
def test_wishes_far_out_of_range_move_nothing(y):
    refused((2.0, y), UnreachableError)


def refused(sample, error):
    stream, twin = stream_of(limits=Limits(0.0, 100.0, 20.0)), stream_of(limits=Limits(0.0, 100.0, 20.0))
    for one in (stream, twin):
        one.step(0.0, 4e-6)
        one.step(1.0, 4e-6)
    for method in (stream.check, stream.step):
        with pytest.raises(error, match="^[^\n]+$"):
            method(*sample)
        assert stream.memory.snapshot() == twin.memory.snapshot()
    # Time has not moved on either.
    assert stream.step(1.5, 8e-6) == twin.step(1.5, 8e-6)


def test_wishes_just_out_of_range_are_held():
    stream = stream_of()
    assert stream.step(0.0, RANGE[1] + 0.99 * margin) == 100.0
    assert stream.held
    assert stream.step(1.0, RANGE[0] - 0.99 * margin) == 0.0
    assert stream.held
    stream.step(2.0, 8e-6)
    assert not stream.held
    twin = FAMILY_CASE.memory()
    twin.forward(100.0)
    twin.forward(0.0)
    assert stream.voltage == twin.inverse(8e-6)


def test_what_is_met_is_not_held():
    """The axis rests at its limit, and may be asked to stay."""
    stream = stream_of()
    assert not stream.held
    assert stream.step(0.0, 2e-6) == 0.0
    assert not stream.held


@pytest.mark.parametrize("limits", [Limits(0.0, 100.0, 50.0), Limits(0.0, 100.0, 50.0, 1e3)])
@pytest.mark.parametrize("within", [True, False])
def test_an_axis_that_leaves_its_limit_as_fast_as_it_may_is_not_held(limits, within):
    """Neither is one on its way to a limit: only there, and if the wish lies beyond it."""
    stream = stream_of(limits=limits)
    for k in range(400):
        v = stream.step(0.01 * k, 10e-6 if within else 16e-6)
        assert stream.held == (v > 100.0 - 1e-7)
    assert stream.missed != within and stream.held != within
    assert v - 9.0 < stream.step(4.0, 6e-6) <= v and stream.missed and not stream.held


# Limits closer to each other than rounding.
@example(
    (
        Case(PrandtlIshlinskii(np.array([0.0, 1.0]), np.array([1e-7, 0.0])), (-50.0, 0.0), False, (-50.0, 50.0), ()),
        Limits(-50.0 - 1.3e-9, -50.0, 1.0),
        [(0.0, -4e-6), (0.0, -4e-6)],
    )
)
@given(streams(st.just(np.inf) | fractions(1, 1000)))
def test_held_is_what_would_stay_however_fast_it_might_go(drawn):
    case, limits, samples = drawn
    stream = stream_of(case, limits, everywhere(case))
    for t, y in samples:
        v = stream.step(t, y)
        if stream.missed:
            fastest = stream.copy().memory.inverse(y, limits.lower, limits.upper)
            # Voltages that differ by no more than rounding, as those between very narrow limits, are one voltage.
            assert stream.held == (abs(fastest - v) <= ROUNDING * (1.0 + abs(fastest)))
        else:
            assert not stream.held


def test_check_agrees_with_step_on_what_no_voltage_reaches():
    """A range as wide as that is in no record, but may be in a document."""
    flat = Case(PrandtlIshlinskii(np.array([0.0]), np.array([1e-9])), (0.0, 0.0), False, (0.0, 100.0), ())
    stream = StreamingInverse(flat.memory(), (-10.0, 10.0), Limits(-np.inf, np.inf))
    before = stream.memory.snapshot()
    with pytest.raises(UsageError):
        stream.step(5.0, 9.0)
    assert stream.memory.snapshot() == before
    stream.step(1.0, 1e-9)


def test_time_may_stand_still():
    stream = stream_of()
    assert stream.step(1.0, 5e-6) != stream.step(1.0, 6e-6)


@pytest.mark.parametrize(
    "limits", [(1.0, 0.0), (np.nan, 1.0), (0.0, np.nan), (0.0, 1.0, 0.0), (0.0, 1.0, -5.0), (0.0, 1.0, np.nan)]
)
def test_limits_that_leave_nothing(limits):
    with pytest.raises(UsageError, match="^[^\n]+$"):
        Limits(*limits)


def test_limits_are_narrowed_never_widened():
    limits = Limits(0.0, 100.0, 30.0)
    assert limits.within((-20.0, 60.0)) == Limits(0.0, 60.0, 30.0)
    assert limits.within((20.0, 160.0)) == Limits(20.0, 100.0, 30.0)
    assert limits.within((100.0, 160.0)) == Limits(100.0, 100.0, 30.0)
    for apart in (-9.0, -1.0), (101.0, 120.0):
        with pytest.raises(UsageError, match=rf"^[^\n]*{apart[0]:g}[^\n]*{apart[1]:g}[^\n]+$"):
            limits.within(apart)


def test_a_single_voltage_is_a_limit_too():
    stream = stream_of(limits=Limits(40.0, 40.0))
    assert [stream.step(float(i), y) for i, y in enumerate((2e-6, 14e-6, 6e-6))] == [40.0] * 3
    assert isinstance(stream.memory, Memory)


@pytest.mark.parametrize("acceleration", [0.0, -1.0, np.nan])
def test_an_acceleration_that_leaves_nothing(acceleration):
    with pytest.raises(UsageError, match="^[^\n]+$"):
        Limits(0.0, 1.0, acceleration=acceleration)


GENTLE = Limits(0.0, 100.0, 300.0, 5000.0)
STEPS = st.lists(fractions(2e-3, 0.1), min_size=1, max_size=7)


def gently(pace: RateLimiter, v: float, goals: list[float], steps: list[float]) -> Iterator[tuple[int, float]]:
    """Yield time (ns) and voltage (V); check what a pace promises of every step."""
    now_ns, rate, limits = 0, 0.0, pace.limits
    pace.start(v)
    pace.begin(now_ns)
    for i, goal in enumerate(goals):
        step_ns = round(steps[i % len(steps)] * 1e9)
        dt, now_ns = step_ns * 1e-9, now_ns + step_ns
        before, v = v, pace.step(goal, now_ns)
        pace.begin(now_ns)
        assert limits.lower <= v <= limits.upper
        assert abs(v - before) <= limits.slew * dt * (1 + 1e-9) + 1e-12
        assert abs((v - before) / dt - rate) <= limits.acceleration * dt * (1 + 1e-9) + 1e-9
        rate = (v - before) / dt
        yield now_ns, v


@given(st.lists(fractions(-50, 150), min_size=1, max_size=30), STEPS)
def test_a_gentle_pace_keeps_all_limits_wherever_it_is_told_to_go(goals, steps):
    """Goals jump and turn, far outside the limits too; every one stays for a few samples."""
    list(gently(RateLimiter(GENTLE, MAX_DT / 2), 40.0, [goal for goal in goals for _ in range(5)], steps))


@given(fractions(0, 100), STEPS)
def test_a_gentle_pace_comes_to_rest_at_its_goal_without_overshoot(goal, steps):
    way = [v for _, v in gently(RateLimiter(GENTLE, MAX_DT / 2), 40.0, [goal] * 400, steps)]
    assert way[-1] == pytest.approx(goal, abs=1e-9)
    towards = np.diff(way) * np.sign(goal - 40.0)
    assert towards.min(initial=0.0) >= -1e-12


@given(fractions(0.5, 20), fractions(1e-3, 5e-3))
def test_a_gentle_stream_follows_a_path_within_its_limits_exactly(omega, dt):
    """A sine of voltages, begun at rest at its lowest point, whose slew and acceleration are allowed."""
    t = np.arange(0.0, 0.7, dt)
    v = 50.0 - min(49.0, 0.9 * 300.0 / omega, 0.9 * 5000.0 / omega**2) * np.cos(omega * t)
    twin = FAMILY_CASE.memory()
    y = [twin.forward(x) for x in v.tolist()]
    stream = stream_of(limits=GENTLE)
    stream.drive(v[0])
    answers = [stream.step(*sample) for sample in zip(t.tolist(), y, strict=True)]
    np.testing.assert_allclose(answers, v, rtol=0, atol=1e-9)


@given(streams(st.sampled_from([np.inf, 300.0])), fractions(100, 1e5))
def test_a_gentle_stream_keeps_to_its_limits_and_the_memory_to_the_voltage(drawn, acceleration):
    case, limits, samples = drawn
    # Time counts in whole nanoseconds.
    samples = [(round(t * 1e9) / 1e9, y) for t, y in samples]
    limits = replace(limits, acceleration=acceleration)
    stream, twin = stream_of(case, limits, everywhere(case)), case.memory()
    v, rate, before, doubt = stream.voltage, 0.0, samples[0][0], 0.0
    twin.forward(v)
    for t, y in samples:
        last, v, dt = v, stream.step(t, y), t - before
        if round(dt * 1e9) > round(MAX_DT * 1e9):
            # After a pause it starts from rest.
            dt, rate, doubt = MAX_DT / 2, 0.0, 0.0
        assert limits.lower <= v <= limits.upper
        # Time counts in whole nanoseconds.
        assert abs(v - last) <= (limits.slew if limits.slew < np.inf else 1e6) * (dt + 1e-9) if dt else v == last
        if dt:
            # So the rate of a short step is not known better than this.
            slack = (2 * acceleration * dt + abs(rate)) * 1e-9 + doubt * dt + 1e-9
            assert abs(v - last - rate * dt) <= acceleration * dt**2 + slack
            rate = (v - last) / dt
            doubt = abs(rate) * 1e-9 / dt
        assert abs(twin.forward(v) - stream.memory.displacement) < 1e-9 * case.height
        before = t


def test_a_gentle_stream_reaches_a_far_wish_and_stays_there():
    stream, quick = stream_of(limits=GENTLE), stream_of()
    goal = quick.step(0.0, 10e-6)
    way = [stream.step(i * 1e-3, 10e-6) for i in range(600)]
    assert max(way) <= goal + 1e-9
    assert way[-1] == pytest.approx(goal, abs=1e-9)
    assert stream.memory.depth == quick.memory.depth


@pytest.mark.parametrize(("present", "expected"), [(60.0, 55.0), (52.0, 50.0), (10.0, 15.0), (38.0, 40.0)])
def test_a_voltage_outside_new_limits_goes_inside_at_full_pace(present, expected):
    pace = RateLimiter(Limits(40.0, 50.0, 500.0), 0.005, present)
    assert pace.step(present, 0) == pytest.approx(expected)
