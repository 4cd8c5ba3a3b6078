"""A drift of a record leaves the zero of the extended model where the stage was at the record's end."""

import numpy as np
import pytest

import slpi_ros
from benchmarks.hidden import hide
from slpi_ros.effects.thermal_drift import ThermalDrift


def test_a_drift_counts_from_its_end():
    drift, end = ThermalDrift((0.0, 10.0, 20.0), (1e-6, 3e-6, 4e-6)).from_end()
    assert end == 4e-6
    assert drift.values == pytest.approx((-3e-6, -1e-6, 0.0), abs=1e-18)


@pytest.mark.slow
def test_the_zero_is_that_of_the_end():
    hidden = hide(7, ["thermal_drift"], base="preisach", axes=1, samples=6_000)
    record, (axis,) = hidden.record, hidden.record.axes
    diagnosis = slpi_ros.diagnose(record, slpi_ros.identify(record))
    model = diagnosis.extended.axes[axis]
    assert [effect.name for effect in model.effects] == ["thermal_drift"]
    error = record.displacement[axis] - model.simulate(record.t, record.voltage[axis])
    last = error[-record.t.size // 20 :]
    # The drift of the last twentieth of the record is left, and nothing before it.
    assert abs(np.mean(last)) < 2.0 * hidden.floor[axis] + np.ptp(error) / 20.0
    assert np.ptp(error) > 5.0 * hidden.floor[axis]
    assert model.initial("end").displacement == pytest.approx(
        model.simulate(record.t, record.voltage[axis])[-1], abs=hidden.floor[axis]
    )
