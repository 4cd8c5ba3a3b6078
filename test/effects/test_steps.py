"""Jumps of the zero: where they are found in a residual, and what is none."""

import numpy as np
import pytest
from effects.residuals import Residual

from slpi_ros.effects.base import EffectContext, FitContext
from slpi_ros.effects.jumps import follows_drive, jumps
from slpi_ros.effects.steps import Steps

T = np.arange(20_000) / 1000.0
AROUND = EffectContext(T)
V = 50.0 - 50.0 * np.cos(2 * np.pi * 0.7 * T)
NOISE = 8e-9
JUMPS = Steps((3.2345, 9.8765, 10.2345), (3 * NOISE, -5 * NOISE, 4 * NOISE))
NONE = {
    "noise": 0.0 * T,
    "exponential drift": 40 * NOISE * np.exp(-T / 8.0),
    "wandering": NOISE * np.cumsum(np.random.default_rng(2).standard_normal(T.size)) / 10.0,
    "repeats with the motion": 10 * NOISE * np.sin(2 * np.pi * 0.7 * T) * np.sin(2 * np.pi * 2.1 * T),
}


def noisy(x, seed=0):
    return x + NOISE * np.random.default_rng(seed).standard_normal(x.size)


def view(y, more=0.0):
    """A fit that leaves `y` without jumps, where other effects have `more` than the hysteresis."""
    h, used = 2e-7 * V, np.ones(T.size, dtype=bool)
    zeros, left = (lambda: np.zeros(1)), (lambda name: y)
    signals = T, V, V, h, h + y + more, used, y
    others = AROUND, 1e-10, (), lambda u: 2e-7 * u, lambda: 0.7, lambda: [(0.7, 20.0)], zeros, lambda: ~used, left
    return FitContext(*signals, *others)


@pytest.mark.parametrize("seed", range(4))
def test_small_jumps_are_found_where_they_are(seed):
    found = sorted(jumps(noisy(JUMPS.added(AROUND), seed), 12))
    assert [k for k, _ in found] == pytest.approx([3235, 9877, 10235], abs=4)
    assert [size for _, size in found] == pytest.approx(JUMPS.sizes, abs=0.5 * NOISE)


@pytest.mark.parametrize("case", NONE)
def test_what_is_gradual_or_everywhere_is_no_jump(case):
    assert all(not jumps(noisy(NONE[case], seed), 12) for seed in range(4))


def test_the_candidates_hold_ever_more_jumps():
    h = 2e-7 * V
    forms = list(Steps.fit(Residual(T, V, h, noisy(h))))
    assert {form.columns.shape[1] for form in forms} == {0} and forms[0].effect(np.empty(0)) == Steps((), ())
    forms = list(Steps.fit(Residual(T, V, h, noisy(h + JUMPS.added(AROUND)))))
    assert [form.columns.shape[1] for form in forms][:4] == [1, 2, 3, 3]
    found = forms[2].effect(np.array(JUMPS.sizes))
    assert found.times == pytest.approx(JUMPS.times, abs=5e-3) and found.sizes == JUMPS.sizes
    # A jump that the joint fit makes another one than it looks like was none.
    assert forms[2].effect(np.array([1.0, -1.0, 1.0]) * JUMPS.sizes).sizes == JUMPS.sizes[::2]


def test_jumps_are_plausible_if_sudden_and_where_the_voltage_does_not_turn():
    assert JUMPS.plausible(view(noisy(JUMPS.added(AROUND))))
    # What another effect explains, such as ringing, does not blur them.
    assert JUMPS.plausible(view(noisy(JUMPS.added(AROUND)), 100 * NOISE * np.sin(2 * np.pi * 90.0 * T)))
    ramp = np.interp(T, (9.0, 10.0), (0.0, 10 * NOISE))
    assert not Steps((9.5,), (10 * NOISE,)).plausible(view(noisy(ramp)))
    # One that is none goes, the others stay.
    mixed = Steps((*JUMPS.times, 19.5), (*JUMPS.sizes, 10 * NOISE))
    left = view(noisy(JUMPS.added(AROUND)))
    assert not mixed.plausible(left) and mixed.only_plausible(left) == JUMPS
    turns = Steps(tuple(k / 1.4 + 5e-4 for k in range(1, 6)), tuple(10 * NOISE * (-1) ** k for k in range(5)))
    assert not turns.plausible(view(noisy(turns.added(AROUND))))
    assert not follows_drive(np.array([5000, 9000]), V)


@pytest.mark.parametrize(("late", "follows"), [(5, True), (30, True), (200, False)])
def test_jumps_that_follow_steps_of_the_voltage_late_are_of_the_drive(late, follows):
    step, every = np.arange(4) * 1400 + 700, 1400
    v = 10.0 * (np.arange(4 * every) % every >= 700)
    assert follows_drive(step + late, v) == follows


def test_a_description_tells_the_largest():
    assert "3 times" in JUMPS.describe() and "9.8765 s" in JUMPS.describe()
    assert Steps((), ()).describe() == "the zero does not jump in this record"
