"""What records say before anything is fitted to them."""

from types import SimpleNamespace

import numpy as np
import pytest

from slpi_ros.diagnosis.prepare import Evidence, Part, excited_frequency
from slpi_ros.diagnosis.search import seen
from slpi_ros.effects.hum import Hum, Line
from slpi_ros.identification.bases import SurfaceBasis

T = np.arange(20_000) / 1000


def evidence(*voltages):
    """Return what records with these voltages, shape (N,), say of a straight stage."""
    used = np.ones(T.size, dtype=bool)
    parts = [Part(f"record {k}", T, v, 1e-7 * v, used, used, used, (), {}, 0.0) for k, v in enumerate(voltages)]
    return Evidence(tuple(parts), SurfaceBasis(np.linspace(0, 100, 11)), 0.1)


def sine(frequency):
    return 50 + 40 * np.sin(2 * np.pi * frequency * T)


@pytest.mark.parametrize("frequency", [0.5, 7.0, 90.0])
def test_a_sine_excites_its_own_frequency(frequency):
    assert excited_frequency(evidence(sine(frequency))) == pytest.approx(frequency, rel=0.1, abs=0.15)


@pytest.mark.parametrize(("frequency", "expected"), [(2.5, True), (12.5, True), (3.1, False), (50.0, False)])
def test_only_low_multiples_of_the_drive_may_be_hysteresis(frequency, expected):
    triangle = np.abs((1.25 * T) % 1.0 - 0.5) * 100
    whole = SimpleNamespace(records=())
    signals = dict.fromkeys(("u", "h", "y", "used", "residual", "respond"), 0)
    view = seen(SimpleNamespace(evidence=evidence(triangle), t=T, effects=(), around=whole, **signals))
    assert Hum((Line(frequency, 1e-9, 0.0),)).plausible(view) is not expected


def test_the_fastest_record_counts():
    assert excited_frequency(evidence(sine(20.0), sine(2.0))) == pytest.approx(20.0, rel=0.1)


def test_steps_excite_what_they_reach():
    steps = 50 + 40 * np.sign(np.sin(2 * np.pi * 0.5 * T))
    assert excited_frequency(evidence(steps)) > 300.0
