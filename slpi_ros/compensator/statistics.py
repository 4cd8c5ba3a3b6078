"""What became of the messages of a compensator."""

from dataclasses import dataclass, field, replace

from slpi_ros.compensator.rejection import CAUSES, MEASURED_CAUSES


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
