import numpy as np
import pytest
from effects.residuals import Residual
from hypothesis import given
from hypothesis import strategies as st
from strategies import FAMILY_CASE, axis_model

from benchmarks.hidden.physics import Ageing
from slpi_ros.effects.base import EffectContext
from slpi_ros.effects.gain_drift import GainDrift

T = np.linspace(0.0, 200.0, 4001)
# 60 equal loops about 10 um.
H = 1e-5 - 8e-6 * np.cos(2 * np.pi * 0.3 * T) + 1e-6 * np.sin(2 * np.pi * 0.3 * T)
DRIFT = GainDrift((50.0, 200.0), (-0.02, -0.03), 4e-6)


def test_loops_shrink_about_the_origin():
    y = DRIFT.apply(H, EffectContext(T))
    assert y[0] == H[0]
    assert y[T == 50.0] == pytest.approx(4e-6 + 0.98 * (H[T == 50.0] - 4e-6), rel=1e-12)
    assert np.ptp(y[-400:]) == pytest.approx(0.97 * np.ptp(H[-400:]), rel=3e-3)
    still = np.full_like(T, 4e-6)
    np.testing.assert_array_equal(DRIFT.apply(still, EffectContext(T)), still)


def test_after_the_record_the_last_sensitivity_stays():
    later = EffectContext(T + 1e6)
    assert DRIFT.lasting == GainDrift((0.0,), (-0.03,), 4e-6)
    np.testing.assert_array_equal(DRIFT.lasting.apply(H, EffectContext(T)), DRIFT.apply(H, later))
    np.testing.assert_allclose(DRIFT.apply(H, later), 4e-6 + 0.97 * (H - 4e-6), rtol=1e-12)
    streaming = DRIFT.streaming()
    streaming.start(float(H[0]))
    for x in H[:50].tolist():
        assert streaming.forward(0.01, x) == pytest.approx(4e-6 + 0.97 * (x - 4e-6), rel=1e-12)
        assert streaming.forward(0.01, streaming.inverse(0.01, x)) == pytest.approx(x, rel=1e-12)


@given(st.floats(0.0, 12e-6), st.floats(0.02, 0.9))
def test_a_stream_uses_the_last_sensitivity(wanted, dt):
    """The stage as it is after the record goes where it is told."""
    axis = axis_model(FAMILY_CASE)
    changed = type(axis)(**{**axis.__dict__, "effects": (DRIFT,)})
    stream = changed.stream()
    start = stream.uncoupled_displacement
    assert start == pytest.approx(4e-6 + 0.97 * (axis.memory().displacement - 4e-6), rel=1e-12)
    v = [stream.step(dt * k, wanted) for k in range(3)]
    h = axis.memory().forward(v[-1])
    if not stream.held:
        assert 4e-6 + 0.97 * (h - 4e-6) == pytest.approx(wanted, abs=1e-12)


@pytest.mark.parametrize("form", ["ramp", "settling", "cycles", "sine"])
@pytest.mark.parametrize("pivot", [3e-6, 10e-6])
def test_fit_finds_the_course_of_a_simulated_change(form, pivot):
    ageing = Ageing(-0.03, form, {"settling": 60.0, "cycles": 4e3, "sine": 400.0}.get(form, 1.0), pivot)
    v = 50.0 - 50.0 * np.cos(2 * np.pi * 0.3 * T)
    noise = np.random.default_rng(0).normal(0.0, 1e-8, T.size)
    record = Residual(T, v, H, ageing.scaled(T, v, H) + noise)
    found = []
    for candidate in GainDrift.fit(record):
        gains = np.linalg.lstsq(candidate.columns, record.residual, rcond=None)[0]
        effect = candidate.effect(gains)
        found.append((np.std(record.y - effect.apply(H, record.around)), effect))
    left, best = min(found, key=lambda one: one[0])
    assert left < 1.5e-8
    assert best.origin == pytest.approx(pivot, abs=3e-7)
    np.testing.assert_allclose(best.factor(T) - 1.0, ageing.path(T, v), atol=1e-3)


@pytest.mark.parametrize("drift", [2e-7 * T / T[-1], 2e-7 * np.sin(T / 60.0)])
def test_a_thermal_drift_is_no_gain_drift(drift):
    record = Residual(T, np.zeros_like(T), H, H + drift)
    for candidate in GainDrift.fit(record):
        effect = candidate.effect(np.linalg.lstsq(candidate.columns, record.residual, rcond=None)[0])
        assert H.min() <= effect.origin <= H.max()
        assert np.std(record.y - effect.apply(H, record.around)) > 0.5 * np.std(drift)


def test_the_sentence_holds_the_figures():
    assert "falls by 3 %" in DRIFT.describe() and "200 s" in DRIFT.describe()
    assert "rises by 2.4 %" in GainDrift((10.0, 20.0), (0.024, 0.01), 0.0).describe()
