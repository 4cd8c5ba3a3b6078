"""Examples of the how-to pages that need a running compensator."""

import subprocess
import sys

import pytest

pytest.importorskip("rclpy")

from documentation.pages import DOCS  # noqa: E402
from nodes.ros_helpers import on_graph, stage_model, started  # noqa: E402
from std_msgs.msg import Float64MultiArray  # noqa: E402
from trajectory_msgs.msg import JointTrajectory  # noqa: E402

from slpi_ros import save_model  # noqa: E402


def test_the_trajectory_example_is_followed(tmp_path):
    model = stage_model(stroke=20e-6)
    save_model(model, tmp_path / "stage.json")
    with on_graph() as graph:
        given = graph.record(Float64MultiArray, "/voltage_command")
        # A subscriber that does not follow, as a recorder.
        sent = graph.record(JointTrajectory, "/desired_trajectory")
        example = subprocess.Popen([sys.executable, DOCS / "examples" / "trajectory.py"], stdout=subprocess.DEVNULL)
        try:
            graph.spin_until(lambda: graph.node.count_publishers("/desired_trajectory"), "the example")
            graph.spin_for(1.0)
            reset = {"model_file": str(tmp_path / "stage.json"), "reset_on_start": True, "reset_cycles": 2}
            with started("compensator", reset) as node:
                graph.tested = node
                graph.spin_until(lambda: given, "the reset")
                assert not sent
                assert example.wait(120) == 0
                begun = len(given)
                # up to 15 um of 20 um and back to 5 um; a busy machine may skip points on the way
                graph.spin_until(lambda: came_back([message.data[0] for message in given[begun:]]), "up and back")
                assert "too fast" not in node.stderr and "rejected" not in node.stderr
        finally:
            example.kill()


def came_back(voltages):
    """Return whether voltages have risen from 0 V over those of 5 um and returned to these."""
    rise = max(voltages, default=0.0) - min(voltages, default=0.0)
    return rise > 40.0 and max(voltages) - voltages[-1] > 0.55 * rise
