"""From one record to the next: what is said of a stage that has, or has not, changed; and causes proved on others."""

from dataclasses import replace

import numpy as np
import pytest

import slpi_ros
from benchmarks.hidden.physics import Amplifier, Physics, own_motion
from slpi_ros.effects.delay import Delay
from slpi_ros.io.record import Record
from slpi_ros.io.schemas import format_document
from slpi_ros.simulation.parameters import AxisParameters

pytestmark = pytest.mark.slow

RATE, NOISE, HIGH = 500.0, 6e-9, 100.0
STAGE = replace(AxisParameters.random(3), stiffening=0.0)


def drive(hertz, seconds=12.0, before=(), seed=0):
    """Return a voltage from 0 V: amplitudes that grow and shrink at one frequency, after moves to other voltages."""
    t = np.arange(round(seconds * RATE)) / RATE
    turns = np.floor(t * hertz)
    tops = np.random.default_rng(seed).permutation(np.linspace(0.25, 1.0, int(turns[-1]) + 1))
    tops[:2] = 1.0
    wave = 0.5 * HIGH * tops[turns.astype(int)] * (1.0 - np.cos(2.0 * np.pi * hertz * t))
    way = np.interp(np.arange(0.0, len(before) * 0.5, 1.0 / RATE), 0.5 * np.arange(len(before) + 1), [0.0, *before])
    # The stage comes back to 0 V before the record begins.
    back = np.linspace(way[-1] if way.size else 0.0, 0.0, 250)
    return np.concatenate([way, back]), wave


def record(hertz, physics=None, before=(), seed=0, gain=1.0, offset=0.0, late=0.0, digit=0.0):
    """Return a record of the stage; what came before it, with the same physics, is not in it."""
    way, wave = drive(hertz, before=before, seed=seed)
    v = np.concatenate([way, wave])
    t = np.arange(v.size) / RATE
    y = own_motion(STAGE, physics or Physics(), t, np.interp(t - late, t, v))[way.size :]
    y = gain * y + offset + NOISE * np.random.default_rng(seed + 100).normal(size=y.size)
    y = np.round(y / digit) * digit if digit else y
    stamps = np.round(np.arange(wave.size) / RATE * 1e9).astype(np.int64)
    return Record(stamps, {"x": wave}, {"x": y}, f"record at {hertz} Hz", "stage")


@pytest.fixture(scope="module")
def model():
    return slpi_ros.identify(record(1.5))


def found(records, model):
    diagnosis = slpi_ros.diagnose(records, model)
    format_document(diagnosis.to_document(), "diagnosis")
    return diagnosis.axes["x"], diagnosis.extended.axes["x"]


@pytest.mark.parametrize("before", [pytest.param((100.0,), marks=pytest.mark.long), (60.0, 20.0, 45.0)])
def test_another_initial_history_is_no_change(model, before):
    axis, extended = found(record(1.5, before=before, seed=5), model)
    assert not axis.given.changed and axis.given.zero_moved is None
    assert not axis.effects and extended == model.axes["x"]


def test_a_change_of_the_gain_is_told(model):
    axis, _ = found(record(1.5, seed=6, gain=1.01), model)
    assert axis.given.changed
    assert axis.given.gain == pytest.approx(0.01, rel=0.2)


def test_a_change_is_one_since_the_record_of_the_model():
    own = replace(record(1.5, seed=11), source="own")
    later = replace(record(1.5, seed=12, gain=1.01), source="later")
    axis, _ = found([own, later], slpi_ros.identify(own))
    assert axis.given.changed
    assert axis.given.gain == pytest.approx(0.01, rel=0.2)


def test_a_quieter_record_of_the_same_name_may_show_a_change():
    own = record(1.5, seed=13)
    hum = 150e-9 * np.sin(2.0 * np.pi * 37.0 * own.t)
    loud = replace(own, displacement={"x": own.displacement["x"] + hum})
    later = replace(record(1.5, seed=14, gain=1.01), source=own.source)
    axis, _ = found(later, slpi_ros.identify(loud))
    assert axis.given.changed
    assert axis.given.gain == pytest.approx(0.01, rel=0.2)


@pytest.mark.parametrize(
    "zeros",
    [
        pytest.param((0.0, 170e-9), id="moved"),
        pytest.param((0.0, 0.0), id="alike", marks=pytest.mark.long),
    ],
)
def test_an_error_of_the_sensor_is_shared_where_the_zeros_are(zeros):
    pair = []
    for seed, zero in zip((15, 16), zeros, strict=True):
        one = record(1.5, seed=seed)
        y = one.displacement["x"]
        read = y + zero + 40e-9 * np.sin(2.0 * np.pi * y / 400e-9)
        pair.append(replace(one, displacement={"x": read}, source=f"record {seed}"))
    axis, extended = found(pair, slpi_ros.identify(pair))
    (effect,) = axis.effects
    assert effect.name == "sensor_periodic"
    assert effect.effect.period == pytest.approx(400e-9, rel=0.01)
    assert [one.name for one in extended.effects] == (["sensor_periodic"] if zeros[1] == 0.0 else [])
    assert ("differs from record to record" in axis.summary) == (zeros[1] != 0.0)


def test_a_moved_zero_is_no_change_of_the_loops(model):
    axis, _ = found(record(1.5, seed=7, offset=-0.6e-6), model)
    assert not axis.given.changed
    assert axis.given.zero_moved == pytest.approx(-0.6e-6, rel=0.2)
    assert axis.records[0].offset == pytest.approx(-0.6e-6, rel=0.2)


@pytest.mark.long
def test_a_delay_at_one_speed_stays_open_and_the_simplest_cause_is_in_the_model():
    one = record(1.5, late=0.04, seed=8)
    model = slpi_ros.identify(one)
    axis, extended = found(one, model)
    assert axis.verdict == "ambiguous" and not axis.given.changed
    (cause,) = axis.effects
    assert cause.name == "delay" and cause.alternatives
    assert [effect.name for effect in extended.effects] == ["delay"]
    assert cause.effect.seconds == pytest.approx(0.04, rel=0.02)


@pytest.mark.parametrize("digits", [60, pytest.param(400, marks=pytest.mark.long)])
def test_a_coarse_sensor_is_no_cause(digits):
    one = record(1.5, seed=9, digit=15e-6 / digits)
    axis, extended = found(one, slpi_ros.identify(one))
    assert not axis.effects and not axis.given.changed and not extended.effects


@pytest.mark.long
def test_a_lag_is_proved_on_records_at_other_speeds():
    physics = Physics(amplifier=Amplifier(lag=4e-3))
    pair = [record(hertz, physics, seed=seed) for hertz, seed in ((0.8, 11), (3.0, 12))]
    plain = slpi_ros.identify(pair)
    axis, extended = found(pair, plain)
    first = axis.effects[0]
    assert {"lag", "delay"} & {first.name, *first.alternatives}
    seconds = first.effect.seconds if isinstance(first.effect, Delay) else first.effect.time_constant
    assert seconds == pytest.approx(4e-3, rel=0.2)
    assert len(axis.records) == 2 and all(each.left_out_rms < 0.5 * each.before_rms for each in axis.records)
    third = record(5.0, physics, seed=13)
    before, after = (
        np.std(one.simulate(third.t, third.voltage["x"]) - third.displacement["x"])
        for one in (plain.axes["x"], extended)
    )
    assert after < 0.5 * before
    told = 1.0 - first.gain_percent / 100.0
    assert after / before == pytest.approx(told, abs=0.2)
