"""Faults of the sensor under feedback: each named in time, and none where there is none."""

from dataclasses import replace

import numpy as np
import pytest
from strategies import FAMILY_CASE, axis_model

from slpi_ros.compensator.controller import Controller
from slpi_ros.compensator.feedback import LoopSettings, PidGains
from slpi_ros.compensator.motion import Safety
from slpi_ros.compensator.sensor_rule import SensorRule
from slpi_ros.model.limits import Limits
from slpi_ros.model.stage_model import StageModel

MS = 1_000_000
SPAN, NOISE = 10e-6, 10e-9
FAULT_TIME = 0.5


def watched(model, reading, seconds, period=0.002):
    """Return the fault and its time (s) after 1 s of good readings; `reading` takes times and true places (m)."""
    watch, rng = SensorRule(SPAN, NOISE), np.random.default_rng(1)
    watch.fault_time = FAULT_TIME
    watch.begin()
    t = np.arange(0.0, 1.0 + seconds, period)
    true = model(t)
    told = np.where(t < 1.0, true, reading(t, true)) + rng.normal(0.0, NOISE, t.size)
    for now, expected, y in zip(t.tolist(), true.tolist(), told.tolist(), strict=True):
        now_ns = round(now * 1e9)
        if not np.isnan(y):
            watch.read(expected, y, now_ns)
        fault = watch.check(now_ns)
        if fault:
            assert "\n" not in fault.reason
            return fault.kind, now - 1.0
    return None, None


def sine(frequency, share=0.4):
    return lambda t: SPAN * (0.5 + share * np.sin(2 * np.pi * frequency * t))


LIES = {
    "stuck": lambda t, y: np.full(t.size, y[t < 1.0][-1]),
    "inverted": lambda t, y: 2 * y[t < 1.0][-1] - y,
    "noisy": lambda t, y: y + np.random.default_rng(2).normal(0.0, 0.1 * SPAN, t.size),
    "silent": lambda t, y: np.full(t.size, np.nan),
}


@pytest.mark.parametrize("kind", LIES)
@pytest.mark.parametrize("frequency", [1.0, 3.0])
def test_each_fault_is_named_within_its_time_after_it_shows(kind, frequency):
    """It shows once the model has moved by 2 % of the range: of these waves within 0.15 s."""
    found, after = watched(sine(frequency), LIES[kind], 3.0)
    assert found == kind
    assert 0.0 < after <= FAULT_TIME + 0.2


@pytest.mark.parametrize("model", [sine(0.05), sine(1.0), sine(5.0), sine(2.0, 0.01), lambda t: np.full(t.size, 5e-6)])
@pytest.mark.parametrize("delay", [0.0, 0.01, 0.05])
def test_a_late_sensor_is_no_fault(model, delay):
    def late(t, y):
        return model(t - delay)

    assert watched(model, late, 3.0) == (None, None)


@pytest.mark.parametrize("model", [sine(1.0), sine(5.0), sine(2.0, 0.01), lambda t: np.full(t.size, 5e-6)])
@pytest.mark.parametrize("reading", [
    lambda t, y: y + np.random.default_rng(3).normal(0.0, 8 * NOISE, t.size),
    lambda t, y: y + 0.02 * SPAN * np.sin(2 * np.pi * 80.0 * t) * np.exp(-((t - 1.0) % 0.3) / 0.05),
    lambda t, y: 0.8 * y, lambda t, y: 1.3 * y + 1e-6,
    lambda t, y: np.where(np.arange(t.size) % 20 == 0, y, np.nan),
], ids=["noisy", "resonating", "80 %", "130 %", "slow"])  # fmt: skip
def test_a_sensor_that_is_only_poor_is_no_fault(model, reading):
    assert watched(model, reading, 3.0) == (None, None)


# In the loop

MODEL = replace(axis_model(FAMILY_CASE), displacement_range=(2e-6, 14e-6))
LIMIT = 5.0


class Loop:
    """A compensator with feedback at 500 Hz, and a stage that is the model but for an offset (V)."""

    def __init__(self, offset=0.0, limit=LIMIT):
        self.made = Controller(
            ["x"], [Limits(0.0, 100.0, 1000.0)], loops=[LoopSettings(True, PidGains(1e6, 1e8), 0.1, limit)]
        )
        self.made.use_model(StageModel({"x": MODEL}))
        self.made.activate(0)
        self.axis, self.stage, self.offset = self.made.axes[0], FAMILY_CASE.memory(), offset
        self.now_ns, self.faults = 0, []

    def run(self, seconds, sensor=lambda y, t: y):
        for _ in range(round(seconds * 500)):
            self.now_ns += 2 * MS
            t = self.now_ns * 1e-9
            told = sensor(self.stage.displacement, t)
            if told is not None:
                self.made.measure(["x"], [told], self.now_ns)
            self.made.update(self.now_ns, ["x"], [8e-6 - 3e-6 * np.cos(3.0 * t)], self.now_ns)
            self.stage.forward(self.made.voltages[0] + self.offset)
            found = self.made.watch(Safety(0.0, False, False, (0.0,), 50.0), FAULT_TIME, self.now_ns)
            self.faults += [(each.kind, t) for each in found if each.rule == "sensor"]


@pytest.mark.parametrize(("kind", "sensor"), [
    ("stuck", lambda y, t: 6e-6), ("inverted", lambda y, t: 16e-6 - y), ("silent", lambda y, t: None),
])  # fmt: skip
def test_feedback_on_a_sensor_that_lies_is_bounded_and_switched_off_feedforward_going_on(kind, sensor):
    """It ran to the voltage limit, with no line that names it."""
    loop = Loop()
    loop.run(2.0)
    assert loop.axis.loop.state == "on" and not loop.faults
    most, begin = 0.0, loop.now_ns
    for _ in range(100):
        loop.run(0.02, sensor)
        most = max(most, abs(loop.axis.loop.correction))
    assert most <= LIMIT + 1e-9
    assert [found for found, _ in loop.faults] == [kind]
    assert loop.faults[0][1] - begin * 1e-9 <= FAULT_TIME + 0.3
    assert loop.axis.loop.state == "fault"
    loop.run(1.0, sensor)
    assert abs(loop.axis.loop.correction) < 1e-3, "it fades"
    assert loop.stage.displacement == pytest.approx(8e-6 - 3e-6 * np.cos(3.0 * loop.now_ns * 1e-9), abs=2e-8)
    # Said again, it acts again.
    loop.axis.retune(LoopSettings(True, PidGains(1e6, 1e8), 0.1, LIMIT))
    loop.run(1.0)
    assert loop.axis.loop.state == "on" and len(loop.faults) == 1


def test_a_reading_that_jumps_is_not_inverted():
    """Feedback moves against the jump, which looked like a sensor of the wrong sign."""
    rule = SensorRule(SPAN, NOISE)
    rule.fault_time, noise = FAULT_TIME, np.random.default_rng(5)
    for k in range(400):
        t = 5e-3 * k
        expected = 10e-6 - 1.5e-6 * min(max((t - 1.0) / 0.1, 0.0), 1.0)
        jumped = 3e-6 if t >= 0.99 else 0.0
        rule.read(expected, expected + jumped + noise.normal(0.0, NOISE), k * 5 * MS)
        assert rule.check(k * 5 * MS) is None


def test_a_correction_at_its_limit_is_saturated_and_no_fault():
    loop = Loop(offset=-8.0)
    loop.run(4.0)
    assert loop.axis.loop.state == "saturated" and not loop.faults
    assert loop.axis.loop.correction == pytest.approx(LIMIT)
    loop.offset = -2.0
    loop.run(2.0)
    assert loop.axis.loop.state == "on" and loop.axis.loop.correction == pytest.approx(2.0, abs=0.2)


def test_feedback_that_is_switched_on_while_nobody_sends_awaits_its_sensor_from_then_on():
    """Counted from the last command, it was silent before the first reading."""
    loop = Loop()
    loop.run(1.0)
    loop.run(1.0, lambda y, t: None)
    assert [kind for kind, _ in loop.faults] == ["silent"]
    loop.now_ns += 3_000 * MS
    loop.axis.retune(LoopSettings(True, PidGains(1e6, 1e8), 0.1, LIMIT))
    safety = Safety(0.0, False, False, (0.0,), 50.0)
    assert not loop.made.watch(safety, FAULT_TIME, loop.now_ns)
    assert not loop.made.watch(safety, FAULT_TIME, loop.now_ns + 499 * MS)
    assert [found.kind for found in loop.made.watch(safety, FAULT_TIME, loop.now_ns + 500 * MS)] == ["silent"]


def test_readings_that_come_too_late_are_none():
    """They read 1 um above the model, by their stamps 0.3 s ago: nothing follows them, and the fault says so."""
    model = axis_model(FAMILY_CASE)
    made = Controller(["x"], [Limits(0.0, 100.0, 1000.0)], loops=[LoopSettings(True, PidGains(1e5, 1e8), 0.1)])
    made.configure()
    made.use_model(StageModel({"x": model}))
    now, found = 10**9, []
    made.activate(now)

    def run(count, ages, off):
        nonlocal now
        for _ in range(count):
            now += MS
            made.update(now, ["x"], [10e-6], now)
            for age in ages:
                made.measure(["x"], [made.axes[0].expected + off], now, age <= 0.2, age)
            found.extend(made.watch(Safety(0.0, False, False, (0.0,), 50.0), FAULT_TIME, now))

    loop = made.axes[0].loop
    run(200, [0.099], 0.0)
    before = loop.correction
    assert loop.state == "on" and loop.sensor.stale == 0.0
    run(300, [0.3], 1e-6)
    # It would be 30 V.
    assert loop.correction == pytest.approx(before, abs=1e-3) and loop.state == "holding" and not found
    assert loop.sensor.stale == 0.3
    run(300, [0.3], 1e-6)
    assert [each.kind for each in found] == ["silent"]
    assert "no measured_displacement for 0.5 s" in found[0].reason
    assert "stamped 0.3 s ago, longer than measurement_timeout" in found[0].reason
    # Without a fault of the clock they count again.
    run(1, [0.0], 0.0)
    assert loop.sensor.stale == 0.0
