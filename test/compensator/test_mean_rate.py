"""A limit of the mean rate: paths that exceed it are refused with a factor, streamed set points slow down."""

import re
from dataclasses import replace

import numpy as np
import pytest
from strategies import FAMILY_CASE, axis_model

from slpi_ros.compensator.block import ENDED, PLAYING
from slpi_ros.compensator.controller import Controller, StopReason
from slpi_ros.compensator.validation import RejectedError
from slpi_ros.model.limits import Limits
from slpi_ros.model.mean_rate import highest_mean_rate
from slpi_ros.model.stage_model import StageModel

MS = 1_000_000
MODEL = replace(axis_model(FAMILY_CASE), displacement_range=(2e-6, 14e-6))
LIMIT = 100.0  # V/s


def controller(mean_rate=LIMIT):
    made = Controller(["x"], [Limits(*MODEL.voltage_range, 5000.0, mean_rate=mean_rate)])
    made.configure()
    made.use_model(StageModel({"x": MODEL}))
    made.activate(10**9)
    return made


def scan(hertz, seconds=15.0):
    t = np.arange(0.0, seconds, 2e-3)
    return (t * 1e9).astype(np.int64), (8e-6 + 4e-6 * np.sin(2 * np.pi * hertz * t))[:, None]


def begin(made, how, times, path):
    if how == "block":
        return made.follow_block(["x"], times, path, 2 * 10**9, 1)
    return made.follow(["x"], times, path, 0, 2 * 10**9, 2 * 10**9)


@pytest.mark.parametrize("how", ["trajectory", "block"])
def test_a_path_is_refused_with_the_factor_that_makes_it_slow_enough(how):
    times, path = scan(10.0)
    with pytest.raises(RejectedError) as refused:
        begin(controller(), how, times, path)
    factor = float(re.search(r"([\d.]+) times more slowly", str(refused.value)).group(1))
    assert factor > 2.0
    begin(controller(), how, (times * factor * 1.1).astype(np.int64), path)
    with pytest.raises(RejectedError):
        begin(controller(), how, (times * factor * 0.9).astype(np.int64), path)
    begin(controller(np.inf), how, times, path)


def test_streamed_set_points_slow_down():
    made, now, out = controller(), 2 * 10**9, []
    times, path = scan(10.0)
    for at, (y,) in zip(times.tolist(), path.tolist(), strict=True):
        made.update(now + at, ["x"], [y], now + at)
        out.append(made.voltages[0])
    assert highest_mean_rate(times * 1e-9, np.array(out)) <= LIMIT * (1 + 1e-9)
    assert highest_mean_rate(times * 1e-9, np.array(out)) > 0.9 * LIMIT
    assert made.axes[0].output.fastest < 5000.0


def played(made, times, path, now, stamp=1):
    """Let a device play a path as a block from `now` (ns) on; return when it has ended, and its way (V)."""
    block = made.follow_block(["x"], times, path, now, stamp)
    end = now + int(len(block.voltages) * block.period * 1e9)
    made.hear_block(stamp, PLAYING, len(block.voltages) // 2, "", (now + end) // 2)
    assert made.hear_block(stamp, ENDED, len(block.voltages), "", end)
    return end, float(np.abs(np.diff(block.voltages[:, 0])).sum())


@pytest.mark.parametrize("how", ["trajectory", "block"])
def test_what_a_device_has_played_counts_for_the_next_path(how):
    """Each block for itself is at 20 V/s; one after the other they would be at 200 V/s."""
    made, now, ways = controller(), 2 * 10**9, []
    times, path = scan(1.0, 1.0)
    while True:
        try:
            now, way = played(made, times, path, now, stamp=len(ways) + 1)
        except RejectedError as error:
            refused = str(error)
            break
        ways.append(way)
        assert sum(ways) <= 10.0 * LIMIT * (1 + 1e-9)
    assert len(ways) > 1 and sum(ways) + ways[-1] > 10.0 * LIMIT
    assert made.axes[0].output.travelled.within(now) == pytest.approx(sum(ways))
    later = float(re.search(r"send it ([\d.]+) s later", refused).group(1))
    # As soon as the begin of the first block is out of the window at its end.
    assert 9.0 - 1.1 * len(ways) < later < 10.02 - len(ways)
    with pytest.raises(RejectedError, match="s later"):
        begin_at(made, how, times, path, now)
    with pytest.raises(RejectedError, match="s later"):
        begin_at(made, how, times, path, now + int(0.9 * later * 1e9))
    begin_at(made, how, times, path, now + int(1.01 * later * 1e9))


def begin_at(made, how, times, path, now):
    if how == "block":
        return made.follow_block(["x"], times, path, now, 1)
    return made.follow(["x"], times, path, 0, now, now)


@pytest.mark.parametrize("readings", [False, True], ids=["alone", "with readings"])
def test_a_path_that_was_accepted_is_not_slowed(readings):
    """900 V within 2 s: the slew limit of streamed set points would fall to 100 V/s on the way."""
    made, now = controller(), 2 * 10**9
    times, path = scan(2.5, 2.0)
    free = controller(np.inf)
    for each in (made, free):
        for at in range(now - 10**9, now - 10**9 + 100 * MS, MS):
            each.update(at, ["x"], [8e-6], at)
            if readings:
                each.measure(["x"], [each.axes[0].expected], at)
        begin_at(each, "trajectory", times, path, now)
        given = []
        for at in range(now, now + 2 * 10**9, MS):
            if readings and at % (10 * MS) == 0:
                each.measure(["x"], [each.axes[0].expected], at)
            each.advance(at, at)
            given.append(each.voltages[0])
        each.given = np.array(given)
    assert 700.0 < np.abs(np.diff(made.given)).sum() < 1000.0
    np.testing.assert_allclose(made.given, free.given, atol=1e-9)
    # What comes after it is slowed again.
    made.stop(StopReason.CANCELED, now)
    assert not made.axes[0].output.checked and not made.axes[0].stream.pace.checked
