"""Modes of any damping: their equation, their inverse on whole paths, and those that are tried."""

import itertools

import numpy as np
import pytest
from effects.cases import BY_NAME, Record, numbers, records
from effects.residuals import Residual
from hypothesis import assume, given
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from slpi_ros.effects.base import Effect, EffectContext
from slpi_ros.effects.filters import Mode
from slpi_ros.effects.resonance import Resonance

T = np.arange(8000) / 4000.0


def small_steps(rng):
    """Displacement (m, (N,)) that steps up and down by 1 um, at random."""
    turns = np.cumsum(rng.integers(20, 120, 400))
    return 1e-6 * (np.searchsorted(turns, np.arange(T.size), side="right") % 2)


@pytest.mark.parametrize(("frequency", "damping"), [(443.0, 0.0145), (412.0, 0.007), (300.0, 0.005), (200.0, 0.03)])
@pytest.mark.parametrize("seed", range(3))
def test_a_light_mode_explains_most_of_what_it_leaves(frequency, damping, seed):
    rng = np.random.default_rng(seed)
    h = small_steps(rng)
    y = Resonance((Mode(frequency, damping),)).apply(h, EffectContext(T)) + 1e-8 * rng.standard_normal(T.size)
    tried = []
    for candidate in Resonance.fit(Residual(T, h, h, y)):
        gains = np.linalg.lstsq(candidate.columns, y - h, rcond=None)[0]
        if (effect := candidate.effect(gains[-candidate.positive :])) is not None:
            tried.append((np.std(y - h - candidate.columns @ gains) / np.std(y - h), effect.modes[0].frequency))
    left, found = min(tried)
    assert left < 0.5
    assert found == pytest.approx(frequency, rel=0.015)


@pytest.mark.parametrize(("frequency", "damping"), [(6.5, 0.45), (40.0, 1.0), (12.0, 1.6), (3.0, 0.7), (600.0, 0.5)])
@pytest.mark.parametrize("seed", range(2))
def test_a_damped_mode_explains_most_of_what_it_leaves(frequency, damping, seed):
    rng = np.random.default_rng(seed)
    h = small_steps(rng)
    y = Resonance((Mode(frequency, damping),)).apply(h, EffectContext(T)) + 1e-8 * rng.standard_normal(T.size)
    left = [
        np.std(y - h - candidate.columns @ np.linalg.lstsq(candidate.columns, y - h, rcond=None)[0]) / np.std(y - h)
        for candidate in Resonance.fit(Residual(T, h, h, y))
    ]
    assert min(left) < 0.4


@pytest.mark.parametrize("damping", [1e-3, 0.45, 1.0 - 1e-9, 1.0, 1.0 + 1e-9, 1.7, 2.0])
def test_a_mode_is_its_differential_equation(damping):
    """For an input that is linear between samples, against a solver that knows no poles; and after a step."""
    w, t = 2 * np.pi * 6.5, np.arange(120) / 200.0
    h = 1.0 * np.sin(2 * np.pi * 2.0 * t) ** 3

    def solve(drive, state):
        """From sample to sample: a solver's step must not cross a kink of the input."""
        path = [state]
        for begin, end in itertools.pairwise(t):
            path.append(
                solve_ivp(
                    lambda now, at: (at[1], w * w * (np.interp(now, t, drive) - at[0]) - 2 * damping * w * at[1]),
                    (begin, end), path[-1], method="DOP853", rtol=1e-12, atol=1e-14,
                ).y[:, -1]
            )  # fmt: skip
        return np.array(path)[:, 0]

    mode = Mode(6.5, damping)
    driven = Resonance((mode,)).apply(h, EffectContext(t))
    np.testing.assert_allclose(driven, solve(h, (0.0, 0.0)), rtol=0, atol=1e-10)
    np.testing.assert_allclose(mode.release(t), solve(np.zeros_like(t), (1.0, 0.0)), rtol=0, atol=1e-8)


@given(BY_NAME["resonance"], records("displacement"))
def test_a_whole_path_is_inverted_exactly(resonance, record: Record):
    assume(all(mode.omega * record.around.t[1] < 2.9 for mode in resonance.modes))
    there = resonance.apply(resonance.invert(record.signal, record.around), record.around)
    np.testing.assert_allclose(there, record.signal, rtol=0, atol=1e-5 * record.span)


@given(numbers(1e-3, 2.0), numbers(-1e-6, 1e-6), st.booleans())
def test_a_path_that_begins_elsewhere_is_reached(damping, start, part):
    """The way to its beginning is that sample by sample; then the stage is on the path."""
    resonance, t = Resonance((Mode(90.0, damping, 0.7 if part else 1.0),)), np.arange(2000) * 1e-3
    path = 1e-6 * np.sin(np.pi * t) ** 4
    around, rest = EffectContext.since_start(t, start=start), np.full_like(path, path[0])
    error = resonance.apply(resonance.invert(path, around), around) - path
    way = resonance.apply(Effect.invert(resonance, rest, around), around) - rest
    np.testing.assert_allclose(error, way, rtol=0, atol=1e-11)
