"""The figures by which a stage's hysteresis is known: stroke, loop width, remanence."""

from collections.abc import Callable
from dataclasses import dataclass


@dataclass(frozen=True)
class LoopFigure:
    """A closed major loop in five numbers.

    Parameters
    ----------
    start : float, metres
        Displacement at the lower voltage before the first rise.
    bottom, top : float, metres
        Displacement at the lower and the upper voltage of the closed loop.
    rising_middle, falling_middle : float, metres
        Displacement halfway between the two voltages, on the way up and on the way down.
    """

    start: float
    bottom: float
    top: float
    rising_middle: float
    falling_middle: float

    @property
    def stroke(self) -> float:
        """Height of the closed loop, metres."""
        return self.top - self.bottom

    @property
    def hysteresis(self) -> float:
        """Width of the loop at the middle voltage, as a share of the stroke."""
        return (self.falling_middle - self.rising_middle) / self.stroke

    @property
    def remanence(self) -> float:
        """What remains of the first rise after the return to the lower voltage, metres."""
        return self.bottom - self.start


def measure_loop(respond: Callable[[float], float], low: float, high: float) -> LoopFigure:
    """Drive two major loops and note where they pass.

    Parameters
    ----------
    respond : callable
        Takes a voltage (V) and returns the displacement (m) it leads to; starts at rest at `low` or below.
    low, high : float, volts
        The voltages between which the loop is driven.

    Returns
    -------
    LoopFigure
        The figures of the second loop, which is closed.
    """
    middle = (low + high) / 2
    start, _, bottom = respond(low), respond(high), respond(low)
    rising_middle, top, falling_middle = respond(middle), respond(high), respond(middle)
    respond(low)
    return LoopFigure(start, bottom, top, rising_middle, falling_middle)
