"""The reading of one model document; a large one is checked in a process of its own."""

import json
import os
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass

from slpi_ros.compensator.persistence import model_id
from slpi_ros.errors import ModelError, SlpiError
from slpi_ros.model.document import model_from, parse_model
from slpi_ros.model.stage_model import StageModel
from slpi_ros.nodes.worker_process import WorkerProcess

# Characters. To check more of them, hostile ones, would keep commands waiting for more than some milliseconds, in
# whatever thread it is done; documents of stages have some ten thousand, at the finest 300,000 for each axis.
SMALL, LARGEST = 65_536, 2_000_000
# How often is looked whether a check is done, seconds.
POLL_PERIOD = 0.02

# A model and its fingerprint.
Read = tuple[StageModel, str]


@dataclass(frozen=True)
class CheckRequest:
    """What to check: a model document, and where it came from."""

    document: str
    source: str


@dataclass(frozen=True)
class CheckOutcome:
    """What came of it: the fingerprint of the model, or an error."""

    fingerprint: str = ""
    error: str = ""


class CheckProcess(WorkerProcess[CheckRequest, CheckOutcome]):
    """A check under way."""

    def __init__(self, request: CheckRequest) -> None:
        with _in_no_hurry():
            super().__init__(check, request, CheckOutcome, f"{request.source}: the check of the model")


def check(request: CheckRequest) -> CheckOutcome:
    """Read a model document."""
    try:
        return CheckOutcome(fingerprint=model_id(parse_model(request.document, request.source)))
    except SlpiError as error:
        return CheckOutcome(error=str(error))


class Reading:
    """One model document to be read in the background.

    Parameters
    ----------
    document, source : str
        The source names it in messages.

    Raises
    ------
    ModelError
        If it is too large.
    """

    def __init__(self, document: str, source: str) -> None:
        if len(document) > LARGEST:
            raise ModelError(
                f"{source}: {len(document)} characters are more than {LARGEST}; give a document of 'slpi identify'"
            )
        self._document, self._source = document, source
        self._unwanted = threading.Event()

    def cancel(self) -> None:
        """Come to an end soon: nobody wants the model any more."""
        self._unwanted.set()

    def read(self) -> Read | None:
        """Return the model and its fingerprint; None once it is unwanted.

        Raises
        ------
        ModelError
            If it is no valid model document.
        """
        if self._unwanted.is_set():
            return None
        if len(self._document) <= SMALL:
            model = parse_model(self._document, self._source)
            return model, model_id(model)
        try:
            checking = CheckProcess(CheckRequest(self._document, self._source))
        except OSError as error:
            raise ModelError(f"{self._source}: cannot be checked: {error.strerror}; send it again") from None
        try:
            while (outcome := checking.outcome()) is None:
                if self._unwanted.wait(POLL_PERIOD):
                    return None
        finally:
            checking.end()
        if outcome.error:
            raise ModelError(outcome.error)
        return model_from(json.loads(self._document), self._source), outcome.fingerprint


@contextmanager
def _in_no_hurry() -> Iterator[None]:
    """Start what this thread starts as any other process, even if the thread itself runs in real time."""
    if not hasattr(os, "sched_getscheduler"):
        yield
        return
    policy, parameters = os.sched_getscheduler(0), os.sched_getparam(0)
    if policy == os.SCHED_OTHER:
        yield
        return
    os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
    try:
        yield
    finally:
        with suppress(OSError):
            os.sched_setscheduler(0, policy, parameters)
