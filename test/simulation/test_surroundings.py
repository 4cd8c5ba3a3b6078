import numpy as np
import pytest

from benchmarks.hidden.physics import Temperature
from slpi_ros.simulation.surroundings import Hum, Interferometer

T = np.linspace(0, 60, 6001)


@pytest.mark.parametrize("form", ["ramp", "settling", "sine", "wandering"])
def test_a_drift_starts_at_0_reaches_its_amplitude_and_is_slow(form):
    for amplitude in (3e-7, -3e-7):
        path = Temperature(amplitude, form, time=80.0, phase=0.3, seed=4).path(T)
        assert path[0] == 0 and np.max(np.abs(path)) == pytest.approx(3e-7)
        assert np.max(np.abs(np.diff(path))) < 3e-7 * 0.01


def test_a_drift_goes_its_way():
    np.testing.assert_allclose(Temperature(1e-6).path(T), 1e-6 * T / 60, atol=1e-18)
    settling = Temperature(1e-6, "settling", time=20.0).path(T)
    np.testing.assert_allclose(settling, 1e-6 * np.expm1(-T / 20) / np.expm1(-3), atol=1e-18)
    sine = Temperature(1e-6, "sine", time=40.0).path(T)
    assert sine[1000] == pytest.approx(1e-6) and sine[3000] == pytest.approx(-1e-6)


def test_wandering_depends_on_its_seed_alone():
    one, same, other = (Temperature(1e-6, "wandering", seed=seed).path(T) for seed in (1, 1, 2))
    np.testing.assert_array_equal(one, same)
    assert np.max(np.abs(one - other)) > 1e-7
    # a coarser clock sees the same walk
    np.testing.assert_allclose(Temperature(1e-6, "wandering", seed=1).path(T[::10]), one[::10], rtol=0.01, atol=1e-9)


def test_hum_is_a_line_in_the_spectrum():
    t = np.arange(4000) / 1000
    path = Hum(50.0, 2e-8, 0.7).path(t)
    spectrum = np.fft.rfft(path) / t.size * 2
    assert abs(spectrum[200]) == pytest.approx(2e-8) and np.sum(np.abs(spectrum) > 1e-12) == 1
    assert path[0] == pytest.approx(2e-8 * np.sin(0.7))


@pytest.mark.parametrize("form", ["offsets", "sine"])
def test_an_interferometer_errs_once_a_fringe(form):
    sensor = Interferometer(316e-9, 5e-9, 0.7, form)
    y = np.arange(3160) * 1e-9
    error = sensor.read(y) - y
    harmonics = np.fft.rfft(error) / y.size * 2
    assert abs(harmonics[10]) == pytest.approx(5e-9, rel=1e-6)
    assert np.angle(harmonics[10]) + np.pi / 2 == pytest.approx(0.7, abs=1e-6)
    # a pointer off centre by a share s of its length has a second harmonic of s / 2
    expected = 5e-9 * (2 * np.pi / 316e-9 * 5e-9) / 2 if form == "offsets" else 0.0
    assert abs(harmonics[20]) == pytest.approx(expected, rel=1e-6, abs=1e-18)


def test_offsets_are_those_of_two_signals_in_quadrature():
    sensor = Interferometer(316e-9, 5e-9, 0.7, "offsets")
    y = np.linspace(0, 2e-6, 5000)
    wave = 2 * np.pi / 316e-9
    share = wave * 5e-9
    cosine = np.cos(wave * y) - share * np.cos(0.7)
    sine = np.sin(wave * y) + share * np.sin(0.7)
    turns = (sensor.read(y) - np.arctan2(sine, cosine) / wave) / 316e-9
    np.testing.assert_allclose(turns, np.round(turns), atol=1e-9)
