"""What a launch file starts, as real processes: compensator, driver and a simulated device at once.

By launch where it is installed, and else by what the launch file says (`launch_reader`), which starts the same
processes with the same arguments.
"""

import os
import signal
import socket
import subprocess
import sys
from contextlib import ExitStack, contextmanager
from importlib.util import find_spec
from pathlib import Path

import pytest
import yaml

pytest.importorskip("rclpy")

from launch_reader import READY, nodes_of  # noqa: E402
from nodes.ros_helpers import RELIABLE, on_graph, stage_model, started, values_of  # noqa: E402
from sensor_msgs.msg import JointState  # noqa: E402
from std_msgs.msg import Float64MultiArray  # noqa: E402

from slpi_ros.model.document import save_model  # noqa: E402

LAUNCH = Path(__file__).resolve().parents[2] / "launch"
LIMITS = {"voltage_min": 0.0, "voltage_max": 90.0}
BY_LAUNCH = """
import sys
from launch import LaunchDescription, LaunchService
from launch.actions import IncludeLaunchDescription
given = dict(word.split(":=", 1) for word in sys.argv[2:])
service = LaunchService()
service.include_launch_description(
    LaunchDescription([IncludeLaunchDescription(sys.argv[1], launch_arguments=given.items())])
)
sys.exit(service.run())
"""


@contextmanager
def by_reading(path, arguments):
    """Start what the file says; yields what the processes have said."""
    with ExitStack() as life:
        running = {}
        for node in sorted(nodes_of(path, arguments), key=lambda each: each.after):
            if node.after:
                while READY[node.after] not in running[node.after].stderr:
                    assert running[node.after].process.poll() is None, running[node.after].stderr
            running[node.executable] = life.enter_context(started(node.executable, node.parameters, *node.words()))
        yield lambda: "".join(each.stderr for each in running.values())
        for each in running.values():
            assert each.stop(signal.SIGINT) == 0


@contextmanager
def by_launch(path, arguments):
    """Let launch start them, from the installed launch files."""
    words = [f"{name}:={value}" for name, value in arguments.items()]
    log = Path(arguments["driver_file"]).with_name("launch.txt")
    with log.open("w") as output:
        process = subprocess.Popen(
            [sys.executable, "-c", BY_LAUNCH, str(path), *words], stdout=output, stderr=output, start_new_session=True
        )
    try:
        yield log.read_text
        # To the group, as a terminal does; launch leaves that to it.
        os.killpg(process.pid, signal.SIGINT)
        assert process.wait(60.0) == 0
        assert log.read_text().count("process has finished cleanly") == 3
    finally:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()


# ROS 2 from apt has launch; no package of PyPI has it.
WAYS = [by_reading, by_launch] if find_spec("launch_ros") else [by_reading]


@pytest.mark.parametrize("way", WAYS, ids=lambda way: way.__name__)
def test_compensator_driver_and_simulated_device_in_one_launch(tmp_path, way):
    with socket.create_server(("127.0.0.1", 0)) as server:
        address = f"127.0.0.1:{server.getsockname()[1]}"
    file, model = tmp_path / "all.yaml", tmp_path / "model.json"
    place = {"device": "gcs", "address": address}
    given = {
        "device_simulator": {**place, "voltage": 10.0, "noise_rms": 0.0},
        "driver": {**place, **LIMITS, "rate": 100.0, "rearm": True, "hardware_id": stage_model().hardware_id},
        "compensator": {"axes": ["x"], **LIMITS},
    }
    file.write_text(yaml.safe_dump({f"/**/{name}": {"ros__parameters": each} for name, each in given.items()}))
    save_model(stage_model(), model)
    arguments = {"params_file": file, "model_file": model, "driver_file": file, "device_file": file}
    arguments = {name: str(value) for name, value in arguments.items()} | {"namespace": "left"}
    with on_graph() as graph, way(LAUNCH / "compensator.launch.py", arguments) as said:
        states = graph.record(JointState, "/left/stage_state")
        commands = graph.record(Float64MultiArray, "/left/voltage_command")
        desired = graph.node.create_publisher(JointState, "/left/desired_displacement", RELIABLE)
        graph.watch_diagnostics()
        graph.spin_until(lambda: states and desired.get_subscription_count(), "all nodes")
        # Opened without a step: where the device was.
        assert list(states[0].effort) == [10.0]
        armed = graph.wait_for_status("/left/driver: driver", lambda each: values_of(each)["state"] == "armed", "armed")
        assert values_of(armed)["device"] == f"gcs {address}"

        def there():
            desired.publish(JointState(name=["x"], position=[4e-6]))
            told = [*states[-1].effort]
            return commands and told == pytest.approx(list(commands[-1].data), abs=1e-4) and told[0] > 20.0

        graph.spin_until(there, "the voltage of 4 µm at the device")
        assert states[-1].position[0] > states[0].position[0] + 1e-6
        # Ended one after the other, the driver may find its device gone.
        assert "Traceback" not in said()
