"""Notches and low pass of the feedback: the filter of the book, and how the feedback uses it."""

from dataclasses import replace
from math import inf, nan, pi

import control
import numpy as np
import pytest

from slpi_ros.compensator.feedback import Feedback, PidGains
from slpi_ros.compensator.loop_filter import LoopFilter, Notch, response, sections
from slpi_ros.errors import UsageError
from slpi_ros.model.limits import Limits, RateLimiter

T, NS = 1e-3, 10**9
NOTCHES = (Notch(120.0, 0.02), Notch(330.0, 0.1, 0.6))


@pytest.mark.parametrize("notch", [*NOTCHES, Notch(499.0, 0.3), Notch(0.5, 0.0, 3.0)], ids=str)
def test_a_notch_is_tustins_with_prewarping(notch):
    w = 2.0 * pi * notch.frequency
    book = control.tf([1.0, 2.0 * notch.damping * w, w * w], [1.0, 2.0 * notch.width * w, w * w])
    discrete = control.sample_system(book, T, method="bilinear", prewarp_frequency=w)
    omega = np.concatenate([np.geomspace(0.1, pi / T * 0.999, 300), [w]])
    found = response(sections((notch,), 0.0, T), np.exp(1j * omega * T))
    np.testing.assert_allclose(found, discrete(np.exp(1j * omega * T)), rtol=1e-6, atol=1e-9)
    # At the mode, exactly what the continuous one does there.
    assert found[-1] == pytest.approx(notch.damping / notch.width, abs=1e-9)


def test_steps_of_the_filter_are_the_transfer_function():
    made = LoopFilter(NOTCHES, 2e-3, T)
    u = np.random.default_rng(1).normal(size=4096)
    z = np.exp(1j * np.linspace(0.01, 3.1, 50))
    powers = z[:, None] ** -np.arange(u.size)
    # Of a signal that goes on for so long that the filter has forgotten its end.
    u[-1500:] = 0.0
    out, states = [], made.at_rest(0.0)
    for each in u:
        y, states = made.after(states, float(each), 1)
        out.append(y)
    np.testing.assert_allclose(powers @ out / (powers @ u), response(made.sections, z), rtol=1e-6)


def test_at_rest_a_filter_passes_what_it_is_given_and_holds_it_over_several_periods():
    made = LoopFilter(NOTCHES, 2e-3, T)
    y, states = made.after(made.at_rest(3.0), 3.0, 7)
    assert y == pytest.approx(3.0, rel=1e-12)
    several, _ = made.after(states, 5.0, 3)
    for _ in range(3):
        y, states = made.after(states, 5.0, 1)
    assert several == y != 5.0


@pytest.mark.parametrize("wrong", [(0.0,), (-1.0,), (nan,), (inf,), (10.0, -0.1), (10.0, nan), (10.0, 0.1, 0.0)])
def test_a_notch_that_makes_no_sense_is_refused(wrong):
    with pytest.raises(UsageError) as caught:
        Notch(*wrong)
    assert "notch" in str(caught.value) and "\n" not in str(caught.value)
    with pytest.raises(UsageError) as caught:
        sections((Notch(500.0),), 0.0, T)
    assert "500 Hz" in str(caught.value) and "1000 Hz" in str(caught.value)


def made(gains: PidGains, period: float = T) -> Feedback:
    feedback = Feedback(gains, RateLimiter(Limits(-1e9, 1e9), period, 0.0))
    feedback.switch(True)
    return feedback


def corrections(feedback: Feedback, readings: np.ndarray, every: int = 1, period: float = T) -> np.ndarray:
    """Return what is output for readings (m) that come in each period, or only `every` so many."""
    found = []
    for k, y in enumerate(readings):
        now_ns = (k + 1) * round(period * NS)
        if k % every == 0:
            feedback.measure(float(y), now_ns, 0.0)
        found.append(feedback.step(0.0, 0.0, now_ns, 1.0))
    return np.array(found)


def test_the_feedback_passes_a_mode_that_rings_on_as_the_notch_does():
    gains = PidGains(1e6, 0.0, notches=(Notch(100.0, 0.01),))
    t = np.arange(3000) * T
    ringing = 1e-6 * np.sin(2.0 * pi * 100.0 * t)
    kept = np.ptp(corrections(made(gains), ringing)[2000:])
    alone = np.ptp(corrections(made(replace(gains, notches=())), ringing)[2000:])
    assert kept == pytest.approx(0.01 * alone, rel=0.05)


def test_the_filter_keeps_its_frequency_when_readings_come_less_often_than_corrections():
    """Over three periods without a reading the filter goes on: its time constant is one in seconds."""
    gains = PidGains(1e6, measurement_filter=20e-3)
    step = np.r_[np.zeros(30), np.full(60, 1e-6)]
    often, seldom = (corrections(made(gains), step, every) for every in (1, 3))
    np.testing.assert_allclose(seldom[30::3], often[32::3], rtol=1e-9, atol=1e-12)


def test_another_rate_discretises_anew_without_a_step():
    gains = PidGains(1e6, 1e7, 1e3, 2e-3, 5e-3, (Notch(60.0, 0.1),))
    feedback = made(gains)
    steady = corrections(feedback, np.full(2000, 1e-6))
    before, now_ns = steady[-1], 2000 * round(T * NS)
    feedback.pace.change(Limits(-1e9, 1e9), T / 4)
    feedback.measure(1e-6, now_ns + round(T * NS / 4), 0.0)
    after = feedback.step(0.0, 0.0, now_ns + round(T * NS / 4), 1.0)
    assert after == pytest.approx(before, rel=1e-3)
    # The same notch at the new rate.
    t = np.arange(8000) * T / 4
    ringing = corrections(made(gains, T / 4), 1e-6 * np.sin(2 * pi * 60.0 * t), period=T / 4)
    plain = corrections(made(replace(gains, notches=()), T / 4), 1e-6 * np.sin(2 * pi * 60.0 * t), period=T / 4)
    assert np.ptp(ringing[6000:]) == pytest.approx(0.1 * np.ptp(plain[6000:]), rel=0.05)


def test_other_filters_are_taken_over_without_a_step():
    feedback = made(PidGains(1e6, 1e7))
    before = corrections(feedback, np.full(3000, 1e-6))[-1]
    feedback.retune(PidGains(1e6, 1e7, notches=NOTCHES, measurement_filter=3e-3))
    now_ns = 3001 * round(T * NS)
    feedback.measure(1e-6, now_ns, 0.0)
    assert feedback.step(0.0, 0.0, now_ns, 1.0) == pytest.approx(before - 1e7 * 1e-6 * T, rel=1e-6)
