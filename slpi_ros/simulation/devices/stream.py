"""A simulated device that answers lines over TCP or a pseudo terminal, which a driver opens as a serial port."""

import os
import select
import socket
import threading
import time
import tty
from abc import abstractmethod
from contextlib import suppress
from pathlib import Path
from typing import Any

from slpi_ros.errors import UsageError
from slpi_ros.simulation.devices.base import HALF, LATE, LOOK, LOST, SILENT, TWICE, Fault, SimulatedDevice


class LostLinkError(Exception):
    """The link is to be lost."""


class StreamSimulator(SimulatedDevice):
    """Serves one client after the other, at `host` and `port`, or at a pseudo terminal behind the link `path`."""

    terminator = b"\n"  # of a command

    def __init__(self, *given: Any, host: str = "127.0.0.1", port: int = 0, path: str = "", **named: Any) -> None:
        super().__init__(*given, **named)
        self._path = path
        self._refused_until = 0.0
        self._ending = threading.Event()
        self._server: socket.socket | None = None
        if not path:
            self._server = socket.create_server((host, port))
            self._server.settimeout(LOOK)
            self.address = "{}:{}".format(*self._server.getsockname()[:2])
        else:
            self.address = path
        serve = self._serve_terminal if path else self._serve_tcp
        self._ready = threading.Event()
        self._thread = threading.Thread(target=serve, name=f"{type(self).__name__}", daemon=True)

    @classmethod
    def placed(cls, address: str) -> dict[str, Any]:
        """Return host and port, or the path of the pseudo terminal; UsageError if the address is none."""
        place = address or cls.usual_address
        if place.startswith("/"):
            if os.path.lexists(place) and not os.path.islink(place):
                raise UsageError(f"address '{place}' is there already; give a path that is free")
            return {"path": place}
        return super().placed(address)

    def start(self) -> None:
        """Begin to serve."""
        self._thread.start()
        self._ready.wait()

    def close(self) -> None:
        """End the server."""
        self._ending.set()
        if self._thread.is_alive():
            self._thread.join()
        if self._server is not None:
            self._server.close()

    @abstractmethod
    def reply(self, line: str) -> bytes:
        """Return the answer to a command, b"" if it has none; LostLinkError ends the connection."""

    @abstractmethod
    def spoil(self, data: bytes, fault: Fault) -> bytes:
        """Return an answer as this fault leaves it."""

    def spoilt(self, data: bytes, fault: Fault) -> bytes:
        """Return an answer after this fault; LostLinkError if the link is to be lost."""
        if fault.kind == LOST:
            self._refused_until = time.monotonic() + fault.seconds
            raise LostLinkError
        if fault.kind == LATE:
            self._ending.wait(fault.seconds)
        if fault.kind == HALF:
            return data[: len(data) // 2]
        if fault.kind == TWICE:
            return data + data
        return b"" if fault.kind == SILENT else self.spoil(data, fault)

    # Links

    def _serve_tcp(self) -> None:
        assert self._server is not None
        self._ready.set()
        while not self._ending.is_set():
            try:
                client, _ = self._server.accept()
            except TimeoutError:
                continue
            with client:
                if time.monotonic() >= self._refused_until:
                    client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                    with suppress(LostLinkError, OSError):
                        self._talk(client.fileno())

    def _serve_terminal(self) -> None:
        while not self._ending.is_set():
            if self._ending.wait(max(self._refused_until - time.monotonic(), 0.0)):
                break
            master, slave = os.openpty()
            tty.setraw(slave)
            link = Path(self._path)
            link.unlink(missing_ok=True)
            link.symlink_to(os.ttyname(slave))
            self._ready.set()
            try:
                with suppress(LostLinkError, OSError):
                    self._talk(master)
            finally:
                # As when the plug is pulled out.
                link.unlink(missing_ok=True)
                os.close(slave)
                os.close(master)

    def _talk(self, file: int) -> None:
        buffer = b""
        while not self._ending.is_set():
            if not select.select([file], [], [], LOOK)[0]:
                continue
            data = os.read(file, 65_536)
            if not data:
                return
            *lines, buffer = (buffer + data).split(self.terminator)
            answers = []
            for line in lines:
                text = line.decode("latin-1").strip()
                if text:
                    self.received.append(text)
                    answers.append(self.reply(text))
            if self.answer_delay:
                time.sleep(self.answer_delay)
            answer = b"".join(answers)
            while answer:
                answer = answer[os.write(file, answer) :]
