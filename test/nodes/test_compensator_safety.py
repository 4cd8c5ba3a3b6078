"""A compensator that is left alone, told to end, or told where its memory is: what the voltages do then."""

import hashlib
import signal
import time
from pathlib import Path

import numpy as np
import pytest

rclpy = pytest.importorskip("rclpy")

from builtin_interfaces.msg import Duration  # noqa: E402
from lifecycle_msgs.msg import Transition  # noqa: E402
from nodes.compensator_client import Client, compensator  # noqa: E402
from nodes.ros_helpers import LATCHED, stage_model, started  # noqa: E402
from std_msgs.msg import String  # noqa: E402
from std_srvs.srv import Trigger  # noqa: E402
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint  # noqa: E402

from slpi_ros.model.document import format_model, save_model  # noqa: E402
from slpi_ros.model.limits import MAX_DT, PERIOD  # noqa: E402

RAMP_RATE = 50.0
SAFE = {"safe_voltage": 10, "ramp_rate": RAMP_RATE}
MS = 1_000_000
QUICK_RESET = {"reset_rate": 5000.0, "reset_cycles": 3}


@pytest.fixture
def x_file(tmp_path: Path) -> str:
    path = tmp_path / "x.json"
    save_model(stage_model(), path)
    return str(path)


def reset(client: Client) -> Trigger.Response:
    return client.graph.call(Trigger, f"{client.name}/reset_memory", Trigger.Request())


def voltages(client: Client, start: int = 0) -> np.ndarray:
    return np.array(client.answers[start:])[:, 0]


def test_silence_leads_to_the_safe_voltage_and_the_next_command_takes_over_from_there(x_file):
    with compensator(model_file=x_file, command_timeout=0.2, on_timeout="safe", slew_limit=2000, **SAFE) as client:
        client.connect()
        while (before := client.ask(["x"], [5e-6])[0]) < 40.0:
            pass
        client.wait_for_rest(10.0)
        # What the slew limit held back of the last command has followed before. On a busy machine more than one
        # command is answered by the goal: the ramp begins at the last of the highest voltages.
        way = voltages(client)
        way = way[way.size - 1 - int(np.argmax(way[::-1])) :]
        assert (np.diff(way) < 0).all() and np.abs(np.diff(way)).max() <= 2.0 * RAMP_RATE * PERIOD + 1e-9
        # Timers are late on a busy machine: not every period has its own step.
        assert len(way) > 0.2 * (before - 10.0) / RAMP_RATE / PERIOD
        # A new path starts where the ramp has ended. A voltage that is repeated, so that it is heard, is no answer.
        while (first := client.ask(["x"], [5e-6])[0]) == 10.0:
            pass
        assert 10.0 < first <= 10.0 + 2.0 * 2000 * PERIOD + 1e-9


def test_a_command_ends_a_ramp(x_file):
    told = {"command_timeout": 0.2, "on_timeout": "safe", "safe_voltage": 0.0, "ramp_rate": 1.0}
    with compensator(model_file=x_file, slew_limit=2000.0, **told) as client:
        client.connect()
        for _ in range(3):
            client.ask(["x"], [8e-6])
            time.sleep(0.02)
        client.graph.spin_until(lambda: len(client.answers) > 20, "the ramp")
        before = len(client.answers)
        client.wish(["x"], [8e-6])
        client.report(accepted=4)
        client.graph.spin_until(lambda: client.answers[-1][0] > client.answers[before - 1][0] + 1.0, "the command")
        # From where the ramp was, at the slew limit.
        assert np.abs(np.diff(voltages(client, before - 1))).max() <= 2.0 * 2000.0 * PERIOD + 1e-9


@pytest.mark.parametrize("how", ["deactivate", "signal", "shutdown"])
def test_an_end_leads_to_the_safe_voltage_first(x_file, how):
    with compensator(model_file=x_file, on_deactivate="safe", **SAFE) as client:
        client.connect()
        before = client.ask(["x"], [5e-6])[0]
        if how == "signal":
            assert client.node.stop(signal.SIGTERM) == 0
            client.graph.tested = None
            client.wait_for_rest(10.0)
        else:
            number = Transition.TRANSITION_DEACTIVATE
            number = Transition.TRANSITION_ACTIVE_SHUTDOWN if how == "shutdown" else number
            assert client.change_state(number)
            client.wait_for_rest(10.0)
            for _ in range(3):
                client.report(state="finalized" if how == "shutdown" else "inactive")
            assert "Traceback" not in client.node.stderr
        way = np.array([before, *voltages(client, 1)])
        assert (np.diff(way) <= 0).all() and np.abs(np.diff(way)).max() <= RAMP_RATE * MAX_DT and len(way) > 20


@pytest.mark.parametrize("how", ["deactivate", "signal"])
def test_an_end_in_motion_brakes_where_acceleration_is_limited(x_file, how):
    """What it takes to stop depends on the rate at the end, not on when the voltages come."""
    with compensator(model_file=x_file, slew_limit=200.0, acceleration_limit=1000.0) as client:
        client.connect()
        points = [
            JointTrajectoryPoint(positions=[8e-6], time_from_start=Duration(nanosec=5 * i * MS)) for i in range(190)
        ]
        message = JointTrajectory(joint_names=["x"], points=points)
        client.graph.publisher(JointTrajectory, "/desired_trajectory").publish(message)
        client.graph.spin_until(lambda: client.answers and client.answers[-1][0] > 30.0, "full pace")
        if how == "signal":
            assert client.node.stop(signal.SIGTERM) == 0
            client.graph.tested = None
        else:
            assert client.change_state(Transition.TRANSITION_DEACTIVATE)
            client.report(state="inactive")
        # Voltages may come after the process has ended.
        client.graph.spin_for(0.3)
        way = voltages(client)
        assert (np.diff(way) >= 0.0).all() and np.diff(way).max() <= 2.0 * 200.0 * PERIOD + 1e-9
        # Not at once: it goes on for a while, but not to its goal.
        assert way[-1] < stage_model().axis("x").memory().inverse(8e-6) - 1.0


def test_on_the_way_from_a_limit_nothing_is_out_of_reach(x_file):
    with compensator(model_file=x_file, slew_limit=1000.0) as client:
        client.connect()
        client.follow(["x"], np.full((60, 1), 5e-6))
        _, values = client.report(accepted=60)
        assert values["held_at_limit"] == values["excursions"] == "0" and int(values["slew_limited"]) > 5
        assert "out of reach" not in client.node.stderr


def test_safe_voltages_lie_within_the_limits(x_file):
    with compensator(model_file=x_file, on_timeout="safe") as client:
        client.connect()
        said = client.graph.set_parameters(client.name, safe_voltage=-5.0)
        assert "safe_voltage -5 V is outside" in said
        assert client.graph.set_parameters(client.name, safe_voltage=-5.0, on_timeout="hold") == ""


@pytest.mark.parametrize("executor", ["events", "default"])
def test_a_reset_brings_the_memory_to_a_known_state_and_answers_when_done(x_file, executor):
    with compensator(model_file=x_file, executor=executor, reset_to="safe", **SAFE, **QUICK_RESET) as client:
        client.connect()
        client.ask(["x"], [5e-6])
        _, values = client.report(memory="assumed")
        answer = reset(client)
        assert answer.success and "memory known" in answer.message
        # The answer may overtake the last voltages.
        client.wait_for_rest(10.0)
        # With the voltage before it: a late period may lead to the first turn in one step.
        way = voltages(client, 0)
        assert way[-1] == 10.0 and way.min() == 0.0 and way.max() == 100.0
        turns = way[1:-1][np.diff(way[:-1]) * np.diff(way[1:]) < 0]
        np.testing.assert_allclose(turns, [100, 0, 100, 0, 70, 10 * 2 / 3 / 2, 40, 20 / 3], atol=1e-9)
        status, values = client.report(memory="known")
        assert status.level == b"\0" and "memory known" in status.message
        # What comes later is the library's answer, from a fresh memory driven through the same turns.
        memory = stage_model().axis("x").memory()
        for v in (*turns, 10.0):
            memory.forward(v)
        for y in (3e-6, 7e-6, 4e-6, 9e-6):
            assert client.ask(["x"], [y]) == pytest.approx([memory.inverse(y)], abs=1e-9)


def test_a_reset_rejects_commands_and_is_cut_short_by_the_end_of_activity(x_file):
    with compensator(model_file=x_file, reset_rate=5.0) as client:
        client.connect()
        client.ask(["x"], [5e-6])
        service = client.graph.node.create_client(Trigger, f"{client.name}/reset_memory")
        client.graph.spin_until(service.service_is_ready, "the service")
        answer = service.call_async(Trigger.Request())
        client.report(memory="resetting")
        client.wish(["x"], [5e-6])
        client.report("the rejection", **{"rejected.resetting": 1})
        assert client.change_state(Transition.TRANSITION_DEACTIVATE)
        client.graph.spin_until(answer.done, "the answer")
        assert not answer.result().success and "interrupted" in answer.result().message
        client.report(memory="assumed", state="inactive")
        refused = reset(client)
        assert not refused.success and "not active" in refused.message


def test_the_memory_comes_back_after_a_restart(x_file, tmp_path):
    kept = {"model_file": x_file, "memory_file": str(tmp_path / "memory.json")}
    path = [3e-6, 7e-6, 4e-6, 9e-6, 8e-6]
    memory = stage_model().axis("x").memory()
    for v in (100.0, 0.0, 100.0, 0.0, 200 / 3, 0.0, 100 / 3, 0.0):
        memory.forward(v)
    expected = [memory.inverse(y) for y in path]
    with compensator(**kept, **QUICK_RESET) as client:
        client.connect()
        assert reset(client).success
        for y in path[:3]:
            client.wish(["x"], [y])
        # The last voltages of the reset may come after its answer.
        client.report(accepted=3)
        last = pytest.approx([expected[2]], abs=1e-9)
        client.graph.spin_until(lambda: client.answers[-1] == last, "the last voltage")
        assert client.node.stop() == 0
        client.graph.tested = None
    with compensator(**kept) as client:
        client.connect()
        _, values = client.report(memory="restored")
        assert float(values["x.voltage_V"]) == pytest.approx(expected[2], abs=1e-4)
        assert client.ask(["x"], [path[3]]) == pytest.approx([expected[3]], abs=1e-9)
        client.node.kill()
        client.graph.tested = None
    # Killed, it may have moved on since it was written: what is best known is no more than assumed.
    with compensator(**kept) as client:
        client.connect()
        client.report(memory="assumed")
    # A memory of another model is none.
    save_model(stage_model(stroke=9e-6), x_file)
    with compensator(**kept) as client:
        client.connect()
        _, values = client.report(memory="assumed")
        # But for the voltage that the amplifier still has.
        assert float(values["x.voltage_V"]) == pytest.approx(expected[3], abs=1e-4)
        assert "belongs to another model" in client.node.stderr


def test_a_memory_file_that_cannot_be_used_stops_nothing(x_file, tmp_path):
    (tmp_path / "folder").mkdir()
    with compensator(model_file=x_file, memory_file=str(tmp_path / "folder")) as client:
        client.connect()
        client.report(memory="assumed")
        assert client.ask(["x"], [0.0]) == [0.0]
        assert "no saved memory" in client.node.stderr and "cannot be written" in client.node.stderr


def test_a_model_of_another_stage_is_refused():
    with compensator(hardware_id="this stage") as client:
        client.connect()
        models = client.graph.publisher(String, "/stage_model", LATCHED)
        models.publish(String(data=format_model(stage_model())))
        status, values = client.report(models_refused=1)
        assert all(name in values["last_model_error"] for name in ("'stage under test'", "'this stage'"))
        models.publish(String(data=format_model(stage_model()).replace("stage under test", "this stage")))
        client.report("the model", **{"model.kind": "slpi"})


def test_only_the_approved_model_is_accepted(x_file):
    """Its sum is that of the file; another one is refused, from a file and from the topic."""
    approved = hashlib.sha256(Path(x_file).read_bytes()).hexdigest()
    with compensator(model_file=x_file, model_sha256=approved) as client:
        client.connect()
        _, values = client.report(models_refused=0)
        assert approved.startswith(values["model.id"])
        models = client.graph.publisher(String, "/stage_model", LATCHED)
        models.publish(String(data=format_model(stage_model(stroke=9e-6))))
        _, values = client.report(models_refused=1)
        assert approved.startswith(values["model.id"]) and approved in values["last_model_error"]
    for wrong in ("0" * 64, approved.upper(), "x"):
        with started("compensator", {"model_file": x_file, "model_sha256": wrong}) as node:
            assert node.wait() in (1, 2) and "model_sha256" in node.stderr and "Traceback" not in node.stderr
