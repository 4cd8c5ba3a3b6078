"""What ``slpi doctor`` asks a running ROS graph."""

import math
from collections.abc import Mapping, Sequence
from contextlib import suppress
from typing import Any

import numpy as np
from rcl_interfaces.srv import GetParameters
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import parameter_value_to_python
from rclpy.qos import QoSProfile
from sensor_msgs.msg import JointState
from std_msgs.msg import String

from slpi_ros.arrays import FloatArray
from slpi_ros.errors import SlpiError
from slpi_ros.io.messages import SECOND_NS
from slpi_ros.model.document import parse_model
from slpi_ros.nodes.common import LATCHED, full_name, nanoseconds, reliability_of
from slpi_ros.nodes.graph_calls import joined, spun
from slpi_ros.nodes.parameters import numbers
from slpi_ros.reports.doctor import STATE_TYPE, Graph

# Longest time for discovery, and for a node to answer a question about its parameters, seconds.
DISCOVERY, ANSWER = 3.0, 2.0
ASKED = ("axes", "voltage_min", "voltage_max")
DEPTH = 1000


def probe(state_topic: str, command_topic: str, namespace: str, seconds: float) -> Graph:
    """Watch a running graph for some `seconds`, without publishing anything; topics are relative to `namespace`."""
    with joined("slpi_doctor", namespace) as (node, executor):
        return _Probe(node, executor, state_topic, command_topic).watch(seconds)


class _Probe:
    def __init__(self, node: Node, executor: SingleThreadedExecutor, state_topic: str, command_topic: str) -> None:
        self._node, self._executor = node, executor
        self._state, self._command = (node.resolve_topic_name(topic) for topic in (state_topic, command_topic))
        self._states: list[tuple[float, JointState]] = []  # with the times of their arrival, s
        self._models: list[String] = []

    def watch(self, seconds: float) -> Graph:
        node = self._node
        node.create_subscription(String, "stage_model", self._models.append, LATCHED)
        spun(self._executor, DISCOVERY, lambda: bool(node.get_publishers_info_by_topic(self._state)))
        offers = node.get_publishers_info_by_topic(self._state)
        if offers and all(offer.topic_type == STATE_TYPE for offer in offers):
            qos = QoSProfile(depth=DEPTH, reliability=reliability_of(offers))
            node.create_subscription(JointState, self._state, self._on_state, qos)
        spun(self._executor, seconds)
        commanding = _ends(node.get_publishers_info_by_topic(self._command))
        last = self._states[-1][1] if self._states else JointState()
        times = [(nanoseconds(state.header.stamp) / SECOND_NS, arrival) for arrival, state in self._states]
        stamps, arrivals = np.array(times).reshape(-1, 2).T
        own = node.get_fully_qualified_name()
        names = [(name, space) for name, space in node.get_node_names_and_namespaces() if not name.startswith("_")]
        model = None
        # Who publishes a document that is not valid says what is wrong with it.
        with suppress(SlpiError):
            model = parse_model(self._models[-1].data if self._models else "", "stage_model")
        return Graph(
            self._state,
            self._command,
            seconds,
            [name for name in (full_name(space, name) for name, space in names) if name != own],
            _ends(node.get_publishers_info_by_topic(self._state)),
            list(commanding),
            # A compensator hears the voltages of others until its first one.
            [each for each in _ends(node.get_subscriptions_info_by_topic(self._command)) if each not in commanding],
            stamps,
            arrivals,
            list(last.name),
            dict(zip(last.name, last.position.tolist(), strict=False)),
            dict(zip(last.name, last.effort.tolist(), strict=False)),
            last.header.frame_id,
            self._limits(next(iter(commanding))) if len(commanding) == 1 else {},
            model,
            {axis: self._readings(axis) for axis in last.name},
        )

    def _on_state(self, state: JointState) -> None:
        self._states.append((self._node.get_clock().now().nanoseconds / SECOND_NS, state))

    def _readings(self, axis: str) -> tuple[FloatArray, FloatArray]:
        """Return the voltages (V) and displacements (m) of an axis in all states, (N,)."""
        rows = []
        for _, state in self._states:
            v, y = (dict(zip(state.name, values, strict=False)) for values in (state.effort, state.position))
            rows.append((v.get(axis, math.nan), y.get(axis, math.nan)))
        voltage, displacement = np.array(rows).T
        return voltage, displacement

    def _limits(self, name: str) -> Mapping[str, tuple[float, float]]:
        """Return the voltage limits (V) of the axes of a node; empty if it does not tell."""
        client = self._node.create_client(GetParameters, f"{name}/get_parameters")
        spun(self._executor, ANSWER, client.service_is_ready)
        if not client.service_is_ready():
            return {}
        answer = client.call_async(GetParameters.Request(names=list(ASKED)))
        spun(self._executor, ANSWER, answer.done)
        values = [parameter_value_to_python(value) for value in answer.result().values] if answer.done() else []
        if len(values) < len(ASKED) or None in values:
            return {}
        given = dict(zip(ASKED, values, strict=True))
        try:
            low, high = (numbers(given, limit, given["axes"], -math.inf, math.inf) for limit in ASKED[1:])
        except SlpiError:
            return {}
        return {axis: (lowest, highest) for axis, lowest, highest in zip(given["axes"], low, high, strict=True)}


def _ends(infos: Sequence[Any]) -> dict[str, str]:
    """Return the type of each end of a topic by name; ends of one node are numbered."""
    ends: dict[str, str] = {}
    for info in infos:
        name, number = full_name(info.node_namespace, info.node_name), 2
        while name in ends:
            name, number = f"{full_name(info.node_namespace, info.node_name)} ({number})", number + 1
        ends[name] = info.topic_type
    return ends
