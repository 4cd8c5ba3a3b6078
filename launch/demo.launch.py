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

# Argument, and topic of the nodes that it remaps, with its meaning.
TOPICS = {
    "desired_topic": ("desired_displacement", "topic of the desired displacements"),
    "trajectory_topic": ("desired_trajectory", "topic of the desired trajectories"),
    "measured_topic": ("measured_displacement", "topic of the measured displacements; stage_state for feedback"),
    "voltage_topic": ("voltage_command", "topic of the voltage commands"),
    "error_topic": ("tracking_error", "topic of the tracking errors"),
    "uncertainty_topic": ("displacement_uncertainty", "topic of where the axes are and how uncertain that is"),
    "state_topic": ("stage_state", "topic of the stage state"),
    "model_topic": ("stage_model", "topic of the stage model"),
    "diagnostics_topic": ("/diagnostics", "topic of the diagnostics"),
    "voltage_trajectory_topic": ("voltage_trajectory", "topic of whole paths, with trajectory_output: block"),
    "trajectory_state_topic": ("voltage_trajectory_state", "topic of what becomes of them"),
    "recorded_topic": ("recorded_trajectory", "topic of what the device recorded of them"),
}


def generate_launch_description() -> LaunchDescription:
    # Written as YAML: launch would concatenate a plain list to one string.
    bags = ParameterValue(["['", LaunchConfiguration("bag"), "']"], value_type=list[str])
    topics = [(topic, LaunchConfiguration(argument)) for argument, (topic, _) in TOPICS.items()]
    return LaunchDescription([
        DeclareLaunchArgument("bag", default_value="", description="recorded calibration to identify at once"),
        DeclareLaunchArgument("namespace", default_value="", description="namespace of all nodes and their topics"),
        *(
            DeclareLaunchArgument(argument, default_value=topic, description=meaning)
            for argument, (topic, meaning) in TOPICS.items()
        ),
        Node(
            package="slpi_ros",
            executable="stage_simulator",
            namespace=LaunchConfiguration("namespace"),
            parameters=[{"axes": ["x"]}],
            remappings=topics,
            output="screen",
        ),
        LifecycleNode(
            package="slpi_ros",
            executable="compensator",
            name="compensator",
            namespace=LaunchConfiguration("namespace"),
            parameters=[ONE_AXIS],
            remappings=topics,
            output="screen",
        ),
        Node(
            package="slpi_ros",
            executable="identify",
            namespace=LaunchConfiguration("namespace"),
            parameters=[{"bags": bags}],
            remappings=topics,
            output="screen",
        ),
    ])  # fmt: skip
