"""A record longer than a window is examined in parts, with the result of one piece; its columns may be in a file."""

from dataclasses import replace

import numpy as np
import pytest
from identification.records import calibration, record_of, rms

import slpi_ros
from slpi_ros.errors import RecordError
from slpi_ros.identification import record_quality, samples
from slpi_ros.identification.samples import select_thinned, windows
from slpi_ros.io import record as records
from slpi_ros.io.record import each_block, first_step_back, new_column, release

LENGTH = 16_000


@pytest.fixture(scope="module")
def record():
    """Return a record with outliers, missing readings and missing voltages."""
    whole, _ = calibration(3, duration=LENGTH / 200)
    y, v = whole.displacement["x"].copy(), whole.voltage["x"].copy()
    y[1000::1500] += 2e-6
    y[700:760] = np.nan
    v[5000:5003] = np.nan
    return replace(whole, voltage={"x": v}, displacement={"x": y})


@pytest.fixture
def small_windows(monkeypatch):
    for module in (samples, record_quality):
        monkeypatch.setattr(module, "WINDOW", 4000)


def test_windows_cover_the_record_once(record, small_windows):
    found = list(windows(record.voltage["x"], 100, LENGTH))
    assert len(found) > 2
    assert found[0][0] == 100 and found[-1][1] == LENGTH
    assert all(end == begin for (_, end), (begin, _) in zip(found, found[1:], strict=False))


def test_a_window_without_motion_is_extended(small_windows):
    v = np.concatenate([np.linspace(0.0, 100.0, 4000), np.full(9000, 100.0), np.linspace(100.0, 0.0, 3000)])
    assert list(windows(v, 0, v.size)) == [(0, 4000), (4000, 16_000)]


@pytest.mark.parametrize("part", [(None, None), (20.0, 60.0)])
def test_the_samples_are_those_of_one_piece(record, monkeypatch, part):
    one, at_one = select_thinned(record, "x", *part, 10**6)
    for module in (samples, record_quality):
        monkeypatch.setattr(module, "WINDOW", 4000)
    several, at = select_thinned(record, "x", *part, 10**6)
    np.testing.assert_array_equal(at, at_one)
    np.testing.assert_allclose(several.v, one.v, rtol=0, atol=1e-9)
    # Noise and resolution are estimated for each window.
    assert np.count_nonzero(several.fitted != one.fitted) <= 3
    np.testing.assert_array_equal(several.y[several.fitted & one.fitted], one.y[several.fitted & one.fitted])


def test_the_model_and_the_quality_are_those_of_one_piece(record, monkeypatch):
    t = record.t[np.isfinite(record.voltage["x"])]
    v = record.voltage["x"][np.isfinite(record.voltage["x"])]
    one, quality = slpi_ros.identify(record), slpi_ros.assess(record, "x")
    for module in (samples, record_quality):
        monkeypatch.setattr(module, "WINDOW", 4000)
    several, in_parts = slpi_ros.identify(record), slpi_ros.assess(record, "x")
    y = one.simulate(t, {"x": v})["x"]
    assert rms(several.simulate(t, {"x": v})["x"] - y) < 1e-4 * np.ptp(y)
    assert several.axes["x"].end.voltage == one.axes["x"].end.voltage
    assert in_parts.clock.samples == quality.clock.samples
    assert in_parts.clock.duration == pytest.approx(quality.clock.duration)
    assert in_parts.drive.turns == quality.drive.turns
    assert in_parts.displacement.missing == pytest.approx(quality.displacement.missing, abs=4)
    assert in_parts.displacement.spikes == pytest.approx(quality.displacement.spikes, abs=3)
    assert in_parts.displacement.noise == pytest.approx(quality.displacement.noise, rel=0.1)


def test_a_record_without_readings_in_a_window(record, small_windows):
    y = record.displacement["x"].copy()
    y[5000:12_000] = np.nan
    found, at = select_thinned(replace(record, displacement={"x": y}), "x", None, None, 10**6)
    assert not found.fitted[(at >= 5000) & (at < 12_000)].any()
    assert found.fitted[(at < 4500)].mean() > 0.9
    with pytest.raises(RecordError):
        select_thinned(replace(record, displacement={"x": np.full(LENGTH, np.nan)}), "x", None, None, 10**6)


def test_unordered_stamps_are_found_in_any_block(monkeypatch):
    monkeypatch.setattr(records, "BLOCK", 10)
    times = np.arange(35)
    assert first_step_back(times) is None
    for at in range(1, 35):
        unordered = times.copy()
        unordered[at] = -1
        assert first_step_back(unordered) == at
    with pytest.raises(RecordError):
        select_thinned(record_of([0.0, 2.0, 1.0], [0.0, 1.0, 0.0], [0.0, 1.0, 0.0]), "x", None, None, 10)


def test_a_column_in_a_file_keeps_its_values(monkeypatch):
    monkeypatch.setattr(records, "MAPPED_FROM", 0)
    column = new_column(5000, np.dtype(np.float64))
    assert type(column) is np.ndarray and column.base is not None
    column[:] = np.arange(5000)
    release(column, column[10:20], np.arange(3.0))
    np.testing.assert_array_equal(column, np.arange(5000))
    monkeypatch.setattr(records, "BLOCK", 999)
    parts = [part[: 999 if part.size > 999 else None] for (part,) in each_block(column)]
    np.testing.assert_array_equal(np.concatenate(parts), column)


def test_changes_of_a_private_mapping_are_kept(tmp_path):
    np.save(tmp_path / "column.npy", np.zeros(5000))
    column = np.load(tmp_path / "column.npy", mmap_mode="c")
    column[:] = 3.0
    release(column)
    assert (column == 3.0).all()
