"""Rules of a drive of an unknown stage, each by itself: causes and numbers."""

import numpy as np
import pytest

from slpi_ros.calibration.drive_rules import RelationLimits, RelationRule, StampRule, StateRule
from slpi_ros.io.messages import SECOND_NS
from slpi_ros.model.limits import Limits

STEP_NS = SECOND_NS // 200


def stamped(offsets, jump=0.5):
    """Return the kinds of words that a rule says of stamps (s off the clock), ten states before the drive."""
    rule = StampRule(jump)
    for number in range(10):
        rule.stamp(SECOND_NS + number * STEP_NS, SECOND_NS + number * STEP_NS, False, number * STEP_NS)
    rule.begin()
    for number, offset in enumerate(offsets, 10):
        now = SECOND_NS + number * STEP_NS
        rule.stamp(now + round(offset * SECOND_NS), now, True, number * STEP_NS)
        if found := rule.check(number * STEP_NS):
            return number - 10, found.reason
    return None, ""


def test_stamps_that_jump_are_found_after_a_tenth_of_a_second_and_three_states():
    number, reason = stamped([0.0] * 10 + [0.7] * 40)
    assert number == 10 + 20 and "0.7 s ahead" in reason and "limit 0.5 s" in reason
    assert stamped([0.0] * 10 + [0.4] * 40)[0] is None
    assert stamped([0.0] * 10 + [-0.7] * 40, jump=2.0)[0] is None
    assert stamped(([0.0] * 5 + [0.7] * 15) * 4)[0] is None


def test_stamps_that_stand_still_are_found_after_three_tenths_of_a_second():
    number, reason = stamped([-k / 200 for k in range(100)])
    assert number == 61 and "stand still over 62 states" in reason


def test_valid_states_may_come_as_slowly_as_before_the_drive():
    for interval, silent in ((0.01, 0.51), (1.0, 2.3)):
        rule, now = StateRule(0.5), 0
        for _ in range(5):
            now += round(interval * SECOND_NS)
            rule.hear(now)
        assert rule.check(now + 3 * SECOND_NS) is None, "no drive"
        rule.begin(now)
        assert rule.check(now + round((silent - 0.02) * SECOND_NS)) is None
        rule.refused = "effort is nan"
        found = rule.check(now + round((silent + 0.25) * SECOND_NS))
        assert (found.rule, found.kind) == ("states", "silent") and "effort is nan" in found.reason


def related(change, gain=1e-7, seconds=6.0, **limits):
    """Return what a relation rule finds, and when (s) after 3 s of an honest stage, on waves over the range."""
    rule = RelationRule(Limits(0.0, 100.0), "x", RelationLimits(**limits))
    rule.begin()
    rng = np.random.default_rng(5)
    for k in range(round(seconds * 200)):
        t = k / 200
        v = 50.0 - 50.0 * np.cos(2.0 * np.pi * t)
        y = gain * v + rng.normal(0.0, 1e-9)
        rule.read(v, y if t < 3.0 else change(y, v), k * STEP_NS)
        if found := rule.check(k * STEP_NS):
            return found.kind, t - 3.0, found.reason
    return None, None, ""


@pytest.mark.parametrize("gain", [1e-7, -1e-7])
def test_a_stage_that_stays_as_it_was_is_let_alone(gain):
    assert related(lambda y, v: y, gain)[0] is None
    assert related(lambda y, v: y + 0.2 * abs(gain) * 100.0, gain)[0] is None, "drift"


@pytest.mark.parametrize("gain", [1e-7, -1e-7])
def test_a_displacement_that_was_not_seen_at_its_voltage(gain):
    kind, after, reason = related(lambda y, v: y + 1e-3, gain)
    assert kind == "outside" and after == pytest.approx(0.1, abs=0.01) and "axis 'x' reads" in reason
    assert related(lambda y, v: y + 15e-6, gain)[0] == "outside"
    assert related(lambda y, v: y + 15e-6, gain, off=2.0)[0] is None


def test_a_reading_that_is_the_same_to_the_last_digit():
    kind, after, reason = related(lambda y, v: 4e-6)
    assert kind == "frozen" and after < 0.3 and "states" in reason and "limit 5 V" in reason


def test_a_reading_that_no_longer_follows():
    rng = np.random.default_rng(6)
    kind, after, reason = related(lambda y, v: 5e-6 + rng.normal(0.0, 1e-9), off=10.0)
    assert kind == "frozen" and after < 0.6 and "µm/V before" in reason


@pytest.mark.parametrize("gain", [1e-7, -1e-7])
def test_a_reading_that_moves_the_wrong_way(gain):
    kind, after, reason = related(lambda y, v: 100.0 * gain - y, gain, off=10.0)
    assert kind == "flipped" and after < 0.6
    assert float(reason.split("wrong way, ")[1].split(" ")[0]) == pytest.approx(-gain * 1e6, rel=0.2)


def test_a_stage_that_never_moves_is_found_by_the_first_part_of_the_range():
    rule = RelationRule(Limits(0.0, 100.0), "x")
    rule.begin()
    rng, found = np.random.default_rng(7), None
    for k in range(400):
        v = 0.25 * k
        rule.read(v, rng.normal(0.0, 1e-9), k * STEP_NS)
        if found := rule.check(k * STEP_NS):
            break
    assert found.kind == "frozen" and "does not follow" in found.reason and v == pytest.approx(30.0, abs=15.0)
