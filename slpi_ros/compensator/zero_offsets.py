"""Measured - model displacement of one axis, of the present and of the last reset, from which its zero is set."""

from collections import deque
from statistics import fmean, median

from slpi_ros.io.messages import SECOND_NS

# Most measurements for the offset of an axis, and how old they may be.
OFFSETS, OFFSET_AGE_NS = 50, SECOND_NS // 5
# How long after a reset the zero is that of its sweep, if nothing has moved: time to call for it by hand.
SWEEP_AGE_NS = 60 * SECOND_NS


class ZeroOffsets:
    """Offsets (m) with their times (steady clock, ns), also where the measurement is refused."""

    def __init__(self) -> None:
        self._recent: deque[tuple[int, float]] = deque(maxlen=OFFSETS)
        # With the number of the swing before them, until the axis moves otherwise.
        self._sweep: list[tuple[int, int, float]] = []

    def take(self, offset: float, swing: int, now_ns: int) -> None:
        """Take an offset (m); `swing`: of a reset, with a known memory; 0: none."""
        self._recent.append((now_ns, offset))
        if swing:
            self._sweep.append((now_ns, swing, offset))

    def leave_reset(self) -> None:
        """Forget the reset: the axis moves otherwise."""
        self._sweep.clear()

    def forget(self) -> None:
        """Forget all: the zero has moved."""
        self._recent.clear()
        self._sweep.clear()

    def latest(self, now_ns: int) -> float | None:
        """Return the offset (m) of the last 0.2 s; None without a measurement."""
        recent = [offset for t, offset in self._recent if now_ns - t <= OFFSET_AGE_NS]
        return median(recent) if recent else None

    def present(self, now_ns: int) -> float | None:
        """Return the present offset (m); None without a measurement in the last 0.2 s.

        Right after a reset it is that of its first swings down and up over the range, as the calibrator takes it from a
        sweep: what relaxes afterwards is not in it, and what differs between falling and rising voltages cancels.
        """
        recent = self.latest(now_ns)
        if recent is not None and self._sweep and now_ns - self._sweep[-1][0] <= SWEEP_AGE_NS:
            swings = [[offset for _, swing, offset in self._sweep if swing == each] for each in (1, 2)]
            if all(swings):
                return fmean(map(median, swings))
        return recent
