"""The answer to a change of a path, from passes that follow one another while a light mode rings through several."""

import numpy as np
import pytest
from scipy.signal import lfilter

from slpi_ros.learning.dynamics import Dynamics, Measured, Pass
from slpi_ros.learning.modes import Mode, ModeAnswers, candidates

SIZE, DT, HERTZ, DAMPING = 100, 1.0 / 4000.0, 335.0, 0.01
W = 2 * np.pi * np.fft.rfftfreq(SIZE)


def guess(frequency):
    return np.ones(frequency.size, complex), (0.05 + (frequency / 150.0) ** 2).clip(max=4.0) ** 2


def gain_of(mode, w):
    """Return the gain of a mode with a static gain of 1 at frequencies (rad/sample)."""
    pole = mode.step
    total, product = 2 * pole.real, abs(pole) ** 2
    z = np.exp(-1j * w)
    return (1 - total + product) * z / (1 - total * z + product * z**2)


def passes(mode, count, noise, seed=0):
    """Return passes with corrections that change at random, and the spectrum of the path."""
    rng, total, product = np.random.default_rng(seed), 2 * mode.step.real, abs(mode.step) ** 2
    desired = 1e-6 * np.abs(np.linspace(-1.0, 1.0, SIZE, endpoint=False))
    smooth = np.hanning(9) / np.hanning(9).sum()
    commanded = [np.zeros(SIZE), np.zeros(SIZE)]
    for _ in range(count - 2):
        change = np.convolve(np.tile(rng.normal(0.0, 2e-8, SIZE), 3), smooth, "same")[SIZE : 2 * SIZE]
        commanded.append(commanded[-1] + change - change.mean())
    whole = np.concatenate([desired + one for one in commanded]) - desired[0]
    answered = lfilter([0.0, 1 - total + product], [1.0, -total, product], whole).reshape(count, SIZE) + desired[0]
    read = answered + rng.normal(0.0, noise, answered.shape)
    return [Pass(u, y - y.mean()) for u, y in zip(commanded, read, strict=True)], np.fft.rfft(desired)


@pytest.mark.parametrize("told", [(), (1.003,)])
def test_a_mode_is_found_or_refined_and_its_transient_is_told(told):
    mode, noise = Mode.of(HERTZ, DAMPING, DT), 2e-10
    history, desired = passes(mode, 6, noise)
    begun = [Mode.of(HERTZ * ratio, 1.3 * DAMPING, DT) for ratio in told]
    dynamics = Dynamics(SIZE, DT, True, guess, begun)
    power = np.full(W.size, SIZE * noise**2)
    for count in range(2, 7):
        so_far = history[:count]
        found = dynamics.answer(
            Measured(
                so_far, so_far[-1].commanded, history[1], desired, 1e-4 * np.abs(desired) ** 2, power,
                lambda change: 1e-4 * np.abs(change) ** 2,
            )
        )  # fmt: skip
    nearest = min(dynamics.modes, key=lambda one: abs(one.angle - mode.angle))
    assert nearest.angle == pytest.approx(mode.angle, rel=2e-3)
    true = gain_of(mode, W)
    known = (W > 0) & (1.2 * mode.angle > W)
    assert np.abs(found.gain - true)[known].max() < 0.1 * np.abs(true).max()
    settled = np.fft.rfft(history[-1].reading) - true * (desired + np.fft.rfft(history[-1].commanded))
    assert np.linalg.norm((found.transient - settled)[1:]) < 0.2 * np.linalg.norm(settled[1:])


def test_columns_of_a_mode_are_its_answers():
    mode = Mode.of(HERTZ, DAMPING, DT)
    answers = ModeAnswers((mode,), np.array([0.3 - 0.2j]), np.array([0j]))
    tone = np.cos(2 * np.pi * 8 * np.arange(SIZE) / SIZE)
    after = answers.answers([np.zeros(SIZE), tone, tone, tone], 0)
    for passed in range(3):
        expected = after[1 + passed][:, :2] @ np.array([0.3, -0.2])
        # A harmonic of 1 is half a cosine, over the samples.
        found = answers.to_tone(0, SIZE, 8, passed, settled=True)[:, 0] * (SIZE / 2)
        assert np.abs(found - expected).max() < 1e-9 * np.abs(expected).max()
    assert not answers.to_tone(0, SIZE, 8, -1, settled=True).any()


def test_candidates_leave_out_what_is_known():
    known = Mode.of(HERTZ, DAMPING, DT)
    angles = np.array([one.angle for one in candidates(SIZE, [known])])
    assert angles.size > 20
    assert np.abs(angles / known.angle - 1.0).min() > 0.1
