"""Errors on blocks left out: cut by loop level, region and speed, beside classical PI and the floor."""

from dataclasses import replace

import numpy as np
import pytest
from identification.records import calibration, record_of, rms

import slpi_ros
from slpi_ros.errors import UsageError
from slpi_ros.hysteresis.prandtl_ishlinskii import PrandtlIshlinskii
from slpi_ros.hysteresis.turning_points import Memory
from slpi_ros.identification import cross_validation as truth
from slpi_ros.identification.cross_validation import cross_validate


@pytest.fixture(scope="module")
def recorded():
    return calibration(seed=1)[0]


@pytest.fixture(scope="module")
def found(recorded):
    return cross_validate(recorded, "x")


def test_every_cut_holds_every_sample_once(found):
    for cut in (found.by_level, found.by_region, found.by_speed):
        assert sum(part.samples for part in cut) == found.overall.samples == found.error.size
        energy = sum(part.samples * part.rms**2 for part in cut)
        assert energy == pytest.approx(found.overall.samples * found.overall.rms**2)
        assert max(part.maximum for part in cut) == found.overall.maximum


def test_it_is_what_the_identification_says(recorded, found):
    quality = slpi_ros.identify(recorded).axes["x"].quality
    assert found.overall.rms == pytest.approx(quality.held_out_rms, rel=1e-9)
    assert found.overall.rms < 1.2 * found.repeatability.rms
    classical = slpi_ros.identify(recorded, "pi").axes["x"].quality
    assert found.overall.classical_rms == pytest.approx(classical.held_out_rms, rel=0.02)


def test_the_cuts_mean_what_they_say(recorded, found):
    low, high = (float(bound) for bound in found.by_region[0].name.removesuffix(" V").split(" to "))
    chosen = (found.v >= low) & (found.v < high)
    assert found.by_region[0].rms == pytest.approx(rms(found.error[chosen]))
    speed = np.abs(np.gradient(recorded.voltage["x"], recorded.t))
    assert found.by_speed[0].name == "at rest"
    assert found.by_speed[0].samples == pytest.approx(np.count_nonzero(speed[recorded.t > 1.0] < 1.0), rel=0.2)
    assert len(found.by_speed) == 4
    assert [part.name for part in found.by_level[:2]] == ["outer loop", "loops of level 1"]


def test_a_wrong_region_shows_there(recorded):
    v, y = recorded.voltage["x"], recorded.displacement["x"].copy()
    # Not repeatable, and only up there.
    high = v > 80.0
    y[high] += np.random.default_rng(0).normal(0.0, 60e-9, np.count_nonzero(high))
    parts = cross_validate(record_of(recorded.t, v, y), "x").by_region
    assert parts[-1].rms > 5 * max(part.rms for part in parts[:-1])


def test_classical_is_as_good_on_a_classical_stage():
    shape = PrandtlIshlinskii(np.array([0.0, 10.0, 25.0]), np.array([1e-7, 4e-8, 3e-8]))
    t = np.arange(0, 20, 0.01)
    v = 50 - 50 * np.cos(2 * np.pi * t / 2) * np.interp(t, [0, 20], [1.0, 0.1])
    v[0] = 0.0
    y = Memory(shape).forward_array(v) + np.random.default_rng(0).normal(0.0, 8e-9, t.size)
    judged = cross_validate(record_of(t, v, y), "x")
    assert judged.overall.classical_rms < 1.1 * judged.overall.rms
    alone = cross_validate(record_of(t, v, y), "x", "pi")
    assert alone.overall.classical_rms == alone.overall.rms


def test_a_long_record_is_thinned(recorded, found, monkeypatch):
    monkeypatch.setattr(truth, "SAMPLES", 1000)
    thin = cross_validate(recorded, "x")
    assert 900 < thin.overall.samples < 1300
    assert thin.overall.rms == pytest.approx(found.overall.rms, rel=0.5)


def test_windows_gaps_and_several_records(recorded):
    v, y = recorded.voltage["x"].copy(), recorded.displacement["x"].copy()
    v[:7], v[500], y[900:950] = np.nan, np.nan, np.nan
    gappy = record_of(recorded.t, v, y)
    judged = cross_validate(gappy, "x", start=3.0, stop=18.0)
    assert judged.t.min() >= 3.0 and judged.t.max() < 18.0
    later = calibration(seed=1, duration=25.0)[0]
    both = cross_validate([gappy, later], "x")
    assert both.overall.samples > judged.overall.samples
    assert both.overall.rms < 1.5 * both.repeatability.rms


def test_the_table_says_it_all(found):
    lines = found.lines()
    assert len(lines) == 3 + len(found.by_level) + len(found.by_region) + len(found.by_speed)
    assert "classical PI" in lines[0] and f"{found.overall.rms * 1e9:.1f}" in lines[1]
    assert found.repeatability.source in lines[-1]
    unknown = replace(found.overall, classical_rms=float("nan"))
    assert replace(found, overall=unknown).lines()[1].endswith("-")


def test_what_cannot_be_judged_is_said(recorded):
    with pytest.raises(UsageError, match="no axis 'z'"):
        cross_validate(recorded, "z")
    with pytest.raises(UsageError, match="unknown kind"):
        cross_validate(recorded, "x", "nonsense")
