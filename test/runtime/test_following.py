"""Axes along trajectories: as planned while nothing comes in between, and as good as possible when something does."""

from dataclasses import replace

import numpy as np
import pytest
from strategies import FAMILY_CASE, axis_model

from slpi_ros.control import PidGains
from slpi_ros.errors import SlpiError
from slpi_ros.runtime.axis import Axis
from slpi_ros.runtime.following import Following
from slpi_ros.runtime.loop import LoopSettings
from slpi_ros.runtime.trajectory import Trajectory
from slpi_ros.stream import Limits

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


def test_points_that_are_late_are_skipped_and_the_memory_knows_what_was_given():
    made, twin = axes(), axes()["x"]
    following = Following(made)
    following.start(trajectory(), lambda: START, START)
    given = follow(following, made, START + 310 * MS, 7 * MS)[:, 0]
    assert following.skipped == 300 - len(given) > 200
    given_points = list(range(0, 300, 7)) + ([299] if 299 % 7 else [])
    expected = [twin.move(1e-3, float(PATH[i])) for i in given_points]
    np.testing.assert_allclose(given, expected, rtol=0, atol=1e-9)
    assert made["x"].went_through == pytest.approx(twin.went_through)


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
