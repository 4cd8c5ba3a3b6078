"""The stage without dynamics is what it was before it had any: figures elsewhere rest on it."""

import numpy as np
import pytest

from slpi_ros.simulation.axis import SimulatedAxis
from slpi_ros.simulation.parameters import AxisParameters
from slpi_ros.simulation.stage import Stage

# Written down from the stage as it was. The last bits of its sums depend on the processor.
same = {"rtol": 1e-12, "atol": 1e-20}

VOLTAGES = np.array([0.0, 97.3, 12.5, 80.0, 79.9, 3.0, 55.5, -20.0, 120.0, 0.0])
DEFAULT = [
    0.0,
    2.281950645527367e-05,
    4.728710012586276e-06,
    1.7949478230339325e-05,
    1.7937097981249292e-05,
    2.4037494311995074e-06,
    1.1912754003618667e-05,
    -3.379812824184007e-06,
    3.0696050058214103e-05,
    1.7519881469257175e-06,
]
DEFAULT_READ_NM = [-6, 22809, 4727, 17953, 17946, 2405, 11908, -3386, 30702, 1765]
THIRD = [
    -1.361044341451688e-07,
    2.091564809117307e-05,
    4.0301397336294046e-06,
    1.6511496435216867e-05,
    1.649859522833376e-05,
    1.9087824463370568e-06,
    1.0885648337769435e-05,
    -3.2313032538239468e-06,
    2.7778492028042066e-05,
    1.3692456414169497e-06,
]
THIRD_READ_NM = [-120, 20895, 4033, 16507, 16495, 1907, 10869, -3233, 27772, 1396]


@pytest.mark.parametrize(
    ("parameters", "seed", "displacements", "readings"),
    [(None, 5, DEFAULT, DEFAULT_READ_NM), (AxisParameters.random(3), 3, THIRD, THIRD_READ_NM)],
)
def test_displacements_and_readings(parameters, seed, displacements, readings):
    y, measured = SimulatedAxis(parameters, seed).run(np.zeros(VOLTAGES.size), VOLTAGES)
    np.testing.assert_allclose(y, displacements, **same)
    np.testing.assert_allclose(measured, np.array(readings) * 1e-9, **same)


def test_random_draws():
    drawn = AxisParameters.random(3)
    assert drawn == AxisParameters(
        stroke=2.0428245835718124e-05,
        hysteresis=0.13184052532980498,
        width_scale=54.0382339561919,
        width_growth=0.06572962885149425,
        bias_slope=0.5847157780163592,
        bias_bow=-0.05349844781082097,
        curvature=0.04371538944225023,
        stiffening=0.004691543028184291,
        offset=-1.3610443414516858e-07,
    )


def test_a_stage_of_two_axes():
    stage = Stage.random(["x", "y"], 3)
    np.testing.assert_allclose(stage.step(0.0, [60.0, 10.0]), [1.1453238356569886e-05, 1.5582781105628445e-06], **same)
    np.testing.assert_allclose(stage.measure([1e-5, 2e-5]), [1.0016e-05, 1.9992e-05], **same)


def test_time_may_go_back_where_nothing_depends_on_it():
    stage = SimulatedAxis()
    stage.step(5.0, 10.0)
    assert stage.step(1.0, 20.0) > 0
