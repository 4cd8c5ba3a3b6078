"""The compensator's service ``~/reset_memory``."""

from collections.abc import Callable

from rclpy.node import Node

from slpi_ros.compensator.controller import Compensation
from slpi_ros.compensator.persistence import KNOWN
from slpi_ros.nodes.common import DeferredService
from slpi_ros.nodes.compensator_diagnostics import Reporter
from slpi_ros.nodes.compensator_driver import Driver
from slpi_ros.nodes.compensator_parameters import CompensatorSettings
from slpi_ros.nodes.compensator_silence import Silence


class MemoryReset:
    """Starts a reset of the memory when asked to, and answers when it is done.

    Parameters
    ----------
    node : Node
    compensation : Compensation
    driver : Driver
    reporter : Reporter
    silence : Silence
    settings : callable
        Returns the present ones.
    """

    def __init__(
        self,
        node: Node,
        compensation: Compensation,
        driver: Driver,
        reporter: Reporter,
        silence: Silence,
        settings: Callable[[], CompensatorSettings],
    ) -> None:
        self._compensation, self._driver, self._reporter, self._settings = compensation, driver, reporter, settings
        self._silence = silence
        self._service = DeferredService(node, "~/reset_memory", self._start)

    def _start(self) -> str:
        """Start a reset, unless one is under way; return why that cannot be, or ""."""
        compensation, settings = self._compensation, self._settings()
        if not compensation.active or compensation.model is None:
            return "not reset: there must be a model, and the node must be active"
        if compensation.following.on:
            return f"not reset: {compensation.following.busy}"
        if not compensation.driving.resetting:
            finals = settings.safety.voltages if settings.reset.to_safe else compensation.voltages
            compensation.driving.reset(settings.reset.cycles, settings.reset.rate, finals)
            self._driver.start(self._on_end)
            self._reporter.report()
        return ""

    def _on_end(self, arrived: bool) -> None:
        self._silence.after_reset()
        axes, voltages = self._compensation.axes, ", ".join(f"{v:.6g}" for v in self._compensation.voltages)
        doubts = [f"axis '{axis.name}': {axis.trust.doubt}" for axis in axes if axis.memory_state != KNOWN]
        if not arrived:
            said = "interrupted; the memory is assumed"
        elif doubts:
            said = f"memory assumed; voltages {voltages} V; {'; '.join(doubts)}"
        else:
            said = f"memory known; voltages {voltages} V"
        self._service.answer(not doubts, said)
        self._reporter.report()
