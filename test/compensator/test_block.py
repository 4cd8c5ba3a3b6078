"""A path as one block of voltages: the limits, the same memory as with samples, and what of it was really played."""

from dataclasses import replace

import numpy as np
import pytest

rclpy = pytest.importorskip("rclpy")

from nodes.ros_helpers import axis_model, stage_model  # noqa: E402

from slpi_ros.compensator.block import ENDED, PATIENCE_NS, PLAYING, REFUSED, STOPPED  # noqa: E402
from slpi_ros.compensator.controller import Controller, OperatingMode  # noqa: E402
from slpi_ros.compensator.motion import Safety  # noqa: E402
from slpi_ros.compensator.validation import RejectedError  # noqa: E402
from slpi_ros.effects.creep import Creep  # noqa: E402
from slpi_ros.model.limits import Limits  # noqa: E402
from slpi_ros.model.stage_model import StageModel  # noqa: E402

PERIOD, SLEW = 1e-3, 1000.0
COUNT = 1500
STAMP = 1_700_000_000_000_000_000


def silent(made, now_ns):
    """Return what the monitor finds of a block."""
    found = made.watch(Safety(0.0, False, False, (0.0,), 50.0), 0.0, now_ns)
    return "".join(each.reason for each in found if each.rule == "block")


def prepared(axes=("x",), model=None, slew=SLEW):
    made = Controller(axes, [Limits(0.0, 100.0, slew)] * len(axes), period=PERIOD)
    made.activate(0)
    made.use_model(model or stage_model(axes))
    made.locate(10**9)
    return made


def path_of(made, count=COUNT):
    """Return a path that turns several times: times (ns), displacements (m)."""
    t = np.arange(count) * PERIOD
    low, high = made.axes[0].stream.accepted
    middle = 0.5 * (low + high)
    size = 0.15 * (high - low)
    return np.round(t * 1e9).astype(np.int64), middle + size * np.sin(2 * np.pi * 2.0 * t) * np.cos(2 * np.pi * 0.7 * t)


def block_of(made, count=COUNT, now_ns=2 * 10**9):
    times, y = path_of(made, count)
    return made.follow_block(["x"], times, y[:, None], now_ns, STAMP), y


def memory(made, place=0):
    stream = made.axes[place].stream
    return np.array([*made.axes[place].reversal_voltages]), stream.uncoupled_displacement


def test_it_begins_at_the_present_voltage_and_keeps_the_limits():
    made = prepared()
    begin = made.axes[0].voltage
    block, _ = block_of(made)
    v = block.voltages[:, 0]
    assert v[0] == begin and block.lead_in > 1 and block.missed == ""
    assert np.abs(np.diff(v)).max() <= SLEW * block.period * (1.0 + 1e-9)
    assert v.min() >= 0.0 and v.max() <= 100.0
    assert len(v) == block.lead_in + COUNT


def test_its_voltages_are_those_of_the_samples_one_by_one():
    made, other = prepared(slew=1e9), prepared(slew=1e9)
    block, y = block_of(made)
    single = []
    for number, desired in enumerate(y):
        other.update(STAMP + number * 1_000_000, ["x"], [desired], 2 * 10**9 + number * 1_000_000)
        single.append(other.voltages[0])
    np.testing.assert_allclose(block.voltages[block.lead_in :, 0], single, atol=1e-9)


@pytest.mark.parametrize("share", [0.0, 0.37, 1.0])
def test_the_memory_follows_what_was_really_played(share):
    model = stage_model(("x",))
    made, other = prepared(model=model), prepared(model=model)
    block, _ = block_of(made)
    count = round(share * len(block.voltages))
    before = memory(made)
    for sample in range(0, count, 100):
        assert not made.hear_block(STAMP, PLAYING, sample, "", 2 * 10**9 + sample)
    assert made.hear_block(STAMP, ENDED if share == 1.0 else STOPPED, count, "", 4 * 10**9)
    assert made.mode is OperatingMode.STREAMING
    stream = other.axes[0].stream
    for v in block.voltages[:count, 0]:
        stream.drive(float(v), PERIOD)
    other.axes[0].output.start(stream.voltage)
    found, expected = memory(made), memory(other)
    np.testing.assert_allclose(found[0], expected[0] if count else before[0], atol=1e-9)
    assert found[1] == pytest.approx(expected[1], abs=1e-15)
    assert made.voltages[0] == (block.voltages[count - 1, 0] if count else before[0][-1])
    # Single samples go on from there, within the slew limit.
    last = made.voltages[0]
    made.update(STAMP, ["x"], [float(path_of(made)[1][0])], 4 * 10**9 + 1_000_000)
    assert abs(made.voltages[0] - last) <= 2.0 * SLEW * PERIOD + 1e-9


def test_while_it_is_played_nothing_else_moves():
    made = prepared()
    block, y = block_of(made)
    before = list(made.voltages)
    for ask in (
        lambda: made.update(STAMP, ["x"], [y[0]], 2 * 10**9),
        lambda: made.ramp([50.0], 10.0, 2 * 10**9),
        lambda: made.reset_memory(3, 100.0, [50.0], 2 * 10**9),
        lambda: made.follow(["x"], [0], [[y[0]]], 0, 2 * 10**9, 2 * 10**9),
        lambda: block_of(made),
        lambda: made.use_model(stage_model(("x",))),
    ):
        with pytest.raises(RejectedError, match="block"):
            ask()
    assert not made.advance(3 * 10**9, 3 * 10**9) and list(made.voltages) == before
    assert made.next_due_ns(0, 0) is None


def test_what_is_told_of_another_block_does_not_count():
    made = prepared()
    block_of(made)
    assert not made.hear_block(STAMP - 1, ENDED, 10, "", 3 * 10**9) and made.mode is OperatingMode.BLOCK
    assert made.hear_block(STAMP, REFUSED, 0, "too long", 3 * 10**9) and made.block.reason == "too long"
    assert not made.hear_block(STAMP, ENDED, 10, "", 3 * 10**9)


def test_no_driver_answers():
    made = prepared()
    block_of(made)
    assert silent(made, 2 * 10**9 + PATIENCE_NS - 1) == ""
    assert "no driver" in silent(made, 2 * 10**9 + PATIENCE_NS) and made.mode is OperatingMode.STREAMING
    assert made.ownership.owned


def test_a_driver_that_falls_silent_needs_to_be_armed():
    made = prepared()
    block_of(made)
    made.hear_block(STAMP, PLAYING, 50, "", 3 * 10**9)
    assert "sample 50" in silent(made, 3 * 10**9 + PATIENCE_NS)
    with pytest.raises(RejectedError, match="sample 50"):
        made.update(STAMP, ["x"], [float(path_of(made)[1][0])], 6 * 10**9)
    for number in range(100):
        made.report(["x"], [37.0], 6 * 10**9 + number * 10_000_000)
    assert made.arm(7 * 10**9) == "" and made.voltages[0] == 37.0


def test_reports_of_a_block_are_no_other_hand():
    made = prepared()
    block, _ = block_of(made)
    begun = 2 * 10**9
    for sample in range(0, len(block.voltages), 50):
        now = begun + sample * 1_000_000
        made.hear_block(STAMP, PLAYING, sample, "", now)
        assert silent(made, now) == ""
        for more in range(0, 50, 5):
            at = min(sample + more, len(block.voltages) - 1)
            assert not made.report(["x"], [float(block.voltages[at, 0])], now + more * 1_000_000)
    assert made.hear_block(STAMP, ENDED, len(block.voltages), "", now + 50_000_000)
    assert made.ownership.owned


@pytest.mark.parametrize(
    ("limits", "beyond"),
    [
        (Limits(0.0, 100.0, SLEW), False),
        (Limits(0.0, 1.0, SLEW), True),
        (Limits(0.0, 100.0, 0.5 * SLEW), True),
        (Limits(0.0, 100.0, 2.0 * SLEW), False),
    ],
)
def test_limits_that_come_while_a_block_is_played_hold_for_the_rest_of_it(limits, beyond):
    made = prepared()
    block, _ = block_of(made)
    made.hear_block(STAMP, PLAYING, 5, "", 3 * 10**9)
    made.use_limits([limits], 3 * 10**9, PERIOD)
    assert made.block.beyond_limits is beyond
    # What has been played counts no more.
    made.use_limits([replace(limits, upper=100.0)], 3 * 10**9, PERIOD)
    made.hear_block(STAMP, PLAYING, len(block.voltages), "", 3 * 10**9)
    assert not made.block.beyond_limits


def test_after_a_block_the_voltage_goes_inside_limits_that_have_come_meanwhile():
    made = prepared()
    block, _ = block_of(made)
    end = float(block.voltages[-1, 0])
    made.use_limits([Limits(0.0, end - 5.0, SLEW)], 3 * 10**9, PERIOD)
    now = 4 * 10**9
    assert made.hear_block(STAMP, ENDED, len(block.voltages), "", now) and made.voltages[0] == end
    given = [end]
    while made.next_due_ns(now, now) is not None and len(given) < 1000:
        now = max(now + 1, made.next_due_ns(now, now))
        made.advance(now, now)
        given.append(made.voltages[0])
    assert given[-1] == end - 5.0
    assert np.abs(np.diff(given)).max() <= 2.0 * SLEW * PERIOD * (1.0 + 1e-9)


def test_an_axis_that_is_not_named_stays_and_effects_go_on():
    model = axis_model()
    slow = replace(model, effects=(Creep((0.5,), (0.03,)),))
    made = prepared(("x", "y"), StageModel({"x": slow, "y": model}))
    voltage = made.voltages[1]
    block, _ = block_of(made)
    assert block.names == ("x",)
    made.hear_block(STAMP, ENDED, len(block.voltages), "", 5 * 10**9)
    assert made.voltages[1] == voltage and made.voltages[0] == block.voltages[-1, 0]
    assert made.axes[0].stream.relaxing(0.0)["creep"] != (0.0,)


def test_a_path_that_is_too_fast_is_told():
    made = prepared(slew=20.0)
    block, _ = block_of(made)
    assert "too fast" in block.missed and made.trajectory.too_fast == block.missed
    assert np.abs(np.diff(block.voltages[:, 0])).max() <= 20.0 * block.period * (1.0 + 1e-9)


def test_points_closer_than_the_output_period_are_kept():
    made = prepared()
    times, y = path_of(made, 400)
    block = made.follow_block(["x"], times // 20, y[:1] + 0.0 * y[:, None], 2 * 10**9, STAMP)
    assert block.period == pytest.approx(5e-5) and block.times_ns[1] == 50_000


@pytest.mark.parametrize("far", [1e-3, float("nan")])
def test_what_is_out_of_reach_changes_nothing(far):
    made = prepared()
    before = list(made.voltages), memory(made)
    with pytest.raises(RejectedError):
        made.follow_block(["x"], [0, 10**6], [[far], [far]], 2 * 10**9, STAMP)
    assert made.mode is OperatingMode.STREAMING and list(made.voltages) == before[0]
    made.update(STAMP, ["x"], [float(path_of(made)[1][0])], 3 * 10**9)


def test_a_path_that_is_too_long():
    made = prepared()
    times, y = path_of(made, 2)
    with pytest.raises(RejectedError, match="samples"):
        made.follow_block(["x"], [0, 10**9 * 10**4], y[:, None], 2 * 10**9, STAMP)
    assert made.mode is OperatingMode.STREAMING
    assert times.size == 2
