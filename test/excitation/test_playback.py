"""A drive sample by sample: whenever it is stopped, it is safe."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from slpi_ros.excitation.drives import DRIVES, Playback, excite


def drive_of(name="calibration", slew=(0.0, 400.0), start=(20.0, -10.0)):
    return excite(
        ("x", "y"),
        voltage_min=(0.0, -10.0),
        voltage_max=(100.0, 50.0),
        slew_limit=slew,
        start=start,
        duration=40.0,
        rate=50.0,
        drive=name,
    )


def given_by(playback):
    samples = []
    while not playback.done:
        samples.append(playback.next())
    return np.array(samples)


def test_all_samples_come_in_order_and_the_last_one_stays():
    drive = drive_of()
    playback = Playback(drive)
    assert playback.seconds_left == pytest.approx(40.0, abs=0.03)
    np.testing.assert_array_equal(given_by(playback), np.column_stack(list(drive.voltage.values())))
    assert playback.seconds_left == 0.0
    assert playback.next() == [20.0, -10.0] and playback.done


@settings(max_examples=60)
@given(
    st.sampled_from(DRIVES), st.integers(0, 2100), st.floats(150.0, 1000.0), st.floats(0.0, 1.0), st.floats(-0.1, 0.1)
)
def test_a_stop_at_any_time_leads_back_within_limits_and_slew(name, stop_after, slew, share, off):
    """From where the axes are, which may be another place than that of the last sample."""
    start = (100.0 * share, -10.0 + 60.0 * share)
    playback = Playback(drive_of(name, slew=(slew, slew), start=start))
    present = np.array([start, *(playback.next() for _ in range(stop_after))])[-1] + off
    playback.stop(present)
    assert playback.stopping
    assert playback.seconds_left <= max(100.0 / slew * np.pi / 2, 1.0 / 0.8) + 0.13
    v = given_by(playback)
    np.testing.assert_array_equal(v[0], np.clip(present, [0.0, -10.0], [100.0, 50.0]))
    assert np.all(v >= [0.0, -10.0]) and np.all(v <= [100.0, 50.0])
    assert np.max(np.abs(np.diff(v, axis=0))) * 50.0 <= slew * (1 + 1e-6)
    assert v[-1] == pytest.approx(start, abs=1e-9)


def test_without_a_slew_limit_the_way_back_is_gentle():
    playback = Playback(drive_of(slew=0.0))
    for _ in range(120):
        present = playback.next()
    playback.stop(present)
    back = given_by(playback)
    assert np.max(np.abs(np.diff(back[:, 0]))) * 50.0 < 130.0
    assert back[-1, 0] == pytest.approx(20.0)


def test_a_stop_before_the_first_sample_stays_where_it_is():
    playback = Playback(drive_of())
    playback.stop([20.0, -10.0])
    np.testing.assert_allclose(given_by(playback), [[20.0, -10.0]] * 4, atol=1e-9)


def test_a_repeated_drive_goes_on_until_stopped():
    drive = drive_of()
    playback = Playback(drive, repeat=True)
    count = drive.t.size
    samples = np.array([playback.next() for _ in range(2 * count + 100)])
    np.testing.assert_array_equal(samples[count : 2 * count], samples[:count])
    assert not playback.done
    playback.stop(samples[-1])
    assert given_by(playback)[-1] == pytest.approx([20.0, -10.0])
