"""Amplifiers with line protocols at a pseudo terminal, with a simulated stage behind them.

Written independently of the driver. NV200/D of piezosystem jena: one axis, flow control by XON and XOFF, a command
without an error has no answer. MDT693B of Thorlabs: three axes, no sensor, a prompt after each answer, an echo.
"""

from collections.abc import Sequence
from typing import Any

from slpi_ros.simulation.devices.base import ERROR, NONSENSE, NOT_FINITE, WRONG_AXIS, Fault
from slpi_ros.simulation.devices.stream import StreamSimulator
from slpi_ros.simulation.stage import Stage

MICROMETRE = 1e-6
XON, XOFF = b"\x11", b"\x13"
PLACE = "/tmp/slpi_ros_serial"


class Nv200Simulator(StreamSimulator):
    """A simulated NV200/D: -20 to 130 V, its position in µm.

    Parameters
    ----------
    axes : one name; the device has no names
    stage : what moves; by default a random one
    servo : whether its position control is on at the start
    source : what sets the voltage: 0 commands, 1 the analog input
    """

    usual_axes, usual_address = ("1",), PLACE
    question = "meas"
    terminator = b"\r\n"

    def __init__(
        self,
        axes: Sequence[str] = ("1",),
        stage: Stage | None = None,
        *,
        servo: bool = False,
        source: int = 0,
        **named: Any,
    ) -> None:
        super().__init__(axes[:1], stage, voltage_range=(-20.0, 130.0), **{"path": PLACE, **named})
        self.servo = {self.axes[0]: servo}
        self.source = source

    def reply(self, line: str) -> bytes:
        """Return the answer between XOFF and XON."""
        command, comma, value = line.partition(",")
        fault = self.due(command)
        text = self._set(command, value) if comma else self._tell(command, fault)
        if fault is not None and fault.kind == ERROR:
            text = f"error,{fault.code}"
        data = XOFF + (text.encode() + b"\r\n" if text else b"") + XON
        return self.spoilt(data, fault) if fault else data

    def spoil(self, data: bytes, fault: Fault) -> bytes:
        """Return an answer as this fault leaves it."""
        return {
            WRONG_AXIS: data.replace(b"meas", b"temp"),
            NONSENSE: b"\xff<html>=1e\r\n",
        }.get(fault.kind, data)

    def _tell(self, command: str, fault: Fault | None) -> str:
        axis = self.axes[0]
        if command == "meas":
            self.cycles += 1
            position = self.measure()[axis] / MICROMETRE
            return "meas,nan" if fault and fault.kind == NOT_FINITE else f"meas,{position:.5f}"
        known = {
            "desc": "NV200/D_NET",
            "set": f"{self.voltage(axis):.3f}",
            "avmin": f"{self.low:.3f}",
            "avmax": f"{self.high:.3f}",
            "cl": str(int(self.servo[axis])),
            "modsrc": str(self.source),
        }
        return f"{command},{known[command]}" if command in known else "error,2"

    def _set(self, command: str, value: str) -> str:
        axis = self.axes[0]
        try:
            number = float(value)
        except ValueError:
            return "error,3"
        if command == "set":
            if not self.low <= number <= self.high:
                return "error,9" if number < self.low else "error,10"
            if not self.servo[axis] and not self.source:
                self.output(axis, number)
        elif command == "cl" and number in (0.0, 1.0):
            self.servo[axis] = bool(number)
        else:
            return "error,2"
        return ""


class MdtSimulator(StreamSimulator):
    """A simulated MDT693B: 0 to 150 V, voltages measured to 0.1 V, no sensor.

    Parameters
    ----------
    axes : some of x, y, z
    stage : what moves, unseen by the device
    echo : whether it repeats each command
    """

    usual_axes, usual_address = ("x",), PLACE
    question = "xvoltage?"
    terminator = b"\r"

    def __init__(
        self, axes: Sequence[str] = ("x",), stage: Stage | None = None, *, echo: bool = True, **named: Any
    ) -> None:
        super().__init__(axes, stage, voltage_range=(0.0, 150.0), **{"path": PLACE, **named})
        self.echo = echo

    def reply(self, line: str) -> bytes:
        """Return echo, answer and prompt."""
        fault = self.due(line)
        self.cycles += line == self.question
        text = self._answer(line)
        if fault is not None and fault.kind == ERROR:
            text = "CMD_NOT_DEFINED"
        if fault is not None and fault.kind == NOT_FINITE:
            text = "[ nan]"
        data = (line.encode() + b"\r" if self.echo else b"") + (text.encode() + b"\r" if text else b"") + b">"
        return self.spoilt(data, fault) if fault else data

    def spoil(self, data: bytes, fault: Fault) -> bytes:
        """Return an answer as this fault leaves it."""
        return {
            WRONG_AXIS: data.replace(b"xvoltage", b"zvoltage"),
            NONSENSE: b"\xff<html>=1e\r>",
        }.get(fault.kind, data)

    def _answer(self, line: str) -> str:
        if line == "id?":
            return "Model MDT693B Piezo Control Module\rFirmware Version: 1.09"
        axis, rest = line[:1], line[1:]
        if axis not in self.axes:
            return "CMD_NOT_DEFINED"
        if rest == "voltage?":
            return f"[{self.voltage(axis):6.1f}]"
        if rest in ("min?", "max?"):
            return f"[{self.low if rest == 'min?' else self.high:6.1f}]"
        if not rest.startswith("voltage="):
            return "CMD_NOT_DEFINED"
        try:
            wanted = float(rest.removeprefix("voltage="))
        except ValueError:
            return "CMD_ARG_INVALID"
        if not self.low <= wanted <= self.high:
            return "CMD_ARG_RANGE_ERR"
        self.output(axis, wanted)
        return ""
