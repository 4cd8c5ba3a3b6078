"""What is said of a record's quality: every injected fault is found, and none where there is none."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from identification.records import calibration, record_of, stage

from slpi_ros.errors import IdentificationError, RecordError, UsageError
from slpi_ros.excitation.drives import calibration_drive
from slpi_ros.identification.record_quality import Finding, assess, findings, missing_samples, require_usable
from slpi_ros.io.record import Record
from slpi_ros.io.tables import import_table
from slpi_ros.simulation.axis import SimulatedAxis
from slpi_ros.simulation.character import Character
from slpi_ros.simulation.parameters import AxisParameters

NOISE = 8e-9
seeds = pytest.mark.parametrize("seed", range(8))


def measured(seed, rate=200.0, duration=30.0):
    """Return time, voltage and displacement of a calibration drive without any fault."""
    t, v = calibration_drive(0.0, 100.0, duration=duration, rate=rate, seed=seed)
    return t, v, stage(seed).run(t, v)[1]


def quality(t, v, y):
    return assess(record_of(t, v, y), "x")


def warnings(t, v, y):
    return [finding.text for finding in findings(quality(t, v, y)) if finding.level != "ok"]


def moves(y, noise=6.0):
    """Say which samples lie so far from the one before that nobody could mistake them for it."""
    return np.abs(np.diff(y, prepend=y[0])) > noise * NOISE


# --- What is clean


@seeds
def test_a_clean_record_is_clean(seed):
    assert warnings(*measured(seed)) == []
    t, v, _ = measured(seed)
    y = SimulatedAxis(replace(AxisParameters.random(seed), quantisation=0.0, noise_rms=0.0), seed).run(t, v)[1]
    assert warnings(t, v, y) == []
    moving = Character(lag=5e-3, creep=0.02, creep_shortest=1e-3, resonance=40.0, damping=0.04)
    assert warnings(t, v, SimulatedAxis(AxisParameters.random(seed), seed, moving).run(t, v)[1]) == []


T = np.arange(8000) * 1e-3
DRIVES = {
    "sine": 50 - 50 * np.cos(2 * np.pi * T),
    "triangle": 100 * np.abs((0.7 * T + 1) % 2 - 1),
    "staircase": np.interp(np.floor(20 * T) / 20, [0, 2, 4, 6, 8], [0, 100, 10, 90, 20]),
    "digits": 0.0244 * np.round((50 - 50 * np.cos(2 * np.pi * T)) / 0.0244),
    "square": 50 + 45 * np.sign(np.sin(np.pi * T)) * (1 - T / 9),
    "holds": np.interp(T, [0, 1, 2, 3, 5, 6, 8], [0, 100, 100, 20, 20, 80, 80]),
}


@pytest.mark.parametrize("drive", DRIVES)
@pytest.mark.parametrize("seed", range(3))
def test_no_fault_is_seen_in_any_drive(drive, seed):
    found = quality(T, DRIVES[drive], stage(seed).run(T, DRIVES[drive])[1])
    assert (found.clock.lost, found.clock.gaps, found.clock.duplicates) == (0, 0, 0)
    for signal in (found.voltage, found.displacement):
        assert (signal.missing, signal.stuck, signal.stale, signal.spikes, signal.clipped) == (0, 0, 0, 0, 0)
    assert found.displacement.noise == pytest.approx(NOISE, rel=0.1)
    assert found.voltage.noise < 0.01


# --- Faults of the clock


@seeds
def test_missing_samples(seed):
    rng = np.random.default_rng([seed, 1])
    t, v, y = measured(seed)
    kept = rng.random(t.size) > 0.02
    kept[[0, -1]] = True
    found = quality(t[kept], v[kept], y[kept])
    assert found.clock.lost == np.count_nonzero(~kept)
    assert found.clock.unseen == found.clock.duplicates == 0
    assert found.displacement.spikes == found.displacement.stale == 0


def test_a_gap_within_which_the_voltage_may_have_turned():
    t, v, y = measured(0)
    kept = (t < 10) | (t > 10.6)
    clock = quality(t[kept], v[kept], y[kept]).clock
    assert (clock.gaps, clock.unseen, clock.lost) == (1, 1, np.count_nonzero(~kept))
    assert clock.longest_gap == pytest.approx(0.61, abs=0.011)
    assert any("may" in text or "unseen" in text for text in warnings(t[kept], v[kept], y[kept]))
    # A gap in a hold hides no turn.
    t, v = T, DRIVES["holds"]
    kept = (t < 3.2) | (t > 4.8)
    clock = quality(t[kept], v[kept], stage(0).run(t, v)[1][kept]).clock
    assert (clock.gaps, clock.unseen) == (1, 0)


@seeds
def test_jitter(seed):
    rng = np.random.default_rng([seed, 1])
    t, v = calibration_drive(0.0, 100.0, duration=30.0, rate=200.0, seed=seed)
    uneven = t + 0.2 * 0.005 * rng.uniform(-1, 1, t.size)
    uneven -= uneven.min()
    then = np.interp(uneven, t, v)
    for voltage in (v, then):  # late stamps; samples that were late themselves
        found = quality(uneven, voltage, stage(seed).run(t, voltage)[1])
        # Two uniform errors make a step.
        assert found.clock.jitter == pytest.approx(0.2 * 0.005 * np.sqrt(2 / 3), rel=0.05)
        assert found.displacement.noise == pytest.approx(NOISE, rel=0.12)
        assert (found.displacement.spikes, found.displacement.stale, found.clock.lost) == (0, 0, 0)


def test_duplicate_stamps():
    t, v, y = measured(1)
    again = np.arange(100, 2100, 100)
    t[again] = t[again - 1]
    assert quality(t, v, y).clock.duplicates == again.size


# --- Faults of the readings


@seeds
def test_lone_outliers(seed):
    rng = np.random.default_rng([seed, 1])
    t, v, y = measured(seed)
    hit = rng.random(t.size) < 0.05
    y[hit] += rng.choice([-10, 10], np.count_nonzero(hit)) * NOISE
    found = quality(t, v, y).displacement
    assert 0.6 * np.count_nonzero(hit) < found.spikes <= np.count_nonzero(hit)
    # By chance some are as readings before them; that makes them no stale ones.
    assert found.stale == 0
    assert found.noise < 1.35 * NOISE


@seeds
@pytest.mark.parametrize("again", [0.0, NOISE], ids=["same", "read_anew"])
def test_stale_samples(seed, again):
    rng = np.random.default_rng([seed, 1])
    t, v, y = measured(seed)
    hit = rng.random(t.size) < 0.01
    hit[0] = False
    hit &= ~np.roll(hit, 1)
    late = moves(y) & hit
    y = np.where(hit, np.roll(y, 1) + again * rng.standard_normal(t.size), y)
    found = quality(t, v, y).displacement
    assert 0.7 * np.count_nonzero(late) < found.stale <= np.count_nonzero(hit)
    assert found.spikes <= 0.1 * found.stale


@seeds
def test_stuck_and_clipped_sensor(seed):
    rng = np.random.default_rng([seed, 1])
    t, v, y = measured(seed)
    first = int(rng.integers(1000, 4000))
    stuck = y.copy()
    stuck[first : first + 100] = y[first]
    found = quality(t, v, stuck).displacement
    assert (found.stuck, found.longest_stuck, found.clipped) == (99, 100, 0)
    top = np.quantile(y, 0.93).round(9)
    found = quality(t, v, np.minimum(y, top)).displacement
    beyond = np.count_nonzero(y >= top)
    assert 0.9 * beyond < found.clipped == found.stuck < beyond


def test_a_sensor_slower_than_the_record():
    t, v, y = measured(2, rate=1000.0)
    slow = np.repeat(y[::5], 5)[: t.size]
    found = quality(t, v, slow).displacement
    assert found.held == pytest.approx(5.0, rel=0.01) and not found.stuck
    assert any("the sensor is slower than the record" in text for text in warnings(t, v, slow))


@seeds
def test_missing_readings(seed):
    rng = np.random.default_rng([seed, 1])
    t, v, y = measured(seed)
    y[rng.random(t.size) < 0.02] = np.nan
    v[rng.random(t.size) < 0.01] = np.nan
    found = quality(t, v, y)
    assert found.displacement.missing == np.count_nonzero(np.isnan(y))
    assert found.voltage.missing == np.count_nonzero(np.isnan(v))
    assert found.displacement.spikes == found.displacement.stale == found.displacement.stuck == 0


@seeds
def test_faults_of_the_voltage(seed):
    rng = np.random.default_rng([seed, 1])
    t, v, y = measured(seed)
    noisy = quality(t, v + 0.05 * rng.standard_normal(t.size), y)
    assert noisy.voltage.noise == pytest.approx(0.05, rel=0.1)
    assert noisy.drive.turns == quality(t, v, y).drive.turns
    assert noisy.displacement.spikes == noisy.voltage.spikes == 0
    spiked = v.copy()
    hit = rng.choice(np.arange(10, t.size - 10, 50), 10, replace=False)
    spiked[hit] += 5 * rng.choice([-1, 1], hit.size)
    found = quality(t, spiked, y)
    assert 8 <= found.voltage.spikes <= 10
    assert found.displacement.spikes == 0
    fast = int(np.argmax(np.abs(np.gradient(v))))
    held = v.copy()
    held[fast - 15 : fast + 15] = v[fast - 15]
    assert quality(t, held, y).voltage.stuck == 29


# --- Noise and digits


@pytest.mark.parametrize("bits", [8, 10, 12, 16])
def test_digits_of_a_sensor(bits):
    t, v, _ = measured(3)
    step = 25e-6 / 2**bits
    y = SimulatedAxis(replace(AxisParameters.random(3), quantisation=step), 3).run(t, v)[1]
    found = quality(t, v, y)
    assert found.displacement.digit == pytest.approx(step, rel=1e-6)
    assert found.displacement.stuck == found.displacement.stale == found.displacement.spikes == 0
    assert any("coarser than the noise" in text for text in warnings(t, v, y)) == (bits <= 10)


@settings(max_examples=25)
@given(st.floats(-3, 3), st.floats(-2, 2))
def test_units_do_not_matter(y_decades, t_decades):
    rng = np.random.default_rng(5)
    t, v, y = measured(5)
    y[rng.random(t.size) < 0.01] += 10 * NOISE
    y[2000:2050] = y[2000]
    one = quality(t, v, y).displacement
    # 1 ns, to which stamps are rounded, is nothing of the period.
    other = quality(t * 10**t_decades, v, y * 10**y_decades).displacement
    assert other.noise == pytest.approx(one.noise * 10**y_decades)
    assert (other.spikes, other.stale, other.stuck) == (one.spikes, one.stale, one.stuck)


# --- The drive


def test_memory():
    t, v, y = measured(4)
    assert quality(t, v, y).drive.begins_at_end
    middle = int(np.argmin(np.abs(v[2000:4000] - 50))) + 2000
    drive = quality(t[middle:] - t[middle], v[middle:], y[middle:]).drive
    assert not drive.begins_at_end
    rest = v[middle:]
    low, high = (np.flatnonzero(end)[0] for end in (rest <= rest.min() + 2, rest >= rest.max() - 2))
    assert drive.after_reset == pytest.approx(t[max(low, high)], abs=0.01)


# --- Words


def test_what_makes_a_fit_impossible_stops_it():
    t, v, y = measured(6)
    rng = np.random.default_rng(6)
    fast = np.sin(2.2 * np.arange(500))
    cases = {
        "too coarse for a loop": (t, v, 4e-6 * np.round(y / 4e-6)),
        "readings from turn to turn": (t, v, np.where(np.arange(t.size) % 60 == 0, y, np.nan)),
        "never turns back": (t, np.linspace(0, 100, t.size) + 0.01 * rng.standard_normal(t.size), t * 1e-7),
        "samples per second or more": (t[:500], 50 + 50 * fast, 1e-5 * fast),
    }
    for says, columns in cases.items():
        found = findings(quality(*columns))
        with pytest.raises(IdentificationError) as caught:
            require_usable(found, "bag, axis 'x'")
        assert says in str(caught.value)
        assert str(caught.value).startswith("bag, axis 'x': ")
        assert "\n" not in str(caught.value)
    require_usable([Finding("ok", "fine"), Finding("warn", "watch")], "bag")


def test_what_is_no_record_of_a_driven_axis():
    t, v, y = measured(6)
    with pytest.raises(UsageError, match="no axis 'w'"):
        assess(record_of(t, v, y), "w")
    with pytest.raises(RecordError, match=f"stamps go back by .* at message 2 of {t.size}"):
        quality(t[::-1], v, y)
    with pytest.raises(RecordError, match=f"all {t.size} messages have one stamp"):
        quality(np.zeros(t.size), v, y)
    with pytest.raises(RecordError, match="usable samples"):
        quality(t[:20], v[:20], y[:20])


def test_infinite_readings_are_not_told_as_missing():
    t, v, y = measured(6)
    y[[500, 600, 700]] = np.inf, -np.inf, np.nan
    told = [finding.text for finding in findings(quality(t, v, y))]
    assert any(line.startswith("displacement infinite for 2 of") for line in told)
    assert any(line.startswith("displacement missing (nan) for 1 of") for line in told)


def test_a_clock_that_was_set_back_is_told_where_messages_were_sorted():
    t, v, y = measured(6)
    back = np.where(np.arange(t.size) < t.size // 2, t, t - 0.4 * t[-1])
    order = np.argsort(back, kind="stable")
    with pytest.raises(IdentificationError, match="with the stamp of the one before: two recordings in one"):
        require_usable(findings(quality(np.round(back, 6)[order], v[order], y[order])), "bag")


def test_only_the_part_to_be_fitted_counts():
    t, v, y = measured(7)
    y[t < 10] = np.nan
    y[t > 20] = y[-1]
    v[t > 20] = np.nan
    record = record_of(t, v, y)
    assert assess(record, "x").displacement.missing == np.count_nonzero(t < 10)
    part = assess(record, "x", start=10.0, stop=20.0)
    assert (part.displacement.missing, part.voltage.missing, part.clock.samples) == (0, 0, 2000)
    assert part.drive.begins_at_end
    assert part.clock.duration == pytest.approx(9.995)


def test_notes_are_passed_on():
    record = replace(record_of(*measured(0)), notes=("time is that of recording",))
    assert findings(assess(record, "x"))[-1] == Finding("warn", "time is that of recording")


def test_findings_on_measured_records(measured_data):
    def of(name, axis="x"):
        return assess(import_table(measured_data / f"{name}.csv"), axis)

    missing = [of("afm_triangle_sine", axis).displacement.missing for axis in "xyz"]
    assert missing == [0, 37, 71]
    for axis in "xyz":
        assert 14e-9 < of("afm_triangle_sine", axis).displacement.noise < 22e-9
        triangle = of("afm_triangle_sine", axis).displacement
        assert triangle.stale + triangle.mixed > 20
    double = of("afm_double_sine_x")
    assert 30 < double.displacement.stale + double.displacement.mixed < 250
    assert double.drive.covered > 0.6 > of("afm_triangle_sine").drive.covered
    piezo = of("piezo_150v_1hz")
    assert piezo.displacement.noise == pytest.approx(0.047e-6, rel=0.1)
    assert piezo.drive.holds == pytest.approx([3.26], abs=0.1)
    assert len(piezo.drive.speeds) == 1
    assert piezo.drive.after_reset == pytest.approx(4.06, abs=0.05)
    assert not piezo.drive.begins_at_end
    for name in ("picma_1hz_major", "picma_1hz_decay_grow"):
        picma = of(name)
        assert picma.displacement.noise == pytest.approx(0.072e-6, rel=0.1)
        assert picma.displacement.digit == pytest.approx(1.933e-9, rel=1e-3)
        assert picma.displacement.spikes == picma.displacement.stale == 0


def test_samples_are_missing_for_all_axes_and_turns_for_the_one_that_moved():
    t, v, _ = measured(0)
    kept = (t < 10) | (t > 10.6)
    v = {"x": np.full(t.size, np.nan), "y": np.zeros(t.size), "z": v}
    time_ns = np.round(t * 1e9).astype(np.int64)
    parts = [Record(time_ns[at], *({axis: x[at] for axis, x in v.items()},) * 2, "") for at in (kept, t < 10)]
    assert [len(missing_samples(part)) for part in parts] == [2, 0]
    rests = replace(parts[0], voltage={axis: np.zeros(kept.sum()) for axis in v})
    assert [finding.level for finding in missing_samples(rests)] == ["warn"]


def test_late_stamps_are_no_missing_samples():
    """One stamp in five comes most of a period late; the next ones are in time again."""
    record, _ = calibration(seed=1)
    late = np.random.default_rng(3).random(len(record)) < 0.2
    stamps = record.time_ns + (late * 4_500_000).astype(np.int64)
    found = assess(replace(record, time_ns=stamps), "x").clock
    assert found.lost == 0
    kept = np.random.default_rng(4).random(len(record)) > 0.05
    kept[[0, -1]] = True
    part = replace(
        record,
        time_ns=stamps[kept],
        voltage={"x": record.voltage["x"][kept]},
        displacement={"x": record.displacement["x"][kept]},
    )
    assert assess(part, "x").clock.lost == pytest.approx(np.count_nonzero(~kept), rel=0.15)


def test_a_growing_sine_has_more_than_one_speed():
    t = np.arange(4000) / 200.0
    v = 50.0 - 45.0 * (t / t[-1]) * np.cos(2.0 * np.pi * t)
    found = assess(record_of(t, v, 2e-7 * v + 5e-9 * np.random.default_rng(1).standard_normal(t.size)), "x")
    slowest, fastest = found.drive.speed_range
    assert fastest > 150.0 and slowest < 30.0
    assert not any(finding.text.startswith("one speed") for finding in findings(found))
