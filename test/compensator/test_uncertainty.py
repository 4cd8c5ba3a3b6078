"""The uncertainty of where the axes are, which a compensator follows while somebody asks for it."""

from dataclasses import replace
from datetime import UTC, datetime, timedelta

import numpy as np
import pytest
from model.test_uncertainty import BARE, CREEP, QUALITY, SURROUNDINGS

from slpi_ros.compensator.controller import Controller, watch_uncertainty
from slpi_ros.model.limits import Limits
from slpi_ros.model.stage_model import StageModel
from slpi_ros.model.uncertainty import AxisUncertainty

SECOND = 10**9
NOW = datetime(2026, 5, 6, 7, 8, 9, tzinfo=UTC)
MADE = (NOW - timedelta(seconds=600)).isoformat()


def watch(controller, wanted, now, now_ns):
    return watch_uncertainty(controller.axes, controller.model, wanted, now, now_ns)


def controller_of(axis, created=MADE):
    controller = Controller(["x"], [Limits(0.0, 100.0)])
    controller.configure()
    controller.use_model(StageModel({"x": axis}, "", created))
    controller.activate(0)
    return controller


def follow(controller, t, y):
    """Return the uncertainty (m) after each sample."""
    told = []
    for now, each in zip(t.tolist(), y.tolist(), strict=True):
        controller.update(round(now * SECOND), ["x"], [each], round(now * SECOND), 0)
        told.append(controller.axes[0].uncertainty.present)
    return told


@pytest.mark.parametrize("effects", [(), (CREEP,)])
def test_it_is_that_of_the_model_while_somebody_asks(effects):
    axis = replace(BARE, effects=effects)
    controller = controller_of(axis)
    t = 1.0 + np.arange(200) * 1e-2
    y = 5e-6 + 3e-6 * np.sin(t)
    assert follow(controller, t[:100], y[:100]) == [None] * 100
    assert watch(controller, True, NOW, round(t[99] * SECOND)) == ""
    told = np.array(follow(controller, t[100:], y[100:]))
    own, (one,) = AxisUncertainty(axis), controller.axes
    # Ten minutes after the calibration, besides the record; the memory has not been known since.
    assert told[0] ** 2 > own.within[0] + QUALITY.drift**2 * 630.0
    assert told[0] ** 2 < own.within[0] + QUALITY.drift**2 * 640.0 + (own.most / 2.0) ** 2
    assert one.expected == pytest.approx(y[-1], abs=1e-12)
    assert watch(controller, False, NOW, round(t[-1] * SECOND)) == ""
    assert one.uncertainty.present is None


def test_after_a_reset_the_memory_is_known_and_the_age_begins_anew():
    controller = controller_of(BARE)
    follow(controller, np.array([1.0]), np.array([5e-6]))
    watch(controller, True, NOW, SECOND)
    before = controller.axes[0].uncertainty.present
    controller.reset_memory(3, 800.0, [40.0], SECOND)
    now = SECOND
    while controller.mode.value == "resetting":
        now += SECOND // 1000
        controller.advance(now, now)
    watch(controller, True, datetime.now(UTC), now)
    after = controller.axes[0].uncertainty.present
    square = AxisUncertainty(BARE).within[0] + QUALITY.drift**2 * QUALITY.duration
    assert after**2 == pytest.approx(square, rel=0.1) and after < before


def test_the_age_counts_while_nothing_moves():
    controller = controller_of(BARE)
    follow(controller, np.array([1.0]), np.array([5e-6]))
    watch(controller, True, NOW, SECOND)
    (axis,), told = controller.axes, []
    for seconds in (1, 2, 3601):
        watch(controller, True, NOW, seconds * SECOND)
        told.append(axis.uncertainty.present**2)
    assert told[1] - told[0] == pytest.approx(QUALITY.drift**2)
    assert told[2] - told[0] == pytest.approx(QUALITY.drift**2 * 3600.0)
    # The next sample comes an hour later by its stamp, too: it does not count twice.
    follow(controller, np.array([3602.0]), np.array([5e-6]))
    assert axis.uncertainty.present**2 - told[0] == pytest.approx(QUALITY.drift**2 * 3601.0)


def test_a_quantity_that_comes_makes_it_smaller():
    controller = controller_of(replace(BARE, effects=(SURROUNDINGS,)))
    follow(controller, np.array([1.0]), np.array([5e-6]))
    watch(controller, True, NOW, SECOND)
    unknown = controller.axes[0].uncertainty.present
    for one in SURROUNDINGS.quantities:
        assert controller.surroundings.take(one.key, one.reference, SECOND)
    follow(controller, np.array([1.01]), np.array([5e-6]))
    assert controller.axes[0].uncertainty.present < unknown


def test_a_model_that_does_not_know_it_says_so_and_compensates():
    controller = controller_of(replace(BARE, quality=replace(QUALITY, drift=None)))
    assert "axis 'x'" in (why := watch(controller, True, NOW, SECOND)) and "diagnose again" in why
    assert follow(controller, np.array([1.0, 2.0]), np.array([5e-6, 6e-6])) == [None, None]
