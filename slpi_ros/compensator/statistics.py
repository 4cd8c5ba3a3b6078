"""Counts of the messages of a compensator, and how long they took."""

from array import array
from dataclasses import dataclass, field, replace

import numpy as np

from slpi_ros.compensator.validation import CAUSES, MEASURED_CAUSES


@dataclass
class Counts:
    """What became of the desired messages.

    Parameters
    ----------
    received, accepted : int
    held_at_limit : int
        Accepted ones of which an axis could not reach its displacement within the voltage limits.
    slew_limited : int
        Accepted ones of which an axis was still on its way, as fast as slew and acceleration allow.
    excursions : int
        Times that an axis went out of reach; it stays one until the axis is back.
    gaps : int
        Accepted ones whose stamp came more than `time_jump` after the one before.
    time_jumps : int
        Accepted ones after which time started anew, because the clock had been set back.
    by_cause : dict of str to int
        Rejected ones.
    measured_by_cause : dict of str to int
        Measured displacements of axes that were not used.
    trajectories, trajectories_rejected : int
        Those that were sent, and those of them that could not be followed.
    points_held, points_slewing : int
        Points of trajectories, as `held_at_limit` and `slew_limited`.
    """

    received: int = 0
    accepted: int = 0
    held_at_limit: int = 0
    slew_limited: int = 0
    excursions: int = 0
    gaps: int = 0
    time_jumps: int = 0
    by_cause: dict[str, int] = field(default_factory=lambda: dict.fromkeys(CAUSES, 0))
    measured_by_cause: dict[str, int] = field(default_factory=lambda: dict.fromkeys(MEASURED_CAUSES, 0))
    trajectories: int = 0
    trajectories_rejected: int = 0
    points_held: int = 0
    points_slewing: int = 0

    @property
    def rejected(self) -> int:
        """All rejected messages."""
        return self.received - self.accepted

    @property
    def measurements_rejected(self) -> int:
        """All measured displacements that were not used."""
        return sum(self.measured_by_cause.values())

    def copy(self) -> "Counts":
        """Return the present counts, which do not count on."""
        return replace(self, by_cause=dict(self.by_cause), measured_by_cause=dict(self.measured_by_cause))


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
