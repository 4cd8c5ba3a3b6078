"""Reference for the latency: a minimal node that answers every message with as many numbers, without a calculation."""

import sys
from array import array

from rclpy.node import Node
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray

from slpi_ros.io.cdr import multiarray_header
from slpi_ros.io.messages import JointStates
from slpi_ros.nodes.common import COMMANDS, run


class Echo(Node):
    """Publish one ``voltage_command`` for each ``desired_displacement``, with ordinary rclpy message objects."""

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


class BytesEcho(Node):
    """The same node with serialised messages, as the compensator receives and publishes them."""

    def __init__(self) -> None:
        super().__init__("bytes_echo")
        self._reader = JointStates()
        self._before = multiarray_header(2)
        self._publisher = self.create_publisher(Float64MultiArray, "voltage_command", COMMANDS)
        self.create_subscription(JointState, "desired_displacement", self._on_desired, COMMANDS, raw=True)

    def _on_desired(self, data: bytes) -> None:
        _, _, numbers = self._reader.read(data)
        self._publisher.publish(self._before + array("d", numbers).tobytes())


if __name__ == "__main__":
    kind, executor = sys.argv[1:3]
    sys.exit(run({"echo": Echo, "bytes": BytesEcho}[kind], executor=executor))
