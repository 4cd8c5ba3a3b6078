import warnings
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from model.test_model_effects import CREEP, DT, SPAN, T, X, coupled, path, wishes, with_effects
from strategies import FAMILY_CASE

from slpi_ros.effects.cross_coupling import CrossCoupling
from slpi_ros.effects.filters import Mode
from slpi_ros.effects.gain_drift import GainDrift
from slpi_ros.effects.lag import Lag
from slpi_ros.effects.rate_dependence import RateDependence
from slpi_ros.effects.resonance import Resonance
from slpi_ros.effects.saturation import Saturation
from slpi_ros.effects.self_heating import SelfHeating
from slpi_ros.effects.sensor_periodic import SensorPeriodic
from slpi_ros.errors import SlpiError
from slpi_ros.model.limits import MAX_DT, Limits
from slpi_ros.model.stage_model import HeldAtLimitWarning, StageModel

MS = 1_000_000
LAG, MODE = Lag(0.015), Resonance((Mode(150.0, 0.02),))
RATE = RateDependence(1.0, 0.1, 2e-8)
SENSITIVE = GainDrift((0.0,), (0.1,), 0.0)
SENSOR = SensorPeriodic(3e-7, 5e-9, 1.0)
EVERY = (LAG, RATE, CREEP, MODE)
# That of the sensor changes nothing, alone or beside others: see test_model_effects.
HEAT = SelfHeating(5e-6, 2.0, 3e-6)
SETS = [(LAG,), (CREEP,), (MODE,), (RATE,), (HEAT,), (LAG, CREEP), (LAG, RATE, HEAT), EVERY]


def ids(effects):
    return "+".join(effect.name for effect in effects)


def followed(stream, y, t=T):
    return np.array([stream.step(now, wish) for now, wish in zip(t.tolist(), y.tolist(), strict=True)])


@pytest.mark.parametrize("effects", [*SETS, (SENSOR,), (RATE, CREEP), (LAG, RATE)], ids=ids)
def test_stream_gives_what_compensate_gives(effects, monkeypatch):
    # On a whole path modes are inverted better than sample by sample.
    monkeypatch.setattr(Resonance, "looks_ahead", False)
    axis = with_effects(*effects)
    batch, _ = axis.compensate(T, path())
    np.testing.assert_allclose(followed(axis.stream(), path()), batch, rtol=0, atol=1e-12)


@pytest.mark.parametrize("mode", [(150.0, 0.02), (6.5, 0.45), (30.0, 1.0), (12.0, 2.0)])
@pytest.mark.parametrize("share", [1.0, 0.8])
def test_a_whole_path_is_followed_through_modes(mode, share):
    axis = with_effects(CREEP, Resonance((Mode(*mode, share),)))
    v, held = axis.compensate(T, path(), start_memory="start")
    error = axis.simulate(T, v) - path()
    streamed = axis.simulate(T, followed(axis.stream(start_memory="start"), path())) - path()
    assert not held.any()
    assert np.abs(error).max() < min(1e-6 * SPAN, 0.1 * np.abs(streamed).max())


def test_a_path_that_the_limits_hold_back_is_followed_as_its_samples_are():
    """The exact inverse of a step needs more than the limits allow."""
    axis, steps = with_effects(Resonance((Mode(6.5, 0.45),))), np.where(T < 1.0, 4e-6, 8e-6)
    v, _ = axis.compensate(T, steps)
    np.testing.assert_allclose(followed(axis.stream(), steps), v, rtol=0, atol=1e-9)


@pytest.mark.parametrize("effects", SETS, ids=ids)
def test_what_is_streamed_gives_the_wish(effects):
    axis = with_effects(*effects)
    v = followed(axis.stream(), path())
    error = (axis.simulate(T, v) - path())[20:]
    ignored = (axis.simulate(T, followed(X.stream(), path())) - path())[20:]
    assert np.sqrt(np.mean(error**2)) < 3e-3 * SPAN
    assert np.sqrt(np.mean(error**2)) < 0.5 * np.sqrt(np.mean(ignored**2))


@pytest.mark.parametrize("effects", SETS, ids=ids)
@given(voltage=st.floats(5.0, 95.0))
@settings(max_examples=10)
def test_a_stage_that_is_found_at_rest_stays_where_it_is(effects, voltage):
    """Whatever the stream followed before, nothing rings or relaxes from there."""
    axis = with_effects(*effects)
    stream = axis.stream()
    followed(stream, path()[:200], T[:200])
    stream.wait(1e5)
    moved = stream.copy()
    moved.drive(voltage, 0.01)
    for _ in range(5):
        moved.wait(1e5)
    there = stream.rest_at(voltage)
    assert stream.voltage == stream.pace.voltage == voltage
    assert there == pytest.approx(moved.drive(voltage), abs=1e-12)
    for _ in range(20):
        assert stream.drive(voltage, 0.01) == pytest.approx(there, abs=1e-12)


@pytest.mark.parametrize("effects", [(CREEP,), (LAG, CREEP), EVERY], ids=ids)
@pytest.mark.parametrize("off", [0.0, 1e-5])
def test_slow_effects_have_relaxed_where_a_stage_is_measured(effects, off):
    """With the wrong history its creep was off for minutes, also after a reset of the memory."""
    axis = with_effects(*effects)
    stage, model = axis.stream(), axis.stream()
    for stream, before in ((stage, 100.0), (model, 5.0)):
        stream.drive(before, 1.0)
    stage.drive(40.0, 1.0)
    for _ in range(5):
        stage.wait(1e5)
    there = stage.drive(40.0)
    unaware = model.copy()
    assert abs(unaware.rest_at(40.0) - there) > 0.05 * SPAN
    # A reading that is off by more than the loop is wide is not believed.
    model.rest_at(40.0, there + off)
    assert model.voltage == 40.0
    # A sweep wipes the memory, and leaves the rest of the relaxation.
    ends = {}
    for stream in (stage, model, unaware):
        for v in np.interp(np.arange(61), [0, 10, 20, 40, 50, 60], [40.0, 110.0, 110.0, 0.0, 0.0, 40.0]).tolist():
            ends[stream] = stream.drive(v, 0.01)
    aware, wrong = (abs(ends[stream] - ends[stage]) for stream in (model, unaware))
    assert aware < (0.1 if off == 0.0 else 2.0) * wrong


@pytest.mark.parametrize("effects", SETS, ids=ids)
def test_the_stream_knows_where_the_model_is(effects):
    """What it says of its own displacement is what the model makes of its voltages, limits or not."""
    axis = with_effects(*effects)
    stream = axis.stream(Limits(10.0, 70.0, 400.0, 4e4))
    v, own = [], []
    for now, wish in zip(T.tolist(), path(1e-6, 13e-6).tolist(), strict=True):
        v.append(stream.step(now, wish))
        own.append(stream.uncoupled_displacement)
    assert (min(v), max(v)) == (10.0, 70.0)
    # The axis rests at its lower limit before.
    twin = axis.stream(Limits(10.0, 70.0))
    expected = [twin.drive(each, DT if k else 0.0) for k, each in enumerate(v)]
    np.testing.assert_allclose(own, expected, rtol=0, atol=1e-9 * SPAN)


@pytest.mark.parametrize("effects", SETS, ids=ids)
def test_drive_does_what_simulate_does(effects):
    axis = with_effects(*effects)
    stream, v = axis.stream(), 40 + 30 * np.sin(6 * T) * np.clip(T, 0, 1) - 40 * np.clip(1 - T, 0, 1) ** 2
    got = [stream.drive(each, DT if k else 0.0) for k, each in enumerate(v.tolist())]
    np.testing.assert_allclose(got, axis.simulate(T, v), rtol=0, atol=1e-6 * SPAN)
    assert stream.voltage == v[-1]
    assert not stream.missed


@pytest.mark.parametrize("effects", SETS, ids=ids)
def test_a_first_voltage_other_than_that_of_the_start_is_a_step(effects):
    axis, v = with_effects(*effects), 50 + 20 * np.sin(6 * T)
    assert axis.initial("end").voltage < 20.0
    stream = axis.stream()
    got = [stream.drive(each, DT if k else 0.0) for k, each in enumerate(v.tolist())]
    np.testing.assert_allclose(got, axis.simulate(T, v), rtol=0, atol=1e-6 * SPAN)


@pytest.mark.parametrize(
    "effects", [(CREEP,), (RATE,), (RATE, CREEP), (GainDrift((0.0,), (0.1,), 0.0), CREEP)], ids=ids
)
def test_a_path_that_begins_with_a_step_is_reached_from_its_start(effects):
    axis, y = with_effects(*effects), np.maximum(path(), 6e-6)
    assert y[0] - axis.rest() > 3e-6
    for v in (axis.compensate(T, y)[0], followed(axis.stream(), y)):
        np.testing.assert_allclose(axis.simulate(T, v), y, rtol=0, atol=1e-9 * SPAN)


@pytest.mark.parametrize(
    "limits", [Limits(0.0, 100.0, 300.0), Limits(0.0, 100.0, 300.0, 2e4), Limits(20.0, 55.0, 900.0)]
)
@pytest.mark.parametrize("effects", SETS, ids=ids)
def test_limits_hold_for_the_command(effects, limits):
    stream = with_effects(*effects).stream(limits)
    wish = np.where(T % 0.5 < 0.25, 4e-6, 10e-6)
    v = followed(stream, wish)
    assert v.min() >= limits.lower
    assert v.max() <= limits.upper
    rate = np.diff(v) / DT
    assert np.abs(rate).max() <= limits.slew * (1 + 1e-9)
    assert np.abs(np.diff(rate)).max() / DT <= limits.acceleration * (1 + 1e-6)


def test_held_and_missed():
    for effects in SETS:
        stream = with_effects(*effects).stream(Limits(0.0, 60.0))
        for k in range(400):
            stream.step(k * DT, 6e-6)
        assert not stream.missed, ids(effects)
        assert not stream.held
        for k in range(400, 800):
            stream.step(k * DT, 12e-6)
        assert stream.missed
        assert stream.held
        assert stream.voltage == pytest.approx(60.0, abs=1e-6)


def test_a_slow_axis_is_missed_but_not_held():
    stream = with_effects(LAG, CREEP).stream(Limits(0.0, 100.0, 10.0))
    stream.step(0.0, 2e-6)
    stream.step(DT, 8e-6)
    assert stream.missed
    assert not stream.held


@pytest.mark.parametrize("effects", SETS, ids=ids)
def test_an_axis_at_a_limit_is_held_only_where_its_wish_lies_beyond(effects):
    limits = Limits(20.0, 60.0, 100.0)
    for wish, held in ((6e-6, False), (12e-6, True)):
        stream = with_effects(*effects).stream(limits)
        assert stream.step(0.0, wish) == limits.lower
        assert stream.missed and not stream.held
        on_the_way = [(stream.step(k * DT, wish) < limits.upper - 1e-6, stream.held) for k in range(1, 800)]
        assert sum(way for way, _ in on_the_way) > 10
        assert not any(there for way, there in on_the_way if way)
        assert stream.held == stream.missed == held
    assert stream.step(800 * DT, 6e-6) < limits.upper
    assert stream.missed and not stream.held


def test_memory_follows_what_reaches_the_hysteresis():
    """A short kick of the command does not turn the hysteresis as far as it goes itself."""
    stream = with_effects(LAG).stream()
    followed(stream, path())
    before, there = stream.memory.voltage, stream.voltage
    stream.drive(there + 20.0, DT)
    assert 0.3 < stream.memory.voltage - before < 2.0
    stream.wait(1.0)
    assert stream.memory.voltage == pytest.approx(there + 20.0)


def test_commands_keep_to_what_the_amplifier_lets_through():
    stream = with_effects(Saturation(10.0, 50.0), LAG).stream(Limits(0.0, 100.0))
    assert stream.limits == Limits(10.0, 50.0)
    v = followed(stream, path())
    assert (v.min(), v.max()) == (10.0, 50.0)
    stream.limits = Limits(0.0, 40.0)
    assert stream.limits == Limits(10.0, 40.0)


@pytest.mark.parametrize("pause", [0.05, 3.0])
def test_creep_goes_on_in_a_pause(pause):
    """The wish comes back after a while; the voltage has stayed, and the stage has crept on."""
    axis = with_effects(CREEP)
    stream = axis.stream()
    followed(stream, np.full(100, 9e-6), T[:100])
    v_before = stream.voltage
    # Linear in between, as a model takes it that has one sample for it.
    v = stream.step(T[99] + pause, 9e-6)
    expected = followed(axis.stream(), np.full(100 + int(pause / DT), 9e-6), DT * np.arange(100 + int(pause / DT)))[-1]
    assert v < v_before
    held_longer = 0.2 if pause > 1 else 0.05
    assert v == pytest.approx(expected, abs=held_longer * (v_before - expected) + 1e-3)


@pytest.mark.parametrize("effects", [(LAG,), (CREEP,)], ids=ids)
def test_a_pause_leaves_the_output_where_the_amplifier_is(effects):
    """A noisy report moves the output and not the memory: the step after a pause is one from the output."""
    stream = with_effects(*effects).stream(Limits(0.0, 100.0, 0.01))
    stream.move(0.0, 0.5 * SPAN, MS)
    stream.pace.start(stream.voltage + 0.08)
    found = stream.pace.voltage
    v = stream.move(1.0, 0.5 * SPAN, 1001 * MS)
    # Two periods of the limiter count, MAX_DT together.
    assert abs(v - found) <= 0.01 * MAX_DT + 1e-9


@pytest.mark.parametrize("effects", SETS, ids=ids)
@settings(max_examples=20)
@given(st.integers(0, 300))
def test_snapshots_and_twins(effects, at):
    axis = with_effects(*effects)
    stream, y = axis.stream(Limits(0.0, 80.0, 2000.0)), path()[400:]
    for k in range(at):
        stream.step(k * DT, float(y[k]))
    state, twin, other = stream.snapshot(), stream.copy(), axis.stream(stream.limits)
    other.restore(state)
    wishes_after = y[at : at + 30].tolist()

    def go_on(one, since_ns):
        one.pace.begin(since_ns)
        return [one.move(DT, wish, since_ns + k * MS) for k, wish in enumerate(wishes_after, 1)]

    expected = go_on(stream, at * MS)
    assert go_on(twin, at * MS) == expected
    np.testing.assert_allclose(go_on(other, 0), expected, rtol=0, atol=1e-9)
    stream.restore(state)
    np.testing.assert_allclose(go_on(stream, 10**12), expected, rtol=0, atol=1e-9)


def test_without_effects_there_is_nothing_in_the_way():
    assert X.stream().timeless
    stream = X.stream()
    followed(stream, path()[:500], T[:500])
    twin, state = stream.copy(), stream.snapshot()
    expected = stream.move(DT, 5e-6, MS)
    assert twin.move(DT, 5e-6, MS) == expected
    stream.restore(state)
    assert stream.move(DT, 5e-6, 2 * MS) == expected


# Several axes


def test_a_stage_takes_its_axes_apart():
    model, wanted = coupled(), wishes()
    stream = model.streams()
    v = {name: np.empty(T.size) for name in wanted}
    for k, now in enumerate(T.tolist()):
        for name, voltage in stream.step(now, {name: float(y[k]) for name, y in wanted.items()}).items():
            v[name][k] = voltage
    seen = model.simulate(T, v)
    for name, wish in wanted.items():
        np.testing.assert_allclose(seen[name][20:], wish[20:], rtol=0, atol=1e-3 * SPAN)


def test_an_axis_that_is_not_named_keeps_its_voltage_and_counts():
    gains = {"x": 0.1, "y": 0.2}
    axes = {"x": with_effects(CrossCoupling({"y": gains["x"]})), "y": with_effects(CrossCoupling({"x": gains["y"]}))}
    stream = StageModel(axes).streams()
    stream.step(0.0, {"x": 5e-6, "y": 6e-6})
    own = {name: each.uncoupled_displacement - 2e-6 for name, each in stream.streams.items()}
    assert own["x"] + gains["x"] * own["y"] == pytest.approx(3e-6)
    assert own["y"] + gains["y"] * own["x"] == pytest.approx(4e-6)
    assert list(stream.step(1.0, {"x": 7e-6})) == ["x"]
    moved = {name: each.uncoupled_displacement - 2e-6 for name, each in stream.streams.items()}
    assert moved["y"] == own["y"]
    assert moved["x"] + gains["x"] * own["y"] == pytest.approx(5e-6)


def test_a_stage_refuses_as_a_whole():
    stream = coupled().streams()
    stream.step(0.0, {"x": 3e-6, "y": 1e-6})
    state = stream.snapshot()
    for t, y in ((1.0, {"x": 4e-6, "y": 1.0}), (-1.0, {"x": 4e-6}), (1.0, {"x": 4e-6, "z": 0.0}), (1.0, {"x": np.nan})):
        with pytest.raises(SlpiError):
            stream.step(t, y)
        assert stream.snapshot() == state
    stream.step(1.0, {"x": 8e-6, "y": 2e-6})
    stream.restore(state)
    assert stream.snapshot() == state


def test_a_stage_without_coupling_is_its_axes():
    y = path()
    model = StageModel({"x": with_effects(CREEP), "y": replace(X)})
    stream, alone = model.streams(), model.axes["x"].stream()
    with warnings.catch_warnings():
        warnings.simplefilter("error", HeldAtLimitWarning)
        for now, wish in zip(T[:500].tolist(), y[:500].tolist(), strict=True):
            assert stream.step(now, {"x": wish, "y": wish})["x"] == alone.step(now, wish)
    assert FAMILY_CASE.rest[1] == 2e-6


@pytest.mark.parametrize("effects", [(CREEP,), (CREEP, MODE, SENSITIVE)], ids=ids)
def test_where_a_stage_rests_does_not_depend_on_where_its_stream_begins(effects):
    """Creep is counted from the rest of the model: after a minute at one voltage the stage is where `simulate` says."""
    axis, t = with_effects(*effects), np.append(T, T[-1] + 60.0)
    v = np.append(np.interp(T, [0.0, 1.0, 2.0, 3.0], [X.start.voltage, 110.0, 10.0, 70.0]), 70.0)
    ended = replace(axis, end=axis.after(v))
    assert abs(ended.end.displacement - axis.start.displacement) > 0.3 * SPAN
    stream = ended.stream()
    assert stream.uncoupled_displacement == pytest.approx(axis.simulate(t, v)[-1], abs=1e-5 * SPAN)
    # The same document, read again, and another start of the same record.
    assert replace(ended, start=ended.end).stream().uncoupled_displacement == stream.uncoupled_displacement


def test_a_voltage_beyond_the_saturation_moves_nothing():
    one, other = (with_effects(Saturation(upper=80.0)).stream() for _ in range(2))
    assert one.drive(100.0, DT) == other.drive(80.0, DT)
    assert one.drive(50.0, DT) == other.drive(50.0, DT)


def test_a_reset_goes_no_further_than_the_saturation():
    wiped = with_effects(Saturation(upper=80.0)).initial("wiped")
    assert wiped == replace(X, voltage_range=(X.voltage_range[0], 80.0)).initial("wiped")
    assert abs(wiped.displacement - X.initial("wiped").displacement) > 1e-3 * SPAN
