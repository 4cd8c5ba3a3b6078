"""A calibration record: the exciter drives the stage, the recorder keeps what it does, and both end together.

ros2 launch slpi_ros calibrate.launch.py params_file:=exciter.yaml bag:=calibration
"""

from launch.actions import DeclareLaunchArgument, EmitEvent, RegisterEventHandler
from launch.event_handlers import OnProcessExit
from launch.events import Shutdown
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue

from launch import LaunchDescription


def generate_launch_description() -> LaunchDescription:
    recorder = Node(
        package="slpi_ros",
        executable="recorder",
        namespace=LaunchConfiguration("namespace"),
        parameters=[{"output": ParameterValue(LaunchConfiguration("bag"), value_type=str)}],
        remappings=[("stage_state", LaunchConfiguration("state_topic"))],
        output="screen",
    )
    exciter = Node(
        package="slpi_ros",
        executable="exciter",
        name="exciter",
        namespace=LaunchConfiguration("namespace"),
        parameters=[LaunchConfiguration("params_file")],
        remappings=[
            ("voltage_command", LaunchConfiguration("voltage_topic")),
            ("stage_state", LaunchConfiguration("state_topic")),
        ],
        # The way back to rest may take longer than launch is used to wait.
        sigterm_timeout="60",
        sigkill_timeout="60",
        output="screen",
    )
    return LaunchDescription([
        DeclareLaunchArgument("params_file", description="parameters of the exciter: see config/exciter.yaml"),
        DeclareLaunchArgument("bag", description="folder of the bag to be made"),
        DeclareLaunchArgument("namespace", default_value="", description="of the nodes and their topics"),
        DeclareLaunchArgument(
            "voltage_topic", default_value="voltage_command", description="where voltages go: a controller's commands"
        ),
        DeclareLaunchArgument("state_topic", default_value="stage_state", description="of the stage's driver"),
        recorder,
        exciter,
        RegisterEventHandler(OnProcessExit(target_action=exciter, on_exit=[EmitEvent(event=Shutdown())])),
    ])  # fmt: skip
