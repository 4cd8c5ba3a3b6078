"""A simulated stage to calibrate, without ROS and faster than real time."""

import numpy as np

from slpi_ros.calibration.closed_loop import ClosedLoop
from slpi_ros.calibration.run import Recording, Request
from slpi_ros.calibration.settings import CalibrationSettings
from slpi_ros.io.record import Record
from slpi_ros.model.limits import Limits
from slpi_ros.simulation.character import Character
from slpi_ros.simulation.stage import Stage

RATE = 200.0
# The stage rests this long between two drives, while the calibration computes, seconds.
PAUSE = 20.0


def settings(axes=("x",), **changes):
    values = {
        "axes": tuple(axes),
        "limits": (Limits(0.0, 100.0, 1000.0, 1e5),) * len(axes),
        "rest": (0.0,) * len(axes),
        "rate": RATE,
        "budget": 240.0 * len(axes),
    }
    return CalibrationSettings(**values | changes)


def stage_of(*characters: Character, seed: int = 3, noise_rms: float = 8e-9) -> Stage:
    return Stage.of("xyz"[: len(characters)], characters, seed, noise_rms)


class SimulatedRecorder:
    """Drives a simulated stage and keeps what it was asked for."""

    def __init__(self, stage: Stage) -> None:
        self.stage, self.now = stage, 1000.0
        self.requests: list[Request] = []
        self.recordings: list[Recording] = []

    def __call__(self, request: Request) -> Recording:
        self.requests.append(request)
        drive = request.drive
        rows = np.column_stack(list(drive.voltage.values())).tolist()
        t = (self.now + drive.t).tolist()
        if request.loops:
            rows, y = self._followed(request, t, rows)
        else:
            y = np.array([self.stage.measure(self.stage.step(at, row)) for at, row in zip(t, rows, strict=True)])
        time_ns = np.round((self.now + drive.t) * 1e9).astype(np.int64)
        self.now = t[-1] + PAUSE
        voltage = dict(zip(drive.axes, np.array(rows).T, strict=True))
        record = Record(time_ns, voltage, dict(zip(drive.axes, y.T, strict=True)), request.name, "simulated")
        self.recordings.append(Recording(record, request.desired))
        return self.recordings[-1]

    def _followed(self, request, t, rows):
        """Return voltages and readings with feedback, each from the reading before."""
        count = len(rows[0])
        loop = ClosedLoop(list(request.loops.values()), settings("xyz"[:count]).limits, RATE, rows[0])
        desired = np.column_stack(list(request.desired.values())).tolist()
        sent, readings = [], []
        for at, row, wanted in zip(t, rows, desired, strict=True):
            now_ns = round(at * 1e9)
            sent.append(loop.goals(row, wanted, now_ns))
            readings.append(self.stage.measure(self.stage.step(at, sent[-1])))
            loop.measure(readings[-1], now_ns + 1)
        return sent, np.array(readings)
