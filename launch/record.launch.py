"""Record a calibration bag: the exciter excites the stage, the recorder stores it, and both end together.

ros2 launch slpi_ros record.launch.py params_file:=exciter.yaml bag:=calibration
"""

from launch.actions import DeclareLaunchArgument, EmitEvent, RegisterEventHandler
from launch.event_handlers import OnProcessExit
from launch.events import Shutdown
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue

from launch import LaunchDescription

# Argument, and topic of the nodes that it remaps, with its meaning.
TOPICS = {
    "voltage_topic": ("voltage_command", "topic of the voltage commands"),
    "voltage_trajectory_topic": ("voltage_trajectory", "topic of a whole drive, with output: trajectory"),
    "trajectory_state_topic": ("voltage_trajectory_state", "topic of what becomes of it"),
    "state_topic": ("stage_state", "topic of the stage state"),
}


def generate_launch_description() -> LaunchDescription:
    topics = [(topic, LaunchConfiguration(argument)) for argument, (topic, _) in TOPICS.items()]
    recorder = Node(
        package="slpi_ros",
        executable="recorder",
        namespace=LaunchConfiguration("namespace"),
        parameters=[{"output": ParameterValue(LaunchConfiguration("bag"), value_type=str)}],
        remappings=topics,
        output="screen",
    )
    exciter = Node(
        package="slpi_ros",
        executable="exciter",
        name="exciter",
        namespace=LaunchConfiguration("namespace"),
        parameters=[LaunchConfiguration("params_file")],
        remappings=topics,
        # The return to the initial voltage may exceed the default timeout of launch.
        sigterm_timeout="60",
        sigkill_timeout="60",
        output="screen",
    )
    return LaunchDescription([
        DeclareLaunchArgument("params_file", description="parameters of the exciter: see config/exciter.yaml"),
        DeclareLaunchArgument("bag", description="folder of the bag to create"),
        DeclareLaunchArgument("namespace", default_value="", description="namespace of the nodes and their topics"),
        *(
            DeclareLaunchArgument(argument, default_value=topic, description=meaning)
            for argument, (topic, meaning) in TOPICS.items()
        ),
        recorder,
        exciter,
        RegisterEventHandler(OnProcessExit(target_action=exciter, on_exit=[EmitEvent(event=Shutdown())])),
    ])  # fmt: skip
