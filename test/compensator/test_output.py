"""What the amplifier feels: what leaves the compensator keeps the limits, whatever happens before it."""

from dataclasses import replace
from math import inf

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from strategies import FAMILY_CASE, axis_model

from benchmarks.episodes import Episode, Ratios, Wire
from slpi_ros.compensator.controller import Controller, OperatingMode
from slpi_ros.compensator.motion import Kind, Safety
from slpi_ros.compensator.persistence import MemoryFile, SavedAxis, load_memory
from slpi_ros.effects.creep import Creep
from slpi_ros.effects.lag import Lag
from slpi_ros.errors import ModelError
from slpi_ros.model.limits import PERIOD, Limits
from slpi_ros.model.stage_model import StageModel

MS, SECOND, START = 1_000_000, 1_000_000_000, 10**15
AXIS = replace(axis_model(FAMILY_CASE), displacement_range=(2e-6, 14e-6))
LIMITS = Limits(0.0, 100.0, 200.0)


class Stage:
    """A compensator, and the wire to an amplifier that is at some voltage and reports it every 10 ms."""

    def __init__(self, there=0.0, limits=LIMITS, model=AXIS, reporting=True, saved=None, last=None):
        self.now_ns, self.limits, self.reporting = START, limits, reporting
        self.wire, self.ratios, self.given = Wire(there, limits, PERIOD), Ratios(), []
        self.made = Controller(["x"], [limits])
        self.made.use_model(StageModel({"x": model}), saved, last_voltages=last)
        self.made.activate(self.now_ns)
        self.made.ownership.reporting = reporting
        self.axis = self.made.axes[0]
        self.run(0.05)

    def publish(self):
        self.given.append((self.now_ns, self.made.voltages[0]))
        self.wire.output(self.made.voltages[0], self.now_ns, self.ratios, f"output {len(self.given)}")

    def run(self, seconds):
        """Let time pass."""
        end_ns = self.now_ns + round(seconds * SECOND)
        report_ns = self.now_ns
        while True:
            due_ns = self.made.next_due_ns(self.now_ns, self.now_ns)
            self.now_ns = max(min(report_ns, end_ns if due_ns is None else due_ns, end_ns), self.now_ns)
            if self.now_ns == report_ns:
                report_ns += 10 * MS
                if self.reporting:
                    self.made.report(["x"], [self.wire.voltage], self.now_ns)
                    self.made.locate(self.now_ns)
            if self.made.advance(self.now_ns, self.now_ns):
                self.publish()
            if self.now_ns >= end_ns:
                return

    def send(self, y, stamp_ns=None):
        self.made.update(self.now_ns if stamp_ns is None else stamp_ns, ["x"], [y], self.now_ns, self.now_ns)
        self.publish()

    def check(self):
        """Compare with the limits what has reached the amplifier so far."""
        ratios = self.ratios
        assert max(ratios.step, ratios.slew, ratios.acceleration) <= 1.0 + 1e-9, ratios
        assert ratios.outside <= 0.0 and ratios.outputs


TOP = AXIS.displacement_range[1]


def test_the_first_command_starts_from_the_amplifier():
    """At 80 V: it was 80 V in one step."""
    stage = Stage(80.0)
    stage.send(0.5 * TOP)
    assert abs(stage.given[0][1] - 80.0) <= 0.4 + 1e-9
    stage.run(1.0)
    stage.check()
    assert stage.axis.stream.memory.displacement == pytest.approx(0.5 * TOP, abs=1e-12)


def test_a_pause_permits_no_large_step():
    """It was 20 V."""
    stage = Stage()
    for y in (0.1, 0.9, 0.2, 0.8):
        stage.send(y * TOP)
        assert abs(stage.given[-1][1] - (stage.given[-2][1] if len(stage.given) > 1 else 0.0)) <= 0.4 + 1e-9
        stage.run(1.5)
    stage.check()


def test_set_points_at_20_hz_arrive_in_steps_of_the_output_rate():
    """They were steps of 10.6 V."""
    stage = Stage()
    for k in range(60):
        stage.send((0.5 + 0.4 * np.sin(0.3 * k)) * TOP)
        stage.run(0.05)
    stage.check()
    assert np.abs(np.diff([v for _, v in stage.given])).max() <= 0.4 + 1e-9


@pytest.mark.parametrize("clocks", [(0, 3 * SECOND), (0, -3 * SECOND), (10**18, 0)])
def test_two_publishers_with_different_clocks(clocks):
    """60 V within 26 ms at 100 V/s it was."""
    stage = Stage(limits=replace(LIMITS, slew=100.0))
    stage.send(0.05 * TOP)
    stage.run(1.0)
    begin = stage.given[-1][1]
    for k in range(26):
        stage.send(0.9 * TOP, stage.now_ns + clocks[k % 2] + k)
        stage.run(0.001)
    assert stage.given[-1][1] - begin <= 100.0 * (0.026 + 2 * PERIOD) + 1e-9
    stage.check()


@pytest.mark.parametrize("change", [
    {"acceleration": 300.0}, {"acceleration": 2e4}, {"acceleration": inf}, {"slew": 50.0}, {"upper": 30.0},
    {"lower": 60.0}, {"slew": 20.0, "acceleration": 500.0, "upper": 40.0},
])  # fmt: skip
@pytest.mark.parametrize("when", [0.05, 0.2, 0.35])
def test_acceleration_limits_hold_while_parameters_change_in_motion(change, when):
    """12,223 and 25,812 V/s^2 were seen."""
    limits = Limits(0.0, 100.0, 300.0, 2000.0)
    stage = Stage(limits=limits)
    stage.send(0.9 * TOP)
    stage.run(when)
    new = replace(limits, **change)
    stage.made.use_limits([new], stage.now_ns)
    stage.wire.change(new, PERIOD)
    stage.run(0.1)
    stage.send(0.1 * TOP)
    stage.run(4.0)
    stage.check()
    assert new.lower - 1e-6 <= stage.made.voltages[0] <= new.upper + 1e-6


def test_a_memory_file_of_another_model_keeps_its_last_voltage(tmp_path):
    """The saved state was dropped whole, and the voltage jumped from 48 to 92 V."""
    model, names = StageModel({"x": AXIS}), ["x"]
    MemoryFile(str(tmp_path / "m.json")).save(model, {"x": SavedAxis((100.0, 0.0, 48.0), True)}, True)
    memory = load_memory(tmp_path / "m.json")
    with pytest.raises(ModelError):
        memory.require_fit(replace(model, created="2030-01-01T00:00:00Z"), names)
    stage = Stage(48.0, reporting=False, last=memory.last_voltages)
    stage.send(0.92 * TOP)
    assert abs(stage.given[0][1] - 48.0) <= 0.4 + 1e-9
    stage.run(1.0)
    stage.check()


@pytest.mark.parametrize("told", [0.0, TOP])
@pytest.mark.parametrize("count", [1, 5])
def test_a_sensor_before_the_first_command_moves_no_voltage(told, count):
    """One sample of 0.0 moved the assumed start by 92 V."""
    stage = Stage(35.0)
    for k in range(count):
        stage.made.measure(["x"], [told], stage.now_ns + k)
    stage.send(0.5 * TOP)
    assert abs(stage.given[0][1] - 35.0) <= 0.4 + 1e-9
    stage.run(1.0)
    stage.check()


@pytest.mark.parametrize("there", [100.0, 80.0, -7.0, 130.0])
def test_a_voltage_outside_goes_to_the_nearest_limit_at_the_slew_limit(there):
    """A limit lowered below the present voltage is accepted; so is an amplifier found outside."""
    stage = Stage(there, limits=replace(LIMITS, lower=0.0, upper=60.0))
    stage.send(0.3 * TOP)
    stage.run(2.0)
    stage.check()
    assert 0.0 <= stage.made.voltages[0] <= 60.0
    ways = np.array([there, *(v for _, v in stage.given)])
    assert np.maximum(np.maximum(ways - 60.0, -ways), 0.0).argmax() == 0, "never further out"
    new = replace(LIMITS, upper=10.0)
    stage.made.use_limits([new], stage.now_ns)
    stage.wire.change(new, PERIOD)
    stage.run(1.0)
    stage.check()
    assert 0.0 <= stage.made.voltages[0] <= 10.0 + 1e-9


@pytest.mark.parametrize("span", [None, (20.0, 60.0)])
def test_a_reset_starts_from_the_report_and_stays_within_its_bounds(span):
    """With `reset_on_start` it went from 80 to 32 V at once."""
    stage = Stage(80.0)
    stage.made.reset_memory(3, 1e4, [50.0], stage.now_ns, [span] if span else ())
    assert stage.made.mode is OperatingMode.RESETTING
    stage.run(10.0)
    stage.check()
    assert stage.made.mode is OperatingMode.STREAMING and stage.made.voltages[0] == pytest.approx(50.0, abs=1e-9)
    v = np.array([v for _, v in stage.given])
    low, high = span or (0.0, 100.0)
    inside = v[np.argmax(v <= high) :]
    assert (inside.min(), inside.max()) == (pytest.approx(low, abs=1e-9), pytest.approx(high, abs=1e-9))
    assert abs(v[0] - 80.0) <= 0.4
    # Planned at 80 % of the limit.
    assert np.abs(np.diff(v)).max() <= 0.8 * 0.4 + 1e-9


# Holds

SETTLING = replace(AXIS, effects=(Lag(0.01), Creep((0.1, 1.0), (0.02, 0.02))))


def test_a_single_set_point_settles_although_the_stage_lags_and_creeps():
    stage = Stage(model=SETTLING, limits=replace(LIMITS, slew=1000.0))
    twin = SETTLING.stream()
    y = 0.6 * TOP
    stage.send(y)
    stage.run(8.0)
    stage.check()
    times = np.array([t for t, _ in stage.given])
    at = stage.given[0][0]
    for t, v in stage.given:
        # Linear in between, as the models take it.
        twin.drive(v, (t - at) * 1e-9)
        at = t
    assert twin.drive(twin.voltage, (stage.now_ns - at) * 1e-9) == pytest.approx(y, abs=3e-9)
    # At the output rate while it settles, then once a second.
    moving = times[times < times[0] + SECOND]
    assert np.median(np.diff(moving)) == MS
    stage.given.clear()
    stage.run(60.0)
    assert len(stage.given) <= 61
    assert stage.axis.motion.kind is Kind.HOLD


def test_a_timeout_holds_the_voltage_and_not_the_displacement():
    """Without commands nobody may be there: no voltage follows the creep of the stage, or its sensor."""
    stage = Stage(model=SETTLING, limits=replace(LIMITS, slew=1000.0))
    stage.send(0.6 * TOP)
    stage.run(0.5)
    assert stage.axis.motion.kind is Kind.HOLD and len(set(stage.given[-20:])) == 20
    assert stage.made.watch(Safety(0.4, False, False, (0.0,), 50.0), 0.0, stage.now_ns)
    stage.given.clear()
    stage.run(5.0)
    assert not stage.given and stage.axis.motion.kind is not Kind.HOLD
    stage.send(0.6 * TOP)
    stage.run(4.0)
    assert stage.axis.motion.kind is Kind.HOLD
    stage.check()


@pytest.mark.parametrize(("interval_ms", "begin_ms"), [(1, 20), (5, 20), (10, 30), (50, 150)])
def test_a_hold_begins_after_three_intervals_and_never_between_samples(interval_ms, begin_ms):
    stage = Stage(model=SETTLING, limits=Limits(0.0, 100.0))
    for k in range(200):
        stage.send((0.6 + 0.25 * np.sin(0.02 * k * interval_ms)) * TOP)
        sent = len(stage.given)
        if k > 3:
            stage.run(interval_ms * 1e-3 - 1e-9)
            assert len(stage.given) == sent and stage.axis.motion.kind is not Kind.HOLD
            stage.run(1e-9)
        else:
            stage.run(interval_ms * 1e-3)
    last_ns = stage.now_ns - interval_ms * MS
    stage.run(1.0)
    assert stage.given[sent][0] - last_ns == pytest.approx(begin_ms * MS, abs=2 * MS)


def test_without_effects_and_feedback_nothing_follows_a_set_point_that_is_reached():
    stage = Stage(limits=Limits(0.0, 100.0))
    stage.send(0.5 * TOP)
    stage.run(5.0)
    assert len(stage.given) == 1


# Everything at once


@example(3002297)
@example(3004729)
@example(55207689)
@given(st.integers(0, 2**31))
def test_random_episodes_keep_all_limits(seed):
    """An independent oracle at the amplifier; a restart, an intruder or a lie of a sensor is no excuse."""
    ratios = Episode(seed).run()
    for name in ("step", "slew", "acceleration", "start"):
        assert getattr(ratios, name) <= 1.0 + 1e-6, (name, ratios.what.get(name))
    assert ratios.outside <= 0.0, ratios.what
