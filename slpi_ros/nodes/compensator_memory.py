"""The compensator's memory over a restart."""

from collections.abc import Mapping, Sequence

from rclpy.node import Node

from slpi_ros.compensator.controller import Compensation
from slpi_ros.compensator.persistence import (
    KNOWN,
    RESTORED,
    LastVoltages,
    SavedAxis,
    SavedMemory,
    last_voltages,
    load_memory,
    model_id,
    save_memory,
)
from slpi_ros.errors import SlpiError
from slpi_ros.model.limits import Limits
from slpi_ros.model.stage_model import StageModel

LOG_PERIOD = 60.0


class MemoryKeeper:
    """Keeps the memory in a file, if there is one; a file that cannot be read or written does not stop the node.

    Parameters
    ----------
    node : Node
    compensation : Compensation
    path : str
        "": none.
    """

    def __init__(self, node: Node, compensation: Compensation, path: str) -> None:
        self._log = node.get_logger()
        self._compensation, self._path = compensation, path
        self._saved: SavedMemory | None = None
        self._last: LastVoltages | None = None

    def find(self, model: StageModel, limits: Sequence[Limits]) -> Mapping[str, SavedAxis] | None:
        """Return where the axes were when the node last ended; None when nobody knows."""
        if not self._path:
            return None
        try:
            saved = load_memory(self._path)
            if saved is None:
                return None
            saved.require_fit(model, self._compensation.names, limits)
        except SlpiError as error:
            self._log.warning(str(error))
            return None
        return saved.axes

    def save(self, complete: bool) -> None:
        """Write the memory, if it has changed; `complete`: nothing will move until the node has ended."""
        model = self._compensation.model
        if not self._path or model is None:
            return
        axes = {
            axis.name: SavedAxis(axis.reversal_voltages, axis.memory_state in (KNOWN, RESTORED))
            for axis in self._compensation.axes
        }
        memory = SavedMemory(model_id(model), complete, axes)
        if memory == self._saved:
            return
        try:
            mark = save_memory(memory, self._path)
            self._saved = memory
            if complete:
                self._stop_noting()
            elif self._last:
                self._last.mark = mark
            else:
                self._last = last_voltages(self._path, mark)
        except SlpiError as error:
            self._complain(error)

    def note(self, voltages: bytes) -> None:
        """Note what has just been given, for a life after a crash; called for each command."""
        if self._last:
            try:
                self._last.note(voltages)
            except SlpiError as error:
                self._complain(error)

    def _stop_noting(self) -> None:
        if self._last:
            self._last.discard()
            self._last = None

    def _complain(self, error: SlpiError) -> None:
        self._log.error(str(error), throttle_duration_sec=LOG_PERIOD)
