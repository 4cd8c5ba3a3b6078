"""Why messages are rejected, and checks of names and displacements: accepted as a whole, or no axis moves."""

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from math import isfinite

from slpi_ros.errors import SlpiError
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
