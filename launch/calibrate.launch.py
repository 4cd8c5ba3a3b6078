"""Calibrate a stage by itself: from an unknown stage to a verified model that knows its causes.

ros2 launch slpi_ros calibrate.launch.py params_file:=calibrator.yaml output:=my_stage
ros2 launch slpi_ros calibrate.launch.py params_file:=calibrator.yaml output:=demo simulate:=true
ros2 launch slpi_ros calibrate.launch.py params_file:=calibrator.yaml output:=my_stage driver_file:=driver.yaml

With device_file a simulated device is started for the driver.

The launch ends with the calibrator, whose exit code is 0 if the target is met, else 1.
"""

from launch.actions import DeclareLaunchArgument, EmitEvent, IncludeLaunchDescription, RegisterEventHandler
from launch.conditions import IfCondition, UnlessCondition
from launch.event_handlers import OnProcessExit
from launch.events import Shutdown
from launch.substitutions import EqualsSubstitution, LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare

from launch import LaunchDescription

DEVICE = PathJoinSubstitution([FindPackageShare("slpi_ros"), "launch", "device.launch.py"])

# Argument, and topic of the nodes that it remaps, with its meaning.
TOPICS = {
    "voltage_topic": ("voltage_command", "topic of the voltage commands"),
    "state_topic": ("stage_state", "topic of the stage state"),
    "model_topic": ("stage_model", "topic of the stage model"),
    "diagnostics_topic": ("/diagnostics", "topic of the diagnostics"),
    "voltage_trajectory_topic": ("voltage_trajectory", "topic of whole paths for the driver"),
    "trajectory_state_topic": ("voltage_trajectory_state", "topic of what becomes of them"),
    "recorded_topic": ("recorded_trajectory", "topic of what the device recorded of them"),
}


def generate_launch_description() -> LaunchDescription:
    params_file, namespace = LaunchConfiguration("params_file"), LaunchConfiguration("namespace")
    topics = [(topic, LaunchConfiguration(argument)) for argument, (topic, _) in TOPICS.items()]
    simulator = Node(
        package="slpi_ros",
        executable="stage_simulator",
        namespace=namespace,
        parameters=[
            params_file,
            {"character": "hidden", "seed": ParameterValue(LaunchConfiguration("simulated_seed"), value_type=int)},
        ],
        remappings=topics,
        condition=IfCondition(LaunchConfiguration("simulate")),
        output="screen",
    )
    driver = IncludeLaunchDescription(
        DEVICE,
        launch_arguments=[
            (argument, LaunchConfiguration(argument))
            for argument in ("driver_file", "device_file", "namespace", *TOPICS)
            if argument != "model_topic"
        ],
        condition=UnlessCondition(EqualsSubstitution(LaunchConfiguration("driver_file"), "")),
    )
    calibrator = Node(
        package="slpi_ros",
        executable="calibrator",
        name="calibrator",
        namespace=namespace,
        parameters=[
            params_file,
            {
                "output": ParameterValue(LaunchConfiguration("output"), value_type=str),
                "resume": ParameterValue(LaunchConfiguration("resume"), value_type=bool),
            },
        ],
        remappings=topics,
        # The return to rest may exceed the default timeout of launch.
        sigterm_timeout="60",
        sigkill_timeout="60",
        output="screen",
    )
    return LaunchDescription([
        DeclareLaunchArgument("params_file", description="parameters of the calibrator: see config/calibrator.yaml"),
        DeclareLaunchArgument("output", description="folder for bags, model, diagnosis and page"),
        DeclareLaunchArgument("resume", default_value="false", description="go on with the bags that output holds"),
        DeclareLaunchArgument("namespace", default_value="", description="namespace of the nodes and their topics"),
        *(
            DeclareLaunchArgument(argument, default_value=topic, description=meaning)
            for argument, (topic, meaning) in TOPICS.items()
        ),
        DeclareLaunchArgument(
            "simulate", default_value="false", description="start a simulated stage with hidden effects"
        ),
        DeclareLaunchArgument("simulated_seed", default_value="1", description="seed of the simulated stage"),
        DeclareLaunchArgument(
            "driver_file", default_value="", description="parameters of the node driver; empty: no driver is started"
        ),
        DeclareLaunchArgument(
            "device_file", default_value="", description="parameters of a simulated device for the driver; empty: none"
        ),
        simulator,
        driver,
        calibrator,
        RegisterEventHandler(OnProcessExit(target_action=calibrator, on_exit=[EmitEvent(event=Shutdown())])),
    ])  # fmt: skip
