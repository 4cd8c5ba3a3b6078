"""A compensator that is killed, and its next life."""

import signal
from pathlib import Path

import numpy as np
import pytest

rclpy = pytest.importorskip("rclpy")

from nodes.compensator_client import Client, compensator  # noqa: E402
from nodes.ros_helpers import RELIABLE, stage_model  # noqa: E402
from nodes.test_compensator_trajectory import trajectory  # noqa: E402
from std_srvs.srv import Trigger  # noqa: E402
from trajectory_msgs.msg import JointTrajectory  # noqa: E402

from slpi_ros.model.document import save_model  # noqa: E402

AXES = ["x", "y"]
MS = 1_000_000


@pytest.fixture
def kept(tmp_path: Path) -> dict[str, object]:
    """Parameters of a life that saves seldom: what comes between counts."""
    save_model(stage_model(AXES), tmp_path / "xy.json")
    files = {"model_file": str(tmp_path / "xy.json"), "memory_file": str(tmp_path / "memory.json")}
    return {"axes": AXES, **files, "diagnostic_period": 2.0}


def kill(client: Client) -> list[float]:
    """Kill it in the midst; return the voltages that came last."""
    client.node.stop(signal.SIGKILL)
    client.graph.tested = None
    counts: list[int] = []

    def nothing_comes() -> bool:
        counts.append(client.answered)
        return counts[-20:] == [client.answered] * 20

    client.graph.spin_until(nothing_comes, "all that it has sent")
    return client.answers[-1]


def test_the_next_life_starts_from_the_voltages_given_last(kept):
    with compensator(**kept) as client:
        client.connect()
        for share in np.linspace(0.1, 0.9, 30):
            client.ask(["y", "x"], [share * 5e-6, share * 9e-6])
        given = client.answers[-2:]
        kill(client)
    assert given[0][0] > 70.0 and given[0][1] > 30.0
    with compensator(**kept) as client:
        client.connect()
        status, values = client.report(memory="assumed")
        assert "restored from before a crash" in status.message
        assert "reversals may be missing" in values["x.memory_doubt"]
        # What has just been given may not be noted yet.
        found = [float(values[f"{axis}.voltage_V"]) for axis in AXES]
        assert any(found == pytest.approx(each, abs=1e-4) for each in given)
        assert client.graph.set_parameters(client.name, slew_limit=1.0) == ""
        # Two output periods of 1 V/s.
        assert client.ask(AXES, [0.0, 0.0]) == pytest.approx(found, abs=2.1e-3)
        assert client.node.stop() == 0
    # An orderly end needs no notes beside the memory.
    assert [path.name for path in Path(str(kept["memory_file"])).parent.glob("memory*")] == ["memory.json"]


def test_points_of_trajectories_and_voltages_of_a_reset_are_noted_too(kept):
    with compensator(**kept, reset_rate=20.0) as client:
        client.connect()
        path = np.linspace(0.0, 9e-6, 1000)[:, None]
        client.graph.publisher(JointTrajectory, "/desired_trajectory", RELIABLE).publish(
            trajectory(["x"], np.arange(1000) * 10 * MS, path)
        )
        client.graph.spin_until(lambda: client.answers and client.answers[-1][0] > 3.0, "the trajectory")
        last = kill(client)[0]
    with compensator(**kept, reset_rate=20.0) as client:
        client.connect()
        _, values = client.report(memory="assumed")
        # 0.1 V between two points.
        assert float(values["x.voltage_V"]) == pytest.approx(last, abs=0.3)
        service = client.graph.node.create_client(Trigger, f"{client.name}/reset_memory")
        client.graph.spin_until(service.service_is_ready, "the service")
        service.call_async(Trigger.Request())
        client.graph.spin_until(lambda: client.answers and client.answers[-1][0] > last + 5.0, "the reset")
        last = kill(client)[0]
    with compensator(**kept) as client:
        client.connect()
        _, values = client.report(memory="assumed")
        assert float(values["x.voltage_V"]) == pytest.approx(last, abs=20.0 * 0.1)


def test_a_reset_within_narrow_limits_says_that_it_knows_no_more(kept):
    with compensator(**kept, voltage_min=20.0, voltage_max=40.0, reset_rate=5000.0, reset_cycles=1) as client:
        client.connect()
        client.ask(["x"], [3e-6])
        answer = client.graph.call(Trigger, f"{client.name}/reset_memory", Trigger.Request())
        assert not answer.success and "memory assumed" in answer.message and "\n" not in answer.message
        assert "axis 'x': reset from 20 to 40 V only" in answer.message and "0 to 100 V" in answer.message
        status, values = client.report("the end", **{"state": "active", "memory": "assumed"})
        client.graph.wait_for_status(f"{client.name}: compensator", lambda s: "reset from 20 to 40" in s.message, "why")
