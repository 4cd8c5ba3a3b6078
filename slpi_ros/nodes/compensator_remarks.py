"""What the compensator logs about its axes: each remark once, and again only when it has changed."""

from collections.abc import Callable

from rclpy.node import Node

from slpi_ros.compensator.amplifier import Calibration
from slpi_ros.compensator.axis import Axis
from slpi_ros.compensator.controller import Controller
from slpi_ros.compensator.path_watch import PathWatch

# Minimum time between two log messages of the same kind, seconds.
LOG_PERIOD = 5.0


class Remarks:
    """Log what has become noteworthy about a controller; `warned` is called where diagnostics should tell it, too."""

    def __init__(self, node: Node, controller: Controller, warned: Callable[[], None]) -> None:
        self._logger, self._controller, self._warned = node.get_logger(), controller, warned
        self._noted: set[str] = set()
        self._doubts: dict[str, str] = {}
        self._calibrations: dict[str, Calibration] = {}
        self._beyond: dict[str, PathWatch] = {}
        self._excursions = 0
        self._too_fast = ""

    def tell_notes(self) -> None:
        """Tell what is not certain about the voltages at the start."""
        notes = {name: note for name, note in self._controller.ownership.notes.items() if note}
        if not self._controller.ownership.obstacle and notes and notes.keys() != self._noted:
            self._noted = set(notes)
            for name, note in notes.items():
                self._logger.warning(f"axis '{name}': {note}")

    def tell_doubts(self) -> None:
        """Tell what has become doubtful about the memory of an axis."""
        for axis in self._controller.axes:
            doubt = axis.confidence.doubt
            if doubt and doubt != self._doubts.get(axis.name):
                self._logger.warning(f"axis '{axis.name}': {doubt}", throttle_duration_sec=LOG_PERIOD)
            self._doubts[axis.name] = doubt

    def tell_calibrations(self) -> None:
        """Tell that the reported voltages differ by a constant gain or offset, which is not followed."""
        for axis in self._controller.axes:
            found = axis.amplifier.calibration
            if found != self._calibrations.get(axis.name, Calibration()):
                self._calibrations[axis.name] = found
                self._logger.warning(
                    f"axis '{axis.name}': stage_state reports {found.gain:.4g} times the output {found.offset:+.4g} V "
                    "(effort): a matter of calibration, it is not followed"
                )

    def tell_beyond(self) -> None:
        """Tell, for each model, that a path is faster than its record."""
        for axis in self._controller.axes:
            if axis.path is not self._beyond.get(axis.name) and axis.path.beyond:
                self._beyond[axis.name] = axis.path
                self._logger.warning(
                    f"axis '{axis.name}': {axis.path.beyond}; errors may be larger than told, record at that rate "
                    "(slpi excite --for-path)"
                )
                self._warned()

    def tell_too_fast(self, *, anew: bool = False) -> None:
        """Tell that a trajectory is too fast for the slew limit; with `anew`, although the last one was, too."""
        said = self._controller.too_fast
        if said and (anew or said != self._too_fast):
            self._logger.warning(f"trajectory {said}; send it more slowly, or raise slew_limit")
        self._too_fast = said or ("" if anew else self._too_fast)

    @property
    def has_excursion(self) -> bool:
        """Whether a displacement beyond those that can be reached was not told yet."""
        return self._controller.counts.excursions > self._excursions

    def tell_held(self) -> None:
        """Tell, for each excursion, that a displacement cannot be reached."""
        self._warned()
        if self.has_excursion:
            self._excursions = self._controller.counts.excursions
            held = [axis for axis in self._controller.axes if axis.held]
            out = [f"axis {axis.name}{_reach(axis)}" for axis in held]
            remedy = "send displacements within the identified range"
            if all(_in_range(axis) for axis in held):
                remedy = (
                    "that is within the range: send a slower path, one further from its ends, or widen voltage_min and "
                    "voltage_max if they are narrower than the model"
                )
            said = f"desired displacement out of reach, held at a voltage limit: {', '.join(out)}"
            self._logger.warning(f"{said}; {remedy}")


def _reach(axis: Axis) -> str:
    """Return the desired displacement of an axis beside the identified range as text."""
    desired, model = axis.tracking.desired, axis.model
    if desired is None or model is None:
        return ""
    low, high = model.displacement_range
    return f" at {desired * 1e6:.5g} of {low * 1e6:.5g} to {high * 1e6:.5g} µm"


def _in_range(axis: Axis) -> bool:
    """Return whether the desired displacement of an axis is in the identified range: what is too much is its rate."""
    desired, model = axis.tracking.desired, axis.model
    if desired is None or model is None:
        return False
    low, high = model.displacement_range
    return low <= desired <= high
