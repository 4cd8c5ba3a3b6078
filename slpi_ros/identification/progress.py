"""Progress messages of long computations: `report_progress` tells the listener that `listening` has set."""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from threading import Timer
from typing import TextIO

from slpi_ros.hysteresis import compilation

Listener = Callable[[str], None]

# Computing time before progress is shown, seconds.
PATIENCE = 2.0
_CLEAR = "\r\x1b[K"

_listener: ContextVar[Listener | None] = ContextVar("listener", default=None)


def report_progress(what: str) -> None:
    """Report the current step, `what`, to the listener of this context, if any."""
    listener = _listener.get()
    if listener:
        listener(what)


compilation.listeners.append(report_progress)


@contextmanager
def listening(listener: Listener) -> Iterator[None]:
    """Pass every progress message of the ``with`` block to `listener`."""
    token = _listener.set(listener)
    try:
        yield
    finally:
        _listener.reset(token)


@contextmanager
def shown_on(stream: TextIO, clock: Callable[[], float] = time.monotonic) -> Iterator[None]:
    """Show the latest progress message on one line of a terminal after `PATIENCE`; write nothing to other streams."""
    if not stream.isatty():
        yield
        return
    began, shown, latest = clock(), False, ""

    def show(what: str) -> None:
        nonlocal shown, latest
        seconds, latest = clock() - began, what
        if what and seconds >= PATIENCE:
            shown = True
            stream.write(f"{_CLEAR}{seconds:.0f} s: {what}")
            stream.flush()

    # A message that came before `PATIENCE` may be followed by a long step.
    timer = Timer(PATIENCE, lambda: show(latest))
    timer.daemon = True
    timer.start()
    with listening(show):
        try:
            yield
        finally:
            timer.cancel()
            if shown:
                stream.write(_CLEAR)
                stream.flush()
