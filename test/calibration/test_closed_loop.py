"""Tuned feedback in a calibration: the path that shows it, the loop around a drive, and all of it on a stage."""

import math
import pickle
from dataclasses import replace

import numpy as np
import pytest
from calibration.stages import SimulatedRecorder, settings, stage_of
from strategies import PI_CASE, axis_model

from slpi_ros.calibration.closed_loop import RASTER, STEPS, AxisLoop, ClosedLoop, moving, showing, too_slow
from slpi_ros.calibration.run import calibrate
from slpi_ros.compensator.feedback import PidGains
from slpi_ros.compensator.gains_file import TunedGains
from slpi_ros.compensator.loop_design import design
from slpi_ros.effects.filters import Mode
from slpi_ros.effects.resonance import Resonance
from slpi_ros.effects.sensor_periodic import SensorPeriodic
from slpi_ros.model.limits import Limits
from slpi_ros.model.stage_model import StageModel
from slpi_ros.reports.calibration import GAINS, write_files
from slpi_ros.simulation.character import Character
from slpi_ros.verification.step_answers import step_answers

RATE, SLOPE = 200.0, 2e-7


def test_each_axis_shows_its_steps_while_the_others_rest():
    model = StageModel({"x": axis_model(PI_CASE), "y": axis_model(PI_CASE)})
    paths = showing(settings("xy"), model)
    moves = {name: np.flatnonzero(np.diff(path)) for name, path in paths.items()}
    assert moves["x"][-1] < moves["y"][0] and paths["x"].size == paths["y"].size
    low, high = model.axis("x").displacement_range
    for path in paths.values():
        assert low <= path.min() and path.max() <= high
        found = step_answers(np.arange(path.size) / RATE, path, np.zeros(path.size), 0.0)
        assert [each.size for each in found] == pytest.approx([size * (high - low) for size in STEPS])
        # The raster is what moves on, also where the record was read between two setpoints.
        read = np.interp(np.arange(2 * path.size) / 2.0, np.arange(path.size), path)
        raster = read[moving(read)]
        assert np.ptp(raster) == pytest.approx(RASTER * (high - low), rel=0.02)
        assert np.all(np.diff(raster) != 0.0) and raster.size == pytest.approx(4 * RATE, abs=8)


def test_readings_correct_the_drive_along_its_path_only():
    # A sensor that reads too much by a wave of 20 nm, as the model knows.
    wave = SensorPeriodic(3e-7, 2e-8, 1.0)
    model = replace(axis_model(PI_CASE), effects=(wave,))
    sensor = model.streaming_sensor()
    loops = [AxisLoop.of(PidGains(0.0, ki), model) for ki in (20.0 / SLOPE, 0.0)]
    loop = ClosedLoop(pickle.loads(pickle.dumps(loops)), [Limits(0.0, 100.0)] * 2, RATE, [50.0, 50.0])
    sent = []
    for k in range(600):
        # Feedforward is 1 V off.
        desired = 51.0 * SLOPE if 100 <= k < 400 else math.nan
        sent.append(loop.goals([50.0, 50.0], [desired, desired], k * 5_000_000 + 1))
        loop.measure([sensor.measure(SLOPE * v) for v in sent[-1]], k * 5_000_000 + 2)
    x, y = np.array(sent).T
    assert np.all(x[:100] == 50.0) and x[399] == pytest.approx(51.0, abs=1e-6)
    assert np.all(np.abs(np.diff(x)) < 0.2) and x[-1] == pytest.approx(50.0, abs=1e-3)
    # An axis without gains has no feedback.
    assert np.all(y == 50.0) and not loop.off


def test_an_oscillation_that_it_sustains_switches_it_off():
    """As with readings that are 50 ms late, which the gains are not made for."""
    model = axis_model(PI_CASE)
    loop = ClosedLoop([AxisLoop.of(PidGains(0.0, 50.0 / SLOPE), model)], [Limits(0.0, 100.0)], RATE, [50.0], ["x"])
    late, sent = [50.0] * 10, []
    for k in range(1200):
        sent += loop.goals([50.0], [51.0 * SLOPE], k * 5_000_000 + 1)
        late.append(sent[-1])
        loop.measure([SLOPE * late.pop(0)], k * 5_000_000 + 2)
    assert loop.off.startswith("axis 'x': it oscillated at")
    assert np.ptp(sent[:600]) > 20.0 and np.all(np.abs(np.array(sent[-100:]) - 50.0) < 1e-3)


def test_a_loop_that_is_computed_too_seldom_shows_nothing_of_its_gains():
    model = replace(axis_model(PI_CASE), effects=(Resonance((Mode(30.0, 0.1, 1.0),)),))
    gains = design(model, RATE).gains
    assert [too_slow(model, gains, period) for period in (1.0 / RATE, 1.2 / RATE, 0.1)] == [False, False, True]


@pytest.mark.slow
@pytest.mark.long
def test_a_calibration_with_tuning_shows_its_loop_on_the_stage(tmp_path):
    recorder = SimulatedRecorder(stage_of(Character(creep=0.01, resonance=30.0, damping=0.1)))
    outcome = calibrate(settings(tune=True, limits=(Limits(0.0, 100.0, 1000.0),)), recorder, clock=lambda: recorder.now)
    loop = outcome.loops["x"]
    assert loop.design is not None and loop.design.bandwidth > 2.0
    assert [each.count for each in loop.steps] == [2, 2]
    # Feedback takes creep and hysteresis out before the next step.
    assert all(each.quiet is not None for each in loop.steps)
    assert recorder.requests[-1].loops["x"].gains == loop.design.gains
    assert outcome.seconds <= outcome.settings.budget
    write_files(tmp_path, outcome)
    assert TunedGains.read(str(tmp_path / GAINS)) == TunedGains(RATE, {"x": loop.design.gains})
    assert "Feedback of axis x" in (tmp_path / "report.html").read_text()
