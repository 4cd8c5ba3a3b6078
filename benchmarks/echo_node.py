"""The floor: a bare node that answers every desired message with as many numbers, and computes nothing."""

import sys
from array import array

from rclpy.node import Node
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray

from slpi_ros.nodes.qos import COMMANDS
from slpi_ros.nodes.runner import run


class Echo(Node):
    """Publishes on ``voltage_command`` for each message on ``desired_displacement``."""

    def __init__(self) -> None:
        super().__init__("echo")
        self._answer = Float64MultiArray()
        self._numbers = array("d", [0.0, 0.0])
        self._publisher = self.create_publisher(Float64MultiArray, "voltage_command", COMMANDS)
        self.create_subscription(JointState, "desired_displacement", self._on_desired, COMMANDS)

    def _on_desired(self, message: JointState) -> None:
        self._numbers[0], self._numbers[1] = message.position
        self._answer.data = self._numbers
        self._publisher.publish(self._answer)


if __name__ == "__main__":
    sys.exit(run(Echo, executor=sys.argv[1] if len(sys.argv) > 1 else "events"))
