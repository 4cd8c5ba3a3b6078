"""The identify node's service ``~/diagnose``."""

import os
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from rclpy.clock import Clock, ClockType
from rclpy.node import Node

from slpi_ros.nodes.diagnosis_process import DiagnosisOutcome, DiagnosisProcess, DiagnosisRequest
from slpi_ros.nodes.late_service import LateService

POLL_PERIOD = 0.1
NO_MODEL = "nothing to diagnose: no bag has been identified yet"


@dataclass(frozen=True)
class Identified:
    """A model and where it came from.

    Parameters
    ----------
    bag, topic : str
        The newest bag of the fit.
    document : str
    """

    bag: str
    topic: str
    document: str


class DiagnosisService:
    """Says what the model in use gets wrong on the bag it was fitted to, and answers when that is known.

    Writes files and publishes nothing: a diagnosis changes no model that is running.

    Parameters
    ----------
    node : Node
    identified : callable
        Returns the model in use; None where there is none.
    folder : callable
        Returns the folder to write into; "": a temporary one.
    report : callable
        Is called when a diagnosis begins and when it ends.
    """

    def __init__(
        self,
        node: Node,
        identified: Callable[[], Identified | None],
        folder: Callable[[], str],
        report: Callable[[], None],
    ) -> None:
        self._logger = node.get_logger()
        self._identified, self._folder, self._report = identified, folder, report
        self._job: DiagnosisProcess | None = None
        self._last: DiagnosisRequest | None = None
        self._outcome = DiagnosisOutcome()
        self._temporary = ""
        self._service = LateService(node, "~/diagnose", self._start)
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._poll = node.create_timer(POLL_PERIOD, self._look, clock=steady, autostart=False)

    @property
    def error(self) -> str:
        """Why the last diagnosis failed; "" where it did not."""
        return self._outcome.error

    @property
    def doing(self) -> str:
        """What is under way, in words; "" when nothing is."""
        return f"diagnosing {self._job.request.bag} for {time.monotonic() - self._began:.0f} s" if self._job else ""

    @property
    def values(self) -> dict[str, object]:
        """What ``/diagnostics`` shows."""
        state = "diagnosing" if self._job else "failed" if self.error else "done" if self._last else "none"
        return {
            "diagnosis.state": state,
            "diagnosis.bag": self._last.bag if self._last else "",
            "diagnosis.folder": self._last.folder if self._last else "",
            **{f"{axis}.verdict": verdict for axis, verdict in self._outcome.verdicts.items()},
            **{f"{axis}.diagnosis": summary for axis, summary in self._outcome.summaries.items()},
        }

    def forget(self) -> None:
        """Forget what was found: another model is in use."""
        if not self._job:
            self._last, self._outcome = None, DiagnosisOutcome()

    def end(self) -> None:
        """End the diagnosis under way."""
        self._poll.cancel()
        if self._job:
            self._job.end()
            self._job = None

    def _start(self) -> str:
        """Start a diagnosis, unless one is under way; return why that cannot be, or ""."""
        if self._job:
            return ""
        identified = self._identified()
        if not identified:
            return NO_MODEL
        try:
            folder = os.path.abspath(self._folder() or self._temporary_folder())
            request = DiagnosisRequest(identified.bag, identified.topic, identified.document, folder)
            self._job, self._began = DiagnosisProcess(request), time.monotonic()
        except OSError as error:
            return f"no diagnosis can be started: {error}; free memory or disk, or set diagnosis_directory"
        self._last, self._outcome = request, DiagnosisOutcome()
        self._poll.reset()
        self._report()
        return ""

    def _temporary_folder(self) -> str:
        self._temporary = self._temporary or tempfile.mkdtemp(prefix="slpi_diagnosis_")
        return self._temporary

    def _look(self) -> None:
        """Look whether the diagnosis is done."""
        outcome = self._job.outcome() if self._job else None
        if not self._job or not outcome:
            return
        folder, self._job, self._outcome = Path(self._job.request.folder), None, outcome
        self._poll.cancel()
        if outcome.error:
            self._logger.error(outcome.error)
            self._service.answer(False, outcome.error)
        else:
            said = "; ".join(
                f"{axis}: {verdict.replace('_', ' ')}: {outcome.summaries[axis]}"
                for axis, verdict in outcome.verdicts.items()
            )
            said += f" Page: {folder / 'report.html'}; extended model, not in use: {folder / 'extended_model.json'}"
            self._logger.info(said)
            self._service.answer(True, said)
        self._report()
