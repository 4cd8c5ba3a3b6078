"""Validation of axis names, displacements and stamps: a message is accepted as a whole, or moves no axis."""

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from math import isfinite

from slpi_ros.errors import SlpiError
from slpi_ros.io.messages import SECOND_NS
from slpi_ros.model.streaming import refusal

NO_MODEL = "no_model"
INACTIVE = "inactive"
STARTING = "starting"
NOT_ARMED = "not_armed"
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
    NO_MODEL, INACTIVE, STARTING, NOT_ARMED, RESETTING, FOLLOWING, EMPTY, LENGTH, DUPLICATE_AXIS, UNKNOWN_AXIS,
    NOT_FINITE, DUPLICATE, TIME_BACKWARDS, STALE, OUT_OF_RANGE,
)  # fmt: skip
# Causes for measured displacements.
MEASURED_CAUSES = (NOT_FINITE, OUT_OF_RANGE)


class RejectedError(SlpiError):
    """A message was rejected as a whole, for one `cause` of `CAUSES`; no axis has moved."""

    def __init__(self, cause: str, message: str) -> None:
        super().__init__(message)
        self.cause = cause


def require_names(names: Sequence[str], axes: Collection[str]) -> None:
    """Reject an empty list of axis names, duplicates, and names that are not in `axes`."""
    if not names:
        raise RejectedError(EMPTY, "the message names no axis; name the axes to move")
    if len(set(names)) != len(names):
        raise RejectedError(DUPLICATE_AXIS, f"{', '.join(names)}: an axis is named twice; name each once")
    unknown = [name for name in names if name not in axes]
    if unknown:
        raise RejectedError(UNKNOWN_AXIS, f"no axis '{unknown[0]}'; this node moves {', '.join(axes)}")


def implausible(y: float, accepted: tuple[float, float], kind: str) -> RejectedError:
    """Return the error for a displacement `y` (m) outside `accepted` (m); `kind` is "desired" or "measured"."""
    if isfinite(y):
        return RejectedError(OUT_OF_RANGE, refusal(y, accepted, kind))
    return RejectedError(NOT_FINITE, f"{kind} displacement is {y} m; send finite values only")


@dataclass(frozen=True)
class TimestampRules:
    """Rules for message time stamps."""

    jump: float = 1.0  # s, the largest step back of a late stamp; beyond it the clock was set back, or forward a gap
    max_age: float = 0.0  # s, beyond which messages are stale; 0 disables the check


class Stamps:
    """Check the order of the sample time stamps of one axis and compute elapsed times."""

    # A stamp that is older than the last one by at most `jump_ns` is late. If it is older by more than this, the clock
    # was set back, and the elapsed time restarts.
    __slots__ = ("_last_ns", "_restarted", "jump_ns")

    def __init__(self, jump_ns: int = SECOND_NS) -> None:
        self.jump_ns = jump_ns
        self._last_ns: int | None = None
        # Whether the axis has moved without stamps since the last one.
        self._restarted = False

    def check(self, stamp_ns: int) -> None:
        """Reject a stamp (ns) that is not newer than the last one, unless the clock was set back."""
        last = self._last_ns
        if last is None or stamp_ns > last or stamp_ns < last - self.jump_ns:
            return
        if stamp_ns == last:
            raise RejectedError(DUPLICATE, "the stamp equals the last accepted one; stamp each sample anew")
        back = f"{(last - stamp_ns) * 1e-9:.9g} s"
        raise RejectedError(TIME_BACKWARDS, f"time runs {back} backwards; send samples in order")

    def accept(self, stamp_ns: int) -> float | None:
        """Store a stamp (ns) accepted by `check`; return the time (s) since the last stamp."""
        # It is 0 for the first stamp, negative if the clock was set back, None for the first one after `restart`.
        last, self._last_ns = self._last_ns, stamp_ns
        if self._restarted:
            self._restarted = False
            return None
        return (stamp_ns - last) * 1e-9 if last is not None else 0.0

    def arrive(self, now_ns: int) -> float | None:
        """Accept a sample without stamp that arrived at `now_ns` (ns); return the time (s) since the last stamp."""
        last = self._last_ns
        if last is not None and last - self.jump_ns <= now_ns < last:
            now_ns = last
        return self.accept(now_ns)

    def restart(self) -> None:
        """Count no time by stamps up to the next one: the axis moved meanwhile; older stamps are still late."""
        self._restarted = self._last_ns is not None
