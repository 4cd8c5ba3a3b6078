"""The drive for the frequency response, and what is found of it in a record."""

from dataclasses import replace

import numpy as np
import pytest

from slpi_ros.effects.delay import Delay
from slpi_ros.effects.filters import Mode
from slpi_ros.effects.resonance import Resonance
from slpi_ros.errors import RecordError, UsageError
from slpi_ros.excitation.response import BIASES, PEAK, PERIODS, response_drive
from slpi_ros.identification.frequency_response import frequency_response
from slpi_ros.simulation.axis import SimulatedAxis
from slpi_ros.simulation.character import Character
from slpi_ros.simulation.parameters import AxisParameters

RATE, FINE = 1000.0, 4
MODE, DAMPING, DELAY = 90.0, 0.05, 2e-3


@pytest.fixture(scope="module")
def drive():
    return response_drive(("x",), 0.0, 100.0, 1000.0, 24.0, RATE, seed=3)


def truth(frequency):
    """Return the linear dynamics of the stage below, with static gain 1."""
    ratio = frequency / MODE
    return np.exp(-2j * np.pi * frequency * DELAY) / (1.0 - ratio**2 + 2j * DAMPING * ratio)


def test_it_keeps_range_and_slew_limit_and_repeats_about_each_bias(drive):
    v = drive.voltage["x"]
    assert v.size == drive.t.size == 24_001 and v[0] == v[-1] == 0.0
    assert v.min() >= 0.0 and v.max() <= 100.0 and np.abs(np.diff(v)).max() * RATE <= 1000.0 * (1.0 + 1e-9)
    size = int(24_000 * 0.9 / (len(BIASES) * PERIODS))
    found = frequency_response(drive.t, v, 1e-7 * v)
    assert found.biases == pytest.approx([100.0 * bias for bias in BIASES], abs=0.1)
    for bias in BIASES:
        near = np.flatnonzero(np.abs(v - 100.0 * bias) <= 100.0 * PEAK * 1.001)
        assert near.size >= PERIODS * size
    # Of a stage that follows at once, but for what lies between the samples.
    np.testing.assert_allclose(found.response * np.sinc(found.frequency / RATE) ** 2, 1e-7, rtol=1e-6)
    # Odd multiples of one frequency, and some of these are left out.
    lines = np.round(found.frequency * size / RATE).astype(int)
    assert np.all(lines % 2 == 1) and 0.6 < lines.size / (lines[-1] // 2 + 1) < 0.9


def test_two_axes_move_one_after_the_other():
    drive = response_drive(("x", "y"), -10.0, 50.0, 0.0, 30.0, RATE)
    x, y = (drive.voltage[name] - (-10.0) for name in ("x", "y"))
    assert not (x * y).any() and x.any() and y.any()


@pytest.mark.parametrize(
    "wrong", [(0.0, 100.0, 1000.0, 0.5, RATE), (0.0, 100.0, 5.0, 20.0, RATE), (9.0, 1.0, 0.0, 20.0, RATE)]
)
def test_times_and_limits_that_allow_none_are_refused(wrong):
    with pytest.raises(UsageError) as caught:
        response_drive(("x",), *wrong)
    assert "\n" not in str(caught.value)


@pytest.fixture(scope="module")
def measured(drive):
    """Return what a stage with hysteresis, a mode and a delay shows, simulated in finer steps."""
    axis = SimulatedAxis(
        AxisParameters.random(4), 1, Character(delay=DELAY, resonance=MODE, damping=DAMPING, creep=0.01)
    )
    fine = np.arange((drive.t.size - 1) * FINE + 1) / (RATE * FINE)
    _, y = axis.run(fine, np.interp(fine, drive.t, drive.voltage["x"]))
    return frequency_response(drive.t, drive.voltage["x"], y[::FINE])


def test_the_response_is_that_of_the_stage_where_its_interval_says_so(measured):
    model = truth(measured.frequency)
    low = measured.frequency < 0.3 * MODE
    off = measured.response / model / np.median(np.abs(measured.response / model)[low])
    sure = (measured.frequency <= 2.0 * MODE) & (measured.relative <= 0.05)
    assert np.count_nonzero(sure) > 20
    assert np.mean((np.abs(np.abs(off[sure]) - 1.0) <= 0.05) & (np.abs(np.angle(off[sure])) <= np.radians(5.0))) > 0.95
    # And no interval is far too small.
    band = measured.frequency <= 2.0 * MODE
    assert np.mean(np.abs(off[band] - 1.0) <= measured.relative[band] + 0.05) > 0.9


def test_where_a_model_agrees_is_told(measured):
    model = truth(measured.frequency)
    assert measured.agreement(3e-8 * model)[1] > 1.5 * MODE
    other = np.where(measured.frequency > 0.5 * MODE, 2.0, 1.0) * model
    assert measured.agreement(other)[1] < 0.6 * MODE
    assert measured.distortion.max() > 0.0 and measured.noise.min() > 0.0


def test_a_record_without_the_drive_is_refused():
    t = np.arange(5000) / RATE
    for v in (50.0 - 40.0 * np.cos(0.7 * t), np.full(t.size, 3.0), np.random.default_rng(1).normal(size=t.size)):
        with pytest.raises(RecordError) as caught:
            frequency_response(t, v, 1e-7 * v)
        assert "--for-response" in str(caught.value) and "\n" not in str(caught.value)


def test_effects_of_the_model_are_those_of_the_plant():
    from strategies import PI_CASE, axis_model

    from slpi_ros.compensator.loop_margin import Plant

    axis = replace(axis_model(PI_CASE), effects=(Delay(DELAY), Resonance((Mode(MODE, DAMPING, 1.0),))))
    plant, frequency = Plant.of(axis), np.geomspace(1.0, 300.0, 50)
    np.testing.assert_allclose(plant.response(2.0 * np.pi * frequency), plant.slope * truth(frequency), rtol=1e-9)


def test_periods_with_a_missing_reading_are_left_out(drive):
    v = drive.voltage["x"]
    y = 1e-7 * v
    size = int(24_000 * 0.9 / (len(BIASES) * PERIODS))
    near = np.flatnonzero(np.abs(v - 50.0) <= 100.0 * PEAK)
    gap = y.copy()
    gap[near[near.size // 2]] = np.nan
    found, whole = frequency_response(drive.t, v, gap), frequency_response(drive.t, v, y)
    assert found.frequency.size == whole.frequency.size and found.biases == whole.biases
    np.testing.assert_allclose(found.response, whole.response, rtol=1e-6)
    assert np.isfinite(found.interval).all()
    assert found.agreement(whole.response) == (found.frequency[0], found.frequency[-1])
    # A bias of which no period is left is left out.
    lost = np.where(np.abs(v - 25.0) <= 100.0 * PEAK, np.nan, y)
    assert frequency_response(drive.t, v, lost).biases == whole.biases[1:]
    gap[:: size // 2] = np.nan
    with pytest.raises(RecordError, match="^readings are missing in nearly all periods[^\n]+$"):
        frequency_response(drive.t, v, gap)


def test_what_is_not_known_agrees_with_no_model(drive):
    v = drive.voltage["x"]
    found = frequency_response(drive.t, v, 1e-7 * v)
    half = np.where(np.arange(found.frequency.size) < found.frequency.size // 2, found.response, np.nan)
    band = replace(found, response=half).agreement(found.response)
    assert band[1] == pytest.approx(found.frequency[found.frequency.size // 2], rel=0.05)
    unsure = replace(found, noise=np.full(found.frequency.size, np.nan))
    for one, model in ((found, np.nan * found.response), (unsure, found.response)):
        assert one.agreement(model) is None


@pytest.mark.parametrize("size", [0, 1, 2, 3, 60])
def test_a_record_that_is_too_short_is_refused(size):
    t = np.arange(size) / RATE
    with pytest.raises(RecordError, match="--for-response"):
        frequency_response(t, np.sin(t), np.sin(t))


def test_a_negative_seed_is_refused():
    with pytest.raises(UsageError, match="seed -1"):
        response_drive(("x",), 0.0, 100.0, 1000.0, 24.0, RATE, seed=-1)
