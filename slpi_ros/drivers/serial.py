"""Amplifiers that speak a line protocol over a serial port: a table of dialects, or a user's own in YAML."""

import math
import re
import time
from collections.abc import Sequence

from slpi_ros.drivers.base import AnswerError, Channel, Device, Found, Reading, RefusedError, UnsuitableError
from slpi_ros.drivers.dialects import DIALECTS, dialect_of
from slpi_ros.drivers.stream import SHOWN, SerialStream, place_and_baud
from slpi_ros.errors import UsageError, shown


class SerialDevice(Device):
    """An amplifier at a serial port; one question at a time. The address is DIALECT:PORT or DIALECT:PORT@BAUD."""

    def __init__(self, address: str, channels: Sequence[Channel]) -> None:
        super().__init__("serial", address, channels)
        name, colon, place = address.partition(":")
        if not colon or not place:
            raise UsageError(
                f"address '{address}' of a serial device; give DIALECT:PORT, such as nv200:/dev/ttyUSB0, with one of "
                f"{', '.join(DIALECTS)} or the path of a .yaml file"
            )
        self._dialect = dialect_of(name)
        port, baud = place_and_baud(place, self._dialect.baud)
        self._stream = SerialStream(self.name, port, baud, self._dialect.ignored.encode("latin-1"))
        self._end = self._dialect.end.encode("latin-1")
        self._error = re.compile(self._dialect.error, re.DOTALL)
        self._unanswered = ""

    def open(self) -> Found:
        """Connect, then only ask."""
        self._unanswered = ""
        self._stream.open()
        return self._found()

    def release_servo(self) -> Found:
        """Switch the servo of all axes off."""
        before = self.read().voltages
        for channel in self.channels:
            self._command(self._text(self._dialect.servo_off, channel))
        found = self._found()
        pairs = zip(before, found.reading.voltages, strict=True)
        note = f"the servo was switched off: {', '.join(f'{v:.3f} to {w:.3f} V' for v, w in pairs)}"
        return Found(**{**vars(found), "notes": (note, *found.notes)})

    def exchange(self, voltages: Sequence[float] | None) -> Reading:
        """Write each axis if voltages are given, then ask for positions and voltages."""
        if voltages is not None:
            for channel, v in zip(self.channels, voltages, strict=True):
                wanted = channel.device_volts(v) / self._dialect.volts_per_unit
                text = self._text(self._dialect.write, channel)
                self._command(text.replace("{voltage}", f"{wanted:.{self._dialect.decimals}f}"))
        sent_ns = time.monotonic_ns()
        positions = (math.nan,) * len(self.channels)
        if self._dialect.position:
            positions = tuple(self._number(self._dialect.position, each) for each in self.channels)
        received_ns = time.monotonic_ns()
        told = [self._volts(self._dialect.voltage, each) for each in self.channels]
        return self.reading((sent_ns + received_ns) // 2, told, positions)

    def close(self) -> None:
        """End the connection; the device keeps its voltages."""
        self._stream.close()

    # What the device says of itself

    def _found(self) -> Found:
        dialect = self._dialect
        identity = self._ask(dialect.identity) if dialect.identity else "a serial device that does not name itself"
        if dialect.source:
            for channel in self.channels:
                if source := self._number(dialect.source, channel):
                    raise UnsuitableError(
                        f"{self.name}: axis '{channel.name}' is not set by commands ({dialect.source} tells "
                        f"{source:g}); switch it over at the device, knowing that this may move the stage"
                    )
        servo = tuple(bool(dialect.servo and self._number(dialect.servo, each)) for each in self.channels)
        reading = self.read()
        asked = (dialect.lowest, -math.inf), (dialect.highest, math.inf)
        ranges = [[self._volts(query, each) if query else absent for query, absent in asked] for each in self.channels]
        notes = [] if dialect.position else ["it has no sensor: positions are not a number, which no calibration takes"]
        return Found(
            " ".join(identity.split()),
            reading,
            reading.voltages,
            *self.range_of(ranges),
            servo,
            tuple(notes),
        )

    # Lines

    def _text(self, text: str, channel: Channel) -> str:
        return text.replace("{channel}", channel.name)

    def _volts(self, query: str, channel: Channel) -> float:
        return self._dialect.volts_per_unit * self._number(query, channel)

    def _number(self, query: str, channel: Channel) -> float:
        asked = self._text(query, channel)
        answer = self._ask(asked)
        value = self._dialect.number(asked, answer)
        if value is None:
            raise AnswerError(f"{self.name}: '{asked}' answered '{shown(answer, SHOWN)}', not a number of that name")
        return value

    def _command(self, text: str) -> None:
        self._send(text)
        if self._dialect.written:
            self._line(text)
        else:
            self._unanswered = text

    def _ask(self, question: str) -> str:
        self._send(question)
        return self._line(question)

    def _send(self, text: str) -> None:
        # A command that has no answer may have been refused.
        if self._unanswered and self._stream.pending():
            answer = self._line(self._unanswered)
            raise AnswerError(f"{self.name}: '{self._unanswered}' answered '{shown(answer, SHOWN)}', not asked for")
        self._unanswered = ""
        self._stream.send(f"{text}{self._dialect.terminator}".encode("latin-1"))

    def _line(self, asked: str) -> str:
        """Return the answer without its end; RefusedError if it tells an error."""
        data = self._stream.until(self._length, asked)
        answer = data[: -len(self._end)].decode("latin-1").strip()
        if self._error.fullmatch(answer):
            raise RefusedError(f"{self.name}: error '{shown(answer, SHOWN)}' after '{asked}'")
        self._stream.require_end()
        return answer

    def _length(self, data: bytes) -> int:
        at = data.find(self._end)
        return at + len(self._end) if at >= 0 else 0


DEVICE = SerialDevice
