"""The simulated stage with a character: each effect does to a drive what it is named after."""

import numpy as np
import pytest

from slpi_ros.errors import UsageError
from slpi_ros.excitation.drives import excite
from slpi_ros.simulation.axis import SimulatedAxis
from slpi_ros.simulation.character import STRENGTHS, Character, draw
from slpi_ros.simulation.stage import Stage

RATE = 250.0


def driven(stage, drive):
    voltages = np.column_stack(list(drive.voltage.values())).tolist()
    return np.array([stage.step(t, v) for t, v in zip(drive.t.tolist(), voltages, strict=True)])


def stage_with(names=("x",), **effects):
    return Stage.of(names, [Character(**effects)] * len(names), seed=3, noise_rms=0.0)


DRIVE = excite(voltage_min=0.0, voltage_max=100.0, duration=10.0, rate=RATE)
PLAIN = driven(stage_with(), DRIVE)[:, 0]
T, V = DRIVE.t, DRIVE.voltage["x"]


def test_without_effects_it_is_the_random_stage():
    assert np.allclose(PLAIN, driven(Stage.random(["x"], 3), DRIVE)[:, 0], atol=1e-15)


def test_a_delay_shifts_the_whole_response():
    y = driven(stage_with(delay=2 / RATE), DRIVE)[:, 0]
    assert np.allclose(y[2:], PLAIN[:-2], atol=2e-9)


def test_lag_and_rate_dependence_vanish_where_the_voltage_rests():
    ends = np.flatnonzero((V.max() == V) & (np.roll(V, 1) == V.max()) & (np.roll(V, -1) != V.max()))[:1]
    for effects in ({"lag": 0.01}, {"rate_dependence": 2.0}):
        away = np.abs(driven(stage_with(**effects), DRIVE)[:, 0] - PLAIN)
        assert away.max() > 20e-9 and away[ends] < 0.2 * away.max()


def test_saturation_holds_the_displacement_above_its_limit():
    y = driven(stage_with(saturation=80.0), DRIVE)[:, 0]
    above = V > 81.0
    assert np.ptp(y[above]) < 1e-9 < np.ptp(PLAIN[above])


def test_creep_goes_on_while_the_voltage_rests():
    stage = stage_with(creep=0.02)
    stage.step(0.0, [0.0])
    y = [stage.step(t, [80.0])[0] for t in (0.01, 1.0, 10.0)]
    assert y[0] < y[1] < y[2] and y[2] - y[1] == pytest.approx(0.02 * y[0], rel=0.3)


def test_a_resonance_rings_at_its_frequency():
    stage = stage_with(resonance=30.0, damping=0.02)
    stage.step(0.0, [0.0])
    t = np.arange(1, 1001) / 1000
    y = np.array([stage.step(x, [10.0])[0] for x in t.tolist()])
    spectrum = np.abs(np.fft.rfft(y - y.mean()))
    assert np.fft.rfftfreq(t.size, 1e-3)[spectrum.argmax()] == pytest.approx(30.0, abs=1.0)


def test_coupling_moves_the_axis_at_rest():
    stage = stage_with(("x", "y"), coupling=0.02)
    rest = stage.step(0.0, [0.0, 0.0])
    moved = stage.step(0.01, [70.0, 0.0])
    assert moved[1] - rest[1] == pytest.approx(0.02 * (moved[0] - rest[0]), rel=1e-3)


def test_drift_hum_and_sensor_change_the_reading_of_a_resting_axis():
    stage = stage_with(thermal_drift=1e-6, drift_time=10.0)
    assert stage.step(100.0, [0.0]) != (y := stage.step(110.0, [0.0])) and y[0] - PLAIN[0] == pytest.approx(
        1e-6 * (1 - np.exp(-1)), rel=1e-3
    )
    stage = stage_with(hum_amplitude=30e-9, hum_frequency=50.0)
    y = np.array([stage.step(t, [0.0])[0] for t in (np.arange(500) / 1000).tolist()])
    assert np.ptp(y) == pytest.approx(60e-9, rel=0.05)
    error = driven(stage_with(sensor_amplitude=10e-9), DRIVE)[:, 0] - PLAIN
    assert np.abs(error).max() == pytest.approx(10e-9, rel=0.05)


def test_a_gain_drift_grows_with_the_displacement():
    stage = stage_with(gain_drift=0.02, drift_time=1.0)
    begin, end = (stage.step(t, [60.0])[0] - PLAIN[0] for t in (0.0, 50.0))
    assert end == pytest.approx(1.02 * begin, rel=1e-3)


@pytest.mark.parametrize("names", [("x",), ("x", "y")])
def test_hidden_stages_are_drawn_from_their_seed(names):
    stages = [Stage.hidden(names, seed, 8e-9, rate=RATE, voltage_max=100.0) for seed in (*range(12), 0)]
    found = [tuple(axis.character for axis in stage.axes.values()) for stage in stages]
    assert found[0] == found[-1] and len(set(found)) == 12
    for stage in stages:
        for effects in stage.effects.values():
            assert 1 <= len(effects) <= 2
            assert len(names) == 1 or "cross_coupling" in effects


def test_impossible_characters_are_refused():
    wrong = {"lag": -1e-3, "creep": float("nan"), "resonance": -1.0, "damping": 1.0, "sensor_amplitude": 1e-6}
    wrong |= {"creep_shortest": 0.0, "creep_longest": 1e-3, "delay": float("inf"), "coupling": 0.5}
    for name, value in (*wrong.items(), ("creep", 0.3), ("damping", 0.0)):
        with pytest.raises(UsageError, match=name):
            Character(**{name: value})
    with pytest.raises(UsageError):
        draw(np.random.default_rng(0), ["mood"], rate=RATE)


def test_time_does_not_run_backwards():
    axis = SimulatedAxis(character=Character(lag=0.01))
    axis.step(1.0, 0.0)
    with pytest.raises(UsageError):
        axis.step(0.5, 0.0)


def test_every_effect_can_be_drawn():
    for effect in STRENGTHS:
        assert draw(np.random.default_rng(1), [effect], rate=RATE).effects == (effect,)
