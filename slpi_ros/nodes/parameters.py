"""Node parameters, declared in one table and validated together."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from typing import Any, Generic, TypeVar

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor, SetParametersResult
from rclpy.node import Node
from rclpy.parameter import Parameter

from slpi_ros.errors import SlpiError, UsageError

Settings = TypeVar("Settings")
Values = Mapping[str, Any]
# Parameters that rclpy declares, some of them later.
KNOWN_TO_RCLPY = ("use_sim_time", "qos_overrides", "start_type_description_service")


@dataclass(frozen=True)
class Declaration:
    """Declaration of one node parameter, whose type is that of its default value."""

    name: str
    default: Any
    description: str  # for ``ros2 param describe``
    read_only: bool = False  # can only be set at the start of the node
    between: tuple[float, float] | None = None  # smallest and largest number; None: any
    number: bool = False  # a double, also given as an integer or as one value for each axis
    each_axis: bool = False  # each axis may have its own value
    choices: tuple[str, ...] = ()  # of a string; (): any

    def read(self, values: Values, axes: Sequence[str]) -> Any:
        """Return the validated value from `values`: a tuple with one value per axis if `each_axis`."""
        # None stands for NaN, if that is the default: it depends on other parameters.
        given = values[self.name]
        if self._is_nan(given) and self._is_nan(self.default):
            return None
        if self.each_axis and self.between:
            return tuple(numbers(values, self.name, axes, *self.between))
        if self.number and self.between:
            return number(values, self.name, *self.between)
        if self.between:
            low, high = map(int, self.between)
            if isinstance(given, bool) or not isinstance(given, int) or not low <= given <= high:
                raise UsageError(f"parameter {self.name} is {given!r}; give a whole number from {low} to {high}")
        if self._is_switch and isinstance(given, bool):
            given = "on" if given else "off"
        if self.choices and given not in self.choices:
            raise UsageError(f"parameter {self.name} is {given!r}; choose one of {', '.join(self.choices)}")
        return given

    @property
    def _is_switch(self) -> bool:
        """Whether it is on or off, which YAML takes for true and false."""
        return "on" in self.choices

    @staticmethod
    def _is_nan(value: Any) -> bool:
        return isinstance(value, float) and math.isnan(value)

    def descriptor(self) -> ParameterDescriptor:
        """Return the ROS descriptor, with the range that rclpy checks unless the default, NaN, is outside of it."""
        described = ParameterDescriptor(
            description=self.description,
            read_only=self.read_only,
            dynamic_typing=self.number or self._is_switch,
        )
        if self.between and not self._is_nan(self.default):
            low, high = self.between
            if self.number:
                described.floating_point_range = [FloatingPointRange(from_value=low, to_value=high)]
            else:
                described.integer_range = [IntegerRange(from_value=int(low), to_value=int(high))]
        return described


def validated(declarations: Sequence[Declaration], values: Values) -> dict[str, Any]:
    """Return all parameters by name, each validated; ``axes`` holds each name once."""
    # An empty list is given as None.
    axes = values.get("axes") or ()
    if "axes" in values and not (axes and all(axes) and len(set(axes)) == len(axes)):
        raise UsageError(f"parameter axes is {list(axes)!r}; name at least one axis, and each once")
    return {entry.name: entry.read(values, axes) for entry in declarations}


class Parameters(Generic[Settings]):
    """Node parameters and the settings that `make` derives from them, changed atomically."""

    def __init__(self, node: Node, declarations: Sequence[Declaration], make: Callable[[Values], Settings]) -> None:
        self._node, self._make = node, make
        self._values: dict[str, Any] = {
            entry.name: node.declare_parameter(entry.name, entry.default, entry.descriptor()).value
            for entry in declarations
        }
        self.settings = make(self._values)
        self._tell_unknown(node)

    def _tell_unknown(self, node: Node) -> None:
        """Warn of parameters that are given and that the node does not have: a misspelt limit would be none."""
        given: Mapping[str, Any] = getattr(node, "_parameter_overrides", {})
        for name in given:
            if name.partition(".")[0] not in KNOWN_TO_RCLPY and not node.has_parameter(name):
                near = get_close_matches(name, self._values, 1)
                node.get_logger().warning(
                    f"there is no parameter {name}, it changes nothing{f'; {near[0]} is meant?' if near else ''}"
                )

    def follow(self, apply: Callable[[Settings], None], check: Callable[[Settings], None] | None = None) -> None:
        """Allow parameter changes unless `check` raises SlpiError; call `apply` with the new settings."""
        self._applied, self._checked = apply, check
        self._node.add_on_set_parameters_callback(self._check)
        self._node.add_post_set_parameters_callback(self._apply)

    def _check(self, changes: Sequence[Parameter]) -> SetParametersResult:
        try:
            settings = self._make(self._values | self._ours(changes))
            if self._checked:
                self._checked(settings)
        except SlpiError as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def _apply(self, changes: Sequence[Parameter]) -> None:
        if ours := self._ours(changes):
            self._values |= ours
            self.settings = self._make(self._values)
            self._applied(self.settings)

    def _ours(self, changes: Sequence[Parameter]) -> dict[str, Any]:
        """Return the changes of declared parameters, without those of rclpy such as use_sim_time."""
        return {change.name: change.value for change in changes if change.name in self._values}


def number(values: Values, name: str, low: float, high: float) -> float:
    """Return the parameter `name` as a float; UsageError if it is not one finite number from `low` to `high`."""
    return numbers(values, name, ("",), low, high)[0]


def numbers(values: Values, name: str, axes: Sequence[str], low: float, high: float) -> list[float]:
    """Return the parameter `name` as floats from `low` to `high`, one for each axis; one value applies to all axes."""
    given = values[name]
    if isinstance(given, Sequence) and not isinstance(given, str):
        # Arrays are converted to lists for messages.
        given = several = list(given)
    else:
        several = [given] * len(axes)
    if not all(isinstance(value, int | float) and not isinstance(value, bool) for value in several):
        several = []
    if len(several) != len(axes):
        wanted = "a number" if len(axes) == 1 else f"a number, or one for each of the axes {', '.join(axes)}"
        raise UsageError(f"parameter {name} is {given!r}; give {wanted}")
    for value in several:
        if not (math.isfinite(value) and low <= value <= high):
            raise UsageError(f"parameter {name} is {value:g}; give a value from {low:g} to {high:g}")
    return [float(value) for value in several]
