"""What every drive is made of: moves and holds, one after the other, within what an axis may do."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from slpi_ros.errors import UsageError

FloatArray = NDArray[np.float64]

# The steepest part of a raised cosine is so many times as steep as the whole.
STEEPEST = math.pi / 2
# A raised cosine of fewer steps is none.
FEWEST_STEPS = 3
# A drive of more samples is a mistake.
MOST_STEPS = 10_000_000
# No stage takes more, volts: a larger one is a slip.
MOST_VOLTAGE = 10_000.0


@dataclass(frozen=True)
class Leg:
    """One move; without a way to go, a hold.

    Parameters
    ----------
    to : float
        Where it ends, as a share of the voltage range, 0..1.
    seconds : float
        How long it is to take. The slew limit may ask for more.
    straight : bool
        At constant speed, with sharp corners; else as a raised cosine, at rest at both ends.
    """

    to: float
    seconds: float
    straight: bool = False


@dataclass(frozen=True)
class Room:
    """What one axis may do.

    Parameters
    ----------
    low, high : float, volts
        Never left.
    duration : float, seconds
        Time of the last sample, from 0.
    rate : float, hertz
        Samples per second.
    slew_limit : float, V/s
        Fastest change from one sample to the next; 0: none.

    Raises
    ------
    UsageError
        If a value makes no sense.
    """

    low: float
    high: float
    duration: float
    rate: float
    slew_limit: float = 0.0

    def __post_init__(self) -> None:
        """Refuse what leaves no room."""
        if not -math.inf < self.low < self.high < math.inf:
            raise UsageError(f"drive: limits {self.low} V and {self.high} V; the first must be the lower one")
        if max(-self.low, self.high) > MOST_VOLTAGE:
            raise UsageError(
                f"drive: limits {self.low:g} V and {self.high:g} V; give at most {MOST_VOLTAGE:g} V either way"
            )
        if not (0 < self.duration < math.inf and 0 < self.rate < math.inf):
            raise UsageError(f"drive: {self.duration} s at {self.rate} Hz; both must be more than 0")
        if self.duration * self.rate > MOST_STEPS:
            raise UsageError(f"drive: {self.duration:g} s at {self.rate:g} Hz are more than {MOST_STEPS} samples")
        if not 0 <= self.slew_limit < math.inf:
            raise UsageError(f"drive: slew limit {self.slew_limit} V/s; give more than 0, or 0 for none")

    @property
    def span(self) -> float:
        """Size of the range, volts."""
        return self.high - self.low

    @property
    def steps(self) -> int:
        """Number of steps from the first sample to the last."""
        return round(self.duration * self.rate)

    def quickest(self, span: float, straight: bool = False) -> float:
        """Return the shortest time (s) for a move over a `span` of the range (share)."""
        if not self.slew_limit:
            return 0.0
        return abs(span) * self.span * (1.0 if straight else STEEPEST) / self.slew_limit

    def fewest_steps(self, span: float, straight: bool) -> int:
        """Return the smallest number of steps for a move over a `span` of the range (share)."""
        return max(1 if straight else FEWEST_STEPS, math.ceil(self.quickest(span, straight) * self.rate))


class Path:
    """Legs, each beginning where the one before it ends.

    Parameters
    ----------
    start : float
        Where the first one begins, as a share of the voltage range.

    Attributes
    ----------
    start : float
        As given.
    at : float
        Where the last one ends.
    legs : list of Leg
        In order.
    """

    def __init__(self, start: float = 0.0) -> None:
        self.start = self.at = start
        self.legs: list[Leg] = []

    def to(self, share: float, seconds: float, *, straight: bool = False) -> None:
        """Move to a share of the range in some seconds, if the slew limit allows."""
        self.legs.append(Leg(share, seconds, straight))
        self.at = share

    def hold(self, seconds: float) -> None:
        """Stay."""
        self.to(self.at, seconds)

    def wanted_steps(self, room: Room) -> FloatArray:
        """Return the number of steps that each leg takes when none is hurried, shape (n,)."""
        wanted = np.array([leg.seconds * room.rate for leg in self.legs])
        return np.asarray(np.maximum(wanted, self.fewest_steps(room)), dtype=np.float64)

    def fewest_steps(self, room: Room) -> NDArray[np.int64]:
        """Return the number of steps that each leg takes at least, shape (n,)."""
        spans = np.diff(self._turns).tolist()
        fewest = [room.fewest_steps(span, leg.straight) for span, leg in zip(spans, self.legs, strict=True)]
        return np.array(fewest, dtype=np.int64)

    def voltages(self, room: Room) -> FloatArray:
        """Move along all legs in just the room's duration.

        Time that is left over, or missing, is shared out: long legs get or give more of it than short ones.

        Parameters
        ----------
        room : Room

        Returns
        -------
        ndarray, shape (room.steps + 1,), volts
            Every turn falls on a sample.

        Raises
        ------
        UsageError
            If the duration is too short for the legs at this slew limit and rate.
        """
        fewest = self.fewest_steps(room)
        spare = room.steps - int(fewest.sum())
        if spare < 0:
            raise UsageError(
                f"drive: {len(fewest)} moves and holds within {room.low:g} to {room.high:g} V take at least "
                f"{fewest.sum() / room.rate:.4g} s at {_pace_of(room)}, not {room.duration:g} s; give more time"
            )
        knots = np.concatenate([[0], np.cumsum(fewest) + _shared_out(spare, self.wanted_steps(room) - fewest)])
        x = np.arange(room.steps + 1)
        leg = np.clip(np.searchsorted(knots, x, side="right") - 1, 0, fewest.size - 1)
        phase = (x - knots[leg]) / np.diff(knots)[leg]
        straight = np.array([each.straight for each in self.legs])[leg]
        way = np.where(straight, phase, (1.0 - np.cos(np.pi * phase)) / 2.0)
        share = self._turns[leg] + np.diff(self._turns)[leg] * way
        return np.asarray(np.clip(room.low + room.span * share, room.low, room.high), dtype=np.float64)

    @property
    def _turns(self) -> FloatArray:
        return np.array([self.start, *(leg.to for leg in self.legs)])


def _shared_out(steps: int, weights: FloatArray) -> NDArray[np.int64]:
    """Share out whole steps by weights; return the running totals, shape (len(weights),)."""
    # Where nobody asks for more, all get the same.
    total = np.cumsum(weights + 1e-9)
    return np.asarray(np.rint(steps * total / total[-1]), dtype=np.int64)


def _pace_of(room: Room) -> str:
    return f"{room.rate:g} Hz and {room.slew_limit:g} V/s" if room.slew_limit else f"{room.rate:g} Hz"
