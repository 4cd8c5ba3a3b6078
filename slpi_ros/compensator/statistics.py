"""Message counters, latency and tracking error of a compensator."""

from collections import Counter, deque
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from slpi_ros.compensator.validation import CAUSES, MEASURED_CAUSES, RejectedError

# What is counted, by the names that /diagnostics shows.
COUNTED = (
    "received", "accepted", "rejected", *(f"rejected.{cause}" for cause in CAUSES), "measurements_rejected",
    *(f"measurements_rejected.{cause}" for cause in MEASURED_CAUSES), "held_at_limit", "excursions", "slew_limited",
    "trajectories", "messages_lost", "worked_off", "largest_backlog", "trajectories_rejected", "points_skipped",
    "points_held_at_limit", "points_slew_limited", "gaps", "time_jumps", "models_refused",
)  # fmt: skip


class Counts(Counter[str]):
    """Counters of a compensator: of desired messages, readings, trajectories and their points (`COUNTED`).

    An excursion is each time that an axis begins to be held at a voltage limit; a gap is stamped more than `time_jump`
    after the message before, a time jump before it, as the clock had been set back.
    """

    def note(self, aheads: Sequence[float | None], jump: float, held: bool, slewing: bool) -> None:
        """Count an accepted message, `aheads` (s) after the last one of each axis by its stamp."""
        self["accepted"] += 1
        if held or slewing:
            self["held_at_limit"] += held
            self["slew_limited"] += slewing
        for ahead in aheads:
            if ahead is not None and not 0.0 <= ahead <= jump:
                known = [each for each in aheads if each is not None]
                self["gaps"] += max(known) > jump
                self["time_jumps"] += min(known) < 0.0
                break

    def reject(self, error: RejectedError, what: str = "rejected") -> None:
        """Count a rejection of a message or a reading by its cause."""
        self[what] += 1
        self[f"{what}.{error.cause}"] += 1


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
        self._arrived, self._took = deque[int](maxlen=WINDOW), deque[int](maxlen=WINDOW)  # ns

    def note(self, arrived_ns: int, answered_ns: int) -> None:
        """Store the arrival and answer times of one message, nanoseconds on a monotonic clock."""
        self._arrived.append(arrived_ns)
        self._took.append(answered_ns - arrived_ns)

    def report(self) -> TimingReport | None:
        """Return the statistics; None if there were fewer than two messages."""
        if len(self._arrived) < 2:
            return None
        p50, p99, longest = np.percentile(self._took, (50, 99, 100)) * 1e-9
        return TimingReport(float(np.diff(self._arrived).std()) * 1e-9, (float(p50), float(p99), float(longest)))

    def restart(self) -> None:
        """Discard the collected times."""
        self._arrived.clear()
        self._took.clear()


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

    __slots__ = ("_errors", "desired", "fresh", "learned")

    def __init__(self) -> None:
        self.desired: float | None = None  # m; None while the axis follows none
        self.learned = 0.0  # m, the part of the setpoint that was learned, which nobody desired
        self.fresh = False  # measured since the last report
        self._errors: deque[float] = deque(maxlen=TRACKED)

    def measure(self, displacement: float, desired: float | None = None) -> None:
        """Store the error of a displacement (m) from the setpoint it refers to (m), by default the present one."""
        if self.desired is not None:
            setpoint = self.desired if desired is None else desired
            self._errors.append(displacement - (setpoint - self.learned))
            self.fresh = True

    def report(self) -> TrackingReport:
        """Return the statistics; NaN without any measurement."""
        self.fresh = False
        errors = np.array(self._errors or [np.nan])
        rms = float(np.sqrt(np.mean(errors**2)))
        return TrackingReport(float(errors[-1]), float(errors.mean()), rms, float(np.abs(errors).max()))
