"""The drive that identifies everything well in the least time."""

from collections.abc import Iterator
from itertools import cycle

import numpy as np

from slpi_ros.excitation.legs import FloatArray, Path, Room

# Ranges of travel per second, and how many times as fast moves are, in turn: a 100 V stage moves at 70 V/s on average
# and at most at about 250 V/s. What depends on time then differs between moves; hysteresis does not.
PACE = 0.8
SPEEDS = (0.6, 1.0, 1.8)
FAST, SLOW = 1.8, 0.6
# Smaller moves take as long as one over this share of the range: several samples each.
SHORTEST = 0.05
# Each of the holds lasts this share of the drive.
HOLD = 0.025
# Reversal curves from each end, and as many loops in each nest. Where there is no time for the usual number, moves are
# hurried, and where that is not enough, there are fewer; where there is time for more than the most, moves are slow.
FEWEST_LEVELS, USUAL_LEVELS, MOST_LEVELS = 2, 4, 100
# Where the nests of loops within loops close in, shares of the range.
NESTS = (0.3, 0.7)


def calibration(room: Room, rng: np.random.Generator) -> Path:
    """Visit the Preisach plane evenly, at several speeds and with holds.

    A sweep over the whole range comes first, so that the record knows its memory whatever was before. Then come
    reversal curves: rising ones from minima spread over the range, falling ones from maxima spread over it, in random
    order, so that what drifts is not taken for what depends on voltage; then loops within loops. The longer the drive,
    the more of each.

    Parameters
    ----------
    room : Room
    rng : numpy.random.Generator
        Moves each reversal within its share of the range, and chooses the order.

    Returns
    -------
    Path
        From the low end to the low end.
    """
    seed = int(rng.integers(2**63))

    def planned(levels: int) -> Path:
        return _Plan(room, np.random.default_rng(seed)).of(levels)

    levels = USUAL_LEVELS
    while levels < MOST_LEVELS and planned(levels + 1).wanted_steps(room).sum() <= room.steps:
        levels += 1
    while levels > FEWEST_LEVELS and planned(levels).fewest_steps(room).sum() > room.steps:
        levels -= 1
    return planned(levels)


def sweep(room: Room) -> Path:
    """Go over the whole range once, from the low end up and down again: whatever was before is forgotten then."""
    plan = _Plan(room, np.random.default_rng(0))
    plan.sweep()
    return plan.path


class _Plan:
    def __init__(self, room: Room, rng: np.random.Generator) -> None:
        self._room, self._rng = room, rng
        self._speeds: Iterator[float] = cycle(SPEEDS)
        self.path = Path()

    def sweep(self) -> None:
        """Rest, rise, rest, fall, rest."""
        self._rise_and_fall()
        self._rest()

    def of(self, levels: int) -> Path:
        # Whatever moved the stage before is forgotten after the fall; the rise from rest is seen only once.
        self._rise_and_fall()
        self._move(1.0, FAST)
        for minimum in self._spread(levels):
            self._through(minimum, 1.0)
        self._through(0.0)
        self._rest()
        for maximum in self._spread(levels):
            self._through(maximum, 0.0)
        for centre in NESTS:
            self._nest(centre, levels)
            if centre == NESTS[-1]:
                self._rest()
            self._through(0.0)
        self._rest()
        return self.path

    def _rise_and_fall(self) -> None:
        self._rest()
        self._move(1.0, SLOW)
        self._rest()
        self._move(0.0, FAST)

    def _nest(self, centre: float, loops: int) -> None:
        for span in 1.0 - (np.arange(loops) + 0.5) / loops:
            self._through(centre + (1.0 - centre) * span, centre - centre * span)

    def _spread(self, levels: int) -> FloatArray:
        """Return shares of the range, one in each of as many equal parts, in random order."""
        return self._rng.permutation((np.arange(levels) + self._rng.uniform(0.1, 0.9, levels)) / levels)

    def _through(self, *shares: float) -> None:
        for share in shares:
            self._move(share, next(self._speeds))

    def _move(self, share: float, speed: float) -> None:
        span = abs(share - self.path.at)
        seconds = max(span, SHORTEST) / (PACE * speed)
        # Where the slew limit is low, corners are gentle anyway, and a straight move is the quicker one.
        self.path.to(share, seconds, straight=seconds < self._room.quickest(span))

    def _rest(self) -> None:
        self.path.hold(HOLD * self._room.duration)
