"""Node parameters, declared in one table and validated together, and those that several nodes have."""

import math
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from difflib import get_close_matches
from os.path import expanduser
from typing import Any, Generic, TypeVar

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor, SetParametersResult
from rclpy.node import Node
from rclpy.parameter import Parameter

from slpi_ros.errors import SlpiError, UsageError
from slpi_ros.excitation.drives import slew_limits
from slpi_ros.io.stage_name import acceptance
from slpi_ros.model.limits import Limits
from slpi_ros.nodes.parameter_texts import leading_zeros, overridden

Settings = TypeVar("Settings")
Values = Mapping[str, Any]
Range = tuple[float, float]  # smallest and largest number
# Parameters that rclpy declares, some of them later.
KNOWN_TO_RCLPY = ("use_sim_time", "qos_overrides", "start_type_description_service")


@dataclass(frozen=True)
class Declaration:
    """Declaration of one node parameter, whose type is that of its default value."""

    name: str
    default: Any
    description: str  # for ``ros2 param describe``
    read_only: bool = False  # can only be set at the start of the node
    between: Range | None = None  # of a number; None: any
    number: bool = False  # a double, also given as an integer or as one value for each axis
    each_axis: bool = False  # each axis may have its own value
    choices: tuple[str, ...] = ()  # of a string; (): any
    required: bool = False  # NaN is refused; else it stands for None, if it is the default
    lists: Range | None = None  # of the numbers of a list, of which each axis has one; the name ends with ".AXIS"
    path: bool = False  # of a file or folder, or several; ~ is the home folder, which no shell puts in after ":="

    def expanded(self, given: Any) -> Any:
        """Return a value with the home folder for ~, if it is a path."""
        if not self.path:
            return given
        return expanduser(given) if isinstance(given, str) else [expanduser(each) for each in given or ()]

    def read(self, values: Values, axes: Sequence[str]) -> Any:
        """Return the validated value from `values`: a tuple with one value per axis if `each_axis`."""
        if self.lists:
            return tuple(_listed(values, named, self.default, *self.lists) for named in self.names(axes))
        given = values[self.name]
        if _is_nan(given) and _is_nan(self.default) and not self.required:
            # It depends on other parameters.
            return None
        if self.number and self.between:
            found = numbers(values, self.name, axes if self.each_axis else ("",), *self.between)
            return tuple(found) if self.each_axis else found[0]
        if self.between:
            low, high = map(int, self.between)
            if isinstance(given, bool) or not isinstance(given, int) or not low <= given <= high:
                raise UsageError(f"parameter {self.name} is {given!r}; give a whole number from {low} to {high}")
        if self._is_switch and isinstance(given, bool):
            given = "on" if given else "off"
        if self.choices and given not in self.choices:
            raise UsageError(f"parameter {self.name} is {given!r}; choose one of {', '.join(self.choices)}")
        return given

    def names(self, axes: Sequence[str]) -> list[str]:
        """Return the names that the node declares: for lists one for each axis."""
        return [self.name.removesuffix("AXIS") + axis for axis in dict.fromkeys(axes)] if self.lists else [self.name]

    @property
    def _is_switch(self) -> bool:
        """Whether it is on or off, which YAML takes for true and false."""
        return "on" in self.choices

    def descriptor(self) -> ParameterDescriptor:
        """Return the ROS descriptor, with the range that rclpy checks unless the default, NaN, is outside of it."""
        described = ParameterDescriptor(
            description=self.description,
            read_only=self.read_only,
            dynamic_typing=self.number or self._is_switch or self.lists is not None,
        )
        if self.between and not _is_nan(self.default):
            low, high = self.between
            if self.number:
                described.floating_point_range = [FloatingPointRange(from_value=low, to_value=high)]
            else:
                described.integer_range = [IntegerRange(from_value=int(low), to_value=int(high))]
        return described


def _is_nan(value: Any) -> bool:
    return isinstance(value, float) and math.isnan(value)


def scalar(name: str, default: float, description: str, between: Range, *, read_only: bool = False) -> Declaration:
    """Declare a numeric parameter with a single value."""
    return Declaration(name, default, description, read_only, between, number=True)


def each_axis(name: str, default: float, description: str, between: Range, *, required: bool = False) -> Declaration:
    """Declare a numeric parameter that may have one value for each axis."""
    description += " One value, or one for each axis."
    return Declaration(name, default, description, between=between, number=True, each_axis=True, required=required)


def list_of_each_axis(name: str, default: float, description: str, between: Range) -> Declaration:
    """Declare a list of numbers of each axis."""
    return Declaration(f"{name}.AXIS", [default], description, lists=between)


def text(name: str, default: str, description: str, *choices: str, read_only: bool = False) -> Declaration:
    """Declare a string parameter, limited to `choices` if any are given."""
    return Declaration(name, default, description, read_only, choices=choices)


def path(name: str, description: str, default: str | list[str] = "", *, read_only: bool = False) -> Declaration:
    """Declare the path of a file or folder, or of several."""
    return Declaration(name, default, description, read_only, path=True)


def read_only(*declarations: Declaration) -> tuple[Declaration, ...]:
    """Return declarations of parameters that can only be set at the start of the node."""
    return tuple(replace(each, read_only=True) for each in declarations)


# Parameters of several nodes

VOLTAGE = (-10_000.0, 10_000.0)
AXES = Declaration("axes", ["x"], "Names of the axes, in the order of voltage_command.", read_only=True)
ACCELERATION_LIMIT = each_axis(
    "acceleration_limit", 0.0, "Maximum change of the rate of a voltage, V/s^2; 0: no limit.", (0.0, 1e12)
)
MEAN_RATE_LIMIT = each_axis(
    "mean_rate_limit", 0.0,
    "Largest mean of |dV/dt| over 10 s, up and down both counted, V/s: twice the average current of a data sheet over "
    "the capacitance. 0: no limit.",
    (0.0, 1e9),
)  # fmt: skip
STATE_TIMEOUT = scalar(
    "state_timeout", 0.5,
    "Seconds without a valid stage_state after which a drive is given up; reports of the voltage may be as late.",
    (1e-3, 60.0), read_only=True,
)  # fmt: skip
DIAGNOSTIC_PERIOD = scalar("diagnostic_period", 1.0, "Period of /diagnostics, seconds.", (0.05, 3600.0), read_only=True)
REALTIME_PRIORITY = Declaration(
    "realtime_priority", 0, "SCHED_FIFO priority, 1 to 99, if the system permits; 0: normal scheduling.",
    read_only=True, between=(0, 99),
)  # fmt: skip
ACCEPT_STAGE = text(
    "accept_stage", "", "Name of a stage that is taken for this one, which is logged at every start; empty: none.",
    read_only=True,
)  # fmt: skip
# Of simulators.
SEED = Declaration("seed", 0, "Seed of the random stage and of the noise.", between=(0, 2**53))


def voltage_limits(used: str = "", low: float = math.nan, high: float = math.nan) -> tuple[Declaration, ...]:
    """Declare voltage_min and voltage_max with defaults (V; NaN: required), and slew_limit; `used`: how much of it."""
    required = "; required" if math.isnan(low) else ""
    slew = f"Maximum rate of a voltage, V/s{used}; NaN: the voltage range in 0.1 s. 0: no limit."
    return (
        each_axis("voltage_min", low, f"Lower voltage limit, volts{required}.", VOLTAGE, required=True),
        each_axis("voltage_max", high, f"Upper voltage limit, volts{required}.", VOLTAGE, required=True),
        each_axis("slew_limit", math.nan, slew, (0.0, 1e9)),
    )


def limits_of(values: Values) -> tuple[Limits, ...]:
    """Return the limits of each axis from validated parameters; UsageError if voltage_min is not below voltage_max."""
    lows, highs = values["voltage_min"], values["voltage_max"]
    for name, low, high in zip(values["axes"], lows, highs, strict=True):
        if not low < high:
            raise UsageError(
                f"axis '{name}': voltage_min {low:g} and voltage_max {high:g} V: the first is not below the second; "
                "correct one of the two"
            )
    slews = slew_limits(values["slew_limit"], lows, highs)
    none = [0.0] * len(lows)
    accelerations, means = values.get("acceleration_limit", none), values.get("mean_rate_limit", none)
    return tuple(
        Limits(low, high, *(each or math.inf for each in rates))
        for low, high, *rates in zip(lows, highs, slews, accelerations, means, strict=True)
    )


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
        self._entries: dict[str, Declaration] = {}
        self._values: dict[str, Any] = {}
        for entry in declarations:
            # The names of the axes are declared first.
            for name in entry.names(self._values.get("axes") or ()):
                self._entries[name] = entry
                given = node.declare_parameter(name, entry.default, entry.descriptor())
                self._values[name] = entry.expanded(given.value)
        self.settings = make(self._values)
        self._tell_unknown(node)
        accepted = self._values.get("accept_stage")
        remarks = [acceptance(accepted, "accept_stage")] if accepted else []
        for remark in (*leading_zeros(sys.argv), *overridden(sys.argv, node), *remarks):
            node.get_logger().warning(remark)

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
        return {
            change.name: self._entries[change.name].expanded(change.value)
            for change in changes
            if change.name in self._entries
        }


def _listed(values: Values, name: str, default: Sequence[float], low: float, high: float) -> tuple[float, ...]:
    """Return the numbers, from `low` to `high`, of a parameter that is a list, or one number."""
    given = values.get(name, default)
    several = list(given) if isinstance(given, Sequence) and not isinstance(given, str) else [given]
    # An empty list is given as None.
    several = list(default) if several in ([], [None]) else several
    return tuple(numbers({name: several}, name, several, low, high))


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
