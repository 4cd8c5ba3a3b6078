"""The criterion by which one set of effects predicts better than another, on errors made by hand."""

from dataclasses import replace

import numpy as np
import pytest

from slpi_ros.diagnosis.held_out import BLOCKS, Loss
from slpi_ros.diagnosis.ruler import CHANCE, LEAST, NO_WORSE, beats, carries_over, chance, independent_trials, share

NOISE, SAMPLES = 1e-9, 20_000


def loss(errors, records=1):
    """Return the loss with these errors (m, (N,)), of records of equal length."""
    return Loss(errors, np.arange(errors.size), np.repeat(np.arange(records), errors.size // records), records)


def white(seed, size=SAMPLES):
    return NOISE * np.random.default_rng(seed).standard_normal(size)


def slow(seed, seconds=300):
    """Return errors alike over many samples, as those of a wrong hysteresis are."""
    return NOISE * np.repeat(np.random.default_rng(seed).standard_normal(SAMPLES // seconds + 1), seconds)[:SAMPLES]


def line(size, samples=40.0):
    return size * np.sin(2 * np.pi * np.arange(SAMPLES) / samples)


@pytest.mark.parametrize(("size", "expected"), [(0.5 * LEAST, False), (2.0 * LEAST, True), (2.0, True)])
def test_what_is_there_beats_its_absence_from_a_tenth_of_the_noise_on(size, expected):
    errors = white(1)
    with_it, without = loss(errors), loss(errors + line(np.sqrt(2.0) * size * NOISE))
    assert beats(with_it, without, NOISE) is expected
    assert not beats(without, with_it, NOISE) and not beats(with_it, with_it, NOISE)


@pytest.mark.parametrize("errors", [white, slow])
def test_what_is_not_there_is_as_seldom_sure_as_chance_says(errors):
    # Both leave the same, and differ by something of its own.
    found = []
    for seed in range(200):
        first, second = errors(3 * seed), errors(3 * seed + 1)
        found.append(chance(loss(first + 0.3 * second), loss(first - 0.3 * second)))
    assert np.mean(np.array(found) <= 0.05) <= 0.1 and np.mean(np.array(found) <= CHANCE) <= 0.01


def test_many_trials_make_the_same_gain_less_sure():
    errors = white(2)
    with_it, without = loss(errors), loss(errors + line(0.02 * NOISE))
    alone, of_many = (chance(with_it, without, trials) for trials in (1.0, 30.0))
    assert alone < of_many <= 30.0 * alone


def test_what_acts_in_few_blocks_and_what_acts_a_little_in_all_are_both_sure():
    rare, errors = np.zeros(SAMPLES), white(3)
    for first in (2_000, 9_000, 17_000):
        rare[first : first + SAMPLES // BLOCKS] = 8.0 * NOISE
    assert chance(loss(errors), loss(errors + rare)) <= CHANCE
    # A share of errors of very different sizes.
    sizes = np.repeat(np.geomspace(1.0, 100.0, BLOCKS), SAMPLES // BLOCKS)
    assert chance(loss(errors * sizes), loss((errors + line(0.5 * NOISE)) * sizes)) <= CHANCE


@pytest.mark.parametrize(("factor", "expected"), [(0.99 * NO_WORSE, True), (1.01 * NO_WORSE, False)])
def test_what_is_worse_on_one_record_does_not_beat_however_much_it_gains_on_others(factor, expected):
    errors = white(4)
    half = SAMPLES // 2
    with_it = loss(errors, 2)
    without = loss(np.concatenate([errors[:half] / factor, errors[half:] + 30.0 * NOISE]), 2)
    assert carries_over(with_it, without) is expected and beats(with_it, without, NOISE) is expected
    # Of two different causes either may be the better one on some record.
    assert beats(with_it, without, NOISE, contained=False) and not beats(without, with_it, NOISE, contained=False)


def test_records_of_which_nothing_is_judged_decide_nothing():
    errors = white(5, 1000)
    of_one = Loss(errors, np.arange(1000), np.zeros(1000, dtype=np.int64), 2)
    assert np.isnan(of_one.records[1]) and carries_over(of_one, replace(of_one, errors=1.01 * errors))


def test_only_samples_that_both_judge_are_compared():
    errors = white(7)
    with_it, without = loss(errors), loss(errors + line(0.5 * NOISE))
    # The other one judges half of the samples alone.
    half = slice(SAMPLES // 2, None)
    part = Loss(without.errors[half], without.sample[half], without.record[half], 1)
    own, its = with_it.beside(part)
    np.testing.assert_array_equal(own, errors[half])
    np.testing.assert_array_equal(its, part.errors)
    assert beats(with_it, part, NOISE) and not beats(part, with_it, NOISE)


@pytest.mark.parametrize(("explained", "expected"), [(1.0, 1.0), (0.5, 0.75), (0.1, 0.19)])
def test_the_share_is_of_the_square_where_it_acts(explained, expected):
    errors, there = white(6), line(20.0 * NOISE)
    # Elsewhere something else is left, which is not its business.
    there[: SAMPLES // 2] = 0.0
    elsewhere = np.where(there == 0.0, 50.0 * NOISE, 0.0)
    with_it, without = (loss(errors + left * there + elsewhere) for left in (1.0 - explained, 1.0))
    assert share(with_it, without, NOISE) == pytest.approx(expected, abs=0.02)


def noise_blocks(count, seed):
    """Return sums of squares of blocks, and those of sets whose gains are noise, independent of each other."""
    rng = np.random.default_rng(seed)
    return np.full(40, 1.0), [1.0 + 0.05 * rng.standard_normal(40) for _ in range(count)]


@pytest.mark.parametrize("count", [1, 10, 100])
def test_the_number_of_trials_is_that_of_the_independent_sets(count):
    before, tried = noise_blocks(count, 1)
    assert independent_trials(before, tried) == pytest.approx(count, rel=0.5)
    # A copy is no trial of its own.
    assert independent_trials(before, 3 * tried) == pytest.approx(independent_trials(before, tried), rel=0.05)
    assert independent_trials(before, []) == 1.0
