"""What all simulated devices share: outputs with a simulated stage behind them, a log of them, and faults on demand."""

import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple, Self

import numpy as np

from slpi_ros.errors import UsageError
from slpi_ros.simulation.stage import Stage

# Time between looks at whether a simulator shall end, seconds.
LOOK = 0.02
# Of a sensor with an analog output.
VOLTS_PER_METRE = 1e5

SILENT, HALF, WRONG_AXIS, ERROR, LATE, TWICE, LOST, NONSENSE, NOT_FINITE = FAULTS = (
    "silent", "half", "wrong_axis", "error", "late", "twice", "lost", "nonsense", "not_finite",
)  # fmt: skip


@dataclass(frozen=True)
class Fault:
    """What goes wrong with the next answers to a question; UsageError if there is no such fault."""

    kind: str  # one of `FAULTS`
    question: str = ""  # by the device's own name; "": the reading of the position
    times: int = 1  # how many answers
    seconds: float = 0.3  # how late an answer comes, or how long no connection is accepted after a loss
    code: int = 17  # that the device tells

    def __post_init__(self) -> None:
        if self.kind not in FAULTS:
            raise UsageError(f"no fault '{self.kind}'; choose one of {', '.join(FAULTS)}")


class OutputChange(NamedTuple):
    """One change of the voltage at an output."""

    time_ns: int  # steady clock
    axis: str
    voltage: float  # V


class SimulatedDevice(ABC):
    """Outputs that move a simulated stage, served by a protocol in threads of its own.

    Parameters
    ----------
    axes : the device's names of the axes
    stage : what moves; by default a random one
    voltage_range : own range of the outputs, V
    voltages : at the outputs at the start, V
    gain : of an amplifier between output and stage, V/V
    answer_delay : time until an answer, s
    """

    usual_axes: tuple[str, ...] = ()  # names of the axes where none are given
    usual_address = ""  # where to serve where none is given
    question = ""  # the device's own name of the reading of the position
    error_question = ""  # where an error code is told; "": in the place of any answer

    def __init__(
        self,
        axes: Sequence[str],
        stage: Stage | None = None,
        *,
        voltage_range: tuple[float, float] = (0.0, 100.0),
        voltages: Sequence[float] | None = None,
        gain: float = 1.0,
        answer_delay: float = 0.0,
    ) -> None:
        self.axes = list(axes)
        self.stage = stage or Stage.random(self.axes, seed=1, noise_rms=0.0)
        self.low, self.high = voltage_range
        self.gain, self.answer_delay = gain, answer_delay
        self.log: list[OutputChange] = []
        self.received: list[str] = []  # what was asked and commanded, in order
        self.cycles = 0  # number of readings of the position
        self.fault: Fault | None = None
        self.address = ""  # for a driver
        self._voltages = dict(zip(self.axes, voltages or [0.0] * len(self.axes), strict=True))
        self._begun = time.monotonic()
        self._lock = threading.RLock()  # of the stage: a hand is another thread
        self.move()

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @classmethod
    def placed(cls, address: str) -> dict[str, Any]:
        """Return the settings that say where to serve; UsageError if the address is none."""
        host, _, port = (address or cls.usual_address).rpartition(":")
        if not host or not port.isdigit() or int(port) > 65_535:
            raise UsageError(f"address '{address}'; give HOST:PORT, such as {cls.usual_address}")
        return {"host": host, "port": int(port)}

    @abstractmethod
    def start(self) -> None:
        """Begin to serve; sets `address`. OSError where that does not go."""

    @abstractmethod
    def close(self) -> None:
        """End the server."""

    def voltage(self, axis: str) -> float:
        """Return the voltage (V) at the output of an axis."""
        return self._voltages[axis]

    def set_by_hand(self, axis: str, voltage: float) -> None:
        """Set a voltage (V) as the knob of a controller does."""
        self.output(axis, voltage)

    def output(self, axis: str, voltage: float) -> None:
        """Set the voltage (V) of an axis, and log it if it is another one."""
        with self._lock:
            if voltage != self._voltages[axis]:
                self.note(axis, [voltage], [time.monotonic_ns()])
                self.move()

    def note(self, axis: str, voltages: Sequence[float], times_ns: Sequence[int]) -> None:
        """Set and log the voltages (V) of an axis at times (ns); the stage follows when it is looked at."""
        before = [self._voltages[axis], *voltages]
        self._voltages[axis] = before[-1]
        changes = zip(times_ns, voltages, before, strict=False)
        self.log += [OutputChange(t, axis, v) for t, v, last in changes if v != last]

    def move(self, time_ns: int | None = None) -> list[float]:
        """Move the stage to the present time; return its readings (m) without noise."""
        low, high = self.stage.voltage_range
        with self._lock:
            felt = np.clip([self.gain * self._voltages[axis] for axis in self.axes], low, high).tolist()
            now = time.monotonic() if time_ns is None else time_ns * 1e-9
            return self.stage.step(now - self._begun, felt)

    def measure(self, time_ns: int | None = None) -> dict[str, float]:
        """Return what the sensor of each axis says (m)."""
        with self._lock:
            return dict(zip(self.axes, self.stage.measure(self.move(time_ns)), strict=True))

    def due(self, question: str) -> Fault | None:
        """Return the fault that this question meets, which counts."""
        fault = self.fault
        if fault is None:
            return None
        asked = self.error_question if fault.kind == ERROR and self.error_question else fault.question or self.question
        if question != asked:
            return None
        self.fault = replace(fault, times=fault.times - 1) if fault.times > 1 else None
        return fault
