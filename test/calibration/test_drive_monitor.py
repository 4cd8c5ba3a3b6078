"""What a stage reports during a drive: lies are found within a second, honest sensors are let alone."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from benchmarks.sensor_lies import DRIVERS, LIES, MARK, SENSORS, live, stage_of
from slpi_ros.calibration.drive_monitor import DriveMonitor
from slpi_ros.calibration.drive_rules import RelationLimits, surest_slope
from slpi_ros.io.messages import SECOND_NS
from slpi_ros.model.limits import Limits

# Honest sensors of each way to be hard to believe, one of each for one of the drivers; the others are long.
QUICK = {"exciter": ("usual", "40 ms late"), "calibrator": ("noise 3 % of the stroke",)}
# Lies of each kind to the exciter, and one to the calibrator, whose watch is the same; the others are long.
FIRST = {"exciter": ("frozen", "effort 0", "stale stamps", "sign flipped"), "calibrator": ("frozen",)}
FOLLOWING = RelationLimits().frozen
# What names each lie in the message.
NAMES = {
    "stale stamps": "stamps", "effort 0": "effort", "effort stays": "effort", "silent": "no valid stage_state",
}  # fmt: skip


@pytest.mark.parametrize(
    ("driver", "lie"),
    [
        pytest.param(driver, lie, marks=() if lie in FIRST[driver] else pytest.mark.long)
        for driver in DRIVERS
        for lie in LIES
    ],
)
@settings(max_examples=2, deadline=None)
@given(seed=st.integers(0, 10_000), at=st.floats(0.05, 0.9), sign=st.sampled_from([1.0, -1.0]))
def test_a_lie_is_found_within_a_second_of_what_shows_it(driver, lie, seed, at, sign):
    life = live(driver, lie, stage_of(seed), SENSORS["usual" if sign > 0 else "negative gain"], seed, at=at)
    if life.shown == life.shown:
        assert life.driven <= MARK, life.fault
        assert NAMES.get(lie, "axis 'x'") in life.fault


def test_small_loops_near_zero_hide_an_effort_of_zero_as_long_as_it_may_be_late():
    """The drive comes back to 0 V every 0.3 s for a while; the lie counts from where no delay explains it."""
    life = live("calibrator", "effort 0", stage_of(1408), SENSORS["usual"], 1408, at=0.4413463)
    assert life.shown == life.shown and life.driven <= MARK and "effort" in life.fault


@pytest.mark.parametrize(
    ("driver", "sensor"),
    [
        pytest.param(driver, sensor, marks=() if sensor in QUICK[driver] else pytest.mark.long)
        for driver in DRIVERS
        for sensor in SENSORS
    ],
)
@settings(max_examples=2, deadline=None)
@given(seed=st.integers(0, 10_000), drive=st.sampled_from(["calibration", "sweep", "creep", "resonance", "lag"]))
def test_an_honest_sensor_is_let_alone(driver, sensor, seed, drive):
    assert not live(driver, "", stage_of(seed), SENSORS[sensor], seed, drive=drive).fault


def watch_of(**given):
    watch = DriveMonitor(["x"], [Limits(0.0, 100.0)], 0.5, **given)
    watch.begin([20.0], 0)
    return watch


@pytest.mark.parametrize(
    ("v", "y", "words"),
    [
        (20.0, 12.3, ("position 12.3", "'x'", "0.1 m", "micrometres")),
        (20.0, float("nan"), ("position", "'x'", "nan")),
        (float("nan"), 1e-6, ("effort", "'x'", "nan")),
        (float("nan"), float("nan"), ("neither effort nor position", "'x'")),
    ],
)
def test_the_rule_that_a_state_breaks_is_named(v, y, words):
    watch = watch_of()
    assert not watch.state(SECOND_NS, SECOND_NS, [v], [y], 0)
    assert all(word in watch.refused for word in words)
    for now in np.arange(0.0, 0.7, 0.01):
        watch.state(SECOND_NS, SECOND_NS, [v], [y], round(now * SECOND_NS))
        fault = watch.check(round(now * SECOND_NS))
    assert "no valid stage_state" in fault and all(word in fault for word in words)


def test_a_process_that_was_held_up_does_not_take_it_for_silence():
    watch = watch_of()
    watch.state(SECOND_NS, SECOND_NS, [20.0], [1e-6], 0)
    assert not watch.check(8 * SECOND_NS)
    watch.state(SECOND_NS + 20_000_000, 9 * SECOND_NS, [20.0], [1e-6], 8 * SECOND_NS)
    watch.state(9 * SECOND_NS, 9 * SECOND_NS, [20.0], [1e-6], 8 * SECOND_NS)
    assert not watch.check(8 * SECOND_NS + 10_000_000)


def test_stamps_that_jump_are_named_with_value_and_limit():
    watch = watch_of()
    fault = ""
    for number in range(40):
        now = number * SECOND_NS // 100
        watch.state(SECOND_NS + now + (3600 * SECOND_NS if number > 10 else 0), SECOND_NS + now, [20.0], [1e-6], now)
        fault = watch.check(now)
    assert "3.6e+03 s ahead" in fault and "0.5 s" in fault


def test_the_start_is_the_median_of_three_recent_reports_or_the_latest_of_a_slow_driver():
    watch = DriveMonitor(["x"], [Limits(0.0, 100.0)], 0.5)
    for number, v in enumerate([40.0, 0.0, 40.1]):
        at = number * 20_000_000
        assert watch.started_from(at, 0) is None
        watch.state(SECOND_NS, SECOND_NS, [v], [1e-6], at)
    assert watch.started_from(40_000_000, 0) == [40.0]
    slow = DriveMonitor(["x"], [Limits(0.0, 100.0)], 0.5)
    slow.state(SECOND_NS, SECOND_NS, [30.0], [1e-6], 0)
    for number in range(60):
        slow.check(number * 20_000_000)
    assert slow.started_from(1_180_000_000, 0) == [30.0]


def test_the_slope_at_the_beginning_of_a_motion_is_the_true_one():
    """Of displacements that are taken to be later, the slope would be 20 times too large."""
    v = np.concatenate([np.zeros(60), np.linspace(0.0, 50.0, 30) ** 2 / 50.0])
    slope, error, sign = surest_slope(v, -1e-7 * v, FOLLOWING)
    assert slope == pytest.approx(1e-7) and sign == -1.0 and error < 1e-3 * slope
    assert surest_slope(v, np.zeros(v.size), FOLLOWING)[0] == 0.0
    for still in (-7.1168e-6, 1.7e-5, 3.3e-3):
        slope, error, _ = surest_slope(v, np.full(v.size, still), FOLLOWING)
        assert slope <= error


@pytest.mark.parametrize("slope", [0.0, 20.0, -60.0])
def test_a_voltage_that_moves_before_the_drive_is_told(slope):
    monitor = DriveMonitor(("x", "y"), [Limits(0.0, 100.0)] * 2, 0.5)
    random = np.random.default_rng(3)
    for k in range(100):
        v, now_ns = 60.0 + slope * 0.01 * k, k * SECOND_NS // 100
        monitor.state(now_ns, now_ns, [50.0 + 0.3 * random.normal(), v + 0.3 * random.normal()], [0.0, 0.0], now_ns)
    assert monitor.moves() == bool(slope)
