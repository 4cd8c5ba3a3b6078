import pytest

from slpi_ros.errors import UsageError
from slpi_ros.simulation.axis import SimulatedAxis
from slpi_ros.simulation.parameters import AxisParameters
from slpi_ros.simulation.stage import Stage


def test_the_first_axis_is_the_stage_of_that_seed_and_the_second_another():
    stage = Stage.random(["x", "y"], seed=3)
    assert stage.axes["x"].parameters == AxisParameters.random(3)
    assert stage.axes["y"].parameters != AxisParameters.random(3)
    assert Stage.random(["x"], seed=3, noise_rms=1e-9).axes["x"].parameters.noise_rms == 1e-9


def test_axes_move_independently_and_in_order():
    stage, alone = Stage.random(["x", "y"], seed=3), SimulatedAxis(AxisParameters.random(3), 3)
    displacements = stage.step(0.0, [60.0, 0.0])
    assert displacements[0] == alone.step(0.0, 60.0)
    assert displacements[1] == pytest.approx(stage.axes["y"].parameters.offset, abs=1e-15)
    assert stage.measure(displacements)[0] == alone.measure(displacements[0])
    assert stage.voltage_range == (-20.0, 120.0)


def test_axes_must_be_there_and_unique():
    with pytest.raises(UsageError):
        Stage({})
    with pytest.raises(UsageError, match=r"\bx\b"):
        Stage.random(["x", "x"], seed=0)
