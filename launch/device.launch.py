"""Start the driver of an amplifier, alone or with the simulated device that it is to connect to.

ros2 launch slpi_ros device.launch.py driver_file:=driver.yaml
ros2 launch slpi_ros device.launch.py driver_file:=simulated.yaml device_file:=simulated.yaml

calibrate.launch.py and compensator.launch.py include it, with the same arguments.
"""

from launch.actions import DeclareLaunchArgument, RegisterEventHandler
from launch.conditions import IfCondition, UnlessCondition
from launch.event_handlers import OnProcessIO
from launch.substitutions import EqualsSubstitution, LaunchConfiguration
from launch_ros.actions import Node

from launch import LaunchDescription

# Argument, and topic of the driver that it remaps, with its meaning.
TOPICS = {
    "voltage_topic": ("voltage_command", "topic of the voltage commands"),
    "state_topic": ("stage_state", "topic of the stage state"),
    "diagnostics_topic": ("/diagnostics", "topic of the diagnostics"),
    "voltage_trajectory_topic": ("voltage_trajectory", "topic of whole paths"),
    "trajectory_state_topic": ("voltage_trajectory_state", "topic of what becomes of them"),
    "recorded_topic": ("recorded_trajectory", "topic of what the device recorded of them"),
}
# In what the simulated device logs once it serves: a driver that finds no device ends.
SERVES = b"own range"


def generate_launch_description() -> LaunchDescription:
    alone = EqualsSubstitution(LaunchConfiguration("device_file"), "")
    device = Node(
        package="slpi_ros",
        executable="device_simulator",
        name="device_simulator",
        namespace=LaunchConfiguration("namespace"),
        parameters=[LaunchConfiguration("device_file")],
        output="screen",
        condition=UnlessCondition(alone),
    )
    connected = driver()

    def connect(event) -> Node | None:
        return connected if SERVES in event.text else None

    return LaunchDescription([
        DeclareLaunchArgument("driver_file", description="parameters of the node driver"),
        DeclareLaunchArgument(
            "device_file",
            default_value="",
            description="parameters of the node device_simulator; empty: the device is a real one",
        ),
        DeclareLaunchArgument("namespace", default_value="", description="namespace of the nodes and their topics"),
        *(
            DeclareLaunchArgument(argument, default_value=topic, description=meaning)
            for argument, (topic, meaning) in TOPICS.items()
        ),
        RegisterEventHandler(OnProcessIO(target_action=device, on_stdout=connect, on_stderr=connect)),
        device,
        driver(IfCondition(alone)),
    ])  # fmt: skip


def driver(condition: IfCondition | None = None) -> Node:
    return Node(
        package="slpi_ros",
        executable="driver",
        name="driver",
        namespace=LaunchConfiguration("namespace"),
        parameters=[LaunchConfiguration("driver_file")],
        remappings=[(topic, LaunchConfiguration(argument)) for argument, (topic, _) in TOPICS.items()],
        output="screen",
        condition=condition,
    )
