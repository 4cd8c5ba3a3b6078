"""Start a simulated stage, a compensator, and the identification of a bag.

ros2 launch slpi_ros demo.launch.py                                  start stage and compensator without a model
ros2 bag record /stage_state -o calibration                          record while /voltage_command is published
ros2 param set /identify bags "['calibration']"                      identify and load the model
"""

from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import LifecycleNode, Node
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare

from launch import LaunchDescription

ONE_AXIS = PathJoinSubstitution([FindPackageShare("slpi_ros"), "config", "one_axis.yaml"])


def generate_launch_description() -> LaunchDescription:
    # Written as YAML: launch would concatenate a plain list to one string.
    bags = ParameterValue(["['", LaunchConfiguration("bag"), "']"], value_type=list[str])
    return LaunchDescription([
        DeclareLaunchArgument("bag", default_value="", description="recorded calibration to identify at once"),
        DeclareLaunchArgument("namespace", default_value="", description="namespace of all nodes and their topics"),
        Node(
            package="slpi_ros",
            executable="stage_simulator",
            namespace=LaunchConfiguration("namespace"),
            parameters=[{"axes": ["x"]}],
            output="screen",
        ),
        LifecycleNode(
            package="slpi_ros",
            executable="compensator",
            name="compensator",
            namespace=LaunchConfiguration("namespace"),
            parameters=[ONE_AXIS],
            output="screen",
        ),
        Node(
            package="slpi_ros",
            executable="identify",
            namespace=LaunchConfiguration("namespace"),
            parameters=[{"bags": bags}],
            output="screen",
        ),
    ])  # fmt: skip
