"""Tracking error of an axis: measured - desired, over a window."""

from math import isnan

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from strategies import two_axes

from slpi_ros.compensator.controller import Controller
from slpi_ros.compensator.statistics import TRACKED, TrackingStatistics
from slpi_ros.model.limits import Limits

MS = 1_000_000


@given(st.lists(st.tuples(st.none() | st.floats(-1e-5, 1e-5), st.floats(-1e-5, 1e-5)), max_size=20), st.integers(1, 60))
def test_the_statistics_are_those_of_the_last_measurements_with_a_setpoint(pairs, repeats):
    tracking, errors = TrackingStatistics(), []
    for desired, measured in pairs * repeats:
        tracking.desired = desired
        tracking.measure(measured)
        if desired is not None:
            errors.append(measured - desired)
    assert tracking.fresh == bool(errors)
    report = tracking.report()
    assert not tracking.fresh
    if not errors:
        assert all(map(isnan, (report.latest, report.mean, report.rms, report.maximum)))
        return
    last = np.array(errors[-TRACKED:])
    assert report.latest == last[-1]
    assert report.mean == pytest.approx(last.mean(), rel=1e-9, abs=1e-20)
    assert report.rms == pytest.approx(np.sqrt(np.mean(last**2)), rel=1e-9)
    assert report.maximum == np.abs(last).max()


def test_an_axis_on_a_ramp_or_in_a_reset_has_no_setpoint():
    made = Controller(["x"], [Limits(0.0, 100.0)])
    made.activate(0)
    made.use_model(two_axes())
    (axis,) = made.axes
    made.measure(["x"], [2e-6], 0)
    assert not axis.tracking.fresh
    made.update(1, ["x"], [1e-6], MS)
    made.measure(["x"], [1.1e-6], 2 * MS)
    assert axis.tracking.report().latest == pytest.approx(1e-7)
    for start in (
        lambda: made.ramp([20.0], 1000.0, 10 * MS),
        lambda: made.reset_memory(2, 1000.0, [0.0], 10 * MS),
    ):
        start()
        made.measure(["x"], [3e-6], 11 * MS)
        assert not axis.tracking.fresh
