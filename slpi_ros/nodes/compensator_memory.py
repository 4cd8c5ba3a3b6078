"""The memory of a compensator: kept in a file, assumed or reset at the start, and reset by ``~/reset_memory``."""

import time
from collections.abc import Mapping

from rclpy.node import Node

from slpi_ros.compensator.axis import Axis
from slpi_ros.compensator.controller import Controller, OperatingMode
from slpi_ros.compensator.motion import reset_limits
from slpi_ros.compensator.persistence import INTERRUPTED, KNOWN, RESTORED, MemoryFile, SavedAxis, load_memory
from slpi_ros.compensator.validation import RejectedError
from slpi_ros.errors import ModelError, SlpiError
from slpi_ros.model.limits import volts
from slpi_ros.model.stage_model import StageModel
from slpi_ros.nodes.common import DeferredService, serve
from slpi_ros.nodes.compensator_diagnostics import Reporter

# Shortest time between two log messages about files, seconds.
FILE_LOG_PERIOD = 60.0


class Memory:
    """Save and restore the memory of a stage over restarts, and reset it.

    Of every voltage that somebody has received, the next start knows, even after a SIGKILL: `note` stores it before it
    is published.
    """

    def __init__(self, node: Node, controller: Controller, path: str, reporter: Reporter) -> None:
        self._node, self._controller, self._reporter = node, controller, reporter
        self._file = MemoryFile(path) if path else None
        self._waits = False  # for the voltages at the start, before it begins
        self._asked = False  # for a reset that waits until it is known who else is there
        self._service = DeferredService(node, "~/reset_memory", self._on_reset)
        serve(node, "~/set_zero", self._on_set_zero)

    # The file

    def find(self, model: StageModel) -> tuple[Mapping[str, SavedAxis] | None, Mapping[str, float] | None]:
        """Return what was saved with a model before the first one, and if it was another one, its last voltages (V)."""
        if self._file is None or self._controller.axes[0].model:
            return None, None
        saved = None
        try:
            saved = load_memory(self._file.path)
            if saved:
                self._controller.ownership.left = None if self._file.used else saved.last_voltages
                saved.require_fit(model, self._controller.names)
        except SlpiError as error:
            self._node.get_logger().warning(str(error))
            return None, saved.last_voltages if saved else None
        return saved.axes if saved else None, None

    def note(self, voltages: bytes) -> None:
        """Store voltages (V, native doubles) that are about to be published."""
        if self._file:
            try:
                self._file.note(voltages)
            except ModelError as error:
                self._tell(error)

    def save(self, *, complete: bool) -> None:
        """Save the memory, or log the error; `complete` means that no further voltage is output afterwards."""
        model = self._controller.identified
        if self._file is None or model is None:
            return
        now_ns = time.monotonic_ns()
        try:
            axes = {axis.name: axis.saved(now_ns) for axis in self._controller.axes}
            self._file.save(model, axes, complete)
        except SlpiError as error:
            self._tell(error)

    def _tell(self, error: SlpiError) -> None:
        self._node.get_logger().error(str(error), throttle_duration_sec=FILE_LOG_PERIOD)

    # At the start

    def begin(self) -> None:
        """Warn once about an assumed memory, or start a reset if `reset_on_start`; only when active with a model."""
        controller = self._controller
        unsure = [axis for axis in controller.axes if axis.confidence.state not in (KNOWN, RESTORED)]
        idle = controller.mode in (OperatingMode.STREAMING, OperatingMode.RAMPING)
        if controller.model is None or not idle or not unsure:
            return
        resets, ownership = self._reporter.settings.values["reset_on_start"], controller.ownership
        if resets and ownership.listening:
            # It goes over the whole range: first everybody is found.
            ownership.left = None
            controller.locate(time.monotonic_ns())
        # As soon as the voltages are known.
        self._waits = ownership.obstacle is not None
        if self._waits:
            return
        if resets:
            self._start_reset()
            return
        said = "; ".join(f"axis '{axis.name}' {_assumed(axis)}" for axis in unsure)
        advice = f"call {self._node.get_fully_qualified_name()}/reset_memory (~/reset_memory) to reset it"
        self._reporter.log.remark("assumed", f"the memory is assumed: {said}; {advice}, or set reset_on_start")

    def poll(self) -> None:
        """Do what has waited, as soon as it is known who else is there and where the amplifiers are."""
        if self._asked and not self._looking:
            self._asked = False
            if why := self._on_reset():
                self._service.answer(False, why)
        if self._waits and not self._controller.ownership.obstacle:
            self.begin()
            self._reporter.report()

    @property
    def _looking(self) -> bool:
        """Whether the middleware may not have found everybody yet."""
        controller, listening = self._controller, self._controller.ownership.listening
        waits = controller.active and controller.model is not None and not controller.ownership.started
        return bool(waits and listening and not listening.looks(time.monotonic_ns()))

    # Zeros and resets

    def _on_set_zero(self) -> tuple[bool, str]:
        """Let the zeros of the models agree with the sensors; nothing moves."""
        try:
            moved = self._controller.set_zero(time.monotonic_ns())
        except SlpiError as error:
            return False, f"not set: {error}"
        said = [
            f"axis '{name}': the zero moves by {offset * 1e6:+.4f} µm"
            if offset is not None
            else f"axis '{name}': not set, no measured_displacement in the last 0.2 s; remap it to that of the sensor"
            for name, offset in moved.items()
        ]
        unsure = [axis.name for axis in self._controller.axes if axis.confidence.state not in (KNOWN, RESTORED)]
        if unsure:
            said.append(f"the memory of axis {', '.join(unsure)} is assumed: reset it, then set the zero again")
        self._node.get_logger().info(f"~/set_zero: {'; '.join(said)}")
        self.save(complete=False)
        self._reporter.report()
        return None not in moved.values(), "; ".join(said)

    def _on_reset(self) -> str:
        """Start a reset unless one is running; return the reason if this is not possible, else ""."""
        self._asked = self._looking
        if self._asked:
            return ""
        if self._controller.mode is not OperatingMode.RESETTING:
            try:
                self._start_reset()
            except RejectedError as error:
                return f"not reset: {error}"
        return ""

    def _start_reset(self) -> None:
        settings, controller = self._reporter.settings, self._controller
        values, spans = settings.values, settings.reset_spans
        finals = values["safe_voltage"] if values["reset_to"] == "safe" else list(controller.voltages)
        controller.reset_memory(values["reset_cycles"], values["reset_rate"], finals, time.monotonic_ns(), spans)
        over = ", ".join(
            f"axis '{axis.name}' {limits.lower:g} to {limits.upper:g} V"
            for axis, limits in zip(controller.axes, reset_limits(controller.axes, spans), strict=True)
        )
        self._node.get_logger().warning(
            f"reset_memory moves the stage over its range: {over}; keep tip and sample apart"
        )
        self._reporter.report()

    def answer_reset(self) -> None:
        """Send the response of the service ``~/reset_memory`` with the result of the reset."""
        axes, voltages = self._controller.axes, volts(*self._controller.voltages)
        doubts = [f"axis '{axis.name}': {axis.confidence.doubt}" for axis in axes if axis.confidence.state != KNOWN]
        if any(axis.confidence.doubt == INTERRUPTED for axis in axes):
            said = "interrupted; the memory is assumed"
        elif doubts:
            said = f"memory assumed; voltages {voltages} V; {'; '.join(doubts)}"
        else:
            said = f"memory known; voltages {voltages} V"
        if doubts:
            self._node.get_logger().warning(f"~/reset_memory: {said}")
        else:
            self._node.get_logger().info(f"~/reset_memory: {said}")
        self._service.answer(not doubts, said)


def _assumed(axis: Axis) -> str:
    """Return a text that describes the assumed memory of an axis."""
    start = axis.initial.assumed
    if axis.confidence.doubt or not start:
        return axis.confidence.doubt or "has not been reset"
    where = {"end": "at the end of the record", "start": "at the start of the record", "wiped": "as after a reset"}
    text = f"starts {where[start]}, at {volts(axis.stream.voltage)} V (start_memory {start})"
    if start == "end" and axis.model and axis.model.end is None:
        text += "; the model holds no end, its start is used"
    return text
