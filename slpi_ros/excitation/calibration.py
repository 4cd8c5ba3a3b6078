"""The default voltage signal for the identification of hysteresis and effects."""

from collections.abc import Iterator
from itertools import cycle

import numpy as np

from slpi_ros.arrays import FloatArray
from slpi_ros.effects.excitation import MEAN_SPEED
from slpi_ros.excitation.legs import DriveSpec, Path

# Sequence of speeds relative to the mean speed: for a 100 V stage a mean of 70 V/s and at most about 250 V/s. Different
# speeds separate time-dependent effects from hysteresis.
SPEEDS = (0.6, 1.0, 1.8)
FAST, SLOW = 1.8, 0.6
# Shorter moves take the time of a move over this share of the range, for several samples each.
SHORTEST = 0.05
# Duration of each hold as a share of the total duration.
HOLD = 0.025
# Number of reversal curves from each end and of loops in each nest: smallest, usual, largest. If time is short, moves
# become faster, then their number is reduced; if time remains beyond the largest number, moves become slower.
FEWEST_LEVELS, USUAL_LEVELS, MOST_LEVELS = 2, 4, 100
# Centres of the nested loops, shares of the range.
NESTS = (0.3, 0.7)


def calibration(spec: DriveSpec, rng: np.random.Generator) -> Path:
    """Cover the Preisach plane uniformly, at several speeds and with holds, from the low end and back to it."""
    # A sweep over the whole range comes first, to set a known hysteresis state. Reversal curves follow in random order,
    # rising from minima and falling from maxima over the whole range, so that drift is not correlated with voltage;
    # then nested loops. A longer duration gives more of each.
    seed = int(rng.integers(2**63))

    def planned(levels: int) -> Path:
        return _Plan(spec, np.random.default_rng(seed)).of(levels)

    levels = USUAL_LEVELS
    while levels < MOST_LEVELS and planned(levels + 1).wanted_steps(spec).sum() <= spec.steps:
        levels += 1
    while levels > FEWEST_LEVELS and planned(levels).fewest_steps(spec).sum() > spec.steps:
        levels -= 1
    return planned(levels)


def sweep(spec: DriveSpec) -> Path:
    """Return one sweep over the whole range, up and down, which removes the initial state."""
    plan = _Plan(spec, np.random.default_rng(0))
    plan.sweep()
    return plan.path


class _Plan:
    def __init__(self, spec: DriveSpec, rng: np.random.Generator) -> None:
        self._room, self._rng = spec, rng
        self._speeds: Iterator[float] = cycle(SPEEDS)
        self.path = Path()

    def sweep(self) -> None:
        """Append a hold, a rise, a hold, a fall and a hold."""
        self._rise_and_fall()
        self._rest()

    def of(self, levels: int) -> Path:
        # The fall removes the initial state; the first rise from rest occurs only once.
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
        """Return shares of the range in random order, one from each of `levels` equal parts."""
        return self._rng.permutation((np.arange(levels) + self._rng.uniform(0.1, 0.9, levels)) / levels)

    def _through(self, *shares: float) -> None:
        for share in shares:
            self._move(share, next(self._speeds))

    def _move(self, share: float, speed: float) -> None:
        span = abs(share - self.path.at)
        seconds = max(span, SHORTEST) / (MEAN_SPEED * speed)
        # Under a low slew limit raised cosines have no advantage, and straight moves are faster.
        self.path.to(share, seconds, straight=seconds < self._room.quickest(span))

    def _rest(self) -> None:
        self.path.hold(HOLD * self._room.duration)
