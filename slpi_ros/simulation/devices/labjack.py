"""A LabJack T7 or T8 on pymodbus's own Modbus server, with an amplifier and a simulated stage behind it.

Written independently of the driver. What is simulated: the analog outputs and inputs, an LJTick-DAC, identity,
watchdog; registers of the T-Series Modbus map (ljm_constants.json, 2026-01-14).
"""

import asyncio
import logging
import struct
import threading
import time
from collections.abc import Sequence
from typing import Any

from pymodbus.constants import ExcCodes
from pymodbus.server import ModbusTcpServer
from pymodbus.simulator import DataType, SimData, SimDevice

from slpi_ros.simulation.devices import base
from slpi_ros.simulation.devices.base import Fault, SimulatedDevice
from slpi_ros.simulation.stage import Stage

# First register and number of registers of what is there.
INPUTS, OUTPUTS, TICKS = (0, 28), (1000, 4), (30_000, 44)
IDENTITY, WATCHDOG = (60_000, 30), (61_600, 54)
# What is between them is not there, and reading over it is an error.
KNOWN_32 = (60_000, 60_004, 60_028, 61_600, 61_602, 61_604, 61_606, 61_610, 61_620, 61_640, 61_642, 61_650, 61_652)
RANGES = {7: (0.0, 5.0), 8: (0.0, 10.0)}
TICK_RANGE = (-10.0, 10.0)
READ, WRITE = 3, 16


class LabjackSimulator(SimulatedDevice):
    """A simulated T7 or T8 with one stage.

    Parameters
    ----------
    axes : OUTPUT:INPUT or OUTPUT:INPUT:INPUT, as the driver's channels: how the stage is wired
    stage : what moves; by default a random one
    gain : of the amplifier behind the outputs
    product : 7 or 8
    watchdog : values of its registers by their address
    port : TCP port; 0 for a free one
    named : what every device has
    """

    usual_axes, usual_address = ("DAC0:AIN0",), "127.0.0.1:5020"
    question = "AIN"

    def __init__(
        self,
        axes: Sequence[str] = ("DAC0:AIN0",),
        stage: Stage | None = None,
        *,
        gain: float = 20.0,
        product: int = 7,
        watchdog: dict[int, int] | None = None,
        host: str = "127.0.0.1",
        port: int = 0,
        **named: Any,
    ) -> None:
        super().__init__(axes, stage, voltage_range=RANGES[product], gain=gain, **named)
        self.watchdog = watchdog or {}
        self._product, self._host, self._port = product, host, port
        self._fault: Fault | None = None
        self._refused_until = 0.0
        # By address: an output's axis, an input's axis and whether it is the sensor.
        self._outputs: dict[int, str] = {}
        self._inputs: dict[int, tuple[str, bool]] = {}
        for axis in self.axes:
            output, *inputs = axis.split(":")
            base = TICKS[0] if output.startswith("T") else OUTPUTS[0]
            self._outputs[base + 2 * int(output.removeprefix("T").removeprefix("DAC"))] = axis
            for name, sensor in zip(inputs, (True, False), strict=False):
                self._inputs[2 * int(name.removeprefix("AIN"))] = axis, sensor
        self._loop: asyncio.AbstractEventLoop | None = None
        self._server: ModbusTcpServer | None = None
        self._ready = threading.Event()
        self._failure: OSError | None = None
        self._thread = threading.Thread(target=self._serve, name="labjack simulator", daemon=True)
        logging.getLogger("pymodbus").setLevel(logging.CRITICAL)

    def start(self) -> None:
        """Begin to serve."""
        self._thread.start()
        self._ready.wait()
        if self._failure is not None:
            raise self._failure

    def close(self) -> None:
        """End the server."""
        if self._thread.is_alive() and self._loop is not None and self._server is not None:
            asyncio.run_coroutine_threadsafe(self._server.shutdown(), self._loop)
            self._thread.join()

    # The link

    def _serve(self) -> None:
        asyncio.run(self._run())

    async def _run(self) -> None:
        self._loop = asyncio.get_running_loop()
        blocks = [
            SimData(first, count=count, values=0, datatype=DataType.REGISTERS)
            for first, count in (INPUTS, OUTPUTS, TICKS, *((first, 2) for first in KNOWN_32))
        ]
        device = SimDevice(1, blocks, action=self._access)
        self._server = ModbusTcpServer(
            device, address=(self._host, self._port), trace_packet=self._packet, trace_connect=self._connected
        )
        await self._server.serve_forever(background=True)
        transport = self._server.transport
        if transport is None:
            self._failure = OSError(f"cannot listen at {self._host}:{self._port}")
            self._ready.set()
            return
        self.address = "{}:{}".format(*transport.sockets[0].getsockname()[:2])
        self._ready.set()
        await self._server.serving

    def _connected(self, connected: bool) -> None:
        if connected and time.monotonic() < self._refused_until:
            self._disconnect()

    def _disconnect(self) -> None:
        """Close all connections, once the present callback has ended."""
        assert self._loop is not None and self._server is not None
        for connection in list(self._server.active_connections.values()):
            self._loop.call_soon(connection.close)

    def _packet(self, sending: bool, data: bytes) -> bytes:
        """Spoil a packet on its way out."""
        if not sending:
            return data
        if self.answer_delay:
            time.sleep(self.answer_delay)
        fault, self._fault = self._fault, None
        if fault is None:
            return data
        if fault.kind == base.LATE:
            time.sleep(fault.seconds)
        if fault.kind == base.LOST:
            self._refused_until = time.monotonic() + fault.seconds
            self._disconnect()
            return b""
        number = int.from_bytes(data[:2], "big")
        return {
            base.SILENT: b"",
            base.HALF: data[: len(data) // 2],
            base.WRONG_AXIS: (number ^ 1).to_bytes(2, "big") + data[2:],
            base.TWICE: data + data,
            base.NONSENSE: b"\xff\x00<html>=1e\n" * 3,
        }.get(fault.kind, data)

    # Registers

    async def _access(
        self, function: int, start: int, address: int, count: int, registers: list[int], values: list[int] | None
    ) -> ExcCodes | None:
        """Fill the registers that are read, and move the outputs that are written."""
        name = self._name_of(address)
        self.received.append(f"{'write' if values else 'read'} {name} {address} {count}")
        self._fault = self.due(name) if values is None else self.due("write")
        if self._fault is not None and self._fault.kind == base.ERROR:
            self._fault = None
            return ExcCodes.DEVICE_FAILURE
        if values is not None:
            return (
                self._write(address, [int(word) for word in values]) if function == WRITE else ExcCodes.ILLEGAL_FUNCTION
            )
        if function != READ or name == "TDAC":
            return ExcCodes.ILLEGAL_FUNCTION
        if name == "AIN":
            self.cycles += 1
        measured = self.measure() if name == "AIN" else {}
        for at in range(address, address + count - 1, 2):
            words = struct.unpack(">2H", self._value(at, measured))
            registers[at - start : at - start + 2] = words
        return None

    def _name_of(self, address: int) -> str:
        names = zip((INPUTS, OUTPUTS, TICKS, IDENTITY, WATCHDOG), ("AIN", "DAC", "TDAC", "ID", "WATCHDOG"), strict=True)
        return next((name for (first, count), name in names if first <= address < first + count), "")

    def _value(self, address: int, measured: dict[str, float]) -> bytes:
        """Return the four bytes of a value."""
        if address >= WATCHDOG[0]:
            return struct.pack(">I", self.watchdog.get(address, 0))
        if address >= IDENTITY[0]:
            known = {60_000: float(self._product), 60_004: 1.0293}
            return struct.pack(">I", 470_012_345) if address == 60_028 else struct.pack(">f", known.get(address, 0.0))
        if address in self._outputs:
            return struct.pack(">f", self.voltage(self._outputs[address]))
        if address in self._inputs:
            axis, sensor = self._inputs[address]
            value = measured[axis] * base.VOLTS_PER_METRE if sensor else self.voltage(axis)
            if self._fault is not None and self._fault.kind == base.NOT_FINITE:
                value = float("nan")
            return struct.pack(">f", value)
        return struct.pack(">f", 0.0)

    def _write(self, address: int, words: list[int]) -> ExcCodes | None:
        if len(words) % 2 or self._name_of(address) not in ("DAC", "TDAC"):
            return ExcCodes.ILLEGAL_ADDRESS
        voltages = struct.unpack(f">{len(words) // 2}f", struct.pack(f">{len(words)}H", *words))
        for place, voltage in enumerate(voltages):
            at = address + 2 * place
            low, high = TICK_RANGE if at >= TICKS[0] else (self.low, self.high)
            if not low <= voltage <= high:
                return ExcCodes.ILLEGAL_VALUE
            if at in self._outputs:
                self.output(self._outputs[at], voltage)
        return None
