"""Recorded quantities over DDS: the compensator finds their types, follows them, and says what is old or outside."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest

rclpy = pytest.importorskip("rclpy")

from geometry_msgs.msg import WrenchStamped  # noqa: E402
from model.test_surroundings import LOAD, WARM  # noqa: E402
from nodes.compensator_client import Client, compensator  # noqa: E402
from nodes.ros_helpers import on_graph, stage_model, started, values_of  # noqa: E402
from rclpy.qos import qos_profile_sensor_data  # noqa: E402
from sensor_msgs.msg import Temperature  # noqa: E402
from std_msgs.msg import Float64  # noqa: E402

from slpi_ros.effects.surroundings import Surroundings  # noqa: E402
from slpi_ros.model.document import save_model  # noqa: E402
from slpi_ros.model.stage_model import StageModel  # noqa: E402
from slpi_ros.nodes.surroundings import assigned  # noqa: E402

QUANTITIES = replace(WARM, sensitivity_gain=0.0), LOAD
KEY = WARM.key


@pytest.fixture
def model_file(tmp_path: Path) -> Iterator[str]:
    axis = replace(stage_model().axis("x"), effects=(Surroundings(QUANTITIES),))
    path = tmp_path / "model.json"
    save_model(StageModel({"x": axis}), path)
    yield str(path)


def tell(client: Client, kind, topic: str, message, period: float = 0.05):
    """Publish a message from now on, and return what ends that."""
    publisher = client.graph.publisher(kind, topic, qos_profile_sensor_data)
    return client.graph.node.create_timer(period, lambda: publisher.publish(message))


def test_the_voltage_follows_and_diagnostics_say_what_is_wrong(model_file):
    with compensator(model_file=model_file) as client:
        client.connect()
        (before,) = client.ask(["x"], [5e-6])
        _, values = client.report()
        assert values[f"{KEY}.value"] == ""
        room = tell(client, Temperature, "/room/temperature", Temperature(temperature=23.0))
        wrench = WrenchStamped()
        wrench.wrench.force.z = 1.0
        tell(client, WrenchStamped, "/load", wrench)
        client.report(**{f"{KEY}.value": "23", f"{LOAD.key}.value": "1"})
        # 2 K expand the stage by 0.8 um, which the voltage takes back.
        (warm,) = client.ask(["x"], [5e-6])
        assert warm < before - 1.0
        # Far outside of the record: the last one stays, and it is said.
        room.destroy()
        room = tell(client, Temperature, "/room/temperature", Temperature(temperature=99.0))
        client.graph.spin_until(lambda: "99" in client.node.stderr, "a refused value")
        status, _ = client.report(**{f"{KEY}.value": "23"})
        room.destroy()

        def is_old(status) -> bool:
            return float(values_of(status)[f"{KEY}.age_s"]) > 2.0 and f"{KEY} is" in status.message

        client.graph.wait_for_status(status.name, is_old, "an old value")
        assert client.ask(["x"], [5e-6]) == pytest.approx([warm], abs=1e-6)


@pytest.mark.long
def test_another_topic_and_type_by_the_parameter(model_file):
    with compensator(model_file=model_file, surroundings=["/lab/number", "/load:force.z"]) as client:
        client.connect()
        tell(client, Float64, "/lab/number", Float64(data=22.0))
        client.report(**{f"{KEY}.value": "22"})


def test_where_quantities_are_found():
    keys = ("/a", "/b:force.z")
    assert assigned(keys, ()) == {"/a": ("/a", ""), "/b:force.z": ("/b", "force.z")}
    assert assigned(keys, ("/c",)) == {"/a": ("/c", ""), "/b:force.z": ("/b", "force.z")}
    assert assigned(keys, ("/a", "/c:force.x")) == {"/a": ("/a", ""), "/b:force.z": ("/c", "force.x")}


@pytest.mark.long
def test_the_simulator_publishes_its_room():
    parameters = {"room_swing": 1.0, "room_rate": 20.0, "temperature_offset": 1e-7, "seed": 5}
    with on_graph() as graph:
        temperatures = graph.record(Temperature, "/room/temperature", qos_profile_sensor_data)
        loads = graph.record(Float64, "/load", qos_profile_sensor_data)
        with started("stage_simulator", parameters):
            graph.spin_until(lambda: len(temperatures) > 3 and len(loads) > 30, "the room")
    assert all(15.0 < each.temperature < 27.0 and each.header.stamp.sec for each in temperatures)
    assert all(-0.1 < each.data < 2.1 for each in loads)
