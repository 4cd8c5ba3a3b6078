"""Who else is on the topics of a stage: other commanders of its voltages, and publishers of its state."""

import time
from collections.abc import Mapping
from typing import Any

from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.type_support import check_for_type_support
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray

from slpi_ros.compensator.controller import Controller
from slpi_ros.compensator.listening import Listening
from slpi_ros.compensator.reporters import SoleReporter
from slpi_ros.io.messages import SECOND_NS
from slpi_ros.nodes.common import MEASUREMENTS, publishers_beside

STATE, COMMAND = "stage_state", "voltage_command"
# A process that was killed stays in the graph for less than this time.
LEFT_NS = 25 * SECOND_NS
# The graph is looked at once in this time. Publishers of the state are told apart for this time after a new one.
GRAPH_NS, PROBED_NS = SECOND_NS, 3 * SECOND_NS


class StateProbe:
    """Reads ``stage_state`` with the numbers that its publishers give their messages."""

    # Beside the executor: the events executor of rclpy 7.1 gives no message info to a callback.
    def __init__(self, node: Node) -> None:
        check_for_type_support(JointState)
        topic, qos = node.resolve_topic_name(STATE), MEASUREMENTS.get_c_qos_profile()
        with node.handle:
            self._reader = rclpy_implementation.Subscription(node.handle, JointState, topic, qos)

    def poll(self, rules: Mapping[str, SoleReporter], now_ns: int) -> None:
        """Give the rules of the axes what has come."""
        with self._reader:
            while taken := self._reader.take_message(JointState, False):
                message, info = taken
                for axis in message.name:
                    if axis in rules:
                        rules[axis].hear(info["publication_sequence_number"], message.header.frame_id, now_ns)

    def close(self) -> None:
        """Read no more."""
        self._reader.destroy_when_not_in_use()


class Company:
    """Who else is on the topics of a compensator, begun at a time (steady clock, ns).

    Listens until its first voltage and for some time after that, then looks at the graph.
    """

    def __init__(self, node: Node, controller: Controller, begun_ns: int) -> None:
        self.newcomers: list[str] = []  # other publishers of the voltages that are alive, as far as is known
        self._node, self._controller, self._ownership = node, controller, controller.ownership
        self.own: set[bytes] = set()  # voltages of this node while it listens
        self._topics = {topic: node.resolve_topic_name(topic) for topic in (STATE, COMMAND)}
        self._listening = self._ownership.listening = Listening(
            lambda: publishers_beside(node, self._topics[COMMAND]), begun_ns
        )
        self._commands: Any = None
        self._probe: StateProbe | None = None
        self._looked_ns = self._probed_ns = self._known_ns = 0  # of the graph, of the probe, when the graph was known
        self._reporters = 0
        for rule in self._ownership.reporters.values():
            rule.publishers = lambda: publishers_beside(node, self._topics[STATE])
        self._beside: list[str] = []  # other publishers of the voltages then

    def listen(self) -> None:
        """Listen from now on: nothing is output."""
        self._listening.begin(time.monotonic_ns())
        if self._commands is None:
            self._commands = self._node.create_subscription(
                Float64MultiArray, COMMAND, self._on_command, MEASUREMENTS, raw=True
            )
        self._probe = self._probe or StateProbe(self._node)

    @property
    def listens(self) -> bool:
        """Whether voltages of others are heard."""
        return self._commands is not None

    def _on_command(self, data: bytes) -> None:
        """Take a voltage, which may be one of this node; one that came before the end of listening counts no more."""
        if self.listens and data not in self.own:
            self._listening.hear(time.monotonic_ns())

    @property
    def several_report(self) -> bool:
        """Whether ``stage_state`` has more than one publisher."""
        return self._reporters > 1

    def heard(self, now_ns: int) -> None:
        """Take that the stage has reported."""
        self._listening.state(now_ns)

    def close(self) -> None:
        """Listen no more."""
        if self._commands is not None:
            self._node.destroy_subscription(self._commands)
            self._commands = None
            self._listening.end()
            self.own.clear()
        if self._probe:
            self._probe.close()
            self._probe = None

    def look(self, now_ns: int) -> None:
        """Look at the graph once a second; stop listening when a voltage has been output."""
        if self._ownership.started and self._commands is not None:
            self._controller.report((), (), now_ns)
            if self._listening.may_end(now_ns, self._ownership.begun_ns):
                self.close()
        elif not self._known_ns:
            # Whom the graph tells first is listened to from then on.
            self._listening.check(now_ns)
        if now_ns - self._looked_ns >= GRAPH_NS:
            self._looked_ns = now_ns
            self._look_at_graph(now_ns)
        if self._probe:
            self._probe.poll(self._ownership.reporters, now_ns)
            if self._commands is None and now_ns - self._probed_ns > PROBED_NS:
                self._probe.close()
                self._probe = None

    def _look_at_graph(self, now_ns: int) -> None:
        others = publishers_beside(self._node, self._topics[COMMAND])
        if not self._known_ns and self._listening.looks(now_ns):
            self._known_ns, self._beside = now_ns, others
        # Those that were there at the beginning may have been killed before.
        dead = self._beside if now_ns - self._known_ns < LEFT_NS else []
        self.newcomers = [name for name in others if name not in dead] if self._known_ns else []
        before, self._reporters = self._reporters, self._node.count_publishers(self._topics[STATE])
        if self._reporters > max(before, 1):
            self._probe, self._probed_ns = self._probe or StateProbe(self._node), now_ns
