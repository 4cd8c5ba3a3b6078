"""Driver of a stage with one axis: voltages to the amplifier, displacement and voltage on stage_state."""

from contextlib import suppress

import rclpy
from my_device import Device
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray

PERIOD_S = 0.005
LOWEST_V, HIGHEST_V = 0.0, 100.0


class Driver(Node):
    def __init__(self):
        super().__init__("driver")
        self.device = Device()
        self.publisher = self.create_publisher(JointState, "stage_state", 100)
        self.create_subscription(Float64MultiArray, "voltage_command", self.on_command, 100)
        self.create_timer(PERIOD_S, self.publish_state)

    def on_command(self, command):
        self.device.write(min(max(command.data[0], LOWEST_V), HIGHEST_V))

    def publish_state(self):
        state = JointState(name=["x"], effort=[self.device.applied()])  # volts that the amplifier puts out
        state.header.stamp = self.get_clock().now().to_msg()  # the time of the measurement, not of the publication
        state.header.frame_id = "stage-17"  # hardware id: the serial number of the stage
        state.position = [self.device.read()]  # metres
        self.publisher.publish(state)


rclpy.init()
with suppress(KeyboardInterrupt, ExternalShutdownException):
    rclpy.spin(Driver())
