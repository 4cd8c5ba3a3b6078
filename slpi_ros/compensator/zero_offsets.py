"""Measured - model displacement of one axis, of the present and of the last reset, from which its zero is set."""

from collections import deque
from itertools import pairwise
from statistics import median

import numpy as np

from slpi_ros.io.messages import SECOND_NS

# Most measurements for the offset of an axis, and how old they may be.
OFFSETS, OFFSET_AGE_NS = 50, SECOND_NS // 5
# Most measurements of a reset, the latest; least range of a swing that counts, as a share of the widest: a changed
# sensitivity moves the others further; how long after the reset the zero is that of the reset, if nothing has moved:
# time to call for it by hand.
OF_RESET, WIDE, RESET_AGE_NS = 100_000, 0.5, 60 * SECOND_NS


class ZeroOffsets:
    """Offsets (m) with their times (steady clock, ns), also where the measurement is refused."""

    def __init__(self) -> None:
        self._recent: deque[tuple[int, float]] = deque(maxlen=OFFSETS)
        # Arrival, number of the swing, reading and displacement of the model (m), age (ns), until it moves otherwise.
        self._reset: deque[tuple[int, int, float, float, float]] = deque(maxlen=OF_RESET)

    def take(self, reading: float, expected: float, swing: int, now_ns: int, age: float = 0.0) -> None:
        """Take a reading of an `age` (s) and the present displacement of the model (m).

        `swing`: of a reset, with a known memory; 0: none.
        """
        self._recent.append((now_ns, reading - expected))
        if swing:
            self._reset.append((now_ns, swing, reading, expected, age * SECOND_NS))

    def leave_reset(self) -> None:
        """Forget the reset: the axis moves otherwise."""
        self._reset.clear()

    def forget(self) -> None:
        """Forget all: the zero has moved."""
        self._recent.clear()
        self._reset.clear()

    def latest(self, now_ns: int) -> float | None:
        """Return the offset (m) of the last 0.2 s; None without a measurement."""
        recent = [offset for t, offset in self._recent if now_ns - t <= OFFSET_AGE_NS]
        return median(recent) if recent else None

    def present(self, now_ns: int) -> float | None:
        """Return the present offset (m); None without a measurement in the last 0.2 s.

        Right after a reset it is that of its wide swings: what relaxes afterwards is not in it.
        """
        recent = self.latest(now_ns)
        if recent is not None and self._reset and now_ns - self._reset[-1][0] <= RESET_AGE_NS:
            of_reset = self._of_reset()
            return recent if of_reset is None else of_reset
        return recent

    def _of_reset(self) -> float | None:
        """Return the offset (m) of the reset; None without two wide swings one after the other."""
        t, swing, reading, expected, age = np.array(self._reset).T
        t, first = np.unique(t, return_index=True)
        if t.size < 2:
            return None
        swing, reading, expected, age = swing[first], reading[first], expected[first], age[first]
        # Some are longer on their way than others; what their clock is ahead by counts as late, below.
        offset = reading - np.interp(t - age, t, expected)
        velocity, swings = np.gradient(expected, t), []
        for number in np.unique(swing):
            own = swing == number
            swings.append((np.ptp(expected[own]), float(np.median(velocity[own])), float(np.median(offset[own]))))
        widest = max(extent for extent, _, _ in swings)
        # A reading that comes late by `T` is off by `-T` times the velocity: a swing up and one down agree on the zero.
        zeros = [
            (before * down - after * up) / (down - up)
            for (one, up, before), (other, down, after) in pairwise(swings)
            if min(one, other) >= WIDE * widest and up * down < 0.0
        ]
        return median(zeros) if zeros else None
