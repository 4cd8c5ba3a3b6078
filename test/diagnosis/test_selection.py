"""The rules by which effects win, lose or draw, on scores made by hand."""

from dataclasses import dataclass
from types import SimpleNamespace

import numpy as np
import pytest

from slpi_ros.diagnosis.candidates import alike
from slpi_ros.diagnosis.joint_fit import Score
from slpi_ros.diagnosis.significance import (
    CHANCE,
    LEAST_GAIN,
    carries_over,
    chance_of_gain,
    clearly_better,
    counts,
    gain,
    independent_trials,
    worse_left_out,
    worse_on_none,
)

BLOCKS = 12
NOTHING = np.empty(0)


def score(rms: float, records: np.ndarray = NOTHING, spread: float = 0.0, seed: int = 0) -> Score:
    """Return the score of blocks that all have about this error (m)."""
    factors = 1.0 + spread * np.random.default_rng(seed).standard_normal(BLOCKS)
    losses = factors**2 / np.mean(factors**2) * rms**2
    return Score(losses, NOTHING, records)


@dataclass
class Rival:
    """What `alike` asks of an effect that competes."""

    name: str
    score: Score
    effect: object = None
    step: float = 1e-3
    noise: float = 1e-9

    @property
    def explanation(self) -> SimpleNamespace:
        return SimpleNamespace(t=np.arange(50) * self.step, noise=self.noise)


@pytest.mark.parametrize(("share", "expected"), [(0.2 * LEAST_GAIN, False), (0.9 * LEAST_GAIN, False), (0.2, True)])
def test_a_gain_counts_from_a_least_share_on_however_sure_it_is(share, expected):
    before, after = score(1e-8), score(1e-8 * (1.0 - share))
    assert gain(before, after) == pytest.approx(share)
    assert counts(before, after) is expected
    assert 0.01 <= LEAST_GAIN <= 0.1


@pytest.mark.parametrize(("share", "expected"), [(0.9 * LEAST_GAIN, False), (0.2, True)])
def test_a_gain_on_all_together_carries_over_from_the_same_share_on(share, expected):
    before = score(1e-8, np.full(3, 1e-16))
    one_grows = np.array([1.01, 1.0 - share, 1.0 - share])
    assert carries_over(before, score(1e-9, (1e-8 * one_grows) ** 2)) is expected


@pytest.mark.parametrize(("share", "expected"), [(0.01, True), (-0.01, False)])
def test_a_gain_on_each_record_that_was_left_out_carries_over(share, expected):
    before = score(1e-8, np.full(3, 1e-16))
    assert carries_over(before, score(1e-9, np.full(3, (1e-8 * (1.0 - share)) ** 2))) is expected


def test_a_gain_that_chance_gives_does_not_count():
    before, after = score(1e-8, spread=0.5, seed=1), score(0.9e-8, spread=0.5, seed=2)
    assert gain(before, after) > LEAST_GAIN and not counts(before, after)


@pytest.mark.parametrize(("rise", "expected"), [(0.04, True), (0.06, False)])
def test_one_record_may_rise_by_a_twentieth_of_what_all_fall_by(rise, expected):
    before = np.array([1.0, 1.0, 400.0])
    fall = 360.0 / 3.0
    assert worse_on_none(before, np.array([1.0, 1.0 + rise * fall, 400.0 - 360.0 - rise * fall])) is expected


@pytest.mark.parametrize(("rise", "expected"), [(0.38, True), (0.42, False)])
def test_one_record_that_is_left_out_may_rise_by_two_fifths_of_what_all_fall_by(rise, expected):
    before, fall = np.array([1.0, 1.0, 400.0]), 100.0
    after = np.array([1.0, 1.0 + rise * fall, 400.0 - 3.0 * fall - rise * fall])
    assert carries_over(score(1e-8, 1e-18 * before), score(1e-9, 1e-18 * after)) is expected


@pytest.mark.parametrize(("share", "expected"), [(0.28, False), (0.32, True)])
def test_an_effect_of_which_one_record_alone_shows_much_acts_in_few_blocks(share, expected):
    records, left = np.array([1.0, 1.0, 4.0]), np.ones(BLOCKS)
    left[:4] = [0.2, 0.3, 0.9, 0.2]
    before = Score(np.full(BLOCKS, 1e-16), NOTHING, 1e-16 * records)
    after = Score(1e-16 * left, NOTHING, 1e-16 * records * np.array([1.0, 1.0, (1.0 - share) ** 2]))
    assert gain(before, after) < 0.3 and CHANCE < chance_of_gain(before, after) < 0.05
    assert counts(before, after, own=False) is expected
    # Of what is separate in each record, those that are left out tell nothing.
    assert not counts(before, after)


@pytest.mark.parametrize(("records", "expected"), [(1.04, False), (1.06, True), (None, False)])
def test_a_simpler_effect_may_be_worse_on_records_that_are_left_out_by_a_twentieth(records, expected):
    best = score(1e-9, np.full(2, 1e-16) if records else NOTHING)
    other = score(1e-9, np.full(2, 1e-16 * records**2) if records else NOTHING)
    assert worse_left_out(best, other) is expected


@pytest.mark.parametrize(("other", "expected"), [(1.01e-9, True), (9e-9, False)])
def test_effects_that_explain_as_much_are_alike(other, expected):
    best = Rival("creep", score(1e-9, spread=0.3, seed=1))
    rival = Rival("thermal_drift", score(other, spread=0.3, seed=2))
    assert alike(best, rival, score(1e-8), one_speed=False) is expected


def test_effects_that_differ_beyond_chance_are_not_alike():
    best, rival = Rival("creep", score(1e-9)), Rival("thermal_drift", score(2e-9))
    assert not alike(best, rival, score(1e-8), one_speed=False)


def test_at_one_speed_time_and_rate_are_alike_although_one_is_better():
    best, rival = Rival("creep", score(1e-9)), Rival("rate_dependence", score(6e-9))
    assert alike(best, rival, score(1e-8), one_speed=True)
    assert not alike(best, rival, score(1e-8), one_speed=False)


def test_a_difference_within_what_the_better_one_leaves_beyond_the_noise_decides_nothing():
    best, rival = Rival("creep", score(1.5e-9)), Rival("thermal_drift", score(1.6e-9))
    assert alike(best, rival, score(1e-8), one_speed=False)
    best.noise = 1.5e-9
    assert not alike(best, rival, score(1e-8), one_speed=False)
    assert clearly_better(score(1e-9), score(1.01e-9), 1e-9) and not clearly_better(score(2e-9), score(2.5e-9), 1e-9)


def noise_scores(count: int, seed: int) -> tuple[Score, list[Score]]:
    """Return a score, and scores of candidates whose gains are noise, independent of each other."""
    rng = np.random.default_rng(seed)
    before = Score(np.full(40, 1.0), NOTHING, NOTHING)
    return before, [Score(1.0 + 0.05 * rng.standard_normal(40), NOTHING, NOTHING) for _ in range(count)]


@pytest.mark.parametrize("count", [1, 10, 100])
def test_the_number_of_trials_is_that_of_the_independent_candidates(count):
    before, tried = noise_scores(count, 1)
    assert independent_trials(before, tried) == pytest.approx(count, rel=0.5)
    # A copy is no trial of its own.
    assert independent_trials(before, 3 * tried) == pytest.approx(independent_trials(before, tried), rel=0.05)


def test_the_best_of_many_that_are_noise_is_as_seldom_significant_as_one():
    found = []
    for seed in range(200):
        before, tried = noise_scores(30, seed)
        trials = independent_trials(before, tried)
        found.append(min(chance_of_gain(before, one, trials) for one in tried))
    alone = [
        min(chance_of_gain(before, one) for one in tried) for before, tried in map(noise_scores, [30] * 200, range(200))
    ]
    assert np.mean(np.array(found) < 0.05) < 0.15 < np.mean(np.array(alone) < 0.05)
    assert np.mean(np.array(found) < CHANCE) < 0.05
