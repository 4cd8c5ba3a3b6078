"""Node ``recorder``: records topics into a bag without rosbag2."""

from collections.abc import Sequence
from functools import partial
from typing import Any

from rclpy.event_handler import SubscriptionEventCallbacks, UnsupportedEventTypeError
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile

from slpi_ros.errors import RecordError, UsageError
from slpi_ros.io.bag_writer import STORAGES, BagWriter
from slpi_ros.io.messages import JOINT_STATE
from slpi_ros.nodes import parameters as declare
from slpi_ros.nodes.common import message_class, queued, reliability_of, request_stop, steady_timer
from slpi_ros.nodes.parameters import Declaration, Parameters, validated

# Queue length for bursts during slow disk writes.
DEPTH = 10_000
DISCOVERY_PERIOD = 0.1
# What was received is on the disk after this time, seconds; half of a second leaves time for a slow disk.
SYNC_PERIOD = 0.5
# Discovery of publishers may take several seconds.
PATIENCE = 5.0
# Shortest time between two of the same warning, seconds.
LOG_PERIOD = 5.0
STAGE_STATE = "stage_state"
DECLARATIONS = declare.read_only(
    declare.path("output", "rosbag2 folder to create; required."),
    Declaration("topics", [STAGE_STATE], "Topics to record."),
    declare.text("storage", "mcap", "File format: mcap or sqlite3.", *STORAGES),
    declare.scalar(
        "duration", 0.0,
        "Seconds from the first message; without any message the node stops 5 s after this time. 0: until a signal.",
        (0.0, 1e9),
    ),
)  # fmt: skip


class Recorder(Node):
    """Record topics into a bag until stopped.

    Subscribes to the topics named by the parameter ``topics``, with the reliability and durability that their
    publishers offer; messages are not deserialized. An incomplete bag is kept in ``.NAME.partial`` in
    the folder of the output, from which it is read if the recorder was killed: at most its last second is then
    lost; parameters in `DECLARATIONS`.
    """

    def __init__(self) -> None:
        super().__init__("recorder")
        values = Parameters(self, DECLARATIONS, partial(validated, DECLARATIONS)).settings
        output, topics = values["output"], values["topics"]
        if not output:
            raise UsageError("recorder: no output; name the bag with --ros-args -p output:=FOLDER")
        if not topics or not all(topics):
            raise UsageError(f"recorder: topics is {topics!r}; give a list of names, as in [stage_state]")
        # Topic names after namespace and remapping.
        self._awaited = {self.resolve_topic_name(topic): topic for topic in topics}
        self._duration: float = values["duration"]
        self._bag: BagWriter | None = BagWriter(output, storage=values["storage"], topic=None)
        self._listening: dict[str, Any] = {}
        for name, topic in self._awaited.items():
            # Subscribed before discovery, as the type is known, so that no message is lost.
            if topic.rpartition("/")[2] == STAGE_STATE:
                self._subscribe(name, JOINT_STATE, ())
        self._discovery = steady_timer(self, DISCOVERY_PERIOD, self._discover)
        self._synced = 0  # messages on the disk
        steady_timer(self, SYNC_PERIOD, self._sync)
        if self._duration:
            self._end = steady_timer(self, self._duration + PATIENCE, request_stop)
        self.get_logger().info(f"recording {', '.join(self._awaited)} into {output}")

    def destroy_node(self) -> None:
        """Complete the bag, then destroy the node; RecordError if it is empty or cannot be completed."""
        try:
            for name in self._listening if self.context.ok() else ():
                self._drain(name)
            if self._bag is not None:
                self._finish(self._bag)
        finally:
            super().destroy_node()

    def _discover(self) -> None:
        """Subscribe to the topics for which publishers have been discovered."""
        for name in list(self._awaited):
            if publishers := self.get_publishers_info_by_topic(name):
                del self._awaited[name]
                try:
                    self._subscribe(name, self._type_of(name, publishers), publishers)
                except RecordError as error:
                    request_stop(error)
        if not self._awaited:
            self._discovery.cancel()

    def _type_of(self, name: str, publishers: Sequence[Any]) -> str:
        types = {publisher.topic_type for publisher in publishers}
        types |= {JOINT_STATE} if name in self._listening else set()
        if len(types) > 1:
            raise RecordError(f"recorder: {name} is both {' and '.join(sorted(types))}; use one type")
        return str(types.pop())

    def _subscribe(self, name: str, msgtype: str, publishers: Sequence[Any]) -> None:
        """Subscribe to a topic with a QoS that all its publishers offer; resubscribe if that QoS has changed."""
        latched = all(each.qos_profile.durability == DurabilityPolicy.TRANSIENT_LOCAL for each in publishers)
        qos = QoSProfile(
            depth=DEPTH,
            reliability=reliability_of(publishers),
            durability=DurabilityPolicy.TRANSIENT_LOCAL if publishers and latched else DurabilityPolicy.VOLATILE,
        )
        former = self._listening.get(name)
        if former is not None and former.qos_profile == qos:
            return
        if former is not None:
            self._drain(name)
            self.destroy_subscription(former)
        elif self._bag is not None:
            self._bag.add_topic(name, msgtype)
        # rclpy's own one says that no message will come.
        events = SubscriptionEventCallbacks(incompatible_qos=partial(self._adapt, name), use_default_callbacks=False)
        subscribe = partial(self.create_subscription, message_class(name, msgtype), name)
        try:
            self._listening[name] = subscribe(partial(self._record, name), qos, raw=True, event_callbacks=events)
        except UnsupportedEventTypeError:
            self._listening[name] = subscribe(partial(self._record, name), qos, raw=True)

    def _adapt(self, name: str, _: object) -> None:
        """Subscribe anew with a QoS that a further publisher offers, too."""
        self._awaited.setdefault(name, name)
        self._discovery.reset()

    def _record(self, name: str, message: bytes) -> None:
        if self._bag is None:
            return
        if self._duration and not self._bag.message_count:
            self.destroy_timer(self._end)
            self._end = steady_timer(self, self._duration, request_stop)
        now_ns = self.get_clock().now().nanoseconds
        if not now_ns:
            self.get_logger().warning(
                "use_sim_time is set and nobody publishes /clock: messages are recorded at time 0; start what "
                "publishes it, or leave use_sim_time out",
                throttle_duration_sec=LOG_PERIOD,
            )
        try:
            self._bag.write(now_ns, message, name)
        except RecordError as error:
            self._give_up(self._bag, error)

    def _sync(self) -> None:
        """Write to the disk what has come since the last call."""
        if self._bag is None or self._bag.message_count == self._synced:
            return
        self._synced = self._bag.message_count
        try:
            self._bag.sync()
        except RecordError as error:
            self._give_up(self._bag, error)

    def _give_up(self, bag: BagWriter, error: RecordError) -> None:
        request_stop(RecordError(f"{error}; its unfinished files are in {bag.partial}"))
        self._bag = None

    def _drain(self, name: str) -> None:
        """Record the messages of a topic that are still queued in the middleware."""
        # Limited, so that continuous publishing cannot delay the end.
        for message in queued(self._listening[name], DEPTH):
            self._record(name, message)

    def _finish(self, bag: BagWriter) -> None:
        """Close the bag and move it to its final path; RecordError if it is empty."""
        if not bag.message_count:
            bag.discard()
            raise RecordError(f"{bag.path}: not written, as no message came; check the parameter topics")
        try:
            bag.close()
        except RecordError as error:
            raise RecordError(f"{error}; its unfinished files are in {bag.partial}") from error
        self.get_logger().info(f"{bag.message_count} messages in {bag.path}")
