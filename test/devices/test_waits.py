"""Devices that never answer, or never end an answer: every driver gives up, and says what came until then."""

import itertools
import os
import pty
import socket
import threading
import tty
from contextlib import contextmanager, suppress

import pytest

from slpi_ros.drivers.base import Channel, DeviceError
from slpi_ros.drivers.registry import make_device

# Beats of the device in 0.5 s, the longest that any thread may wait; a driver gives up after 0.2 s.
BEAT, MOST = 0.02, 25
# Device, channel, address for the driver, whether it is at a terminal.
DRIVERS = {
    "gcs": ("1", "{}", False),
    "labjack": ("DAC0:AIN0", "{}", False),
    "nidaqmx": ("ao0:ai0", "Dev1@{}", False),
    "serial": ("1", "nv200:{}", True),
}
# What a device sends with every beat once it was spoken to; the first thing once only.
ANSWERS = {
    "nothing": [b""],
    "half a line": [b"desc,=1", *[b""] * MOST],
    "a byte now and then": [b"1"],
    "what never ends": [b"\0" * 100],
}


class Device:
    """Answers at a socket or a pseudo terminal, and counts its beats while somebody waits for it."""

    def __init__(self, answers, terminal):
        self.beats, self._answers, self._ending = 0, answers, threading.Event()
        if terminal:
            self._file, self._slave = pty.openpty()
            tty.setraw(self._slave)
            self.address, self._server = os.ttyname(self._slave), None
        else:
            self._server = socket.create_server(("127.0.0.1", 0))
            self.address = "127.0.0.1:{}".format(*self._server.getsockname()[1:])
        self._thread = threading.Thread(target=self._serve)
        self._thread.start()

    def _serve(self):
        with suppress(OSError):
            if self._server:
                link, _ = self._server.accept()
                with link:
                    self._talk(lambda: link.recv(4096), link.sendall)
            else:
                self._talk(lambda: os.read(self._file, 4096), lambda data: os.write(self._file, data))

    def _talk(self, hear, say):
        hear()
        for answer in itertools.cycle(self._answers):
            if self._ending.wait(BEAT):
                return
            self.beats += 1
            if answer:
                say(answer)

    def close(self):
        self._ending.set()
        if self._server:
            with suppress(OSError):
                self._server.shutdown(socket.SHUT_RDWR)
            self._server.close()
        else:
            # Else it may wait for the first question.
            os.write(self._slave, b"\n")
        self._thread.join()
        if not self._server:
            os.close(self._file)
            os.close(self._slave)


@contextmanager
def device_that(answers, terminal):
    device = Device(ANSWERS[answers], terminal)
    try:
        yield device
    finally:
        device.close()


@pytest.mark.parametrize("answers", ANSWERS)
@pytest.mark.parametrize("kind", DRIVERS)
def test_no_wait_is_longer_than_half_a_second(kind, answers):
    channel, address, terminal = DRIVERS[kind]
    with device_that(answers, terminal) as simulated:
        device = make_device(kind, address.format(simulated.address), [Channel(channel)])
        with pytest.raises(DeviceError, match=r"no whole answer|no connection|too slowly") as told:
            device.open()
        beats = simulated.beats
        device.close()
    assert beats <= MOST and str(told.value).startswith(device.name)
    if answers == "half a line" and kind in ("gcs", "serial"):
        assert "'desc,=1'" in str(told.value)
