"""What a node says of its health on ``/diagnostics``."""

from collections.abc import Mapping
from dataclasses import dataclass

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.node import Node

from slpi_ros.nodes.qos import DIAGNOSTICS

OK: bytes = DiagnosticStatus.OK
WARN: bytes = DiagnosticStatus.WARN
ERROR: bytes = DiagnosticStatus.ERROR


@dataclass(frozen=True)
class Health:
    """How a node is.

    Parameters
    ----------
    problems : sequence of (level, str)
        What is wrong, worst or not; empty when all is well.
    summary : str
        What the node does when all is well.
    values : mapping of str to object
        Counters and states, shown as text.
    hardware_id : str
        The stage.
    """

    problems: tuple[tuple[bytes, str], ...]
    summary: str
    values: Mapping[str, object]
    hardware_id: str = ""

    @property
    def level(self) -> bytes:
        """The worst of the problems' levels."""
        return max((level for level, _ in self.problems), default=OK)

    @property
    def message(self) -> str:
        """All problems, the worst first, or the summary."""
        worst_first = sorted(self.problems, key=lambda problem: problem[0], reverse=True)
        return "; ".join(text for _, text in worst_first) or self.summary


class Diagnostics:
    """The publisher of one status, named after its node and what the node is."""

    def __init__(self, node: Node, role: str) -> None:
        self._node = node
        self._name = f"{node.get_fully_qualified_name()}: {role}"
        self._publisher = node.create_publisher(DiagnosticArray, "/diagnostics", DIAGNOSTICS)
        self.level = OK

    def report(self, health: Health) -> None:
        """Publish the health, and remember its level."""
        self.level = health.level
        status = DiagnosticStatus(
            level=health.level,
            name=self._name,
            message=health.message,
            hardware_id=health.hardware_id,
            values=[KeyValue(key=key, value=str(value)) for key, value in health.values.items()],
        )
        array = DiagnosticArray(status=[status])
        array.header.stamp = self._node.get_clock().now().to_msg()
        self._publisher.publish(array)
