"""The calibration drive: it wipes the memory, visits everything, and is enough to identify a stage by."""

import numpy as np
import pytest
from excitation.loops import fastest, holds, turning_points, visited_cells
from hypothesis import given, settings
from hypothesis import strategies as st

import slpi_ros
from benchmarks.paths import scan_path
from slpi_ros.errors import UsageError
from slpi_ros.excitation.drives import calibration_drive, excite
from slpi_ros.identification.bases import SurfaceBasis
from slpi_ros.identification.design_matrix import Walk
from slpi_ros.simulation.axis import SimulatedAxis
from slpi_ros.simulation.parameters import AxisParameters

CASES = [(30.0, 100.0, 0), (60.0, 200.0, 1), (80.0, 100.0, 7), (10.0, 200.0, 0)]


def drive(**given):
    """Return t and v of a drive of one axis."""
    made = excite(**({"voltage_min": 0.0, "voltage_max": 100.0} | given))
    return made.t, made.voltage["x"]


@pytest.mark.parametrize(("duration", "rate", "seed"), CASES)
def test_the_drive_uses_its_range_and_comes_home(duration, rate, seed):
    t, v = calibration_drive(-5.0, 95.0, duration=duration, rate=rate, seed=seed)
    assert t.shape == v.shape == (round(duration * rate) + 1,)
    assert t[0] == 0 and t[-1] == pytest.approx(duration)
    assert v[0] == v[-1] == v.min() == -5.0
    assert v.max() == 95.0


@settings(max_examples=30)
@given(st.floats(55.0, 500.0), st.integers(0, 1000), st.sampled_from([100.0, 250.0]))
def test_limits_and_slew_are_kept(slew, seed, rate):
    t, v = drive(voltage_min=-20.0, voltage_max=80.0, slew_limit=slew, seed=seed, rate=rate)
    assert v.min() == -20.0 and v.max() == 80.0
    assert fastest(t, v) <= slew * (1 + 1e-9)


@pytest.mark.parametrize(("duration", "rate", "seed"), CASES[:3])
def test_without_a_slew_limit_it_is_gentle_all_the_same(duration, rate, seed):
    t, v = calibration_drive(0.0, 100.0, duration=duration, rate=rate, seed=seed)
    assert fastest(t, v) < 270.0


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("slew", [0.0, 60.0])
def test_full_loops_come_first(seed, slew):
    t, v = drive(seed=seed, slew_limit=slew)
    turns = turning_points(v)
    np.testing.assert_array_equal(turns[:3], [100.0, 0.0, 100.0])
    # The second fall follows the rising reversal curves, each of which returns to the top.
    before_second_fall = turns[: int(np.flatnonzero(turns == 0.0)[1])]
    assert np.all(before_second_fall[2::2] == 100.0)


@pytest.mark.parametrize("seed", range(4))
def test_the_memory_is_wiped_whatever_went_before(seed):
    t, v = drive(seed=seed, rate=100.0)
    history = np.random.default_rng(seed).uniform(0.0, 100.0, 40)
    one, other = SimulatedAxis(), SimulatedAxis()
    other.run(np.arange(40.0), history)
    y, again = one.run(t, v)[0], other.run(t, v)[0]
    wiped = int(np.flatnonzero(v == 100.0)[0])
    assert np.max(np.abs(y - again)[:wiped]) > 1e-7
    np.testing.assert_allclose(y[wiped:], again[wiped:], atol=1e-12)


@pytest.mark.parametrize("seed", range(4))
def test_turning_points_are_spread_over_the_range(seed):
    turns = turning_points(drive(duration=60.0, seed=seed)[1])
    inner = np.sort(turns[(turns > 0.0) & (turns < 100.0)])
    assert inner.size >= 20
    assert np.max(np.diff([0.0, *inner, 100.0])) < 15.0
    # In random order: what drifts must not look like what depends on voltage.
    second_fall = int(np.flatnonzero(turns == 0.0)[1])
    minima = turns[3:second_fall:2].tolist()
    assert len(minima) >= 6
    assert minima != sorted(minima) and minima != sorted(minima, reverse=True)


@pytest.mark.parametrize("seed", range(4))
def test_it_moves_at_several_speeds_and_holds(seed):
    t, v = drive(seed=seed)
    steps = np.abs(np.diff(v)) * 200.0
    through_the_middle = steps[(v[:-1] > 40.0) & (v[:-1] < 60.0) & (steps > 0)]
    low, high = np.percentile(through_the_middle, (5, 95))
    assert high > 2.5 * low
    # Creep shows from half a second on.
    rests = holds(v, least=100)
    assert len(rests) == 5
    assert {voltage for _, voltage in rests} >= {0.0, 100.0} and any(5 < voltage < 95 for _, voltage in rests)
    assert v[100] == v[-100] == 0.0


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize(("duration", "share"), [(30.0, 0.75), (60.0, 0.85)])
def test_the_surface_of_the_loop_family_is_covered(seed, duration, share):
    v = drive(duration=duration, seed=seed)[1]
    basis = SurfaceBasis(np.linspace(0.0, 100.0, 21))
    assert basis.covered(basis.branch_part(Walk.along(v, symmetric_rest=False, primed=False))) >= share
    assert visited_cells(v) >= share


def test_a_major_loop_alone_covers_little():
    v = 50 - 50 * np.cos(np.linspace(0, 8 * np.pi, 4001))
    basis = SurfaceBasis(np.linspace(0.0, 100.0, 21))
    assert basis.covered(basis.branch_part(Walk.along(v, symmetric_rest=False, primed=False))) < 0.4
    assert visited_cells(v) < 0.5


def test_more_time_means_more_loops_and_not_slower_ones():
    counts = [turning_points(drive(duration=duration)[1]).size for duration in (30.0, 60.0, 120.0, 240.0)]
    assert counts[0] >= 25
    assert all(1.6 < later / earlier < 2.4 for earlier, later in zip(counts, counts[1:], strict=False))


def test_the_longest_drives_are_drawn_too():
    t, v = drive(duration=7200.0, rate=10.0)
    assert t.size == 72001 and turning_points(v).size < 1000


def test_the_same_seed_gives_the_same_drive():
    one, same, other = (drive(seed=seed)[1] for seed in (1, 1, 2))
    np.testing.assert_array_equal(one, same)
    assert np.max(np.abs(one - other)) > 1.0


@pytest.mark.parametrize("seed", [3, 7])
def test_thirty_seconds_are_enough(seed):
    def stage():
        return SimulatedAxis(AxisParameters.random(seed), seed)

    t, v = drive(seed=seed)
    true, measured = stage().run(t, v)
    record = slpi_ros.Record(np.round(t * 1e9).astype(np.int64), {"x": v}, {"x": measured})
    model = slpi_ros.identify(record)
    remanent = true[-1]
    margin = 0.02 * (true.max() - remanent)
    low, high = remanent + margin, true.max() - margin
    path_t, desired = scan_path(low, high, duration=20.0, seed=1000 + seed)
    error = np.abs(stage().run(path_t, model.compensate(path_t, desired, "start"))[0] - desired) / (high - low)
    assert error.mean() < 0.0003 and error.max() < 0.003


@pytest.mark.parametrize(
    ("given", "says"),
    [
        ({"voltage_min": 100.0, "voltage_max": 0.0}, r"100\.0 V.*0\.0 V"),
        ({"duration": 0.0}, r"\b0\.0 s"),
        ({"rate": 2.0}, r"2 Hz.*30 s"),
        ({"slew_limit": 10.0}, r"200 Hz.*10 V/s.*30 s"),
        ({"seed": -1}, "-1"),
    ],
)
def test_drives_that_cannot_be_drawn(given, says):
    with pytest.raises(UsageError, match=says):
        drive(**given)
