"""What the stamps of a stream of samples mean."""

from dataclasses import dataclass

from slpi_ros.runtime.rejection import DUPLICATE, TIME_BACKWARDS, RejectedError

SECOND_NS = 1_000_000_000


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
        self._restarted = False

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

        They are 0 for the first stamp and after a restart, and negative where the clock was set back.
        """
        last, self._last_ns = self._last_ns, stamp_ns
        restarted, self._restarted = self._restarted, False
        if last is None:
            return 0.0
        ahead = (stamp_ns - last) * 1e-9
        return min(ahead, 0.0) if restarted else ahead

    def arrive(self, now_ns: int) -> float:
        """Go on with a sample that has no stamp but that of its arrival (ns): it is never late."""
        last = self._last_ns
        if last is not None and last - self.jump_ns <= now_ns < last:
            now_ns = last
        return self.accept(now_ns)

    def restart(self) -> None:
        """Let the next stamp count as the first; what is older than the last one stays late."""
        self._restarted = True
