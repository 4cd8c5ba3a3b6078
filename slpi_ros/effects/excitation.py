"""Excitation of effects: what the drive that separates one effect from others is made of."""

from collections.abc import Callable
from dataclasses import dataclass
from math import pi
from typing import Protocol

import numpy as np

# Mean speed of moves, and largest speed at the steepest point even without a slew limit, in voltage ranges per second.
MEAN_SPEED, FASTEST = 0.8, 5.0
# Ratio of largest to mean slope of a raised cosine, and its smallest number of steps.
STEEPEST, FEWEST_STEPS = pi / 2, 3
# Share of the duration for the initial hold and the full loop that resets the hysteresis state.
WIPED = 0.15


class DriveLimits(Protocol):
    """What a drive has to keep to."""

    @property
    def rate(self) -> float:
        """Samples per second, hertz."""

    @property
    def duration(self) -> float:
        """Duration of the drive, seconds."""

    def quickest(self, span: float, straight: bool = False) -> float:
        """Return the shortest time (s) for a move over a `span` of the range (share)."""


class DrivePath(Protocol):
    """A sequence of moves and holds, in shares of the voltage range."""

    @property
    def at(self) -> float:
        """Position at the end."""

    def to(self, share: float, seconds: float, *, straight: bool = False) -> None:
        """Append a move to a share of the range in `seconds`, or longer if the slew limit requires it."""

    def hold(self, seconds: float) -> None:
        """Append a hold of `seconds` at the current position."""


@dataclass(frozen=True)
class Excitation:
    """An excitation drive for one effect."""

    # One sentence on the motion, and on why it separates the effect from others.
    why: str
    # Appends the legs of the drive to a path, after an initial full loop.
    draw: Callable[[DrivePath, DriveLimits], None]
    # Effects from which it separates its own where records cannot tell them apart. Of several such drives, the one with
    # the lowest order is recorded first.
    separates: tuple[str, ...] = ()
    order: int = 0
    # If the calibration drive lacks its conditions: share of the error that it may reveal at least, and what lacks.
    lacking: tuple[float, str] | None = None
    least_axes: int = 1


def safe_duration(span: float) -> float:
    """Return a duration (s), safe for any stage, of a move over a `span` of the range (share)."""
    return abs(span) * STEEPEST / FASTEST


def remaining(limits: DriveLimits) -> float:
    """Return the time (s) that remains after the initial hold and full loop."""
    return (1.0 - WIPED) * limits.duration


def move(path: DrivePath, share: float) -> None:
    """Append a move to a share of the range at the mean speed."""
    path.to(share, max(abs(share - path.at), 0.05) / MEAN_SPEED)


def loops(path: DrivePath, low: float, high: float, seconds: float, count: int, *, straight: bool = False) -> None:
    """Append `count` loops between two shares of the range, with legs of `seconds` each."""
    for _ in range(count):
        path.to(high, seconds, straight=straight)
        path.to(low, seconds, straight=straight)


def full_loops(path: DrivePath, limits: DriveLimits) -> None:
    """Append full loops one after the other, at most 60 and as quick as allowed."""
    quickest = max(limits.quickest(1.0), safe_duration(1.0))
    count = min(max(int(remaining(limits) / (2 * quickest)), 3), 60)
    loops(path, 0.0, 1.0, remaining(limits) / (2 * count), count)


def at_speeds(path: DrivePath, limits: DriveLimits, low: float, high: float, *, straight: bool) -> None:
    """Append one loop at increasing speeds, with about the same time and at least two repeats at each speed."""
    count = 6
    each = remaining(limits) / count
    span = high - low
    quickest = max(limits.quickest(span, straight), safe_duration(span), 8 / limits.rate)
    move(path, low)
    for seconds in np.geomspace(max(each / 4, quickest), quickest, count).tolist():
        loops(path, low, high, seconds, max(2, round(each / (2 * seconds))), straight=straight)
