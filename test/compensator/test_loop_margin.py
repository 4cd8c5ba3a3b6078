"""The loop as it is built: stable or not as its course over time shows, margins, and the gains that would do."""

from dataclasses import replace
from math import ceil, inf, pi

import numpy as np
import pytest
from strategies import PI_CASE, axis_model

from slpi_ros.compensator.feedback import Feedback, PidGains
from slpi_ros.compensator.loop_filter import Notch
from slpi_ros.compensator.loop_margin import LEAST_MARGIN, DiscreteLoop, Plant, refusal
from slpi_ros.effects.contact import Contact
from slpi_ros.effects.delay import Delay
from slpi_ros.effects.filters import AT_ONCE, Dynamics, Mode, first_order
from slpi_ros.effects.lag import Lag
from slpi_ros.effects.resonance import Resonance
from slpi_ros.model.limits import Limits, RateLimiter
from slpi_ros.model.sensor import Sensor

SLOPE, T = 1e-7, 1e-3
# Steps of the simulation in a period; every delay below is a whole number of these.
FINE = 8


def growth(loop: DiscreteLoop, seconds: float) -> float:
    """Return how much a small error grows in the second half of a time: `Feedback` itself, and Euler's small steps."""
    plant, h = loop.plant, loop.period / FINE
    a, b, c, d = plant.dynamics
    # By the trapezoidal rule, which keeps what is stable stable.
    left = np.linalg.inv(np.eye(len(b)) - 0.5 * h * a)
    step, drive = left @ (np.eye(len(b)) + 0.5 * h * a), left @ b * h
    pace = RateLimiter(Limits(-1e12, 1e12), loop.period, 0.0)
    feedback = Feedback(loop.gains, pace)
    feedback.switch(True)
    period_ns, late = round(loop.period * 1e9), round(plant.delay / h)
    given = [0.0] * (late + 1)  # at each small step, delayed
    x, v, reading, errors = np.zeros(len(b)), 0.0, 1e-9, []
    for k in range(round(seconds / loop.period)):
        now_ns = (k + 1) * period_ns
        following = feedback.correct(now_ns, 0.0, reading, 0.0) if k else 0.0
        # What is computed from a reading is output a period later.
        for _ in range(FINE):
            given.append(v)
            x = step @ x + drive * given[-1 - late]
        v = following
        # A reading just after the output; in the beginning there is an error.
        reading = plant.slope * float(c @ x + d * (([*given, v])[-1 - late])) + (1e-9 if k < 3 else 0.0)
        errors.append(abs(reading))
        if errors[-1] > 1.0:
            return inf
    half = len(errors) // 2
    quarter = len(errors) // 4
    return float(np.max(errors[half + quarter :]) / max(np.max(errors[quarter:half]), 1e-300))


def mode(frequency: float, damping: float, gain: float = 1.0) -> Dynamics:
    return Resonance((Mode(frequency, damping, gain),)).dynamics


PLANTS = {
    "nothing": Plant(SLOPE),
    "a delay": Plant(SLOPE, 6.5 * T),
    "a delay of whole periods": Plant(SLOPE, 3 * T),
    "a lag": Plant(SLOPE, 0.0, first_order(8e-3)),
    "a mode": Plant(SLOPE, 0.0, mode(60.0, 0.03)),
    "a mode with a part that follows at once": Plant(SLOPE, 0.0, mode(60.0, 0.03, 0.6)),
    "a mode above half the rate": Plant(SLOPE, 0.0, mode(700.0, 0.05)),
    "all of it": Plant(SLOPE, 2.25 * T, mode(80.0, 0.1).then(first_order(2e-3))),
}
KINDS = {
    "integral": PidGains(0.0, 30.0 / SLOPE),
    "proportional": PidGains(0.1 / SLOPE),
    "both": PidGains(0.05 / SLOPE, 20.0 / SLOPE),
    "a notch and a low pass": PidGains(0.05 / SLOPE, 20.0 / SLOPE, 0.0, 0.0, 1e-3, (Notch(60.0, 0.05, 0.8),)),
    "filters, and all three": PidGains(
        0.05 / SLOPE, 20.0 / SLOPE, 0.02 * T / SLOPE, 3e-3, 5e-4, (Notch(60.0, 0.02), Notch(80.0, 0.1, 0.6))
    ),
    "all three": PidGains(0.05 / SLOPE, 20.0 / SLOPE, 0.02 * T / SLOPE, 3e-3),
}


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("name", PLANTS)
def test_the_limit_of_stability_is_where_the_course_over_time_begins_to_grow(name, kind):
    """The largest stable multiple of the gains, by Nyquist, against the loop itself a little below and above."""
    loop = DiscreteLoop(PLANTS[name], KINDS[kind], T)
    low, high = 1e-4, 1e4
    assert loop.scaled(low).margins.stable and not loop.scaled(high).margins.stable
    for _ in range(40):
        middle = (low * high) ** 0.5
        low, high = (middle, high) if loop.scaled(middle).margins.stable else (low, middle)
    # The offset of a takeover decays with its own time constant.
    assert growth(loop.scaled(0.93 * low), 1.5) < 1.0 < growth(loop.scaled(1.07 * low), 1.5)


def test_margins_of_an_integrator_alone():
    """``L = k z^-1 / (1 - z^-1)``, k = ki g T: stable below 2, and 1 + L is least at half the rate: 1 - k / 2."""
    for k in (0.1, 0.5, 1.0, 1.5, 1.9):
        found = DiscreteLoop(Plant(SLOPE), PidGains(0.0, k / SLOPE / T), T)
        # With the period from the reading to the output: 1 + k z^-1 z / (z - 1) / 1.
        omega = np.linspace(1e-3, pi / T, 20001)
        z = np.exp(1j * omega * T)
        expected = np.abs(1.0 + k / (z - 1.0))
        assert found.margins.stable == (k < 2.0)
        assert found.margins.modulus == pytest.approx(expected.min(), rel=1e-3)


def test_the_response_of_a_held_lag_and_of_a_mode_is_the_one_of_the_book():
    omega = np.array([1.0, 30.0, 400.0, 2500.0])
    z = np.exp(1j * omega * T)
    kept = np.exp(-T / 5e-3)
    own = PidGains(1.0)
    lag = DiscreteLoop(Plant(1.0, 0.0, first_order(5e-3)), own, T).response(omega)
    np.testing.assert_allclose(lag, (1.0 - kept) / (z - kept) / z, rtol=1e-9)
    # Slowly, the hold is half a period, and the rest is the mode itself.
    slow = np.array([1.0, 5.0])
    ring = DiscreteLoop(Plant(1.0, 7.3e-4, mode(20.0, 0.1)), own, T).response(slow)
    expected = Mode(20.0, 0.1).response(slow / (2 * pi)) * np.exp(-1j * slow * (1.5 * T + 7.3e-4))
    np.testing.assert_allclose(ring, expected, rtol=1e-5)


def test_the_gains_that_would_do_do_and_a_tenth_more_does_not():
    for plant in PLANTS.values():
        loop = DiscreteLoop(plant, KINDS["both"], T).scaled(1e3)
        share = loop.share_that_does()
        found = loop.scaled(share).margins
        assert 0.0 < share < 1.0 and found.enough
        assert not loop.scaled(1.15 * share).margins.enough
    assert DiscreteLoop(PLANTS["a mode"], PidGains(0.0, 1.0), T).share_that_does() == 1.0


MODEL = replace(axis_model(PI_CASE), effects=())


def test_the_plant_of_a_model_holds_slope_modes_delay_lag_and_the_timing_of_the_sensor():
    bare = Plant.of(MODEL)
    low, high = MODEL.hysteresis_range
    y = MODEL.memory().forward_array(np.linspace(low, high, 3))
    assert bare.slope >= (y[-1] - y[0]) / (high - low) > 0.0
    assert bare.delay == 0.0 and bare.dynamics is AT_ONCE
    effects = (Delay(3e-3), Lag(2e-3), Resonance((Mode(90.0, 0.02, 1.0),)), Contact(1e-6, 3.0))
    whole = Plant.of(replace(MODEL, effects=effects, sensor=Sensor(1e-3, 4e-3)))
    assert whole.slope == pytest.approx(3.0 * bare.slope)
    assert whole.delay == pytest.approx(4e-3) and len(whole.dynamics.b) == 4
    # Static gain 1.
    a, b, c, d = whole.dynamics
    assert d - c @ np.linalg.solve(a, b) == pytest.approx(1.0)
    assert Plant.of(replace(MODEL, effects=(Delay(-2e-3),))).delay == 0.0


def test_a_refusal_says_in_one_line_which_gain_would_do():
    slope = Plant.of(MODEL).slope
    assert refusal(MODEL, PidGains(0.0, 10.0 / slope), T) == "" == refusal(MODEL, PidGains(0.0), T)
    said = refusal(MODEL, PidGains(0.0, 3000.0 / slope), T)
    assert "unstable" in said and "\n" not in said
    would = float(said.split("ki ")[1].split()[0])
    assert refusal(MODEL, PidGains(0.0, would), T) == ""
    found = DiscreteLoop(Plant.of(MODEL), PidGains(0.0, would), T).margins
    assert found.modulus == pytest.approx(LEAST_MARGIN, rel=0.2)
    # The same gains at another rate of the loop.
    assert refusal(MODEL, PidGains(0.0, 3000.0 / slope), 1e-4) == ""
    near = DiscreteLoop(Plant.of(MODEL), PidGains(0.0, 1.6 / T / slope), T).margins
    assert near.stable and not near.enough
    assert "barely stable" in refusal(MODEL, PidGains(0.0, 1.6 / T / slope), T)


def test_a_long_delay_at_a_high_rate_is_judged_too():
    for crossover, stable in ((0.5, True), (3.0, False)):
        loop = DiscreteLoop(Plant(SLOPE, 1.0, first_order(0.01)), PidGains(0.0, crossover / SLOPE), 5e-5)
        assert loop.margins.stable == stable
        assert ceil(loop.plant.delay / loop.period) == 20_000
