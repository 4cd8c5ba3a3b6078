"""What is accepted: which axes, displacements and stamps a message may hold, and why it is rejected otherwise.

One rule for all kinds of messages: a message is accepted as a whole, or rejected as a whole with a `RejectedError`
that says why; nothing has moved then.
"""

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from math import isfinite

from slpi_ros.errors import SlpiError
from slpi_ros.io.messages import SECOND_NS
from slpi_ros.model.streaming import refusal

NO_MODEL = "no_model"
INACTIVE = "inactive"
RESETTING = "resetting"
FOLLOWING = "following"
EMPTY = "empty"
LENGTH = "length"
DUPLICATE_AXIS = "duplicate_axis"
UNKNOWN_AXIS = "unknown_axis"
NOT_FINITE = "not_finite"
DUPLICATE = "duplicate"
TIME_BACKWARDS = "time_backwards"
STALE = "stale"
OUT_OF_RANGE = "out_of_range"
CAUSES = (
    NO_MODEL, INACTIVE, RESETTING, FOLLOWING, EMPTY, LENGTH, DUPLICATE_AXIS, UNKNOWN_AXIS, NOT_FINITE, DUPLICATE,
    TIME_BACKWARDS, STALE, OUT_OF_RANGE,
)  # fmt: skip
# Of measured displacements.
MEASURED_CAUSES = (NOT_FINITE, OUT_OF_RANGE)


class RejectedError(SlpiError):
    """A message was rejected as a whole, and nothing has moved.

    Attributes
    ----------
    cause : str
        One of `CAUSES`.
    """

    def __init__(self, cause: str, message: str) -> None:
        super().__init__(message)
        self.cause = cause


def require_names(names: Sequence[str], axes: Collection[str]) -> None:
    """Reject names that are none of the node's axes, or no list of them.

    Raises
    ------
    RejectedError
        If there is none, one is named twice, or one is unknown.
    """
    if not names:
        raise RejectedError(EMPTY, "no axis is named; name the axes to move")
    if len(set(names)) != len(names):
        raise RejectedError(DUPLICATE_AXIS, f"{', '.join(names)}: an axis is named twice; name each once")
    unknown = [name for name in names if name not in axes]
    if unknown:
        raise RejectedError(UNKNOWN_AXIS, f"no axis '{unknown[0]}'; this node moves {', '.join(axes)}")


def implausible(y: float, accepted: tuple[float, float], kind: str) -> RejectedError:
    """Return the rejection of a displacement `y` (m) outside of `accepted` (m); `kind`: "desired" or "measured"."""
    if isfinite(y):
        return RejectedError(OUT_OF_RANGE, refusal(y, accepted, kind))
    return RejectedError(NOT_FINITE, f"{kind} displacement is {y} m; send finite ones only")


@dataclass(frozen=True)
class TimestampRules:
    """How stamps are judged.

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
    """The stamps of the samples of one axis, whole nanoseconds.

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
        # Seconds that have passed since the present voltage was given without a stamp; None: it had one.
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
        """Take the next stamp for `elapsed` (s) after the present voltage; stamps older than the last one stay late."""
        self._restarted = elapsed
