"""Identification: what it finds, what it stands, and what it refuses."""

from dataclasses import replace

import numpy as np
import pytest
from identification.records import calibration, record_of, rms, stage

import slpi_ros
from benchmarks.paths import scan_path
from slpi_ros.errors import IdentificationError, RecordError, UsageError
from slpi_ros.excitation.drives import calibration_drive
from slpi_ros.hysteresis.kinds import DESCRIPTIONS
from slpi_ros.hysteresis.prandtl_ishlinskii import PrandtlIshlinskii
from slpi_ros.hysteresis.turning_points import Memory
from slpi_ros.identification.fit import KINDS


@pytest.fixture(scope="module")
def recorded():
    return calibration(seed=1)


@pytest.fixture(scope="module")
def model(recorded):
    return slpi_ros.identify(recorded[0])


def unseen_error(model, seed):
    """Follow an unseen path on the seed's stage; return errors in shares of the stroke."""
    low, high = 4e-6, 0.95 * model.axes["x"].displacement_range[1]
    t, desired = scan_path(low, high, duration=20.0, rate=200.0, seed=77)
    achieved, _ = stage(seed).run(t, model.compensate(t, desired, "start"))
    return np.abs(achieved - desired) / (high - low)


def test_the_residual_is_the_sensor_noise(recorded, model):
    record, true = recorded
    simulated = model.simulate(record.t, record.voltage["x"])
    assert rms(simulated - true) < 6e-9
    quality = model.axes["x"].quality
    assert 7e-9 < quality.rms < 9e-9
    assert 7e-9 < quality.floor_rms < 9e-9
    assert 0.5 < quality.covered <= 1.0


@pytest.mark.parametrize("seed", [1, 2])
def test_unseen_paths_are_followed(seed):
    record, _ = calibration(seed, duration=30.0)
    error = unseen_error(slpi_ros.identify(record), seed)
    assert error.mean() < 0.0005 and error.max() < 0.003
    classical = unseen_error(slpi_ros.identify(record, "pi"), seed)
    assert classical.mean() > 25 * error.mean()


@pytest.mark.parametrize("seed", [1, 3])
def test_a_little_beyond_the_record_the_model_goes_on_as_it_did(seed):
    """A model that knew nothing but the mean gain out there would be 3 % to 5 % of the stroke off."""
    driven = stage(seed)
    t, v = calibration_drive(10.0, 90.0, duration=30.0, rate=200.0, seed=seed)
    true, measured = driven.run(t, v)
    model = slpi_ros.identify(record_of(t, v, measured))
    later, beyond = calibration_drive(6.0, 94.0, duration=20.0, rate=200.0, seed=seed + 100)
    true = np.concatenate([true, driven.run(t[-1] + 0.005 + later, beyond)[0]])
    both = np.concatenate([v, beyond])
    error = (model.simulate(np.arange(both.size) / 200.0, both) - true)[v.size :]
    assert np.max(np.abs(error - error.mean())) < 0.022 * np.ptp(true)


def test_a_classical_stage_is_identified_by_both_kinds():
    truth = PrandtlIshlinskii(np.array([0.0, 10.0, 25.0]), np.array([1e-7, 4e-8, 3e-8]))
    t = np.arange(0, 20, 0.01)
    v = 50 - 50 * np.cos(2 * np.pi * t / 2) * np.interp(t, [0, 20], [1.0, 0.1])
    v[0] = 0.0
    y = Memory(truth).forward_array(v)
    for kind in ("pi", "slpi"):
        found = slpi_ros.identify(record_of(t, v, y), kind)
        assert rms(found.simulate(t, v) - y) < 5e-4 * np.ptp(y), kind


def test_identification_is_deterministic(recorded, model):
    again = slpi_ros.identify(recorded[0])
    np.testing.assert_array_equal(again.axes["x"].hysteresis.everett, model.axes["x"].hysteresis.everett)


def test_outliers_stale_samples_and_dropouts_do_little_harm(recorded, model):
    record, _ = recorded
    rng = np.random.default_rng(0)
    y = record.displacement["x"].copy()
    spikes = rng.random(y.size) < 0.05
    y[spikes] += rng.normal(0, 80e-9, spikes.sum())
    stale = np.flatnonzero(rng.random(y.size) < 0.01)
    y[stale] = y[np.maximum(stale - 1, 0)]
    y[rng.random(y.size) < 0.02] = np.nan
    spoiled = slpi_ros.identify(record_of(record.t, record.voltage["x"], y))
    assert unseen_error(spoiled, 1).mean() < 2.0 * unseen_error(model, 1).mean() + 5e-5


def test_a_record_that_starts_in_mid_loop_is_understood(recorded):
    record, _ = recorded
    late = record.t > 1.7
    assert not record.voltage["x"][late][0] < 5.0
    cut = record_of(record.t[late], record.voltage["x"][late], record.displacement["x"][late])
    found = slpi_ros.identify(cut)
    after_reset = cut.t > 6.0
    error = found.simulate(cut.t, cut.voltage["x"]) - cut.displacement["x"]
    assert rms(error[after_reset]) < 12e-9


def test_voltage_before_the_start_still_moves_the_memory(recorded):
    record, true = recorded
    found = slpi_ros.identify(record, start=5.0)
    error = found.simulate(record.t, record.voltage["x"]) - true
    assert rms(error[record.t >= 5.0]) < 8e-9


def test_several_axes_and_a_choice_of_them(recorded):
    record, _ = recorded
    both = slpi_ros.Record(
        record.time_ns,
        {"x": record.voltage["x"], "y": record.voltage["x"]},
        {"x": record.displacement["x"], "y": 2 * record.displacement["x"]},
    )
    assert list(slpi_ros.identify(both, "pi").axes) == ["x", "y"]
    assert list(slpi_ros.identify(both, "pi", axes=["y"]).axes) == ["y"]
    with pytest.raises(UsageError, match="no axis 'z'"):
        slpi_ros.identify(both, "pi", axes=["z"])


def spoil(record, **changes):
    parts = {"t": record.t.copy(), "v": record.voltage["x"].copy(), "y": record.displacement["x"].copy()}
    for key, change in changes.items():
        parts[key] = change(parts[key])
    return record_of(parts["t"], parts["v"], parts["y"])


BAD = {
    "voltage without variation": ({"v": lambda v: np.full_like(v, 20.0)}, "voltage stays at 20 V"),
    "displacement without variation": ({"y": lambda y: np.full_like(y, 1e-6)}, "displacement stays at 1e-06 m"),
    "no displacement": ({"y": lambda y: np.full_like(y, np.nan)}, "0 usable samples"),
    "infinite": ({"v": lambda v: np.full_like(v, np.inf)}, "0 usable samples"),
    "time backwards": (
        {"t": lambda t: np.concatenate([t[:100], t[50:-50]])},
        "stamps go back by 0.245 s at message 101",
    ),
    "one sample": ({key: lambda x: x[:1] for key in "tvy"}, "1 usable samples"),
    "nothing": ({key: lambda x: x[:0] for key in "tvy"}, "0 usable samples"),
}


@pytest.mark.parametrize("case", BAD)
def test_what_cannot_be_fitted_is_said(recorded, case):
    changes, message = BAD[case]
    with pytest.raises(RecordError, match=message):
        slpi_ros.identify(spoil(recorded[0], **changes))


def test_single_bad_samples_are_left_out(recorded):
    def spoil_some(values):
        values[[100, 1500, 3000]] = np.nan, np.inf, -np.inf
        return values

    found = slpi_ros.identify(spoil(recorded[0], y=spoil_some, v=lambda v: spoil_some(v[::-1])[::-1]), "pi")
    assert found.axes["x"].quality.samples == len(recorded[0]) - 6


def test_unknown_kind_and_empty_window(recorded):
    with pytest.raises(UsageError, match="unknown kind 'nonsense'"):
        slpi_ros.identify(recorded[0], "nonsense")
    with pytest.raises(RecordError, match="usable samples"):
        slpi_ros.identify(recorded[0], start=1000.0)


def test_axes_of_different_length_are_refused():
    with pytest.raises(RecordError, match="voltage of axis 'x' has"):
        slpi_ros.Record(np.arange(5), {"x": np.zeros(4)}, {"x": np.zeros(5)})
    with pytest.raises(RecordError, match="each axis needs both"):
        slpi_ros.Record(np.arange(5), {"x": np.zeros(5)}, {"y": np.zeros(5)})


def test_a_wrong_sign_and_noise_are_told(recorded):
    record, _ = recorded
    with pytest.raises(RecordError, match="displacement falls where voltage rises"):
        slpi_ros.identify(spoil(record, y=lambda y: -y))
    noise = np.random.default_rng(1).normal(0, 1e-6, len(record)) + 1e-9 * record.voltage["x"]
    with pytest.raises(IdentificationError, match="does not explain"):
        slpi_ros.identify(spoil(record, y=lambda y: noise))


def test_a_mere_ramp_is_told():
    t = np.linspace(0, 10, 500)
    with pytest.raises(IdentificationError, match="never turns back"):
        slpi_ros.identify(record_of(t, 10 * t, 2e-6 * t))


@pytest.mark.parametrize(("key", "factor", "what"), [("v", 1e6, "voltage of"), ("y", 1e6, "displacement of")])
def test_wrong_units_are_told(recorded, key, factor, what):
    with pytest.raises(RecordError, match=f"{what}.*check the unit"):
        slpi_ros.identify(spoil(recorded[0], **{key: lambda signal: signal * factor}))


def test_the_window_must_be_in_order(recorded):
    with pytest.raises(UsageError, match="not before stop"):
        slpi_ros.identify(recorded[0], start=3.0, stop=2.0)


def test_outliers_do_not_count_in_the_held_out_error(recorded):
    record, _ = recorded
    clean = slpi_ros.identify(record, "slpi").axes["x"].quality
    y = record.displacement["x"].copy()
    spikes = np.random.default_rng(2).random(y.size) < 0.02
    y[spikes] += 1e-6
    quality = slpi_ros.identify(record_of(record.t, record.voltage["x"], y), "slpi").axes["x"].quality
    assert quality.held_out_rms == pytest.approx(clean.held_out_rms, rel=0.2)


def test_every_kind_of_model_can_be_identified():
    assert tuple(DESCRIPTIONS) == KINDS


def later_record(seed, offset):
    """Loops that the calibration of the same stage does not hold, with another zero of the sensor."""
    other = stage(seed)
    t = 0.005 * np.arange(4000)
    v = 50.0 - 50.0 * np.cos(2 * np.pi * 0.11 * t) * (0.6 + 0.4 * np.cos(2 * np.pi * 0.013 * t))
    return record_of(t, v, other.run(t, v)[1] + offset)


def test_several_records_share_one_model(recorded):
    first, second = recorded[0], later_record(1, 3e-7)
    joint = slpi_ros.identify([first, second]).axes["x"]
    alone = slpi_ros.identify(first).axes["x"]
    assert joint.quality.samples == len(first) + len(second)
    assert joint.start.voltage == alone.start.voltage
    assert joint.start.displacement == pytest.approx(alone.start.displacement, abs=2e-8)
    # It is still the model of the first record, to the noise.
    error = joint.simulate(first.t, first.voltage["x"]) - first.displacement["x"]
    assert rms(error) < 1.2 * alone.quality.rms
    assert joint.quality.held_out_rms < 2 * joint.quality.floor_rms


def test_one_record_in_a_list_is_that_record(recorded, model):
    again = slpi_ros.identify([recorded[0]]).axes["x"]
    np.testing.assert_array_equal(again.hysteresis.everett, model.axes["x"].hysteresis.everett)


def test_records_that_do_not_belong_together(recorded):
    record = recorded[0]
    with pytest.raises(UsageError, match="no record given"):
        slpi_ros.identify([])
    with pytest.raises(UsageError, match="several stages: 'a'.*'b'"):
        slpi_ros.identify([replace(record, hardware_id="a"), replace(record, hardware_id="b")])
    with pytest.raises(UsageError, match="axis 'x'"):
        slpi_ros.identify([record, record_of(record.t, record.voltage["x"], record.displacement["x"], axis="z")])
    with pytest.raises(UsageError, match="fitted to one"):
        slpi_ros.identify([record, record], "slpi-published")


@pytest.mark.parametrize("kind", KINDS)
def test_no_kind_is_fitted_to_a_mere_rise(kind):
    t = 0.01 * np.arange(400)
    for v in (25.0 * t, np.where(t < 1, 0.0, 50.0)):
        with pytest.raises(IdentificationError, match="never turns back"):
            slpi_ros.identify(record_of(t, v, 2e-7 * v), kind)


def test_no_rate_is_told_where_most_stamps_are_equal(recorded):
    record, _ = recorded
    coarse = replace(record, time_ns=record.time_ns // 10**8 * 10**8)
    assert slpi_ros.identify(coarse, kind="pi").axes["x"].quality.fastest is None
    assert slpi_ros.identify(record, kind="pi").axes["x"].quality.fastest > 0.0
