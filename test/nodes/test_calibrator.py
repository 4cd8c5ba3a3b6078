"""The calibrator as a process of its own, on a stage in the test that obeys, and then does not."""

import math
import os
import signal
import time
from pathlib import Path

import numpy as np
import pytest

rclpy = pytest.importorskip("rclpy")

from nodes.ros_helpers import LATCHED, RELIABLE, on_graph, started  # noqa: E402
from std_msgs.msg import Float64MultiArray, String  # noqa: E402
from std_srvs.srv import Trigger  # noqa: E402

from benchmarks.faulty_stage import FAULTS, FaultyStage  # noqa: E402
from slpi_ros.errors import UsageError  # noqa: E402
from slpi_ros.io.bag_reader import read_bag  # noqa: E402
from slpi_ros.io.bag_writer import write_bag  # noqa: E402
from slpi_ros.io.record import Record  # noqa: E402
from slpi_ros.io.tables import write_table  # noqa: E402
from slpi_ros.io.unfinished_bags import partial_path  # noqa: E402
from slpi_ros.model.document import parse_model  # noqa: E402
from slpi_ros.nodes.calibration_job import PATH, StageClock  # noqa: E402
from slpi_ros.nodes.calibrator import DECLARATIONS, settings_of  # noqa: E402
from slpi_ros.nodes.parameters import validated  # noqa: E402

LOW, HIGH, SLEW, RATE, REST = -10.0, 90.0, 300.0, 100.0, 5.0
PARAMETERS = {
    "voltage_min": LOW, "voltage_max": HIGH, "slew_limit": SLEW, "rate": RATE, "rest_voltage": REST,
    # The stage shares its process with the test, and the machine with other tests.
    "state_timeout": 1.5,
}  # fmt: skip


def require_safe(stage) -> None:
    """Within the limits, never faster than the slew limit, and at rest at the end."""
    assert not stage.harm(LOW, HIGH, SLEW, RATE, REST)


def begun(graph, node, stage):
    """Wait until the calibration drive is well on its way."""
    checked(graph, node, stage)
    graph.spin_until(lambda: "02_calibration" in node.stderr and max(stage.commands) > 40.0, "the calibration drive")
    count = len(stage.commands)
    graph.spin_until(lambda: len(stage.commands) > count + 20, "more of the drive")


def checked(graph, node, stage):
    """Wait until the first drive, the check, has begun."""
    graph.tested = node
    graph.spin_until(lambda: "01_check" in node.stderr and stage.commands, "the check")
    count = len(stage.commands)
    graph.spin_until(lambda: len(stage.commands) > count + 20, "more of the check")


def ended(graph, node) -> int:
    graph.tested = None
    graph.spin_until(lambda: node.process.poll() is not None, "the end of the node")
    return node.process.returncode


@pytest.mark.ros
@pytest.mark.parametrize("fault", [FAULTS[0], *(pytest.param(fault, marks=pytest.mark.long) for fault in FAULTS[1:])])
def test_a_fault_of_the_stage_ends_in_a_ramp_to_rest(tmp_path, fault):
    with on_graph() as graph, started("calibrator", {**PARAMETERS, "output": str(tmp_path / "out")}) as node:
        stage = FaultyStage(graph.node)
        begun(graph, node, stage)
        stage.fault = fault
        assert ended(graph, node) == 1
        last = node.stderr.strip().splitlines()[-1]
        assert last.startswith("calibrator: ") and "Traceback" not in node.stderr
    require_safe(stage)
    names = {path.name for path in (tmp_path / "out").iterdir()}
    assert names == {"01_check", "interrupted_02_calibration"}
    assert len(read_bag(tmp_path / "out" / "interrupted_02_calibration")) > 100


@pytest.mark.ros
@pytest.mark.parametrize(
    "how", ["signal", *(pytest.param(how, marks=pytest.mark.long) for how in ("stop", "other publisher", "no disk"))]
)
def test_whoever_ends_it_the_stage_comes_to_rest(tmp_path, how):
    with on_graph() as graph, started("calibrator", {**PARAMETERS, "output": str(tmp_path / "out")}) as node:
        stage = FaultyStage(graph.node)
        begun(graph, node, stage)
        if how == "stop":
            assert graph.call(Trigger, "/calibrator/stop", Trigger.Request()).success
        elif how == "signal":
            os.killpg(node.process.pid, signal.SIGTERM)
        elif how == "other publisher":
            graph.node.create_publisher(Float64MultiArray, "voltage_command", RELIABLE)
        else:
            for path in (tmp_path / "out").glob(".*.partial/*"):
                path.rename(path.with_name("elsewhere"))
            assert graph.call(Trigger, "/calibrator/stop", Trigger.Request()).success
        assert ended(graph, node) == 1
        assert node.stderr.strip().splitlines()[-1].startswith("calibrator: ") and "Traceback" not in node.stderr
    require_safe(stage)
    assert (tmp_path / "out" / "01_check").exists()


@pytest.mark.ros
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGHUP])
def test_a_terminal_that_ends_it_hears_where_the_stage_is_left_and_nothing_of_its_worker(tmp_path, number):
    """As from a shell, whose first worker starts also what multiprocessing needs for all."""
    output = {"output": str(tmp_path / "out")}
    with on_graph() as graph, started("calibrator", PARAMETERS | output, fresh=True) as node:
        stage = FaultyStage(graph.node)
        graph.tested = node
        children = Path(f"/proc/{node.process.pid}/task/{node.process.pid}/children")
        # The worker, which still imports, beside the tracker of resources.
        graph.spin_until(lambda: len(children.read_text().split()) > 1, "the worker")
        os.killpg(node.process.pid, number)
        assert ended(graph, node) == 1
        assert "Traceback" not in node.stderr and f"at {REST:g} V" in node.stderr.strip().splitlines()[-1]
    require_safe(stage)


@pytest.mark.ros
@pytest.mark.long
def test_a_killed_calibration_is_resumed_with_the_bags_that_are_complete(tmp_path):
    parameters = {**PARAMETERS, "output": str(tmp_path / "out")}
    with on_graph() as graph:
        stage = FaultyStage(graph.node)
        with started("calibrator", parameters) as node:
            begun(graph, node, stage)
            os.killpg(node.process.pid, signal.SIGKILL)
            node.wait()
        first = read_bag(tmp_path / "out" / "01_check").time_ns
        with started("calibrator", {**parameters, "resume": True}) as node:
            count = len(stage.commands)
            graph.tested = node
            graph.spin_until(lambda: "02_calibration" in node.stderr, "the calibration drive")
            # What comes before is the return to rest.
            graph.spin_until(lambda: REST in stage.commands[count:], "rest")
            graph.spin_until(lambda: abs(stage.commands[-1] - REST) > 1.0, "its voltages")
            os.killpg(node.process.pid, signal.SIGINT)
            assert ended(graph, node) == 1
        require_safe(stage)
    names = {path.name for path in (tmp_path / "out").iterdir()}
    aside = partial_path(tmp_path / "out" / "killed_02_calibration")
    assert names == {"01_check", aside.name, "interrupted_02_calibration"}
    assert np.array_equal(read_bag(tmp_path / "out" / "01_check").time_ns, first)


@pytest.mark.ros
@pytest.mark.long
def test_a_kept_bag_that_is_no_use_is_named(tmp_path):
    parameters = {**PARAMETERS, "output": str(tmp_path / "out")}
    with on_graph() as graph:
        stage = FaultyStage(graph.node)
        with started("calibrator", parameters) as node:
            begun(graph, node, stage)
            os.killpg(node.process.pid, signal.SIGTERM)
            assert ended(graph, node) == 1

        def last_line(**changes) -> str:
            with started("calibrator", {**parameters, "resume": True, **changes}) as node:
                assert ended(graph, node) == 1
                assert "Traceback" not in node.stderr
                return node.stderr.strip().splitlines()[-1]

        said = last_line(voltage_max=40.0)
        assert "01_check" in said and "voltage_max" in said and "limits" in said and "amplifier" not in said
        (bag,) = (tmp_path / "out" / "01_check").glob("*.mcap")
        bag.write_bytes(bag.read_bytes()[:3000])
        assert "01_check" in (said := last_line()) and "rename it" in said
        require_safe(stage)


@pytest.mark.ros
def test_it_pauses_and_goes_on(tmp_path):
    with on_graph() as graph, started("calibrator", {**PARAMETERS, "output": str(tmp_path / "out")}) as node:
        stage = FaultyStage(graph.node)
        checked(graph, node, stage)
        assert graph.call(Trigger, "/calibrator/pause", Trigger.Request()).success
        count = len(stage.commands)
        graph.spin_until(lambda: len(stage.commands) > count + 50, "held voltages")
        assert np.ptp(stage.commands[-30:]) == 0.0
        assert graph.call(Trigger, "/calibrator/start", Trigger.Request()).success
        graph.spin_until(lambda: np.ptp(stage.commands[-30:]) > 1.0, "motion")
        graph.watch_diagnostics()
        graph.wait_for_status("/calibrator: calibrator", lambda status: "recording 0" in status.message, "progress")


@pytest.mark.ros
def test_a_pause_before_the_start_does_not_keep_it_from_starting(tmp_path):
    parameters = {**PARAMETERS, "output": str(tmp_path / "out"), "autostart": False}
    with on_graph() as graph, started("calibrator", parameters) as node:
        stage = FaultyStage(graph.node)
        assert graph.call(Trigger, "/calibrator/pause", Trigger.Request()).success
        assert graph.call(Trigger, "/calibrator/start", Trigger.Request()).success
        checked(graph, node, stage)


@pytest.mark.ros
def test_its_worker_ends_with_it_however_it_ends(tmp_path):
    with on_graph() as graph, started("calibrator", {**PARAMETERS, "output": str(tmp_path / "out")}) as node:
        stage = FaultyStage(graph.node)
        checked(graph, node, stage)
        children = Path(f"/proc/{node.process.pid}/task/{node.process.pid}/children").read_text().split()
        assert children
        os.kill(node.process.pid, signal.SIGKILL)
        node.wait()
        graph.tested = None
        graph.spin_until(lambda: not any(alive(int(pid)) for pid in children), "the end of the worker")


def alive(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] != "Z"
    except OSError:
        return False


@pytest.mark.ros
def test_nothing_moves_while_another_node_publishes_voltages(tmp_path):
    with on_graph() as graph:
        graph.node.create_publisher(Float64MultiArray, "voltage_command", RELIABLE)
        stage = FaultyStage(graph.node)
        with started("calibrator", {**PARAMETERS, "output": str(tmp_path / "out"), "patience": 2.0}) as node:
            assert ended(graph, node) == 1
    assert not stage.commands


@pytest.mark.ros
def test_topics_may_be_remapped_in_a_namespace(tmp_path):
    remapped = [part for name in ("stage_state", "voltage_command") for part in ("-r", f"{name}:=/{name}")]
    arguments = ["-r", "__ns:=/left", *remapped]
    with (
        on_graph() as graph,
        started("calibrator", {**PARAMETERS, "output": str(tmp_path / "out")}, *arguments) as node,
    ):
        stage = FaultyStage(graph.node)
        checked(graph, node, stage)
        assert graph.call(Trigger, "/left/calibrator/stop", Trigger.Request()).success
        assert ended(graph, node) == 1
    require_safe(stage)


def test_the_time_of_a_simulated_stage_goes_on_between_two_messages(monkeypatch):
    steady = [100.0]
    monkeypatch.setattr(time, "monotonic", lambda: steady[0])
    clock = StageClock(5.0)
    for passed, now, seen in [(10.0, 15.0, 15.0), (10.0, 35.0, 25.0), (5.0, 45.0, 45.0), (5.0, 45.0, 55.0)]:
        steady[0] += passed
        assert clock() == pytest.approx(seen)
        clock.set(now)
        assert clock() == pytest.approx(now)
    # It stands: the simulation is paused.
    steady[0] += 50.0
    assert clock() == pytest.approx(45.0)


@pytest.mark.ros
def test_without_a_stage_it_ends(tmp_path):
    with started("calibrator", {**PARAMETERS, "output": str(tmp_path / "out"), "patience": 1.0}) as node:
        assert node.wait() == 1
        assert "stage_state" in node.stderr


@pytest.mark.ros
@pytest.mark.parametrize(
    ("changed", "complaint"),
    [
        ({"voltage_max": math.nan}, "voltage_max"),
        ({"output": ""}, "output"),
        ({"budget": 20.0}, "budget"),
        ({"rest_voltage": 200.0}, "200"),
        ({"rate": 1.0}, "rate"),
    ],
)
def test_parameters_with_which_it_cannot_start(tmp_path, changed, complaint):
    with started("calibrator", {**PARAMETERS, "output": str(tmp_path / "out"), **changed}) as node:
        assert node.wait() == 2
        assert complaint in node.stderr and "Traceback" not in node.stderr


@pytest.mark.ros
def test_a_desired_path_is_sampled_at_the_rate(tmp_path):
    t = np.arange(1001) / 1000.0
    write_table(tmp_path / "path.csv", t, {"x": 1e-6 * np.sin(2 * np.pi * 4.0 * t)}, "m")
    values = {entry.name: entry.default for entry in DECLARATIONS} | {
        "voltage_min": 0.0, "voltage_max": 100.0, "output": "out", "desired_path": str(tmp_path / "path.csv"),
    }  # fmt: skip
    path = settings_of(validated(DECLARATIONS, values)).path["x"]
    assert path == pytest.approx(1e-6 * np.sin(2 * np.pi * 4.0 * np.arange(201) / 200.0), abs=1e-12)
    for wrong in ({"rate": 10.0}, {"axes": ["y"]}):
        with pytest.raises(UsageError, match="desired_path"):
            settings_of(validated(DECLARATIONS, values | wrong))
    # Micrometres, and no time.
    for times, y in ((t, np.sin(t)), (0.0 * t, 1e-6 * t)):
        write_table(tmp_path / "path.csv", times, {"x": y}, "m")
        with pytest.raises(UsageError, match="desired_path"):
            settings_of(validated(DECLARATIONS, values))


def test_a_folder_in_use_is_not_touched(tmp_path):
    (tmp_path / "thesis.txt").write_text("mine")
    with started("calibrator", {**PARAMETERS, "output": str(tmp_path)}) as node:
        assert node.wait() == 2
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.txt"]


@pytest.mark.ros
@pytest.mark.slow
@pytest.mark.long
def test_a_stage_with_a_hidden_cause_calibrates_itself(tmp_path):
    rate = 100.0
    simulated = {"creep": 0.02, "rate": rate, "speed": 4.0}
    parameters = {
        "voltage_min": 0.0, "voltage_max": 100.0, "slew_limit": 1000.0, "rate": rate, "target": 0.1,
        "output": str(tmp_path / "out"), "use_sim_time": True,
    }  # fmt: skip
    with on_graph() as graph, started("stage_simulator", simulated):
        models = graph.record(String, "stage_model", LATCHED)
        with started("calibrator", parameters) as node:
            graph.tested = None
            deadline = time.monotonic() + 600.0
            while node.process.poll() is None and time.monotonic() < deadline:
                graph.spin_for(0.1)
            assert node.process.returncode == 0, node.stderr
            graph.spin_until(lambda: models, "the model")
    out = Path(tmp_path / "out")
    model = parse_model(models[-1].data, "stage_model")
    assert "creep" in [effect.name for effect in model.axes["x"].effects]
    assert parse_model((out / "model.json").read_text(), "model.json").hardware_id.startswith("simulated-0-")
    assert {"report.html", "diagnosis", "01_check", "02_calibration"} <= {path.name for path in out.iterdir()}


@pytest.mark.ros
@pytest.mark.slow
@pytest.mark.long
def test_models_are_verified_on_a_desired_path(tmp_path):
    rate = 100.0
    t = np.arange(int(15 * rate) + 1) / rate
    path = 8e-6 - 4e-6 * np.cos(2.0 * np.pi * 0.5 * t) * np.exp(-t / 20.0)
    write_table(tmp_path / "path.csv", t, {"x": path}, "m")
    parameters = {
        "voltage_min": 0.0, "voltage_max": 100.0, "slew_limit": 1000.0, "rate": rate, "target": 0.1,
        "output": str(tmp_path / "out"), "desired_path": str(tmp_path / "path.csv"), "use_sim_time": True,
    }  # fmt: skip
    simulated = {"rate": rate, "speed": 4.0}
    with started("stage_simulator", simulated), started("calibrator", parameters) as node:
        assert node.process.wait(600.0) == 0, node.stderr
    out = tmp_path / "out"
    verifications = sorted(out.glob("*_verification"))
    assert verifications
    for bag in verifications:
        desired = read_bag(bag, PATH).displacement["x"]
        desired = desired[np.isfinite(desired)]
        # After the way to its begin, the whole path; then at rest at its end.
        assert desired.max() == pytest.approx(path.max(), abs=1e-8) and desired.min() <= path.min() + 1e-8
        assert desired[-1] == pytest.approx(path[-1], abs=1e-9)
    model = parse_model((out / "model.json").read_text(), "model.json").axes["x"]
    assert model.voltage_range == pytest.approx((0.0, 100.0), abs=1.0)
    assert "the desired path" in (out / "report.html").read_text()


@pytest.mark.ros
@pytest.mark.parametrize(("accepted", "code"), [("", 1), ("theirs", None)])
def test_bags_of_another_stage_are_not_gone_on_with(tmp_path, accepted, code):
    t = np.arange(300, dtype=np.int64) * 10_000_000
    kept = Record(t, {"x": np.linspace(0.0, 10.0, t.size)}, {"x": np.linspace(0.0, 1e-6, t.size)}, hardware_id="theirs")
    write_bag(tmp_path / "out" / "09_kept", kept)
    given = {**PARAMETERS, "output": str(tmp_path / "out"), "resume": True, "accept_stage": accepted}
    with on_graph() as graph, started("calibrator", given) as node:
        stage = FaultyStage(graph.node, frame_id="mine")
        if code is None:
            checked(graph, node, stage)
        else:
            assert ended(graph, node) == code
            assert not stage.commands
            assert "'theirs'" in node.stderr and "'mine'" in node.stderr
