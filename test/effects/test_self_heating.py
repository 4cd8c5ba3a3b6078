from dataclasses import replace

import numpy as np
import pytest
from effects.residuals import Residual
from model.test_model_effects import with_effects

import slpi_ros
from benchmarks.hidden import hide
from benchmarks.hidden.physics import Warmth
from slpi_ros.effects.base import EffectContext
from slpi_ros.effects.lag import Lag
from slpi_ros.effects.rate_dependence import RateDependence
from slpi_ros.effects.saturation import Saturation
from slpi_ros.effects.self_heating import MOST, SelfHeating
from slpi_ros.effects.slew import Slew

DT = 2e-3
T = DT * np.arange(30_000)
# A minute: bursts of 10 s, at 4 Hz, and rests of 10 s.
BURST = (T // 10) % 2 == 0
V = 50.0 - 40.0 * np.cos(2 * np.pi * 4 * T) * BURST - 40.0 * ~BURST
H = 1.2e-7 * V + 3e-10 * V**2
HEAT = SelfHeating(-4e-7, 7.0, 2e-6)
AROUND = EffectContext(T, voltage=V)
# Mean square rate of the bursts.
POWER = 0.5 * (40.0 * 2 * np.pi * 4) ** 2


def followed(effect, t, v, x):
    streaming = effect.streaming()
    streaming.reach(float(v[0]))
    streaming.start(float(x[0]))
    said = []
    for dt, voltage, h in zip(np.diff(t, prepend=t[0]).tolist(), v.tolist(), x.tolist(), strict=True):
        # What it says before it knows the voltage is what it does.
        inside = streaming.inverse(dt, h)
        streaming.reach(voltage)
        y = streaming.forward(dt, inside)
        assert y == pytest.approx(h, rel=1e-13, abs=1e-20)
        said.append(inside)
    return np.array(said)


def test_the_sensitivity_follows_the_power():
    y = HEAT.apply(H, AROUND)
    factor = (y - 2e-6) / (H - 2e-6)
    np.testing.assert_allclose(factor, HEAT.factor(AROUND), rtol=1e-9)
    assert factor[0] == 1.0
    # As an exponential filter of the mean power; the square of the rate ripples at 8 Hz.
    after = -4e-7 * POWER * (1 - np.exp(-10 / 7.0))
    assert factor[T < 10.0][-1] - 1.0 == pytest.approx(after, rel=0.02)
    assert factor[T < 20.0][-1] - 1.0 == pytest.approx(after * np.exp(-10 / 7.0), rel=0.02)
    np.testing.assert_array_equal(HEAT.apply(np.full_like(H, 2e-6), AROUND), 2e-6)


def test_it_is_what_another_implementation_of_the_physics_gives():
    warmth = Warmth(-4e-7, 1.0, 7.0, 2e-6)
    np.testing.assert_allclose(HEAT.factor(AROUND) - 1.0, warmth.path(T, V), atol=3e-3 * 4e-7 * POWER)


def test_the_voltage_of_a_sample_counts_from_the_next_one_on():
    for k in (1, 700, T.size - 2):
        other = V.copy()
        other[k] += 3.0
        changed = np.flatnonzero(HEAT.factor(EffectContext(T, voltage=other)) != HEAT.factor(AROUND))
        assert changed[0] == k + 1


def test_each_record_starts_cold_and_a_piezo_without_a_voltage_rests():
    two = EffectContext(np.concatenate([T, T]), records=(EffectContext(T), EffectContext(T)))
    driven = two.driven(np.concatenate([V, V]))
    np.testing.assert_array_equal(HEAT.factor(driven), np.tile(HEAT.factor(AROUND), 2))
    np.testing.assert_array_equal(driven.records[1].voltage, V)
    np.testing.assert_allclose(HEAT.apply(H, EffectContext(T)), H, rtol=1e-15)


def test_a_record_that_starts_warm_cools_down_to_what_its_motion_makes():
    warm = replace(HEAT, initial=(0.0, POWER))
    two = EffectContext(np.concatenate([T, T]), records=(EffectContext(T), EffectContext(T))).driven(np.tile(V, 2))
    first, second = two.split(warm.factor(two))
    np.testing.assert_array_equal(first, HEAT.factor(AROUND))
    np.testing.assert_allclose(second - first, -4e-7 * POWER * np.exp(-T / 7.0), rtol=1e-6, atol=1e-12)
    np.testing.assert_array_equal(warm.of_record(1).factor(AROUND), second)
    assert warm.lasting == HEAT and warm.of_record(0).factor(AROUND) == pytest.approx(first)


@pytest.mark.parametrize("effect", [HEAT, replace(HEAT, gain=3e-3), replace(HEAT, time_constant=0.01)])
def test_sample_by_sample_it_is_the_same(effect):
    rng = np.random.default_rng(0)
    t = np.cumsum(DT * rng.integers(0, 3, T.size))
    expected = effect.invert(H, EffectContext(t, voltage=V))
    np.testing.assert_allclose(followed(effect, t, V, H), expected, rtol=1e-13)


def test_a_step_changes_the_sensitivity_by_no_more_than_its_bound():
    v = np.where(T < 1.0, 0.0, 100.0)
    for gain in (1.0, -1.0):
        factor = SelfHeating(gain, 3.0).factor(EffectContext(T, voltage=v))
        assert np.max(np.abs(factor - 1.0)) == pytest.approx(MOST, rel=1e-3)
    # In no time there is no rate.
    t = np.where(T < 1.0, T, T - DT)
    at = int(np.argmax(v > 0.0))
    assert t[at] == t[at - 1]
    np.testing.assert_array_equal(SelfHeating(1.0, 3.0).factor(EffectContext(t, voltage=v)), 1.0)


@pytest.mark.parametrize("warmth", [Warmth(-4e-7, 1.0, 7.0, 3e-6), Warmth(2e-7, 1.0, 25.0, 8e-6)])
def test_fit_finds_the_gain_and_the_time_constant_of_a_simulated_stage(warmth):
    noise = np.random.default_rng(0).normal(0.0, 1e-8, T.size)
    record = Residual(T, V, H, warmth.scaled(T, V, H) + noise)
    found = []
    for candidate in SelfHeating.fit(record):
        gains = np.linalg.lstsq(candidate.columns, record.residual, rcond=None)[0]
        if effect := candidate.effect(gains):
            found.append((np.std(record.y - effect.apply(H, record.around)), effect))
    left, best = min(found, key=lambda one: one[0])
    assert left < 0.4 * np.std(record.residual)
    assert best.time_constant == pytest.approx(warmth.time_constant, rel=0.7)
    assert best.gain == pytest.approx(warmth.change, rel=0.5)
    assert best.origin == pytest.approx(warmth.pivot, abs=1e-6)


def test_fit_finds_a_warm_start():
    true = replace(HEAT, time_constant=5.656854, initial=(0.5 * POWER,))
    record = Residual(T, V, H, true.apply(H, AROUND))
    fits = []
    for candidate in SelfHeating.fit(record):
        gains, left, *_ = np.linalg.lstsq(candidate.columns, record.residual, rcond=None)
        fits.append((float(left[0]), candidate.columns.shape[1] - 2, candidate.effect(gains)))
    _, starting, best = min(fits, key=lambda one: one[0])
    assert starting == 2 and best.initial == pytest.approx((0.5 * POWER,), rel=0.5)
    assert all(not effect.initial for _, starting, effect in fits if effect and not starting)


def test_a_stage_at_rest_has_no_candidates():
    assert not list(SelfHeating.fit(Residual(T, np.full_like(T, 3.0), H, H)))


@pytest.mark.parametrize(
    "others", [(Lag(0.01),), (Slew(300.0),), (Saturation(10.0, 60.0),), (RateDependence(1.0, 0.1, 2e-8),)], ids=str
)
def test_the_power_is_that_of_the_voltage_at_the_piezo(others):
    """Not of the command, and not of what the hysteresis feels."""
    axis = with_effects(*others, HEAT)
    cold, (before, law) = with_effects(*others), (axis.chain.before, axis.chain.around)
    at_piezo = V
    for effect in before:
        at_piezo = effect.apply(at_piezo, EffectContext(T, start=axis.start.voltage))
    assert bool(law) != bool(before)
    expected = HEAT.apply(cold.simulate(T, V), EffectContext(T, voltage=at_piezo))
    np.testing.assert_allclose(axis.simulate(T, V), expected, rtol=1e-12)
    stream = axis.stream()
    got = [stream.drive(v, DT if k else 0.0) for k, v in enumerate(V[:3000].tolist())]
    np.testing.assert_allclose(got, expected[:3000], rtol=0, atol=1e-12)


def test_another_model_goes_on_warm():
    one, other = with_effects(HEAT).stream(), with_effects(replace(HEAT, time_constant=9.0)).stream()
    for k, v in enumerate(V[:3000].tolist()):
        one.drive(v, DT if k else 0.0)
    other.resume(one)
    assert other.snapshot().effects["self_heating"] == one.snapshot().effects["self_heating"]
    assert other.snapshot().effects["self_heating"][0] > 0.2 * POWER


def test_a_path_known_in_advance_is_compensated_with_its_own_power():
    found = slpi_ros.identify(hide(1, [], base="preisach", axes=1, samples=4000).record, "smpi").axes["x"]
    assert not found.causal
    axis, t = replace(found, effects=(SelfHeating(5e-7, 4.0, 2e-6),)), T[:15_000]
    v = 50.0 - 50.0 * np.cos(2 * np.pi * (0.5 * t + 0.02 * t**2))
    y = axis.simulate(t, v)
    again, ignored = (axis.simulate(t, each.compensate(t, y, start_memory="start")[0]) for each in (axis, found))
    assert np.std(ignored - y) > 1e-7
    np.testing.assert_allclose(again, y, rtol=0, atol=1e-4 * np.std(ignored - y))


@pytest.mark.long
def test_noise_of_a_measured_voltage_is_no_power():
    hidden = hide(1, [], base="preisach", axes=1, samples=12_000)
    v = hidden.record.voltage["x"] + np.random.default_rng(0).normal(0.0, 0.03, len(hidden.record))
    record = replace(hidden.record, voltage={"x": v})
    found = slpi_ros.diagnose(record, slpi_ros.identify(record)).axes["x"]
    assert not found.effects, found.summary


@pytest.mark.long
def test_with_a_measured_voltage_it_is_found_as_with_the_command():
    hidden = hide(2, ["self_heating"], axes=1, size=10.0, samples=12_000)
    v = hidden.record.voltage["x"] + np.random.default_rng(0).normal(0.0, 0.03, len(hidden.record))
    record = replace(hidden.record, voltage={"x": v})
    (found,) = slpi_ros.diagnose(record, slpi_ros.identify(record)).axes["x"].effects
    true = hidden.truth[0].parameters
    assert found.effect.gain == pytest.approx(true["gain"], rel=0.1)
    assert found.effect.time_constant == pytest.approx(true["time_constant"], rel=0.1)


def test_the_sentence_holds_the_figures():
    assert "158 V/s rms it falls by 1 %" in HEAT.describe() and "7 s" in HEAT.describe()
