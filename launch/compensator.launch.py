"""Start one compensator: ros2 launch slpi_ros compensator.launch.py params_file:=... model_file:=..."""

from launch.actions import DeclareLaunchArgument
from launch.conditions import IfCondition, UnlessCondition
from launch.substitutions import EqualsSubstitution, LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import LifecycleNode
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
    "state_topic": ("stage_state", "topic of the stage state: where the amplifier is"),
    "error_topic": ("tracking_error", "topic of the tracking errors"),
    "model_topic": ("stage_model", "topic of the stage model"),
    "diagnostics_topic": ("/diagnostics", "topic of the diagnostics"),
}


def generate_launch_description() -> LaunchDescription:
    model_file = LaunchConfiguration("model_file")
    no_model_file = EqualsSubstitution(model_file, "")
    as_in_params_file = [LaunchConfiguration("params_file")]
    with_model_file = [*as_in_params_file, {"model_file": ParameterValue(model_file, value_type=str)}]
    return LaunchDescription([
        DeclareLaunchArgument("params_file", default_value=ONE_AXIS, description="parameters of the compensator"),
        DeclareLaunchArgument("model_file", default_value="", description="model document, if not in params_file"),
        DeclareLaunchArgument("namespace", default_value="", description="namespace of the node and its topics"),
        *(
            DeclareLaunchArgument(argument, default_value=topic, description=meaning)
            for argument, (topic, meaning) in TOPICS.items()
        ),
        compensator(as_in_params_file, IfCondition(no_model_file)),
        compensator(with_model_file, UnlessCondition(no_model_file)),
    ])  # fmt: skip


def compensator(parameters: list, condition: IfCondition) -> LifecycleNode:
    # The node configures and activates itself unless its parameter autostart is false.
    return LifecycleNode(
        package="slpi_ros",
        executable="compensator",
        name="compensator",
        namespace=LaunchConfiguration("namespace"),
        parameters=parameters,
        remappings=[(topic, LaunchConfiguration(argument)) for argument, (topic, _) in TOPICS.items()],
        output="screen",
        condition=condition,
    )
