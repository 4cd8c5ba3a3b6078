"""Stamps of two clocks: what they do to a record, and that they stay with it."""

import numpy as np
import pytest
from effects.residuals import Residual

from slpi_ros.effects.base import EffectContext
from slpi_ros.effects.chain import Chain, lasting
from slpi_ros.effects.clock import Clock

T = np.arange(0.0, 77.0, 2e-3)
PPM = 1e-6


def motion(t):
    return 1e-5 * np.sin(2 * np.pi * 1.3 * t) + 4e-6 * np.sin(2 * np.pi * 0.21 * t)


@pytest.mark.parametrize("rate", [-3e-3, -100 * PPM, 50 * PPM])
def test_a_faster_clock_stamps_later(rate):
    """What happens at t has the stamp (1 + rate) t, so at a stamp is what was there at stamp / (1 + rate)."""
    found = Clock(rate).apply(motion(T), EffectContext(T))
    inside = T < 76.0
    np.testing.assert_allclose(found[inside], motion(T / (1 + rate))[inside], rtol=0, atol=1e-9)
    back = Clock(rate).invert(found, EffectContext(T))
    np.testing.assert_allclose(back[inside], motion(T)[inside], rtol=0, atol=2e-9)


def test_each_record_begins_anew():
    around = EffectContext(np.concatenate([T, T]), records=(EffectContext(T), EffectContext(T)))
    whole = Clock(1e-3).apply(np.concatenate([motion(T)] * 2), around)
    one = Clock(1e-3).apply(motion(T), EffectContext(T))
    np.testing.assert_array_equal(whole, np.concatenate([one, one]))


@pytest.mark.parametrize("rate", [-100 * PPM, 20 * PPM])
def test_the_rate_is_found(rate):
    noise = 8e-9
    h = motion(T)
    y = Clock(rate).apply(h, EffectContext(T)) + noise * np.random.default_rng(1).standard_normal(T.size)
    (candidate,) = Clock.fit(Residual(T, h, h, y))
    gains = np.linalg.lstsq(candidate.columns, y - h, rcond=None)[0]
    found = candidate.effect(gains)
    assert found.rate == pytest.approx(rate, abs=0.5 * PPM)
    assert np.std(y - found.apply(h, EffectContext(T))) == pytest.approx(noise, rel=0.03)


def test_it_stays_with_its_record():
    """No inverse holds it, and nothing of it is carried to another record."""
    clock = Clock(-100 * PPM)
    assert lasting((clock,)) == () and Chain.of((clock,)).measured == (clock,)
    assert "100 ppm slower" in clock.describe()
