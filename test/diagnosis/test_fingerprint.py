"""What is left goes with the variable that it was made of, and white noise with none."""

import numpy as np
import pytest

from slpi_ros.diagnosis.fingerprint import Signals, fingerprint, half_power

T = np.arange(20_000) / 1000.0
V = (
    50
    + 40 * np.sin(np.pi * T) * (0.5 + 0.5 * np.sin(0.44 * T + 1))
    + 10 * np.sin(20.7 * T) * (0.5 + 0.5 * np.tanh(T - 10))
)
RATE = np.gradient(V, T)
SIZE, NOISE = 30e-9, 8e-9


def record(residual: np.ndarray, seed: int) -> Signals:
    return Signals(T, V, 2e-7 * V, SIZE * residual + NOISE * np.random.default_rng(seed).standard_normal(T.size))


@pytest.mark.parametrize("seed", [0, 1])
@pytest.mark.parametrize(
    ("variables", "residual"),
    [
        (("time",), np.sin(T / 3.7)),
        # Nearly proportional to each other.
        (("voltage", "displacement"), 1.5 * (V / 50 - 1) ** 2),
        (("rate",), RATE / 100),
        (("acceleration",), np.gradient(RATE, T) / 3000),
        (("direction",), np.sign(RATE) * (1 - (V / 50 - 1) ** 2)),
        (("lines of the spectrum",), np.sin(2 * np.pi * 50 * T) + 0.5 * np.sin(2 * np.pi * 123.4 * T)),
        (("jumps",), 1.0 * (T > 7.123) - 1.3 * (T > 15.5)),
    ],
)
def test_the_variable_that_a_residual_depends_on_comes_first(variables, residual, seed):
    first = fingerprint([record(residual, seed), record(residual, seed + 10)])[0]
    power = SIZE**2 * np.var(residual)
    assert first.variable in variables
    # The functions of one variable are piecewise linear, so that they miss a part of sharp ones.
    assert 0.5 * power / (power + NOISE**2) < first.share <= 1.02 * power / (power + NOISE**2)


@pytest.mark.parametrize("seed", range(5))
def test_white_noise_goes_with_nothing(seed):
    assert fingerprint([record(np.zeros(T.size), seed)]) == ()


def test_a_share_is_of_data_that_were_held_out():
    """Drift in which each block has a level of its own cannot be predicted from the other blocks."""
    levels = np.repeat(np.random.default_rng(3).standard_normal(40), T.size // 40)
    assert all(one.variable != "time" or one.share < 0.5 for one in fingerprint([record(levels, 0)]))


def test_frequencies_and_amplitudes_of_lines_are_told():
    found = fingerprint([record(np.sin(2 * np.pi * 50.3 * T), 0)])
    assert "50.3 Hz (30" in found[0].evidence or "50.3 Hz (29" in found[0].evidence


@pytest.mark.parametrize(("hertz", "told"), [(30.0, False), (33.7, True)])
def test_a_harmonic_of_the_drive_is_no_line_of_its_own(hertz, told):
    v = 50 + 40 * np.sin(2 * np.pi * 10.0 * T)
    noise = NOISE * np.random.default_rng(0).standard_normal(T.size)
    found = fingerprint([Signals(T, v, 2e-7 * v, SIZE * np.sin(2 * np.pi * hertz * T) + noise)])
    assert ("lines of the spectrum" in {one.variable for one in found}) is told


def test_a_few_periods_are_a_drift_and_no_line():
    slow = np.sin(2 * np.pi * 4.3 / T[-1] * T) + 0.3 * np.random.default_rng(1).standard_normal(T.size)
    assert {"time"} <= {one.variable for one in fingerprint([record(slow, 0)])} - {"lines of the spectrum"}
    assert "lines of the spectrum" not in {one.variable for one in fingerprint([record(slow, 0)])}


def test_half_of_the_power_is_below_a_frequency():
    slow = Signals(T, V, V, np.sin(2 * np.pi * 3.0 * T) + 0.9 * np.sin(2 * np.pi * 40.0 * T))
    assert half_power([slow]) == pytest.approx(3.0, abs=0.2)
    fast = slow._replace(residual=np.sin(2 * np.pi * 40.0 * T))
    assert half_power([slow, fast]) == pytest.approx(40.0, abs=0.2)
    assert half_power([]) == half_power([slow._replace(residual=0.0 * T)]) == 0.0


def test_short_and_still_records_have_a_fingerprint_too():
    still = Signals(T[:10], np.full(10, 5.0), np.zeros(10), np.arange(10) * 1e-9)
    assert all(0.0 <= one.share <= 1.0 for one in fingerprint([still]))
