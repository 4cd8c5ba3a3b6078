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
        self._subscriptions: dict[str, Any] = {}  # by quantity
        self.refused: dict[str, str] = {}  # why there is none, by quantity

    def update(self, wanted: Sequence[str]) -> None:
        """Follow the model in use; `wanted` names topics, ``topic[:field]``, instead of those of the model."""
        places = {
            key: (self._node.resolve_topic_name(chosen.topic), chosen.field)
            for key, chosen in assigned(tuple(self._controller.surroundings), wanted).items()
        }
        for key, subscription in list(self._subscriptions.items()):
            if key not in places or places[key][0] != subscription.topic_name:
                self._node.destroy_subscription(self._subscriptions.pop(key))
        missing = {key: place for key, place in places.items() if key not in self._subscriptions}
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
        self._subscriptions[key] = self._node.create_subscription(kind, topic, callback, MEASUREMENTS, raw=True)

    def _on_message(self, key: str, msgtype: str, field: str, data: bytes) -> None:
        value = value_of(data, msgtype, field)
        if value is not None:
            self._controller.surroundings.take(key, value, time.monotonic_ns())


def assigned(keys: Sequence[str], wanted: Sequence[str]) -> dict[str, Chosen]:
    """Return where each quantity is found: by default as the model names it.

    `wanted` are other places: one of the same topic and field, or topic alone, is that of its quantity; the others are
    taken in the order of the quantities that are left.
    """
    places, others = {key: Chosen.of(key) for key in keys}, [Chosen.of(text) for text in wanted]
    own = {*places.values(), *(Chosen(place.topic, "") for place in places.values())}
    left = [chosen for chosen in others if chosen not in own]
    named = {chosen.topic for chosen in others}
    free = [key for key in keys if places[key].topic not in named]
    for key, chosen in zip(free, left, strict=False):
        places[key] = chosen if chosen.field else Chosen(chosen.topic, places[key].field)
    return places
