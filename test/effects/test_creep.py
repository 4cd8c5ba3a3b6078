"""Creep by a power of time: its chain, and what a record of it says about a longer one."""

import numpy as np
import pytest
from effects.cases import numbers
from effects.residuals import Residual
from hypothesis import given
from hypothesis import strategies as st

from slpi_ros.effects.base import EffectContext
from slpi_ros.effects.creep import Creep
from slpi_ros.effects.parameters import facts_of

NOISE = 5e-9


@given(numbers(0.02, 0.9), numbers(1e-3, 0.1), st.sampled_from((1e-3, 1e-2, 1.0)))
def test_a_step_creeps_with_the_power_of_time(exponent, gain, dt):
    """From 10 ms to a day, to 1 % of the creep."""
    t = np.arange(2000) * dt
    t = np.append(t, np.geomspace(2.0 * t[-1], 1e5, 20))
    crept = Creep(exponent=exponent, gain=gain).apply(np.zeros(t.size), EffectContext.since_start(t, start=-1.0))
    late = t > 0.01
    np.testing.assert_allclose(crept[late], gain * t[late] ** exponent, rtol=0.012)


def test_two_numbers_are_fitted():
    power = Creep(exponent=0.2, gain=0.02)
    assert [leaf.place for leaf in power.free_leaves()] == ["exponent", "gain"]
    again = power.with_free([0.3, 0.01])
    assert (again.exponent, again.gain, again.time_constants) == (0.3, 0.01, ())
    chain = Creep((1.0,), (0.1,))
    assert [leaf.place for leaf in chain.free_leaves()] == ["time_constants.0", "gains.0"]
    assert "power 0.2" in power.describe() and "5.02 %" in power.describe()


def moves(t: np.ndarray, rng: np.random.Generator, count: int) -> np.ndarray:
    """Return steps of up to 10 um at random times, from 0 m."""
    at = np.sort(rng.uniform(0.02, 0.95, count)) * t[-1]
    return np.concatenate([[0.0], rng.uniform(0.0, 1e-5, count)])[np.searchsorted(at, t, side="right")]


@pytest.mark.parametrize("exponent", [0.1, 0.25, 0.5])
def test_a_record_ten_times_as_long_is_predicted(exponent):
    """With the exponent and gain that a short record has, but with no chain that is fitted to its length."""
    rng, truth = np.random.default_rng(3), Creep(exponent=exponent, gain=0.02)
    t, longer = np.arange(0.0, 30.0, 0.01), np.arange(0.0, 300.0, 0.02)
    h, far = moves(t, rng, 8), moves(longer, rng, 10)
    y = truth.apply(h, EffectContext(t)) + NOISE * rng.standard_normal(t.size)
    best = {}
    for candidate in Creep.fit(Residual(t, h, h, y)):
        columns = np.column_stack([h, candidate.columns])
        gains = np.linalg.lstsq(columns, y, rcond=None)[0]
        effect = candidate.effect(gains[-candidate.positive :]) if gains[-candidate.positive :].min() > 0 else None
        if effect is not None:
            left = np.std(y - columns @ gains)
            best[candidate.group] = min(best.get(candidate.group, (np.inf,)), (left, effect), key=lambda one: one[0])
    power = _refined(best[1][1], h, y, t)
    assert power.exponent == pytest.approx(exponent, abs=0.05)
    truly = truth.apply(far, EffectContext(longer))
    error = power.apply(far, EffectContext(longer)) - truly
    by_chain = best[0][1].apply(far, EffectContext(longer)) - truly
    # Without what another sensitivity of the hysteresis would take.
    assert _beside(error, far) < NOISE
    assert _beside(error, far) < 0.5 * _beside(by_chain, far)


def _beside(error: np.ndarray, h: np.ndarray) -> float:
    return float(np.std(error - np.column_stack([h, np.ones_like(h)]) @ np.linalg.lstsq(
        np.column_stack([h, np.ones_like(h)]), error, rcond=None)[0]))  # fmt: skip


def _refined(effect: Creep, h: np.ndarray, y: np.ndarray, t: np.ndarray) -> Creep:
    """Return the effect after Gauss-Newton steps, with the sensitivity of the hysteresis free."""
    assert facts_of(Creep)["exponent"].fit is not None
    for _ in range(20):
        now = [leaf.value for leaf in effect.free_leaves()]
        at = effect.apply(h, EffectContext(t))
        columns = [h]
        for k, value in enumerate(now):
            near = effect.with_free([*now[:k], value * 1.001, *now[k + 1 :]])
            columns.append((near.apply(h, EffectContext(t)) - at) / (0.001 * value))
        move = np.linalg.lstsq(np.column_stack(columns), y - at, rcond=None)[0][1:]
        effect = effect.with_free([max(v + 0.7 * d, 0.3 * v) for v, d in zip(now, move.tolist(), strict=True)])
    return effect
