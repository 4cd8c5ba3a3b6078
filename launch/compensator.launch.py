"""Start one compensator: ros2 launch slpi_ros compensator.launch.py params_file:=... model_file:=...

With driver_file:=driver.yaml the driver of the amplifier is started, too; with device_file a simulated device for it.
"""

from launch.actions import DeclareLaunchArgument, IncludeLaunchDescription
from launch.conditions import IfCondition, UnlessCondition
from launch.substitutions import EqualsSubstitution, LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import LifecycleNode
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare

from launch import LaunchDescription

ONE_AXIS = PathJoinSubstitution([FindPackageShare("slpi_ros"), "config", "one_axis.yaml"])
DEVICE = PathJoinSubstitution([FindPackageShare("slpi_ros"), "launch", "device.launch.py"])

# Argument, and topic of the nodes that it remaps, with its meaning.
TOPICS = {
    "desired_topic": ("desired_displacement", "topic of the desired displacements"),
    "trajectory_topic": ("desired_trajectory", "topic of the desired trajectories"),
    "measured_topic": ("measured_displacement", "topic of the measured displacements; stage_state for feedback"),
    "voltage_topic": ("voltage_command", "topic of the voltage commands"),
    "state_topic": ("stage_state", "topic of the stage state: where the amplifier is"),
    "error_topic": ("tracking_error", "topic of the tracking errors"),
    "uncertainty_topic": ("displacement_uncertainty", "topic of where the axes are and how uncertain that is"),
    "model_topic": ("stage_model", "topic of the stage model"),
    "diagnostics_topic": ("/diagnostics", "topic of the diagnostics"),
    "voltage_trajectory_topic": ("voltage_trajectory", "topic of whole paths, with trajectory_output: block"),
    "trajectory_state_topic": ("voltage_trajectory_state", "topic of what becomes of them"),
    "recorded_topic": ("recorded_trajectory", "topic of what the device recorded of them"),
}
# Those of the driver, as in device.launch.py.
DRIVER_TOPICS = (
    "voltage_topic", "state_topic", "diagnostics_topic", "voltage_trajectory_topic", "trajectory_state_topic",
    "recorded_topic",
)  # fmt: skip


def generate_launch_description() -> LaunchDescription:
    model_file = LaunchConfiguration("model_file")
    no_model_file = EqualsSubstitution(model_file, "")
    as_in_params_file = [LaunchConfiguration("params_file")]
    with_model_file = [*as_in_params_file, {"model_file": ParameterValue(model_file, value_type=str)}]
    return LaunchDescription([
        DeclareLaunchArgument("params_file", default_value=ONE_AXIS, description="parameters of the compensator"),
        DeclareLaunchArgument("model_file", default_value="", description="model document, if not in params_file"),
        DeclareLaunchArgument(
            "driver_file", default_value="", description="parameters of the node driver; empty: no driver is started"
        ),
        DeclareLaunchArgument(
            "device_file", default_value="", description="parameters of a simulated device for the driver; empty: none"
        ),
        DeclareLaunchArgument("namespace", default_value="", description="namespace of the nodes and their topics"),
        *(
            DeclareLaunchArgument(argument, default_value=topic, description=meaning)
            for argument, (topic, meaning) in TOPICS.items()
        ),
        compensator(as_in_params_file, IfCondition(no_model_file)),
        compensator(with_model_file, UnlessCondition(no_model_file)),
        IncludeLaunchDescription(
            DEVICE,
            launch_arguments=[
                (argument, LaunchConfiguration(argument))
                for argument in ("driver_file", "device_file", "namespace", *DRIVER_TOPICS)
            ],
            condition=UnlessCondition(EqualsSubstitution(LaunchConfiguration("driver_file"), "")),
        ),
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
