"""A controller that speaks PI's General Command Set over TCP or a pseudo terminal, with a simulated stage behind it.

Written independently of the driver. What is simulated: axes, one output for each, the servo as a switch that holds the
voltage, the own range of voltages, error codes. Syntax: user manual of E-727 (E727T0005, page 178).
"""

import time
from collections.abc import Callable, Sequence
from typing import Any

from slpi_ros.simulation.devices.base import ERROR, NONSENSE, NOT_FINITE, WRONG_AXIS, Fault
from slpi_ros.simulation.devices.gcs_waves import SimulatedWaves
from slpi_ros.simulation.devices.stream import StreamSimulator
from slpi_ros.simulation.stage import Stage

IDENTITY = "(c)2020 Physik Instrumente (PI) GmbH & Co. KG, E-727.SIMULATED, {serial}, 13.21.00.09"
SERIAL = "0123456789"
COMMANDS = (
    "*IDN?", "ERR?", "HLP?", "ONL?", "POS?", "PUN?", "SAI?", "SVA", "SVA?", "SVO", "SVO?", "TMN?", "TMX?", "VMA?",
    "VMI?", "VOL?", "WAV", "WSL", "WGC", "WTR", "WGO", "WGO?", "WGI?", "SPA?", "RTR", "DRC", "DRR?",
)  # fmt: skip
MICROMETRE = 1e-6
# Metres of the units in which it counts.
UNITS = {"MM": 1e-3, "UM": MICROMETRE, "NM": 1e-9}
TRAVEL = 25.0 * MICROMETRE


class GcsSimulator(StreamSimulator):
    """A simulated controller.

    Parameters
    ----------
    axes : names of the axes; output channels are numbered from 1
    stage : what moves; by default a random one
    servo : whether the servo is on at the start
    units_per_volt : of ``SVA``, which is not in volts on every controller
    without : commands that this controller has not got
    unit : in which it counts positions, and which ``PUN?`` tells; one of `UNITS`
    serial : its serial number
    named : what every device has, and where to serve: `host` and `port`, or the `path` of a pseudo terminal
    """

    usual_axes, usual_address = ("1",), "127.0.0.1:50000"
    question, error_question = "POS?", "ERR?"

    def __init__(
        self,
        axes: Sequence[str] = ("1",),
        stage: Stage | None = None,
        *,
        servo: bool = False,
        units_per_volt: float = 1.0,
        without: Sequence[str] = (),
        unit: str = "UM",
        serial: str = SERIAL,
        **named: Any,
    ) -> None:
        super().__init__(axes, stage, **{"voltage_range": (-20.0, 120.0), **named})
        self.servo = dict.fromkeys(self.axes, servo)
        self.online = dict.fromkeys(self.axes, True)
        self.units_per_volt = units_per_volt
        self.metres = UNITS[unit]
        self._known = [command for command in COMMANDS if command not in without]
        self._outputs = {str(place): axis for place, axis in enumerate(self.axes, 1)}
        self._error = 0
        self._handlers: dict[str, Callable[[list[str]], list[str]]] = {
            "*IDN?": lambda _: [IDENTITY.format(serial=serial)],
            "ERR?": self._tell_error,
            "HLP?": lambda _: ["The following commands are available:", *self._known, "end of help"],
            "ONL?": lambda given: self._tell_output(given, lambda axis: str(int(self.online[axis]))),
            "POS?": self._tell_positions,
            "PUN?": lambda given: self._tell(given, lambda _: unit),
            "SAI?": lambda _: self.axes,
            "SVA": self._set_voltages,
            "SVA?": lambda given: self._tell(given, lambda axis: f"{self.voltage(axis) * self.units_per_volt:.6f}"),
            "SVO": self._set_servo,
            "SVO?": lambda given: self._tell(given, lambda axis: str(int(self.servo[axis]))),
            "TMN?": lambda given: self._tell(given, lambda _: "0.0000"),
            "TMX?": lambda given: self._tell(given, lambda _: f"{TRAVEL / self.metres:.6g}"),
            "VMA?": lambda given: self._tell_output(given, lambda _: f"{self.high:.4f}"),
            "VMI?": lambda given: self._tell_output(given, lambda _: f"{self.low:.4f}"),
            "VOL?": lambda given: self._tell_output(given, lambda axis: f"{self.voltage(axis):.6f}"),
        }
        self.waves = SimulatedWaves(self)
        self._handlers |= self.waves.handlers

    # Commands

    def reply(self, line: str) -> bytes:
        """Return the lines of the answer to a command; b"" if it has none."""
        self.waves.advance(time.monotonic_ns())
        command, *given = line.split()
        if command not in self._known:
            self._error = 2
            return b""
        fault = self.due(command)
        if fault and fault.kind == ERROR:
            self._error = fault.code
        answer = self._handlers[command](given)
        data = " \n".join(answer).encode("latin-1") + b"\n" if answer else b""
        return self.spoilt(data, fault) if fault else data

    def spoil(self, data: bytes, fault: Fault) -> bytes:
        """Return an answer as this fault leaves it."""
        first = self.axes[0].encode()
        return {
            WRONG_AXIS: data.replace(first + b"=", b"Z="),
            NONSENSE: b"\xff\x00<html>=1e\n" * max(data.count(b"\n"), 1),
            NOT_FINITE: first + b"=nan\n",
        }.get(fault.kind, data)

    def set_by_hand(self, axis: str, voltage: float) -> None:
        """Set a voltage (V) as the knob of the controller does."""
        self.waves.advance(time.monotonic_ns())
        super().set_by_hand(axis, voltage)

    def fail(self, code: int) -> list[str]:
        """Note an error for ``ERR?``; return no answer."""
        self._error = code
        return []

    def _tell_error(self, _: list[str]) -> list[str]:
        code, self._error = self._error, 0
        return [str(code)]

    def _tell(self, given: list[str], value: Callable[[str], str]) -> list[str]:
        """Return a line for each axis that was asked for, or for all."""
        if any(axis not in self.axes for axis in given):
            self._error = 15
            return []
        return [f"{axis}={value(axis)}" for axis in given or self.axes]

    def _tell_output(self, given: list[str], value: Callable[[str], str]) -> list[str]:
        """Return a line for each output channel that was asked for, or for all."""
        if any(output not in self._outputs for output in given):
            self._error = 17
            return []
        return [f"{output}={value(self._outputs[output])}" for output in given or self._outputs]

    def _tell_positions(self, given: list[str]) -> list[str]:
        self.cycles += 1
        readings = self.measure()
        return self._tell(given, lambda axis: f"{readings[axis] / self.metres:.6f}")

    def _set_voltages(self, given: list[str]) -> list[str]:
        wanted = dict(zip(given[::2], given[1::2], strict=False))
        try:
            values = {axis: float(text) / self.units_per_volt for axis, text in wanted.items()}
        except ValueError:
            values = {}
        if not values or len(given) % 2:
            self._error = 1
        elif any(axis not in self.axes for axis in values):
            self._error = 15
        elif any(self.servo[axis] for axis in values):
            self._error = 303
        elif any(self.waves.moves(axis) for axis in values):
            self._error = 73
        elif not all(self.low <= v <= self.high for v in values.values()):
            self._error = 302
        else:
            for axis, v in values.items():
                self.output(axis, v)
        return []

    def _set_servo(self, given: list[str]) -> list[str]:
        if len(given) != 2 or given[0] not in self.axes or given[1] not in ("0", "1"):
            self._error = 1
        else:
            # Without a jump: the voltage of the servo stays.
            self.servo[given[0]] = given[1] == "1"
        return []
