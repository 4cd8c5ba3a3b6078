"""A model that follows recorded quantities: both directions, sample by sample, documents, and what is not known."""

import json
from dataclasses import replace

import numpy as np
import pytest
from model.test_model_effects import CREEP, SPAN, T, X, coupled, path, wishes, with_effects
from refusals import holds, refusal

from slpi_ros.effects.filters import Mode
from slpi_ros.effects.gain_drift import GainDrift
from slpi_ros.effects.lag import Lag
from slpi_ros.effects.registry import from_document, to_document
from slpi_ros.effects.resonance import Resonance
from slpi_ros.effects.surroundings import Quantity, Surroundings
from slpi_ros.errors import UsageError
from slpi_ros.model.document import format_model, parse_model
from slpi_ros.model.stage_model import StageModel

WARM = Quantity("/room/temperature", "", 21.0, 4e-7, 0.01, 0.0, lowest=20.0, highest=23.0)
LATE = replace(WARM, sensitivity_gain=0.0, time_constant=0.8)
LOAD = Quantity("/load", "force.z", 1.0, -3e-7, 0.02, 0.0, lowest=0.0, highest=2.0)
ROOM = {
    "/room/temperature": 21.0 + 1.2 * np.sin(3.0 * T) + 0.3 * T / T[-1],
    "/load:force.z": 1.0 + np.sin(5.0 * T) ** 3,
}
SETS = [
    (Surroundings((WARM,), 2e-6),),
    (Surroundings((LATE,)),),
    (Surroundings((LATE, LOAD), 1e-6), CREEP, Lag(0.01)),
    (Surroundings((WARM, LOAD), 1e-6), GainDrift((0.0,), (0.1,), 0.0), Resonance((Mode(150.0, 0.02),))),
]


def ids(effects):
    return "+".join(effect.name for effect in effects)


def model_of(effects):
    return StageModel({"x": with_effects(*effects)})


def of(effects):
    return {key: ROOM[key] for effect in effects for key in effect.keys}


def followed(stream, y, room):
    rows = ({key: values[k] for key, values in room.items()} for k in range(y.size))
    return np.array([stream.step(*each) for each in zip(T.tolist(), y.tolist(), rows, strict=True)])


@pytest.mark.parametrize("effects", SETS, ids=ids)
def test_a_path_in_its_surroundings_is_reached_and_streamed(effects):
    model, y, room = model_of(effects), path(), of(effects)
    v = model.compensate(T, y, surroundings=room)
    np.testing.assert_allclose(followed(model.stream("x"), y, room), v, rtol=0, atol=1e-9)
    slow = any(effect.name in ("lag", "resonance") for effect in effects)
    error = model.simulate(T, v, room) - y
    # A mode rings after the first step, which the surroundings make.
    error, begins = (error[1000:], 1000) if slow else (error[20:], 20)
    assert np.abs(error).max() < (1e-3 if slow else 1e-9) * SPAN
    # Without them the path is missed by what they do.
    missed = model.simulate(T, model.compensate(T, y), room) - y
    assert np.std(missed[begins:]) > 5 * np.std(error) + 1e-8


@pytest.mark.parametrize("effects", SETS, ids=ids)
def test_what_is_left_out_has_its_reference_value(effects):
    model, y = model_of(effects), path()
    others = [effect for effect in effects if not effect.keys]
    plain = StageModel({"x": with_effects(*others)})
    np.testing.assert_allclose(model.compensate(T, y), plain.compensate(T, y), rtol=0, atol=1e-9)
    v = 40.0 + 30.0 * np.sin(4.0 * T)
    np.testing.assert_allclose(model.simulate(T, v), plain.simulate(T, v), rtol=0, atol=1e-15)
    reference = {one.key: np.full(T.size, one.reference) for one in model.axes["x"].followed}
    np.testing.assert_allclose(model.simulate(T, v, reference), plain.simulate(T, v), rtol=0, atol=1e-15)


def test_a_quantity_that_is_not_followed_or_has_no_values_is_refused():
    model, v = model_of(SETS[0]), np.full(T.size, 20.0)
    told = refusal(UsageError, model.simulate, T, v, {"/humidity": v})
    assert holds(told, "/humidity", "/room/temperature")
    refusal(UsageError, model.simulate, T, v, {"/room/temperature": v[:-1]})
    refusal(UsageError, model.compensate, T, path(), "end", {"/room/temperature": np.full(T.size, np.nan)})
    refusal(UsageError, StageModel({"x": X}).simulate, T, v, {"/room/temperature": v})


def test_other_axes_follow_what_the_coupling_brings():
    model = coupled(0.02, 0.01)
    follows = replace(model.axes["x"], effects=(*model.axes["x"].effects, Surroundings((WARM,))))
    model = StageModel({**model.axes, "x": follows})
    y = wishes()
    room = {"/room/temperature": ROOM["/room/temperature"]}
    reached = model.simulate(T, model.compensate(T, y, surroundings=room), room)
    for axis in y:
        np.testing.assert_allclose(reached[axis], y[axis], rtol=0, atol=1e-4 * SPAN)


@pytest.mark.parametrize("effects", SETS, ids=ids)
def test_documents_keep_it(effects):
    for effect in effects:
        assert from_document(json.loads(json.dumps(to_document(effect)))) == effect
    model = model_of(effects)
    assert parse_model(format_model(model), "here").axes["x"].effects == model.axes["x"].effects


def test_a_moved_zero_moves_it_along():
    model = model_of(SETS[0])
    moved, room = model.shifted({"x": 3e-6}), {"/room/temperature": ROOM["/room/temperature"]}
    v = 40.0 + 30.0 * np.sin(4.0 * T)
    np.testing.assert_allclose(moved.simulate(T, v, room), model.simulate(T, v, room) + 3e-6, rtol=0, atol=1e-15)


@pytest.mark.parametrize("effects", SETS, ids=ids)
def test_streams_go_on_from_a_copy_and_a_snapshot(effects):
    room, y, half = of(effects), path(), T.size // 2
    stream = with_effects(*effects).stream()
    for k in range(half):
        stream.step(T[k], y[k], {key: values[k] for key, values in room.items()})
    copied, restored = stream.copy(), with_effects(*effects).stream()
    restored.restore(stream.snapshot())
    # Nothing new is told: the last values stay in use.
    first, second, third = (
        [one.move(T[1], y[k], k * 1_000_000) for k in range(half, half + 50)] for one in (stream, copied, restored)
    )
    np.testing.assert_array_equal(second, first)
    np.testing.assert_allclose(third, first, rtol=0, atol=1e-9)


def test_a_new_model_takes_over_the_values():
    before, after = model_of(SETS[0]).stream("x"), model_of(SETS[0]).stream("x")
    before.step(0.0, 5e-6, {"/room/temperature": 22.5})
    after.drive(before.voltage)
    after.resume(before)
    assert after.uncoupled_displacement == pytest.approx(before.uncoupled_displacement, abs=1e-12)


def test_noisy_readings_are_averaged_in_use():
    rng = np.random.default_rng(3)
    noisy = {"/room/temperature": 21.0 + 0.5 * rng.standard_normal(T.size)}
    voltage = {}
    for seconds in (0.0, 0.5):
        model = model_of([Surroundings((replace(WARM, sensitivity_gain=0.0, averaging=seconds),))])
        y = np.full(T.size, float(np.mean(path())))
        voltage[seconds] = followed(model.stream("x"), y, noisy)[100:]
    assert np.std(voltage[0.5]) < 0.3 * np.std(voltage[0.0])
    # A value that is not finite, or of something else, changes nothing.
    stream = model_of(SETS[0]).stream("x")
    before = stream.step(0.0, 5e-6, {"/room/temperature": 22.0})
    assert stream.step(0.1, 5e-6, {"/room/temperature": np.nan, "/other": 5.0}) == before


def test_a_quantity_that_the_stage_precedes_is_foretold_in_use():
    # The readings are 60 ms late, and the stage follows what will be read.
    one = replace(WARM, sensitivity_gain=0.0, lead=0.06)
    y, late = np.full(T.size, float(np.mean(path()))), np.interp(T - 0.06, T, ROOM["/room/temperature"])
    model = model_of([Surroundings((replace(one, averaging=0.01, ahead=0.06),))])
    truth = model_of([Surroundings((replace(WARM, sensitivity_gain=0.0),))])
    wanted = truth.compensate(T, y, surroundings={"/room/temperature": ROOM["/room/temperature"]})[100:]
    foretold = followed(model.stream("x"), y, {"/room/temperature": late})[100:]
    held = followed(model_of([Surroundings((one,))]).stream("x"), y, {"/room/temperature": late})[100:]
    assert np.std(foretold - wanted) < 0.15 * np.std(held - wanted)
    # Of a record all of the readings are known.
    v = model.compensate(T, y)[:-100]
    np.testing.assert_allclose(
        model.simulate(T[:-100], v, {"/room/temperature": late[:-100]})[:-100],
        truth.simulate(T[:-100], v, {"/room/temperature": ROOM["/room/temperature"][:-100]})[:-100],
        rtol=0, atol=2e-9,
    )  # fmt: skip
