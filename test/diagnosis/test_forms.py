"""Causes of two numbers or fewer that go on as they began: what they leave, also on a record that is not theirs."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lsim
from scipy.special import gamma

import slpi_ros
from slpi_ros.excitation.drives import calibration_drive
from slpi_ros.simulation.axis import SimulatedAxis
from slpi_ros.simulation.dynamics import Relaxation
from slpi_ros.simulation.parameters import AxisParameters

STAGE = replace(AxisParameters.random(3), noise_rms=0.0, quantisation=0.0)


def moved(duration: float, rate: float, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return times (s), voltages (V) and the displacement of the hysteresis (m), (N,) each, of a calibration drive."""
    t, v = calibration_drive(0.0, 100.0, duration=duration, rate=rate, seed=seed)
    return t, v, SimulatedAxis(STAGE, 0).run(t, v)[0]


def record_of(t: np.ndarray, v: np.ndarray, y: np.ndarray, noise: float, seed: int = 3) -> slpi_ros.Record:
    read = y + noise * np.random.default_rng([seed, t.size]).standard_normal(t.size)
    return slpi_ros.Record(np.round(t * 1e9).astype(np.int64), {"x": v}, {"x": read}, f"record {seed}")


def crept(t: np.ndarray, x: np.ndarray, exponent: float, gain: float) -> np.ndarray:
    """Return a displacement that creeps with a power of time: ten relaxations in each decade from 0.1 ms to 10 days."""
    times = 10.0 ** np.arange(-4, 6.01, 0.1)
    shares = gain * exponent / gamma(1 - exponent) * times**exponent * np.log(10) / 10
    chain, steps = Relaxation(times), np.diff(t, prepend=t[:1])
    return np.array(
        [now + shares @ chain.step(dt, now - x[0]) for dt, now in zip(steps.tolist(), x.tolist(), strict=True)]
    )


def test_creep_by_a_power_of_time_predicts_a_record_ten_times_as_long():
    noise = 5e-9
    t, v, x = moved(40.0, 200.0, 1)
    short = record_of(t, v, crept(t, x, 0.2, 0.02), noise)
    diagnosis = slpi_ros.diagnose(short, slpi_ros.identify(short))
    found = diagnosis.axes["x"]
    assert found.verdict == "named" and [one.name for one in found.effects] == ["creep"]
    assert found.effects[0].effect.exponent == pytest.approx(0.2, abs=0.05)
    assert found.after_rms < 1.2 * noise
    t, v, x = moved(400.0, 50.0, 2)
    error = diagnosis.extended.axes["x"].simulate(t, v) - crept(t, x, 0.2, 0.02)
    assert np.std(error[t > 40.0]) < 1.2 * noise


def test_a_clock_that_goes_slower_is_found_and_stays_with_its_record():
    noise = 8e-9
    t, v, x = moved(77.0, 200.0, 1)
    record = record_of(t, v, np.interp(t / (1 - 100e-6), t, x), noise)
    diagnosis = slpi_ros.diagnose(record, slpi_ros.identify(record))
    found = diagnosis.axes["x"]
    assert found.verdict == "named" and [one.name for one in found.effects] == ["clock"]
    assert found.effects[0].effect.rate == pytest.approx(-100e-6, abs=2e-6)
    assert found.after_rms < 1.1 * noise and not found.effects[0].alternatives
    assert diagnosis.extended.axes["x"].chain.measured == ()


@pytest.mark.parametrize("damping", [0.45, pytest.param(1.6, marks=pytest.mark.long)])
def test_a_well_damped_mode_is_found_from_two_speeds(damping):
    """It takes what a lag and a delay together would leave."""
    noise, w = 8e-9, 2 * np.pi * 6.5
    records = []
    for seed, duration in ((1, 40.0), (2, 12.0)):
        t, v, x = moved(duration, 200.0, seed)
        y = x[0] + lsim(([w * w], [1.0, 2 * damping * w, w * w]), x - x[0], t)[1]
        records.append(record_of(t, v, y, noise, seed))
    diagnosis = slpi_ros.diagnose(records, slpi_ros.identify(records[0]))
    found = diagnosis.axes["x"]
    assert [one.name for one in found.effects] == ["resonance"]
    (mode,) = found.effects[0].effect.modes
    assert mode.frequency == pytest.approx(6.5, rel=0.05) and mode.damping == pytest.approx(damping, rel=0.05)
    assert found.after_rms < 1.5 * noise


TAKEN_BACK = "a delay is named that takes back the second pole, which the largest damping of a mode leaves"


@pytest.mark.parametrize("lag", [0.06, pytest.param(0.04, marks=pytest.mark.xfail(reason=TAKEN_BACK))])
@pytest.mark.long
def test_a_lag_behind_the_hysteresis_is_an_overdamped_mode_and_carries_over(lag):
    """As of a sensor that is late."""
    noise = 8e-9
    (t, v, y), (other_t, other_v, other_y) = (
        (t, v, x[0] + lsim(([1.0], [lag, 1.0]), x - x[0], t)[1])
        for t, v, x in (moved(40.0, 200.0, 1), moved(20.0, 200.0, 2))
    )
    record = record_of(t, v, y, noise)
    diagnosis = slpi_ros.diagnose(record, slpi_ros.identify(record))
    found = diagnosis.axes["x"]
    assert found.verdict == "named" and [one.name for one in found.effects] == ["resonance"]
    (mode,) = found.effects[0].effect.modes
    assert mode.damping > 1.5 and mode.lag == pytest.approx(lag, rel=0.1)
    assert found.after_rms < 1.5 * noise
    error = diagnosis.extended.axes["x"].simulate(other_t, other_v) - other_y
    assert np.std(error) < 1.5 * noise
