"""Causes from the rest of the bag: the right topic with its gain, no decoy, and what cannot be told."""

import warnings
from dataclasses import replace

import numpy as np
import pytest

from slpi_ros.diagnosis.diagnose import diagnose, following
from slpi_ros.diagnosis.prepare import evidence_of, no_cause
from slpi_ros.diagnosis.result import AMBIGUOUS
from slpi_ros.identification.fit import identify
from slpi_ros.identification.refit import refit
from slpi_ros.io.record import Record
from slpi_ros.simulation.axis import SimulatedAxis
from slpi_ros.simulation.character import Character
from slpi_ros.simulation.parameters import AxisParameters
from slpi_ros.simulation.room import RoomSensor
from slpi_ros.verification.verify import verify

RATE, SECONDS = 10.0, 400.0
T = np.arange(0.0, SECONDS, 1.0 / RATE)
TOPIC, DECOY = "/room/temperature", "/room/humidity"


def temperature(t):
    return 21.0 + 0.6 * np.sin(2 * np.pi * t / 83.0) + 0.4 * np.sin(2 * np.pi * t / 190.0 + 1.0) + 1e-3 * t


def humidity(t):
    """It drifts, and has as many ups and downs."""
    return 0.4 + 0.03 * np.sin(2 * np.pi * t / 61.0 + 2.0) + 2e-4 * t


def drive(seed):
    rng, times, turns = np.random.default_rng(seed), [0.0, 5.0, 10.0], [0.0, 100.0, 0.0]
    while times[-1] < SECONDS:
        turns.append(rng.uniform(0.0, 100.0))
        times.append(times[-1] + max(0.5, abs(turns[-1] - turns[-2]) / rng.uniform(8.0, 60.0)))
    return np.interp(T, times, turns)


def read_by(sensor, quantity):
    """Return what a slow and noisy sensor says of a quantity, with a gap."""
    at = sensor.times(-3.0, SECONDS + 3.0)
    value = sensor.read(at, quantity(at))
    value[(at > 150.0) & (at < 158.0)] = np.nan
    return at, value


def record(seed=1, offset=0.0, gain=0.0, late=0.0, character=None, beside=None, since=0.0):
    """Return the record of a simulated stage in a room, with what its sensors say."""
    parameters = AxisParameters.random(seed)
    v = drive(seed)
    motion, _ = SimulatedAxis(parameters, seed, character or Character()).run(T, v)
    warm = temperature(T + since) - 21.0
    if late:
        before = np.arange(-2000.0, 0.0, 1.0 / RATE)
        whole, lagged = temperature(np.concatenate([before, T]) + since) - 21.0, 0.0
        kept = np.exp(-1.0 / (RATE * late))
        for k, value in enumerate(whole.tolist()):
            lagged = value + kept * (lagged - value)
            if k >= before.size:
                warm[k - before.size] = lagged
    y = motion * (1.0 + gain * warm) + offset * warm + 8e-9 * np.random.default_rng(seed).standard_normal(T.size)
    if beside is None:
        beside = {
            TOPIC: read_by(RoomSensor(2.0, noise=0.02, seed=1), lambda t: temperature(t + since)),
            DECOY: read_by(RoomSensor(3.0, noise=1e-3, seed=2), lambda t: humidity(t + since)),
        }
    stamps = 1_700_000_000 * 10**9 + np.round((T + since) * 1e9).astype(np.int64)
    return Record(stamps, {"x": v}, {"x": y}, f"record {seed}", surroundings=beside)


def diagnosed(one):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        model = identify(replace(one, surroundings={}))
        return model, diagnose(one, model)


def quantities(found):
    return [one for named in found.effects if named.name == "surroundings" for one in named.effect.quantities]


@pytest.mark.long
def test_a_temperature_is_named_and_the_model_follows_it_on_another_day():
    model, diagnosis = diagnosed(record(offset=2e-7))
    found = diagnosis.axes["x"]
    (one,) = quantities(found)
    assert one.topic == TOPIC and one.offset_gain == pytest.approx(2e-7, rel=0.1) and one.sensitivity_gain == 0.0
    assert found.effects[0].alternatives == () and found.after_rms < 12e-9 < 0.2 * found.before_rms
    assert set(found.surroundings) == {TOPIC, DECOY}
    assert set(found.to_document()["looked_at"]) == {TOPIC, DECOY}
    # The same stage on a later day, judged in its surroundings and without.
    later = replace(record(offset=2e-7, since=500.0), source="later")
    judged = verify(later, diagnosis.extended).axes["x"]
    blind = verify(replace(later, surroundings={}), diagnosis.extended).axes["x"]
    assert judged.rest.rms < 15e-9 < 0.2 * blind.rest.rms
    assert judged.passed and not blind.passed
    # That day is warmer than the record of the model: said, as is a quantity that is not known.
    told = judged.records[0].beyond, blind.records[0].beyond
    assert told[0] != told[1] and all(TOPIC in each for each in told)
    # A refit takes it out of the record first.
    again, changes = refit(diagnosis.extended, later)
    assert changes["x"].error_after < 15e-9 and again.axes["x"].quantities == (TOPIC,)
    assert model.axes["x"].quantities == ()


@pytest.mark.long
@pytest.mark.parametrize(("facts", "late"), [({"gain": 0.01}, 0.0), ({"offset": 3e-7}, 30.0)])
def test_sensitivity_and_time_constant(facts, late):
    _, diagnosis = diagnosed(record(seed=3, late=late, **facts))
    (one,) = quantities(diagnosis.axes["x"])
    assert one.topic == TOPIC
    if late:
        assert one.offset_gain == pytest.approx(3e-7, rel=0.1) and one.time_constant == pytest.approx(late, rel=0.2)
    else:
        assert one.sensitivity_gain == pytest.approx(0.01, rel=0.1)


@pytest.mark.long
def test_a_sensor_slower_than_the_stage_is_made_up_for_in_use():
    beside = {TOPIC: read_by(RoomSensor(4.0, lag=6.0, noise=0.02, seed=1), temperature)}
    _, diagnosis = diagnosed(record(offset=3e-7, beside=beside))
    (one,) = quantities(diagnosis.axes["x"])
    assert one.offset_gain == pytest.approx(3e-7, rel=0.1) and one.time_constant == 0.0
    # The simulated sensor takes each value as it was for the whole interval before it.
    kept = np.exp(-4.0 / 6.0)
    assert one.lead == pytest.approx(4.0 * kept / (1.0 - kept), abs=1.0)
    (used,) = (each for effect in diagnosis.extended.axes["x"].effects for each in effect.quantities)
    assert used.lead == one.lead and used.reading_error > 0.0 and used.ahead == pytest.approx(one.lead + 2.0, abs=0.2)


@pytest.mark.long
def test_two_quantities_that_go_together_are_ambiguous():
    given = record(offset=2e-7)
    both = given.surroundings | {"/rack/temperature": given.surroundings[TOPIC]}
    _, diagnosis = diagnosed(replace(given, surroundings=both))
    found = diagnosis.axes["x"]
    assert found.verdict == AMBIGUOUS
    (named,) = found.effects
    (one,) = quantities(found)
    assert {one.topic, *(other.split(" ")[1] for other in named.alternatives)} == {TOPIC, "/rack/temperature"}
    # The model follows one of them.
    assert diagnosis.extended.axes["x"].quantities == (one.topic,)


@pytest.mark.long
@pytest.mark.parametrize("facts", [{}, {"thermal_drift": 8e-7, "drift_time": 120.0}, {"gain_drift": 0.02}])
def test_what_merely_drifts_is_not_named(facts):
    settling = {
        "/lamp": read_by(
            RoomSensor(2.0, noise=0.01, seed=3), lambda t: 40.0 - 9.0 * np.exp(-np.maximum(t, 0.0) / 110.0)
        )
    }
    given = record(seed=2, character=Character(**facts))
    _, diagnosis = diagnosed(replace(given, surroundings={**given.surroundings, **settling}))
    assert not quantities(diagnosis.axes["x"])


def test_an_identification_with_a_quantity_follows_it_or_says_not():
    given = record(offset=2e-7)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        model, told = following([given], identify(given))
    (one,) = model.axes["x"].followed
    assert one.key == TOPIC
    assert len(told) == 1 and DECOY in told[0]


@pytest.mark.parametrize("signal", ["displacement", "voltage"])
def test_a_second_sensor_of_the_stage_is_no_cause(signal):
    given = record(offset=2e-7)
    at = np.arange(0.0, SECONDS, 0.25)
    own = np.interp(at, T, getattr(given, signal)["x"])
    echo = 3.0 * own / np.ptp(own) + 0.01 * np.random.default_rng(5).standard_normal(at.size)
    given = replace(given, surroundings={**given.surroundings, "/laser": (at, echo)})
    told = no_cause(given, given.surroundings["/laser"], 0.0, SECONDS)
    assert "of axis 'x'" in told
    assert not no_cause(given, given.surroundings[TOPIC], 0.0, SECONDS)
    with pytest.warns(UserWarning, match="/laser"):
        evidence = evidence_of([given], "x", None)
    assert set(evidence.surroundings) == {TOPIC, DECOY}
