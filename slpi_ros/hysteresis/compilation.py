"""The compiler of Numba, or a warning where there is none, and the listeners that are told of compilations."""

import warnings
from collections.abc import Callable
from functools import cache
from typing import Any

from slpi_ros.errors import HOW_TO_GET, explanation

listeners: list[Callable[[str], None]] = []


class NotCompiledWarning(UserWarning):
    """Numba is missing or broken: long paths and diagnoses take many times as long, with the same results."""


def announce() -> None:
    """Tell all listeners that a function is being compiled, which takes seconds, once on a machine."""
    for listener in listeners:
        listener("compiling numerical functions, once on this machine")


@cache
def compiler() -> Callable[..., Any] | None:
    """Return ``numba.njit``; None, after one NotCompiledWarning in this process, if Numba is missing or broken.

    Importing Numba takes about 0.5 s.
    """
    try:
        from numba import njit
        from numba.core import event

        _try(njit)
    # Not only ImportError: a library of LLVM that cannot be loaded is an OSError, another Python a KeyError.
    except Exception as error:
        reason = explanation(error) or f"numba cannot be used ({error}); get another one: {HOW_TO_GET['numba']}"
        warnings.warn(f"{reason}. Without it, long paths take many times as long", NotCompiledWarning, stacklevel=2)
        return None

    class Announcer(event.Listener):
        """Listener of Numba's compilations; functions loaded from the cache are none."""

        def on_start(self, event: event.Event) -> None:
            """Announce a compilation."""
            announce()

        def on_end(self, event: event.Event) -> None:
            """Do nothing."""

    event.register("numba:compile", Announcer())  # type: ignore[no-untyped-call]
    compile_: Callable[..., Any] = njit
    return compile_


def _try(njit: Callable[..., Any]) -> None:
    """Compile a function: a Numba that does not know this Python or this NumPy may fail no earlier."""
    try:
        njit(cache=True)(_nothing)()
    except RuntimeError:
        # No folder for the cache is writable.
        njit(_nothing)()


def _nothing() -> None:
    pass
