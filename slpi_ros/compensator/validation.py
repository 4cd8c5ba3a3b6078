"""What the stamps of a stream of samples mean."""

from dataclasses import dataclass

from slpi_ros.compensator.rejection import DUPLICATE, TIME_BACKWARDS, RejectedError
from slpi_ros.io.joint_state import SECOND_NS


@dataclass(frozen=True)
class TimeRules:
    """What stamps may do.

    Parameters
    ----------
    jump : float, seconds
        A stamp older than the last by at most this is late; by more: the clock was set back. Newer by more: a gap.
    max_age : float, seconds
        A message stamped longer ago is stale; 0: none is.
    """

    jump: float = 1.0
    max_age: float = 0.0


class Stamps:
    """The stamps of one axis: whole nanoseconds, in order, or of a clock that was set.

    Parameters
    ----------
    jump_ns : int, nanoseconds
        A stamp that is older than the last one by at most this comes late; by more: the clock was set back, and time
        starts anew.
    """

    __slots__ = ("_last_ns", "_restarted", "jump_ns")

    def __init__(self, jump_ns: int = SECOND_NS) -> None:
        self.jump_ns = jump_ns
        self._last_ns: int | None = None
        # Seconds that have passed without a stamp; None: stamps tell.
        self._restarted: float | None = None

    def check(self, stamp_ns: int) -> None:
        """Reject a stamp (ns) that is not newer than the last one, unless the clock was set back.

        Raises
        ------
        RejectedError
            With the cause `duplicate` or `time_backwards`.
        """
        last = self._last_ns
        if last is None or stamp_ns > last or stamp_ns < last - self.jump_ns:
            return
        if stamp_ns == last:
            raise RejectedError(DUPLICATE, "the stamp is that of the last accepted message; stamp each sample anew")
        back = f"{(last - stamp_ns) * 1e-9:.9g} s"
        raise RejectedError(TIME_BACKWARDS, f"time runs {back} backwards; send in order")

    def accept(self, stamp_ns: int) -> float:
        """Go on to a stamp (ns) that `check` lets pass; return the seconds since the last one.

        They are 0 for the first stamp, what `restart` says after that, and negative where the clock was set back.
        """
        last, self._last_ns = self._last_ns, stamp_ns
        elapsed = self._restarted
        if elapsed is None and last is not None:
            return (stamp_ns - last) * 1e-9
        self._restarted = None
        ahead = (stamp_ns - last) * 1e-9 if last is not None else 0.0
        return min(ahead, 0.0) or elapsed or 0.0

    def arrive(self, now_ns: int) -> float:
        """Go on with a sample that has no stamp but that of its arrival (ns): it is never late."""
        last = self._last_ns
        if last is not None and last - self.jump_ns <= now_ns < last:
            now_ns = last
        return self.accept(now_ns)

    def restart(self, elapsed: float = 0.0) -> None:
        """Let the next stamp come `elapsed` (s) after the voltage; what is older than the last one stays late."""
        self._restarted = elapsed
