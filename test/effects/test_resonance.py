"""Resonances that are tried: of what a light mode leaves, one near its line explains most."""

import numpy as np
import pytest
from effects.residuals import Residual

from slpi_ros.effects.base import EffectContext
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
