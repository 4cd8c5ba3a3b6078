"""What a long computation is about, said to whoever listens.

Whoever computes calls `report_progress`; who wants to know listens. So no fit has to hand a listener on.
"""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import TextIO

Listener = Callable[[str], None]

# Shorter work is not worth a word (seconds).
PATIENCE = 2.0
_CLEAR = "\r\x1b[K"

_listener: ContextVar[Listener | None] = ContextVar("listener", default=None)


def report_progress(what: str) -> None:
    """Say in a few words what is being done."""
    listener = _listener.get()
    if listener:
        listener(what)


@contextmanager
def listening(listener: Listener) -> Iterator[None]:
    """Hand everything told within to `listener`."""
    token = _listener.set(listener)
    try:
        yield
    finally:
        _listener.reset(token)


@contextmanager
def shown_on(stream: TextIO, clock: Callable[[], float] = time.monotonic) -> Iterator[None]:
    """Show the latest on one line of a terminal, once the work takes long; write nothing on anything else."""
    if not stream.isatty():
        yield
        return
    began, shown = clock(), False

    def show(what: str) -> None:
        nonlocal shown
        seconds = clock() - began
        if seconds >= PATIENCE:
            shown = True
            stream.write(f"{_CLEAR}{seconds:.0f} s: {what}")
            stream.flush()

    with listening(show):
        try:
            yield
        finally:
            if shown:
                stream.write(_CLEAR)
                stream.flush()
