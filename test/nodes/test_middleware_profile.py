"""A node that was killed is forgotten sooner with the profile of ``config/fastdds.xml``."""

import os
import signal
from pathlib import Path

import pytest

rclpy = pytest.importorskip("rclpy")

from nodes.ros_helpers import RELIABLE, on_graph, started  # noqa: E402
from rclpy.event_handler import PublisherEventCallbacks  # noqa: E402
from sensor_msgs.msg import JointState  # noqa: E402

pytestmark = [pytest.mark.ros, pytest.mark.slow]

PROFILE = Path(__file__).resolve().parents[2] / "config" / "fastdds.xml"


def test_a_killed_node_with_the_profile_is_forgotten_first(monkeypatch):
    """Until it is forgotten, others send to it, and its next life waits."""
    if "fastrtps" not in rclpy.get_rmw_implementation_identifier():
        pytest.skip("another middleware")
    gone = []
    with on_graph() as graph:

        def publisher(name):
            def matched(info):
                if info.current_count_change < 0:
                    gone.append(name)

            return graph.node.create_publisher(
                JointState,
                f"/{name}/desired_displacement",
                RELIABLE,
                event_callbacks=PublisherEventCallbacks(matched=matched),
            )

        publishers = {name: publisher(name) for name in ("usual", "profile")}
        with started("compensator", {}, "-r", "__ns:=/usual") as usual:
            monkeypatch.setenv("FASTRTPS_DEFAULT_PROFILES_FILE", str(PROFILE))
            with started("compensator", {}, "-r", "__ns:=/profile") as profile:
                for name, each in publishers.items():
                    graph.spin_until(each.get_subscription_count, f"the node {name}")
                # With equal leases the first one to be killed would be the first one to be forgotten.
                for node in (usual, profile):
                    os.killpg(node.process.pid, signal.SIGKILL)
                    node.wait()
                    graph.spin_for(4.0)
                graph.spin_until(lambda: gone, "the end of the lease")
    assert gone == ["profile"]
