"""Message counters, latency and tracking error of a compensator."""

from array import array
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from slpi_ros.compensator.validation import CAUSES, MEASURED_CAUSES


@dataclass
class Counts:
    """Message counters of a compensator."""

    received: int = 0  # messages with desired displacements
    accepted: int = 0
    held_at_limit: int = 0  # of the accepted: an axis was held at a voltage limit
    slew_limited: int = 0  # of the accepted: slew or acceleration kept an axis from its setpoint
    excursions: int = 0  # how often an axis began to be held at a voltage limit
    gaps: int = 0  # stamped more than `time_jump` after the previous message
    time_jumps: int = 0  # stamped before the previous message: the clock had been set back
    by_cause: dict[str, int] = field(default_factory=lambda: dict.fromkeys(CAUSES, 0))
    measured_by_cause: dict[str, int] = field(default_factory=lambda: dict.fromkeys(MEASURED_CAUSES, 0))
    trajectories: int = 0
    trajectories_rejected: int = 0
    points_held: int = 0
    points_slewing: int = 0
    lost: int = 0  # messages, by the middleware
    worked_off: int = 0  # messages that had waited
    largest_backlog: int = 0
    models_refused: int = 0

    @property
    def rejected(self) -> int:
        """Number of rejected messages."""
        return self.received - self.accepted

    @property
    def measurements_rejected(self) -> int:
        """Number of rejected measured displacements."""
        return sum(self.measured_by_cause.values())

    def note(self, aheads: Sequence[float | None], jump: float, held: bool, slewing: bool) -> None:
        """Count an accepted message, `aheads` (s) after the last one of each axis by its stamp."""
        self.accepted += 1
        self.held_at_limit += held
        self.slew_limited += slewing
        known = [each for each in aheads if each is not None]
        if known:
            self.gaps += max(known) > jump
            self.time_jumps += min(known) < 0.0

    def copy(self) -> "Counts":
        """Return a copy of the present counts."""
        return replace(self, by_cause=dict(self.by_cause), measured_by_cause=dict(self.measured_by_cause))


# Maximum number of messages in the statistics.
WINDOW = 8192


@dataclass(frozen=True)
class TimingReport:
    """Timing of the messages since the last `Timing.restart`, at most of the last `WINDOW` messages."""

    jitter: float  # s, standard deviation of the time between messages
    latency: tuple[float, float, float]  # s from arrival to output: median, 99th percentile, maximum


class Timing:
    """Collect arrival times and latencies of messages."""

    def __init__(self) -> None:
        self._arrived = array("q", bytes(8 * WINDOW))
        self._took = array("q", bytes(8 * WINDOW))
        self._count = 0

    def note(self, arrived_ns: int, answered_ns: int) -> None:
        """Store the arrival and answer times of one message, nanoseconds on a monotonic clock."""
        at = self._count % WINDOW
        self._arrived[at] = arrived_ns
        self._took[at] = answered_ns - arrived_ns
        self._count += 1

    def report(self) -> TimingReport | None:
        """Return the statistics; None if there were fewer than two messages."""
        count, first = min(self._count, WINDOW), self._count % WINDOW if self._count > WINDOW else 0
        if count < 2:
            return None
        arrived = np.roll(np.frombuffer(self._arrived, np.int64)[:count], -first)
        p50, p99, longest = np.percentile(np.frombuffer(self._took, np.int64)[:count], (50, 99, 100)) * 1e-9
        return TimingReport(float(np.diff(arrived).std()) * 1e-9, (float(p50), float(p99), float(longest)))

    def restart(self) -> None:
        """Discard the collected times."""
        self._count = 0


# Number of measurements in the statistics of the tracking error.
TRACKED = 500


@dataclass(frozen=True)
class TrackingReport:
    """Tracking error (m), measured - desired, over the last `TRACKED` measurements; `maximum` is absolute."""

    latest: float
    mean: float
    rms: float
    maximum: float


class TrackingStatistics:
    """Collect the tracking error (m), measured - desired, of one axis."""

    __slots__ = ("_count", "_errors", "desired", "fresh", "learned")

    def __init__(self) -> None:
        self.desired: float | None = None  # m; None while the axis follows none
        self.learned = 0.0  # m, the part of the setpoint that was learned, which nobody desired
        self.fresh = False  # measured since the last report
        self._errors = array("d", bytes(8 * TRACKED))
        self._count = 0

    def measure(self, displacement: float, desired: float | None = None) -> None:
        """Store the error of a displacement (m) from the setpoint it refers to (m), by default the present one."""
        if self.desired is not None:
            setpoint = self.desired if desired is None else desired
            self._errors[self._count % TRACKED] = displacement - (setpoint - self.learned)
            self._count += 1
            self.fresh = True

    def report(self) -> TrackingReport:
        """Return the statistics; NaN without any measurement."""
        self.fresh = False
        if not self._count:
            return TrackingReport(np.nan, np.nan, np.nan, np.nan)
        errors = np.frombuffer(self._errors)[: min(self._count, TRACKED)]
        return TrackingReport(
            latest=float(errors[(self._count - 1) % TRACKED]),
            mean=float(errors.mean()),
            rms=float(np.sqrt(np.mean(errors**2))),
            maximum=float(np.abs(errors).max()),
        )
