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
    mode, residue, rng = Mode.of(HERTZ, DAMPING, DT), 0.3 - 0.2j, np.random.default_rng(3)
    answers = ModeAnswers((mode,), np.array([residue]), np.array([0j]))
    commanded = rng.normal(size=(3, SIZE))
    impulse = np.real(residue * mode.step ** np.arange(3 * SIZE))
    expected = np.convolve(commanded.ravel(), impulse)[: 3 * SIZE].reshape(3, SIZE)
    for found, one in zip(answers.answers(list(commanded), 0), expected, strict=True):
        assert found[:, :2] @ [residue.real, residue.imag] == pytest.approx(np.fft.rfft(one), rel=1e-9)
    # What rings from before changes by the pole from one pass to the next.
    first, second = (np.fft.irfft(answers.ringing(SIZE, number)[:, 0], SIZE) for number in (0, 1))
    assert first == pytest.approx(np.real(mode.step ** np.arange(SIZE)))
    assert second == pytest.approx(np.real(mode.step ** (SIZE + np.arange(SIZE))))


def test_candidates_leave_out_what_is_known():
    known = Mode.of(HERTZ, DAMPING, DT)
    angles = np.array([one.angle for one in candidates(SIZE, [known])])
    assert angles.size > 20
    assert np.abs(angles / known.angle - 1.0).min() > 0.1
