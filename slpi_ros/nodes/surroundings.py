"""Subscriptions to the quantities that a stage follows: the topics of the model, or those of a parameter."""

import time
from collections.abc import Sequence
from functools import partial
from typing import Any

from rclpy.node import Node

from slpi_ros.compensator.controller import Controller
from slpi_ros.errors import RecordError
from slpi_ros.io.messages import QUANTITY_TYPES
from slpi_ros.io.surroundings import Chosen, value_of
from slpi_ros.nodes.common import MEASUREMENTS, message_class


class SurroundingsTopics:
    """Subscribe to the quantities of the controller's model as soon as the graph tells their types."""

    def __init__(self, node: Node, controller: Controller) -> None:
        self._node, self._controller = node, controller
        self._subscriptions: dict[str, tuple[str, Any]] = {}  # by quantity: full name of its topic, subscription
        self.refused: dict[str, str] = {}  # why there is none, by quantity

    def update(self, wanted: Sequence[str]) -> None:
        """Follow the model in use; `wanted` names topics, ``topic[:field]``, instead of those of the model."""
        places = assigned(tuple(self._controller.surroundings), wanted)
        for key in [key for key in self._subscriptions if key not in places]:
            self._leave(key)
        missing = {}
        for key, chosen in places.items():
            topic = self._node.resolve_topic_name(chosen.topic)
            if key in self._subscriptions and self._subscriptions[key][0] != topic:
                self._leave(key)
            if key not in self._subscriptions:
                missing[key] = topic, chosen.field
        self.refused = {key: why for key, why in self.refused.items() if key in missing}
        types = dict(self._node.get_topic_names_and_types()) if missing else {}
        for key, (topic, field) in missing.items():
            if types.get(topic):
                self._follow(key, topic, field, types[topic][0])

    def _follow(self, key: str, topic: str, field: str, msgtype: str) -> None:
        if msgtype not in QUANTITY_TYPES:
            self.refused[key] = f"{topic} is {msgtype}, not {' or '.join(QUANTITY_TYPES)}; name another topic"
            return
        try:
            kind = message_class(topic, msgtype)
        except RecordError as error:
            self.refused[key] = str(error)
            return
        self.refused.pop(key, None)
        callback = partial(self._on_message, key, msgtype, field)
        subscription = self._node.create_subscription(kind, topic, callback, MEASUREMENTS, raw=True)
        self._subscriptions[key] = topic, subscription

    def _on_message(self, key: str, msgtype: str, field: str, data: bytes) -> None:
        value = value_of(data, msgtype, field)
        if value is not None:
            self._controller.surroundings.take(key, value, time.monotonic_ns())

    def _leave(self, key: str) -> None:
        self._node.destroy_subscription(self._subscriptions.pop(key)[1])


def assigned(keys: Sequence[str], wanted: Sequence[str]) -> dict[str, Chosen]:
    """Return where each quantity is found: by default as the model names it.

    `wanted` are other places: one of the same topic and field, or topic alone, is that of its quantity; the others are
    taken in the order of the quantities that are left.
    """
    places = {key: Chosen.of(key) for key in keys}
    left = []
    for text in wanted:
        chosen = Chosen.of(text)
        same = [key for key, own in places.items() if own == chosen or (own.topic == chosen.topic and not chosen.field)]
        if not same:
            left.append(chosen)
    named = {Chosen.of(text).topic for text in wanted}
    free = [key for key in keys if Chosen.of(key).topic not in named]
    for key, chosen in zip(free, left, strict=False):
        places[key] = chosen if chosen.field else Chosen(chosen.topic, places[key].field)
    return places
