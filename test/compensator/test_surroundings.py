"""Quantities in use: which values are taken, what is said of the others, and what moves with them."""

from dataclasses import replace

import numpy as np
import pytest
from model.test_surroundings import LOAD, WARM
from strategies import FAMILY_CASE, axis_model

from slpi_ros.compensator.controller import Controller
from slpi_ros.compensator.feedback import LoopSettings, PidGains
from slpi_ros.compensator.surroundings import Surrounding
from slpi_ros.effects.base import Followed
from slpi_ros.effects.surroundings import Surroundings
from slpi_ros.model.limits import Limits
from slpi_ros.model.stage_model import StageModel

SECOND = 10**9
MODEL = StageModel(
    {"x": replace(axis_model(FAMILY_CASE), effects=(Surroundings((replace(WARM, sensitivity_gain=0.0), LOAD)),))}
)
KEY = "/room/temperature"


def test_a_value_is_unknown_then_used_then_old():
    one = Surrounding(Followed("/t", 21.0, 20.0, 22.0))
    assert one.problem(0) and one.age_ns(0) is None
    for k in range(5):
        assert one.note(21.0 + 0.1 * k, k * SECOND)
    assert one.problem(5 * SECOND) == ""
    assert one.age_ns(5 * SECOND) == SECOND
    # Ten usual intervals.
    assert one.problem(13 * SECOND) == "" and one.problem(15 * SECOND) != ""
    assert one.value == pytest.approx(21.4)


@pytest.mark.parametrize("value", [30.0, -273.0, np.nan, np.inf])
def test_a_value_far_outside_is_refused_and_the_last_one_stays(value):
    one = Surrounding(Followed("/t", 21.0, 20.0, 22.0))
    assert one.note(21.5, 0)
    assert not one.note(value, SECOND)
    assert one.value == 21.5 and one.problem(SECOND) != ""
    # A little beyond the record is no fault.
    assert one.note(22.4, 2 * SECOND) and one.problem(2 * SECOND) == ""


@pytest.mark.parametrize("loops", [(), (LoopSettings(True, PidGains(0.0, 1e5, 0.0, 0.0), 0.1, 10.0),)])
def test_the_voltage_follows_a_value_and_keeps_it_over_a_new_model(loops):
    controller = Controller(["x"], [Limits(0.0, 100.0)], loops=loops)
    controller.configure()
    controller.use_model(MODEL)
    controller.activate(0)
    assert set(controller.surroundings) == {KEY, LOAD.key}

    def voltage(now: int) -> float:
        controller.update(now, ["x"], [5e-6], now, now)
        return float(controller.voltages[0])

    before = voltage(SECOND)
    assert controller.surroundings.take(KEY, 23.0, SECOND)
    assert not controller.surroundings.take("/other", 1.0, SECOND)
    assert not controller.surroundings.take(KEY, 99.0, SECOND)
    warm = voltage(2 * SECOND)
    # 2 K expand it by 0.8 um.
    assert warm < before - 1.0
    controller.use_model(MODEL)
    assert controller.surroundings[KEY].value == 23.0
    assert voltage(3 * SECOND) == pytest.approx(warm, abs=1e-6)
    expected = MODEL.axes["x"].stream()
    expected.step(0.0, 5e-6)
    assert expected.step(1.0, 5e-6, {KEY: 23.0}) == pytest.approx(warm, abs=1e-6)
