"""A stream of bytes to a device, over TCP or a serial port, with the same errors for both."""

import os
import select
import socket
import time
from abc import ABC, abstractmethod
from collections.abc import Callable
from contextlib import suppress
from typing import Any

from slpi_ros.drivers.base import TIMEOUT, AnswerError, LinkError, host_and_port
from slpi_ros.errors import UsageError, dependencies_needed, shown

# Longest answer, bytes: a list of commands has some ten thousand, a record of a recorder a million.
LONGEST = 1 << 24
# Bytes of an answer that are shown in a message.
SHOWN = 60
BAUD = 115_200


class Stream(ABC):
    """What is sent to a device and comes from it; every wait ends after `TIMEOUT`, every failure is a DeviceError."""

    def __init__(self, name: str, ignored: bytes = b"") -> None:
        self._name, self._ignored = name, ignored
        self._buffer = b""
        self._poll = select.poll()

    def open(self) -> None:
        """Connect anew; what came before is left out."""
        self.close()
        self._open()
        self._poll = select.poll()
        self._poll.register(self._file(), select.POLLIN)

    def close(self) -> None:
        """End the connection. Never raises."""
        with suppress(OSError):
            self._close()
        self._buffer = b""

    def send(self, data: bytes) -> None:
        """Send data; AnswerError if something has come that nobody asked for."""
        if self._file() is None:
            raise LinkError(f"{self._name}: it is not open")
        if self.pending():
            # An answer that comes late or twice would be taken for the next one.
            raise AnswerError(f"{self._name}: it sent {cut(self._buffer)} without having been asked")
        try:
            self._send(data)
        except OSError as error:
            raise self._lost(error) from error

    def until(self, length: Callable[[bytes], int], what: str) -> bytes:
        """Return the next answer: as many bytes as `length` says of all that came, once it says more than none."""
        deadline = time.monotonic() + TIMEOUT
        while not (count := length(self._buffer)):
            left = deadline - time.monotonic()
            if left < 0.0:
                raise LinkError(f"{self._name}: {what} is answered too slowly; until now came {cut(self._buffer)}")
            self._receive(what, left)
        answer, self._buffer = self._buffer[:count], self._buffer[count:]
        return answer

    def pending(self) -> bool:
        """Tell whether something has come that was not taken."""
        if self._file() is not None and self._poll.poll(0):
            self._receive("an answer without a question", TIMEOUT)
        return bool(self._buffer)

    def require_end(self) -> None:
        """Raise AnswerError if more has come than what was taken."""
        if self._buffer:
            raise AnswerError(f"{self._name}: it sent {cut(self._buffer)} beyond what was asked")

    def _receive(self, what: str, seconds: float) -> None:
        """Add what has come to the buffer, waiting for it if there is nothing."""
        try:
            if not self._poll.poll(seconds * 1e3):
                raise LinkError(
                    f"{self._name}: no whole answer to {what} within {TIMEOUT:g} s; until then came {cut(self._buffer)}"
                )
            data = self._read()
        except (OSError, ValueError) as error:
            raise self._lost(error) from error
        if not data:
            raise LinkError(f"{self._name}: it closed the connection")
        self._buffer += data.translate(None, self._ignored) if self._ignored else data
        if len(self._buffer) > LONGEST:
            raise AnswerError(f"{self._name}: it sent more than {LONGEST} bytes; they begin with {cut(self._buffer)}")

    def _lost(self, error: Exception) -> LinkError:
        return LinkError(f"{self._name}: the link was lost ({getattr(error, 'strerror', None) or error})")

    @abstractmethod
    def _open(self) -> None: ...

    @abstractmethod
    def _close(self) -> None: ...

    @abstractmethod
    def _file(self) -> Any: ...

    @abstractmethod
    def _send(self, data: bytes) -> None: ...

    @abstractmethod
    def _read(self) -> bytes: ...


class TcpStream(Stream):
    """A stream over TCP."""

    def __init__(self, name: str, host: str, port: int) -> None:
        super().__init__(name)
        self._host, self._port = host, port
        self._socket: socket.socket | None = None

    def _open(self) -> None:
        try:
            self._socket = socket.create_connection((self._host, self._port), TIMEOUT)
            # A command leaves at once, not with the next one.
            self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            # A time-out of the socket is one more system call for each sending and each reading. Its buffer takes many
            # commands: one that is full belongs to a device that has not read for long.
            self._socket.setblocking(False)
        except OSError as error:
            raise LinkError(
                f"{self._name}: no connection ({error.strerror or error}); check that the device is on, its address "
                "and its port, and that no other program is connected to it"
            ) from error

    def _close(self) -> None:
        link, self._socket = self._socket, None
        if link is not None:
            link.close()

    def _file(self) -> socket.socket | None:
        return self._socket

    def _send(self, data: bytes) -> None:
        assert self._socket is not None
        self._socket.sendall(data)

    def _read(self) -> bytes:
        assert self._socket is not None
        return self._socket.recv(65_536)


class SerialStream(Stream):
    """A stream over a serial port, by pyserial; some bytes, such as those of flow control, may be ignored."""

    def __init__(self, name: str, port: str, baud: int = BAUD, ignored: bytes = b"") -> None:
        super().__init__(name, ignored)
        with dependencies_needed():
            import serial
        self._library: Any = serial
        self._place, self._baud = port, baud
        self._port: Any = None

    def _open(self) -> None:
        try:
            # Another program at the same port would take answers away.
            self._port = self._library.Serial(
                self._place, self._baud, timeout=0.0, write_timeout=TIMEOUT, exclusive=True
            )
        except (OSError, ValueError) as error:
            # pyserial's own text holds its call.
            reason = os.strerror(error.errno) if isinstance(error, OSError) and error.errno else error
            raise LinkError(
                f"{self._name}: no connection ({reason}); check that the device is on, its port, that no other program "
                "has it open, and that this user may open it (group dialout)"
            ) from error

    def _close(self) -> None:
        port, self._port = self._port, None
        if port is not None:
            port.close()

    def _file(self) -> Any:
        return self._port

    def _send(self, data: bytes) -> None:
        self._port.write(data)

    def _read(self) -> bytes:
        return bytes(self._port.read(65_536))


def stream_to(kind: str, address: str, port: int) -> Stream:
    """Return the stream to HOST, HOST:PORT or the path of a serial port, /dev/.. or /dev/..@BAUD."""
    if address.startswith("/"):
        place, baud = place_and_baud(address)
        return SerialStream(f"{kind} {address}", place, baud)
    return TcpStream(f"{kind} {address}", *host_and_port(kind, address, port))


def place_and_baud(address: str, usual: int = BAUD) -> tuple[str, int]:
    """Return path and baud rate of a serial port; UsageError if the rate is none."""
    place, at, baud = address.partition("@")
    if at and not (baud.isdigit() and int(baud) > 0):
        raise UsageError(f"address '{address}': the baud rate is '{baud}'; give it such as {place}@{BAUD}")
    return place, int(baud) if at else usual


def cut(data: bytes) -> str:
    """Return the beginning of an answer for a message."""
    return f"'{shown(data[:SHOWN].decode('latin-1'))}'" if data else "nothing"
