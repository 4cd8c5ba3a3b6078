"""Drives for one effect: each shows what its sentence promises."""

import json
from itertools import pairwise

import numpy as np
import pytest
from excitation.loops import fastest, holds, turning_points

from slpi_ros.effects.registry import EFFECTS
from slpi_ros.errors import UsageError
from slpi_ros.excitation.drives import CALIBRATION, DRIVES, SWEEP, excite
from slpi_ros.excitation.effects import for_effect, separating
from slpi_ros.simulation.dynamics import FlexureMode, Relaxation

RATE = 200.0


def drive(effect, **given):
    """Return t and v of the first axis, and all voltages."""
    axes = ("x", "y") if effect == "cross_coupling" else ("x",)
    made = excite(axes, **({"voltage_min": 0.0, "voltage_max": 100.0, "drive": effect} | given))
    return made.t, made.voltage["x"], made.voltage


def lagged(t, v, time_constant):
    """Return what a first-order lag makes of a voltage."""
    lag = Relaxation(np.array([time_constant]))
    return np.array([lag.step(dt, x)[0] for dt, x in zip(np.diff(t, prepend=t[0]), v, strict=True)])


def lag_not_explained_by_delay(t, v, time_constant=0.02):
    """Return the share of a lag's effect that the best delay leaves."""
    effect = lagged(t, v, time_constant) - v
    left = []
    for seconds in np.linspace(0.2, 2.0, 19) * time_constant:
        delay = np.interp(t - seconds, t, v) - v
        left.append(np.linalg.norm(effect - delay * (effect @ delay) / (delay @ delay)))
    return min(left) / np.linalg.norm(effect)


def bursts(v):
    """Return (span, steps) of every move of a record, without holds."""
    ends = [0, *(np.flatnonzero(np.diff(np.sign(np.diff(v)))) + 1), len(v) - 1]
    return [(abs(v[b] - v[a]), b - a) for a, b in pairwise(ends) if abs(v[b] - v[a]) > 1e-9]


def test_there_is_a_drive_for_every_effect():
    assert set(DRIVES) == set(EFFECTS) | {CALIBRATION, SWEEP}
    for name in EFFECTS:
        effect = for_effect(name)
        assert effect.why.endswith(".") and effect.why.count(". ") == 0 and len(effect.why) > 80
        json.dumps(effect.why)
    with pytest.raises(UsageError, match="friction"):
        for_effect("friction")


@pytest.mark.parametrize(
    ("names", "drive"),
    [
        (("delay", "lag"), "lag"),
        (("delay", "rate_dependence", "lag", "creep"), "lag"),
        (("delay", "rate_dependence"), "rate_dependence"),
        (("creep", "thermal_drift", "gain_drift"), "gain_drift"),
        (("gain_drift", "self_heating"), "self_heating"),
        (("creep", "thermal_drift", "lag"), "thermal_drift"),
        (("rate_dependence", "creep"), "creep"),
        (("delay", "resonance"), "resonance"),
        (("hum", "sensor_periodic"), "hum"),
    ],
)
def test_the_drive_that_separates_ambiguous_effects(names, drive):
    assert separating(names) == drive


def test_a_sweep_visits_both_ends_once():
    made = excite(voltage_min=-20.0, voltage_max=80.0, drive=SWEEP, duration=10.0, start=10.0, slew_limit=60.0)
    v = made.voltage["x"]
    assert turning_points(v).tolist() == [-20.0, 80.0, -20.0]
    assert v[0] == v[-1] == 10.0 and fastest(made.t, v) <= 60.0 * (1 + 1e-9)


def test_calibration_begins_with_a_sweep():
    v = excite(voltage_min=0.0, voltage_max=100.0).voltage["x"]
    assert turning_points(v)[:2].tolist() == [100.0, 0.0]


@pytest.mark.parametrize(("duration", "slew"), [(15.0, 0.0), (30.0, 0.0), (30.0, 150.0), (120.0, 0.0), (120.0, 70.0)])
@pytest.mark.parametrize("effect", DRIVES)
def test_each_keeps_to_its_limits_and_wipes_the_memory_first(effect, duration, slew):
    made = excite(("x", "y"), voltage_min=-20.0, voltage_max=80.0, drive=effect, duration=2 * duration, slew_limit=slew)
    for v in made.voltage.values():
        assert v.shape == made.t.shape and made.t[-1] == pytest.approx(2 * duration)
        assert v[0] == v[-1] == v.min() == -20.0 and v.max() == 80.0
        assert not slew or fastest(made.t, v) <= slew * (1 + 1e-9)
        assert turning_points(v)[0] == 80.0


@pytest.mark.parametrize("effect", sorted(set(EFFECTS) - {"resonance"}))
def test_no_move_but_a_small_step_is_abrupt(effect):
    t, v, _ = drive(effect)
    assert fastest(t, v) < 600.0


@pytest.mark.parametrize("effect", ["delay", "lag"])
def test_delay_and_lag_are_told_apart(effect):
    t, v, _ = drive(effect)
    assert lag_not_explained_by_delay(t, v) > 3 * lag_not_explained_by_delay(*drive(CALIBRATION)[:2])
    moves = bursts(v)[3:-1]
    assert {round(span, 6) for span, _ in moves} == {round(moves[0][0], 6)}
    assert max(steps for _, steps in moves) > 8 * min(steps for _, steps in moves)
    corners = np.abs(np.diff(v, 2))[len(v) // 4 : -len(v) // 20]
    middle = np.median(corners)
    # Straight lines with corners, against waves without.
    assert (middle < 1e-9) == (effect == "delay")


def test_saturation_comes_up_to_both_limits_at_two_speeds():
    moves, (_, v, _) = bursts(drive("saturation")[1]), drive("saturation")
    peaks = [voltage for _, voltage in holds(v, least=20)]
    assert [v for v in peaks if v > 50] == pytest.approx([80, 80, 90, 90, 95, 95, 100, 100])
    assert [v for v in peaks if 0 < v < 50] == pytest.approx([20, 20, 10, 10, 5, 5])
    to_the_limits = [steps for span, steps in moves[2:] if span == pytest.approx(90) or span > 94]
    assert max(to_the_limits) > 2.5 * min(to_the_limits)


def test_slew_ramps_ever_faster_with_a_hold_after_each():
    _, v, _ = drive("slew")
    moves = bursts(v)[2:]
    assert len(moves) == 8 and {span for span, _ in moves} == {100.0}
    assert moves[0][1] > 5 * moves[-1][1] and np.all(np.diff([steps for _, steps in moves]) < 0)
    assert len(holds(v, least=20)) >= 8


def test_rate_dependence_has_loops_of_other_size_at_the_same_speed():
    moves = [(round(span), steps) for span, steps in bursts(drive("rate_dependence")[1])[2:]]
    by_span = {span: [steps for s, steps in moves if s == span] for span in (60, 30, 15)}
    for steps in by_span.values():
        assert max(steps) > 3.5 * min(steps)
    speeds = {span: [span / s for s in steps] for span, steps in by_span.items()}
    assert min(abs(a / b - 1) for a in speeds[60] for b in speeds[15]) < 0.1


def test_contact_has_loops_of_one_size_at_five_levels():
    _, v, _ = drive("contact")
    small = [span for span, _ in bursts(v) if span == pytest.approx(20.0)]
    assert len(small) >= 5 * 3
    ends = turning_points(v)
    assert {0.0, 20.0, 40.0, 60.0, 80.0, 100.0} <= {round(float(end), 6) for end in ends}


def test_creep_has_ever_longer_holds_after_moves_up_and_down():
    _, v, _ = drive("creep")
    rests = holds(v, least=100)[1:]
    assert sum(steps for steps, _ in rests) > 0.7 * v.size
    lengths, levels = zip(*rests, strict=True)
    assert len(rests) == 5 and all(later > 0.95 * earlier for earlier, later in pairwise(lengths))
    assert lengths[-1] > 6 * lengths[0]
    assert {np.sign(step) for step in np.diff(levels)} == {-1.0, 1.0}
    between = [steps for span, steps in bursts(v)[2:-1]]
    assert len(between) >= 5 and np.median(between) < 100


@pytest.mark.parametrize("frequency", [5.0, 11.0, 27.0])
def test_resonance_rings_after_small_steps(frequency):
    def ringing(v, where):
        mode = FlexureMode(frequency, 0.03)
        return float(np.std(np.array([mode.step(1.0 / RATE, x) for x in v - v[0]])[where] - (v - v[0])[where]))

    for effect, rings in (("resonance", True), ("hum", False)):
        _, v, _ = drive(effect)
        still = np.concatenate([np.diff(v) == 0, [False]])
        still[: v.size // 5] = still[-v.size // 10 :] = False
        assert (ringing(v, still) > 0.5) == rings
    _, v, _ = drive("resonance")
    jumps = np.abs(np.diff(v))[v.size // 5 : v.size // 2]
    assert jumps.max() == pytest.approx(10.0) and np.count_nonzero(jumps > 9.0) >= 12


def test_resonance_sweeps_to_a_sixth_of_the_rate():
    _, v, _ = drive("resonance")
    moves = [steps for span, steps in bursts(v)[-200:] if span == pytest.approx(5.0)]
    assert moves[-1] <= 4 and moves[0] >= 20
    assert all(later <= earlier + 1 for earlier, later in pairwise(moves))


@pytest.mark.parametrize("effect", DRIVES)
def test_one_axis_moves_at_a_time(effect):
    made = excite(("x", "y", "z"), voltage_min=0.0, voltage_max=100.0, drive=effect, duration=90.0)
    moving = np.array([np.diff(v) != 0 for v in made.voltage.values()])
    assert moving.sum(axis=0).max() == 1
    assert all(each.any() for each in moving)


def test_cross_coupling_takes_two_axes():
    with pytest.raises(UsageError):
        excite(("x",), voltage_min=0.0, voltage_max=100.0, drive="cross_coupling")


def test_thermal_drift_repeats_itself():
    _, v, _ = drive("thermal_drift")
    tops = [voltage for steps, voltage in holds(v, least=20) if voltage == 100.0]
    assert len(tops) == 8
    ups = np.flatnonzero((v[:-1] < 50.0) & (v[1:] >= 50.0))[1:]
    assert np.ptp(np.diff(ups)) <= 2
    period = int(np.diff(ups)[0])
    cycles = [v[up - period // 4 : up + period // 2] for up in ups[1:-1]]
    assert max(np.max(np.abs(cycle - cycles[0])) for cycle in cycles) < 3.0


def test_gain_drift_repeats_full_loops_without_a_rest():
    _, v, _ = drive("gain_drift", duration=120.0)
    moves = bursts(v)[2:]
    assert len(moves) >= 60 and {round(span) for span, _ in moves} == {100}
    lengths = [steps for _, steps in moves]
    assert max(lengths) - min(lengths) <= 2
    rest = np.diff(v[v.size // 5 : -v.size // 20]) == 0
    assert np.count_nonzero(rest) <= len(moves)


def test_self_heating_has_bursts_of_fast_loops_with_rests_and_slow_loops_between():
    t, v, _ = drive("self_heating", duration=120.0)
    rate, seconds = np.abs(np.diff(v)) * RATE, np.arange(120)
    fast = np.array([float(np.sqrt(np.mean(rate[(t[:-1] >= s) & (t[:-1] < s + 1)] ** 2))) for s in seconds])[20:-5]
    assert np.count_nonzero(np.diff(fast > 100.0)) >= 5
    assert 0.2 < np.mean(fast > 100.0) < 0.4 and np.mean(fast < 30.0) > 0.4
    tops = [voltage for steps, voltage in holds(v, least=1000) if voltage == 100.0]
    assert len(tops) == 3
    assert sum(span == pytest.approx(100.0) and steps > 500 for span, steps in bursts(v)) >= 10


def test_sensor_periodic_is_slow_and_steady_at_two_speeds():
    _, v, _ = drive("sensor_periodic")
    ramps = [(span, steps) for span, steps in bursts(v) if span == 100.0][2:]
    assert len(ramps) == 4
    assert ramps[2][1] == pytest.approx(2 * ramps[0][1], rel=0.02)
    assert np.max(np.abs(np.diff(v, 2))[v.size // 4 : -v.size // 20]) < 0.3
    # At least 10 samples a period of 316 nm on a stage of 22 µm.
    assert min(steps for _, steps in ramps) > 10 * 22 / 0.316


def test_steps_are_looked_for_at_rest():
    _, v, _ = drive("steps")
    rests = holds(v, least=400)
    assert len({round(voltage) for _, voltage in rests}) == 7 and sum(steps for steps, _ in rests) > 0.6 * v.size


def test_hum_is_mostly_rest_at_three_levels():
    _, v, _ = drive("hum")
    rests = [(steps, voltage) for steps, voltage in holds(v, least=1000)]
    assert [voltage for _, voltage in rests] == pytest.approx([10.0, 50.0, 90.0])
    assert sum(steps for steps, _ in rests) > 0.75 * v.size
