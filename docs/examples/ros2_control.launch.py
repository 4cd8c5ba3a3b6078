"""ros2 launch ros2_control.launch.py description:=stage.urdf model_file:=/path/to/xy.json."""

from launch.actions import DeclareLaunchArgument
from launch.substitutions import Command, LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue

from launch import LaunchDescription

CONTROLLERS = "controllers.yaml"


def generate_launch_description():
    description = ParameterValue(Command(["cat ", LaunchConfiguration("description")]), value_type=str)
    return LaunchDescription([
        DeclareLaunchArgument("description", description="robot description with the ros2_control section"),
        DeclareLaunchArgument("model_file", description="model document, absolute path"),
        Node(
            package="robot_state_publisher",
            executable="robot_state_publisher",
            parameters=[{"robot_description": description}],
        ),
        Node(package="controller_manager", executable="ros2_control_node", parameters=[CONTROLLERS]),
        Node(
            package="controller_manager",
            executable="spawner",
            arguments=["joint_state_broadcaster", "voltage_controller"],
        ),
        Node(
            package="slpi_ros",
            executable="compensator",
            name="compensator",
            parameters=[CONTROLLERS, {"model_file": LaunchConfiguration("model_file")}],
            remappings=[
                ("voltage_command", "/voltage_controller/commands"),
                ("measured_displacement", "/joint_states"),
            ],
        ),
    ])  # fmt: skip
