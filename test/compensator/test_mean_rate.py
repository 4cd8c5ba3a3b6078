"""A limit of the mean rate: paths that exceed it are refused with a factor, streamed set points slow down."""

import re
from dataclasses import replace

import numpy as np
import pytest
from strategies import FAMILY_CASE, axis_model

from slpi_ros.compensator.controller import Controller
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
