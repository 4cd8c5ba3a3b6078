"""Whether another driver of a stage publishes already: listening before speaking."""

import time
from collections.abc import Sequence

from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import JointState

from slpi_ros.compensator.listening import LOOK_WITHOUT_NS, QUIET_NS
from slpi_ros.errors import RecordError, shown
from slpi_ros.io.stage_name import same_stage, stage_name
from slpi_ros.nodes.common import UNNAMED, publishers_beside, read_state

# Time to find publishers, as middleware announces itself every 3 s where what it said at first is lost, and to hear one
# that was found: one that was killed is known for 20 s more, and silent.
FIND, HEAR = LOOK_WITHOUT_NS * 1e-9, QUIET_NS * 1e-9


class OtherDriver:
    """Hears who reports some of the `axes` on a topic that `node` publishes too, but not before `done`."""

    def __init__(self, node: Node, topic: str, axes: Sequence[str]) -> None:
        self._node, self._axes = node, frozenset(axes)
        self._topic = node.resolve_topic_name(topic)
        self.frames: set[str] = set()  # of the states that were heard
        self._begun = time.monotonic()
        self._found: float | None = None  # when another publisher was found
        # Whatever reliability they offer.
        qos = QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT)
        self._subscription = node.create_subscription(JointState, self._topic, self._on_state, qos, raw=True)

    @property
    def done(self) -> bool:
        """Whether it has listened for long enough; then it ends."""
        now, others = time.monotonic(), publishers_beside(self._node, self._topic)
        if self._found is None and (others or self.frames):
            self._found = now
        # The name of a node may become known after its publisher.
        named = bool(others) and UNNAMED not in others
        if not (self.frames and named) and now < (self._begun + FIND if self._found is None else self._found + HEAR):
            return False
        self._node.destroy_subscription(self._subscription)
        return True

    def refusal(self, frame: str) -> RecordError | None:
        """Return the error if what was heard may be the stage of this frame id; None if nothing was."""
        other = next((each for each in sorted(self.frames) if same_stage(each, frame)), None)
        if other is None:
            return None
        who = ", ".join(publishers_beside(self._node, self._topic)) or "another node"
        name = f"stage '{shown(other)}'" if stage_name(other) else "a stage without a name"
        return RecordError(
            f"{self._node.get_name()}: {who} publishes {self._topic} of {name} with axis "
            f"{', '.join(sorted(self._axes))} already; end it, or give this stage a hardware_id, a namespace or "
            "another ROS_DOMAIN_ID"
        )

    def _on_state(self, data: bytes) -> None:
        if (state := read_state(data)) and self._axes.intersection(state.name):
            self.frames.add(state.header.frame_id)
