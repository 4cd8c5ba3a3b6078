"""The memory at the start, over DDS: what is assumed is said once, a reset comes first where wanted."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

rclpy = pytest.importorskip("rclpy")

from lifecycle_msgs.msg import Transition  # noqa: E402
from nodes.compensator_client import Client, compensator  # noqa: E402
from nodes.ros_helpers import stage_model, values_of  # noqa: E402
from rclpy.qos import qos_profile_sensor_data  # noqa: E402
from sensor_msgs.msg import JointState  # noqa: E402
from std_srvs.srv import Trigger  # noqa: E402

from slpi_ros.model.document import save_model  # noqa: E402
from slpi_ros.model.stage_model import StageModel  # noqa: E402


def ended_model() -> StageModel:
    """Return a stage whose record ended within a loop."""
    axis = stage_model().axis("x")
    quality = replace(axis.quality, held_out_rms=8e-9, floor_rms=8e-9)
    end = axis.after(np.array([100.0, 0.0, 80.0, 20.0, 60.0]))
    return StageModel({"x": replace(axis, end=end, quality=quality)}, "stage under test", "")


def measure(client: Client, displacement: float) -> None:
    """Publish a measured displacement (m) from now on: a best-effort reader may miss the first ones."""
    measured = client.graph.publisher(JointState, "/measured_displacement", qos_profile_sensor_data)
    message = JointState(name=["x"], position=[displacement])
    client.graph.node.create_timer(0.01, lambda: measured.publish(message))


@pytest.fixture
def x_file(tmp_path: Path) -> str:
    path = tmp_path / "x.json"
    save_model(ended_model(), path)
    return str(path)


def test_what_is_assumed_is_said_once_and_a_measurement_chooses(x_file):
    model = ended_model().axis("x")
    with compensator(model_file=x_file) as client:
        client.connect()
        _, values = client.report(memory="assumed")
        assert float(values["x.voltage_V"]) == pytest.approx(60.0, abs=1e-4)
        client.graph.spin_until(lambda: "~/reset_memory" in client.node.stderr, "what is assumed")
        # A measurement tells one history from the other; where the amplifier is it does not tell.
        other = model.memory("start")
        measure(client, other.forward(60.0))
        client.graph.spin_until(lambda: "start_memory 'start'" in client.node.stderr, "the other memory")
        _, values = client.report(memory="assumed")
        assert float(values["x.voltage_V"]) == pytest.approx(60.0, abs=1e-4)
        # What comes now is the library's answer from there.
        assert client.ask(["x"], [5e-6]) == pytest.approx([other.inverse(5e-6)], abs=1e-9)
        assert client.node.stderr.count("~/reset_memory") == 1


def test_a_measurement_that_fits_no_memory_is_a_warning(x_file):
    with compensator(model_file=x_file, start_memory="wiped") as client:
        client.connect()
        measure(client, -1.5e-6)
        status = client.graph.wait_for_status(
            f"{client.name}: compensator", lambda status: status.level == b"\1", "the warning"
        )
        assert "~/reset_memory" in status.message
        _, values = client.report(memory="assumed")
        assert values["x.memory_doubt"]


def test_a_reset_comes_before_the_first_command_where_that_is_wanted(x_file):
    # Activated once the client sees all voltages; slow enough for a command that comes during the reset.
    told = {"reset_on_start": True, "reset_rate": 100.0, "reset_cycles": 2, "autostart": False}
    with compensator(model_file=x_file, **told) as client:
        client.connect("unconfigured")
        assert client.change_state(Transition.TRANSITION_CONFIGURE)
        client.connect("inactive")
        assert client.change_state(Transition.TRANSITION_ACTIVATE)
        client.report(memory="resetting")
        client.wish(["x"], [5e-6])
        client.report("the rejection", **{"rejected.resetting": 1})
        client.report(memory="known")
        client.wait_for_rest(60.0)
        assert "the memory is assumed" not in client.node.stderr
        way = np.array(client.answers)[:, 0]
        assert way.max() == pytest.approx(100.0) and way.min() == pytest.approx(0.0, abs=1e-9)
        assert client.ask(["x"], [5e-6])[0] > 0.0


def test_a_reset_at_the_start_that_leaves_the_memory_assumed_is_not_silent(x_file):
    told = {"reset_on_start": True, "reset_rate": 400.0, "reset_cycles": 2, "voltage_min": 20.0, "voltage_max": 80.0}
    with compensator(model_file=x_file, **told) as client:
        client.graph.spin_until(lambda: "~/reset_memory" in client.node.stderr, "the warning")
        status = client.graph.wait_for_status(
            f"{client.name}: compensator", lambda status: values_of(status).get("x.memory_doubt"), "the doubt"
        )
        warned = [line for line in client.node.stderr.splitlines() if "~/reset_memory" in line]
        assert len(warned) == 1 and "WARN" in warned[0] and values_of(status)["x.memory_doubt"] in warned[0]


def test_after_a_reset_the_zero_is_set_and_not_another_reset_advised(x_file, tmp_path):
    memory = tmp_path / "memory.json"
    told = {"reset_on_start": True, "reset_rate": 400.0, "reset_cycles": 2, "memory_file": str(memory)}
    with compensator(model_file=x_file, **told) as client:
        client.connect()
        client.report(memory="known")
        refused = client.graph.call(Trigger, f"{client.name}/set_zero", Trigger.Request())
        assert not refused.success and "no measured_displacement" in refused.message
        client.ask(["x"], [5e-6])
        client.wait_for_rest(client.answers[-1][0])
        measure(client, 5.3e-6)
        status = client.graph.wait_for_status(
            f"{client.name}: compensator", lambda status: "off its model" in status.message, "the moved zero"
        )
        assert "~/set_zero" in status.message and "reset the memory" not in status.message
        assert values_of(status)["x.zero_from"] == "reset"
        answer = client.graph.call(Trigger, f"{client.name}/set_zero", Trigger.Request())
        assert answer.success and "+0.3000" in answer.message
        _, values = client.report(**{"x.zero_from": "sensor"})
        assert float(values["x.zero_moved_nm"]) == pytest.approx(300.0, abs=1.0)
        saved = json.loads(memory.read_text())["axes"]["x"]["zero"]
        assert saved["from"] == "sensor" and saved["offset_m"] == pytest.approx(0.3e-6, abs=1e-9)
