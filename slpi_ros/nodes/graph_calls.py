"""What ``slpi call`` and ``slpi param`` ask a node: a Trigger service, or a parameter."""

import math
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from difflib import get_close_matches
from typing import Any

import rclpy
import yaml
from rcl_interfaces.msg import ParameterType
from rcl_interfaces.srv import GetParameters, ListParameters, SetParametersAtomically
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.parameter import Parameter, parameter_value_to_python
from std_srvs.srv import Trigger

from slpi_ros.errors import SlpiError, UsageError
from slpi_ros.nodes.common import START_ERRORS, full_name

# Longest time for discovery, and for the answer about a parameter, seconds.
DISCOVERY, ANSWER = 5.0, 5.0
# Fast DDS drops the answer to a client that a service has not discovered yet, seconds.
ACQUAINTANCE = 0.5
SPIN = 0.02
_TRIGGER = "std_srvs/srv/Trigger"
# By the type that a parameter has, that of its elements where it is an array.
_NUMBERS = (
    ParameterType.PARAMETER_INTEGER, ParameterType.PARAMETER_DOUBLE, ParameterType.PARAMETER_INTEGER_ARRAY,
    ParameterType.PARAMETER_DOUBLE_ARRAY,
)  # fmt: skip
_SWITCHES = (ParameterType.PARAMETER_BOOL, ParameterType.PARAMETER_BOOL_ARRAY)


@contextmanager
def joined(name: str, namespace: str = "") -> Iterator[tuple[Any, SingleThreadedExecutor]]:
    """Take part in the graph with a node of this name; UsageError if ROS cannot start."""
    context = Context()
    try:
        rclpy.init(args=[], context=context)
        node = rclpy.create_node(name, namespace=namespace or None, context=context)
        executor = SingleThreadedExecutor(context=context)
        executor.add_node(node)
        try:
            yield node, executor
        finally:
            executor.shutdown()
            node.destroy_node()
    except START_ERRORS as error:
        raise UsageError(f"ROS cannot start: {' '.join(str(error).split())}") from None
    finally:
        context.try_shutdown()


class NodeCalls:
    """Calls of the services of a node, given by its full name, from a node that has joined the graph."""

    def __init__(self, node: Any, executor: SingleThreadedExecutor, name: str) -> None:
        """Wait for the node; SlpiError if there is none."""
        self._node, self._executor, self._name = node, executor, f"/{name.strip('/')}"
        if not self._wait(DISCOVERY, lambda: self._name in self._names()):
            there = ", ".join(self._names()) or "none; check ROS_DOMAIN_ID and ROS_AUTOMATIC_DISCOVERY_RANGE"
            raise SlpiError(f"no node {self._name}; there are {there}")

    def trigger(self, service: str, seconds: float) -> tuple[bool, str]:
        """Return what a Trigger service of the node answers within some `seconds`: whether it succeeded, and a text."""
        wanted = f"{self._name}/{service.removeprefix('~').strip('/')}"
        if not self._wait(DISCOVERY, lambda: wanted in self._triggers()):
            own = ", ".join(name.rpartition("/")[2] for name in self._triggers()) or "no such service"
            raise UsageError(f"{self._name} has no service {wanted} of type {_TRIGGER}; it has {own}")
        answer = self._call(Trigger, wanted, Trigger.Request(), seconds)
        return bool(answer.success), str(answer.message)

    def parameter(self, name: str) -> Any:
        """Return the value of a parameter; UsageError if the node has none of this name."""
        return parameter_value_to_python(self._value(name))

    def set_parameter(self, name: str, text: str) -> Any:
        """Set a parameter to what a text says of its type; return its new value, or raise UsageError if refused."""
        value = value_of(text, self._value(name).type, name)
        request = SetParametersAtomically.Request(parameters=[Parameter(name, value=value).to_parameter_msg()])
        result = self._call(SetParametersAtomically, f"{self._name}/set_parameters_atomically", request).result
        if not result.successful:
            raise UsageError(f"{self._name}: {name} stays: {result.reason or 'refused'}")
        return self.parameter(name)

    def _value(self, name: str) -> Any:
        request = GetParameters.Request(names=[name])
        values = self._call(GetParameters, f"{self._name}/get_parameters", request).values
        if not values or values[0].type == ParameterType.PARAMETER_NOT_SET:
            listed = self._call(ListParameters, f"{self._name}/list_parameters", ListParameters.Request())
            near = get_close_matches(name, listed.result.names, 1)
            raise UsageError(f"{self._name} has no parameter {name}{f'; {near[0]} is meant?' if near else ''}")
        return values[0]

    def _names(self) -> list[str]:
        own = self._node.get_fully_qualified_name()
        names = [full_name(space, name) for name, space in self._node.get_node_names_and_namespaces()]
        return sorted(name for name in names if name != own and not name.rpartition("/")[2].startswith("_"))

    def _triggers(self) -> list[str]:
        space, _, name = self._name.rpartition("/")
        offered = self._node.get_service_names_and_types_by_node(name, space or "/")
        return [service for service, types in offered if _TRIGGER in types]

    def _call(self, kind: Any, name: str, request: Any, seconds: float = ANSWER) -> Any:
        client = self._node.create_client(kind, name)
        if not self._wait(DISCOVERY, client.service_is_ready):
            raise SlpiError(f"{name}: the service does not come; is the node alive?")
        self._wait(ACQUAINTANCE, lambda: False)
        answer = client.call_async(request)
        if not self._wait(seconds, answer.done):
            raise SlpiError(f"{name}: no answer within {seconds:g} s; look at /diagnostics whether it was carried out")
        return answer.result()

    def _wait(self, seconds: float, done: Callable[[], bool]) -> bool:
        return spun(self._executor, seconds, done)


def spun(executor: SingleThreadedExecutor, seconds: float, done: Callable[[], bool] = lambda: False) -> bool:
    """Spin for some `seconds` at most, until it is `done`; return whether it is."""
    end = time.monotonic() + seconds
    while not done():
        if time.monotonic() > end:
            return False
        executor.spin_once(timeout_sec=SPIN)
    return True


def value_of(text: str, kind: int, name: str) -> Any:
    """Return the value of a text for a parameter of a type (`rcl_interfaces/ParameterType`); UsageError if it is none.

    Numbers are decimal, and text is text: nothing is octal or a truth value by its looks.
    """
    if kind == ParameterType.PARAMETER_STRING:
        return text
    try:
        # Every leaf stays a text.
        given = yaml.load(text, yaml.BaseLoader)
    except yaml.YAMLError:
        given = text
    several = isinstance(given, list)
    values = [_single(str(each), kind, name) for each in (given if several else [given])]
    if several and any(isinstance(each, float) for each in values):
        values = [float(each) for each in values]
    return values if several else values[0]


def _single(text: str, kind: int, name: str) -> str | float | bool:
    if kind in _SWITCHES:
        if text.lower() in ("true", "false"):
            return text.lower() == "true"
        raise UsageError(f"parameter {name}: '{text}' is not true or false")
    if kind not in _NUMBERS:
        return text
    if text.lstrip("+-").isdecimal() and kind in _NUMBERS[::2]:
        return int(text)
    try:
        return math.nan if text == ".nan" else float(text)
    except ValueError:
        raise UsageError(f"parameter {name}: '{text}' is no number") from None
