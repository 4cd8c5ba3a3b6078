"""The loop goes by the clock of the node: how often desired displacements come makes no other loop of it."""

from dataclasses import replace

import numpy as np
import pytest
from strategies import PI_CASE, axis_model

from slpi_ros.compensator.controller import Controller
from slpi_ros.compensator.feedback import LoopSettings, PidGains
from slpi_ros.effects.delay import Delay
from slpi_ros.hysteresis.prandtl_ishlinskii import PrandtlIshlinskii
from slpi_ros.hysteresis.turning_points import Memory
from slpi_ros.model.axis_model import Start
from slpi_ros.model.limits import Limits
from slpi_ros.model.stage_model import StageModel

MS, START, SLOPE = 1_000_000, 10**12, 1e-7
LINEAR = PrandtlIshlinskii(np.array([0.0]), np.array([SLOPE]))
MODEL = replace(
    axis_model(PI_CASE), hysteresis=LINEAR, voltage_range=(0.0, 100.0), displacement_range=(0.0, 1e-5), effects=(),
    start=Start(0.0, 0.0), end=None,
)  # fmt: skip
CROSSOVER = 20.0  # rad/s
GAINS = PidGains(0.0, CROSSOVER / SLOPE)


class Stage:
    """A compensator with feedback whose stage is the model, but for a disturbance, on a made clock.

    The sensor is read 1,000 times a second, apart from the periods of the output.
    """

    def __init__(self, gains: PidGains = GAINS, period: float = 1e-3) -> None:
        self.now_ns = self.read_ns = START + 300_000
        self.made = Controller(["x"], [Limits(0.0, 100.0)], loops=[LoopSettings(True, gains, 0.1)], period=period)
        self.made.use_model(StageModel({"x": MODEL}))
        self.made.activate(self.now_ns)
        self.memory, self.disturbance = Memory(LINEAR), 0.0
        self.given: list[tuple[int, float]] = []
        self.send(5e-6)

    def publish(self) -> None:
        self.given.append((self.now_ns, self.made.voltages[0]))
        self.memory.forward(self.made.voltages[0])

    def send(self, y: float) -> None:
        self.made.update(self.now_ns, ["x"], [y], self.now_ns)
        self.publish()

    def run(self, seconds: float, rate: float, y=lambda t: 5e-6) -> np.ndarray:
        """Return the displacements (m) that are read, (N,), while desired ones come at a rate (Hz; 0: none)."""
        begun_ns, readings = self.now_ns, []
        end_ns = begun_ns + round(seconds * 1e9)
        send_ns = begun_ns + 137_000 if rate else end_ns
        while True:
            due_ns = self.made.next_due_ns(self.now_ns, self.now_ns)
            self.now_ns = min(send_ns, self.read_ns, end_ns if due_ns is None else max(due_ns, self.now_ns), end_ns)
            if self.now_ns >= end_ns:
                return np.array(readings)
            if self.now_ns == self.read_ns:
                self.read_ns += MS
                readings.append(self.memory.displacement + self.disturbance)
                self.made.measure(["x"], [readings[-1]], self.now_ns)
            elif self.now_ns == send_ns:
                send_ns += round(1e9 / rate)
                self.send(y((self.now_ns - begun_ns) * 1e-9))
            elif self.made.advance(self.now_ns, self.now_ns):
                self.publish()


def crossover(rate: float, period: float = 1e-3) -> float:
    """Return the rate (rad/s) at which a disturbance decays, of which an integrator takes away a constant share."""
    stage = Stage(period=period)
    stage.run(0.5, rate)
    stage.disturbance = 1e-7
    error = np.abs(stage.run(0.3, rate) - 5e-6)
    t = np.arange(error.size) * 1e-3
    inner = (error < 0.8e-7) & (error > 0.05e-7)
    return -float(np.polyfit(t[inner], np.log(error[inner]), 1)[0])


@pytest.mark.parametrize("rate", [0.0, 10.0, 100.0, 1000.0, 3000.0])
def test_the_crossover_does_not_depend_on_the_rate_of_the_commands(rate):
    assert crossover(rate) == pytest.approx(CROSSOVER, rel=0.05)


def test_nor_on_the_output_rate_as_long_as_that_is_fast_enough():
    assert crossover(100.0, 2e-3) == pytest.approx(CROSSOVER, rel=0.05)


def test_where_the_rate_changes_there_is_no_bump():
    stage = Stage()
    stage.disturbance = 1e-7
    stage.run(1.0, 100.0)
    stage.given.clear()
    for rate in (1000.0, 10.0, 3000.0, 100.0, 0.0, 50.0):
        errors = stage.run(0.5, rate) - 5e-6
        assert np.abs(errors).max() < 1e-12
    voltages = np.array([v for _, v in stage.given])
    assert np.ptp(voltages) < 1e-6


def test_between_set_points_the_feedforward_stays_and_feedback_goes_on():
    """At 20 set points a second, each is answered at once; between two of them only the correction changes."""
    stage = Stage()
    stage.run(0.5, 20.0)
    stage.disturbance = 1e-7
    stage.given.clear()
    path = lambda t: 5e-6 + 1e-6 * round(20.0 * t) / 20.0  # noqa: E731
    stage.run(0.5, 20.0, path)
    times, v = np.array(stage.given).T
    steps = np.abs(np.diff(v))
    assert np.count_nonzero(steps > 0.2) == 9, "those of the set points but the first, 0.5 V each"
    assert np.median(steps[steps < 0.2]) > 0.0 and steps[steps < 0.2].max() < 0.04
    # With the answers of the set points, one voltage in each output period and not more.
    assert 480 <= v.size <= 520


def test_feedback_is_frozen_in_a_ramp_and_goes_on_without_a_bump():
    stage = Stage()
    stage.disturbance = 1e-7
    stage.run(1.0, 100.0)
    stage.made.ramp([40.0], 1000.0, stage.now_ns)
    stage.run(0.2, 0.0)
    assert stage.made.voltages[0] == 40.0 and stage.made.axes[0].loop.correction == 0.0
    stage.run(0.2, 0.0)
    assert stage.made.voltages[0] == 40.0, "without a set point there is nothing to correct"
    stage.given.clear()
    stage.run(0.5, 100.0, lambda t: 4.1e-6)
    assert np.abs(np.diff([v for _, v in stage.given][1:])).max() < 0.2
    assert stage.memory.displacement + 1e-7 == pytest.approx(4.1e-6, abs=1e-10)


def test_a_late_answer_between_two_set_points_is_no_residual_while_feedback_goes_on():
    """The stage is where it was before the set point for 5 ms more; corrections in between are no other sample."""
    stage = Stage(PidGains(0.0, 1.0))
    stage.run(0.2, 100.0)
    for k in range(600):
        y = 5e-6 + 1e-8 * (k % 200)
        stage.send(y)
        before = stage.memory.displacement - 1e-8 * (k % 200 > 0)
        for ms in range(10):
            stage.now_ns += MS
            stage.made.measure(["x"], [before if ms < 5 else stage.memory.displacement], stage.now_ns)
            if stage.made.advance(stage.now_ns, stage.now_ns):
                stage.publish()
    drift = stage.made.axes[0].loop.drift
    assert drift.samples == 500 and drift.rms < 1e-10


@pytest.mark.parametrize("delay", [0.0, 7e-3])
def test_the_delay_of_the_stage_is_no_error_along_a_trajectory_and_one_along_single_set_points(delay):
    """Points of a trajectory are output earlier: a reading tells of those that the stage has come to."""
    stage, whole = Stage(), StageModel({"x": replace(MODEL, effects=(Delay(delay),) if delay else ())})
    stage.made.use_model(whole)
    late = [stage.memory.displacement] * round(delay * 1e3)
    places = 5e-6 + 2e-6 * np.sin(np.linspace(0.0, 4.0, 800))
    stage.run(0.1, 100.0)
    axis, errors = stage.made.axes[0], []

    def along(k: int) -> None:
        stage.now_ns = START + 10**9 + k * MS
        while (due_ns := stage.made.next_due_ns(stage.now_ns, stage.now_ns)) is not None and due_ns <= stage.now_ns:
            if stage.made.advance(stage.now_ns, stage.now_ns):
                stage.publish()
        late.append(stage.memory.displacement)
        stage.made.measure(["x"], [late.pop(0)], stage.now_ns + MS // 2)
        errors.append(axis.tracking.report().latest)

    begin_ns = START + 10**9 + 20 * MS
    stage.made.follow(["x"], np.arange(places.size) * MS, places[:, None], begin_ns, stage.now_ns, stage.now_ns)
    for k in range(900):
        along(k)
    assert np.abs(errors).max() < 1e-11 and abs(axis.loop.correction) < 1e-4
    for k in range(900, 1700):
        stage.now_ns = START + 10**9 + k * MS
        stage.send(float(places[k - 900]))
        along(k)
    assert (np.abs(errors).max() > 1e-8) == (delay > 0.0)
    # And back to a trajectory from where it is, whose first points are due before the last single ones are reached.
    stage.made.follow(["x"], [50 * MS, 100 * MS], [[5e-6], [5e-6]], 0, stage.now_ns, stage.now_ns)
    for k in range(1700, 2800):
        along(k)
    assert abs(errors[-1]) < 1e-11
