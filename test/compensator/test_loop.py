"""The closed loop of an axis, and what its measurements say of the model."""

from dataclasses import replace

import numpy as np
import pytest
from strategies import FAMILY_CASE, PI_CASE, axis_model

from slpi_ros.compensator.axis import Axis
from slpi_ros.compensator.feedback import ENOUGH, WINDOW, LoopSettings, PidGains, ResidualWindow
from slpi_ros.compensator.motion import Kind, Ramp
from slpi_ros.compensator.validation import RejectedError
from slpi_ros.effects.sensor_periodic import SensorPeriodic
from slpi_ros.model.limits import Limits
from slpi_ros.model.sensor import Sensor

LIMITS = Limits(0.0, 100.0, 2000.0)
MODEL = replace(axis_model(FAMILY_CASE), displacement_range=(2e-6, 14e-6))
OFF = LoopSettings(False, PidGains(2e6, 1e8, 0.0), 0.1)
ON = replace(OFF, enabled=True)
DT, MS = 1e-3, 1_000_000


class Bench:
    """An axis whose stage is the model, but for an offset of its voltage: a stage that has drifted."""

    def __init__(self, settings: LoopSettings, offset: float = 0.0, limits: Limits = LIMITS) -> None:
        self.now_ns = 0
        self.axis = Axis("x", limits, settings)
        self.axis.use(MODEL, self.axis.prepare(MODEL))
        self.stage, self.offset = FAMILY_CASE.memory(), offset
        self.measured = self.stage.forward(offset)
        self.voltages: list[float] = []

    def move(self, dt: float, y: float) -> float:
        return self.axis.update(dt, y, self.now_ns)

    def run(self, path: np.ndarray, measuring: bool = True) -> np.ndarray:
        """Return the errors, shape (N,), metres, along a path, shape (N,), metres."""
        errors = []
        for y in path.tolist():
            self.now_ns += MS
            if measuring:
                self.axis.measure(self.measured, self.now_ns)
            v = self.move(DT, y)
            self.voltages.append(v)
            self.measured = self.stage.forward(v + self.offset)
            errors.append(self.measured - y)
        return np.array(errors)


PATH = 8e-6 - 4e-6 * np.cos(np.linspace(0.0, 12.0, 3000))
START = np.linspace(2e-6, PATH[0], 400)


def test_feedback_takes_away_what_the_model_does_not_know():
    alone, corrected = Bench(OFF, 3.0), Bench(ON, 3.0)
    for bench in (alone, corrected):
        bench.run(START)
    late = slice(1000, None)
    without, with_feedback = (np.abs(bench.run(PATH)[late]).mean() for bench in (alone, corrected))
    assert without > 2e-7 and with_feedback < without / 20
    assert alone.axis.loop.state == "off" and corrected.axis.loop.state == "on"
    assert corrected.axis.loop.correction == pytest.approx(-3.0, abs=0.3)


def test_a_measurement_is_held_against_the_wish_that_it_answers():
    """On a ramp a stage that does what the model says leaves nothing to correct."""
    bench = Bench(ON)
    bench.run(START)
    bench.run(np.linspace(PATH[0], 11e-6, 1000))
    assert abs(bench.axis.loop.correction) < 1e-6


@pytest.mark.parametrize("enabled", [True, False])
def test_other_gains_after_a_slope_beyond_reason(enabled):
    silent = replace(ON, gains=PidGains(0.0, 0.0, 1e-300), enabled=enabled)
    bench = Bench(silent)
    bench.run(START)
    for measured in (2e-6, 14e-6):
        bench.axis.measure(measured, bench.now_ns)
        bench.move(1e-9, float(START[-1]))
    before = bench.axis.voltage
    bench.axis.retune(replace(silent, gains=PidGains(0.0, 0.0, 1e306)))
    assert bench.move(DT, float(START[-1])) == pytest.approx(before, abs=1e-9)
    bench.axis.retune(replace(silent, gains=PidGains(1e2, 1e8)))
    assert bench.move(DT, float(START[-1])) == pytest.approx(before, abs=1e-9)
    # Another takes over, and acts.
    bench.run(PATH[:500])
    assert bench.axis.loop.state == ("on" if enabled else "off")


def test_without_feedback_measurements_change_no_voltage():
    heard, deaf = Bench(OFF, 3.0), Bench(OFF, 3.0)
    heard.run(PATH)
    deaf.run(PATH, measuring=False)
    assert heard.voltages == pytest.approx(deaf.voltages, abs=1e-12)
    assert deaf.axis.loop.drift is None and heard.axis.loop.drift.samples == WINDOW


def test_stale_and_absurd_measurements_do_not_act_and_the_correction_stays():
    bench = Bench(ON, 3.0)
    bench.run(START)
    bench.run(PATH[:1000])
    kept = bench.axis.loop.correction
    assert kept < -2.0
    for spoil in (None, np.nan, np.inf, 1e308):
        if spoil is not None:
            with pytest.raises(RejectedError):
                bench.axis.measure(spoil, bench.now_ns)
        # Between measurements the correction stays; after their timeout that is said.
        bench.now_ns += 101 * MS
        bench.move(DT, float(PATH[1000]))
        assert bench.axis.loop.state == "holding"
        assert bench.axis.loop.correction == pytest.approx(kept, abs=1e-9)
    bench.axis.measure(9e-6, bench.now_ns)
    bench.now_ns += 200 * MS
    bench.move(DT, PATH[1000])
    assert bench.axis.loop.state == "holding"


@pytest.mark.parametrize("absurd", [17e-6, -1e-6, 1e-3, -1e300, 1e300, np.nan, np.inf])
def test_a_measurement_that_cannot_be_acts_on_nothing(absurd):
    """As far outside the identified displacements as no wish may be: a wrong unit, a sensor that fails."""
    bench, undisturbed = Bench(ON, 3.0), Bench(ON, 3.0)
    for each in (bench, undisturbed):
        each.run(START)
        each.run(PATH[:600])
    for each in (bench, undisturbed):
        for y in PATH[600:610].tolist():
            if each is bench:
                with pytest.raises(RejectedError, match="^[^\n]+$") as caught:
                    each.axis.measure(absurd, each.now_ns)
                assert caught.value.cause == ("out_of_range" if np.isfinite(absurd) else "not_finite")
            each.run(np.array([y]), measuring=False)
    assert bench.voltages == undisturbed.voltages
    assert bench.axis.loop.drift == undisturbed.axis.loop.drift


@pytest.mark.parametrize("first", [1e-3, np.nan])
def test_a_measurement_that_cannot_be_does_not_hide_one_that_came_before(first):
    bench, other = Bench(ON, 3.0), Bench(ON, 3.0)
    for each in (bench, other):
        each.run(START)
        each.axis.measure(each.measured, each.now_ns)
    with pytest.raises(RejectedError):
        bench.axis.measure(first, bench.now_ns)
    assert bench.move(DT, PATH[0]) == other.move(DT, PATH[0])
    assert bench.axis.loop.state == "on"


def test_switching_the_feedback_makes_no_jump():
    bench = Bench(OFF, 3.0)
    bench.run(START)
    for settings in (ON, OFF, replace(ON, gains=PidGains(1e6, 3e8)), ON, OFF):
        bench.axis.retune(settings)
        bench.run(np.full(300, PATH[0]))
    steps = np.abs(np.diff(bench.voltages))[len(START) :]
    assert 0.0 < steps.max() < 0.1


@pytest.mark.parametrize("acceleration", [np.inf, 2e5])
def test_voltages_in_total_keep_to_all_limits(acceleration):
    limits = Limits(0.0, 60.0, 500.0, acceleration)
    bench = Bench(ON, 8.0, limits)
    rng = np.random.default_rng(3)
    bench.run(np.repeat(rng.uniform(2e-6, 12e-6, 60), 40))
    v = np.array([0.0, *bench.voltages])
    assert v.min() >= 0.0 and v.max() <= 60.0 and v.max() > 59.0
    # After a rest, two output periods count; in motion within an acceleration limit, the last one.
    steps, rested = np.abs(np.diff(v)), np.append(True, np.diff(v)[:-1] == 0.0) & (acceleration == np.inf)
    assert (steps <= 500.0 * DT * np.where(rested, 2.0, 1.0) + 1e-9).all()
    if acceleration < np.inf:
        assert np.abs(np.diff(v, 2)).max() <= acceleration * DT**2 + 1e-9


def test_a_new_model_takes_over_without_a_jump_and_keeps_the_correction():
    bench = Bench(ON, 3.0)
    bench.run(START)
    bench.run(PATH[:1000])
    voltage, correction = bench.axis.voltage, bench.axis.loop.correction
    other = replace(MODEL, quality=replace(MODEL.quality, rms=1e-9))
    bench.axis.use(other, bench.axis.prepare(other))
    assert (bench.axis.voltage, bench.axis.loop.correction) == (voltage, correction)
    bench.run(PATH[1000:1010])
    assert abs(bench.voltages[-10] - voltage) <= 2.0


def test_a_drive_starts_at_the_voltage_in_total_and_the_path_goes_on_from_its_end():
    bench = Bench(ON, 3.0)
    bench.run(START)
    bench.run(PATH[:1000])
    before = bench.axis.voltage
    bench.axis.begin(Ramp([20.0], 1000.0), bench.now_ns)
    way = []
    while bench.axis.motion.kind is Kind.RAMP:
        bench.now_ns += MS
        bench.axis.tick(bench.now_ns)
        way.append(bench.axis.voltage)
    assert abs(way[0] - before) <= 1.0 + 1e-9 and np.abs(np.diff(way)).max() <= 1.0 + 1e-9
    bench.axis.end_ramp(bench.now_ns)
    assert bench.axis.voltage == 20.0 and bench.axis.loop.correction == 0.0
    assert bench.axis.reversal_voltages[-1] == 20.0
    assert bench.move(0.0, PATH[1000]) == 20.0, "no time has passed since the last step"
    bench.now_ns += MS
    assert 0.0 < abs(bench.move(DT, PATH[1000]) - 20.0) <= 2.0 + 1e-9


def test_the_health_of_a_stage_as_identified_is_its_noise_and_of_another_more():
    """Moving or not, as long as the answer comes before the sample after the next."""
    rng = np.random.default_rng(1)
    for offset, low, high in ((0.0, 7e-9, 9e-9), (3.0, 2e-7, 1e-6)):
        bench = Bench(OFF, offset)
        bench.run(START)
        for y in [PATH[0]] * WINDOW:
            bench.axis.measure(bench.measured + rng.normal(0.0, 8e-9), bench.now_ns)
            bench.run(np.array([y]), measuring=False)
        assert low < bench.axis.loop.drift.rms < high
        bench.run(PATH[:WINDOW])
        assert bench.axis.loop.drift.rms <= high


def test_residuals_are_counted_in_a_window_and_only_outside_of_what_was_expected():
    window = ResidualWindow(0.0)
    for _ in range(ENOUGH - 1):
        window.measure(1.0)
    assert window.drift() is None
    window.measure(1.0)
    assert (window.drift().rms, window.drift().mean) == (1.0, 1.0)
    window.expect(10.0)
    for i in range(WINDOW):
        window.measure((0.0, 10.0, 5.0, -1.0, 11.0)[i % 5])
    drift = window.drift()
    assert drift.samples == WINDOW
    assert (drift.rms, drift.mean) == (pytest.approx(0.4**0.5), pytest.approx(0.0))


def test_an_axis_without_a_model_takes_no_measurement():
    axis = Axis("x", LIMITS, ON)
    axis.measure(1e-6, 0)
    assert axis.loop.drift is None
    model = axis_model(PI_CASE)
    axis.use(model, axis.prepare(model))
    assert axis.loop.state == "holding"


# The sensor is not the stage


SENSOR = SensorPeriodic(3e-7, 2e-8, 1.0)


class SensedBench(Bench):
    """A bench whose sensor has a periodic error, a delay (whole samples) and a lag, which the model knows."""

    def __init__(self, settings: LoopSettings, offset: float, delay: int, lag: float, known: bool = True) -> None:
        super().__init__(settings, offset)
        model = replace(MODEL, effects=(SENSOR,), sensor=Sensor(delay * DT, lag)) if known else MODEL
        self.axis.use(model, self.axis.prepare(model))
        self.true = self.measured
        self._kept = np.exp(-DT / lag) if lag else 0.0
        self._lagged = self._says(self.true)
        self._late = [self._lagged] * delay

    @staticmethod
    def _says(x: float) -> float:
        return x + 2e-8 * np.sin(2 * np.pi * x / 3e-7 + 1.0)

    def run(self, path: np.ndarray, measuring: bool = True) -> np.ndarray:
        """Return the errors of the stage itself, shape (N,), metres, along a path, shape (N,), metres."""
        errors = []
        for y in path.tolist():
            self.now_ns += MS
            # Half a sample ago; the stage has been where it is since the last one.
            now = self._says(self.true)
            self._late.append(now + (self._lagged - now) * self._kept**0.5)
            self._lagged = now + (self._lagged - now) * self._kept
            reading = float(self._late.pop(0))
            if measuring:
                self.axis.measure(reading, self.now_ns - MS // 2)
            v = self.move(DT, y)
            self.voltages.append(v)
            self.true = self.stage.forward(v + self.offset)
            errors.append(self.true - y)
        return np.array(errors)


@pytest.mark.parametrize(("delay", "lag"), [(0, 0.0), (7, 0.0), (0, 0.005), (7, 0.005)])
def test_feedback_brings_the_stage_to_the_setpoint_and_not_its_sensor(delay, lag):
    """Everywhere on the sensor's period: with a stage that has drifted, the stage itself ends at the setpoint."""
    slow = replace(ON, gains=PidGains(0.0, 1e8, 0.0))
    for target in np.linspace(7e-6, 7.3e-6, 5).tolist():
        bench = SensedBench(slow, 3.0, delay, lag)
        bench.run(np.linspace(2e-6, target, 400))
        left = bench.run(np.full(1500, target))
        assert abs(left[-1]) < 1e-11
        assert abs(bench.axis.tracking.report().latest) < 1e-11
        assert abs(bench.axis.tracking.report().latest - left[-1]) < 1e-12


@pytest.mark.parametrize(("delay", "lag"), [(0, 0.0), (7, 0.0), (0, 0.005), (7, 0.005)])
def test_a_late_sensor_on_a_moving_stage_is_no_error(delay, lag):
    """A stage that does what the model says gets no correction, has no tracking error and is healthy, as it moves."""
    known, unknown = SensedBench(ON, 0.0, delay, lag), SensedBench(ON, 0.0, delay, lag, known=False)
    for bench in (known, unknown):
        bench.run(START)
        bench.run(PATH)
    assert known.axis.loop.state == "on"
    assert abs(known.axis.loop.correction) < 1e-6
    assert known.axis.tracking.report().maximum < 1e-12
    assert known.axis.loop.drift.rms < 1e-12
    assert unknown.axis.tracking.report().maximum > 1e-8
    assert abs(unknown.axis.loop.correction) > 1e-4


@pytest.mark.parametrize(("delay", "lag"), [(0, 0.0), (7, 0.0), (7, 0.005)])
def test_a_slow_sensor_does_not_hide_what_the_model_lacks(delay, lag):
    """Ten samples from reading to reading: the health is that of the model, not within the motion in between."""
    bench = SensedBench(OFF, 3.0, delay, lag)
    bench.run(START)
    for k in range(0, PATH.size, 10):
        bench.run(PATH[k : k + 9], measuring=False)
        bench.run(PATH[k + 9 : k + 10])
    assert bench.axis.loop.drift.rms > 2e-7


def test_a_late_reading_from_before_the_path_corrects_nothing():
    bench = SensedBench(ON, 0.0, 20, 0.0)
    bench.run(START[:15])
    assert bench.axis.loop.state == "holding" and not bench.axis.tracking.fresh
    bench.run(START[15:30])
    assert bench.axis.loop.state == "on" and bench.axis.tracking.fresh
    bench.axis.begin(Ramp([60.0], 1000.0), bench.now_ns)
    while bench.axis.motion.kind is Kind.RAMP:
        bench.now_ns += MS
        bench.axis.tick(bench.now_ns)
        bench.axis.measure(6e-6, bench.now_ns)
    bench.axis.end_ramp(bench.now_ns)
    bench.axis.tracking.report()
    bench.now_ns += MS
    bench.move(DT, 8e-6)
    bench.now_ns += 5 * MS
    # It tells where the stage was on the ramp.
    bench.axis.measure(5e-6, bench.now_ns)
    assert not bench.axis.tracking.fresh
    bench.move(DT, 8e-6)
    assert bench.axis.loop.correction == 0.0 and bench.axis.loop.state == "holding"
