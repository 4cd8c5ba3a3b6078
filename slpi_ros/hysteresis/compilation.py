"""Listeners that are told before a function is compiled, which takes seconds, once on a machine."""

from collections.abc import Callable

listeners: list[Callable[[str], None]] = []


def announce() -> None:
    """Tell all listeners that a function is being compiled."""
    for listener in listeners:
        listener("compiling numerical functions, once on this machine")
