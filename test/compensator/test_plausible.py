"""Displacements that no piezo stage has are found, whatever is known of it, and those of stages are let alone."""

from math import inf

import numpy as np
import pytest

from slpi_ros.compensator.plausible import (
    PlausibleRule,
    implausible,
    implausible_noise,
    implausible_stroke,
)
from slpi_ros.model.limits import Limits

LIMITS = Limits(0.0, 100.0, 1000.0)
PERIOD_NS = 5_000_000
RATE = 200.0


def moved(*goals, seconds=2.0, begin=0.0):
    """Return voltages at 200 Hz that go from one goal to the next, and rest there for a second."""
    count, rest = int(seconds * RATE), int(RATE)
    parts, last = [np.full(rest, begin)], begin
    for goal in goals:
        parts += [np.linspace(last, goal, count), np.full(rest, goal)]
        last = goal
    return np.concatenate(parts)


def readings(v, stroke, noise=0.0, hysteresis=0.15, late=0.0, digit=0.0, hold=1):
    """Return what the sensor of a stage says: stroke (m) at 100 V, width of its loop, delay (s), digit (m)."""
    wide, y = hysteresis * 100.0 / 2.0, np.empty(v.size)
    state = 0.0
    for place, at in enumerate(v):
        state = min(max(state, at - wide), at + wide)
        y[place] = state
    # Of a piezo at least half of the slope is there after a turn, too.
    y = (y + v) / 200.0 * stroke
    if late:
        y = np.concatenate((np.full(round(late * RATE), y[0]), y))[: v.size]
    y = y + noise * np.random.default_rng(1).standard_normal(v.size)
    if digit:
        y = digit * np.round(y / digit)
    return np.repeat(y[::hold], hold)[: v.size]


def found_by(v, y, travel=None):
    rule = PlausibleRule(LIMITS, "x")
    if travel is not None:
        rule.begin(travel)
    for place, (voltage, reading) in enumerate(zip(v.tolist(), y.tolist(), strict=True)):
        rule.read(voltage, reading, place * PERIOD_NS)
        if place % 10 == 0 and (found := rule.check(place * PERIOD_NS)):
            return found
    return rule.check(v.size * PERIOD_NS)


@pytest.mark.parametrize(
    ("stroke", "well"),
    [(23e-9, False), (99e-9, False), (101e-9, True), (20e-6, True), (1.99e-3, True), (2.1e-3, False), (inf, False)],
)
def test_strokes(stroke, well):
    assert (implausible_stroke(stroke) == "") == well


@pytest.mark.parametrize("goals", [(100.0, 0.0), (30.0, 10.0), (50.0,)])
@pytest.mark.parametrize("noise", [0.008, 0.3])  # of a stroke of 23
def test_millimetres_taken_for_micrometres_are_found(goals, noise):
    v = moved(*goals)
    found = found_by(v, readings(v, 23e-9, noise * 1e-9))
    assert found is not None and (found.rule, found.kind, found.axis) == ("units", "implausible", "x")
    assert implausible(v, readings(v, 23e-9, noise * 1e-9), LIMITS.span)


@pytest.mark.parametrize("goals", [(100.0, 0.0), (30.0, 10.0)])
def test_nanometres_taken_for_micrometres_are_found(goals):
    v = moved(*goals)
    y = readings(v, 23e-3, 8e-6)
    assert found_by(v, y) is not None
    assert implausible(v, y, LIMITS.span)


STAGES = {
    "usual": {"stroke": 20e-6, "noise": 8e-9},
    "short": {"stroke": 0.3e-6, "noise": 1e-9},
    "long": {"stroke": 1e-3, "noise": 50e-9},
    "wide loop": {"stroke": 5e-6, "noise": 1e-9, "hysteresis": 0.3},
    "late": {"stroke": 20e-6, "noise": 8e-9, "late": 0.2},
    "coarse digit": {"stroke": 20e-6, "digit": 1e-6},
    "fine digit": {"stroke": 20e-6, "noise": 1e-9, "digit": 1e-10},
    "held": {"stroke": 20e-6, "noise": 1e-9, "hold": 40},
    "held, coarse": {"stroke": 20e-6, "noise": 1e-9, "hold": 20, "digit": 1e-8},
    "noisy": {"stroke": 2e-6, "noise": 100e-9},
    "quiet": {"stroke": 20e-6, "noise": 3e-12},
    "standing still": {"stroke": 0.0},
}


@pytest.mark.parametrize("name", STAGES)
@pytest.mark.parametrize("goals", [(100.0, 0.0), (10.0, 0.0), (1.0, 0.5), (0.05,)])
@pytest.mark.parametrize("seconds", [0.02, 2.0])
def test_stages_are_let_alone(name, goals, seconds):
    v = moved(*goals, seconds=seconds)
    assert found_by(v, readings(v, **STAGES[name])) is None


@pytest.mark.parametrize("name", STAGES)
def test_records_of_stages_are_let_alone(name):
    v = moved(100.0, 0.0)
    assert implausible(v, readings(v, **STAGES[name])) == ""


def test_what_the_device_tells_of_its_travel_counts_before_anything_moves():
    v = np.zeros(10)
    assert found_by(v, v, 25e-9) is not None
    assert found_by(v, v, 25e-6) is None
    assert found_by(v, v, float("nan")) is None


def test_what_was_found_stands_until_the_device_is_opened_anew():
    rule = PlausibleRule(LIMITS, "x")
    rule.begin(25e-9)
    assert rule.check(0) and rule.check(10**12)
    rule.begin()
    assert rule.check(0) is None


@pytest.mark.parametrize(
    ("y", "well"),
    [
        (1e-14 * np.random.default_rng(1).standard_normal(500), False),
        (1e-9 * np.random.default_rng(1).standard_normal(500), True),
        (np.zeros(500), True),
        (np.repeat(1e-9 * np.arange(20.0), 25), True),  # a digit of 1 nm
        (np.repeat(5e-12 * np.random.default_rng(1).standard_normal(50), 10), True),  # held
        (1e-9 * np.arange(500.0), True),  # as steady as its digit shows
        (np.array([0.0, np.nan, 1e-14]), True),
        (np.array([]), True),
    ],
)
def test_noise(y, well):
    assert (implausible_noise(y) == "") == well


def test_an_axis_that_rests_or_does_not_follow_tells_no_stroke():
    v, random = moved(100.0, 0.0), np.random.default_rng(1)
    assert implausible(np.zeros(v.size), 1e-9 * random.standard_normal(v.size)) == ""
    assert implausible(v, 1e-9 * random.standard_normal(v.size)) == ""
