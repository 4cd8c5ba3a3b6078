"""What a voltage does: turns, speeds, holds and the pairs of voltages it visits."""

import numpy as np
import pytest

from slpi_ros.identification.drive import Runs, covered, holds

T = np.arange(8000) * 1e-3
HOLDS = np.interp(T, [0, 1, 2, 3, 5, 6, 8], [0, 100, 100, 20, 20, 80, 80])


def test_speeds_and_holds():
    turns = np.array([0.0, 80.0] * 6 + [0.0])
    for rates, expected in (((20.0,), 1), ((20.0, 60.0, 180.0), 3)):
        seconds = np.cumsum(np.concatenate([[0.0], 80.0 / np.repeat(rates, 12 // len(rates))]))
        t = np.arange(0, seconds[-1], 0.002)
        v = np.interp(t, seconds, turns)
        found = Runs.of(t, v, 0.5).speeds
        assert found == pytest.approx(rates, rel=0.05)
        assert len(found) == expected
        assert holds(t, v, 0.01).size == 0
    assert holds(T, HOLDS, 0.01) == pytest.approx([1.0, 2.0, 2.0], abs=0.02)
    noisy = HOLDS + 0.05 * np.random.default_rng(0).standard_normal(T.size)
    assert holds(T, noisy, 0.45) == pytest.approx([1.0, 2.0, 2.0], abs=0.05)


def test_a_sawtooth_does_not_show_two_speeds():
    def drive(*rates):
        v = np.tile([0.0, 80.0], len(rates) // 2 + 1)[: len(rates) + 1]
        t = np.concatenate([[0.0], np.cumsum(80.0 / np.array(rates))])
        at = np.arange(0.0, t[-1], 0.002)
        return Runs.of(at, np.interp(at, t, v), 0.5)

    sawtooth = drive(*[20.0, 200.0] * 6)
    assert len(sawtooth.speeds) == 1
    assert sawtooth.speed_range(1) == pytest.approx((20.0, 20.0), rel=0.05)
    assert sawtooth.speed_range(-1) == pytest.approx((200.0, 200.0), rel=0.05)
    # As rises of two speeds, and one period of each of two speeds, do.
    assert drive(*[20.0, 200.0, 60.0, 200.0] * 3).speeds == pytest.approx((20.0, 60.0), rel=0.05)
    assert drive(20.0, 20.0, 60.0, 60.0).speeds == pytest.approx((20.0, 60.0), rel=0.05)


def test_covered_pairs():
    sine = 50 - 50 * np.cos(2 * np.pi * T)
    # Turns at the lowest and the highest of ten cells, and from each all others.
    assert covered(sine, Runs.of(T, sine, 0.5)) == pytest.approx(0.2)
    levels = np.arange(5.0, 100.0, 10.0)
    turns = np.concatenate(
        [[0.0, 100.0], *([[level, 100.0] for level in levels]), *([[level, 0.0] for level in levels])]
    )
    seconds = np.concatenate([[0.0], np.cumsum(np.abs(np.diff(turns)))])
    t = np.arange(0.0, seconds[-1], 0.5)
    v = np.interp(t, seconds, turns)
    assert covered(v, Runs.of(t, v, 0.5)) == 1.0
