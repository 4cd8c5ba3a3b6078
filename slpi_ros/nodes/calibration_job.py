"""A calibration in a worker process: it computes, and asks the node that drives the stage for each record."""

import multiprocessing
import os
import threading
import time
from contextlib import suppress
from dataclasses import dataclass, replace
from multiprocessing.connection import Connection, wait
from pathlib import Path

import numpy as np

from slpi_ros.arrays import FloatArray
from slpi_ros.calibration.closed_loop import AxisLoop
from slpi_ros.calibration.kept import REMEDY
from slpi_ros.calibration.run import Progress, Recording, Request, aligned, calibrate
from slpi_ros.calibration.settings import CalibrationSettings
from slpi_ros.errors import SlpiError
from slpi_ros.io.bag_reader import read_bag
from slpi_ros.io.stage_name import stage_name
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
    loops: tuple[AxisLoop, ...] = ()  # feedback along the path; none: without


# Settings, the folder of bags and results, and the time of the stage, s.
CalibrationRequest = tuple[CalibrationSettings, Path, float]


@dataclass(frozen=True)
class CalibrationOutcome:
    """Outcome of a calibration: a model document and why the target is met or not, or an error with its exit code."""

    document: str = ""
    met: bool = False
    why: str = ""
    error: str = ""
    exit_code: int = 1


class CalibrationJob(WorkerProcess[CalibrationRequest, Progress | Wanted | CalibrationOutcome]):
    """A calibration in a worker process, which also tells its progress and the drives that it wants."""

    def __init__(self, settings: CalibrationSettings, output: Path, clock: float) -> None:
        what = "calibrator: the computation"
        super().__init__(run_calibration, (settings, output, clock), CalibrationOutcome, what, talks=True)

    def recorded(self, off: str, clock: float) -> None:
        """Tell the worker that its drive is recorded, why feedback was switched off, and the time of the stage (s).

        `outcome` tells of its end.
        """
        with suppress(BrokenPipeError, ConnectionResetError):
            self.connection.send((off, clock))


def run_calibration(request: CalibrationRequest, node: Connection) -> CalibrationOutcome:
    """Calibrate a stage; entry point of the worker process."""
    # Imported here because they load slowly.
    from slpi_ros.model.document import format_model
    from slpi_ros.reports.calibration import write_files

    threading.Thread(target=_end_with_parent, daemon=True).start()
    settings, output, begun = request
    clock = StageClock(begun)

    def record(wanted: Request) -> Recording:
        kept = (output / wanted.name).exists()
        if not kept:
            columns = np.column_stack([*wanted.drive.voltage.values(), *wanted.desired.values()])
            voltage, desired = np.split(columns, [len(wanted.drive.voltage)], axis=1)
            node.send(Wanted(wanted.name, wanted.drive.t, voltage, desired, tuple(wanted.loops.values())))
        off = ""
        if not kept:
            off, now = node.recv()
            clock.set(now)
        return replace(recording_of(output, wanted), kept=kept, off=off)

    try:
        outcome = calibrate(settings, record, node.send, clock)
        write_files(output, outcome)
    except SlpiError as error:
        return CalibrationOutcome(error=str(error), exit_code=error.exit_code)
    return CalibrationOutcome(format_model(outcome.model), outcome.met, outcome.why)


class StageClock:
    """Time of the stage (s), which may be simulated: as fast as between the last two times that it was set."""

    def __init__(self, now: float) -> None:
        self._set, self._steady, self._speed = now, time.monotonic(), 1.0

    def set(self, now: float) -> None:
        """Set it to `now` (s)."""
        steady = time.monotonic()
        if steady > self._steady:
            self._speed = max(now - self._set, 0.0) / (steady - self._steady)
        self._set, self._steady = now, steady

    def __call__(self) -> float:
        """Return the time (s)."""
        return self._set + self._speed * (time.monotonic() - self._steady)


def stage_of_kept(output: Path) -> str:
    """Return the name of the stage of the first bag in a folder that names one, "" if none does."""
    for bag in sorted(output.iterdir()):
        with suppress(SlpiError):
            if bag.is_dir() and not bag.name.startswith(".") and (name := stage_name(read_bag(bag, STATE).hardware_id)):
                return name
    return ""


def recording_of(output: Path, wanted: Request) -> Recording:
    """Return what the stage did during a drive, from its bag in the folder `output`."""
    bag = output / wanted.name
    try:
        record = replace(read_bag(bag, STATE), source=wanted.name)
        sent = read_bag(bag, PATH) if wanted.desired else None
    except SlpiError as error:
        raise type(error)(f"{error}; {REMEDY}") from None
    return Recording(record, {}) if sent is None else aligned(record, sent.time_ns, sent.voltage, sent.displacement)


def _end_with_parent() -> None:
    """End this process when the node that started it has ended, however it did."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        wait([parent.sentinel])
        os._exit(1)
