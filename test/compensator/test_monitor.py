"""One monitor: a further thing to notice is one rule, and what each common part of the rules says when."""

import numpy as np
import pytest

from slpi_ros.compensator.monitor import Finding, Lasting, Monitor, Rule, Silence
from slpi_ros.compensator.sensor_rule import FollowingLimits, SensorLimits, SensorRule, misfit, slopes
from slpi_ros.compensator.watchdog import CommandWatchdog

MS = 1_000_000


class Jump(Rule):
    """A rule of its own, as a further one would be written: the reading jumps from one to the next."""

    def __init__(self, limit):
        self.limit, self.last, self.jump = limit, None, 0.0

    def read(self, expected, reading, now_ns):
        self.jump = 0.0 if self.last is None else abs(reading - self.last)
        self.last = reading

    def check(self, now_ns):
        return Finding("jump", "far", f"it jumped by {self.jump:g} m", "x") if self.jump > self.limit else None


def test_a_further_rule_is_fed_and_told_without_any_other_change():
    monitor = Monitor(SensorRule(10e-6), Jump(1e-6))
    for now, y in enumerate([0.0, 0.5e-6, 0.6e-6]):
        monitor.output(1.0, now * MS)
        monitor.report(1.0, now * MS)
        monitor.read(0.0, y, now * MS)
        assert monitor.check(now * MS) == [] and monitor.standing == ()
    monitor.read(0.0, 4e-6, 4 * MS)
    (found,) = monitor.check(4 * MS)
    assert (found.rule, found.kind, found.axis) == ("jump", "far", "x")
    assert str(found) == "axis 'x': it jumped by 3.4e-06 m"


def test_a_finding_is_new_once_and_stands_as_long_as_it_is_there():
    jump, monitor = Jump(1e-6), None
    monitor = Monitor(jump)
    monitor.read(0.0, 0.0, 0)
    monitor.read(0.0, 5e-6, MS)
    assert len(monitor.check(MS)) == 1
    assert monitor.check(2 * MS) == [] and [each.rule for each in monitor.standing] == ["jump"]
    monitor.read(0.0, 5e-6, 3 * MS)
    assert monitor.check(3 * MS) == [] and monitor.standing == ()
    monitor.read(0.0, 0.0, 4 * MS)
    assert len(monitor.check(4 * MS)) == 1


def test_something_lasts_if_it_is_of_one_kind_often_enough_and_for_long_enough():
    lasting = Lasting(3)
    assert [lasting.note("a", t * MS, 25 * MS) for t in (0, 10, 20, 30)] == [False, False, False, True]
    assert lasting.seen == 4
    assert not lasting.note("b", 40 * MS, 25 * MS) and not lasting.note("", 50 * MS)
    assert [lasting.note("b", 60 * MS + t) for t in range(3)] == [False, False, True]
    lasting.forget()
    assert not lasting.note("b", 70 * MS)


def test_no_kind_never_lasts():
    lasting = Lasting()
    assert not any(lasting.note("", t * MS) for t in range(100))


def test_silence_is_told_after_its_limit_with_its_seconds():
    silence = Silence(100 * MS, lambda seconds: f"nothing for {seconds:g} s")
    assert silence.beyond(0.5, 599 * MS) == "" and silence.beyond(0.5, 700 * MS) == "nothing for 0.6 s"
    silence.hear(700 * MS)
    assert silence.beyond(0.5, 1199 * MS) == "" and silence.seconds(1100 * MS) == pytest.approx(0.4)


@pytest.mark.parametrize(("slope", "kind"), [(1.0, ""), (0.3, ""), (0.05, "stuck"), (0.0, "stuck"), (-0.3, "inverted")])
@pytest.mark.parametrize("late", [0, 3])
def test_the_slope_of_readings_names_what_does_not_follow_late_or_not(slope, kind, late):
    expected = np.sin(np.linspace(0.0, 6.0, 100))
    reading = slope * np.concatenate([np.full(late, expected[0]), expected[: 100 - late]])
    found, value = misfit(expected, reading, FollowingLimits())
    assert found == kind and value == pytest.approx(slope, rel=0.15, abs=0.005)


def test_a_slope_that_is_not_known_well_is_no_fault():
    expected = np.linspace(0.0, 1.0, 20)
    reading = np.random.default_rng(3).normal(0.0, 5.0, 20)
    limits = FollowingLimits(error=0.1, errors=4.0)
    assert min(error for _, error in slopes(expected, reading, limits)) > 0.1
    assert misfit(expected, -reading, limits)[0] == misfit(expected, reading, limits)[0] == ""
    assert misfit(expected, np.zeros(20), limits)[0] == "stuck"


def test_too_few_readings_have_no_slope():
    assert misfit(np.arange(3.0), -np.arange(3.0), FollowingLimits()) == ("", 1.0)
    assert misfit(np.ones(30), np.arange(30.0), FollowingLimits()) == ("", 1.0)


def test_the_limits_of_a_sensor_are_parameters():
    for limits, found in ((SensorLimits(), None), (SensorLimits(following=FollowingLimits(stuck=0.6)), "stuck")):
        rule = SensorRule(10e-6, limits=limits, axis="y")
        rule.begin()
        rule.fault_time, kinds = 0.5, set()
        for k in range(1000):
            y = 5e-6 * np.sin(0.02 * k)
            rule.read(y, 0.5 * y, k * 2 * MS)
            if each := rule.check(k * 2 * MS):
                kinds.add((each.rule, each.kind, each.axis))
        assert kinds == ({("sensor", found, "y")} if found else set())


def test_a_sensor_is_not_judged_without_a_fault_time_or_before_it_begins():
    rule = SensorRule(10e-6)
    assert rule.check(10**12) is None
    rule.fault_time = 0.5
    assert rule.check(10**12) is None
    rule.begin()
    assert rule.check(0) is None and rule.check(501 * MS).kind == "silent"
    rule.fault_time = 0.0
    assert rule.check(10**12) is None


def test_the_watchdog_is_a_rule_whose_timeout_may_be_off():
    watchdog = CommandWatchdog()
    watchdog.start(0)
    assert watchdog.check(10**12) is None
    watchdog.timeout = 0.5
    found = watchdog.check(600 * MS)
    assert (found.rule, found.kind, found.reason) == ("commands", "silent", "no command yet for 0.6 s")
    watchdog.commanded = True
    watchdog.feed(600 * MS)
    assert watchdog.check(1099 * MS) is None and watchdog.check(1101 * MS).reason == "no command for 0.501 s"
