"""LabJack T7 and T8 by Modbus TCP, and an LJTick-DAC on one of them.

Registers: T-Series Modbus map of the maker (ljm_constants.json, 2026-01-14). A value of 32 bits takes two registers,
the more significant one first.
"""

import logging
import math
import re
import select
import struct
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from pymodbus.client import ModbusTcpClient
from pymodbus.exceptions import ModbusException

from slpi_ros.drivers.base import (
    TIMEOUT,
    AnswerError,
    Channel,
    Device,
    Found,
    LinkError,
    Reading,
    RefusedError,
    UnsuitableError,
    host_and_port,
)
from slpi_ros.errors import UsageError

PORT = 502
# Addresses; those of numbered ones are this plus twice the number.
AIN, DAC, TDAC = 0, 1000, 30_000
PRODUCT, FIRMWARE, SERIAL = 60_000, 60_004, 60_028
WATCHDOG = 61_600
# Its timeout, and its actions that change an output, by address.
WATCHDOG_TIMEOUT = 61_604
ACTIONS = {
    61_602: "WATCHDOG_ADVANCED_DEFAULT",
    61_620: "WATCHDOG_RESET_ENABLE_DEFAULT",
    61_640: "WATCHDOG_DAC0_ENABLE_DEFAULT",
    61_650: "WATCHDOG_DAC1_ENABLE_DEFAULT",
}
# Range of the outputs by the number of the product, V.
RANGES = {7: (0.0, 5.0), 8: (0.0, 10.0)}
TICK_RANGE = (-10.0, 10.0)
UNIT = 1
# Bytes of an answer before what its length counts.
HEADER = 6
# What AIN tells of a channel that it cannot read.
NO_READING = -9999.0
SYNTAX = re.compile(r"(DAC[01]|TDAC\d\d?)(?::AIN(\d{1,3}))(?::AIN(\d{1,3}))?")


@dataclass(frozen=True)
class Wires:
    """Terminals of one axis."""

    output: str
    address: int  # of the output
    position: int  # number of the analog input with the sensor
    voltage: int | None  # number of the analog input that the output is wired to; None: what the device was told last

    @classmethod
    def of(cls, name: str) -> "Wires":
        """Return the terminals by a name such as DAC0:AIN0 or TDAC2:AIN0:AIN2; UsageError if it is none."""
        found = SYNTAX.fullmatch(name)
        if not found:
            raise UsageError(
                f"channel '{name}' of a labjack; give OUTPUT:INPUT of the sensor, such as DAC0:AIN0, or "
                "OUTPUT:INPUT:INPUT with the one that the output is wired to, such as TDAC0:AIN0:AIN2"
            )
        output, position, voltage = found.groups()
        if output.startswith("T") and voltage is None:
            raise UsageError(
                f"channel '{name}': an LJTick-DAC does not tell its voltage, and the first one would be a jump; wire "
                f"its output to an analog input and give it, such as {output}:AIN{position}:AIN2"
            )
        number = int(output.removeprefix("T").removeprefix("DAC"))
        base = TDAC if output.startswith("T") else DAC
        return cls(output, base + 2 * number, int(position), int(voltage) if voltage else None)


class LabjackDevice(Device):
    """A T7 or T8 over TCP: one request for each row of neighbouring registers."""

    def __init__(self, address: str, channels: Sequence[Channel]) -> None:
        super().__init__("labjack", address, channels)
        self._host, self._port = host_and_port("labjack", address, PORT)
        self._wires = [Wires.of(channel.name) for channel in channels]
        self._client: ModbusTcpClient | None = None
        self._answer = b""  # all that came since the last question
        self._positions = _rows([AIN + 2 * each.position for each in self._wires])
        told = [each.address if each.voltage is None else AIN + 2 * each.voltage for each in self._wires]
        self._told, self._voltages = told, _rows(told)
        self._outputs = _rows([each.address for each in self._wires])
        # It writes what it knows of this to standard error; the errors say it.
        logging.getLogger("pymodbus").setLevel(logging.CRITICAL)

    def open(self) -> Found:
        """Connect, then only ask."""
        self.close()
        client = ModbusTcpClient(self._host, port=self._port, timeout=TIMEOUT, retries=0, trace_packet=self._on_packet)
        if not client.connect():
            raise LinkError(
                f"{self.name}: no connection; check that the device is on, its address and its port, and that not two "
                "other programs are connected to it"
            )
        self._client = client
        (product,) = self._numbers("PRODUCT_ID", PRODUCT, 1)
        if product not in RANGES:
            raise UnsuitableError(
                f"{self.name}: it is product {product:g}; this driver knows the T{' and the T'.join(map(str, RANGES))}"
            )
        (firmware,) = self._numbers("FIRMWARE_VERSION", FIRMWARE, 1)
        serial = self._integer("SERIAL_NUMBER", SERIAL)
        notes = self._check_watchdog()
        reading = self.read()
        ranges = [TICK_RANGE if each.address >= TDAC else RANGES[int(product)] for each in self._wires]
        return Found(
            f"LabJack T{product:g}, serial number {serial}, firmware {firmware:.4f}",
            reading,
            reading.voltages,
            *self.range_of(ranges),
            (False,) * len(self.channels),
            (*notes, *self._notes()),
        )

    def release_servo(self) -> Found:
        """Return what the device says: it has no servo."""
        return self.open()

    def exchange(self, voltages: Sequence[float] | None) -> Reading:
        """Write the outputs if voltages are given, then read sensors and outputs."""
        if voltages is not None:
            wanted = {
                each.address: channel.device_volts(v)
                for each, channel, v in zip(self._wires, self.channels, voltages, strict=True)
            }
            for first, count in self._outputs:
                values = [wanted[first + 2 * place] for place in range(count)]
                words = list(struct.unpack(f">{2 * count}H", struct.pack(f">{count}f", *values)))
                self._request(f"writing {first}", "write_registers", first, words)
        sent_ns = time.monotonic_ns()
        positions = self._table("AIN", self._positions)
        received_ns = time.monotonic_ns()
        told = self._table("the outputs", self._voltages)
        return self.reading(
            (sent_ns + received_ns) // 2,
            [told[address] for address in self._told],
            [positions[AIN + 2 * each.position] for each in self._wires],
        )

    def close(self) -> None:
        """End the connection; the device keeps its voltages."""
        if self._client is not None:
            self._client.close()
        self._client = None

    # What the device says of itself

    def _notes(self) -> list[str]:
        told = [each.output for each in self._wires if each.voltage is None]
        return [f"the voltage of {', '.join(told)} is what the device was told last: it does not measure it"] * bool(
            told
        )

    def _check_watchdog(self) -> list[str]:
        """Raise UnsuitableError where the device changes an output by itself when the link is lost."""
        if not self._integer("WATCHDOG_ENABLE_DEFAULT", WATCHDOG):
            return []
        changing = [name for address, name in ACTIONS.items() if self._integer(name, address)]
        seconds = self._integer("WATCHDOG_TIMEOUT_S_DEFAULT", WATCHDOG_TIMEOUT)
        if changing:
            raise UnsuitableError(
                f"{self.name}: after {seconds} s without a link its watchdog changes the outputs "
                f"({', '.join(changing)}), so that the stage jumps; set these registers "
                "or WATCHDOG_ENABLE_DEFAULT to 0 with the maker's program (Kipling): then a lost link holds"
            )
        return [f"its watchdog acts after {seconds} s without a link, and changes no analog output"]

    # Registers

    def _table(self, what: str, rows: Sequence[tuple[int, int]]) -> dict[int, float]:
        """Return the numbers of rows of registers, by address."""
        found: dict[int, float] = {}
        for first, count in rows:
            numbers = self._numbers(what, first, count)
            found |= {first + 2 * place: value for place, value in enumerate(numbers)}
        return found

    def _numbers(self, what: str, address: int, count: int) -> tuple[float, ...]:
        values = struct.unpack(f">{count}f", self._read(what, address, 2 * count))
        if not all(map(math.isfinite, values)) or NO_READING in values:
            raise AnswerError(f"{self.name}: {what} at {address} is {list(values)}, not a measured voltage")
        return values

    def _integer(self, what: str, address: int) -> int:
        (value,) = struct.unpack(">I", self._read(what, address, 2))
        return int(value)

    def _read(self, what: str, address: int, count: int) -> bytes:
        answer = self._request(what, "read_holding_registers", address, count=count)
        if len(answer.registers) != count:
            raise AnswerError(
                f"{self.name}: {what} was asked for {count} registers and answered {len(answer.registers)}"
            )
        return struct.pack(f">{count}H", *answer.registers)

    def _request(self, what: str, function: str, *given: Any, **named: Any) -> Any:
        """Return the answer to one request of the library."""
        client = self._client
        if client is None or client.socket is None:
            raise LinkError(f"{self.name}: it is not open")
        if select.select([client.socket], [], [], 0.0)[0]:
            # An answer that comes late or twice; the library would leave it out.
            raise AnswerError(f"{self.name}: it sent something before {what} without having been asked")
        self._answer = b""
        try:
            answer = getattr(client, function)(*given, device_id=UNIT, **named)
        except ModbusException as error:
            raise LinkError(f"{self.name}: no whole answer to {what} within {TIMEOUT:g} s ({error.string})") from error
        except OSError as error:
            raise LinkError(f"{self.name}: the link was lost at {what} ({error.strerror or error})") from error
        except (ValueError, struct.error, IndexError) as error:
            raise AnswerError(f"{self.name}: {what} was answered by what is no Modbus ({error})") from error
        if len(self._answer) != HEADER + int.from_bytes(self._answer[HEADER - 2 : HEADER], "big"):
            raise AnswerError(f"{self.name}: {len(self._answer)} bytes came for {what}, more than one answer to it")
        if answer.isError():
            raise RefusedError(f"{self.name}: Modbus exception {answer.exception_code} at {what}")
        return answer

    def _on_packet(self, sending: bool, data: bytes) -> bytes:
        # The library gives all that came for one question, again with each further part.
        if not sending:
            self._answer = data
        return data


DEVICE = LabjackDevice


def _rows(addresses: Sequence[int]) -> list[tuple[int, int]]:
    """Return the first address and the number of values of each row of neighbouring values."""
    rows: list[tuple[int, int]] = []
    for address in sorted(set(addresses)):
        if rows and address == rows[-1][0] + 2 * rows[-1][1]:
            rows[-1] = (rows[-1][0], rows[-1][1] + 1)
        else:
            rows.append((address, 1))
    return rows
