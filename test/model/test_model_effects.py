import json
import warnings
from dataclasses import replace

import numpy as np
import pytest
from effects.cases import BY_NAME, numbers
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from strategies import FAMILY_CASE, PI_CASE, axis_model, two_axes

from slpi_ros.effects.creep import Creep
from slpi_ros.effects.cross_coupling import CrossCoupling
from slpi_ros.effects.delay import Delay
from slpi_ros.effects.filters import Mode
from slpi_ros.effects.gain_drift import GainDrift
from slpi_ros.effects.hum import Hum, Line
from slpi_ros.effects.lag import Lag
from slpi_ros.effects.rate_dependence import RateDependence
from slpi_ros.effects.resonance import Resonance
from slpi_ros.effects.saturation import Saturation
from slpi_ros.effects.sensor_periodic import SensorPeriodic
from slpi_ros.effects.thermal_drift import ThermalDrift
from slpi_ros.errors import ModelError, SlpiError
from slpi_ros.model.document import format_model, parse_model
from slpi_ros.model.limits import Limits
from slpi_ros.model.stage_model import HeldAtLimitWarning, StageModel

# Rest is not at a limit.
X = replace(axis_model(FAMILY_CASE), voltage_range=(-20.0, 120.0))
SPAN = 10e-6
DT = 1e-3
T = DT * np.arange(4000)
CREEP = Creep((0.03, 0.3, 3.0), (0.02, 0.02, 0.03))
DRIFT = ThermalDrift((0.0, 2.0, 3.0), (0.0, 1e-7, -1e-7))
# What is undone exactly, whatever the path.
EXACT = ("rate_dependence", "creep", "self_heating", "gain_drift")
# What belongs to the sensor or to the record: in no inverse.
NEVER = ("thermal_drift", "sensor_periodic", "hum")


def drawn(names, **options):
    """Draw some of the named effects."""
    chosen = st.sets(st.sampled_from(names), **options)
    return chosen.flatmap(lambda some: st.tuples(*map(BY_NAME.get, sorted(some))))


def path(low=4e-6, high=10e-6, seed=0):
    """A smooth path that begins where the model rests."""
    rng = np.random.default_rng(seed)
    tones = sum(
        np.sin(2 * np.pi * f * T + phase) for f, phase in zip((0.7, 1.1, 1.7), rng.uniform(0, 6, 3), strict=True)
    )
    fade = np.clip(T / 0.5, 0, 1)
    fade = fade**3 * (10 - 15 * fade + 6 * fade**2)
    return 2e-6 + fade * ((low + high) / 2 - 2e-6 + (high - low) / 6 * tones)


def with_effects(*effects, axis=X):
    return replace(axis, effects=effects)


@settings(max_examples=40)
@given(drawn(EXACT))
def test_compensate_undoes_simulate_exactly(effects):
    model = StageModel({"x": with_effects(*effects)})
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        v = model.compensate(T, path())
    # A sensitivity that falls far may put a part of the path out of reach.
    assume(not any(issubclass(warning.category, HeldAtLimitWarning) for warning in told))
    np.testing.assert_allclose(model.simulate(T, v), path(), rtol=0, atol=1e-8 * SPAN)


@settings(max_examples=40)
@given(drawn(NEVER, min_size=1), st.floats(0.0, 0.1), st.floats(0.0, 0.1))
def test_an_independent_stage_goes_where_it_shall_whatever_the_model_knows_of_sensor_and_record(effects, delay, lag):
    """The stage itself, without the model: its displacement is the path, not what the sensor would make of it."""
    model = StageModel({"x": with_effects(*effects)}).with_sensor(delay=delay, lag=lag)
    stream = model.stream("x")
    for v in (model.compensate(T, path()), np.array([stream.step(*sample) for sample in zip(T, path(), strict=True)])):
        np.testing.assert_allclose(FAMILY_CASE.memory().forward_array(v), path(), rtol=0, atol=1e-9 * SPAN)


def test_what_the_sensor_will_say_has_its_effects_and_none_of_the_record():
    sensor, hum = SensorPeriodic(3e-7, 5e-9, 1.0), Hum((Line(50.0, 3e-9, 0.0),))
    axis, v = with_effects(CREEP, DRIFT, sensor, hum), X.compensate(T, path())[0]
    there = with_effects(CREEP).simulate(T, v)
    np.testing.assert_allclose(axis.stage_only.simulate(T, v), there, rtol=0, atol=1e-20)
    said = there + 5e-9 * np.sin(2 * np.pi * there / 3e-7 + 1.0)
    np.testing.assert_allclose(axis.simulate(T, v), said, rtol=0, atol=1e-15)
    np.testing.assert_array_equal(axis.simulate(T, v), StageModel({"x": axis}).simulate(T, v))
    drifted = there + np.interp(T, DRIFT.times, DRIFT.values)
    told = drifted + 5e-9 * np.sin(2 * np.pi * drifted / 3e-7 + 1.0) + 3e-9 * np.sin(100 * np.pi * T)
    np.testing.assert_allclose(axis.simulate(T, v, of_record=True), told, rtol=0, atol=1e-15)


def test_after_its_record_a_gain_drift_keeps_its_last_value():
    axis, v = with_effects(GainDrift((1.0, 3.0), (0.1, 0.02), 2e-6)), X.compensate(T, path())[0]
    at_start = X.simulate(T, v) - 2e-6
    np.testing.assert_allclose(axis.simulate(T, v), 2e-6 + 1.02 * at_start, rtol=1e-12)
    then = 1.0 + np.interp(T, (0.0, 1.0, 3.0), (0.0, 0.1, 0.02))
    np.testing.assert_allclose(axis.simulate(T, v, of_record=True), 2e-6 + then * at_start, rtol=1e-12)
    reached = X.simulate(T, StageModel({"x": axis}).compensate(T, path()))
    np.testing.assert_allclose(2e-6 + 1.02 * (reached - 2e-6), path(), rtol=0, atol=1e-8 * SPAN)


@pytest.mark.parametrize(
    ("effect", "share"),
    [
        (Lag(0.015), 2e-4),
        (Delay(0.02), 1e-3),
        (Delay(-0.02), 1e-3),
        (Resonance((Mode(150.0, 0.02),)), 1e-3),
        (Resonance((Mode(80.0, 0.05, 0.5), Mode(150.0, 0.02, 0.3))), 1e-5),
        (Resonance((Mode(80.0, 0.05, 0.6), Mode(150.0, 0.02, 0.4))), 1e-4),
        (RateDependence(1.0, 0.1, 2e-8), 1e-12),
        (Saturation(-10.0, 95.0), 1e-9),
    ],
    ids=lambda value: getattr(value, "name", None),
)
def test_compensate_undoes_simulate_nearly(effect, share):
    """Where the inverse is damped, or looks at slopes; the turns of a path are where it is not exact."""
    model, bare = StageModel({"x": with_effects(effect)}), StageModel({"x": X})
    wish, inside = path(), slice(30, -30)
    got = model.simulate(T, model.compensate(T, wish))
    ignored = model.simulate(T, bare.compensate(T, wish))
    error = np.abs(got - wish)[inside]
    assert np.sqrt(np.mean(error**2)) <= share * SPAN
    assert effect.name == "saturation" or error.mean() < 0.3 * np.abs(ignored - wish)[inside].mean()


def test_a_model_without_effects_does_not_look_at_time():
    v = X.compensate(T, path())[0]
    np.testing.assert_array_equal(X.simulate(T, v), X.simulate(np.zeros(T.size), v))


def test_effects_stand_in_the_order_in_which_they_act():
    axis = with_effects(CREEP, Lag(0.01), Saturation(0.0, 90.0))
    assert [effect.name for effect in axis.effects] == ["lag", "saturation", "creep"]
    with pytest.raises(ModelError, match="'lag'"):
        with_effects(Lag(0.01), Lag(0.02))


def test_limits_hold_for_the_command():
    """Under a lag the command overshoots: it may not leave its limits; the lagged voltage stays within them anyway."""
    axis = with_effects(Lag(0.1))
    limits = Limits(20.0, 60.0)
    v, held = axis.compensate(T, path(), limits)
    assert v.min() == 20.0
    assert v.max() == 60.0
    assert (held | ((v > 20.0) & (v < 60.0)) | ((v == 20.0) | (v == 60.0))).all()
    assert held[(v == 60.0) & (path() > 9e-6)].all()


def test_out_of_reach_with_effects():
    model = StageModel({"x": with_effects(CREEP)})
    with pytest.warns(HeldAtLimitWarning) as caught:
        v = model.compensate(T, path(4e-6, 18e-6))
    assert v.max() == 120.0
    assert caught[0].filename == __file__


def test_saturation_is_where_the_voltage_ends():
    axis = with_effects(Saturation(-5.0, 40.0))
    v, held = axis.compensate(T, path())
    assert v.max() == 40.0
    assert held[v == 40.0].all()
    assert (axis.simulate(T, np.full(T.size, 80.0)) == axis.simulate(T, np.full(T.size, 40.0))).all()


# Axes that move along with each other


def coupled(xy=0.05, yx=-0.1):
    y = axis_model(PI_CASE)
    return StageModel({
        "x": with_effects(CREEP, CrossCoupling({"y": xy})),
        "y": with_effects(Lag(0.01), CrossCoupling({"x": yx}), axis=y),
    })  # fmt: skip


def wishes():
    return {"x": path(), "y": path(4e-6, 6e-6, 1) - 2e-6}


def test_coupling_adds_the_own_motion_of_the_others():
    model = coupled()
    v = {"x": 30 * np.sin(T) ** 2, "y": 50 * np.sin(2 * T) ** 2}
    seen = model.simulate(T, v)
    own = {name: replace(axis, effects=axis.effects[:-1]).simulate(T, v[name]) for name, axis in model.axes.items()}
    np.testing.assert_allclose(seen["x"], own["x"] + 0.05 * own["y"], rtol=0, atol=1e-17)
    np.testing.assert_allclose(seen["y"], own["y"] - 0.1 * (own["x"] - 2e-6), rtol=0, atol=1e-17)
    # An axis that is not given rests.
    np.testing.assert_allclose(model.simulate(T, {"x": v["x"]})["x"], own["x"], rtol=0, atol=1e-17)


def test_axes_are_taken_apart():
    model = coupled()
    back = model.simulate(T, model.compensate(T, wishes()))
    for name, wish in wishes().items():
        np.testing.assert_allclose(back[name][20:], wish[20:], rtol=0, atol=1e-3 * SPAN)


@given(numbers(-0.4, 0.4), numbers(-0.4, 0.4))
def test_any_coupling_is_taken_apart(xy, yx):
    model = coupled(xy, yx)
    exact = {name: replace(axis, effects=axis.effects[-1:]) for name, axis in model.axes.items()}
    exact = {name: replace(axis, displacement_range=(-1e-3, 1e-3)) for name, axis in exact.items()}
    model = StageModel(exact)
    v = {"x": 50 + 30 * np.sin(3 * T), "y": 40 + 20 * np.sin(4 * T)}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", HeldAtLimitWarning)
        back = model.compensate(T, model.simulate(T, v))
    for name in v:
        np.testing.assert_allclose(back[name], v[name], rtol=0, atol=1e-7)


# Documents


@given(st.lists(st.sampled_from(sorted(BY_NAME)).flatmap(BY_NAME.get), unique_by=lambda effect: effect.name))
def test_a_document_holds_the_effects(effects):
    model = StageModel({"x": with_effects(*effects), "y": axis_model(PI_CASE)})
    text = format_model(model)
    again = parse_model(text, "here")
    assert again.axes["x"].effects == model.axes["x"].effects
    assert again.axes["y"].effects == ()
    assert format_model(again) == text


def test_documents_of_before_there_were_effects():
    document = json.loads(format_model(two_axes()))
    for axis in document["axes"].values():
        del axis["effects"]
    assert all(axis.effects == () for axis in parse_model(json.dumps(document), "old").axes.values())


@pytest.mark.parametrize(
    "effect",
    [
        {"name": "lag"},
        {"name": "lag", "parameters": {}},
        {"name": "lag", "parameters": {"time_constant": -1}},
        {"name": "lag", "parameters": {"time_constant": "1"}},
        {"name": "lag", "parameters": {"time_constant": 1, "more": 1}},
        {"name": "lag", "parameters": {"time_constant": 1}, "uncertainty": {"time_constant": -1}},
        {"name": "lag", "parameters": {"time_constant": 1}, "uncertainty": {"gain": 1}},
        {"name": "resonance", "parameters": {"modes": [{"frequency": 100, "damping": 3, "gain": 1}]}},
        {"name": "gremlins", "parameters": {}},
        {"name": "cross_coupling", "parameters": {"gains": {"y": 2}}},
        17,
    ],
)
def test_documents_with_effects_that_make_no_sense(effect):
    document = json.loads(format_model(two_axes()))
    document["axes"]["x"]["effects"] = [effect]
    with pytest.raises(ModelError, match="^here: [^\n]+$"):
        parse_model(json.dumps(document), "here")


def test_a_document_has_each_effect_once():
    document = json.loads(format_model(StageModel({"x": with_effects(Lag(0.1))})))
    document["axes"]["x"]["effects"] *= 2
    with pytest.raises(ModelError, match="^here: .*'lag'"):
        parse_model(json.dumps(document), "here")


def test_few_samples():
    axis = with_effects(
        *(Lag(0.01), CREEP, Resonance((Mode(100.0, 0.1),)), RateDependence(1.0, 0.1, 1e-8), Delay(0.1)),
        *(SensorPeriodic(1e-7, 1e-9, 0.0), Hum((Line(50.0, 1e-9, 0.0),)), DRIFT),
    )
    model = StageModel({"x": axis})
    assert model.simulate([], []).shape == model.compensate([], []).shape == (0,)
    assert np.isfinite(model.compensate([0.0], [5e-6])).all()
    assert np.isfinite(model.compensate([0.0, 0.0], [5e-6, 6e-6])).all()
    assert np.isfinite(model.simulate([0.0, 1.0], [5.0, 6.0])).all()
    with pytest.raises(SlpiError):
        model.simulate([0.0], [np.nan])
    with pytest.raises(SlpiError):
        model.compensate([0.0], [np.inf])
