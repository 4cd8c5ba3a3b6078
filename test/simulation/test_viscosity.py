import numpy as np
import pytest

from benchmarks.hidden.physics import RateLaw, Viscosity

POWER, LOGARITHM = RateLaw(2.0, exponent=0.5), RateLaw(2.0, onset=4.0)


def ramp(rate, seconds=1.0, samples=2001):
    t = np.linspace(0, seconds, samples)
    return t, rate * t


@pytest.mark.parametrize(("law", "growth"), [(POWER, lambda r: 2 * (r / 100) ** 0.5), (LOGARITHM, None)])
def test_the_growth_follows_the_law_once_it_has_settled(law, growth):
    growth = growth or (lambda r: 2 * np.log1p(r / 4) / np.log1p(25))
    for rate in (3.0, 100.0, -400.0):
        assert law.growth(*ramp(rate))[-1] == pytest.approx(growth(abs(rate)), rel=1e-9)
    assert law.growth(*ramp(100.0))[-1] == pytest.approx(2.0)


def test_the_growth_settles_exponentially():
    t = np.arange(400) / 1000
    v = 100.0 * np.maximum(t - 0.2, 0.0)
    law = RateLaw(1.0, exponent=1.0, settling=0.02)
    after = t > 0.201
    np.testing.assert_allclose(law.growth(t, v)[after], -np.expm1(-(t[after] - 0.2) / 0.02), atol=0.04)


def test_relays_see_a_play_as_wide_as_the_growth():
    t, up = ramp(100.0)
    v = np.concatenate([up, up[::-1][1:]])
    t = np.concatenate([t, t[-1] + t[1:]])
    seen = Viscosity(POWER).relay_voltage(t, v)
    assert (v - seen)[1900] == pytest.approx(2.0) and (v - seen)[-100] == pytest.approx(-2.0)
    # nothing happens after the turn until the whole width is played through
    waiting = (t > 1.0) & (v > 96.5)
    np.testing.assert_allclose(seen[waiting], 98.0, atol=0.2)


def test_walls_follow_at_rest():
    t = np.arange(1000) / 1000
    v = np.minimum(100 * t, 50.0)
    assert Viscosity(POWER).relay_voltage(t, v)[-1] == pytest.approx(50.0, abs=1e-3)
    assert Viscosity(RateLaw(1e-7, exponent=0.5), "friction").drag(t, v)[-1] == pytest.approx(0.0, abs=1e-12)


def test_friction_turns_round_over_its_transition_and_widens_the_loop():
    rate, law = 100.0, RateLaw(1e-7, exponent=0.5, settling=1e-6)
    t, up = ramp(rate)
    v, t = np.concatenate([up, up[::-1][1:]]), np.concatenate([t, t[-1] + t[1:]])
    drag = Viscosity(law, "friction", transition=5.0).drag(t, v)
    away = v[2000] - v[2002:]
    expected = 1e-7 * (-1 + 2 * np.exp(-away / 5.0))
    np.testing.assert_allclose(drag[2002:], expected, atol=1e-10)


def test_each_form_does_only_its_own():
    t, v = ramp(100.0)
    assert not Viscosity(POWER).drag(t, v).any()
    np.testing.assert_array_equal(Viscosity(RateLaw(1e-7), "friction").relay_voltage(t, v), v)
