"""Trajectories over DDS: accepted as a whole, given at their own times, replaced and cancelled."""

import re
import signal
import time
from pathlib import Path

import numpy as np
import pytest

rclpy = pytest.importorskip("rclpy")

from builtin_interfaces.msg import Duration  # noqa: E402
from nodes.compensator_client import SECOND_NS, Client, compensator  # noqa: E402
from nodes.ros_helpers import LATCHED, RELIABLE, stage_model, voltage_path  # noqa: E402
from std_msgs.msg import Float64MultiArray, String  # noqa: E402
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint  # noqa: E402

from slpi_ros.compensator.persistence import model_id  # noqa: E402
from slpi_ros.model.document import format_model, save_model  # noqa: E402
from slpi_ros.model.stage_model import HeldAtLimitWarning  # noqa: E402
from slpi_ros.nodes.common import WARN  # noqa: E402

pytestmark = pytest.mark.filterwarnings(f"ignore::{HeldAtLimitWarning.__module__}.{HeldAtLimitWarning.__name__}")
MS = 1_000_000


@pytest.fixture
def xy_file(tmp_path: Path) -> str:
    path = tmp_path / "xy.json"
    save_model(stage_model(("x", "y")), path)
    return str(path)


def trajectory(names, times_ns, positions, start_ns=0) -> JointTrajectory:
    message = JointTrajectory(joint_names=list(names))
    message.header.stamp.sec, message.header.stamp.nanosec = divmod(start_ns, SECOND_NS)
    for at, row in zip(times_ns, positions, strict=True):
        sec, nanosec = divmod(int(at), SECOND_NS)
        message.points.append(
            JointTrajectoryPoint(positions=list(row), time_from_start=Duration(sec=sec, nanosec=nanosec))
        )
    return message


def settle(client: Client, points: int) -> dict[str, str]:
    """Return the report of the end, once all voltages have come: at least one for each point."""
    _, values = client.report("the end", points_remaining=0, trajectories=1)
    given = points - int(values["points_skipped"])
    client.graph.spin_until(lambda: client.answered >= given, f"{given} points")
    quiet(client)
    return values


def quiet(client: Client) -> None:
    """Wait until no voltage comes any more: those between the points come too, and may come after the report."""
    answered = -1
    while client.answered > answered:
        answered = client.answered
        client.graph.spin_for(0.5)


def sender(client: Client):
    return client.graph.publisher(JointTrajectory, "/desired_trajectory", RELIABLE)


def library(path: np.ndarray, axes=("x", "y")) -> np.ndarray:
    model = stage_model(axes)
    answer = model.compensate(np.arange(len(path)), dict(zip(axes, path.T, strict=True)))
    return np.column_stack([answer[axis] for axis in axes])


def wide_path(samples: int, axes=("x", "y")) -> np.ndarray:
    model = stage_model(axes)
    return np.column_stack(
        [model.axis(a).simulate(np.arange(samples), voltage_path(samples, seed)) for seed, a in enumerate(axes)]
    )


def test_a_trajectory_is_given_point_by_point_at_its_times(xy_file):
    # Up, a rest, and down: a machine too busy for every deadline loses points, but no turn.
    legs = np.concatenate([np.linspace(0.0, 9e-6, 120), np.full(60, 9e-6), np.linspace(9e-6, 4e-6, 120)])
    path, times = np.column_stack([legs, 0.8 * legs]), np.arange(300) * 4 * MS
    with compensator(axes=["x", "y"], model_file=xy_file) as client:
        client.connect()
        came = []
        client.graph.node.create_subscription(
            Float64MultiArray, "/voltage_command", lambda _: came.append(time.monotonic()), RELIABLE
        )
        sender(client).publish(trajectory(["y", "x"], times, path[:, ::-1]))
        client.graph.spin_until(lambda: client.answered >= 1, "the first point")
        client.wish(["x"], [1e-6])
        values = settle(client, 300)
        # Between the points the displacement is interpolated once a millisecond.
        fine = np.arange(299 * 4 + 1)
        expected = library(np.column_stack([np.interp(fine, 4 * np.arange(300), each) for each in path.T]))
        places = [int(np.abs(expected - answer).sum(axis=1).argmin()) for answer in client.answers]
        assert np.array(client.answers) == pytest.approx(expected[places], abs=1e-8)
        x = np.array(client.answers)[:, 0]
        top = int(x.argmax())
        assert (np.diff(x[: top + 1]) >= -1e-8).all() and (np.diff(x[top:]) <= 1e-8).all()
        assert client.answers[-1] == pytest.approx(expected[-1].tolist(), abs=1e-8)
        assert values["rejected.following"] == "1"
        # Each report tells of the points since the one before, of which there may be none.
        late = [float(report["deadline_error_p50_us"] or "nan") for report in client.reports]
        assert np.nanmin(late) >= 0.0
        # Not before its time: the last point comes 299 intervals after the first, at most one late start earlier.
        assert came[-1] - came[0] > 0.5 * 299 * 4e-3
        # Afterwards wishes count again, from where it ended.
        assert client.ask(["x"], [path[-1, 0]])[0] == pytest.approx(expected[-1, 0], abs=1e-8)
        client.report(accepted=1)


def test_cancel_replace_append_and_refuse(xy_file):
    long = np.full((2000, 1), 3e-6)
    with compensator(axes=["x", "y"], model_file=xy_file) as client:
        client.connect()
        publisher = sender(client)
        publisher.publish(trajectory(["x"], np.arange(2000) * 5 * MS, long))
        client.graph.spin_until(lambda: client.answered >= 3, "the first points")
        # Refused ones change nothing.
        for names, times, rows in (
            (["z"], [0], [[1e-6]]), (["x"], [0, 0], [[1e-6]] * 2), (["x"], [0], [[1.0]]), (["x"], [0], [[1e-6, 2e-6]]),
            (["x"], [0], [[np.nan]]), (["x", "x"], [0], [[1e-6] * 2]),
        ):  # fmt: skip
            publisher.publish(trajectory(names, times, rows))
        publisher.publish(b"\0\1\0\0 no trajectory")
        past = client.graph.node.get_clock().now().nanoseconds - 5 * SECOND_NS
        publisher.publish(trajectory(["x"], [0], [[1e-6]], past))
        _, values = client.report(trajectories_rejected=8)
        assert int(values["points_remaining"]) > 1000
        # Appended: what comes before its time goes on, then it takes over.
        start = client.graph.node.get_clock().now().nanoseconds + SECOND_NS // 2
        publisher.publish(trajectory(["y"], [0, 100 * MS], [[4e-6], [5e-6]], start))
        _, values = client.report(trajectories=10)
        assert 2 < int(values["points_remaining"]) < 500
        client.graph.spin_until(lambda: client.answers[-1][1] > 0, "the appended one")
        client.report(points_remaining=0)
        quiet(client)
        assert client.answers[-1] == pytest.approx(library(np.array([[3e-6, 4e-6], [3e-6, 5e-6]]))[-1], abs=1e-8)
        # Replaced at once, and cancelled by an empty one.
        publisher.publish(trajectory(["x"], np.arange(2000) * 5 * MS, long))
        client.report(trajectories=11)
        publisher.publish(trajectory(["x"], np.arange(2000) * 5 * MS, long + 1e-6))
        client.report(trajectories=12)
        client.graph.spin_until(lambda: client.answers[-1][0] > client.answers[3][0] + 1.0, "the other path")
        publisher.publish(JointTrajectory())
        _, values = client.report(points_remaining=0, trajectories=13)
        quiet(client)
        held = client.answered
        assert client.ask(["x"], [4e-6])[0] == pytest.approx(client.answers[held - 1][0], abs=1e-8)
        assert client.answered == held + 1


def test_a_trajectory_keeps_to_the_slew_limit_and_survives_new_limits_and_a_new_model(xy_file):
    path, times = wide_path(400), np.arange(400) * 2 * MS
    with compensator(axes=["x", "y"], model_file=xy_file, slew_limit=2000.0) as client:
        client.connect()
        models = client.graph.publisher(String, "/stage_model", LATCHED)
        sender(client).publish(trajectory(["x", "y"], times, path))
        client.graph.spin_until(lambda: client.answered >= 20, "the first points")
        assert client.graph.set_parameters(client.name, slew_limit=1500.0) == ""
        models.publish(String(data=format_model(stage_model(("x", "y"), stroke=9.5e-6))))
        values = settle(client, 400)
        v = np.vstack([[0.0, 0.0], client.answers])
    assert values["models_refused"] == "0" and values["last_rejection"] == ""
    assert v.min() >= 0.0 and v.max() <= 100.0
    # In one step two output periods at most.
    assert np.abs(np.diff(v, axis=0)).max() <= 2.0 * 2000.0 / 1000 + 1e-9


def test_a_trajectory_that_waits_is_given_with_the_model_that_came_meanwhile(xy_file):
    other = stage_model(("x", "y"), stroke=14e-6)
    path = np.linspace(1e-6, 5e-6, 20)
    with compensator(axes=["x", "y"], model_file=xy_file) as client:
        client.connect()
        models = client.graph.publisher(String, "/stage_model", LATCHED)
        # Its way begins at its start, which comes after the model.
        start = client.graph.node.get_clock().now().nanoseconds + 4 * SECOND_NS
        sender(client).publish(trajectory(["x"], 20 * MS + np.arange(20) * 20 * MS, path[:, None], start))
        client.report(trajectories=1, points_remaining=20)
        models.publish(String(data=format_model(other)))
        client.report(**{"model.id": model_id(other)[:12], "points_remaining": 20})
        settle(client, 20)
        x = [answer[0] for answer in client.answers]
        expected = other.compensate(np.arange(20), {"x": path, "y": np.zeros(20)})["x"]
        # Interpolated on the way, which has no turns; a busy machine may lose points.
        assert (np.diff(x) >= -1e-8).all() and x[-1] == pytest.approx(expected[-1], abs=1e-8)
        reached = [np.abs(np.array(x) - v).min() < 1e-8 for v in expected]
        assert sum(reached) >= 20 - int(client.reports[-1]["points_skipped"])
        assert client.ask(["x"], [path[-1]])[0] == pytest.approx(x[-1], abs=1e-8)


def test_skipped_points_are_told_with_their_reason(xy_file):
    with compensator(axes=["x", "y"], model_file=xy_file) as client:
        client.connect()
        publisher = sender(client)
        publisher.publish(trajectory(["x"], 20 * MS + np.arange(2000) * MS // 100, np.full((2000, 1), 1e-6)))
        status, values = client.report(trajectories=1, points_remaining=0)
        assert status.level == WARN and int(values["points_skipped"]) > 0
        assert "output period of 1 ms" in status.message
        # Of the points in this reporting period: an earlier report may have told the others.
        told = int(re.match(r"(\d+) points? of a trajectory", status.message)[1])
        assert told in {
            int(values["points_skipped"]) - int(each["points_skipped"] or 0) for each in client.reports[:-1]
        }
        # Told once: a later report has nothing new.
        client.graph.wait_for_status(status.name, lambda later: "skipped" not in later.message, "a report without")
        publisher.publish(trajectory(["x"], np.arange(200) * 5 * MS, np.full((200, 1), 2e-6)))
        client.graph.spin_until(lambda: client.answers[-1][0] > 15.0, "the second trajectory")
        client.node.process.send_signal(signal.SIGSTOP)
        time.sleep(0.1)
        client.node.process.send_signal(signal.SIGCONT)
        client.graph.wait_for_status(status.name, lambda later: "computer was busy" in later.message, "the reason")
        client.report(trajectories=2, points_remaining=0)
        # Between points that are far apart samples are missed, and no points.
        publisher.publish(trajectory(["x"], np.array([0, 2000]) * MS, np.array([[2e-6], [4e-6]])))
        client.graph.spin_until(lambda: client.answers[-1][0] > 25.0, "the third trajectory")
        client.node.process.send_signal(signal.SIGSTOP)
        time.sleep(0.1)
        client.node.process.send_signal(signal.SIGCONT)
        client.graph.wait_for_status(
            status.name, lambda later: " ms late" in later.message and "skipped" not in later.message, "the delay"
        )
        assert "output period" in client.node.stderr


def test_a_cancelled_trajectory_brakes(xy_file):
    """What it takes to stop depends on the rate at the end, not on when the voltages come."""
    limits = {"slew_limit": 200.0, "acceleration_limit": 1000.0}
    with compensator(axes=["x", "y"], model_file=xy_file, **limits) as client:
        client.connect()
        publisher = sender(client)
        publisher.publish(trajectory(["x"], np.arange(2000) * 5 * MS, np.full((2000, 1), 8e-6)))
        client.graph.spin_until(lambda: client.answers and client.answers[-1][0] > 30.0, "full pace")
        publisher.publish(JointTrajectory())
        client.report(points_remaining=0)
        told = len(client.reports)
        client.graph.spin_until(lambda: len(client.reports) > told + 5, "rest")
        v = np.array(client.answers)[:, 0]
        assert (np.diff(v) >= 0.0).all() and np.diff(v).max() <= 2.0 * 200.0 / 1000 + 1e-9
        # It goes on for a while, but not to its goal.
        assert 30.0 < v[-1] < stage_model().axis("x").memory().inverse(8e-6) - 1.0


def test_points_that_come_too_fast_hold_up_no_report(xy_file):
    path = np.column_stack([4e-6 + 3e-6 * np.sin(np.arange(30_000) / 3000.0)] * 2)
    with compensator(axes=["x", "y"], model_file=xy_file, diagnostic_period=3.0) as client:
        client.connect()
        sender(client).publish(trajectory(["x", "y"], np.arange(len(path)) * 50_000, path))
        client.report("the end", points_remaining=0, trajectories=1)
        before = len(client.reports)
        client.graph.spin_until(lambda: len(client.reports) > before, "a report")
