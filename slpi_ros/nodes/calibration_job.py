"""A calibration in a worker process: it computes, and asks the node that drives the stage for each record."""

import json
import multiprocessing
import os
import threading
from dataclasses import asdict, dataclass, replace
from multiprocessing.connection import Connection, wait
from pathlib import Path

import numpy as np

from slpi_ros.arrays import FloatArray
from slpi_ros.calibration.kept import REMEDY
from slpi_ros.calibration.run import Progress, Recording, Request, aligned, calibrate
from slpi_ros.calibration.settings import CalibrationSettings
from slpi_ros.errors import RecordError, SlpiError
from slpi_ros.io.bag_reader import read_bag
from slpi_ros.nodes.jobs import WorkerProcess

# Topics of a bag. The second one, only in bags of a verification, holds the desired displacement, NaN before and after
# the path, and the commanded voltage.
STATE, PATH = "stage_state", "verification_path"


@dataclass(frozen=True)
class Wanted:
    """A drive to be recorded in the bag `name`."""

    name: str
    t: FloatArray  # s, (N,)
    voltage: FloatArray  # V, (N, axes)
    desired: FloatArray  # m, (N, axes), or (N, 0) if there is none


@dataclass(frozen=True)
class CalibrationRequest:
    """What the worker needs; `output` is the folder of bags and results, `node` the connection to the node."""

    settings: CalibrationSettings
    output: str
    node: Connection


@dataclass(frozen=True)
class CalibrationOutcome:
    """Outcome of a calibration: a model document and why the target is met or not, or an error with its exit code."""

    document: str = ""
    met: bool = False
    why: str = ""
    error: str = ""
    exit_code: int = 1


class CalibrationJob:
    """A calibration in a worker process; `output` is the folder of bags and results."""

    def __init__(self, settings: CalibrationSettings, output: Path) -> None:
        self._own, worker = multiprocessing.get_context("spawn").Pipe()
        request = CalibrationRequest(settings, str(output), worker)
        self._process = WorkerProcess(run_calibration, request, CalibrationOutcome, "calibrator: the computation")
        worker.close()

    def said(self) -> Progress | Wanted | None:
        """Return what the worker has said, if anything: its progress, or a drive that it wants; does not block."""
        try:
            if not self._own.poll():
                return None
            said = json.loads(self._own.recv_bytes())
            if "progress" in said:
                return Progress(**said["progress"])
            count, columns = said["axes"], np.frombuffer(self._own.recv_bytes())
        except (EOFError, OSError):
            return None
        columns = columns.reshape(said["samples"], -1)
        return Wanted(said["name"], columns[:, 0], columns[:, 1 : count + 1], columns[:, count + 1 :])

    def recorded(self, error: str = "") -> None:
        """Tell the worker that its drive is recorded, or why it is not."""
        self._own.send_bytes(json.dumps(error).encode())

    def outcome(self) -> CalibrationOutcome | None:
        """Return the outcome, or None while the worker is running; does not block."""
        return self._process.outcome()

    def end(self) -> None:
        """End the worker at once, wherever it is."""
        self._process.end()
        self._own.close()


def run_calibration(request: CalibrationRequest) -> CalibrationOutcome:
    """Calibrate a stage; entry point of the worker process."""
    # Imported here because they load slowly.
    from slpi_ros.model.document import format_model
    from slpi_ros.reports.calibration import write_files

    threading.Thread(target=_end_with_parent, daemon=True).start()
    node, output = request.node, Path(request.output)

    def report(progress: Progress) -> None:
        node.send_bytes(json.dumps({"progress": asdict(progress)}).encode())

    def record(wanted: Request) -> Recording:
        kept = (output / wanted.name).exists()
        if not kept:
            _ask(node, wanted)
        return replace(recording_of(output, wanted), kept=kept)

    try:
        outcome = calibrate(request.settings, record, report)
        write_files(output, outcome)
    except SlpiError as error:
        return CalibrationOutcome(error=str(error), exit_code=error.exit_code)
    return CalibrationOutcome(format_model(outcome.model), outcome.met, outcome.why)


def recording_of(output: Path, wanted: Request) -> Recording:
    """Return what the stage did during a drive, from its bag in the folder `output`."""
    bag = output / wanted.name
    try:
        record = replace(read_bag(bag, STATE), source=wanted.name)
        sent = read_bag(bag, PATH) if wanted.desired else None
    except SlpiError as error:
        raise type(error)(f"{error}; {REMEDY}") from None
    return Recording(record, {}) if sent is None else aligned(record, sent.time_ns, sent.voltage, sent.displacement)


def _ask(node: Connection, wanted: Request) -> None:
    """Ask the node for a record and wait for it; RecordError if it cannot be had."""
    drive = wanted.drive
    columns = np.column_stack([drive.t, *drive.voltage.values(), *wanted.desired.values()])
    said = {"name": wanted.name, "samples": len(columns), "axes": len(drive.voltage)}
    node.send_bytes(json.dumps(said).encode())
    node.send_bytes(np.ascontiguousarray(columns).tobytes())
    error = json.loads(node.recv_bytes())
    if error:
        raise RecordError(error)


def _end_with_parent() -> None:
    """End this process when the node that started it has ended, however it did."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        wait([parent.sentinel])
        os._exit(1)
