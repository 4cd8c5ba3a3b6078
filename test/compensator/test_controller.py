"""The compensator's heart without ROS: all or nothing, always within the limits."""

import math
import warnings
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

rclpy = pytest.importorskip("rclpy")

from nodes.ros_helpers import axis_model, stage_model, voltage_path  # noqa: E402

from slpi_ros.compensator.controller import Controller  # noqa: E402
from slpi_ros.compensator.validation import CAUSES, STALE, RejectedError, TimestampRules  # noqa: E402
from slpi_ros.errors import SlpiError, UsageError  # noqa: E402
from slpi_ros.model.axis_model import Start  # noqa: E402
from slpi_ros.model.limits import Limits  # noqa: E402
from slpi_ros.model.stage_model import HeldAtLimitWarning, StageModel  # noqa: E402

MS = 1_000_000
START_NS = 1_700_000_000_123_456_789


def compensation(axes=("x",), model=None, **limits):
    made = Controller(axes, [Limits(**{"lower": 0.0, "upper": 100.0, **limits})] * len(axes))
    made.activate(0)
    made.use_model(model or stage_model(axes))
    return made


def update(made, stamp_ns, names, displacements):
    return made.update(stamp_ns, names, displacements, max(stamp_ns, 0))


def snapshots(made):
    return [axis.stream.memory.snapshot() for axis in made.axes]


def test_answers_are_the_library_s():
    model = stage_model(("x", "y"))
    made = compensation(("x", "y"))
    wanted = {
        axis: model.axis(axis).simulate(np.arange(3000) * 5e-3, voltage_path(3000, seed))
        for seed, axis in enumerate("xy")
    }
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", HeldAtLimitWarning)
        expected = model.compensate(np.arange(3000) * 5e-3, wanted)
    for i, (x, y) in enumerate(zip(wanted["x"], wanted["y"], strict=True)):
        order = (["x", "y"], [x, y]) if i % 3 else (["y", "x"], [y, x])
        update(made, START_NS + 5 * MS * i, *order)
        assert made.voltages[0] == pytest.approx(expected["x"][i], abs=1e-9)
        assert made.voltages[1] == pytest.approx(expected["y"][i], abs=1e-9)
    assert made.counts["accepted"] == 3000 and made.counts["rejected"] == 0


def test_axes_that_are_not_named_keep_their_voltage():
    made = compensation(("x", "y"))
    update(made, START_NS, ["y"], [5e-6])
    voltage = made.voltages[1]
    for i in range(1, 10):
        update(made, START_NS + i * MS, ["x"], [i * 1e-6])
        assert made.voltages[1] == voltage


REJECTIONS = {
    "empty": ([], []),
    "length": (["x", "y"], [1e-6]),
    "duplicate_axis": (["x", "x"], [1e-6, 2e-6]),
    "unknown_axis": (["x", "z"], [1e-6, 2e-6]),
    "not_finite": (["x", "y"], [1e-6, math.nan]),
    "out_of_range": (["x", "y"], [1e-6, 1.0]),
}


@pytest.mark.parametrize("cause", REJECTIONS)
def test_a_rejected_message_moves_nothing(cause):
    made = compensation(("x", "y"))
    update(made, START_NS, ["x", "y"], [3e-6, 4e-6])
    before, voltages = snapshots(made), list(made.voltages)
    with pytest.raises(RejectedError) as caught:
        update(made, START_NS + MS, *REJECTIONS[cause])
    assert caught.value.cause == cause
    assert {each: made.counts[f"rejected.{each}"] for each in CAUSES} == {**dict.fromkeys(CAUSES, 0), cause: 1}
    assert (made.counts["received"], made.counts["accepted"], made.counts["rejected"]) == (2, 1, 1)
    assert snapshots(made) == before and list(made.voltages) == voltages


def test_nothing_moves_before_a_model_or_activation():
    made = Controller(["x"], [Limits(0.0, 100.0)])
    causes = []
    for _ in range(2):
        with pytest.raises(RejectedError) as caught:
            update(made, START_NS, ["x"], [1e-6])
        causes.append(caught.value.cause)
        made.activate(0)
    assert causes == ["inactive", "no_model"]


def test_time_is_compared_in_nanoseconds_and_for_each_axis():
    made = compensation(("x", "y"))
    update(made, START_NS, ["x"], [2e-6])
    update(made, START_NS - 50 * MS, ["y"], [1e-6])
    with pytest.raises(RejectedError) as caught:
        update(made, START_NS - 1, ["y", "x"], [2e-6, 2e-6])
    assert caught.value.cause == "time_backwards"
    made.use_model(stage_model(("x", "y"), stroke=9e-6))
    with pytest.raises(RejectedError):
        update(made, START_NS - 1, ["x"], [2e-6])


def test_what_is_just_out_of_reach_is_held_and_the_path_after_it_is_as_before():
    made = compensation()
    top = stage_model().axis("x").displacement_range[1]
    update(made, START_NS, ["x"], [0.0])
    assert made.counts["held_at_limit"] == 0
    assert update(made, START_NS + 1, ["x"], [1.1 * top])
    assert made.voltages[0] == 100.0 and made.counts["held_at_limit"] == 1
    assert not update(made, START_NS + 2, ["x"], [0.5 * top])
    clean = compensation()
    for i, y in enumerate((top, 0.5 * top)):
        update(clean, START_NS + i, ["x"], [y])
    assert made.voltages[0] == pytest.approx(clean.voltages[0], abs=1e-9)


def test_slew_is_respected_from_the_first_sample_on():
    made = compensation(slew=500.0)
    path = stage_model().axis("x").simulate(np.arange(2000) * 5e-3, voltage_path(2000, 3))
    last = made.voltages[0]
    reached, changed = 0, -2
    for i, y in enumerate(path):
        update(made, START_NS + i * MS, ["x"], [y])
        # At most two output periods since the last change count, at the first sample as well.
        assert abs(made.voltages[0] - last) <= 0.5 * min(i - changed, 2) + 1e-9
        reached += abs(made.axes[0].stream.memory.displacement - y) < 1e-12
        changed = i if made.voltages[0] != last else changed
        last = made.voltages[0]
    assert reached > 0


@pytest.mark.parametrize("slew", [math.inf, 200.0])
def test_a_new_model_takes_over_where_the_voltage_is(slew):
    made = compensation(slew=slew)
    path = stage_model().axis("x").simulate(np.arange(400) * 5e-3, voltage_path(400, 5))
    rng, changed = np.random.default_rng(7), -2
    for i, y in enumerate(path):
        if i % 3 == 0:
            before = made.voltages[0]
            narrow = axis_model(stroke=10e-6 * rng.uniform(0.9, 1.1), voltage=rng.uniform(85.0, 120.0))
            made.use_model(StageModel({"x": narrow}))
            assert made.voltages[0] == before
        last = made.voltages[0]
        update(made, START_NS + i * MS, ["x"], [min(y, narrow.displacement_range[1])])
        assert 0.0 <= made.voltages[0] <= 100.0
        assert abs(made.voltages[0] - last) <= slew * 1e-3 * min(i - changed, 2) + 1e-9
        changed = i if made.voltages[0] != last else changed


def refused_models():
    good = axis_model()
    yield "'x'", {"y": good}
    yield r"200\b.*\b300\b", {"x": replace(good, voltage_range=(200.0, 300.0))}
    yield "displacement", {"x": replace(good, displacement_range=(0.0, 1e6))}
    yield "voltage", {"x": replace(good, start=Start(5e6, 0.0))}


@pytest.mark.parametrize(("why", "axes"), list(refused_models()))
def test_a_refused_model_leaves_the_old_one_working(why, axes):
    made = compensation()
    update(made, START_NS, ["x"], [4e-6])
    before, model = snapshots(made), made.model
    with pytest.raises(SlpiError, match=why):
        made.use_model(StageModel(axes))
    assert snapshots(made) == before and made.model is model
    update(made, START_NS + MS, ["x"], [5e-6])


def advanced(made, now_ns, seconds):
    """Return the voltages (V) of the first axis that follow, shape (N,), and the time then."""
    way, end_ns = [], now_ns + int(seconds * 1e9)
    while (due_ns := made.next_due_ns(now_ns, now_ns)) is not None and due_ns <= end_ns:
        now_ns = max(due_ns, now_ns)
        if made.advance(now_ns, now_ns):
            way.append(made.voltages[0])
    return np.array(way), end_ns


def test_limits_change_while_it_runs_and_a_voltage_outside_goes_inside_at_the_slew_limit():
    made = compensation()
    update(made, START_NS, ["x"], [5e-6])
    before = snapshots(made)
    now = START_NS + 10**9
    made.use_limits([Limits(0.0, 70.0, 1000.0)], now)
    assert snapshots(made) == before
    update(made, now, ["x"], [9e-6])
    way, now = advanced(made, now, 0.2)
    assert way[-1] == made.voltages[0] == 70.0 and np.diff(way).max() <= 1.0 + 1e-9
    # Lower than where it is: accepted, inside at once or nearly so, never in one step.
    made.use_limits([Limits(0.0, 60.0, 1000.0)], now)
    assert made.voltages[0] == 70.0
    way, now = advanced(made, now, 0.2)
    assert np.abs(np.diff([70.0, *way])).max() <= 2.0 + 1e-9 and (np.diff([70.0, *way]) < 0.0).all()
    assert len(way) <= 11 and way[-1] == pytest.approx(60.0, abs=1e-9)
    update(made, now, ["x"], [9e-6])
    assert made.voltages[0] <= 60.0


def test_limits_outside_of_what_was_identified_are_refused():
    made = compensation()
    update(made, START_NS, ["x"], [5e-6])
    before = made.voltages[0]
    with pytest.raises(UsageError, match=r"\b100 V.*\b120\b"):
        made.use_limits([Limits(120.0, 150.0)], START_NS + MS)
    assert made.axes[0].limits == Limits(0.0, 100.0) and made.voltages[0] == before


@pytest.mark.parametrize(("max_age", "age", "taken"), [
    (0.5, 0.499, True), (0.5, 0.501, False), (0.5, -3.0, True), (0.0, 1000.0, True),
])  # fmt: skip
def test_a_sample_that_is_older_than_allowed_is_stale(max_age, age, taken):
    made = compensation()
    made.messages.use(TimestampRules(max_age=max_age))
    arrival = START_NS + round(age * 1e9)
    if taken:
        made.update(START_NS, ["x"], [4e-6], arrival, arrival)
        return
    with pytest.raises(RejectedError) as caught:
        made.update(START_NS, ["x"], [4e-6], arrival, arrival)
    assert caught.value.cause == STALE and "0.501 s" in str(caught.value)


NUMBER = st.one_of(
    st.floats(-3e-6, 13e-6), st.sampled_from([0.0, math.nan, math.inf, -math.inf, 1e300, -1e-300, 5e-324, 10e-6])
)
MESSAGE = st.tuples(
    st.sampled_from([-5 * MS, 0, 1, MS, 20 * MS, 10**12]),
    st.lists(st.sampled_from(["x", "y", "x", "y", "z"]), max_size=3),
    st.lists(NUMBER, max_size=3),
)
LIMITS = st.tuples(st.floats(-50.0, 40.0), st.floats(1.0, 120.0), st.sampled_from([math.inf, 1.0, 1e3, 1e6]))


@settings(max_examples=150)
@given(st.lists(st.one_of(MESSAGE, st.tuples(st.floats(5e-6, 2e-5), st.floats(60.0, 150.0))), max_size=60), LIMITS)
def test_no_flood_brings_a_voltage_outside(events, bounds):
    lower, width, slew = bounds
    limits = Limits(lower, lower + width, slew)
    made = Controller(("x", "y"), [limits] * 2)
    made.activate(0)
    try:
        made.use_model(stage_model(("x", "y")))
    except UsageError:
        return
    clean = Controller(("x", "y"), [limits] * 2)
    clean.activate(0)
    clean.use_model(stage_model(("x", "y")))
    now, last = START_NS, list(made.voltages)
    latest: dict[str, int] = {}
    changed: dict[str, int] = {}
    for event in events:
        if len(event) == 2:
            model = stage_model(("x", "y"), stroke=event[0], voltage=event[1])
            try:
                made.use_model(model)
            except UsageError:
                # It has another voltage now than this model is good for.
                assert max(last) > event[1]
            else:
                clean.use_model(model)
            assert list(made.voltages) == last
            continue
        step, names, displacements = event
        now += step
        try:
            update(made, now, names, displacements)
        except RejectedError:
            assert list(made.voltages) == last
        else:
            update(clean, now, names, displacements)
            for name, before, after in zip("xy", last, made.voltages, strict=True):
                assert limits.lower <= after <= limits.upper
                elapsed = min(max(now, 0) - changed.get(name, -MS * 2), 2 * MS) * 1e-9
                assert slew == math.inf or abs(after - before) <= slew * elapsed + 1e-9
                assert name in names or after == before
                if after != before:
                    changed[name] = max(now, 0)
            latest |= dict.fromkeys(names, now)
        last = list(made.voltages)
        now = max([now, *latest.values()])
    assert snapshots(made) == snapshots(clean)
