"""The recorder as a process of its own, over DDS."""

import os
import signal
import time
from collections.abc import Callable

import pytest

rclpy = pytest.importorskip("rclpy")

from mcap.reader import make_reader  # noqa: E402
from mcap_ros2.decoder import DecoderFactory  # noqa: E402
from nodes.ros_helpers import PATIENCE_S, NodeProcess  # noqa: E402
from rclpy.context import Context  # noqa: E402
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy, qos_profile_sensor_data  # noqa: E402
from refusals import holds  # noqa: E402
from sensor_msgs.msg import JointState  # noqa: E402
from std_msgs.msg import Float64, String  # noqa: E402

from slpi_ros.io.bag_reader import read_bag  # noqa: E402

RELIABLE = QoSProfile(depth=1000, reliability=ReliabilityPolicy.RELIABLE)
LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)


class Recording:
    """A recorder process."""

    def __init__(self, *arguments: str, **parameters) -> None:
        given = [part for name, value in parameters.items() for part in ("-p", f"{name}:={value}")]
        self.node = NodeProcess("recorder", {}, [*given, *arguments])

    def wait_until(self, done: Callable[[], bool]) -> None:
        deadline = time.monotonic() + PATIENCE_S
        while not done():
            assert self.node.process.poll() is None, self.node.stderr
            assert time.monotonic() < deadline
            time.sleep(0.01)

    def end(self, number: signal.Signals | None = None) -> tuple[int, str]:
        """Send a signal, if any; return exit code and what was said."""
        if number is not None:
            self.node.process.send_signal(number)
        code, errors = self.node.wait(), self.node.stderr
        assert "Traceback" not in errors
        return code, errors


@pytest.fixture
def record():
    """Return a function that starts recorders, none of which outlives the test."""
    started = []

    def start(*arguments, **parameters) -> Recording:
        started.append(Recording(*arguments, **parameters))
        return started[-1]

    yield start
    for recording in started:
        recording.node.kill()


@pytest.fixture
def node():
    context = Context()
    context.init()
    node = rclpy.create_node("stage", context=context)
    yield node
    node.destroy_node()
    context.try_shutdown()


def state(row: int) -> JointState:
    message = JointState(name=["x", "y"], position=[row * 1e-9, 0.5], effort=[row * 0.25, -1.0])
    message.header.frame_id = "stage-7"
    message.header.stamp.sec, message.header.stamp.nanosec = 100 + row, 7
    return message


def feed(recording: Recording, publisher, messages: int) -> None:
    """Publish numbered states once the recorder listens; return when the last one has reached its process."""
    recording.wait_until(lambda: publisher.get_subscription_count() > 0)
    for row in range(messages):
        publisher.publish(state(row))
    assert publisher.wait_for_all_acked(rclpy.duration.Duration(seconds=PATIENCE_S))


@pytest.mark.parametrize(
    ("storage", "number"), [("mcap", signal.SIGINT), ("sqlite3", signal.SIGTERM), ("mcap", signal.SIGHUP)]
)
def test_records_until_a_signal(tmp_path, node, record, storage, number):
    publisher = node.create_publisher(JointState, "stage_state", RELIABLE)
    recording = record(output=tmp_path / "bag", storage=storage)
    feed(recording, publisher, 900)
    assert os.listdir(tmp_path) == [".bag.partial"]
    code, said = recording.end(number)
    assert code == 0
    assert holds(said, 900, tmp_path / "bag")
    assert os.listdir(tmp_path) == ["bag"]
    read = read_bag(tmp_path / "bag")
    assert (read.axes, read.hardware_id) == (("x", "y"), "stage-7")
    assert read.time_ns.tolist() == [(100 + row) * 10**9 + 7 for row in range(900)]
    assert read.displacement["x"].tolist() == [row * 1e-9 for row in range(900)]
    assert read.voltage["x"].tolist() == [row * 0.25 for row in range(900)]
    assert set(read.voltage["y"]) == {-1.0}


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_killed_at_any_moment_it_loses_its_last_second_at_most(tmp_path, node, record, storage):
    publisher = node.create_publisher(JointState, "stage_state", RELIABLE)
    recording = record(output=tmp_path / "bag", storage=storage)
    feed(recording, publisher, 1000)
    # More than the file has without messages, and less than these have.
    written = tmp_path / ".bag.partial" / "bag" / f"bag.{'mcap' if storage == 'mcap' else 'db3'}"
    recording.wait_until(lambda: written.stat().st_size > 100_000)
    for row in range(1000, 1100):
        publisher.publish(state(row))
    recording.node.process.kill()
    assert recording.node.wait() == -signal.SIGKILL
    read = read_bag(tmp_path / "bag")
    assert 500 < len(read) <= 1100
    assert read.displacement["x"].tolist() == [row * 1e-9 for row in range(len(read))]
    assert read.notes


def test_several_topics_each_as_it_is_published(tmp_path, node, record):
    latched = node.create_publisher(String, "/lab/stage_model", LATCHED)
    latched.publish(String(data="latched before"))
    states = node.create_publisher(JointState, "/lab/state", qos_profile_sensor_data)
    names = "[stage_state, stage_model, temperature]"
    recording = record("-r", "__ns:=/lab", "-r", "stage_state:=state", output=tmp_path / "bag", topics=names)
    recording.wait_until(lambda: states.get_subscription_count() > 0)
    late = node.create_publisher(Float64, "/lab/temperature", RELIABLE)
    recording.wait_until(lambda: late.get_subscription_count() and latched.get_subscription_count())
    late.publish(Float64(data=21.5))
    assert all(reliable.wait_for_all_acked(rclpy.duration.Duration(seconds=PATIENCE_S)) for reliable in (late, latched))
    # a recorder that insisted on reliable messages would get none of these, and rclpy says so while it does
    for row in range(50):
        states.publish(state(row))
        time.sleep(0.02)
    code, said = recording.end(signal.SIGINT)
    assert code == 0 and "No messages" not in said
    assert 0 < len(read_bag(tmp_path / "bag", "/lab/state")) <= 50
    with (tmp_path / "bag" / "bag.mcap").open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        rows = [(channel.topic, message) for _, channel, _, message in reader.iter_decoded_messages()]
    assert [message.data for topic, message in rows if topic == "/lab/stage_model"] == ["latched before"]
    assert [message.data for topic, message in rows if topic == "/lab/temperature"] == [21.5]


def test_a_further_publisher_of_another_quality_is_recorded_too(tmp_path, node, record):
    first = node.create_publisher(JointState, "stage_state", RELIABLE)
    recording = record(output=tmp_path / "bag")
    feed(recording, first, 100)
    second = node.create_publisher(JointState, "stage_state", qos_profile_sensor_data)
    recording.wait_until(lambda: second.get_subscription_count() > 0)
    for row in range(100, 150):
        second.publish(state(row))
        time.sleep(0.02)
    assert recording.end(signal.SIGINT)[0] == 0
    read = read_bag(tmp_path / "bag")
    assert read.displacement["x"][:100].tolist() == [row * 1e-9 for row in range(100)]
    assert len(read) > 100
    assert "No messages" not in recording.node.stderr


def test_a_simulated_clock_that_nobody_publishes_is_told(tmp_path, node, record):
    publisher = node.create_publisher(JointState, "stage_state", RELIABLE)
    recording = record(output=tmp_path / "bag", use_sim_time="true")
    feed(recording, publisher, 10)
    code, said = recording.end(signal.SIGINT)
    assert code == 0 and holds(said, "use_sim_time", "/clock")
    assert len(read_bag(tmp_path / "bag")) == 10


def test_the_home_folder_is_put_in_for_its_sign(tmp_path, node, record, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path))
    publisher = node.create_publisher(JointState, "stage_state", RELIABLE)
    recording = record(output="~/bag")
    feed(recording, publisher, 10)
    assert recording.end(signal.SIGINT)[0] == 0
    assert len(read_bag(tmp_path / "bag")) == 10


def test_duration(tmp_path, node, record):
    publisher = node.create_publisher(JointState, "stage_state", RELIABLE)
    recording = record(output=tmp_path / "bag", duration=1)
    feed(recording, publisher, 10)
    assert recording.end()[0] == 0
    assert len(read_bag(tmp_path / "bag")) == 10


def test_nothing_came(tmp_path, record):
    code, said = record(output=tmp_path / "bag", duration=0.1).end()
    assert code == 1
    assert holds(said.splitlines()[-1], tmp_path / "bag", "topics")
    assert os.listdir(tmp_path) == []


def test_topic_of_another_type(tmp_path, node, record):
    node.create_publisher(Float64, "stage_state", RELIABLE)
    code, said = record(output=tmp_path / "bag").end()
    assert code == 1
    assert holds(said.splitlines()[-1], "/stage_state", "sensor_msgs/msg/JointState", "std_msgs/msg/Float64")
    assert os.listdir(tmp_path) == []


def test_bag_exists(tmp_path, node, record):
    publisher = node.create_publisher(JointState, "stage_state", RELIABLE)
    recording = record(output=tmp_path / "bag")
    feed(recording, publisher, 3)
    assert holds(record(output=tmp_path / "bag").end()[1], tmp_path / ".bag.partial")
    recording.end(signal.SIGINT)
    read = read_bag(tmp_path / "bag")
    code, said = record(output=tmp_path / "bag").end()
    assert code == 1 and said.startswith(f"{tmp_path / 'bag'}: ") and len(said.splitlines()) == 1
    assert len(read) == len(read_bag(tmp_path / "bag")) == 3


def test_place_taken_while_recording(tmp_path, node, record):
    publisher = node.create_publisher(JointState, "stage_state", RELIABLE)
    recording = record(output=tmp_path / "bag")
    feed(recording, publisher, 3)
    (tmp_path / "bag").write_text("somebody else's")
    code, said = recording.end(signal.SIGINT)
    assert code == 1
    assert holds(said.splitlines()[-1], tmp_path / ".bag.partial")
    assert (tmp_path / "bag").read_text() == "somebody else's"
    assert len(read_bag(tmp_path / ".bag.partial" / "bag")) == 3


@pytest.mark.parametrize(
    ("parameters", "code", "says"),
    [
        ({}, 2, "output"),
        ({"output": "bag", "storage": "zip"}, 2, "'zip'"),
        ({"output": "bag", "duration": "-1.0"}, 2, "duration"),
        ({"output": "bag", "duration": "soon"}, 2, "'soon'"),
        ({"output": "bag", "topics": "one"}, 2, "topics"),
        ({"output": "bag", "topics": "['a b']"}, 2, "topic name"),
        ({"output": "/proc/no/bag"}, 1, "/proc/no/bag"),
    ],
)
def test_parameters_that_make_no_recording(tmp_path, record, parameters, code, says):
    if parameters.get("output") == "bag":
        parameters = {**parameters, "output": tmp_path / "bag"}
    exit_code, said = record(**parameters).end()
    assert exit_code == code
    assert says in said.splitlines()[-1]
    assert os.listdir(tmp_path) == []
