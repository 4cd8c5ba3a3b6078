"""Axes along trajectories: as planned while nothing comes in between, and as good as possible when something does."""

from dataclasses import replace
from unittest import mock

import numpy as np
import pytest
from strategies import FAMILY_CASE, axis_model

from slpi_ros.compensator.axis import Axis
from slpi_ros.compensator.feedback import LoopSettings, PidGains
from slpi_ros.compensator.trajectory import Following, Trajectory, prepare
from slpi_ros.errors import SlpiError
from slpi_ros.model.streaming import Limits

MS = 1_000_000
START = 10**18
MODEL = replace(axis_model(FAMILY_CASE), displacement_range=(2e-6, 14e-6))
ALONE = LoopSettings(False, PidGains(0.0), 0.1)
PATH = 8e-6 - 5e-6 * np.cos(np.linspace(0.0, 9.0, 300)) * np.linspace(0.3, 1.0, 300)


def axes(**limits):
    made = {name: Axis(name, i, Limits(0.0, 100.0, **limits), ALONE) for i, name in enumerate("xy")}
    for axis in made.values():
        axis.use(MODEL, axis.prepare(MODEL))
    return made


def follow(following, made, until_ns, step_ns=MS):
    """Return the voltages after each point, shape (M, axes)."""
    given = []
    for now in range(START, until_ns, step_ns):
        if following.step(now) is not None:
            given.append([axis.voltage for axis in made.values()])
    return np.array(given)


def trajectory(names="x", path=PATH, start_ns=0):
    rows = np.column_stack([path] * len(names))
    return Trajectory.of(list(names), np.arange(len(rows)) * MS, rows, start_ns, axes=["x", "y"])


@pytest.mark.parametrize("limits", [{}, {"slew": 2000.0}, {"slew": 3000.0, "acceleration": 2e5}])
def test_as_planned_is_as_sample_by_sample(limits):
    made, twin = axes(**limits), axes(**limits)["x"]
    following = Following(made)
    following.start(trajectory("xy"), lambda: START, START - 1000 * MS)
    given = follow(following, made, START + 400 * MS)
    assert len(given) == 300 and not following.on
    expected = [twin.move(0.1 if i == 0 else 1e-3, y) for i, y in enumerate(PATH.tolist())]
    np.testing.assert_allclose(given, np.column_stack([expected] * 2), rtol=0, atol=1e-7)


def test_a_model_limits_or_lateness_in_between_make_the_rest_sample_by_sample():
    other = replace(MODEL, quality=replace(MODEL.quality, rms=1e-9))

    def swap(axis):
        axis.use(other, axis.prepare(other))

    changes = {
        "model": swap,
        "limits": lambda axis: axis.use_limits(Limits(0.0, 100.0, 700.0)),
        "voltage": lambda axis: axis.use_limits(Limits(0.0, max(axis.voltage, 60.0))),
    }
    for name, change in changes.items():
        made, twin = axes(), axes()["x"]
        following = Following(made)
        following.start(trajectory(), lambda: START, START - 1000 * MS)
        given = [follow(following, made, START + 150 * MS)]
        change(made["x"])
        given.append(follow(following, made, START + 400 * MS))
        expected = []
        for i, y in enumerate(PATH.tolist()):
            if i == 150:
                change(twin)
            expected.append(twin.move(1e-3, y))
        np.testing.assert_allclose(np.vstack(given)[:, 0], expected, rtol=0, atol=1e-7, err_msg=name)


CURVES = MODEL.hysteresis
STEEP = replace(MODEL, hysteresis=replace(CURVES, everett=1.2 * CURVES.everett, rise=1.2 * CURVES.rise))


def swapped(axis):
    axis.use(STEEP, axis.prepare(STEEP))


def limited(axis):
    axis.use_limits(Limits(0.0, 100.0, 1500.0))


def shaken(axis):
    """Leave the voltage, but not the memory."""
    there = axis.voltage
    for v in (80.0, 10.0, there):
        axis.stream.drive(v)


IN_BETWEEN = {"model": swapped, "limits": limited, "memory": shaken, "desired": lambda axis: axis.move(1e-3, 6e-6)}


def kept_to(given, axis):
    """Check the voltages: those of live wishes from where the axis was, each as soon as the slew limit allows."""
    for (ahead, y), v in given:
        assert v == pytest.approx(axis.move(ahead, y), abs=1e-7)


@pytest.mark.parametrize("what", IN_BETWEEN)
def test_a_plan_that_waits_for_its_time_is_worth_nothing_once_something_has_changed(what):
    made, twin = axes(slew=2000.0), axes(slew=2000.0)["x"]
    following = Following(made)
    following.start(trajectory(start_ns=START + 100 * MS), lambda: START, START - 1000 * MS)
    assert follow(following, made, START + 50 * MS).size == 0
    for axis in (made["x"], twin):
        IN_BETWEEN[what](axis)
    given = follow(following, made, START + 500 * MS)[:, 0]
    assert len(given) == 300
    kept_to(zip([(0.1, PATH[0]), *((1e-3, y) for y in PATH[1:].tolist())], given, strict=True), twin)


@pytest.mark.parametrize("accepted", [20, 80])
@pytest.mark.parametrize("what", ["model", "limits", "late"])
def test_nor_one_that_reckoned_with_a_path_that_became_another(what, accepted):
    """Whether it was accepted before or after: what was planned for the path before it is no longer given."""
    made, twin = axes(slew=2000.0), axes(slew=2000.0)["x"]
    following = Following(made)
    begin = START + 150 * MS
    following.start(trajectory(), lambda: START, START - 1000 * MS)
    given = []
    for k in range(300):
        now = START + k * MS
        if k == accepted:
            following.start(trajectory(start_ns=begin, path=PATH[150:]), lambda at=now: at, START)
        if k == 50 and what != "late":
            for axis in (made["x"], twin):
                IN_BETWEEN[what](axis)
        if what == "late" and 46 <= k < 55:
            continue
        assert following.step(now) is not None
        ahead = 0.1 if k == 0 else 10e-3 if what == "late" and k == 55 else 1e-3
        given.append(made["x"].voltage)
        assert given[-1] == pytest.approx(twin.move(ahead, float(PATH[k])), abs=1e-7), k
    assert not following.on


@pytest.mark.parametrize("limits", [{}, {"slew": 2000.0}, {"slew": 3000.0, "acceleration": 2e5}])
def test_what_comes_after_a_path_that_was_kept_to_is_given_as_planned(limits):
    made = axes(**limits)
    following, plans = Following(made), []
    with mock.patch("slpi_ros.compensator.trajectory.prepare", lambda *a: plans.append(prepare(*a)) or plans[-1]):
        following.start(trajectory("xy"), lambda: START, START - 1000 * MS)
        follow(following, made, START + 50 * MS)
        following.start(trajectory("x", PATH[::-1], START + 150 * MS), lambda: START + 50 * MS, START)
    with mock.patch.object(Axis, "move", None):
        given = follow(following, made, START + 500 * MS)[:, 0]
    expected = [*plans[0].voltages[50:150, 0], *plans[1].voltages[:, 0]]
    np.testing.assert_allclose(given, expected, rtol=0, atol=1e-9)


def test_points_that_are_late_are_skipped_and_the_memory_knows_what_was_given():
    made, twin = axes(), axes()["x"]
    following = Following(made)
    following.start(trajectory(), lambda: START, START)
    given = follow(following, made, START + 310 * MS, 7 * MS)[:, 0]
    assert following.skipped == 300 - len(given) > 200
    given_points = list(range(0, 300, 7)) + ([299] if 299 % 7 else [])
    expected = [twin.move(1e-3, float(PATH[i])) for i in given_points]
    np.testing.assert_allclose(given, expected, rtol=0, atol=1e-9)
    assert made["x"].reversal_voltages == pytest.approx(twin.reversal_voltages)


def test_one_that_is_refused_changes_nothing():
    made, clean = axes(), axes()
    following, undisturbed = Following(made), Following(clean)
    for each in (following, undisturbed):
        each.start(trajectory(), lambda: START, START)
    given = [follow(following, made, START + 100 * MS)]
    with pytest.raises(SlpiError):
        following.start(trajectory(path=PATH + 1e-3), lambda: START + 100 * MS, START)
    given.append(follow(following, made, START + 400 * MS))
    assert np.vstack(given).tolist() == follow(undisturbed, clean, START + 400 * MS).tolist()


def test_replaced_at_once_appended_later_and_stopped():
    made = axes()
    following = Following(made)
    following.start(trajectory(), lambda: START, START)
    follow(following, made, START + 50 * MS)
    following.start(trajectory("y"), lambda: START + 50 * MS, START)
    assert following.remaining == 300
    following.start(trajectory("x", np.full(9, 5e-6), START + 100 * MS), lambda: START + 50 * MS, START)
    assert following.remaining == 50 + 9
    before = made["x"].voltage
    follow(following, made, START + 100 * MS)
    assert made["x"].voltage == before and made["y"].voltage > 0.0
    assert following.next_deadline_ns == START + 100 * MS
    following.stop()
    assert not following.on and following.step(START + 10**12) is None
    # No time has passed at the next sample.
    assert made["x"].stamps.accept(START) == 0.0


def test_the_plan_says_what_is_out_of_reach_or_too_fast():
    made = axes(slew=100.0)
    following = Following(made)
    following.start(trajectory(path=np.concatenate([PATH, np.full(5000, 15e-6)])), lambda: START, START)
    assert following.points_slewing > 100 and following.points_held > 100
