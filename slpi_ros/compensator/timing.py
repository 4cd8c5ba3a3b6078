"""How regularly messages come, and how long they take."""

from array import array
from dataclasses import dataclass

import numpy as np

# Messages looked back on.
WINDOW = 8192


@dataclass(frozen=True)
class TimingReport:
    """The messages since the last report, the last `WINDOW` of them at most.

    Parameters
    ----------
    jitter : float, seconds
        Standard deviation of the time from one to the next.
    latency : (float, float, float), seconds
        From the arrival of a message to its published answer: median, 99th percentile, longest.
    """

    jitter: float
    latency: tuple[float, float, float]


class Timing:
    """Collects arrivals and answers."""

    def __init__(self) -> None:
        self._arrived = array("q", bytes(8 * WINDOW))
        self._took = array("q", bytes(8 * WINDOW))
        self._count = 0

    def note(self, arrived_ns: int, answered_ns: int) -> None:
        """Note one message: when it came and when it was answered, nanoseconds on a clock that never jumps."""
        at = self._count % WINDOW
        self._arrived[at] = arrived_ns
        self._took[at] = answered_ns - arrived_ns
        self._count += 1

    def report(self) -> TimingReport | None:
        """Return what was collected; None if there were fewer than two messages."""
        count, first = min(self._count, WINDOW), self._count % WINDOW if self._count > WINDOW else 0
        if count < 2:
            return None
        arrived = np.roll(np.frombuffer(self._arrived, np.int64)[:count], -first)
        p50, p99, longest = np.percentile(np.frombuffer(self._took, np.int64)[:count], (50, 99, 100)) * 1e-9
        return TimingReport(float(np.diff(arrived).std()) * 1e-9, (float(p50), float(p99), float(longest)))

    def restart(self) -> None:
        """Forget what was collected."""
        self._count = 0
