"""Where the axes are and how uncertain that is, over DDS: published while somebody subscribes."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

rclpy = pytest.importorskip("rclpy")

from nodes.compensator_client import PERIOD_NS, START_NS, compensator  # noqa: E402
from nodes.ros_helpers import stage_model  # noqa: E402
from sensor_msgs.msg import JointState  # noqa: E402

from slpi_ros.model.document import save_model  # noqa: E402
from slpi_ros.model.stage_model import StageModel  # noqa: E402
from slpi_ros.model.uncertainty import REGIONS, AxisUncertainty  # noqa: E402

pytestmark = pytest.mark.long


def model(known: bool) -> StageModel:
    stage = stage_model(("x", "y"))
    told = {"regions": (9e-9,) * REGIONS, "drift": 1e-9, "duration": 30.0, "fastest": 1e4} if known else {}
    axes = {name: replace(axis, quality=replace(axis.quality, **told)) for name, axis in stage.axes.items()}
    return StageModel(axes, stage.hardware_id, "")


def saved(folder: Path, known: bool) -> str:
    save_model(model(known), folder / "model.json")
    return str(folder / "model.json")


def test_it_is_published_while_somebody_subscribes(tmp_path):
    with compensator(model_file=saved(tmp_path, True), axes=["x", "y"]) as client:
        client.connect()
        found = client.graph.record(JointState, "/displacement_uncertainty")
        path = 5e-6 + 2e-6 * np.sin(np.linspace(0.0, 6.0, 200))
        for k, y in enumerate(path.tolist()):
            client.ask(["x", "y"], [y, 4e-6], START_NS + k * PERIOD_NS)
        client.graph.spin_until(
            lambda: found and found[-1].position.tolist() == pytest.approx([path[-1], 4e-6], abs=1e-12),
            "the last place",
        )
        last = found[-1]
        assert last.name == ["x", "y"] and len(last.effort) == 2 and last.header.stamp.sec > 0
        for name, spread in zip(last.name, last.effort, strict=True):
            own = AxisUncertainty(model(True).axis(name), known_memory=True)
            assert spread**2 >= own.within.min() and spread < 1e-6


def test_a_model_that_does_not_know_it_still_compensates(tmp_path):
    with compensator(model_file=saved(tmp_path, False), axes=["x", "y"]) as client:
        client.connect()
        found = client.graph.record(JointState, "/displacement_uncertainty")
        for k in range(100):
            client.ask(["x", "y"], [5e-6, 4e-6], START_NS + k * PERIOD_NS)
        client.report()
        assert found == []
