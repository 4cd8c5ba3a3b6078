"""Worker processes for identification, diagnosis, and the validation of large model documents."""

import json
import multiprocessing
import os
import signal
import threading
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, Generic, TypeVar

from slpi_ros.compensator.persistence import model_id
from slpi_ros.errors import ModelError, RecordError, SlpiError, dependencies_needed, shown
from slpi_ros.io.atomic_file import make_folder
from slpi_ros.io.input_limits import TOPIC_MODEL_CHARACTERS
from slpi_ros.io.record import Record
from slpi_ros.io.stage_name import same_stage
from slpi_ros.model.document import format_model, load_model, model_from, parse_model
from slpi_ros.model.stage_model import StageModel

Request = TypeVar("Request")
Outcome = TypeVar("Outcome")


class Worker:
    """A process that runs a function of a module with the other end of `connection`; `end` kills it at once."""

    def __init__(self, run: Callable[..., None], *given: Any) -> None:
        # Not fork: the middleware threads do not survive a fork.
        context = multiprocessing.get_context("spawn")
        self.connection, other = context.Pipe()
        self.process = context.Process(target=run, args=(other, *given), daemon=True)
        with normal_scheduling():
            # Begun with the first process, it would unblock the signal for that one.
            resource_tracker.ensure_running()
            # Ctrl-C, and the end of a terminal, reach the whole process group; this process ends the worker itself.
            blocked = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT, signal.SIGHUP})
            try:
                self.process.start()
            finally:
                signal.pthread_sigmask(signal.SIG_SETMASK, blocked)
        other.close()

    def end(self) -> None:
        """Kill the process and wait until it has ended."""
        self.process.kill()
        self.process.join()
        self.connection.close()


class WorkerProcess(Worker, Generic[Request, Outcome]):
    """Run a function of a module in a worker process and return its outcome without blocking.

    The class `outcome` is created with only `error` set if the process ends without a result, which then names `what`
    was done. Work that `talks` is given its connection, too: `outcome` also returns what it says before its outcome.
    """

    def __init__(
        self, work: Callable[..., Any], request: Request, outcome: type, what: str, talks: bool = False
    ) -> None:
        super().__init__(_run, work, request, outcome, talks)
        self.request, self._begun = request, time.monotonic()
        self._make, self._what = outcome, what

    @property
    def seconds(self) -> float:
        """Time since the start of the process (s)."""
        return time.monotonic() - self._begun

    def outcome(self) -> Outcome | None:
        """Return the outcome, or None while the process is running; does not block."""
        if not self.connection.poll():
            return None
        try:
            said: Outcome = self.connection.recv()
        except (EOFError, OSError):
            self.process.join()
            said = self._make(
                error=f"{self._what} ended with exit code {self.process.exitcode} and no result; check the "
                "available memory, or use a shorter record"
            )
        if isinstance(said, self._make):
            self.end()
        return said


def _run(connection: Connection, work: Callable[..., Any], request: Any, outcome: type, talks: bool) -> None:
    """Entry point of the process: send the outcome of a request."""
    # Like a line of the node's log, without the line of code that warns.
    warnings.formatwarning = lambda message, *_: f"[WARN] {shown(str(message))}\n"
    try:
        with dependencies_needed():
            said = work(request, connection) if talks else work(request)
    except SlpiError as error:
        said = outcome(error=str(error))
    connection.send(said)


@dataclass(frozen=True)
class StageIdentity:
    """Identity of a stage: hardware id, "" if unknown, and axes."""

    hardware_id: str
    axes: tuple[str, ...]

    @classmethod
    def of(cls, model: StageModel, before: "StageIdentity | None" = None) -> "StageIdentity":
        """Return the identity of a model's stage; a missing hardware id is taken from `before`."""
        return cls(model.hardware_id or (before.hardware_id if before else ""), tuple(model.axes))

    def require(self, record: Record) -> None:
        """Raise RecordError if `record` is from another stage."""
        other, lacking = "", [axis for axis in self.axes if axis not in record.axes]
        if lacking:
            other = f"no axis '{lacking[0]}', only {', '.join(record.axes)}"
        if not same_stage(record.hardware_id, self.hardware_id):
            other = f"of stage '{record.hardware_id}'"
        if other:
            name = f" of stage '{self.hardware_id}'" if self.hardware_id else ""
            raise RecordError(
                f"{record.source}: {other}, and skipped: the published model{name} holds {', '.join(self.axes)}; give "
                "each stage a node and a folder of its own, or name this bag in the parameter bags"
            )


@dataclass(frozen=True)
class BagsRequest:
    """Request for which all `bags` are read together."""

    bags: tuple[str, ...]
    topic: str

    @property
    def source(self) -> str:
        """Text that names the bags."""
        return ", ".join(self.bags)


@dataclass(frozen=True)
class FitRequest(BagsRequest):
    """Request of an identification in one fit."""

    kind: str
    start: float | None  # s, of the fitted part; None: first stamp
    stop: float | None  # s; None: last stamp
    output: str  # file for the model document; "": none
    stage: StageIdentity | None = None  # that the bags must belong to; None: any, unless `as_in_use`
    as_in_use: bool = False  # without a `stage` the bags must belong to that of the model in use, if there is one
    in_use: str = ""  # document of the model in use; "": that in `output`, if any
    unconditional: bool = False  # published whatever the comparison says
    sensor_delay: float = 0.0  # s, known
    sensor_lag: float = 0.0  # s, known
    surroundings: tuple[str, ...] = ()  # recorded quantities that the stage may follow

    @property
    def requires_stage_in_use(self) -> bool:
        """Whether the bags must belong to the stage of the model in use, if there is one."""
        return self.as_in_use and self.stage is None


@dataclass(frozen=True)
class FitOutcome:
    """Outcome of an identification: a model document or an error."""

    document: str = ""
    error: str = ""
    doubt: str = ""  # why the model must not replace the one in use automatically
    stage: StageIdentity | None = None  # that the bags had to belong to


def fit(request: FitRequest) -> FitOutcome:
    """Read the bags, identify the model and compare it with the one in use."""
    # Imported here because they load slowly: the compensator uses this module to read models only.
    from slpi_ros.model.sensor import Sensor
    from slpi_ros.verification.replacement import doubt_about
    from slpi_ros.workflows.identify import IdentifyRequest, identify
    from slpi_ros.workflows.records import Source

    in_use = _in_use(request)
    stage = StageIdentity.of(in_use) if in_use and request.requires_stage_in_use else request.stage
    try:
        sensor = Sensor(request.sensor_delay, request.sensor_lag)
        source = Source(
            request.bags, request.topic, start=request.start, stop=request.stop, surroundings=request.surroundings
        )
        records = source.read()
        if stage:
            for record in records:
                stage.require(record)
        model = identify(IdentifyRequest(replace(source, records=records), request.kind, sensor=sensor)).model
        document, doubt = format_model(model), ""
        if in_use and not request.unconditional and _is_of(StageIdentity.of(in_use), records):
            doubt = doubt_about(model, in_use, records)
    except SlpiError as error:
        return FitOutcome(error=str(error))
    return FitOutcome(document, doubt=doubt and f"{request.source}: {doubt}", stage=stage)


def _in_use(request: FitRequest) -> StageModel | None:
    """Return the model in use; None if there is none, or none that can be read."""
    try:
        if request.in_use:
            return parse_model(request.in_use, "stage_model")
        if request.output and Path(request.output).is_file():
            return load_model(request.output)
    except SlpiError:
        pass
    return None


def _is_of(stage: StageIdentity, records: Sequence[Record]) -> bool:
    """Return whether all records may be of a stage."""
    try:
        for record in records:
            stage.require(record)
    except RecordError:
        return False
    return True


@dataclass(frozen=True)
class DiagnosisRequest(BagsRequest):
    """Request of a diagnosis of the model `document`; `folder`: "" if not chosen yet."""

    document: str
    folder: str = ""
    surroundings: tuple[str, ...] = ()  # recorded quantities that are looked at; empty: all
    start: float | None = None  # s, of the fitted part; None: first stamp
    stop: float | None = None  # s; None: last stamp


@dataclass(frozen=True)
class DiagnosisOutcome:
    """Outcome of a diagnosis: verdict and summary of each axis, or an error."""

    verdicts: dict[str, str] = field(default_factory=dict)
    summaries: dict[str, str] = field(default_factory=dict)
    error: str = ""


def run_diagnosis(request: DiagnosisRequest) -> DiagnosisOutcome:
    """Read the bags, diagnose the model and write the output files."""
    from slpi_ros.reports.diagnosis import FILES, write_files
    from slpi_ros.workflows.diagnose import DiagnoseRequest, diagnose
    from slpi_ros.workflows.records import Source

    folder = Path(request.folder)
    try:
        make_folder(folder, *FILES)
        model = parse_model(request.document, "stage_model")
        quantities = request.surroundings or None
        source = Source(request.bags, request.topic, start=request.start, stop=request.stop, surroundings=quantities)
        diagnosis = diagnose(DiagnoseRequest(source, model)).diagnosis
        write_files(folder, diagnosis)
    except SlpiError as error:
        return DiagnosisOutcome(error=str(error))
    return DiagnosisOutcome(
        {axis: found.verdict for axis, found in diagnosis.axes.items()},
        {axis: found.summary for axis, found in diagnosis.axes.items()},
    )


# Characters. The validation of a longer document could delay commands by several milliseconds in any thread of this
# process; typical documents have ten thousand characters, the finest 300,000 for each axis.
SMALL = 65_536
# Polling period for the end of a validation, seconds.
POLL_PERIOD = 0.02

# A model and its fingerprint.
Read = tuple[StageModel, str]


@dataclass(frozen=True)
class CheckOutcome:
    """Outcome of a validation: the fingerprint of the model, or an error."""

    fingerprint: str = ""
    error: str = ""


def check(request: tuple[str, str]) -> CheckOutcome:
    """Validate a model document; `request` holds its text, and its name in messages."""
    return CheckOutcome(model_id(parse_model(*request)))


class Reading:
    """Validation of a model document, called `source` in messages, in the background; ModelError if too large."""

    def __init__(self, document: str, source: str) -> None:
        if len(document) > TOPIC_MODEL_CHARACTERS:
            raise ModelError(
                f"{source}: {len(document)} characters are more than {TOPIC_MODEL_CHARACTERS}; give a document of "
                "'slpi identify'"
            )
        self._document, self._source = document, source
        self._unwanted = threading.Event()

    def cancel(self) -> None:
        """Cancel the validation."""
        self._unwanted.set()

    def read(self) -> Read | None:
        """Return the model and its fingerprint, None if canceled; ModelError if the document is not valid."""
        if self._unwanted.is_set():
            return None
        if len(self._document) <= SMALL:
            model = parse_model(self._document, self._source)
            return model, model_id(model)
        try:
            checking: WorkerProcess[tuple[str, str], CheckOutcome] = WorkerProcess(
                check, (self._document, self._source), CheckOutcome, f"{self._source}: the check of the model"
            )
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
def normal_scheduling() -> Iterator[None]:
    """Start child processes with normal scheduling, even if this thread has real-time priority."""
    if not hasattr(os, "sched_getscheduler") or os.sched_getscheduler(0) == os.SCHED_OTHER:
        yield
        return
    policy, parameters = os.sched_getscheduler(0), os.sched_getparam(0)
    os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
    try:
        yield
    finally:
        with suppress(OSError):
            os.sched_setscheduler(0, policy, parameters)
