from collections.abc import Callable
from dataclasses import asdict, replace

import control
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.signal import cont2discrete, lfilter
from strategies import FAMILY_CASE, fractions

from slpi_ros.compensator.feedback import Feedback, PidGains
from slpi_ros.errors import UsageError
from slpi_ros.model.limits import MAX_DT, Limits, RateLimiter
from slpi_ros.model.streaming import StreamingInverse, nanoseconds

INF = float("inf")
NAN = float("nan")
FREE = Limits(-INF, INF)
STAGE = Limits(0.0, 100.0)
# A stage of 0.1 um/V.
GAIN = 1e-7
PID = PidGains(2e6, 4e7, 3e3, 0.02)
PI = replace(PID, derivative=0.0)
ONLY_I = PidGains(0.0, 4e7)


def made(gains: PidGains, limits: Limits, voltage: float = 0.0, **times: float) -> Feedback:
    feedback = Feedback(gains, RateLimiter(limits, MAX_DT / 2, voltage))
    for name, seconds in times.items():
        setattr(feedback, name, seconds)
    return feedback


def at(answer: Callable[..., float], t: float, *sample: float) -> float:
    """Return the voltage for a sample at a time in seconds; rate limits count from the last sample on."""
    feedback, now_ns = answer.__self__, nanoseconds(t)
    feedback.pace.begin(now_ns if feedback._last_ns == -INF else feedback._last_ns)
    return answer(now_ns, *sample)


def enabled(gains: PidGains = PID, limits: Limits = FREE, voltage: float = 0.0, **times: float) -> Feedback:
    feedback = made(gains, limits, voltage, **times)
    feedback.switch(True)
    return feedback


def taken_over(gains: PidGains = PID, limits: Limits = FREE, **times: float) -> Feedback:
    """Return a feedback that took over at 0 s, 0 m and 0 V, without error."""
    feedback = enabled(gains, limits, **times)
    at(feedback.correct, 0.0, 0.0, 0.0, 0.0)
    return feedback


gains_drawn = st.builds(
    PidGains, fractions(0, 1e7), fractions(0, 1e9), fractions(0, 1e5), st.just(0.0) | fractions(1e-4, 1)
)
steps_drawn = st.just(0.0) | fractions(1e-6, 1)
metres = fractions(-2e-5, 2e-5)
samples_drawn = st.tuples(steps_drawn, metres, metres, fractions(-30, 130))
ACTIONS = ("correct", "correct", "correct", "correct", "hold", "enable", "disable", "retune", "bad", "limits")


@st.composite
def scripts(draw: st.DrawFn) -> list[tuple[str, tuple[float, float, float, float], PidGains]]:
    """Draw what may happen to a feedback: actions, each at a sample (t, desired, measured, feedforward)."""
    t, script = draw(st.sampled_from((0.0, -3.0, 1.7e9))), []
    for action, (dt, *sample) in draw(st.lists(st.tuples(st.sampled_from(ACTIONS), samples_drawn), max_size=25)):
        t += dt
        script.append((action, (t, *sample), draw(gains_drawn) if action == "retune" else PID))
    return script


def act(feedback: Feedback, action: str, sample: tuple[float, float, float, float], gains: PidGains) -> None:
    t, desired, measured, feedforward = sample
    if action == "correct":
        at(feedback.correct, t, desired, measured, feedforward)
    elif action == "hold":
        at(feedback.hold, t, feedforward)
    elif action == "retune":
        feedback.retune(gains)
    elif action == "bad":
        with pytest.raises(UsageError):
            at(feedback.correct, t, desired, NAN, feedforward)
    elif action == "limits":
        feedback.pace.limits = replace(feedback.pace.limits, lower=feedforward - 20.0, upper=feedforward + 60.0)
    else:
        feedback.switch(action == "enable")


def play(feedback: Feedback, script: list[tuple[str, tuple[float, float, float, float], PidGains]]) -> float:
    """Play a script and return the time it ends."""
    for each in script:
        act(feedback, *each)
    return script[-1][1][0] if script else 0.0


# The control law, against independent ones.


@pytest.mark.parametrize("gains", [PI, PID, ONLY_I, PidGains(3e6), replace(PID, derivative_filter=0.0)])
def test_the_loop_is_that_of_linear_theory(gains):
    """Unsaturated, on a first-order plant: ``v = (feedforward + C desired) / (1 + (C + D) G)``."""
    dt, lag, count = 0.005, 0.03, 400
    plant = control.ss(-1.0 / lag, 1.0 / lag, GAIN, 0.0).sample(dt, method="zoh")
    pole = np.exp(-dt / gains.derivative_filter) if gains.derivative_filter else 0.0
    errors = control.ss(1.0, 1.0, gains.integral * dt, gains.proportional + gains.integral * dt, dt)
    rate = gains.derivative * (1.0 - pole) / dt
    rates = control.ss(pole, 1.0, rate * (pole - 1.0), rate, dt)
    loop = control.feedback(control.ss([], [], [], 1.0, dt), (errors + rates) * plant)

    rng = np.random.default_rng(7)
    desired = np.concatenate([[0.0], 1e-5 * rng.random(count - 1).round(1)])
    feedforward = np.concatenate([[0.0], desired[1:] / (1.3 * GAIN) + 5.0])
    t = dt * np.arange(count)
    expected = sum(
        control.forced_response(system, t, u).outputs for system, u in ((loop, feedforward), (loop * errors, desired))
    )

    feedback = enabled(gains)
    decay, y, voltages = np.exp(-dt / lag), 0.0, []
    for now, wish, given_to_plant in zip(t.tolist(), desired.tolist(), feedforward.tolist(), strict=True):
        voltages.append(at(feedback.correct, now, wish, y, given_to_plant))
        y = decay * y + (1.0 - decay) * GAIN * voltages[-1]
    assert np.ptp(voltages) > 50.0
    np.testing.assert_allclose(voltages, expected, rtol=0, atol=1e-9)


def test_the_filtered_derivative_is_that_of_a_line_between_samples():
    dt, y = 0.01, np.concatenate([[0.0], 1e-5 * np.random.default_rng(3).random(300)])
    numerator, denominator, _ = cont2discrete(([1.0, 0.0], [PID.derivative_filter, 1.0]), dt, "foh")
    expected = -PID.derivative * lfilter(numerator[0], denominator, y)
    feedback = enabled(PidGains(0.0, 0.0, PID.derivative, PID.derivative_filter))
    corrections = [at(feedback.correct, dt * i, 0.0, float(x), 0.0) for i, x in enumerate(y)]
    np.testing.assert_allclose(corrections, expected, rtol=0, atol=1e-9)


@given(
    st.lists(st.tuples(fractions(1e-3, 0.5), metres), min_size=1, max_size=8),
    st.lists(fractions(0.01, 0.99), max_size=4),
    fractions(1e-3, 1),
)
def test_samples_put_between_on_the_line_change_no_derivative(knots, shares, time_constant):
    gains = PidGains(0.0, 0.0, PID.derivative, time_constant)
    few, many = taken_over(gains), taken_over(gains)
    t, y = 0.0, 0.0
    for dt, goal in knots:
        for share in sorted(shares):
            at(many.correct, t + share * dt, 0.0, y + share * (goal - y), 0.0)
        t, y = t + dt, goal
        assert at(many.correct, t, 0.0, y, 0.0) == pytest.approx(at(few.correct, t, 0.0, y, 0.0), rel=1e-6, abs=1e-6)


def test_no_kick_when_the_desired_displacement_steps():
    for time_constant in (0.0, 0.02):
        feedback = taken_over(PidGains(0.0, 0.0, 1e4, time_constant))
        assert [at(feedback.correct, t, 1e-5, 0.0, 7.0) for t in (0.0, 1e-6, 0.1)] == [7.0] * 3
        assert at(feedback.correct, 0.2, 1e-5, 1e-6, 7.0) < 7.0 - 1e-3


@pytest.mark.parametrize("wrong", [0.8, 1.25])
def test_a_wrong_gain_leaves_no_error(wrong):
    """The stage is the model, but for its gain: what is left without feedback is gone with it."""
    desired, errors = 7e-6, {}
    for active in (False, True):
        stream = StreamingInverse(FAMILY_CASE.memory(), (2e-6, 14e-6), STAGE)
        stage, feedback = FAMILY_CASE.memory(), made(PI, STAGE, release_time=0.1)
        if active:
            feedback.switch(True)
        for i in range(1000):
            t = 0.005 * i
            measured = 2e-6 + wrong * (stage.displacement - 2e-6)
            stage.forward(at(feedback.correct, t, desired, measured, stream.step(t, desired)))
        errors[active] = abs(desired - measured)
    assert errors[False] > 0.9e-6
    assert errors[True] < 1e-12


# Limits.


@given(scripts(), st.just(INF) | fractions(1, 1e5), fractions(0, 100), gains_drawn)
def test_the_voltage_keeps_to_its_limits_and_their_slew(script, slew, start, gains):
    feedback = made(gains, Limits(0.0, 100.0, slew), start)
    before = None
    for action, sample, new_gains in script:
        voltage = feedback.pace.voltage
        act(feedback, action, sample, new_gains)
        limits = feedback.pace.limits
        if action not in ("correct", "hold"):
            assert feedback.pace.voltage == voltage
            continue
        # Time counts in whole nanoseconds; a pause counts no longer than 0.1 s.
        elapsed = min(sample[0] - before + 1e-9, MAX_DT) if before is not None else 0.0
        reach = slew * elapsed if slew < INF else INF
        assert abs(feedback.pace.voltage - voltage) <= reach + 1e-12 * 100
        # Outside of new limits it goes inside at full pace.
        outside, was_outside = (max(limits.lower - v, v - limits.upper, 0.0) for v in (feedback.pace.voltage, voltage))
        surely = reach - slew * 2e-9 if slew < INF else INF
        assert outside <= max(was_outside - surely, 0.0) + 1e-12 * 100
        before = sample[0]


@given(st.lists(samples_drawn, min_size=1), st.just(INF) | fractions(1, 1000), gains_drawn)
def test_a_disabled_feedback_gives_what_the_stream_gives(samples, slew, gains):
    limits = Limits(5.0, 80.0, slew)
    stream = StreamingInverse(FAMILY_CASE.memory(), (2e-6, 14e-6), limits)
    feedback, t = made(gains, limits, 5.0), 0.0
    for dt, share, measured, _ in samples:
        t += dt
        desired = 8e-6 + 0.4 * share
        assert at(feedback.correct, t, desired, measured, stream.step(t, desired)) == stream.voltage
        assert feedback.correction == 0.0


def saturated(gains: PidGains, limits: Limits, duration: float, target: float, back: float) -> list[float]:
    """Wish for `target` (m) for `duration` (s), then for `back`; return the voltages from then on."""
    feedback, y, voltages = taken_over(gains, limits), 0.0, []
    dt, ticks = 0.01, round(duration / 0.01)
    for i in range(1, ticks + 60):
        desired = target if i < ticks else back
        voltage = at(feedback.correct, i * dt, desired, y, min(max(desired / (1.2 * GAIN), limits.lower), limits.upper))
        voltages.append(voltage)
        y += (GAIN * voltage - y) * 0.3
    return voltages[ticks - 2 :]


@pytest.mark.parametrize("gains", [PID, PI, ONLY_I])
@pytest.mark.parametrize(("target", "limit"), [(1.6e-5, 100.0), (-1.6e-5, -50.0)])
def test_a_long_saturation_is_left_at_once(gains, target, limit):
    """And as from a short one: nothing was wound up meanwhile."""
    limits = Limits(-50.0, 100.0)
    short, long = (saturated(gains, limits, duration, target, 0.25 * target) for duration in (2.0, 500.0))
    assert short[0] == long[0] == limit
    assert abs(long[1]) < abs(limit) - 10.0
    np.testing.assert_allclose(long, short, rtol=0, atol=1e-6)


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize("at_start", [0.0, 1e-5, -1e-5])
def test_the_integral_goes_right_to_the_limit_and_back_at_once(sign, at_start):
    """Whatever the proportional part and the offset are meanwhile."""
    feedback, limit, dt = enabled(PI, Limits(-60.0, 60.0), release_time=1e6), sign * 60.0, 0.01
    at(feedback.correct, 0.0, at_start, 0.0, 0.0)
    for i in range(1, 40):
        voltage = at(feedback.correct, dt * i, sign * 1e-5, 0.0, 0.0)
    assert voltage == pytest.approx(limit, abs=1e-3)
    # The error goes down by 3 um but keeps its sign: the proportional part falls, the integral grows.
    down = -3e-6 * PI.proportional + 7e-6 * PI.integral * dt
    assert at(feedback.correct, 0.4, sign * 7e-6, 0.0, 0.0) == pytest.approx(limit + sign * down, abs=1e-3)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_slew_limit_neither_winds_the_integral_up_nor_makes_it_forget(sign):
    """The feedforward jumps far away; the voltage arrives there late, without overshoot, with the correction learnt."""
    slew, dt, offset = 20.0, 0.01, -6e-7
    feedback, y, t = taken_over(PI, Limits(-100.0, 100.0, slew), release_time=0.1), offset, 0.0

    def track(desired: float, seconds: float) -> list[float]:
        nonlocal y, t
        reached = []
        for _ in range(round(seconds / dt)):
            t += dt
            y = GAIN * at(feedback.correct, t, desired, y, desired / GAIN) + offset
            reached.append(y)
        return reached

    track(0.0, 5.0)
    learnt = feedback.correction
    assert learnt == pytest.approx(6.0, abs=1e-6)
    way = np.array(track(sign * 6e-6, 5.0))
    assert np.all(np.abs(np.diff(way)) <= GAIN * slew * dt * (1 + 1e-9))
    # On the way for three seconds: an integral wound up meanwhile would go on for micrometres.
    assert np.max(sign * way) < 6e-6 + 2 * GAIN * slew * dt
    assert np.all(np.abs(way[320:] - sign * 6e-6) < 1e-8)
    assert feedback.correction == pytest.approx(learnt, abs=0.1)


@pytest.mark.parametrize("acceleration", [INF, 1e3])
def test_a_voltage_outside_goes_inside_as_a_rate_limiter_lets_it_and_no_faster(acceleration):
    """One rule for feedforward and feedback: at the start, and within new limits."""
    outside = Limits(0.0, 40.0, 10.0, acceleration)
    feedback, pace, v = (
        made(PID, Limits(0.0, 100.0, 10.0, acceleration), 60.0),
        RateLimiter(outside, MAX_DT / 2, 60.0),
        60.0,
    )
    at(feedback.hold, 0.0, 60.0)
    pace.begin(0)
    feedback.pace.limits = outside
    for k in range(1, 30):
        v = pace.step(40.0, k * 10**8)
        assert at(feedback.hold, 0.1 * k, 60.0) == pytest.approx(v, abs=1e-9)
    assert v == pytest.approx(40.0, abs=1e-6)
    feedback = made(PID, Limits(0.0, 100.0, 10.0), 120.0)
    assert [at(feedback.hold, 0.1 * k, 50.0) for k in range(4)] == pytest.approx([120.0, 119.0, 118.0, 117.0])
    assert made(PID, STAGE, 120.0).hold(0.0, 50.0) == 50.0


# On, off and other gains.


SWITCHES = (("enable",), ("disable",), ("retune",), ("disable", "enable"), ("enable", "retune"))


@given(scripts(), samples_drawn, gains_drawn, gains_drawn, st.sampled_from(SWITCHES))
def test_no_switch_makes_the_voltage_jump(script, sample, gains, others, switch):
    """The same sample once more, right after the switch, is answered by the same voltage."""
    feedback = made(gains, STAGE, 20.0)
    t = play(feedback, script)
    feedback.pace.limits = STAGE
    now = (t + sample[0], *sample[1:])
    voltage = at(feedback.correct, *now)
    for action in switch:
        act(feedback, action, now, others)
    # Volts that cancel each other: the error is below 4e-5 m, the rate below 4e-5 m over 1e-6 s.
    volts = sum(4e-5 * g.proportional + 40.0 * g.derivative for g in (gains, others, PID)) + 1e3
    assert at(feedback.correct, *now) == pytest.approx(voltage, abs=1e-14 * volts * (len(script) + 2))


@given(scripts(), samples_drawn, st.lists(samples_drawn, min_size=1, max_size=5))
def test_while_enabled_feedback_waits_for_a_measurement_only_the_feedforward_moves_the_voltage(script, first, later):
    feedback = made(PID, FREE, release_time=0.5)
    script = [each for each in script if each[0] != "limits"]
    t = play(feedback, script) + first[0]
    feedback.switch(False)
    at(feedback.correct, t, *first[1:])
    correction = feedback.correction
    feedback.switch(True)
    for dt, *_, feedforward in later:
        t += dt
        assert at(feedback.hold, t, feedforward) == feedforward + correction
    # Whatever the error is now.
    assert at(feedback.correct, t + 0.1, *first[1:]) == first[3] + correction


def test_the_error_at_the_moment_of_enabling_comes_in_softly():
    release_time, error, dt = 0.4, 8e-6, 0.01
    feedback = made(PI, FREE, release_time=release_time, longest_gap=0.5)
    assert not feedback.enabled
    at(feedback.correct, 0.0, error, 0.0, 30.0)
    feedback.switch(True)
    assert feedback.enabled
    for i in range(1, 400):
        since = dt * (i - 1)
        proportional = PI.proportional * error * (1.0 - np.exp(-since / release_time))
        assert at(feedback.correct, dt * i, error, 0.0, 30.0) == pytest.approx(
            30.0 + proportional + PI.integral * error * since, abs=1e-9
        )


def test_the_derivative_is_ready_when_feedback_is_enabled():
    feedback, speed = made(PidGains(0.0, 0.0, 1e4, 0.3), FREE, release_time=INF), 1e-5
    for i in range(1000):
        if i == 500:
            feedback.switch(True)
        assert at(feedback.correct, 0.01 * i, 0.0, 0.01 * i * speed, 30.0) == pytest.approx(30.0, abs=1e-6)
    assert at(feedback.correct, 10.0, 0.0, 10.0 * speed + 1e-6, 30.0) < 30.0 - 1e-3


@given(st.lists(st.tuples(fractions(0, 0.1), st.booleans()), min_size=1, max_size=30), fractions(0.01, 10))
def test_disabled_the_correction_fades_with_the_release_time(samples, release_time):
    feedback = taken_over(PidGains(1e6), release_time=release_time)
    assert at(feedback.correct, 1.0, 9e-6, 0.0, 20.0) == pytest.approx(29.0)
    feedback.switch(False)
    assert not feedback.enabled
    t = 1.0
    for dt, measures in samples:
        # Times are whole nanoseconds.
        t = round(t + dt, 9)
        voltage = at(feedback.correct, t, 5e-6, 3e-6, 40.0) if measures else at(feedback.hold, t, 40.0)
        assert voltage == pytest.approx(40.0 + 9.0 * np.exp((1.0 - t) / release_time), abs=1e-12)


def test_what_no_voltage_showed_need_not_fade():
    """1000 V of correction are wished for, 40 V given; these fade."""
    feedback = taken_over(PidGains(1e8), STAGE, longest_gap=2.0, release_time=1.0)
    assert at(feedback.correct, 1.0, 1e-5, 0.0, 60.0) == 100.0
    assert feedback.correction == 40.0
    feedback.switch(False)
    assert at(feedback.hold, 2.0, 60.0) == pytest.approx(60.0 + 40.0 / np.e)


def test_a_feedforward_outside_the_limits_makes_no_correction():
    feedback = taken_over(PidGains(1e6), STAGE)
    assert at(feedback.correct, 1.0, 5e-6, 0.0, 120.0) == 100.0
    assert feedback.correction == 0.0
    assert at(feedback.correct, 1.0, -2.5e-5, 0.0, 120.0) == 95.0
    assert feedback.correction == -25.0


def test_enabling_what_is_enabled_and_disabling_what_is_not_change_nothing():
    feedback, twin = (taken_over() for _ in range(2))
    at(feedback.correct, 0.1, 1e-6, 0.0, 10.0)
    at(twin.correct, 0.1, 1e-6, 0.0, 10.0)
    feedback.switch(True)
    assert at(feedback.correct, 0.2, 2e-6, 0.0, 10.0) == at(twin.correct, 0.2, 2e-6, 0.0, 10.0)
    for _ in range(2):
        feedback.switch(False)
    twin.switch(False)
    assert at(feedback.hold, 0.25, 10.0) == at(twin.hold, 0.25, 10.0)


def test_other_gains_act_in_full_after_the_release_time():
    feedback = taken_over(PidGains(1e6), release_time=0.05)
    assert at(feedback.correct, 0.1, 1e-6, 0.0, 10.0) == 11.0
    feedback.retune(PidGains(5e6))
    assert feedback.gains == PidGains(5e6)
    voltages = [at(feedback.correct, 0.1 + 0.02 * i, 1e-6, 0.0, 10.0) for i in range(100)]
    assert voltages[0] == pytest.approx(11.0)
    assert np.all(np.diff(voltages) >= 0.0)
    assert voltages[-1] == pytest.approx(15.0)


def test_after_forgetting_the_next_measurement_takes_over_without_a_jump():
    feedback = taken_over(PidGains(1e6, 1e7))
    before = at(feedback.correct, 0.1, 3e-6, 0.0, 10.0)
    feedback.forget()
    assert at(feedback.hold, 0.1, 10.0) == before
    assert at(feedback.correct, 0.1, -5e-6, 2e-6, 10.0) == pytest.approx(before)
    assert at(feedback.correct, 5.0, 0.0, 0.0, 10.0) != pytest.approx(before)


def test_without_release_the_correction_stays():
    feedback = taken_over(PidGains(1e6), release_time=INF)
    at(feedback.correct, 0.1, 3e-6, 0.0, 10.0)
    feedback.switch(False)
    assert [at(feedback.hold, t, 10.0) for t in (0.2, 1e6)] == [13.0, 13.0]


# Time, and samples that lack something.


def test_without_measurement_the_correction_is_kept():
    feedback = taken_over()
    voltage = at(feedback.correct, 0.1, 3e-6, 1e-6, 10.0)
    assert [at(feedback.hold, t, 10.0 + t) for t in (0.1, 0.2, 5.0)] == pytest.approx(
        [voltage + t for t in (0.1, 0.2, 5)]
    )


@pytest.mark.parametrize("seconds", [0.03, 0.2, 3600.0])
@pytest.mark.parametrize("held", [False, True])
def test_a_gap_integrates_no_longer_than_allowed(seconds, held):
    feedback = taken_over(ONLY_I, longest_gap=0.2)
    if held:
        for share in (0.1, 0.5, 0.9):
            at(feedback.hold, share * seconds, 0.0)
    assert at(feedback.correct, seconds, 1e-6, 0.0, 0.0) == pytest.approx(40.0 * min(seconds, 0.2))


def test_a_gap_fades_no_longer_than_allowed():
    feedback = taken_over(PidGains(1e6), longest_gap=0.2, release_time=1.0)
    at(feedback.correct, 0.1, 1e-5, 0.0, 0.0)
    feedback.switch(False)
    assert at(feedback.hold, 3600.0, 0.0) == pytest.approx(10.0 * np.exp(-0.2))


def test_time_may_stand_still():
    feedback = taken_over(replace(PID, derivative_filter=0.0))
    at(feedback.correct, 0.1, 1e-6, 0.0, 10.0)
    state = feedback._integral, feedback._rate
    twin = taken_over(feedback.gains)
    at(twin.correct, 0.1, 1e-6, 0.0, 10.0)
    voltages = [at(feedback.correct, 0.1, 1e-6, y, 10.0) for y in (0.0, 4e-6, 0.0, -4e-6) * 50]
    assert (feedback._integral, feedback._rate) == state
    assert voltages[0] == voltages[-2]
    assert voltages[1] == pytest.approx(voltages[0] - 4e-6 * PID.proportional)
    # The next slope is that from the first measurement of the instant.
    assert at(feedback.correct, 0.2, 1e-6, 2e-6, 10.0) == at(twin.correct, 0.2, 1e-6, 2e-6, 10.0)


BAD = [
    (0.9, 1e-6, 0.0, 10.0),
    (2.0, NAN, 0.0, 10.0), (2.0, INF, 0.0, 10.0), (2.0, 1e-6, NAN, 10.0), (2.0, 1e-6, INF, 10.0),
    (2.0, INF, INF, 10.0), (2.0, 1e-6, 0.0, NAN), (2.0, 1e-6, 0.0, -INF),
    (2.0, 1e308, -1e308, 10.0), (2.0, 1e303, 0.0, 10.0), (2.0, 1e-6, 1e305, 10.0),
]  # fmt: skip


@pytest.mark.parametrize("active", [True, False])
@pytest.mark.parametrize("sample", BAD)
def test_samples_that_make_no_sense_move_nothing(sample, active):
    feedback = taken_over()
    at(feedback.correct, 1.0, 2e-6, 1e-6, 10.0)
    if not active:
        feedback.switch(False)
    before = dict(vars(feedback))
    with pytest.raises(UsageError, match="^[^\n]+$"):
        at(feedback.correct, *sample)
    assert vars(feedback) == before


@pytest.mark.parametrize("sample", [sample for sample in BAD if sample[1:3] == (1e-6, 0.0)])
def test_held_samples_that_make_no_sense_move_nothing(sample):
    feedback = taken_over()
    at(feedback.correct, 1.0, 2e-6, 1e-6, 10.0)
    before = dict(vars(feedback))
    with pytest.raises(UsageError, match="^[^\n]+$"):
        at(feedback.hold, sample[0], sample[3])
    assert vars(feedback) == before


def test_voltages_beyond_all_numbers_move_nothing():
    feedback = taken_over(PidGains(1e300, 1e295))
    before = dict(vars(feedback))
    with pytest.raises(UsageError, match=r"1e\+308 V"):
        at(feedback.correct, 1.0, 1e8, 0.0, 1e308)
    assert vars(feedback) == before


@given(scripts())
def test_the_same_samples_give_the_same_voltages(script):
    one, other = made(PID, STAGE), made(PID, STAGE)
    play(one, script)
    play(other, script)
    states = [{**vars(each), "pace": (each.pace.limits, each.pace.rate)} for each in (one, other)]
    assert states[0] == states[1]


# What makes no controller.


@pytest.mark.parametrize("name", [name for name in asdict(PID) if name != "notches"])
@pytest.mark.parametrize("value", [-1e-9, NAN, INF])
def test_gains_that_make_no_sense(name, value):
    with pytest.raises(UsageError, match=f"^PID gain {name} is [^\n]+$"):
        replace(PID, **{name: value})


@pytest.mark.parametrize("voltage", [NAN, INF])
def test_a_start_that_makes_no_sense(voltage):
    with pytest.raises(UsageError, match="^voltage[^\n]+$"):
        made(PID, STAGE, voltage)


def test_gains_beyond_reason_are_refused_at_run_time():
    feedback = taken_over()
    at(feedback.correct, 1.0, 1e3, 0.0, 10.0)
    before = dict(vars(feedback))
    with pytest.raises(UsageError, match=r"1e\+306"):
        feedback.retune(PidGains(1e306))
    assert vars(feedback) == before
